"""The nearest control within bounds and under a few linear constraints, exactly, by trying every set of active constraints.

Each element of the control is free or rests on one of its bounds, and each constraint is active or not. For a few of both
there are few such patterns; all are solved side by side by elimination of as many unknowns as there are constraints, at a
fixed cost, without iteration or start, and the derivative is that of the active set.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.projection import within
from jaxsafe.types import Number


def nearest_control(
    u: Float[Array, " m"],
    low: Float[Array, " m"],
    high: Float[Array, " m"],
    rows: Float[Array, "c m"],
    offsets: Float[Array, " c"],
    slack: Number | None = None,
    tolerance: Number | None = None,
) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
    """Nearest control, argmin ‖w − u‖² + σ‖s‖² subject to rows·w + s ≥ offsets, s ≥ 0 and low ≤ w ≤ high.

    Without a `slack` σ, s = 0. For a pattern with free elements F and active rows S, w_F = u_F + A_SFᵀλ, where
    (A_SF A_SFᵀ + I/σ) λ = b_S − A_S w⁰ and w⁰ is u on F and the bounds elsewhere. No admissible pattern gives less than the
    optimum, which is one of them, so the best is the solution, and no signs of multipliers need to be checked. There are
    3ᵐ 2ᶜ patterns at most.

    Args:
        u: the desired control, shape (m,).
        low: lower bounds, finite, shape (m,).
        high: upper bounds, finite, shape (m,).
        rows: the constraints' normals A, shape (c, m).
        offsets: their right-hand sides b, shape (c,).
        slack: cost σ > 0 of missing a constraint; None: none may be missed.
        tolerance: by which a row of unit length counts as met; None: 30 times the rounding unit, 4e-6 in float32.

    Returns:
        The solution, and whether there is one without slack; where not, u within its bounds. With slack there always is,
        and the second says whether each row by itself can be met.
    """
    count, size = rows.shape
    squared = jnp.sum(rows * rows, axis=-1)
    scale = jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0))  # a row of zeros has no derivative of its length
    rows, offsets = rows / scale[:, None], offsets / scale
    cost = None if slack is None else slack * scale**2
    allowed = 30.0 * float(jnp.finfo(u.dtype).eps) if tolerance is None else tolerance

    # Vectors and matrices are lists over their elements, each an array over the patterns: SIMD runs along the long axis.
    sides, actives = _patterns(size, count, soft=slack is not None)
    begin = [jnp.where(side == 0, u[k], jnp.where(side < 0, low[k], high[k])) for k, side in enumerate(sides)]
    reach = [[jnp.where(side == 0, row[k], 0.0) for k, side in enumerate(sides)] for row in rows]
    gram = [
        [jnp.where(p & q, _dot(some, row), 0.0) for row, q in zip(rows, actives, strict=True)]
        for some, p in zip(reach, actives, strict=True)
    ]
    for i, active in enumerate(actives):
        gram[i][i] = jnp.where(active, gram[i][i] + (0.0 if cost is None else 1.0 / cost[i]), 1.0)
    gap = [jnp.where(active, offsets[i] - _dot(begin, rows[i]), 0.0) for i, active in enumerate(actives)]
    multipliers, regular = _solve(gram, gap)
    w = [within(begin[k] + _dot(multipliers, [some[k] for some in reach]), low[k], high[k]) for k in range(size)]

    missing = [jnp.maximum(offsets[i] - _dot(w, rows[i]), 0.0) for i in range(count)]
    value = sum((w[k] - u[k]) ** 2 for k in range(size))
    if cost is None:
        valid = functools.reduce(jnp.logical_and, [one <= allowed for one in missing], regular)
        feasible = jnp.any(valid)
    else:
        valid, value = regular, value + sum(cost[i] * missing[i] ** 2 for i in range(count))
        feasible = jnp.all(jnp.sum(jnp.where(rows > 0.0, rows * high, rows * low), axis=-1) >= offsets)
    best = jnp.argmin(jnp.where(valid, value, jnp.inf))
    # On a bound several patterns give u itself, and the first of them holds it there; u has its own derivative.
    unaltered = jnp.all(jnp.sum(rows * u, axis=-1) >= offsets) & jnp.all((u >= low) & (u <= high))
    chosen = jnp.where(unaltered, u, jnp.stack([one[best] for one in w]))
    return jnp.where(jnp.any(valid), chosen, within(u, low, high)), feasible


def _patterns(size: int, count: int, *, soft: bool) -> tuple[np.ndarray, np.ndarray]:
    """Every element's side, −1 low, 0 free, 1 high, and every row's activity.

    At most as many rows as free elements can be active without depending on each other; with slack all can.
    """
    both = [
        (side, active)
        for side in itertools.product((-1, 0, 1), repeat=size)
        for active in itertools.product((False, True), repeat=count)
        if soft or sum(active) <= side.count(0)
    ]
    return np.array([side for side, _ in both]).T, np.array([active for _, active in both]).T


def _dot(left: Sequence[Any], right: Any) -> Any:
    return sum(a * b for a, b in zip(left, right, strict=True))


def _solve(gram: list[list[Array]], right: list[Array]) -> tuple[list[Array], Bool[Array, " p"]]:
    """Solutions of small symmetric positive systems by elimination, and which of them are regular.

    A pivot is the squared distance of a unit row from the span of those before it.
    """
    size = len(right)
    regular = jnp.ones(right[0].shape, bool)
    for i in range(size):
        regular = regular & (gram[i][i] > 100.0 * jnp.finfo(right[i].dtype).eps)
        gram[i][i] = jnp.where(regular, gram[i][i], 1.0)
        for j in range(i + 1, size):
            factor = gram[j][i] / gram[i][i]
            gram[j] = [of_j - factor * of_i for of_j, of_i in zip(gram[j], gram[i], strict=True)]
            right[j] = right[j] - factor * right[i]
    solution = list(right)
    for i in reversed(range(size)):
        known = _dot(gram[i][i + 1 :], solution[i + 1 :])
        solution[i] = (right[i] - known) / gram[i][i]
    return solution, regular
