"""A batch that several devices share: the part of one device, and what it needs from the others.

Every device draws the random numbers of the whole batch and keeps those of its part. So the number
of devices changes only the order of sums. All of this happens inside `jax.shard_map`. With one
device, methods that take arrays return them as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxsafe.types import Key

Tree = TypeVar("Tree")


@dataclass(frozen=True)
class Shard:
    """One of `count` equal parts of a batch, along an axis of the mesh."""

    axis: str = ""
    count: int = 1

    def first(self, size: int) -> Array | int:
        """Return where the part of this device begins in the batch, if parts have this size."""
        return 0 if self.count == 1 else jax.lax.axis_index(self.axis) * size

    def own(self, x: Array) -> Array:
        """Return this device's part of an array that all devices have, along the first axis."""
        if self.count == 1:
            return x
        size = x.shape[0] // self.count
        return jax.lax.dynamic_slice_in_dim(x, self.first(size), size)

    def draw(
        self, draw: Callable[..., Array], key: Key, shape: tuple[int, ...], *options: Any
    ) -> Array:
        """Return the part of this device of one random draw for the whole batch.

        Args:
            draw: the random function, called as `draw(key, shape, *options)`.
            key: a PRNG key, the same on all devices.
            shape: shape of the part.
            options: further arguments of `draw`.
        """
        return self.own(draw(key, (shape[0] * self.count, *shape[1:]), *options))

    def join(self, tree: Tree, axis: int = 0) -> Tree:
        """Return the parts of all devices, joined along an axis.

        Arrays of the same type are exchanged together, because an exchange takes some time however
        little it moves.

        Args:
            tree: the part of this device. All leaves have the same leading axes up to `axis`.
            axis: the axis to join along.
        """
        if self.count == 1:
            return tree
        leaves, structure = jax.tree.flatten(tree)
        joined = dict.fromkeys(range(len(leaves)))
        # Types are taken in the order of the leaves, because every process must trace the same.
        for dtype in dict.fromkeys(leaf.dtype for leaf in leaves):
            indices = [index for index, leaf in enumerate(leaves) if leaf.dtype == dtype]
            columns = [
                leaves[index].reshape(*leaves[index].shape[: axis + 1], -1) for index in indices
            ]
            ends = np.cumsum([column.shape[-1] for column in columns])[:-1]
            packed = jnp.concatenate(columns, axis=-1)
            gathered = jax.lax.all_gather(packed, self.axis, axis=axis, tiled=True)
            for index, part in zip(indices, jnp.split(gathered, ends, axis=-1), strict=True):
                rest = leaves[index].shape[axis + 1 :]
                joined[index] = part.reshape(*part.shape[: axis + 1], *rest)
        return jax.tree.unflatten(structure, joined.values())

    def mean(self, tree: Any) -> Any:
        """Return the mean over the devices of what each has computed for its part."""
        if self.count == 1:
            return tree
        flat, restore = ravel_pytree(tree)  # one exchange instead of one for each array
        return restore(jax.lax.pmean(flat, self.axis))


WHOLE = Shard()
"""The whole batch, which a single device has."""
