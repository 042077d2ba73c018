"""The exact nearest control within bounds and under a few linear constraints.

Each element of the control is free or rests on one of its bounds, and each constraint is active or
not. For a few of both there are few such patterns. All patterns are solved side by side, by
elimination of as many unknowns as there are constraints. So the cost is fixed, nothing is iterated
from a starting point, and the derivative is that of the active set.
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
from jaxsafe.types import Number, Record

ROUNDINGS_MISSED = 30.0
"""By how many rounding units a row of unit length may be missed and still count as met.

In float32 that is 4e-6.
"""


class Solution(Record):
    """The nearest control, and what is known of it."""

    control: Float[Array, " m"]
    solved: Bool[Array, ""]  # whether some control meets all rows without slack
    feasible: Bool[Array, ""]  # whether also each row with slack can be met by itself
    # How far each row of unit length moves the nearest control. 0 where a row is not active.
    multipliers: Float[Array, " c"]


def nearest_solution(
    u: Float[Array, " m"],
    low: Float[Array, " m"],
    high: Float[Array, " m"],
    rows: Float[Array, "c m"],
    offsets: Float[Array, " c"],
    slack: Number | Sequence[Number | None] | None = None,
) -> Solution:
    """Return the nearest control argmin ‖w − u‖² + Σ σ s².

    It is subject to rows·w + s ≥ offsets, s ≥ 0 and low ≤ w ≤ high. A row without a `slack` σ has
    s = 0.

    For a pattern with free elements F and active rows S the solution is w_F = u_F + A_SFᵀλ, where
    (A_SF A_SFᵀ + I/σ) λ = b_S − A_S w⁰, and w⁰ is u on F and the bounds elsewhere. The optimum is
    the solution of one of the patterns, and no admissible pattern gives less. So the best pattern
    is the solution, and no signs of multipliers need to be checked. There are 3ᵐ 2ᶜ patterns at
    most.

    Args:
        u: the desired control, shape (m,).
        low: lower bounds, finite, shape (m,).
        high: upper bounds, finite, shape (m,).
        rows: normals A of the constraints, shape (c, m).
        offsets: right-hand sides b of the constraints, shape (c,).
        slack: cost σ > 0 of missing a constraint, one for all rows or one for each. A row with None
            may not be missed.

    Returns:
        The solution. If there is none, its control is u within its bounds.
    """
    count, size = rows.shape
    slacks = list(slack) if isinstance(slack, Sequence) else [slack] * count
    squared = jnp.sum(rows * rows, axis=-1)
    # The length of a row of zeros has no derivative, so 1 takes its place.
    scale = jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0))
    rows = rows / scale[:, None]
    offsets = offsets / scale
    costs = [None if sigma is None else sigma * scale[i] ** 2 for i, sigma in enumerate(slacks)]
    soft = [cost is not None for cost in costs]
    allowed = ROUNDINGS_MISSED * float(jnp.finfo(u.dtype).eps)

    # Vectors and matrices are lists of their elements. Each element is an array over the patterns,
    # because SIMD runs along the long axis.
    sides, actives = _patterns(size, soft)
    w0 = [
        jnp.where(side == 0, u[k], jnp.where(side < 0, low[k], high[k]))
        for k, side in enumerate(sides)
    ]
    free_rows = [
        [jnp.where(side == 0, row[k], 0.0) for k, side in enumerate(sides)] for row in rows
    ]
    gram = [
        [
            jnp.where(active & other_active, _dot(free_row, row), 0.0)
            for row, other_active in zip(rows, actives, strict=True)
        ]
        for free_row, active in zip(free_rows, actives, strict=True)
    ]
    for i, active in enumerate(actives):
        cost = costs[i]
        softening = 0.0 if cost is None else 1.0 / cost
        gram[i][i] = jnp.where(active, gram[i][i] + softening, 1.0)
    gap = [
        jnp.where(active, offsets[i] - _dot(w0, rows[i]), 0.0) for i, active in enumerate(actives)
    ]
    multipliers, regular = _solve(gram, gap)
    w = [
        within(w0[k] + _dot(multipliers, [row[k] for row in free_rows]), low[k], high[k])
        for k in range(size)
    ]

    missing = [jnp.maximum(offsets[i] - _dot(w, rows[i]), 0.0) for i in range(count)]
    value = sum((w[k] - u[k]) ** 2 for k in range(size))
    met = [amount <= allowed for amount, is_soft in zip(missing, soft, strict=True) if not is_soft]
    valid = functools.reduce(jnp.logical_and, met, regular)
    solved = jnp.any(valid)
    feasible = solved
    if any(soft):
        paid = zip(costs, missing, strict=True)
        value = value + sum(cost * amount**2 for cost, amount in paid if cost is not None)
        highest = jnp.sum(jnp.where(rows > 0.0, rows * high, rows * low), axis=-1)
        reached = jnp.all((highest >= offsets) | ~np.array(soft))
        feasible = reached if all(soft) else reached & solved
    best = jnp.argmin(jnp.where(valid, value, jnp.inf))
    # If u is on a bound, several patterns give u itself. The first of them holds it on the bound
    # and so has no derivative there. Therefore u is taken with its own derivative.
    unaltered = jnp.all(jnp.sum(rows * u, axis=-1) >= offsets) & jnp.all((u >= low) & (u <= high))
    chosen = jnp.where(unaltered, u, jnp.stack([element[best] for element in w]))
    largest = jnp.stack([multiplier[best] for multiplier in multipliers])
    return Solution(
        control=jnp.where(solved, chosen, within(u, low, high)),
        solved=solved,
        feasible=feasible,
        multipliers=jnp.where(unaltered | ~solved, 0.0, largest),
    )


def _patterns(size: int, soft: Sequence[bool]) -> tuple[np.ndarray, np.ndarray]:
    """Return for each pattern the side of every element and whether each row is active.

    A side is −1 for the low bound, 0 for a free element and 1 for the high bound. If more rows
    without slack are active than elements are free, the rows depend on each other, so such patterns
    are left out. Rows with slack (`soft`) may all be active.

    Returns:
        Sides of shape (size, patterns) and activity of shape (count, patterns).
    """
    patterns = [
        (side, active)
        for side in itertools.product((-1, 0, 1), repeat=size)
        for active in itertools.product((False, True), repeat=len(soft))
        if sum(on and not is_soft for on, is_soft in zip(active, soft, strict=True))
        <= side.count(0)
    ]
    sides = np.array([side for side, _ in patterns]).T
    actives = np.array([active for _, active in patterns]).T
    return sides, actives


def _dot(left: Sequence[Any], right: Any) -> Any:
    return sum(a * b for a, b in zip(left, right, strict=True))


def _solve(gram: list[list[Array]], right: list[Array]) -> tuple[list[Array], Bool[Array, " p"]]:
    """Return the solutions of small symmetric positive systems and which of them are regular.

    They are solved by elimination. A pivot is the squared distance of a unit row from the span of
    the rows before it, so a small pivot means that the rows depend on each other.
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
