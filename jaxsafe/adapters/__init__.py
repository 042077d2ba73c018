"""The tasks in other libraries: each adapter is one file over `reset` and `step`, and nothing in the core knows of it."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Mapping
from typing import Any

from jaxsafe.config import override
from jaxsafe.environment import Environment
from jaxsafe.envs import make
from jaxsafe.errors import ConfigError, nearest


def environment(
    task: str | os.PathLike | Environment, overrides: Mapping[str, Any] | None, options: Mapping[str, Any]
) -> Environment:
    """What `jaxsafe.make` makes of the arguments of an adapter, or the environment that it was given.

    Raises:
        ConfigError: as `jaxsafe.make`.
    """
    known = list(inspect.signature(make).parameters)[1:]
    for option in options:
        if option not in known:
            raise ConfigError(f"{option}: unknown option; choose from {nearest(option, known)}")
    if not isinstance(task, Environment):
        return make(task, overrides, **options)
    if options:
        raise ConfigError(f"{next(iter(options))}: the environment is made already; give it to jaxsafe.make instead")
    return override(task, overrides) if overrides else task


def observation_bounds(env: Environment) -> tuple[list[float], list[float]]:
    """The least and the greatest value of each element of an observation: infinite where it is not clipped."""
    bounds = []
    for item in env.observation:
        size = sum(name == item.name or name.startswith(f"{item.name}.") for name in env.observation_names)
        bounds += size * [(-math.inf, math.inf) if item.clip is None else (float(item.clip[0]), float(item.clip[1]))]
    return [low for low, _ in bounds], [high for _, high in bounds]
