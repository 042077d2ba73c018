"""The safety of a controller as a question for verifiers, and a search for a counterexample.

Verifiers of neural networks get two files. An ONNX graph holds the closed loop, from a start to
every margin h on the way. A VNN-LIB file describes what must not happen: there is a start in a box
from which some margin is negative. `search` looks for such a start.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.export.functions import Exported
from jaxsafe.storage.files import write_bytes
from jaxsafe.types import Key

Box = Sequence[tuple[float, float]]
"""The lowest and the highest value of each element of a start."""


class Worst(NamedTuple):
    """The start with the smallest margin that a search found."""

    margin: float
    """The smallest margin on the way, or −∞ if some margin is NaN. That is not safe either."""

    start: np.ndarray
    """The start, in the order of the inputs of the closed loop."""

    tried: int
    """Number of starts that the search tried."""


def write_vnnlib(path: Path, exported: Exported, box: Box) -> Path:
    """Write the property that some margin is ≤ 0 for some start in the box.

    If a verifier answers `unsat`, every start in the box is safe. VNN-LIB has no strict inequality,
    so a margin of 0 counts as unsafe, although it is safe.

    Args:
        path: the file.
        exported: the closed loop.
        box: bounds of each input.

    Returns:
        The path of the file.
    """
    lines = [
        f"; unsafe if any of {len(exported.outputs)} margins is <= 0;"
        " unsat: every start in the box is safe"
    ]
    lines += [f"; X_{i} is {name}" for i, name in enumerate(exported.inputs)]
    lines += [f"(declare-const X_{i} Real)" for i in range(len(exported.inputs))]
    lines += [f"(declare-const Y_{i} Real)" for i in range(len(exported.outputs))]
    for i, (low, high) in enumerate(box):
        lines += [f"(assert (>= X_{i} {low!r}))", f"(assert (<= X_{i} {high!r}))"]
    lines += [
        "(assert (or",
        *(f"    (and (<= Y_{i} 0.0))" for i in range(len(exported.outputs))),
        "))",
    ]
    write_bytes(path, ("\n".join(lines) + "\n").encode())
    return path


def search(
    exported: Exported, box: Box, key: Key, starts: int = 10_000, best: int = 64, rounds: int = 100
) -> Worst:
    """Look for a start in the box from which some margin is negative.

    The search tries corners and random starts, and then descends from the worst of them. It may
    miss a start, so a search that finds nothing is no proof. A margin that is NaN counts as unsafe.

    Args:
        exported: the closed loop.
        box: bounds of each element of a start.
        key: a PRNG key for the random starts.
        starts: number of random starts.
        best: number of starts from which the search descends. They have the smallest margins.
        rounds: number of steps of each descent.
    """
    low, high = (jnp.array([[bounds[i] for bounds in box]], jnp.result_type(float)) for i in (0, 1))
    corners = np.stack(np.meshgrid(*([0.0, 1.0] for _ in box), indexing="ij"), axis=-1).reshape(
        -1, len(box)
    )[:4096]
    shares = jnp.concatenate(
        [jnp.asarray(corners, low.dtype), jax.random.uniform(key, (starts, len(box)))]
    )

    def least(share: jax.Array) -> jax.Array:
        margins = exported.function(low + share * (high - low))
        return jnp.min(jnp.where(jnp.isnan(margins), -jnp.inf, margins), axis=-1)

    @jax.jit
    def descend(share: jax.Array) -> tuple[jax.Array, jax.Array]:
        def descend_once(
            i: int, carry: tuple[jax.Array, jax.Array, jax.Array]
        ) -> tuple[jax.Array, jax.Array, jax.Array]:
            share, worst, at = carry
            gradient = jax.grad(lambda s: jnp.sum(least(s)))(share)
            # Where there is no finite slope, the start stays.
            gradient = jnp.where(jnp.isfinite(gradient), gradient, 0.0)
            length = jnp.linalg.norm(gradient, axis=-1, keepdims=True)
            moved = jnp.clip(
                share - 0.1 * 0.95**i * gradient / jnp.maximum(length, 1e-12), 0.0, 1.0
            )
            margin = least(moved)
            better = margin < worst
            return moved, jnp.where(better, margin, worst), jnp.where(better[:, None], moved, at)

        begin = (share, least(share), share)
        _, worst, at = jax.lax.fori_loop(0, rounds, descend_once, begin)
        return worst, at

    order = jnp.argsort(jax.jit(least)(shares))[:best]
    worst, at = descend(shares[order])
    index = int(jnp.argmin(worst))
    start = np.asarray(low[0] + at[index] * (high[0] - low[0]))
    return Worst(float(worst[index]), start, len(shares) + best * rounds)
