"""Building blocks of exact integration.

They are ratios of sines without cancellation, ramps that stop at a limit, first-order lags, and
Gauss-Legendre nodes. Where no exact solution is known, there are Runge-Kutta steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.simulation.trig import sin_cos
from jaxsafe.types import Number

T = TypeVar("T")

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)
NODES = ((_NODES + 1.0) / 2.0).tolist()
"""Gauss-Legendre nodes of the unit interval, order 6."""

WEIGHTS = (_WEIGHTS / 2.0).tolist()
"""Weights of the Gauss-Legendre nodes."""

PARTIAL_WEIGHTS = np.linalg.solve(
    np.vander(NODES, increasing=True).T, (np.array(NODES)[:, None] ** [1, 2, 3] / [1, 2, 3]).T
).T.tolist()
"""Weights of the integrals from 0 to each Gauss-Legendre node, one list per node."""

AHEAD = (0.0, 1 / 2, 1 / 2, 1.0)
"""Times of the stages of the classical Runge-Kutta method, in lengths of a step."""

STAGE_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
"""Weights of the stages of the classical Runge-Kutta method."""


def ramp(x: Number, rate: Number | None, limits: Float[Array, " 2"], t: Number) -> Any:
    """Return clip(x + rate·t, low, high): a state that its rate moves until it rests on a limit.

    Without a rate the state is returned as it is, even if it is beyond a limit.

    Args:
        x: the state at time 0.
        rate: its rate of change per second, or None.
        limits: lowest and highest state.
        t: time [s].
    """
    return x if rate is None else jnp.clip(x + rate * t, limits[0], limits[1])


def time_to_limit(x: Number, rate: Number, limits: Float[Array, " 2"], dt: Number) -> Any:
    """Return the time in [0, dt] at which a ramp comes to rest on a limit, or dt if it does not.

    Integrals over a ramp are split at this time, because the rate jumps there. The ramp itself is
    continuous, so its integrals do not change with the time of the split. The time therefore has no
    derivative, and rates near 0 do no harm.

    Args:
        x: the state at time 0.
        rate: its rate of change per second.
        limits: lowest and highest state.
        dt: length of the step [s].
    """
    to_go = jnp.where(rate > 0.0, limits[1], limits[0]) - x
    crossing = jnp.abs(rate) * dt > jnp.abs(to_go)
    time = jnp.where(crossing, to_go / jnp.where(crossing, rate, 1.0), dt)
    return jax.lax.stop_gradient(jnp.clip(time, 0.0, dt))


def lagged(x: Number, target: Number, time_constant: Number, t: Number) -> Any:
    """Return the value at time t of what follows a target with first-order lag, τẋ = target − x.

    Args:
        x: the value at time 0.
        target: the constant target.
        time_constant: τ [s].
        t: time [s].
    """
    return target + (x - target) * jnp.exp(-t / time_constant)


def lagged_integral(x: Number, target: Number, time_constant: Number, t: Number) -> Any:
    """Return the integral of `lagged` from 0 to t."""
    return target * t - (x - target) * time_constant * jnp.expm1(-t / time_constant)


def lag_within_rate(
    x: Number, target: Number, time_constant: Number | None, rate_limit: Number | None, dt: Number
) -> tuple[Any, Any]:
    """Return the mean over a step of a value that follows a target, and the value at its end.

    The value x follows the target u by ẋ = clip((u − x)/τ, ±R). The solution is exact: a ramp as
    long as R limits the rate, and an exponential afterwards. Without a time constant τ the ramp
    leads to the target, where the value then rests.

    Args:
        x: the value at the beginning.
        target: the constant target u.
        time_constant: τ [s], or None.
        rate_limit: R per second, or None.
        dt: length of the step [s].
    """
    total = jnp.zeros_like(dt)
    remaining = dt
    if rate_limit is not None:
        gap = target - x
        # Within this distance of the target the lag alone is slower than the rate limit.
        lag_distance = 0.0 if time_constant is None else rate_limit * time_constant
        ramped = jnp.clip(jnp.abs(gap) - lag_distance, 0.0, rate_limit * dt)
        time = ramped / rate_limit
        total = time * (x + 0.5 * jnp.sign(gap) * ramped)
        x = jnp.where(ramped >= jnp.abs(gap), target, x + jnp.sign(gap) * ramped)
        remaining = dt - time
    if time_constant is None:
        return (total + remaining * x) / dt, x
    total = total + lagged_integral(x, target, time_constant, remaining)
    return total / dt, lagged(x, target, time_constant, remaining)


def turning_time(rate: Number, target: Number, time_constant: Number) -> Any:
    """Return the time [s] at which a rate that follows a target with a lag is 0.

    It is infinite if the rate never changes its sign. Like `time_to_limit` it has no derivative.

    Args:
        rate: the rate at time 0.
        target: the constant target.
        time_constant: time constant of the lag [s].
    """
    turns = rate * target < 0.0
    quotient = jnp.where(turns, -rate / jnp.where(turns, target, 1.0), 0.0)
    time = jnp.where(turns, time_constant * jnp.log1p(quotient), jnp.inf)
    return jax.lax.stop_gradient(time)


def lagged_ramp(
    x: Number,
    rate: Number,
    target: Number,
    time_constant: Number,
    turning: Number,
    limits: Float[Array, " 2"],
    t: Number,
) -> Any:
    """Return a state whose rate follows a target with a first-order lag, and which has limits.

    At a limit the state rests until its rate turns inwards. The rate changes its sign once at most.
    So it is known by how much the state would exceed a limit, and the solution is exact.

    Args:
        x: the state at time 0, within the limits.
        rate: its rate of change at time 0.
        target: the constant rate that the rate follows.
        time_constant: time constant of the lag [s].
        turning: the `turning_time` of the rate [s].
        limits: lowest and highest state.
        t: time [s].
    """
    free = x + lagged_integral(rate, target, time_constant, t)
    before = jnp.minimum(t, turning)
    extreme = x + lagged_integral(rate, target, time_constant, before)
    excess = extreme - jnp.clip(extreme, limits[0], limits[1])
    return jnp.clip(free - excess, limits[0], limits[1])


def runge_kutta(
    derivative: Callable[[T], T],
    state: T,
    dt: Number,
    substeps: int,
    limit: Callable[[T], T] = lambda state: state,
) -> T:
    """Return the state after `dt` seconds by Runge-Kutta steps of order 4, all of one length.

    Args:
        derivative: returns the time derivative of a state, as a tree of the same structure.
        state: the state at time 0, a tree of numbers.
        dt: length of the step [s].
        substeps: the number of Runge-Kutta steps.
        limit: returns a state brought back into its limits. It is applied after each of these
            steps.
    """
    h = jnp.asarray(dt) / substeps
    split, join = _in_scalars(state)

    # The stages are a loop over single numbers. Without a loop XLA would compute a stage again for
    # each use of it. With vectors it would interleave their elements in a batch.
    def one_step(numbers: list[Array]) -> list[Array]:
        def one_stage(
            carry: tuple[list[Array], list[Array]], stage: tuple[Array, Array]
        ) -> tuple[tuple[list[Array], list[Array]], None]:
            slopes, totals = carry
            ahead, weight = stage
            now = [x + ahead * slope for x, slope in zip(numbers, slopes, strict=True)]
            slopes = split(derivative(join(now)))
            totals = [total + weight * slope for total, slope in zip(totals, slopes, strict=True)]
            return (slopes, totals), None

        still = [jnp.zeros_like(number) for number in numbers]
        stages = (h * jnp.asarray(AHEAD, h.dtype), h * jnp.asarray(STAGE_WEIGHTS, h.dtype))
        (_, totals), _ = jax.lax.scan(one_stage, (still, numbers), stages)
        return split(limit(join(totals)))

    numbers = split(state)
    if substeps == 1:
        return join(one_step(numbers))
    return join(jax.lax.scan(lambda x, _: (one_step(x), None), numbers, length=substeps)[0])


def _in_scalars(tree: T) -> tuple[Callable[[T], list[Array]], Callable[[list[Array]], T]]:
    """Return two functions: from a tree like this one to a list of its numbers, and back."""
    leaves, structure = jax.tree.flatten(tree)
    shapes = [jnp.shape(leaf) for leaf in leaves]
    ends = np.cumsum([math.prod(shape) for shape in shapes])

    def split(tree: T) -> list[Array]:
        return [number for leaf in jax.tree.leaves(tree) for number in jnp.ravel(leaf)]

    def join(numbers: list[Array]) -> T:
        parts = [
            jnp.stack(numbers[end - math.prod(shape) : end]).reshape(shape)
            for shape, end in zip(shapes, ends, strict=True)
        ]
        return jax.tree.unflatten(structure, parts)

    return split, join


def through_pieces(
    fly: Callable[[T, Number, Number], T], start: T, stops: Sequence[Any], dt: Number
) -> T:
    """Return the state after all pieces of a step, one after another.

    The pieces are a loop over single numbers. Without a loop XLA would compute a piece again for
    each use of it. From stacked times it would compute one number at a time.

    Args:
        fly: returns the state after a piece, given the state before it, and the beginning and the
            length of the piece [s].
        start: the state at time 0, a tree of numbers.
        stops: times [s] at which one piece ends and the next one begins, in any order.
        dt: length of the step [s].
    """

    def one_piece(carry: tuple[list[Any], T], _: None) -> tuple[tuple[list[Any], T], None]:
        (begin, end, *later), state = carry
        return ([end, *later, dt], fly(state, begin, end - begin)), None

    bounds = [jnp.zeros_like(dt), *ascending(stops), dt]
    (_, state), _ = jax.lax.scan(one_piece, (bounds, start), length=len(stops) + 1)
    return state


def ascending(values: Sequence[Any]) -> list[Any]:
    """Return the values in ascending order.

    They are sorted by exchanges. Under `vmap` this is several times cheaper than a sort in every
    environment.
    """
    values = list(values)
    for last in range(len(values) - 1, 0, -1):
        for i in range(last):
            values[i : i + 2] = (
                jnp.minimum(values[i], values[i + 1]),
                jnp.maximum(values[i], values[i + 1]),
            )
    return values


def sine_ratios(tau: Number) -> tuple[Any, Any, Any]:
    """Return sin τ/τ, (1 − cos τ)/τ² and (τ − sin τ)/τ³, which are smooth through τ = 0."""
    s3 = _sine_remainder(tau)
    half = tau / 2.0
    return 1.0 - tau**2 * s3, 0.5 * (1.0 - half**2 * _sine_remainder(half)) ** 2, s3


def _sine_remainder(tau: Number) -> Any:
    """Return (τ − sin τ)/τ³.

    Where |τ| < 1 it is a series, because the derivative of a quotient would lose its digits there.
    So does the derivative of `jnp.sinc`.
    """
    small = jnp.abs(tau) < 1.0
    squared = jnp.where(small, tau, 0.0) ** 2
    series = 0.0
    for k in reversed(range(9)):
        series = series * squared + (-1) ** k / math.factorial(2 * k + 3)
    large = jnp.where(small, 1.0, tau)
    return jnp.where(small, series, (large - sin_cos(large)[0]) / large**3)
