"""The tasks by name, and `make`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, Literal

from jaxsafe.config import build, load, override
from jaxsafe.config.override import set_path
from jaxsafe.environment import Environment
from jaxsafe.envs.docking2d import docking2d
from jaxsafe.envs.docking3d import docking3d
from jaxsafe.errors import ConfigError, nearest
from jaxsafe.simulation.controllers import Continuous, Discrete

TASKS = {"docking2d": docking2d, "docking3d": docking3d}
"""Every task that `make` knows by name."""

_ACTIONS = {"continuous": Continuous, "discrete": Discrete}


def make(
    task: str | os.PathLike,
    overrides: Mapping[str, Any] | None = None,
    *,
    actions: Literal["continuous", "discrete"] | None = None,
) -> Environment:
    """Return an environment, ready for `reset` and `step`.

    Args:
        task: the name of a task, or the path of a YAML file as printed by `python -m jaxsafe.config`.
        overrides: new values by dotted path, for instance `{"reward.delta_v.scale": -0.02}`.
        actions: `continuous`, in [−1, 1], or `discrete`, indices of points per actuator; None leaves what the task has
            (the tasks by name are continuous).

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    if not isinstance(task, (str, os.PathLike)):
        raise ConfigError(f"env: expected the name of a task or a .yaml file, found {task!r}")
    name = os.fspath(task)
    if name in TASKS:
        env = build(TASKS[name]())
    elif name.endswith((".yaml", ".yml")):
        env = load(name)
    else:
        raise ConfigError(f"env: unknown task {name!r} and not a .yaml file; choose from {nearest(name, TASKS)}")
    if actions is not None:
        env = _with_actions(env, actions)
    return override(env, overrides or {})


def _with_actions(env: Environment, actions: str) -> Environment:
    if actions not in _ACTIONS:
        raise ConfigError(f"actions: unknown kind {actions!r}; choose from {nearest(actions, _ACTIONS)}")
    controller = _ACTIONS[actions](actuators=env.agent_platform.controller.actuators)
    return set_path(env, f"{env.agent}.controller", controller)
