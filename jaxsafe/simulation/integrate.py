"""Pieces of exact integration: ratios of sines without cancellation, ramps that stop at a limit, Gauss-Legendre nodes."""

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
"""Their weights."""

PARTIAL_WEIGHTS = np.linalg.solve(
    np.vander(NODES, increasing=True).T, (np.array(NODES)[:, None] ** [1, 2, 3] / [1, 2, 3]).T
).T.tolist()
"""Weights of the integrals from 0 to each node, one list a node."""


def ramp(x: Number, rate: Number | None, limits: Float[Array, " 2"], t: Number) -> Any:
    """A state that its rate moves until it rests on a limit: clip(x + rate·t, low, high); x where the rate is None."""
    return x if rate is None else jnp.clip(x + rate * t, limits[0], limits[1])


def time_to_limit(x: Number, rate: Number, limits: Float[Array, " 2"], dt: Number) -> Any:
    """Time in [0, dt] at which the ramp comes to rest on a limit; dt if it does not.

    Integrals over a ramp are split here because its rate jumps. They do not change with the place of the split, as the
    ramp itself is continuous; so it has no derivative, and rates near 0 do no harm.
    """
    to_go = jnp.where(rate > 0.0, limits[1], limits[0]) - x
    crossing = jnp.abs(rate) * dt > jnp.abs(to_go)
    time = jnp.where(crossing, to_go / jnp.where(crossing, rate, 1.0), dt)
    return jax.lax.stop_gradient(jnp.clip(time, 0.0, dt))


def pieces(stops: Sequence[Any], dt: Number) -> tuple[Float[Array, " s"], Float[Array, " s"]]:
    """Begin and length of the pieces of a step between the times at which something stops: `len(stops) + 1` of them."""
    bounds = [jnp.zeros_like(dt), *ascending(stops), dt]
    return jnp.stack(bounds[:-1]), jnp.stack([end - begin for begin, end in itertools.pairwise(bounds)])


def ascending(values: Sequence[Any]) -> list[Any]:
    """Sorted by exchanges: under `vmap` several times cheaper than a sort in every lane."""
    values = list(values)
    for last in range(len(values) - 1, 0, -1):
        for i in range(last):
            values[i : i + 2] = jnp.minimum(values[i], values[i + 1]), jnp.maximum(values[i], values[i + 1])
    return values


def sine_ratios(tau: Number) -> tuple[Any, Any, Any]:
    """The ratios sin τ/τ, (1 − cos τ)/τ² and (τ − sin τ)/τ³, smooth through τ = 0."""
    s3, half = _sine_remainder(tau), tau / 2.0
    return 1.0 - tau**2 * s3, 0.5 * (1.0 - half**2 * _sine_remainder(half)) ** 2, s3


def _sine_remainder(tau: Number) -> Any:
    """(τ − sin τ)/τ³; a series where |τ| < 1, where quotients, `jnp.sinc` too, lose the digits of their derivative."""
    small = jnp.abs(tau) < 1.0
    squared, series = jnp.where(small, tau, 0.0) ** 2, 0.0
    for k in reversed(range(9)):
        series = series * squared + (-1) ** k / math.factorial(2 * k + 3)
    large = jnp.where(small, 1.0, tau)
    return jnp.where(small, series, (large - sin_cos(large)[0]) / large**3)
