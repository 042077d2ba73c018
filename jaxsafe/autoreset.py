"""New starts for the environments of a batch whose episodes ended.

On a CPU the cost grows with the number of these environments. The index of an environment is its
place on the axis of the batch.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxsafe.devices.backend import accelerated
from jaxsafe.sparse import flagged, pack

Tree = TypeVar("Tree")

Draw = Callable[[Any, Array], Tree]
"""`draw(parameters, indices)` returns the starts of the environments with these indices."""

SPARSE_RESETS_FROM = 256
"""Size of a batch from which on starts are drawn only for the environments that need one.

In a smaller batch they are drawn for all environments if any needs one.
"""

RESETS_PER_ROUND = 1 / 128
"""Share of a large batch that gets its starts in one round. On most steps one round is enough."""

MIN_RESETS_PER_ROUND = 16
"""The least number of environments that get their starts in one round."""


def renew(
    where: Bool[Array, " n"],
    draw: Draw[Tree],
    parameters: Any,
    old: Tree,
    axis: Literal[0, -1] = 0,
) -> Tree:
    """Return a batch in which some environments are replaced by new starts.

    To draw a start costs many times as much as a step. In a small batch most steps end no episode.
    In a large batch most steps end a few.

    An accelerator draws a start for every environment, and the draws become part of the kernels of
    the step. A step of docking3d is 23 kernels that way. With a branch and a loop, which wait for
    the host, it was 65 to 90.

    Args:
        where: which environments to replace.
        draw: `draw(parameters, indices)` returns starts. Derivatives do not pass through what it
            closes over.
        parameters: what the starts depend on. Derivatives pass through it.
        old: the batch.
        axis: the axis of the environments in all leaves, the first or the last.
    """
    if accelerated():
        return _renew_by_definition(draw, axis, where, parameters, old)
    if where.shape[0] >= SPARSE_RESETS_FROM:
        return _renew_in_rounds(draw, axis, where, parameters, old)
    return jax.lax.cond(
        jnp.any(where),
        lambda: _renew_by_definition(draw, axis, where, parameters, old),
        lambda: old,
    )


def choose(where: Array, fresh: Tree, old: Tree, axis: Literal[0, -1] = 0) -> Tree:
    """Return a batch with the environments of `fresh` where `where` holds, and else those of `old`.

    The axes of `where` are the leading axes of all leaves, or the last axis with `axis=-1`.
    """

    def choose_leaf(fresh_leaf: Array, old_leaf: Array) -> Array:
        inner = fresh_leaf.ndim - where.ndim if axis == 0 else 0
        return jnp.where(where.reshape(where.shape + (1,) * inner), fresh_leaf, old_leaf)

    return jax.tree.map(choose_leaf, fresh, old)


def _renew_by_definition(
    draw: Draw[Tree], axis: Literal[0, -1], where: Array, parameters: Any, old: Tree
) -> Tree:
    """Draw a start for every environment, and use those that are needed."""
    return choose(where, draw(parameters, jnp.arange(where.shape[0])), old, axis)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _renew_in_rounds(
    draw: Draw[Tree], axis: Literal[0, -1], where: Array, parameters: Any, old: Tree
) -> Tree:
    """Draw starts for a share of the batch at a time, until all that need one have theirs."""
    size = where.shape[0]
    per_round = max(MIN_RESETS_PER_ROUND, int(size * RESETS_PER_ROUND))
    flags = pack(where)

    def renew_round(index: Array | int, batch: Tree) -> Tree:
        indices = flagged(flags, index * per_round + jnp.arange(per_round), size)
        place = indices if axis == 0 else (..., indices)
        starts = draw(parameters, indices)
        return jax.tree.map(lambda x, new: x.at[place].set(new, mode="drop"), batch, starts)

    num_rounds = (flags.ends[-1] + per_round - 1) // per_round
    once = renew_round(0, old)  # outside the loop, because a loop copies all that it carries
    return jax.lax.cond(
        num_rounds > 1,
        lambda: jax.lax.fori_loop(1, num_rounds, renew_round, once),
        lambda: once,
    )


@_renew_in_rounds.defjvp
def _(draw: Draw[Tree], axis: Literal[0, -1], primals: tuple, tangents: tuple) -> tuple[Tree, Tree]:
    """Take the derivative of the definition, because a loop of unknown length has no reverse."""
    return jax.jvp(functools.partial(_renew_by_definition, draw, axis), primals, tangents)
