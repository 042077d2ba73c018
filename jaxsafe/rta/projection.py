"""Nearest controls in closed form, in a box with one half-space and in a box with one ball.

The cost is fixed and the derivatives are exact.

Both minimisers lie on a path that bends only where an element of the control reaches a bound. The
reason is that the Lagrangian separates over the elements: for a multiplier λ each element is the
clip of its own minimiser. Along the path the constraint changes monotonically. Its values at the
bends tell on which piece of the path it is met first. On that piece the constraint is one scalar
equation.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.simulation.integrate import ascending
from jaxsafe.types import Number


def project_box_halfspace(
    u: Float[Array, " m"],
    low: Float[Array, " m"],
    high: Float[Array, " m"],
    a: Float[Array, " m"],
    b: Number,
) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
    """Return the nearest point argmin ‖w − u‖² subject to a·w ≥ b and low ≤ w ≤ high.

    With a multiplier λ ≥ 0 of the half-space the minimiser is w(λ) = clip(u + λa, low, high), and
    a·w(λ) does not decrease with λ.

    Args:
        u: the point to project, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        a: normal of the half-space, shape (m,).
        b: offset of the half-space.

    Returns:
        The projection and whether it exists. If it does not, the first is the point of the box that
        comes closest to the half-space.
    """
    slope = jnp.where(a != 0.0, a, 1.0)
    bends = [jnp.where(a != 0.0, (bound - u) / slope, 0.0) for bound in (low, high)]
    bends = ascending([jnp.zeros_like(u[0]), *jnp.maximum(jnp.concatenate(bends), 0.0)])
    values = [jnp.sum(a * jnp.clip(u + bend * a, low, high)) for bend in bends]

    before, after = _piece(bends, [value >= b for value in values])
    moving = u + (after + before) / 2.0 * a
    free = (moving > low) & (moving < high)
    fixed = jnp.sum(jnp.where(free, 0.0, a * jnp.clip(moving, low, high)))
    curvature = jnp.sum(jnp.where(free, a * a, 0.0))
    step = (b - fixed - jnp.sum(jnp.where(free, a * u, 0.0))) / jnp.where(
        curvature > 0.0, curvature, 1.0
    )

    met = values[0] >= b
    feasible = values[-1] >= b
    multiplier = jnp.where(met, 0.0, jnp.where(feasible, step, bends[-1]))
    return within(u + multiplier * a, low, high), feasible


def project_box_ball(
    u: Float[Array, " m"],
    low: Float[Array, " m"],
    high: Float[Array, " m"],
    beta: Number,
    p: Float[Array, " m"],
    k: Number,
) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
    """Return the nearest point argmin ‖w − u‖² subject to q(w) ≤ 0 and low ≤ w ≤ high.

    The ball is q(w) = β‖w‖² + 2p·w + k ≤ 0, with the centre c = −p/β. With a multiplier λ ≥ 0 the
    minimiser is w(t) = clip(u + t(c − u), low, high), where t = λβ/(1 + λβ) is in [0, 1], and
    q(w(t)) does not increase with t.

    Args:
        u: the point to project, within the box, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        beta: coefficient of ‖w‖², positive.
        p: half the linear coefficients, shape (m,).
        k: the constant.

    Returns:
        The projection and whether it exists. If it does not, the first is the point of the box
        nearest to the ball's centre.
    """
    towards = -p / beta - u
    bound = jnp.where(towards > 0.0, high, low)
    moves = towards != 0.0
    times = jnp.clip(jnp.where(moves, (bound - u) / jnp.where(moves, towards, 1.0), 1.0), 0.0, 1.0)
    bends = [jnp.zeros_like(u[0]), *ascending(list(times)), jnp.ones_like(u[0])]
    values = [_quadratic(jnp.clip(u + bend * towards, low, high), beta, p, k) for bend in bends]

    before, after = _piece(bends, [value <= 0.0 for value in values])
    free = times > (after + before) / 2.0
    resting = jnp.where(free, u, jnp.clip(bound, low, high))
    rate = jnp.where(free, towards, 0.0)
    c2 = beta * jnp.sum(rate * rate)  # q = c2 t² + 2 c1 t + c0 on this piece
    c1 = jnp.sum(rate * (beta * resting + p))
    c0 = _quadratic(resting, beta, p, k)
    root = c1 * c1 - c2 * c0
    root = jnp.where(root > 0.0, jnp.sqrt(jnp.where(root > 0.0, root, 1.0)), 0.0)
    divisor = root - c1
    t = c0 / jnp.where(divisor > 0.0, divisor, 1.0)

    met = values[0] <= 0.0
    feasible = values[-1] <= 0.0
    t = jnp.where(met, 0.0, jnp.where(feasible, jnp.clip(t, before, after), 1.0))
    return within(u + t * towards, low, high), feasible


def within(
    control: Float[Array, " m"], low: Float[Array, " m"], high: Float[Array, " m"]
) -> Float[Array, " m"]:
    """Return the control within its bounds.

    On a bound the control keeps its derivative. `jnp.clip` would take half of it away.
    """
    return jnp.where(control < low, low, jnp.where(control > high, high, control))


def _piece(bends: Sequence[Array], met: Sequence[Array]) -> tuple[Array, Array]:
    """Return the last bend before the constraint is met and the first bend where it is met.

    Both are the first bend if the constraint is never met.
    """
    before = bends[0]
    after = bends[0]
    for i in reversed(range(len(bends))):
        after = jnp.where(met[i], bends[i], after)
        before = jnp.where(met[i], bends[max(i - 1, 0)], before)
    return before, after


def _quadratic(
    w: Float[Array, "*n m"], beta: Number, p: Float[Array, " m"], k: Number
) -> Float[Array, "*n"]:
    return beta * jnp.sum(w * w, axis=-1) + 2.0 * jnp.sum(p * w, axis=-1) + k
