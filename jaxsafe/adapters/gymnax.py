"""The tasks as environments of gymnax.

They have `reset(key, params)` and `step(key, state, action, params)`. A step that ends an episode
also starts the next one. What a step returns depends on the version of gymnax::

    env = GymnaxEnv("docking2d")               # gymnax ≥ 1.0: six values
    env = GymnaxEnv("docking2d", legacy=True)  # gymnax 0.0.9, rejax, PureJaxRL: five, one `done`
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
    checked_count,
    elements,
    environment,
    observation_bounds,
)
from jaxsafe.environment import Environment, action_bounds, acts_within_one, reset, step
from jaxsafe.rollout import cut_short, restarted
from jaxsafe.schema.errors import missing
from jaxsafe.types import Key, Record, State

try:
    from gymnax.environments import spaces
except ImportError as error:
    raise missing(error, "gymnax", "gymnax") from None


class GymnaxParams(Record):
    """The parameters of an environment, as gymnax calls them.

    They are the environment itself, a pytree of all its numbers, and a limit of steps.
    """

    env: Environment
    max_steps_in_episode: int = 10_000
    """Number of steps after which an episode is truncated. None of the five tasks lasts so long."""

    def __post_init__(self) -> None:
        """Refuse a limit that no program can count to.

        Limits that are traced, and the axes that stand for them in `in_axes`, are left alone.
        """
        if isinstance(self.max_steps_in_episode, int) and self.max_steps_in_episode > MAX_COUNT:
            checked_count("max_steps_in_episode", self.max_steps_in_episode)


class GymnaxEnv:
    """One task as an environment of gymnax.

    Its methods work under `jax.vmap` over keys and states, and over parameters.

    `info` holds `cost`, `costs` (by constraint), `is_success`, `terminated`, `truncated` and
    `final_observation`. The final observation is the one that the step led to, before any reset.

    A discrete action of the task is a choice for each actuator. Here it is one choice among all
    combinations of these. A mixed action is a mapping from the name of each actuator to its
    element, or the vector of the elements.
    """

    def __init__(
        self,
        task: str | os.PathLike | Environment,
        overrides: Mapping[str, Any] | None = None,
        *,
        legacy: bool = False,
        **options: Any,
    ) -> None:
        """Make the environment.

        Args:
            task: the name of a task, a YAML file, or an environment that `jaxsafe.make` returned.
            overrides: as `jaxsafe.make` takes them.
            legacy: whether `step` returns one `done` in place of `terminated` and `truncated`.
            options: `actions`, `variant`, `randomize` and `rta` of `jaxsafe.make`.

        Raises:
            ConfigError: as `jaxsafe.make`.
        """
        self.env = environment(task, overrides, options)
        self.legacy = legacy
        self.name = str(task) if isinstance(task, str | os.PathLike) else "jaxsafe"

    @property
    def default_params(self) -> GymnaxParams:
        """Return the environment as it was made, with the default limit of steps."""
        return GymnaxParams(self.env)

    def reset(self, key: Key, params: GymnaxParams | None = None) -> tuple[Array, State]:
        """Return the observation and the state of a random start."""
        return _reset(key, params or self.default_params)

    def step(
        self, key: Key, state: State, action: Array, params: GymnaxParams | None = None
    ) -> tuple:
        """Take one step, and draw a fresh start where it ends the episode.

        Returns:
            The values (observation, state, reward, terminated, truncated, info). With `legacy` they
            are (observation, state, reward, done, info).
        """
        *taken, info = _step(key, state, action, params or self.default_params)
        ends = (info["terminated"], info["truncated"])
        return *taken, *((ends[0] | ends[1],) if self.legacy else ends), info

    @property
    def num_actions(self) -> int:
        """Return the number of combinations of discrete actions.

        If actions are continuous or mixed, return the number of elements of an action.
        """
        return (
            math.prod(self.env.num_action_points)
            if self.env.action_kind == "discrete"
            else self.env.action_size
        )

    def action_space(self, params: GymnaxParams | None = None) -> Any:
        """Return the space of actions.

        It is a `Discrete` over all combinations of discrete actions, and a `Box` of continuous
        ones. The box is [−1, 1] for actuators that rescale, and without bounds for those that take
        the tanh of an action. For the others it has the limits that they have in `params`. Mixed
        actions have a `Dict`, which holds a `Discrete` or a `Box` by the name of each actuator.
        """
        kind = self.env.action_kind
        if kind == "discrete":
            return spaces.Discrete(self.num_actions)
        if kind == "continuous" and acts_within_one(self.env):
            return spaces.Box(-1.0, 1.0, (self.env.action_size,), dtype=jnp.float32)
        low, high = action_bounds((params or self.default_params).env)
        if kind == "mixed":
            parts = zip(self.env.action_names, self.env.num_action_points, low, high, strict=True)
            return spaces.Dict(
                {
                    name: spaces.Discrete(count) if count else spaces.Box(least, most, ())
                    for name, count, least, most in parts
                }
            )
        arrays = [
            jnp.stack(jnp.broadcast_arrays(*bounds), axis=-1).astype(jnp.float32)
            for bounds in (low, high)
        ]
        return spaces.Box(*arrays, (self.env.action_size,), dtype=jnp.float32)

    def observation_space(self, params: GymnaxParams | None = None) -> Any:
        """Return a `Box`. Elements of an observation that are not clipped have no bounds."""
        low, high = observation_bounds(self.env)
        return spaces.Box(
            jnp.array(low), jnp.array(high), (len(low),), dtype=jnp.result_type(float)
        )


@jax.jit
def _reset(key: Key, params: GymnaxParams) -> tuple[Array, State]:
    """Return the observation and the state of a random start.

    This function and `_step` are compiled once for all environments that have the same structure.
    """
    state, timestep = reset(params.env, key)
    return timestep.observation, state


@jax.jit
def _step(
    key: Key, state: State, action: Any, params: GymnaxParams
) -> tuple[Array, State, Array, dict[str, Array]]:
    points = params.env.num_action_points
    chosen = action
    if params.env.action_kind == "discrete":
        chosen = jnp.stack(jnp.unravel_index(action, points)).astype(jnp.int32)
    elif isinstance(action, Mapping):
        number = jnp.result_type(float)
        parts = elements(params.env, action)
        chosen = jnp.stack([jnp.asarray(element, number) for element in parts], axis=-1)
    state, timestep = step(params.env, state, chosen)
    timestep = cut_short(params.env, state, timestep, params.max_steps_in_episode)
    following, observation = restarted(params.env, state, timestep, key)
    info = {
        "cost": timestep.cost,
        "costs": timestep.costs,
        "is_success": params.env.succeeded(timestep.info.outcome),
        "terminated": timestep.terminated,
        "truncated": timestep.truncated,
        "final_observation": timestep.observation,
    }
    return observation, following, timestep.reward, info
