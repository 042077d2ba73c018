"""The distributions over actions.

Continuous actions have normal distributions. Discrete actions are one choice per actuator. Mixed
actions have some elements of each kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.lax import broadcast_to_rank
from jaxtyping import Array, Float

from jaxsafe.devices.shard import WHOLE, Shard
from jaxsafe.schema.component import Component
from jaxsafe.types import Key


class Gaussian(Component):
    """Independent normal distributions, one for each actuator.

    Actions outside [−1, 1] are clipped by the actuators, not here.
    """

    mean: Float[Array, "*batch a"]
    log_std: Float[Array, " a"]

    def mode(self) -> Float[Array, "*batch a"]:
        return self.mean

    def sample(self, key: Key, shard: Shard = WHOLE) -> Float[Array, "*batch a"]:
        noise = shard.draw(jax.random.normal, key, self.mean.shape, self.mean.dtype)
        return self.mean + broadcast_to_rank(jnp.exp(self.log_std), noise.ndim) * noise

    def log_prob(self, action: Float[Array, "*batch a"]) -> Float[Array, "*batch"]:
        z = (action - self.mean) * broadcast_to_rank(jnp.exp(-self.log_std), self.mean.ndim)
        log_std = broadcast_to_rank(self.log_std, z.ndim)
        return jnp.sum(-0.5 * z * z - log_std - 0.5 * jnp.log(2.0 * jnp.pi), axis=-1)

    def entropy(self) -> Float[Array, "*batch"]:
        total = jnp.sum(self.log_std + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e), axis=-1)
        return jnp.broadcast_to(total, self.mean.shape[:-1])


class Categorical(Component):
    """One independent choice per actuator.

    The logits of an actuator's choices follow those of the actuator before it.
    """

    logits: Float[Array, "*batch points"]
    points: tuple[int, ...]
    """The number of choices of each actuator."""

    def mode(self) -> Array:
        return jnp.stack([jnp.argmax(block, axis=-1) for block in self._blocks()], axis=-1).astype(
            jnp.int32
        )

    def sample(self, key: Key, shard: Shard = WHOLE) -> Array:
        gumbel = shard.draw(jax.random.gumbel, key, self.logits.shape, self.logits.dtype)
        return Categorical(logits=self.logits + gumbel, points=self.points).mode()

    def log_prob(self, action: Array) -> Float[Array, "*batch"]:
        chosen = [
            jnp.take_along_axis(jax.nn.log_softmax(block), action[..., i : i + 1], axis=-1)[..., 0]
            for i, block in enumerate(self._blocks())
        ]
        return jnp.sum(jnp.stack(chosen), axis=0)

    def entropy(self) -> Float[Array, "*batch"]:
        logs = [jax.nn.log_softmax(block) for block in self._blocks()]
        return -jnp.sum(jnp.stack([jnp.sum(jnp.exp(log) * log, axis=-1) for log in logs]), axis=0)

    def _blocks(self) -> list[Array]:
        ends = [sum(self.points[: i + 1]) for i in range(len(self.points))]
        return jnp.split(self.logits, ends[:-1], axis=-1)


class Joint(Component):
    """Normal distributions of the continuous elements of an action, and choices of the others.

    All are independent. An action is a vector of floats in the order of the actuators, in which
    choices are indices. Log-probability and entropy are sums over both parts.
    """

    normal: Gaussian
    """The distributions of the continuous elements, in their order."""
    choices: Categorical
    """The choices, in their order."""
    points: tuple[int, ...]
    """The number of choices of each actuator, 0 for a continuous one."""

    def mode(self) -> Float[Array, "*batch a"]:
        return self._action(self.normal.mode(), self.choices.mode())

    def sample(self, key: Key, shard: Shard = WHOLE) -> Float[Array, "*batch a"]:
        key_normal, key_choices = jax.random.split(key)
        return self._action(
            self.normal.sample(key_normal, shard), self.choices.sample(key_choices, shard)
        )

    def log_prob(self, action: Float[Array, "*batch a"]) -> Float[Array, "*batch"]:
        numbers = [action[..., i] for i, count in enumerate(self.points) if not count]
        indices = [action[..., i] for i, count in enumerate(self.points) if count]
        chosen = jnp.stack(indices, axis=-1).astype(jnp.int32)
        return self.normal.log_prob(jnp.stack(numbers, axis=-1)) + self.choices.log_prob(chosen)

    def entropy(self) -> Float[Array, "*batch"]:
        return self.normal.entropy() + self.choices.entropy()

    def _action(self, numbers: Array, indices: Array) -> Float[Array, "*batch a"]:
        """Return the elements of both parts in the order of the actuators."""
        parts = {False: numbers, True: indices.astype(numbers.dtype)}
        taken = {False: 0, True: 0}
        columns = []
        for is_choice in (count > 0 for count in self.points):
            columns.append(parts[is_choice][..., taken[is_choice]])
            taken[is_choice] += 1
        return jnp.stack(columns, axis=-1)


def split_outputs(
    outputs: Float[Array, "*batch o"], points: Sequence[int]
) -> tuple[Float[Array, "*batch n"], Float[Array, "*batch p"]]:
    """Return the means of the continuous elements, and the logits of the others.

    Args:
        outputs: outputs of an actor in the order of the actuators: a mean, or as many logits as
            there are choices.
        points: the number of choices of each actuator, 0 for a continuous one.
    """
    parts: dict[bool, list[Array]] = {False: [], True: []}
    end = 0
    for count in points:
        start, end = end, end + (count or 1)
        parts[count > 0].append(outputs[..., start:end])
    return jnp.concatenate(parts[False], axis=-1), jnp.concatenate(parts[True], axis=-1)


Distribution = Gaussian | Categorical | Joint
"""A distribution over actions.

`mode()` returns the most probable actions, and `sample(key)` draws actions. With a `shard` it draws
those of one device. `log_prob(action)` is the logarithm of the probability of an action, or of its
density where it is continuous. `entropy()` is in nats.
"""


def action_distribution(
    points: tuple[int, ...],
    outputs: Float[Array, "*batch o"],
    log_std: Float[Array, " a"],
    choose: Callable[[Array, Array, tuple[int, ...]], Categorical],
) -> Distribution:
    """Return the distribution over actions that the outputs of an actor stand for.

    Args:
        points: the number of choices of each actuator, 0 for a continuous one, or `()` if all are
            continuous.
        outputs: the outputs in the order of the actuators, as for `split_outputs`.
        log_std: one number for each actuator.
        choose: returns the choices that logits, their part of `log_std` and their points stand for.
    """
    if not any(points):
        return Gaussian(mean=outputs, log_std=log_std)
    if all(points):
        return choose(outputs, log_std, points)
    mean, logits = split_outputs(outputs, points)
    width, sharpness = split_outputs(log_std, [min(count, 1) for count in points])
    return Joint(
        normal=Gaussian(mean=mean, log_std=width),
        choices=choose(logits, sharpness, tuple(filter(None, points))),
        points=points,
    )
