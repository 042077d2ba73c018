"""From environments and time steps to Gymnasium's spaces and infos."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import jax.numpy as jnp
import numpy as np

from jaxsafe.adapters import action_bounds, observation_bounds
from jaxsafe.environment import Environment
from jaxsafe.types import TimeStep

Space = gym.spaces.Box | gym.spaces.MultiDiscrete

_FACTS = (
    "margins", "severity", "reward_terms", "reward_totals", "status", "control_desired", "control_actual", "intervening",
)  # fmt: skip


def spaces(env: Environment) -> tuple[gym.spaces.Box, Space]:
    """Of observations and of actions."""
    dtype = jnp.result_type(float)
    low, high = observation_bounds(env)
    observation = gym.spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
    if env.num_action_points:
        return observation, gym.spaces.MultiDiscrete(list(env.num_action_points))
    low, high = action_bounds(env)
    return observation, gym.spaces.Box(
        np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32
    )


def facts(env: Environment, timestep: TimeStep) -> dict[str, Any]:
    """What `info` holds, of one step or of a batch on the host."""
    info = timestep.info
    outcomes = np.array(env.outcomes, object)
    found = {
        "cost": timestep.cost,
        "outcome": outcomes[info.outcome],
        "is_success": info.outcome == env.success,
        **{name: getattr(info, name) for name in _FACTS},
    }
    return found if info.rta is None else {**found, "rta": vars(info.rta)}


def masked(found: Mapping[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Gymnasium's form of a batch of infos: beside each entry, under `_` and its name, which lanes have it."""
    mask = mask.copy()  # one for all, since it must not change
    mask.setflags(write=False)
    batch = {}
    for name, value in found.items():
        batch[name] = masked(value, mask) if isinstance(value, Mapping) else np.asarray(value)
        batch[f"_{name}"] = mask
    return batch


def of_lane(infos: Mapping[str, Any], lane: int) -> dict[str, Any]:
    """Return the info of one lane, as a single environment has it, from Gymnasium's form of a batch."""
    found = {}
    for name, value in infos.items():
        if name.startswith("_") and name[1:] in infos:
            continue
        one = of_lane(value, lane) if isinstance(value, Mapping) else value[lane]
        found[name] = one.item() if isinstance(one, np.generic) else one
    return found
