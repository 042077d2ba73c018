"""The discrete-time algebraic Riccati equation, and the gain of a linear-quadratic regulator."""

from __future__ import annotations

import numpy as np

from jaxsafe.schema.errors import ConfigError

MAX_DOUBLINGS = 60
"""Doublings after which the iteration is given up. A dozen are usual."""


def riccati(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return the stabilising P of P = AᵀPA − AᵀPB (R + BᵀPB)⁻¹ BᵀPA + Q.

    P is computed by the structure-preserving doubling algorithm (Chu, Fan, Lin and Wang 2004). Its
    k-th iterate is the cost of 2ᵏ steps.

    Args:
        a: A of the plant x' = A x + B u, shape (n, n).
        b: B of the plant, shape (n, m).
        q: Q, the weights of the state, shape (n, n).
        r: R, the weights of the control, shape (m, m).

    Raises:
        ConfigError: the iteration does not converge, for instance because the plant cannot be
            stabilised.
    """
    identity = np.eye(len(a))
    g = b @ np.linalg.solve(r, b.T)
    p = q
    for _ in range(MAX_DOUBLINGS):
        with np.errstate(all="ignore"):
            inverse = np.linalg.solve(identity + g @ p, np.concatenate([a, g], axis=1))
            through, spread = np.split(inverse, [len(a)], axis=1)
            increase = a.T @ p @ through
            g = g + a @ spread @ a.T
            a = a @ through
            p = p + (increase + increase.T) / 2.0
        if np.abs(increase).max() <= 1e-14 * np.abs(p).max():
            return p
        if not np.isfinite(p).all():
            break
    raise ConfigError("controller: the Riccati equation has no solution for this plant")


def lqr_gain(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return K = (R + BᵀPB)⁻¹ BᵀPA, shape (m, n), with which u = −K x minimises Σ xᵀQx + uᵀRu.

    The arguments are those of `riccati`.

    Raises:
        ConfigError: the Riccati equation has no solution.
    """
    p = riccati(a, b, q, r)
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
