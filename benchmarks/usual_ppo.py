"""PPO as it is mostly written in JAX, all under `vmap`.

It calls the networks, takes gradients and draws permutations one after another. It has the parts
that PureJaxRL made common, written anew as a peer for `ppo.py`:

- a key for every environment at every step,
- a start drawn whether it is needed or not,
- the batch sorted into a random order and gathered whole in each epoch,
- the gradient of a whole minibatch at once,
- one `done` for termination and truncation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

import jaxsafe
from jaxsafe.rollout import step_or_reset

GAMMA = 0.99
LAMBDA = 0.95
CLIP = 0.2
VALUE_COEFFICIENT = 0.5
LEARNING_RATE = 3e-4
MAX_GRAD_NORM = 0.5


class Sample(NamedTuple):
    """One step of every environment."""

    observation: Array
    action: Array
    log_prob: Array
    value: Array
    reward: Array
    done: Array


def init(env: jaxsafe.Environment, hidden: Sequence[int], num_envs: int, key: Array) -> Any:
    """Return the first carry of `update`.

    It is the networks, the optimiser, the states of the environments, their observations and a key.
    """
    key, key_actor, key_critic, key_reset = jax.random.split(key, 4)
    params = {
        "actor": _layers(key_actor, [env.observation_size, *hidden, env.action_size], 0.01),
        "critic": _layers(key_critic, [env.observation_size, *hidden, 1], 1.0),
        "log_std": jnp.zeros(env.action_size),
    }
    state, timestep = jax.vmap(jaxsafe.reset, in_axes=(None, 0))(
        env, jax.random.split(key_reset, num_envs)
    )
    return params, _OPTIMIZER.init(params), state, timestep.observation, key


def update(
    env: jaxsafe.Environment, num_steps: int, num_epochs: int, num_minibatches: int, carry: Any
) -> Any:
    """Collect one batch and learn from it. Return the next carry."""
    params, optimizer, state, observation, key = carry

    def step(carry: Any, _: None) -> tuple[Any, Sample]:
        state, observation, key = carry
        key, key_act, key_step = jax.random.split(key, 3)
        mean = _network(params["actor"], observation)
        value = _network(params["critic"], observation)[:, 0]
        action = mean + jnp.exp(params["log_std"]) * jax.random.normal(key_act, mean.shape)
        keys = jax.random.split(key_step, len(observation))
        (state, following), timestep = jax.vmap(step_or_reset, in_axes=(None, 0, 0, 0))(
            env, state, action, keys
        )
        sample = Sample(
            observation,
            action,
            _log_prob(params, mean, action),
            value,
            timestep.reward,
            timestep.done,
        )
        return (state, following, key), sample

    (state, observation, key), samples = jax.lax.scan(
        step, (state, observation, key), None, num_steps
    )
    last = _network(params["critic"], observation)[:, 0]

    def backward(carry: tuple[Array, Array], sample: Sample) -> tuple[tuple[Array, Array], Array]:
        advantage, following = carry
        delta = sample.reward + GAMMA * following * (1 - sample.done) - sample.value
        advantage = delta + GAMMA * LAMBDA * (1 - sample.done) * advantage
        return (advantage, sample.value), advantage

    _, advantages = jax.lax.scan(backward, (jnp.zeros_like(last), last), samples, reverse=True)
    batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (samples, advantages))

    def minibatch(carry: Any, part: tuple[Sample, Array]) -> tuple[Any, None]:
        params, optimizer = carry
        step, optimizer = _OPTIMIZER.update(jax.grad(_loss)(params, *part), optimizer)
        return (optax.apply_updates(params, step), optimizer), None

    def epoch(carry: Any, key: Array) -> tuple[Any, None]:
        order = jax.random.permutation(key, batch[1].size)
        split = lambda x: x[order].reshape(num_minibatches, -1, *x.shape[1:])  # noqa: E731
        return jax.lax.scan(minibatch, carry, jax.tree.map(split, batch))

    key, key_learn = jax.random.split(key)
    keys = jax.random.split(key_learn, num_epochs)
    (params, optimizer), _ = jax.lax.scan(epoch, (params, optimizer), keys)
    return params, optimizer, state, observation, key


def _loss(params: Any, sample: Sample, advantage: Array) -> Array:
    mean = _network(params["actor"], sample.observation)
    ratio = jnp.exp(_log_prob(params, mean, sample.action) - sample.log_prob)
    normal = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    surrogate = jnp.minimum(ratio * normal, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * normal)
    value = _network(params["critic"], sample.observation)[:, 0]
    clipped = sample.value + jnp.clip(value - sample.value, -CLIP, CLIP)
    target = sample.value + advantage
    error = 0.5 * jnp.maximum((value - target) ** 2, (clipped - target) ** 2)
    return jnp.mean(VALUE_COEFFICIENT * error - surrogate)


def _network(layers: Sequence[tuple[Array, Array]], x: Array) -> Array:
    for i, (kernel, bias) in enumerate(layers):
        x = x @ kernel + bias
        x = jnp.tanh(x) if i < len(layers) - 1 else x
    return x


def _layers(key: Array, sizes: Sequence[int], last: float) -> list[tuple[Array, Array]]:
    scales = [2**0.5] * (len(sizes) - 2) + [last]
    keys = jax.random.split(key, len(scales))
    return [
        (jax.nn.initializers.orthogonal(scale)(key, (low, high)), jnp.zeros(high))
        for key, scale, low, high in zip(keys, scales, sizes[:-1], sizes[1:], strict=True)
    ]


def _log_prob(params: Any, mean: Array, action: Array) -> Array:
    z = (action - mean) * jnp.exp(-params["log_std"])
    return jnp.sum(-0.5 * z * z - params["log_std"] - 0.5 * jnp.log(2 * jnp.pi), axis=-1)


_OPTIMIZER = optax.chain(
    optax.clip_by_global_norm(MAX_GRAD_NORM), optax.adam(LEARNING_RATE, eps=1e-5)
)
