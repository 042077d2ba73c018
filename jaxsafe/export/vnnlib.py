"""The safety of a controller as a question for neural-network verifiers, and a search for a counterexample.

A verifier gets the closed loop as one ONNX graph, from a start to every margin h on the way, and a VNN-LIB file that
describes what must not happen: a start in the box from which some margin is negative.
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


class Worst(NamedTuple):
    """The start with the least margin that a search found."""

    margin: float  # −∞ if some margin on the way is not a number, which is not safe either
    start: np.ndarray
    tried: int


def write_vnnlib(path: Path, exported: Exported, box: Box) -> Path:
    """Write the property that some output is ≤ 0 for some input in the box: `unsat` means safe.

    VNN-LIB knows no strict inequality, so a margin of 0, which is safe, counts as unsafe.
    """
    lines = [
        f"; unsafe if any of {len(exported.outputs)} margins is <= 0; unsat: every start in the box is safe"
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
    """Look for a start in the box with a negative margin: corners, random starts, then descent from the worst of them.

    It may miss one: a search that finds nothing is no proof. A margin that is not a number is no safe one.
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
        def one(
            i: int, carry: tuple[jax.Array, jax.Array, jax.Array]
        ) -> tuple[jax.Array, jax.Array, jax.Array]:
            share, worst, at = carry
            gradient = jax.grad(lambda s: jnp.sum(least(s)))(share)
            gradient = jnp.where(
                jnp.isfinite(gradient), gradient, 0.0
            )  # from where there is no slope, stay
            length = jnp.linalg.norm(gradient, axis=-1, keepdims=True)
            moved = jnp.clip(
                share - 0.1 * 0.95**i * gradient / jnp.maximum(length, 1e-12), 0.0, 1.0
            )
            found = least(moved)
            better = found < worst
            return moved, jnp.where(better, found, worst), jnp.where(better[:, None], moved, at)

        _, worst, at = jax.lax.fori_loop(0, rounds, one, (share, least(share), share))
        return worst, at

    order = jnp.argsort(jax.jit(least)(shares))[:best]
    worst, at = descend(shares[order])
    index = int(jnp.argmin(worst))
    start = np.asarray(low[0] + at[index] * (high[0] - low[0]))
    return Worst(float(worst[index]), start, len(shares) + best * rounds)
