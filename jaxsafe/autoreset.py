"""New starts for those lanes of a batch whose episodes ended, at a cost that follows their number."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from jaxsafe.devices.backend import accelerated

Tree = TypeVar("Tree")
Draw = Callable[[Any, Array], Tree]

LARGE = 256
"""From so many lanes on, starts are drawn for those that need one; below, for all if any does."""

SHARE = 128
"""Of a large batch, one lane in so many gets its start at a time, …"""

LEAST = 16
"""… and so many at least."""

BITS = 32
"""Lanes whose flags share a word."""


def renew(where: Bool[Array, " n"], draw: Draw[Tree], parameters: Any, old: Tree, axis: Literal[0, -1] = 0) -> Tree:
    """`old`, its lanes where `where` holds replaced by `draw(parameters, lanes)`; lanes are the first axis, or the last.

    Drawing a start costs many times a step. With few lanes most steps end no episode, with many most end a few. What `draw`
    closes over has no derivative; what is in `parameters` has.

    An accelerator draws a start for every lane: the draws become part of the kernels of the step. A step of docking3d is 23
    kernels that way. With a branch and a loop, which wait for the host, it was 65 to 90.
    """
    if accelerated():
        return _every(draw, axis, where, parameters, old)
    if where.shape[0] >= LARGE:
        return _renew_some(draw, axis, where, parameters, old)
    return jax.lax.cond(jnp.any(where), lambda: _every(draw, axis, where, parameters, old), lambda: old)


def choose(where: Array, fresh: Tree, old: Tree, axis: Literal[0, -1] = 0) -> Tree:
    """One of two trees lane by lane; `where` has the leading axes of all their leaves, or with `axis=-1` the last."""

    def one(a: Array, b: Array) -> Array:
        inner = a.ndim - where.ndim if axis == 0 else 0
        return jnp.where(where.reshape(where.shape + (1,) * inner), a, b)

    return jax.tree.map(one, fresh, old)


def _every(draw: Draw[Tree], axis: Literal[0, -1], where: Array, parameters: Any, old: Tree) -> Tree:
    """The definition: a draw for each lane."""
    return choose(where, draw(parameters, jnp.arange(where.shape[0])), old, axis)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _renew_some(draw: Draw[Tree], axis: Literal[0, -1], where: Array, parameters: Any, old: Tree) -> Tree:
    """The same, one lane in `SHARE` at a time until all have theirs; mostly that is once."""
    size = where.shape[0]
    number = max(LEAST, size // SHARE)
    flags = _packed(where)

    def some(turn: Array | int, old: Tree) -> Tree:
        lanes = _lanes(flags, turn * number + jnp.arange(number), size)
        place = lanes if axis == 0 else (..., lanes)
        return jax.tree.map(lambda x, new: x.at[place].set(new, mode="drop"), old, draw(parameters, lanes))

    turns = (flags.ends[-1] + number - 1) // number
    once = some(0, old)  # outside the loop, which copies all it carries
    return jax.lax.cond(turns > 1, lambda: jax.lax.fori_loop(1, turns, some, once), lambda: once)


@_renew_some.defjvp
def _(draw: Draw[Tree], axis: Literal[0, -1], primals: tuple, tangents: tuple) -> tuple[Tree, Tree]:
    """A loop of unknown length has no reverse; the definition has."""
    return jax.jvp(functools.partial(_every, draw, axis), primals, tangents)


class Flags(NamedTuple):
    """The flags of all lanes, `BITS` to a word: bit *b* of word *w* is lane *w* + *b* × words."""

    words: UInt32[Array, " words"]
    ends: Int[Array, " words"]  # how many are set up to and with this word


def _packed(where: Bool[Array, " n"]) -> Flags:
    """Halves laid over each other: that vectorises. A sum over bits, or `jnp.nonzero`, is a loop of scalars on a CPU."""
    words = jnp.pad(where, (0, -where.shape[0] % BITS)).reshape(BITS, -1).astype(jnp.uint32)
    while (half := words.shape[0] // 2) > 0:
        words = words[:half] | (words[half:] << half)
    ends, shift = jax.lax.population_count(words[0]).astype(jnp.int32), 1
    while shift < ends.shape[0]:
        ends, shift = ends + jnp.pad(ends[:-shift], (shift, 0)), 2 * shift
    return Flags(words[0], ends)


def _lanes(flags: Flags, rank: Int[Array, " k"], size: int) -> Int[Array, " k"]:
    """The lanes with the first, second, … flag that is set, for `rank` 0, 1, …; `size`, which is none, beyond the last."""
    count = flags.ends.shape[0]
    word = jnp.searchsorted(flags.ends, rank, side="right", method="scan_unrolled")
    here = jnp.minimum(word, count - 1)
    bits = flags.words[here]
    before = flags.ends[here] - jax.lax.population_count(bits).astype(jnp.int32)
    upto = (jnp.uint32(2) << jnp.arange(BITS, dtype=jnp.uint32)) - 1  # bits 0 … b; the last overflows to all
    seen = jax.lax.population_count(bits[:, None] & upto[None]).astype(jnp.int32)
    bit = jnp.sum(seen <= (rank - before)[:, None], axis=1)
    return jnp.where(word < count, here + bit * count, size)
