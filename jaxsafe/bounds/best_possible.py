"""What is possible at best from each start of a task."""

from __future__ import annotations

import numpy as np

from jaxsafe.bounds.docking import docking_bounds
from jaxsafe.bounds.rejoin import rejoin_bounds
from jaxsafe.environment import Environment, require_environment
from jaxsafe.schema.errors import ConfigError
from jaxsafe.types import State


def best_possible(env: Environment, starts: State) -> dict[str, np.ndarray]:
    """Return bounds that hold for every policy, with or without a filter.

    Numbers of the tasks may be changed, and the bounds follow. Parts of other kinds have no bounds.

    Args:
        env: the environment.
        starts: the states after `reset`. Every array is [starts, …].

    Returns:
        Arrays [starts] by name. `length` is the least number of steps of a success without a
        violation. `return` is the largest return. `delta_v` is the least Δv of a success [m/s],
        where the task has one.

    Raises:
        ConfigError: the environment has parts for which no bounds are known.
    """
    require_environment("best_possible: env", env)
    if env.uncertainty or env.randomize or env.decision_period > 1:
        raise ConfigError(
            "bounds: not known for an environment with uncertainty, randomize or decision_period"
        )
    for bounds_of in (docking_bounds, rejoin_bounds):
        bounds = bounds_of(env, starts)
        if bounds is not None:
            return bounds
    raise ConfigError("bounds: known for the parts of docking and of rejoin alone")
