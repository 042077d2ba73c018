"""Conversion of environments and time steps to Gymnasium's spaces and infos."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import jax.numpy as jnp
import numpy as np

from jaxsafe.adapters import observation_bounds
from jaxsafe.environment import Environment, action_bounds
from jaxsafe.types import TimeStep

Space = gym.spaces.Box | gym.spaces.MultiDiscrete | gym.spaces.Dict

_FACTS = (
    "margins",
    "severity",
    "reward_terms",
    "reward_totals",
    "status",
    "control_desired",
    "control_actual",
    "intervening",
)
"""Fields of `Info` that become entries of Gymnasium's `info` as they are."""


def spaces(env: Environment) -> tuple[gym.spaces.Box, Space]:
    """Return the space of observations and the space of actions.

    Discrete actions have a `MultiDiscrete` space, continuous ones a `Box`. Mixed actions have a
    `Dict`, which holds a `Discrete` or a `Box` of shape () by the name of each actuator.
    """
    dtype = jnp.result_type(float)
    low, high = observation_bounds(env)
    observation = gym.spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
    if env.action_kind == "discrete":
        return observation, gym.spaces.MultiDiscrete(list(env.num_action_points))
    low, high = action_bounds(env)
    if env.action_kind == "mixed":
        parts: dict[str, gym.Space] = {}
        for index, name in enumerate(env.action_names):
            count = env.num_action_points[index]
            ends = np.array([low[index], high[index]], np.float32)
            parts[name] = gym.spaces.Discrete(count) if count else gym.spaces.Box(*ends, shape=())
        return observation, gym.spaces.Dict(parts)
    return observation, gym.spaces.Box(
        np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32
    )


def facts(env: Environment, timestep: TimeStep) -> dict[str, Any]:
    """Return the entries of `info`.

    Args:
        env: the environment.
        timestep: one time step or a batch of them, as NumPy arrays.
    """
    info = timestep.info
    outcomes = np.array(env.outcomes, object)
    entries = {
        "cost": timestep.cost,
        "costs": timestep.costs,
        "outcome": outcomes[info.outcome],
        "is_success": env.succeeded(info.outcome),
        **{name: getattr(info, name) for name in _FACTS},
    }
    return entries if info.rta is None else {**entries, "rta": vars(info.rta)}


def masked(entries: Mapping[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Return a batch of infos in Gymnasium's form.

    In that form each entry has a mask beside it, named after it with `_` in front. The mask says
    which environments of the batch have the entry.

    Args:
        entries: the entries, each [num_envs, …] or a mapping of such entries.
        mask: which environments have them, [num_envs].
    """
    # All entries share one copy, so nobody may write to it.
    mask = mask.copy()
    mask.setflags(write=False)
    batch = {}
    for name, value in entries.items():
        batch[name] = masked(value, mask) if isinstance(value, Mapping) else np.asarray(value)
        batch[f"_{name}"] = mask
    return batch


def of_environment(infos: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Return the info of one environment of a batch, in the form that a single environment has.

    Args:
        infos: the infos of the batch, in Gymnasium's form.
        index: the index of the environment in the batch.
    """
    info = {}
    for name, value in infos.items():
        if name.startswith("_") and name[1:] in infos:
            continue
        entry = of_environment(value, index) if isinstance(value, Mapping) else value[index]
        info[name] = entry.item() if isinstance(entry, np.generic) else entry
    return info
