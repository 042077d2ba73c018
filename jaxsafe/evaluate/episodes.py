"""Whole episodes of a policy: their sums for the metrics, or every step of them for logs and figures."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxsafe.environment import Environment, step
from jaxsafe.metrics import Episode, accumulate, begin
from jaxsafe.processors.terminal import Timeout
from jaxsafe.rollout import Policy, reset_batch
from jaxsafe.types import Key, State, TimeStep

MAX_STEPS_WITHOUT_TIMEOUT = 10_000
"""In an environment without a timeout, an episode that takes longer is given up; its outcome is then `running`."""

MAX_STEPS = 1_000_000
"""An episode that takes longer is given up whatever the timeout, which may be so late that it means none."""


def run_episodes(env: Environment, policy: Policy, key: Key, num_episodes: int) -> Episode:
    """Run one episode in each of `num_episodes` environments until all have ended or are given up after `max_steps`.

    Starts depend on the key only, so that policies are compared from the same starts.

    Returns:
        Sums over each episode, every field [num_episodes].
    """
    key_start, key_act = jax.random.split(key)
    state, timestep = reset_batch(env, key_start, num_episodes)
    episode = begin(timestep)
    limit = max_steps(env)

    def going(carry: tuple[Array, State, Array, Episode]) -> Array:
        return (carry[0] < limit) & jnp.any(carry[3].outcome == 0)

    def advance(carry: tuple[Array, State, Array, Episode]) -> tuple[Array, State, Array, Episode]:
        t, state, observation, episode = carry
        action = policy(jax.random.fold_in(key_act, t), observation)
        state, timestep = jax.vmap(step, in_axes=(None, 0, 0))(env, state, action)
        running = episode.outcome == 0
        episode = jax.tree.map(lambda new, old: jnp.where(running, new, old), accumulate(episode, timestep), episode)
        return t + 1, state, timestep.observation, episode

    start = (jnp.zeros((), jnp.int32), state, timestep.observation, episode)
    return jax.lax.while_loop(going, advance, start)[3]


class Position(NamedTuple):
    """How far a recording of several episodes has come: what its next steps begin with."""

    num_steps: Int[Array, ""]
    state: State
    observation: Array


def begin_recording(env: Environment, key: Key, num_episodes: int) -> tuple[Position, tuple[State, TimeStep]]:
    """Start the episodes that `run_episodes` runs with the same key; states and time steps are [num_episodes]."""
    key_start, _ = jax.random.split(key)
    state, timestep = reset_batch(env, key_start, num_episodes)
    return Position(jnp.zeros((), jnp.int32), state, timestep.observation), (state, timestep)


def record_steps(
    env: Environment, policy: Policy, key: Key, position: Position, num_steps: int
) -> tuple[Position, tuple[State, TimeStep]]:
    """Go on with episodes that `begin_recording` began with this key.

    Returns:
        Where they are then, and the states and time steps on the way, [num_steps, num_episodes]; what follows the end of
        an episode means nothing.
    """
    _, key_act = jax.random.split(key)

    def advance(carry: tuple[State, Array], t: Array) -> tuple[tuple[State, Array], tuple[State, TimeStep]]:
        state, observation = carry
        action = policy(jax.random.fold_in(key_act, t), observation)
        state, timestep = jax.vmap(step, in_axes=(None, 0, 0))(env, state, action)
        return (state, timestep.observation), (state, timestep)

    times = position.num_steps + jnp.arange(num_steps, dtype=jnp.int32)
    (state, observation), recorded = jax.lax.scan(advance, (position.state, position.observation), times)
    return Position(position.num_steps + num_steps, state, observation), recorded


def max_steps(env: Environment) -> int:
    """Return the number of steps after which an episode that has not ended is given up.

    It does not follow from the numbers of a timeout: those end episodes themselves, and may be any.
    """
    ends = any(isinstance(condition, Timeout) for condition in env.terminal)
    return MAX_STEPS if ends else MAX_STEPS_WITHOUT_TIMEOUT
