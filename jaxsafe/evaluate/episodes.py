"""Whole episodes of a policy: their sums for the metrics, or every step of them for logs and figures."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxsafe.environment import Environment, step
from jaxsafe.metrics import Episode, accumulate, begin
from jaxsafe.processors.terminal import Timeout
from jaxsafe.rollout import Policy, reset_batch
from jaxsafe.types import Key, State, TimeStep

LONGEST = 10_000
"""Steps after which an episode without a timeout is given up; its outcome is then `running`."""


def run_episodes(env: Environment, policy: Policy, key: Key, num_episodes: int) -> Episode:
    """Run one episode in each of `num_episodes` environments until all have ended.

    Starts depend on the key only, so that policies are compared from the same starts.

    Returns:
        Sums over each episode, every field [num_episodes].
    """
    key_start, key_act = jax.random.split(key)
    state, timestep = reset_batch(env, key_start, num_episodes)
    episode = begin(timestep)
    limit = longest(env)

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


def record_episodes(
    env: Environment, policy: Policy, key: Key, num_episodes: int, num_steps: int
) -> tuple[State, TimeStep]:
    """Every state and time step of the episodes that `run_episodes` runs with the same key, from the start on.

    Returns:
        States and time steps, [num_steps + 1, num_episodes]; what follows the end of an episode means nothing.
    """
    key_start, key_act = jax.random.split(key)
    first = reset_batch(env, key_start, num_episodes)

    def advance(carry: tuple[State, Array], t: Array) -> tuple[tuple[State, Array], tuple[State, TimeStep]]:
        state, observation = carry
        action = policy(jax.random.fold_in(key_act, t), observation)
        state, timestep = jax.vmap(step, in_axes=(None, 0, 0))(env, state, action)
        return (state, timestep.observation), (state, timestep)

    _, rest = jax.lax.scan(advance, (first[0], first[1].observation), jnp.arange(num_steps))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)


SPARE = 2
"""One more than fit into the limit, and one for the rounding of their quotient."""


def longest(env: Environment) -> Array:
    """At least as many steps as an episode can take, from its timeouts; `LONGEST` without one."""
    drawn = {path: (jnp.min(span), jnp.max(span)) for path, span in env.randomize.items()}
    dt = drawn["dt"][0] if "dt" in drawn else env.dt
    limits = [
        drawn.get(f"terminal.{condition.name}.limit", (None, condition.limit))[1] / dt
        for condition in env.terminal if isinstance(condition, Timeout)
    ]  # fmt: skip
    return jnp.asarray(LONGEST) if not limits else jnp.floor(jnp.min(jnp.stack(limits))).astype(jnp.int32) + SPARE
