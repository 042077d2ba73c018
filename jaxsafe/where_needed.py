"""A function that is computed for some elements of a batch only.

On a CPU the cost grows with the number of these elements.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from jaxsafe.devices.backend import accelerated

Tree = TypeVar("Tree")

PER_ROUND = 1 / 32
"""Share of a batch that is computed in one round."""

MIN_PER_ROUND = 16
"""The least number of elements that are computed in one round."""

FLAGS_PER_WORD = 32
"""Number of elements whose flags share a word."""


def where_needed(
    needed: Bool[Array, " k"], function: Callable[[Any, Any], Tree], shared: Any, elements: Any
) -> Tree:
    """Return the results of a function for k elements, and zeros where they are not needed.

    Under `vmap` all elements of all batches are one list. Those that are needed are computed in
    rounds of a fixed size, until none is left. Derivatives do not pass.

    Args:
        needed: which results are needed.
        function: `function(shared, element)` for one element. It closes over no array.
        shared: what all elements of a batch have in common.
        elements: the elements, along the first axis of all leaves.
    """
    shared, elements = jax.lax.stop_gradient((shared, elements))
    one = jax.eval_shape(function, shared, jax.tree.map(lambda leaf: leaf[0], elements))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), one)

    def if_needed(shared: Any, needed: Array, element: Any) -> Tree:
        return jax.lax.cond(needed, function, lambda *_: zeros, shared, element)

    @jax.custom_batching.custom_vmap
    def compute(needed: Array, shared: Any, elements: Any) -> Tree:
        return jax.lax.map(lambda pair: if_needed(shared, *pair), (needed, elements))

    @compute.def_vmap
    def _(size: int, batched: Any, needed: Array, shared: Any, elements: Any) -> tuple[Tree, Any]:
        def listed(leaf: Array, is_batched: bool) -> Array:
            whole = leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape))
            return whole.reshape(-1, *whole.shape[2:])

        count = needed.shape[-1]
        flat = jax.tree.map(listed, (needed, elements), (batched[0], batched[2]))
        owners = jnp.arange(size * count) // count
        common = jax.tree.map(lambda leaf, own: None if own else leaf, shared, batched[1])
        own = jax.tree.map(lambda leaf, own: leaf if own else None, shared, batched[1])

        def one(given: tuple[Any, Any]) -> Tree:
            """Return the result for an element and what its member of the batch has of its own."""
            own, element = given
            is_none = lambda leaf: leaf is None  # noqa: E731
            both = jax.tree.map(lambda a, b: b if a is None else a, common, own, is_leaf=is_none)
            return function(both, element)

        each = jax.tree.map(lambda leaf: leaf[owners], own), flat[1]
        results = _in_rounds(one, flat[0], each, zeros)
        results = jax.tree.map(lambda leaf: leaf.reshape(size, count, *leaf.shape[1:]), results)
        return results, jax.tree.map(lambda _: True, results)

    return compute(needed, shared, elements)


def _in_rounds(
    function: Callable[[Any], Tree], needed: Bool[Array, " n"], elements: Any, zeros: Tree
) -> Tree:
    """Return the results for all elements, and zeros for those that are not needed."""
    size = needed.shape[0]
    none = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape), leaf.dtype), zeros)
    if accelerated() or size <= MIN_PER_ROUND:
        return choose(needed, jax.vmap(function)(elements), none)
    per_round = max(MIN_PER_ROUND, int(size * PER_ROUND))
    flags = pack(needed)
    tables, as_elements = _tables(elements)
    start, as_results = _tables(none)

    def one_round(index: Array, results: list[Array]) -> list[Array]:
        indices = indices_of(flags, index * per_round + jnp.arange(per_round), size)
        chosen = as_elements([table[jnp.minimum(indices, size - 1)] for table in tables])
        found, _ = _tables(jax.vmap(function)(chosen))
        return [
            table.at[indices].set(new, mode="drop")
            for table, new in zip(results, found, strict=True)
        ]

    num_rounds = (flags.ends[-1] + per_round - 1) // per_round
    return as_results(jax.lax.fori_loop(0, num_rounds, one_round, start))


def _tables(tree: Tree) -> tuple[list[Array], Callable[[list[Array]], Tree]]:
    """Return one table of all arrays for each type of number, and the inverse.

    A table has a row for each element. To move the rows of a table takes one operation. To move
    those of many arrays takes many, which the compiler is slow to translate.
    """
    leaves, structure = jax.tree.flatten(tree)
    types = list(dict.fromkeys(leaf.dtype for leaf in leaves))
    flat = [leaf.reshape(leaf.shape[0], -1) for leaf in leaves]
    tables = [
        jnp.concatenate([part for part in flat if part.dtype == kind], axis=1) for kind in types
    ]

    def inverse(tables: list[Array]) -> Tree:
        places = dict.fromkeys(types, 0)
        parts = []
        for leaf, part in zip(leaves, flat, strict=True):
            begin = places[leaf.dtype]
            places[leaf.dtype] = begin + part.shape[1]
            columns = tables[types.index(leaf.dtype)][:, begin : places[leaf.dtype]]
            parts.append(columns.reshape(-1, *leaf.shape[1:]))
        return jax.tree.unflatten(structure, parts)

    return tables, inverse


def choose(where: Array, fresh: Tree, old: Tree, axis: Literal[0, -1] = 0) -> Tree:
    """Return a batch with the elements of `fresh` where `where` holds, and else those of `old`.

    The axes of `where` are the leading axes of all leaves, or the last axis with `axis=-1`.
    """

    def choose_leaf(fresh_leaf: Array, old_leaf: Array) -> Array:
        inner = fresh_leaf.ndim - where.ndim if axis == 0 else 0
        return jnp.where(where.reshape(where.shape + (1,) * inner), fresh_leaf, old_leaf)

    return jax.tree.map(choose_leaf, fresh, old)


class Flags(NamedTuple):
    """The flags of all elements of a batch, `FLAGS_PER_WORD` to a word.

    Bit *b* of word *w* is the flag of element *w* + *b* × (number of words).
    """

    words: UInt32[Array, " words"]
    ends: Int[Array, " words"]  # number of flags that are set in this word and those before it


def pack(where: Bool[Array, " n"]) -> Flags:
    """Pack flags into words by laying one half of them over the other, again and again.

    These operations vectorise. On a CPU a sum over bits, or `jnp.nonzero`, is a loop of scalars.
    """
    padded = jnp.pad(where, (0, -where.shape[0] % FLAGS_PER_WORD))
    words = padded.reshape(FLAGS_PER_WORD, -1).astype(jnp.uint32)
    while (half := words.shape[0] // 2) > 0:
        words = words[:half] | (words[half:] << half)
    ends = jax.lax.population_count(words[0]).astype(jnp.int32)
    shift = 1
    while shift < ends.shape[0]:
        ends = ends + jnp.pad(ends[:-shift], (shift, 0))
        shift = 2 * shift
    return Flags(words=words[0], ends=ends)


def indices_of(flags: Flags, rank: Int[Array, " k"], size: int) -> Int[Array, " k"]:
    """Return the indices of elements whose flag is set, given their ranks among these.

    Args:
        flags: the flags of the batch.
        rank: 0 for the first element whose flag is set, 1 for the second, and so on.
        size: size of the batch. It is returned for ranks beyond the last, because it is the index
            of no element.
    """
    num_words = flags.ends.shape[0]
    word = jnp.searchsorted(flags.ends, rank, side="right", method="scan_unrolled")
    existing = jnp.minimum(word, num_words - 1)
    bits = flags.words[existing]
    before = flags.ends[existing] - jax.lax.population_count(bits).astype(jnp.int32)
    # Bits 0 … b of a word, for every b. The last one overflows to all bits.
    upto = (jnp.uint32(2) << jnp.arange(FLAGS_PER_WORD, dtype=jnp.uint32)) - 1
    seen = jax.lax.population_count(bits[:, None] & upto[None]).astype(jnp.int32)
    bit = jnp.sum(seen <= (rank - before)[:, None], axis=1)
    return jnp.where(word < num_words, existing + bit * num_words, size)
