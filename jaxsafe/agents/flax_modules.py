"""The Flax modules behind the networks of this package."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from flax import linen
from jaxtyping import Array, Float

from jaxsafe.agents.networks import CELL, OUTPUT, Memory


class Perceptron(linen.Module):
    """Layers with an activation between them, and none after the last."""

    hidden: Sequence[int]
    activation: str
    layer_norm: bool
    num_outputs: int
    output_gain: float

    @linen.compact
    def __call__(self, inputs: Float[Array, "*batch i"]) -> Float[Array, "*batch o"]:
        x = inputs
        for i, size in enumerate(self.hidden):
            x = linen.Dense(size, name=f"hidden_{i}")(x)
            if self.layer_norm:
                x = linen.LayerNorm(name=f"norm_{i}")(x)
            x = getattr(linen, self.activation)(x)
        return linen.Dense(self.num_outputs, name=OUTPUT)(x)


class WeightedVectors(linen.Module):
    """The last vector of the inputs, plus the vectors before it, weighted by a perceptron."""

    hidden: Sequence[int]
    vectors: int
    num_outputs: int
    output_gain: float

    @linen.compact
    def __call__(self, inputs: Float[Array, "*batch i"]) -> Float[Array, "*batch o"]:
        first = inputs.shape[-1] - self.vectors * self.num_outputs
        x = inputs[..., :first]
        for i, size in enumerate(self.hidden):
            x = linen.tanh(linen.Dense(size, name=f"hidden_{i}")(x))
        weights = 2.0 * linen.tanh(linen.Dense(self.vectors - 1, name=OUTPUT)(x))
        vectors = inputs[..., first:].reshape(*x.shape[:-1], self.vectors, self.num_outputs)
        weighted = jnp.sum(weights[..., None] * vectors[..., :-1, :], axis=-2)
        return weighted + vectors[..., -1, :]


class Recurrent(linen.Module):
    """Hidden layers with tanh, a cell of gated recurrent units, and the outputs."""

    hidden: Sequence[int]
    units: int
    num_outputs: int
    output_gain: float

    @linen.compact
    def __call__(
        self, memory: Memory, inputs: Float[Array, "*batch i"]
    ) -> tuple[Memory, Float[Array, "*batch o"]]:
        x = inputs
        for i, size in enumerate(self.hidden):
            x = linen.tanh(linen.Dense(size, name=f"hidden_{i}")(x))
        memory, x = linen.GRUCell(self.units, name=CELL)(memory, x)
        return memory, linen.Dense(self.num_outputs, name=OUTPUT)(x)
