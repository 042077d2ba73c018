"""Whole episodes of a policy: sums for the metrics, or every step for logs and figures."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxsafe.environment import Environment, step
from jaxsafe.evaluate.cases import Cases, reset_to_cases
from jaxsafe.metrics import Episode, accumulate, begin, full_controls
from jaxsafe.processors.terminal import Timeout
from jaxsafe.rollout import (
    Policy,
    RecurrentPolicy,
    act,
    first_memory,
    require_batch,
    reset_batch,
)
from jaxsafe.types import Key, State, TimeStep

MAX_STEPS_WITHOUT_TIMEOUT = 10_000
"""Longest episode in an environment without a timeout.

A longer episode is given up, and its outcome is then `running`.
"""

MAX_STEPS = 1_000_000
"""Longest episode in an environment with a timeout.

A longer episode is given up. A timeout may be so late that it never ends an episode.
"""

Carry = tuple[Array, State, Array, Any, Episode]
"""Number of steps so far, states, observations, memory of the policy, sums over the episodes."""


def run_episodes(
    env: Environment,
    policy: Policy | RecurrentPolicy,
    key: Key,
    num_episodes: int,
    cases: Cases | None = None,
) -> Episode:
    """Run one episode in each of `num_episodes` environments.

    They run until all episodes have ended or `max_steps` is reached. Starts depend on the key only,
    so that policies are compared from the same starts. Or they are `cases`, one for each episode.

    Returns:
        Sums over each episode. Every field has the shape [num_episodes].
    """
    key_start, key_act = jax.random.split(key)
    state, timestep = starts_of(env, key_start, num_episodes, cases)
    constraints = [constraint.name for constraint in env.constraints]
    episode = begin(timestep, cost_names=constraints, measure=env.measure)
    full = full_controls(env)
    limit = max_steps(env)

    def going(carry: Carry) -> Array:
        num_steps, *_, episode = carry
        return (num_steps < limit) & jnp.any(episode.outcome == 0)

    def advance(carry: Carry) -> Carry:
        t, state, observation, memory, episode = carry
        action, memory = act(policy, jax.random.fold_in(key_act, t), observation, memory)
        require_batch(env, action, observation.shape[0])
        state, timestep = jax.vmap(step, in_axes=(None, 0, 0))(env, state, action)
        running = episode.outcome == 0
        later = accumulate(episode, timestep, full)
        episode = jax.tree.map(lambda new, old: jnp.where(running, new, old), later, episode)
        return t + 1, state, timestep.observation, memory, episode

    memory = first_memory(policy, num_episodes)
    start = (jnp.zeros((), jnp.int32), state, timestep.observation, memory, episode)
    return jax.lax.while_loop(going, advance, start)[-1]


class Position(NamedTuple):
    """Position in a recording of several episodes, at which its next steps begin."""

    num_steps: Int[Array, ""]
    state: State
    observation: Array
    memory: Any
    """What the policy remembers."""


def begin_recording(
    env: Environment,
    policy: Policy | RecurrentPolicy,
    key: Key,
    num_episodes: int,
    cases: Cases | None = None,
) -> tuple[Position, tuple[State, TimeStep]]:
    """Start the episodes that `run_episodes` runs with the same key and the same cases.

    Returns:
        The position after the starts, and the states and time steps of the starts [num_episodes].
    """
    key_start, _ = jax.random.split(key)
    state, timestep = starts_of(env, key_start, num_episodes, cases)
    position = Position(
        num_steps=jnp.zeros((), jnp.int32),
        state=state,
        observation=timestep.observation,
        memory=first_memory(policy, num_episodes),
    )
    return position, (state, timestep)


def starts_of(
    env: Environment, key: Key, num_episodes: int, cases: Cases | None
) -> tuple[State, TimeStep]:
    """Return random starts, or those of the cases.

    Args:
        env: the environment.
        key: the first part of the key of `run_episodes`.
        num_episodes: the number of starts.
        cases: the cases, or None.
    """
    if cases is None:
        return reset_batch(env, key, num_episodes)
    return reset_to_cases(env, cases, key)


def record_steps(
    env: Environment,
    policy: Policy | RecurrentPolicy,
    key: Key,
    position: Position,
    num_steps: int,
) -> tuple[Position, tuple[State, TimeStep]]:
    """Go on with the episodes that `begin_recording` began with this key.

    Args:
        env: the environment.
        policy: the policy.
        key: the key with which `begin_recording` was called.
        position: the position after the last step so far.
        num_steps: the number of steps to run.

    Returns:
        The position after these steps, and the states and time steps [num_steps, num_episodes].
        Steps after the end of an episode mean nothing.
    """
    _, key_act = jax.random.split(key)

    def advance(carry: tuple[State, Array, Any], t: Array) -> tuple[Any, tuple[State, TimeStep]]:
        state, observation, memory = carry
        action, memory = act(policy, jax.random.fold_in(key_act, t), observation, memory)
        require_batch(env, action, observation.shape[0])
        state, timestep = jax.vmap(step, in_axes=(None, 0, 0))(env, state, action)
        return (state, timestep.observation, memory), (state, timestep)

    times = position.num_steps + jnp.arange(num_steps, dtype=jnp.int32)
    start = (position.state, position.observation, position.memory)
    (state, observation, memory), recorded = jax.lax.scan(advance, start, times)
    position = Position(
        num_steps=position.num_steps + num_steps,
        state=state,
        observation=observation,
        memory=memory,
    )
    return position, recorded


def max_steps(env: Environment) -> int:
    """Return the number of steps after which an episode that has not ended is given up.

    It does not depend on the limit of a timeout, which ends episodes itself and may have any value.
    """
    has_timeout = any(isinstance(condition, Timeout) for condition in env.terminal)
    return MAX_STEPS if has_timeout else MAX_STEPS_WITHOUT_TIMEOUT
