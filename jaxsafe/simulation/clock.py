"""Comparison of times that are whole numbers of time steps.

50 steps of 0.3 s take 15 s, although in float32 the product 50 × 0.3 is not equal to 15. Times are
therefore compared with a tolerance.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxsafe.types import Number

TOLERANCE_IN_ROUNDINGS = 4
"""Times that differ by at most this many rounding errors are equal.

Two errors are in the product of the number of steps and dt, one is in the limit, and one is spare.
"""


def later(time: Number, limit: Number) -> Bool[Array, "*shape"]:
    """Return whether a time ≥ 0 is after a limit. A time equal to the limit is not."""
    return time > limit * (1.0 + _relative_tolerance(limit))


def reached(time: Number, limit: Number) -> Bool[Array, "*shape"]:
    """Return whether a time ≥ 0 is at a limit or after it."""
    return time >= limit * (1.0 - _relative_tolerance(limit))


def _relative_tolerance(limit: Number) -> float:
    return TOLERANCE_IN_ROUNDINGS * float(jnp.finfo(jnp.result_type(limit, float)).eps)
