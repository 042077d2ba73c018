"""Loops and vectors with fewer kernels, which are faster on an accelerator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree


def accelerated() -> bool:
    """Return whether this process computes on a GPU or another accelerator.

    A CPU runs a loop at little cost and gains from what it skips. An accelerator spends a
    microsecond or more on every kernel, and waits for the host wherever a program branches. So it
    gains from having few kernels, even if they compute more.
    """
    return jax.default_backend() != "cpu"


def scan_packed(
    function: Callable[[Any, Any], tuple[Any, Any]], start: Any, xs: Any
) -> tuple[Any, Any]:
    """Return what `jax.lax.scan` returns, and write the outputs with fewer kernels.

    In `jax.lax.scan` each array that a step returns is written into its stack by a kernel of its
    own. Here arrays of the same shape and type are written together.
    """
    shapes = jax.eval_shape(lambda: function(start, jax.tree.map(lambda x: x[0], xs))[1])
    leaves, structure = jax.tree.flatten(shapes)
    groups: dict[Any, list[int]] = {}
    for index, leaf in enumerate(leaves):
        groups.setdefault((leaf.shape, leaf.dtype), []).append(index)

    def packed(carry: Any, x: Any) -> tuple[Any, list[Any]]:
        carry, returned = function(carry, x)
        flat = jax.tree.leaves(returned)
        return carry, [jnp.stack([flat[index] for index in group]) for group in groups.values()]

    end, stacks = jax.lax.scan(packed, start, xs)
    outputs = {}
    for group, stack in zip(groups.values(), stacks, strict=True):
        for position, index in enumerate(group):
            outputs[index] = stack[:, position]
    return end, jax.tree.unflatten(structure, [outputs[index] for index in range(len(leaves))])


def packing(tree: Any) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Return a function that makes one vector of a tree shaped like this one, and its inverse.

    An operation on the vector is one kernel. On the tree it would be a kernel for each array. On a
    CPU both functions return their argument.
    """
    if not accelerated():
        return (lambda tree: tree), (lambda tree: tree)
    return (lambda tree: ravel_pytree(tree)[0]), ravel_pytree(tree)[1]
