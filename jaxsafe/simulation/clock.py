"""Comparing times that are whole numbers of time steps: 50 × 0.3 s are 15 s, although their floats are not equal."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxsafe.types import Number

ROUNDINGS = 4
"""Times that differ by so many roundings are equal: two are in the count times dt, one is in the limit, one is spare."""


def later(time: Number, limit: Number) -> Bool[Array, "*shape"]:
    """Return whether a time ≥ 0 is after a limit, and not at it."""
    return time > limit * (1.0 + _tolerance(limit))


def reached(time: Number, limit: Number) -> Bool[Array, "*shape"]:
    """Return whether a time ≥ 0 is at a limit or after it."""
    return time >= limit * (1.0 - _tolerance(limit))


def _tolerance(limit: Number) -> float:
    return ROUNDINGS * float(jnp.finfo(jnp.result_type(limit, float)).eps)
