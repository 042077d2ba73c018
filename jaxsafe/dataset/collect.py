"""Steps that a policy takes, episode after episode, as arrays."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsafe.environment import Environment, action_bounds
from jaxsafe.evaluate.episodes import max_steps
from jaxsafe.rollout import Policy, RecurrentPolicy, require_count, rollout
from jaxsafe.types import Key

EPISODES_PER_BATCH = 100
"""Largest number of episodes that run side by side."""

CHUNK = 512
"""Number of steps of each episode between two copies from the device."""


class Dataset(NamedTuple):
    """Whole episodes, one after another, as arrays of their n steps.

    Where no timeout ends episodes, one that goes on for 10,000 steps is given up. Its last step is
    truncated.
    """

    observation: Float[np.ndarray, "n o"]
    """What the policy acted on."""
    action: np.ndarray
    """What the policy returned, within the bounds of the actuators, of shape (n, m)."""
    reward: Float[np.ndarray, " n"]
    next_observation: Float[np.ndarray, "n o"]
    """Where the step led, also at the end of an episode."""
    terminated: Bool[np.ndarray, " n"]
    truncated: Bool[np.ndarray, " n"]
    costs: Float[np.ndarray, "n c"]
    """The cost of the step for each safety constraint, in the order of `env.constraints`.

    It is 1 where the step violates it, else 0, or the severity if the environment says so.
    """
    control: Float[np.ndarray, "n m"]
    """The control that acted, after run time assurance, in physical units."""
    success: Bool[np.ndarray, " n"]
    """Whether the step ended its episode with a success."""

    @property
    def done(self) -> Bool[np.ndarray, " n"]:
        """Whether a step is the last of its episode."""
        return self.terminated | self.truncated

    def episodes(self) -> list[slice]:
        """Return the steps of each episode."""
        ends = (np.flatnonzero(self.done) + 1).tolist()
        return [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]


def collect(
    env: Environment, policy: Policy | RecurrentPolicy, key: Key, num_episodes: int
) -> Dataset:
    """Return whole episodes of a policy from random starts.

    Args:
        env: the environment.
        policy: `policy(key, observation)` returns an action for each of a batch of observations. It
            may be a `RecurrentPolicy`.
        key: a typed PRNG key.
        num_episodes: number of episodes.

    Raises:
        ConfigError: `num_episodes` is not a whole number, or is too small.
    """
    return collect_from_each(env, lambda _: policy, [()], key, num_episodes)


def collect_from_each(
    env: Environment,
    policy_of: Callable[[Any], Policy | RecurrentPolicy],
    parameters: Sequence[Any],
    key: Key,
    num_episodes: int,
) -> Dataset:
    """Return whole episodes of several policies, as many of each, one policy after another.

    The number of episodes is fixed before they run. Whatever keeps a number of steps instead has
    short episodes more often than long ones.

    Args:
        env: the environment.
        policy_of: returns the policy that some parameters stand for. Its program is compiled once.
        parameters: the parameters of each policy, which are trees of arrays of the same shapes.
        key: a typed PRNG key.
        num_episodes: number of episodes of each policy.

    Raises:
        ConfigError: `num_episodes` is not a whole number, or is too small.
    """
    require_count("num_episodes", num_episodes, least=1)
    num_envs = min(num_episodes, EPISODES_PER_BATCH)
    run = jax.jit(functools.partial(_chunk, policy_of=policy_of, num_envs=num_envs))
    episodes = []
    for number, own in enumerate(parameters):
        advance = functools.partial(run, env, own)
        key_policy = jax.random.fold_in(key, number)
        for first in range(0, num_episodes, num_envs):
            count = min(num_envs, num_episodes - first)
            key_batch = jax.random.fold_in(key_policy, first)
            episodes += _episodes(advance, key_batch, count, max_steps(env))
    return Dataset(*(np.concatenate(arrays) for arrays in zip(*episodes, strict=True)))


def _episodes(advance: Callable[..., Any], key: Key, count: int, limit: int) -> Iterator[Dataset]:
    """Yield the first episode of each of the first `count` environments of a batch.

    Args:
        advance: `_chunk` of a policy, as a function of the key and of where the batch has got to.
        key: a typed PRNG key of the batch.
        count: number of episodes.
        limit: number of steps after which an episode is given up.
    """
    pieces: list[list[Dataset]] = [[] for _ in range(count)]
    running = [*range(count)]
    start = None
    for before in range(0, limit, CHUNK):
        start, steps = advance(jax.random.fold_in(key, before), start)
        part = Dataset(**jax.device_get(steps))
        ends = {env: np.flatnonzero(part.done[:, env]) for env in running}
        for env in running:
            length = ends[env][0] + 1 if ends[env].size else min(CHUNK, limit - before)
            # Copies, or the steps after the end of the episode would stay in memory.
            pieces[env].append(Dataset(*(array[:length, env].copy() for array in part)))
        running = [env for env in running if not ends[env].size]
        if not running:
            break
    for of_episode in pieces:
        whole = Dataset(*(np.concatenate(arrays) for arrays in zip(*of_episode, strict=True)))
        whole.truncated[-1] |= ~whole.terminated[-1]
        yield whole


def _chunk(
    env: Environment, parameters: Any, key: Key, start: Any, policy_of: Any, num_envs: int
) -> tuple[Any, dict[str, Array]]:
    """Return where a rollout has got to, and the fields of its steps [CHUNK, num_envs, …]."""
    policy = policy_of(parameters)
    after, steps = rollout(env, policy, key, CHUNK, num_envs, record="transitions", start=start)
    low, high = action_bounds(env)
    costs = [steps.costs[constraint.name] for constraint in env.constraints]
    none = jnp.zeros((*steps.reward.shape, 0))
    action = jnp.clip(steps.action, jnp.stack(low), jnp.stack(high))
    return after, {
        "observation": steps.observation,
        "action": action.astype(steps.action.dtype),
        "reward": steps.reward,
        "next_observation": steps.next_observation,
        "terminated": steps.terminated,
        "truncated": steps.truncated,
        "costs": jnp.stack(costs, axis=-1) if costs else none,
        "control": steps.info.control_actual,
        "success": steps.done & env.succeeded(steps.info.outcome),
    }


def random_policy(env: Environment) -> Policy:
    """Return a policy that draws actions uniformly within their bounds."""
    low, high = (jnp.stack([jnp.asarray(x) for x in ends]) for ends in action_bounds(env))

    def policy(key: Key, observation: Float[Array, "*batch o"]) -> Array:
        shape = (*observation.shape[:-1], env.action_size)
        if env.action_kind == "continuous":
            return low + (high - low) * jax.random.uniform(key, shape)
        share = jax.random.uniform(key, shape)
        chosen = jnp.floor(low + (high - low + 1.0) * share)
        if env.action_kind == "discrete":
            return jnp.minimum(chosen, high).astype(jnp.int32)
        whole = jnp.array(env.num_action_points) > 0
        return jnp.where(whole, jnp.minimum(chosen, high), low + (high - low) * share)

    return policy
