"""The record that describes a task, and the tasks by name.

A package adds a task of its own with one call:

    register(Task(name="hover", environment=hover))

Then `make("hover")` knows it, Gymnasium knows its id, and
`jaxsafe train env=MODULE:hover` imports the module that registers it and trains it.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gymnasium.envs import registration

from jaxsafe.control.law import ControlLaw
from jaxsafe.environment import Environment
from jaxsafe.rta.filter import RTA
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.schema.user_modules import import_modules

Filters = Mapping[str, Callable[[], RTA]]
"""Filters by the name of their preset. `default` is the recommended one."""

Controllers = Mapping[str, Callable[[], ControlLaw]]
"""Classical controllers by the name that follows `controller/`."""

TASKS: dict[str, Task] = {}
"""Every registered task by its name, except the starters."""

STARTERS: dict[str, Task] = {}
"""Small tasks to begin with, by name. They are not part of the benchmark, nor of `env=all`."""

_NAME = re.compile(r"[A-Za-z]\w*")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Task:
    """A task: its environment, and what the commands offer for it."""

    name: str
    environment: Callable[[], Environment]
    """Returns the environment as it is declared, before `jaxsafe.config.build`."""
    released: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """What `variant="released"` changes, by dotted path: the semantics of the released code."""
    filters: Filters = dataclasses.field(default_factory=dict)
    """The presets of `rta=…`."""
    controllers: Controllers = dataclasses.field(default_factory=dict)
    """The controllers of `run=controller/…`."""
    gymnasium_id: str | None = None
    """The id for `gymnasium.make`, for instance `my_package/Hover-v0`."""
    recipe: str | Path | None = None
    """The file of training recipes by preset, or of an environment that has such `recipes`. A
    relative path begins at the package's `configs/`. Without a file there is only the preset
    `observation_only`, which has the defaults of the options."""
    paper_steps: int | None = None
    """Table 2 of the paper: environment steps to 80 % success in training."""
    reference_returns: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Mean returns of an episode: `random` of random actions, `expert` of the packaged policy.

    The score of an offline learner is 0 at the first and 100 at the second. Headers of datasets
    have them if the task has a `gymnasium_id`."""
    starter: bool = False
    """Whether it is a small task to begin with, which no comparison of tasks includes."""


def register(task: Task) -> None:
    """Make a task known by its name, and to Gymnasium by its id.

    A task that is defined again in the same module replaces the first one, as happens when the cell
    of a notebook runs twice.

    Raises:
        ConfigError: the name is not a plain word, or another task has the name or the id.
    """
    if not _NAME.fullmatch(task.name) or task.name == "all":
        raise ConfigError(
            f"task {show(task.name)}: expected a name of letters, digits and _, other than all"
        )
    existing = registered(task.name)
    if existing and existing.environment.__module__ != task.environment.__module__:
        raise ConfigError(
            f"task {task.name!r}: taken by {existing.environment.__module__}; choose another name"
        )
    if task.gymnasium_id:
        _register_id(task.gymnasium_id, task.name)
    (STARTERS if task.starter else TASKS)[task.name] = task


def registered(name: str) -> Task | None:
    """Return the task of a name, or None if there is none. The name may begin with its module."""
    short = name.rpartition(":")[2]
    return TASKS.get(short) or STARTERS.get(short)


def find_task(name: str, place: str = "env", others: Sequence[str] = ()) -> Task:
    """Return the task of a name. `MODULE:NAME` imports the user's module first, which registers it.

    Args:
        name: the name.
        place: where the name was given. Error messages begin with it.
        others: what may be given besides tasks and files, for error messages.

    Raises:
        ConfigError: the module cannot be imported, or there is no such task.
    """
    module, _, short = name.rpartition(":")
    if module:
        import_modules([module], place)
    task = registered(short)
    if task is None:
        raise ConfigError(
            f"{place}: unknown task {show(short)} and not a .yaml file"
            f"{choices_text(short, [*TASKS, *STARTERS, *others])}"
        )
    return task


def default_filter(name: str) -> str | None:
    """Return `default` if a task has a recommended filter, else None. It is None for a file too."""
    if is_file(name):
        return None
    return "default" if "default" in find_task(name).filters else None


def is_file(name: str) -> bool:
    """Return whether a name is that of a YAML file, and not of a task."""
    return name.endswith((".yaml", ".yml"))


def short_name(name: str) -> str:
    """Return the name of a task without its module, or that of a file without folder and ending."""
    return Path(name.rpartition(":")[2]).stem


def user_module(name: str) -> str | None:
    """Return the module of a user's task. It is None for a task of this package and for a file."""
    task = registered(name)
    if task is None or task.environment.__module__.partition(".")[0] == "jaxsafe":
        return None
    return task.environment.__module__


def _register_id(gymnasium_id: str, task: str) -> None:
    """Register a task with Gymnasium, which imports the adapter when an environment is made.

    No `max_episode_steps` is given. Tasks end by themselves, and a second clock would truncate what
    they terminate.
    """
    existing = registration.registry.get(gymnasium_id)
    if existing is not None and existing.kwargs.get("task") != task:
        raise ConfigError(f"task {task!r}: Gymnasium has another environment called {gymnasium_id}")
    if existing is None:
        registration.register(
            gymnasium_id,
            entry_point="jaxsafe.adapters.gymnasium:GymEnv",
            vector_entry_point="jaxsafe.adapters.gymnasium:GymVectorEnv",
            kwargs={"task": task},
        )
