"""The tasks as gymnax environments: `reset(key, params)` and `step(key, state, action, params)`, which resets by itself.

env = GymnaxEnv("docking2d")                  # gymnax ≥ 1.0: six values from a step
env = GymnaxEnv("docking2d", legacy=True)     # gymnax 0.0.9, rejax, PureJaxRL: five, with one `done`
"""
# pyright: reportMissingImports=false

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxsafe.adapters import (
    MAX_COUNT,
    action_bounds,
    acts_in_physical_units,
    checked_count,
    environment,
    observation_bounds,
)
from jaxsafe.environment import Environment, reset, step
from jaxsafe.rollout import cut_short, restarted
from jaxsafe.schema.errors import missing
from jaxsafe.types import Key, Record, State

try:
    from gymnax.environments import spaces
except ImportError as error:
    raise missing(error, "gymnax", "gymnax") from None


class GymnaxParams(Record):
    """What gymnax calls parameters: the environment, which is a pytree of all its numbers, and a limit."""

    env: Environment
    max_steps_in_episode: int = 10_000  # longer than any of the five tasks lasts

    def __post_init__(self) -> None:
        """Refuse a limit that no program can count to. Traced limits, and trees of axes such as 0, are left alone."""
        if isinstance(self.max_steps_in_episode, int) and self.max_steps_in_episode > MAX_COUNT:
            checked_count("max_steps_in_episode", self.max_steps_in_episode)


class GymnaxEnv:
    """One task; `jax.vmap` it over keys and states, and over parameters.

    `info` holds `cost`, `is_success`, `terminated`, `truncated` and `final_observation`, the one that the step led to
    before any reset. Discrete actions, one choice for each actuator, become one choice among all their combinations.
    """

    def __init__(
        self,
        task: str | os.PathLike | Environment,
        overrides: Mapping[str, Any] | None = None,
        *,
        legacy: bool = False,
        **options: Any,
    ) -> None:
        """Make the environment; `options` are `actions`, `variant`, `randomize`, `rta` of `jaxsafe.make`.

        Raises:
            ConfigError: as `jaxsafe.make`.
        """
        self.env, self.legacy = environment(task, overrides, options), legacy
        self.name = str(task) if isinstance(task, str | os.PathLike) else "jaxsafe"

    @property
    def default_params(self) -> GymnaxParams:
        """The environment as it was made."""
        return GymnaxParams(self.env)

    def reset(self, key: Key, params: GymnaxParams | None = None) -> tuple[Array, State]:
        """A random start: observation and state."""
        return _reset(key, params or self.default_params)

    def step(
        self, key: Key, state: State, action: Array, params: GymnaxParams | None = None
    ) -> tuple:
        """One step, and a fresh start where it ends the episode: (observation, state, reward, terminated, truncated, info).

        With `legacy`, (observation, state, reward, done, info).
        """
        *taken, info = _step(key, state, action, params or self.default_params)
        ends = (info["terminated"], info["truncated"])
        return *taken, *((ends[0] | ends[1],) if self.legacy else ends), info

    @property
    def num_actions(self) -> int:
        """Number of combinations of discrete actions, or of elements of a continuous one."""
        return (
            math.prod(self.env.num_action_points)
            if self.env.num_action_points
            else self.env.action_size
        )

    def action_space(self, params: GymnaxParams | None = None) -> Any:
        """Return `Box`, [−1, 1] or the limits of actuators that do not rescale, or `Discrete` over all combinations.

        The limits are those of `params`.
        """
        if self.env.num_action_points:
            return spaces.Discrete(self.num_actions)
        if not acts_in_physical_units(self.env):
            return spaces.Box(-1.0, 1.0, (self.env.action_size,), dtype=jnp.float32)
        low, high = action_bounds((params or self.default_params).env)
        arrays = [
            jnp.stack(jnp.broadcast_arrays(*bounds), axis=-1).astype(jnp.float32)
            for bounds in (low, high)
        ]
        return spaces.Box(*arrays, (self.env.action_size,), dtype=jnp.float32)

    def observation_space(self, params: GymnaxParams | None = None) -> Any:
        """`Box` with the bounds of what is clipped."""
        low, high = observation_bounds(self.env)
        return spaces.Box(
            jnp.array(low), jnp.array(high), (len(low),), dtype=jnp.result_type(float)
        )


@jax.jit
def _reset(key: Key, params: GymnaxParams) -> tuple[Array, State]:
    """Compiled once for all environments of one structure, as is `_step`."""
    state, timestep = reset(params.env, key)
    return timestep.observation, state


@jax.jit
def _step(
    key: Key, state: State, action: Array, params: GymnaxParams
) -> tuple[Array, State, Array, dict[str, Array]]:
    points = params.env.num_action_points
    chosen = jnp.stack(jnp.unravel_index(action, points)).astype(jnp.int32) if points else action
    state, timestep = step(params.env, state, chosen)
    timestep = cut_short(state, timestep, params.max_steps_in_episode)
    following, observation = restarted(params.env, state, timestep, key)
    info = {
        "cost": timestep.cost,
        "is_success": timestep.info.outcome == params.env.success,
        "terminated": timestep.terminated,
        "truncated": timestep.truncated,
        "final_observation": timestep.observation,
    }
    return observation, following, timestep.reward, info
