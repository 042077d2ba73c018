"""Building blocks of exact integration.

They are ratios of sines without cancellation, ramps that stop at a limit, and Gauss-Legendre nodes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.simulation.trig import sin_cos
from jaxsafe.types import Number

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)
NODES = ((_NODES + 1.0) / 2.0).tolist()
"""Gauss-Legendre nodes of the unit interval, order 6."""

WEIGHTS = (_WEIGHTS / 2.0).tolist()
"""Weights of the Gauss-Legendre nodes."""

PARTIAL_WEIGHTS = np.linalg.solve(
    np.vander(NODES, increasing=True).T, (np.array(NODES)[:, None] ** [1, 2, 3] / [1, 2, 3]).T
).T.tolist()
"""Weights of the integrals from 0 to each Gauss-Legendre node, one list per node."""


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


def pieces(stops: Sequence[Any], dt: Number) -> tuple[Float[Array, " s"], Float[Array, " s"]]:
    """Return begin and length [s] of the pieces of a step, each of shape (len(stops) + 1,).

    Args:
        stops: times [s] at which one piece ends and the next one begins, in any order.
        dt: length of the step [s].
    """
    bounds = [jnp.zeros_like(dt), *ascending(stops), dt]
    return jnp.stack(bounds[:-1]), jnp.stack(
        [end - begin for begin, end in itertools.pairwise(bounds)]
    )


def ascending(values: Sequence[Any]) -> list[Any]:
    """Return the values in ascending order.

    They are sorted by exchanges, which under `vmap` is several times cheaper than a sort in every
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

    It is a series where |τ| < 1. There the derivative of a quotient would lose its digits, also
    that of `jnp.sinc`.
    """
    small = jnp.abs(tau) < 1.0
    squared = jnp.where(small, tau, 0.0) ** 2
    series = 0.0
    for k in reversed(range(9)):
        series = series * squared + (-1) ** k / math.factorial(2 * k + 3)
    large = jnp.where(small, 1.0, tau)
    return jnp.where(small, series, (large - sin_cos(large)[0]) / large**3)
