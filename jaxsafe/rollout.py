"""Running episodes back to back: automatic reset, batches of environments, and scans over time."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxsafe.autoreset import choose, renew
from jaxsafe.devices.shard import WHOLE, Shard
from jaxsafe.environment import Environment, reset, step
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.types import Key, State, TimeStep

Policy = Callable[[Key, Array], Array]
"""`policy(key, observation) -> action`, batched where the observations are."""


def rollout(env: Environment, policy: Policy, key: Key, num_steps: int, num_envs: int | None = None) -> TimeStep:
    """Run a policy for a number of steps; every finished episode is followed by a fresh random start.

    The time step that ends an episode holds the episode's true last observation; the policy acts next on the observation
    of the new start, which is not part of the result.

    Args:
        env: the environment.
        policy: `policy(key, observation) -> action`; with `num_envs` it sees and returns a leading axis of that size.
        key: a typed PRNG key.
        num_steps: steps to take in each environment.
        num_envs: number of environments run side by side; None is one, without a batch axis.

    Returns:
        The time steps, stacked [num_steps] or [num_steps, num_envs].

    Raises:
        ConfigError: `num_steps` or `num_envs` is no number of steps or environments.
    """
    _require_count("num_steps", num_steps, least=0)
    if num_envs is not None:
        _require_count("num_envs", num_envs, least=1)
    key_start, key_run = jax.random.split(key)
    carry = reset(env, key_start) if num_envs is None else reset_batch(env, key_start, num_envs, axis=-1)

    def one_step(carry: tuple[State, Array], key: Key) -> tuple[tuple[State, Array], TimeStep]:
        state, observation = carry
        key_policy, key_reset = jax.random.split(key)
        if num_envs is None:
            return step_or_reset(env, state, policy(key_policy, observation), key_reset)
        action = policy(key_policy, observation.T).T
        return step_or_reset_batch(env, state, action, key_reset, axis=-1)

    _, timesteps = jax.lax.scan(one_step, (carry[0], carry[1].observation), jax.random.split(key_run, num_steps))
    return timesteps if num_envs is None else jax.tree.map(lambda x: jnp.moveaxis(x, -1, 1), timesteps)


def _require_count(name: str, value: Any, least: int) -> None:
    """Refuse what is no whole number, or too small; XLA would say so in many lines, or run no environment at all."""
    try:
        enough = operator.index(value) >= least
    except TypeError:
        enough = False
    if not enough:
        raise ConfigError(f"rollout: {name}: expected a whole number ≥ {least}, found {show(value)}")


def step_or_reset(env: Environment, state: State, action: Array, key: Key) -> tuple[tuple[State, Array], TimeStep]:
    """One step; where it ends the episode, the next state is a fresh start.

    Returns:
        The next state with the observation to act on, and the time step taken, with the observation it led to.
    """
    state, timestep = step(env, state, action)
    return restarted(env, state, timestep, key), timestep


def restarted(env: Environment, state: State, timestep: TimeStep, key: Key) -> tuple[State, Array]:
    """State and observation to go on from: a fresh start where the time step ended the episode."""
    fresh_state, fresh = reset(env, key)
    return choose(timestep.done, (fresh_state, fresh.observation), (state, timestep.observation))


def reset_batch(
    env: Environment, key: Key, num_envs: int, shard: Shard = WHOLE, axis: Literal[0, -1] = 0
) -> tuple[State, TimeStep]:
    """Independent random starts, [num_envs], of which a shard has its part; `axis` as in `step_or_reset_batch`."""
    size = num_envs // shard.count
    return _starts(env, key, shard.first(size) + jnp.arange(size), axis)


def _starts(env: Environment, key: Key, lanes: Int[Array, " n"], axis: int) -> tuple[State, TimeStep]:
    """The starts of some lanes, each from a key of its own."""
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, lanes)
    return jax.vmap(reset, in_axes=(None, 0), out_axes=axis)(env, keys)


def step_or_reset_batch(
    env: Environment,
    state: State,
    action: Array,
    key: Key,
    max_episode_steps: Array | float = jnp.inf,
    shard: Shard = WHOLE,
    axis: Literal[0, -1] = 0,
) -> tuple[tuple[State, Array], TimeStep]:
    """`step_or_reset` for a batch, [num_envs]; starts are drawn only where episodes end.

    An episode still running after `max_episode_steps` is truncated, without an outcome. With `axis=-1` the environments are
    the last axis of everything that goes in and comes out, [3, num_envs] for a position; a CPU steps many faster so.
    """
    state, timestep = jax.vmap(step, in_axes=(None, axis, axis), out_axes=axis)(env, state, action)
    timestep = cut_short(state, timestep, max_episode_steps)
    first = shard.first(action.shape[axis])

    def draw(parameters: tuple[Environment, Key, Array], lanes: Array) -> tuple[State, Array]:
        env, key, first = parameters
        fresh_state, fresh = _starts(env, key, first + lanes, axis)
        return fresh_state, fresh.observation

    return renew(timestep.done, draw, (env, key, first), (state, timestep.observation), axis), timestep


def cut_short(state: State, timestep: TimeStep, max_episode_steps: Array | float) -> TimeStep:
    """The time step, truncated if its episode is still running after `max_episode_steps`."""
    number = jnp.result_type(float)
    cut = ~timestep.done & (state.num_steps.astype(number) >= jnp.asarray(max_episode_steps, number))
    return timestep.replace(truncated=timestep.truncated | cut)
