"""Adapters that offer the tasks to other libraries.

Each adapter is one file over `reset` and `step`. Nothing in the core knows of it.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxsafe.config import override
from jaxsafe.environment import Environment
from jaxsafe.envs import make
from jaxsafe.schema.errors import ConfigError, choices_text, show

FORKED = (
    "forked processes would wait for ever for JAX's threads; start workers with context='spawn'"
    " (make_vec: vector_kwargs={'context': 'spawn'})"
)
"""What is wrong with forked workers, and what works instead."""

_process: int | None = None
"""Id of the process that has made or stepped environments.

A process that is forked from it lacks its JAX threads.
"""


def refuse_fork() -> None:
    """Raise in a process that was forked from one that has used JAX here.

    Raises:
        ConfigError: this is such a process. Any computation would wait for ever in it.
    """
    global _process
    if _process not in (None, os.getpid()):
        raise ConfigError(f"process {os.getpid()}: {FORKED}")
    _process = os.getpid()


def environment(
    task: str | os.PathLike | Environment,
    overrides: Mapping[str, Any] | None,
    options: Mapping[str, Any],
) -> Environment:
    """Return the environment that the arguments of an adapter describe.

    Args:
        task: the name of a task, a YAML file, or an environment that is made already.
        overrides: as `jaxsafe.make` takes them.
        options: the other arguments of `jaxsafe.make`, by name. An environment that is made already
            takes none.

    Raises:
        ConfigError: an option is unknown, or is given for an environment that is made already, or
            this process was forked from one that has used JAX. Also raised as by `jaxsafe.make`.
    """
    refuse_fork()
    choices = list(inspect.signature(make).parameters)[1:]
    for option in options:
        if option not in choices:
            raise ConfigError(f"{option}: unknown option{choices_text(option, choices)}")
    if not isinstance(task, Environment):
        return make(task, overrides, **options)
    if options:
        raise ConfigError(
            f"{next(iter(options))}: the environment is made already;"
            " give it to jaxsafe.make instead"
        )
    return override(task, overrides) if overrides else task


MAX_COUNT = 2**31 - 1
"""The largest number of environments or of steps. The programs count in 32 bits."""


def checked_count(name: str, count: Any) -> int:
    """Return a number of environments or of steps as an `int`.

    Args:
        name: the name of the argument, for the error message.
        count: the number that was given.

    Raises:
        ConfigError: `count` is not a whole number from 1 to `MAX_COUNT`.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ConfigError(f"{name}: expected a whole number ≥ 1, found {show(count)}")
    if count > MAX_COUNT:
        raise ConfigError(
            f"{name}: expected a whole number from 1 to {MAX_COUNT:,}, found {show(count)}"
        )
    return int(count)


def observation_bounds(env: Environment) -> tuple[list[float], list[float]]:
    """Return the lowest and the highest value of each element of an observation.

    Elements that are not clipped have infinite bounds.
    """
    bounds = []
    for item in env.observation:
        size = sum(
            name == item.name or name.startswith(f"{item.name}.") for name in env.observation_names
        )
        bounds += size * [
            (-math.inf, math.inf)
            if item.clip is None
            else (float(item.clip[0]), float(item.clip[1]))
        ]
    return [low for low, _ in bounds], [high for _, high in bounds]


def elements(env: Environment, action: Mapping[str, Any]) -> list[Any]:
    """Return the elements of a mixed action in the order of the actuators.

    Args:
        env: the environment.
        action: the element of each actuator by its name.

    Raises:
        ConfigError: these are not the actuators of the environment.
    """
    if set(action) != set(env.action_names):
        names = ", ".join(env.action_names)
        raise ConfigError(f"action: expected {names}, found {', '.join(map(str, action))}")
    return [action[name] for name in env.action_names]
