"""The metrics of a policy, as a function."""

from __future__ import annotations

import jax

from jaxsafe.environment import Environment
from jaxsafe.evaluate.episodes import run_episodes
from jaxsafe.metrics import measures, summarise
from jaxsafe.rollout import Policy, RecurrentPolicy
from jaxsafe.types import Key


def evaluate(
    env: Environment, policy: Policy | RecurrentPolicy, key: Key, num_episodes: int = 1000
) -> dict[str, float | None]:
    """Return the metrics of Section 5 over whole episodes of a policy.

    Args:
        env: the environment.
        policy: `policy(key, observation)` returns an action for each of a batch of observations,
            as what `jaxsafe.load_policy` returns does. It may be a `RecurrentPolicy`.
        key: a typed PRNG key. It decides starts and noise.
        num_episodes: how many episodes run side by side.

    Returns:
        By name: rates as fractions in [0, 1], lengths in steps, Δv in the unit of the task. None
        where the environment does not measure a quantity or it is not finite.
    """
    episodes = jax.jit(run_episodes, static_argnums=(1, 3))(env, policy, key, num_episodes)
    return summarise(jax.device_get(episodes), env.success, **measures(env))
