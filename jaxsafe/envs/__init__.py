"""The tasks by name, and `make`, which returns the environment of a task.

The two domains, `rejoin` and `docking`, have a module each. The tasks of a domain are at the end of
its module. The module `task` has the record of a task and the function that registers one.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from jaxsafe.config import build, load, load_filter, override
from jaxsafe.environment import Environment
from jaxsafe.envs import docking, rejoin
from jaxsafe.envs.task import (
    STARTERS,
    TASKS,
    Task,
    default_filter,
    find_task,
    is_file,
    register,
    registered,
    short_name,
    user_module,
)
from jaxsafe.rta.filter import RTA
from jaxsafe.schema.dotted_paths import get_path, set_path
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.simulation.controllers import AgentController, Continuous, Discrete, Mixed

__all__ = [
    "STARTERS",
    "TASKS",
    "VARIANTS",
    "Task",
    "adapt",
    "default_filter",
    "find_task",
    "is_file",
    "make",
    "register",
    "registered",
    "short_name",
    "unchanged",
    "user_module",
]

# The tasks are registered in the order of the paper.
for _task in (*rejoin.TASKS, *docking.TASKS, *docking.STARTERS):
    register(_task)

VARIANTS = ("paper", "released")
"""Variants of a task.

`paper` is the task as it is declared. `released` has the semantics of the published SafeRL code.
"""

_ACTIONS: dict[str, type[AgentController]] = {
    "continuous": Continuous,
    "discrete": Discrete,
    "mixed": Mixed,
}


def make(
    task: str | os.PathLike,
    overrides: Mapping[str, Any] | None = None,
    *,
    actions: Literal["continuous", "discrete", "mixed"] | None = None,
    variant: Literal["paper", "released"] | None = None,
    randomize: Mapping[str, Sequence[float]] | None = None,
    rta: str | RTA | None = None,
) -> Environment:
    """Return an environment, ready for `reset` and `step`.

    Args:
        task: the name of a task, or the path of a YAML file as printed by `jaxsafe config`.
            `MODULE:NAME` first imports the module that registers the task.
        overrides: new values by dotted path, for instance `{"reward.delta_v.scale": -0.02}`.
        actions: `continuous` for actions in [−1, 1], `discrete` for indices of points, one for each
            actuator, or `mixed` for indices where an actuator has `discrete: true`. None leaves
            what the task has. The tasks by name are continuous.
        variant: `paper`, or `released` for the semantics of the published SafeRL code. None stands
            for `paper`.
        randomize: intervals, by dotted path, of numbers that are drawn again for each episode, for
            instance `{"deputy.mass": [10, 14]}`.
        rta: run time assurance. It is the name of a preset of the task, `default` for the
            recommended preset, a filter, or a YAML file with a filter that
            `jaxsafe.config.load_filter` can read. `none` removes the filter that a file has. None
            leaves the environment as it is. The tasks by name have no filter.

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    if not isinstance(task, (str, os.PathLike)):
        raise ConfigError(f"env: expected the name of a task or a .yaml file, found {show(task)}")
    for option, expected_type, value in (
        ("overrides", Mapping, overrides),
        ("randomize", Mapping, randomize),
        ("actions", str, actions),
    ):
        if value is not None and not isinstance(value, expected_type):
            expected = "paths with values" if expected_type is Mapping else "a name"
            raise ConfigError(f"{option}: expected {expected}, found {show(value)}")
    name = os.fspath(task)
    return adapt(
        unchanged(name),
        name,
        overrides,
        actions=actions,
        variant=variant,
        randomize=randomize,
        rta=rta,
    )


def unchanged(task: str) -> Environment:
    """Return the environment of a task as it is declared, or the environment in a YAML file.

    Raises:
        ConfigError: there is no such task, or the file has no environment.
    """
    env = load(task) if is_file(task) else build(find_task(task).environment())
    return env.named(short_name(task))


def adapt(
    env: Environment,
    task: str,
    overrides: Mapping[str, Any] | None = None,
    *,
    actions: str | None = None,
    variant: str | None = None,
    randomize: Mapping[str, Sequence[float]] | None = None,
    rta: str | RTA | None = None,
    place: str = "",
) -> Environment:
    """Return an environment changed by the options of `make`.

    Args:
        env: the environment.
        task: the name of its task, or its file.
        overrides: new values by dotted path.
        actions: the kind of actions, as for `make`.
        variant: the variant of the task, as for `make`, but None changes nothing.
        randomize: the intervals of random numbers by dotted path.
        rta: run time assurance, as for `make`.
        place: what error messages put before the paths of the overrides, such as `env`.

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    if variant is not None:
        env = override(env, _variant_values(task, variant))
    if actions is not None:
        env = _with_actions(env, actions)
    # A filter may fit the environment only together with the overrides, so both are set at once.
    filters = {} if rta is None else {"rta": _filter(task, rta)}
    random = {} if randomize is None else {"randomize": randomize}
    return override(env, {**filters, **(overrides or {}), **random}, place)


def _variant_values(name: str, variant: str) -> dict[str, Any]:
    """Return the values of a variant, for every dotted path at which the variants differ.

    Args:
        name: the name of a task, which may begin with its module.
        variant: one of `VARIANTS`.

    Raises:
        ConfigError: there is no such variant, or `name` is not the name of a task.
    """
    if variant not in VARIANTS:
        raise ConfigError(
            f"variant: unknown variant {show(variant)}{choices_text(variant, VARIANTS)}"
        )
    task = TASKS.get(name.rpartition(":")[2])
    if task is None:
        raise ConfigError(f"variant: {name} has no variants; a variant is for {', '.join(TASKS)}")
    if variant == "released":
        return dict(task.released)
    paper = task.environment()
    return {path: get_path(paper, path) for path in task.released}


def _filter(name: str, rta: str | RTA) -> RTA | None:
    """Return the filter that the option `rta` of `make` stands for. None is no filter.

    Raises:
        ConfigError: there is no such preset, or the file has no filter.
    """
    if isinstance(rta, RTA):
        return rta
    if isinstance(rta, str) and rta.endswith((".yaml", ".yml")):
        return load_filter(rta)
    task = registered(name)
    presets = {"none": lambda: None, **(task.filters if task else {})}
    if not isinstance(rta, str) or rta not in presets:
        choices = [*presets, "FILE.yaml"]
        raise ConfigError(f"rta: {name} has no preset {show(rta)}{choices_text(rta, choices)}")
    return presets[rta]()


def _with_actions(env: Environment, actions: str) -> Environment:
    if actions not in _ACTIONS:
        raise ConfigError(f"actions: unknown kind {show(actions)}{choices_text(actions, _ACTIONS)}")
    actuators = env.actuators
    if actions == "continuous":
        actuators = tuple(actuator.replace(discrete=False) for actuator in actuators)
    return set_path(env, f"{env.agent}.controller", _ACTIONS[actions](actuators=actuators))
