"""Norms with safe gradients, directions and rotations, and checks of vectors that a user gives."""

from __future__ import annotations

import functools
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.schema.component import Unit
from jaxsafe.simulation.trig import sin_cos
from jaxsafe.types import Number, Place, Reach


def dot(
    first: Float[Array, "*batch d"], second: Float[Array, "*batch d"]
) -> Float[Array, "*batch"]:
    """Return the scalar product of two vectors.

    The sum is written out, because a reduction keeps XLA from working on many vectors at a time.
    """
    products = first * second
    terms = [jax.lax.index_in_dim(products, i, -1, keepdims=False) for i in range(first.shape[-1])]
    return functools.reduce(jnp.add, terms)


def safe_norm(vector: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    """Return the Euclidean norm ‖v‖, whose gradient at v = 0 is 0 instead of NaN."""
    return safe_root(dot(vector, vector))


def safe_root(squared: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the root of a squared norm, whose gradient at 0 is 0 instead of infinite.

    The function uses two `where`. The root must not see 0 even in the branch that is not taken,
    because `where` would multiply the infinite derivative of that branch by zero.
    """
    zero = squared == 0.0  # false for NaN, so that NaN stays NaN
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def closest_approach(before: Float[Array, " d"], after: Float[Array, " d"]) -> Float[Array, ""]:
    """Return the smallest norm on the straight line between two vectors."""
    change = after - before
    squared = dot(change, change)
    share = jnp.clip(-dot(before, change) / jnp.where(squared > 0.0, squared, 1.0), 0.0, 1.0)
    return safe_norm(before + share * change)


def mag_norm(vector: Float[Array, " d"]) -> Float[Array, " d+1"]:
    """Return magnitude and direction [‖v‖, v/‖v‖], Eq. (21).

    At v = 0, which has no direction, all elements are 0.
    """
    magnitude = safe_norm(vector)
    return jnp.concatenate([magnitude[None], vector / jnp.where(magnitude > 0.0, magnitude, 1.0)])


def direction(
    azimuth: Float[Array, "*n"], polar: Float[Array, "*n"] | None = None
) -> Float[Array, "*n d"]:
    """Return the unit vector of an azimuth and, in space, a polar angle.

    Args:
        azimuth: angle from the x axis towards the y axis [rad].
        polar: angle from the z axis [rad]. None gives a vector in the plane.
    """
    y, x = sin_cos(azimuth)
    if polar is None:
        return jnp.stack([x, y], axis=-1)
    level, z = sin_cos(polar)
    return jnp.stack([level * x, level * y, z], axis=-1)


def rotation(
    yaw: Float[Array, "*n"], pitch: Number | None = None, roll: Number | None = None
) -> Float[Array, "*n d d"]:
    """Return the rotation matrix from a body frame to the global frame.

    In space it is R_z(ψ)·R_y(γ)·R_x(φ), in ZYX Euler angles. Its first column, the body's x axis,
    is (cos ψ cos γ, sin ψ cos γ, −sin γ). In the plane it is the 2 × 2 matrix of R_z(ψ).

    Args:
        yaw: ψ [rad].
        pitch: γ [rad]. None gives the matrix in the plane.
        roll: φ [rad]. None gives the matrix in the plane.
    """
    s, c = sin_cos(yaw)
    if pitch is None or roll is None:
        return jnp.stack([jnp.stack([c, -s], axis=-1), jnp.stack([s, c], axis=-1)], axis=-2)
    sp, cp = sin_cos(pitch)
    sr, cr = sin_cos(roll)
    rows = [
        [c * cp, c * sp * sr - s * cr, c * sp * cr + s * sr],
        [s * cp, s * sp * sr + c * cr, s * sp * cr - c * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def to_body(orientation: Float[Array, "d d"], vector: Float[Array, " d"]) -> Float[Array, " d"]:
    """Return the components of a vector in the body frame, Rᵀv.

    Args:
        orientation: R, the rotation from the body frame to the global frame, shape (d, d).
        vector: v in the global frame, shape (d,).

    Raises:
        ValueError: the shapes do not match.
    """
    if vector.shape != orientation.shape[:1]:
        raise ValueError(
            f"expected a vector of {orientation.shape[0]} components to turn,"
            f" found shape {vector.shape}"
        )
    # The sums are written out for two reasons. Accelerators may compute a matrix product in reduced
    # precision, and a reduction keeps XLA from working on many vectors at a time.
    return functools.reduce(
        jnp.add, [row * element for row, element in zip(orientation, vector, strict=True)]
    )


def to_global(orientation: Float[Array, "d d"], vector: Float[Array, " d"]) -> Float[Array, " d"]:
    """Return a vector of the body frame in the global frame, Rv.

    Args:
        orientation: R, the rotation from the body frame to the global frame, shape (d, d).
        vector: v in the body frame, shape (d,).
    """
    return to_body(jnp.swapaxes(orientation, -1, -2), vector)


def turn_between(before: Float[Array, "d d"], after: Float[Array, "d d"]) -> Float[Array, ""]:
    """Return the angle between two orientations [rad], from 0 to π."""
    half_sine = safe_norm(jnp.ravel(after - before)) / (2.0 * 2.0**0.5)
    return 2.0 * jnp.arcsin(jnp.minimum(half_sine, 1.0))


def angle_between(first: Float[Array, " d"], second: Float[Array, " d"]) -> Float[Array, ""]:
    """Return the angle between two vectors [rad], from 0 to π.

    It is 0 if one of the vectors is 0 and so has no direction. Its gradient is finite everywhere.
    """
    first = mag_norm(first)[1:]
    second = mag_norm(second)[1:]
    defined = jnp.any(first != 0.0) & jnp.any(second != 0.0)
    cosine = dot(first, second)
    sine = safe_norm(second - cosine * first)
    return jnp.arctan2(jnp.where(defined, sine, 0.0), jnp.where(defined, cosine, 1.0))


Coordinates = Annotated[Number, Unit("m or ft", length=0), Place]
"""A vector of lengths, one number for each dimension of space."""

Sizes = Annotated[Number, Unit("m or ft", length=0), Reach]
"""Lengths that are not negative, one for each dimension of space."""

Heading = Annotated[Number, Unit("1", length=0), Place]
"""A vector that is not 0, one number for each dimension. Only its direction counts."""


def no_direction(vector: Float[Array, " d"], name: str) -> str | None:
    """Return what is wrong with a vector that must have a direction, or None if nothing is."""
    return None if np.any(np.asarray(vector) != 0.0) else f"expected a `{name}` other than 0"


def wrong_size(env: Any, **vectors: Float[Array, " d"]) -> dict[str, str]:
    """Return what is wrong with each vector that lacks one number per dimension, by its name."""
    space = env.agent_platform.dimension
    return {
        name: f"expected {space} numbers, found {vector.size}"
        for name, vector in vectors.items()
        if vector.size != space
    }
