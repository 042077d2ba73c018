"""Work for those members of a batch that need it, which are often few."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from jaxsafe.devices.backend import accelerated

Tree = TypeVar("Tree")

FLAGS_PER_WORD = 32
"""Number of members of a batch whose flags share a word."""

MEMBERS_PER_ROUND = 8
"""Number of members of a batch for which `only_where` computes at a time."""


def only_where(
    needed: Bool[Array, ""],
    function: Callable[..., Tree],
    arguments: tuple[Any, ...],
    otherwise: Tree,
) -> Tree:
    """Return `function(*arguments)` where it is needed, else `otherwise`.

    Under `vmap` a CPU gathers the members of the batch that need it, a few at a time. An
    accelerator computes it for all, because a loop would wait for the host. Derivatives are zero.

    Args:
        needed: whether the function is needed.
        function: a function of arrays, which closes over none that is traced.
        arguments: its arguments, trees of arrays.
        otherwise: a result of the same shapes and types.
    """

    @jax.custom_batching.custom_vmap
    def one(needed: Any, arguments: Any, otherwise: Any) -> Any:
        return jax.lax.cond(needed, lambda: function(*arguments), lambda: otherwise)

    @one.def_vmap
    def batch(size: int, batched: Any, needed: Any, arguments: Any, otherwise: Any) -> Any:
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched[1]))
        mapped = jax.vmap(function, in_axes=axes)
        is_batched = jax.tree.map(lambda _: True, otherwise)

        def whole(is_batched: bool, leaf: Array) -> Array:
            return leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape))

        otherwise = jax.tree.map(whole, batched[2], otherwise)
        needed = whole(batched[0], needed)
        if accelerated():
            computed = mapped(*arguments)
            return jax.tree.map(
                lambda new, old: jnp.where(needed.reshape(-1, *(1,) * (new.ndim - 1)), new, old),
                computed,
                otherwise,
            ), is_batched
        per_round = min(MEMBERS_PER_ROUND, size)

        def one_round(flags: Flags, index: Array, results: Any) -> Any:
            members = flagged(flags, index * per_round + jnp.arange(per_round), size)
            gathered = jax.tree.map(
                lambda is_batched, leaf: leaf.at[members].get(mode="clip") if is_batched else leaf,
                tuple(batched[1]),
                arguments,
            )
            computed = mapped(*gathered)
            return jax.tree.map(
                lambda old, new: old.at[members].set(new, mode="drop"), results, computed
            )

        def in_rounds() -> Any:
            flags = pack(needed)
            rounds = (flags.ends[-1] + per_round - 1) // per_round
            return jax.lax.fori_loop(0, rounds, partial(one_round, flags), otherwise)

        return jax.lax.cond(jnp.any(needed), in_rounds, lambda: otherwise), is_batched

    return one(*jax.lax.stop_gradient((needed, arguments, otherwise)))


class Flags(NamedTuple):
    """Flags of the members of a batch, `FLAGS_PER_WORD` to a word.

    Bit *b* of word *w* is the flag of member *w* + *b* × (number of words).
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


def flagged(flags: Flags, rank: Int[Array, " k"], size: int) -> Int[Array, " k"]:
    """Return the indices of members whose flag is set, given their ranks among these.

    Args:
        flags: the flags of the batch.
        rank: 0 for the first member whose flag is set, 1 for the second, and so on.
        size: size of the batch. It is returned for ranks beyond the last, because it is the index
            of no member.
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
