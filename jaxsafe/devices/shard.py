"""A batch that several devices share: the part that one of them has, and what it needs of the others.

Every device draws the random numbers of the whole batch and keeps its own, so what a batch does depends on the number of
devices by the order of sums only. Inside `jax.shard_map`; with one device every method leaves its argument as it is.
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
    """One of `count` equal parts, along an axis of the mesh."""

    axis: str = ""
    count: int = 1

    def first(self, size: int) -> Array | int:
        """Where this device's part begins, if it has this size."""
        return 0 if self.count == 1 else jax.lax.axis_index(self.axis) * size

    def own(self, x: Array) -> Array:
        """This device's part, along the first axis, of what all of them have whole."""
        if self.count == 1:
            return x
        size = x.shape[0] // self.count
        return jax.lax.dynamic_slice_in_dim(x, self.first(size), size)

    def draw(self, draw: Callable[..., Array], key: Key, shape: tuple[int, ...], *options: Any) -> Array:
        """This device's part, of this shape, of one draw for the batch: `draw(key, shape, *options)`."""
        return self.own(draw(key, (shape[0] * self.count, *shape[1:]), *options))

    def join(self, tree: Tree, axis: int = 0) -> Tree:
        """The parts of all devices, one after the other; all leaves have the same leading axes up to `axis`.

        What has the same type goes in one exchange: each takes its time, however little it moves.
        """
        if self.count == 1:
            return tree
        leaves, structure = jax.tree.flatten(tree)
        found = dict.fromkeys(range(len(leaves)))
        for dtype in dict.fromkeys(leaf.dtype for leaf in leaves):  # in one order: every process must trace the same
            which = [index for index, leaf in enumerate(leaves) if leaf.dtype == dtype]
            columns = [leaves[index].reshape(*leaves[index].shape[: axis + 1], -1) for index in which]
            ends = np.cumsum([one.shape[-1] for one in columns])[:-1]
            joined = jax.lax.all_gather(jnp.concatenate(columns, axis=-1), self.axis, axis=axis, tiled=True)
            for index, part in zip(which, jnp.split(joined, ends, axis=-1), strict=True):
                found[index] = part.reshape(*part.shape[: axis + 1], *leaves[index].shape[axis + 1 :])
        return jax.tree.unflatten(structure, found.values())

    def mean(self, tree: Any) -> Any:
        """The mean over the devices of what each has found for its part."""
        if self.count == 1:
            return tree
        flat, restore = ravel_pytree(tree)  # one exchange instead of one for each array
        return restore(jax.lax.pmean(flat, self.axis))


WHOLE = Shard()
"""The batch of a single device."""
