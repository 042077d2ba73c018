"""Steps that a policy takes, episode after episode, as arrays."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsafe.environment import Environment, action_bounds
from jaxsafe.processors.terminal import time_limit
from jaxsafe.rollout import Policy, RecurrentPolicy, rollout
from jaxsafe.types import Key

NUM_ENVS = 16
"""Number of environments side by side. Each contributes episodes one after another."""

EPISODES_PER_ENV = 4
"""Number of the longest episodes for which each environment has time, if there is one."""

CHUNK = 512
"""Number of steps of each environment between two copies from the device."""


class Dataset(NamedTuple):
    """Steps in order: those of an episode follow each other, and so do episodes.

    The last step of an episode that was cut because there were enough steps is truncated.
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
        ends = np.flatnonzero(self.done) + 1
        return [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]


def collect(
    env: Environment, policy: Policy | RecurrentPolicy, key: Key, num_steps: int
) -> Dataset:
    """Return steps that a policy takes from random starts.

    Args:
        env: the environment.
        policy: `policy(key, observation)` returns an action for each of a batch of observations. It
            may be a `RecurrentPolicy`.
        key: a typed PRNG key.
        num_steps: number of steps.
    """
    return collect_from_each(env, lambda _: policy, [()], key, num_steps)


def collect_from_each(
    env: Environment,
    policy_of: Callable[[Any], Policy | RecurrentPolicy],
    parameters: Sequence[Any],
    key: Key,
    num_steps: int,
) -> Dataset:
    """Return steps that several policies take, as many of each, one after another.

    Args:
        env: the environment.
        policy_of: returns the policy that some parameters stand for. Its program is compiled once.
        parameters: the parameters of each policy, which are trees of arrays of the same shapes.
        key: a typed PRNG key.
        num_steps: number of steps of all policies together.
    """
    count = -(-num_steps // len(parameters))
    num_envs = _num_envs(env, count)
    run = jax.jit(functools.partial(_chunk, policy_of=policy_of, num_envs=num_envs))
    parts = []
    for number, own in enumerate(parameters):
        advance = functools.partial(run, env, own)
        parts.append(_steps(advance, jax.random.fold_in(key, number), count, num_envs))
    whole = Dataset(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
    return _first(whole, num_steps)


def _num_envs(env: Environment, num_steps: int) -> int:
    """Return how many environments run side by side, so that each has time for some episodes."""
    longest = time_limit(env)
    episode = 1000.0 if longest is None else float(longest) / float(env.dt)
    return int(np.clip(num_steps / (EPISODES_PER_ENV * episode), 1, NUM_ENVS))


def _steps(advance: Callable[..., Any], key: Key, num_steps: int, num_envs: int) -> Dataset:
    """Return the steps of one policy, environment after environment."""
    per_env = -(-num_steps // num_envs)
    parts = []
    start = None
    for number in range(-(-per_env // CHUNK)):
        start, part = advance(jax.random.fold_in(key, number), start)
        parts.append(jax.device_get(part))
    steps = _first(Dataset(**{name: _column(parts, name) for name in Dataset._fields}), per_env)
    flat = Dataset(*(np.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]) for x in steps))
    return _first(flat, num_steps)


def _first(steps: Dataset, count: int) -> Dataset:
    """Return the first steps. The last one is truncated if the episode does not end there."""
    cut = Dataset(*(array[:count] for array in steps))
    cut.truncated[-1] |= ~cut.terminated[-1]
    return cut


def _column(parts: Sequence[dict[str, np.ndarray]], name: str) -> np.ndarray:
    """Return a field of all steps. The arrays are copies, which may be written to."""
    return np.concatenate([part[name] for part in parts])


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
