"""Norms with safe gradients, directions, rotations, and regions.

Regions are described in Section 4 and in Tables 3 and 4.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.schema.component import Component, Unit
from jaxsafe.simulation.trig import sin_cos
from jaxsafe.types import Length, Number, Place, PlatformName, Radians, Reach, RegionState, Turn


def safe_norm(vector: Float[Array, "*batch d"]) -> Float[Array, "*batch"]:
    """Return the Euclidean norm ‖v‖, whose gradient at v = 0 is 0 instead of NaN.

    The function uses two `where`. The root must not see 0 even in the branch that is not taken,
    because `where` multiplies that branch's infinite derivative by zero.
    """
    squared = jnp.sum(vector * vector, axis=-1)
    zero = squared == 0.0  # false for NaN, so that NaN stays NaN
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def closest_approach(before: Float[Array, " d"], after: Float[Array, " d"]) -> Float[Array, ""]:
    """Return the smallest norm on the straight line between two vectors."""
    change = after - before
    squared = jnp.sum(change * change)
    share = jnp.clip(-jnp.sum(before * change) / jnp.where(squared > 0.0, squared, 1.0), 0.0, 1.0)
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


class Offset(Component):
    """Position of a region's centre relative to the platform that carries the region."""

    def vector(self, platform: Any) -> Float[Array, " d"]:
        """Return the offset in the global frame, given the platform's state."""
        raise NotImplementedError


class Aspect(Offset, type="aspect"):
    """Offset ρ (cos(ψ + π + θ), sin(ψ + π + θ)), Eq. (6), behind a platform with heading ψ.

    θ is the angle from the platform's tail. The offset turns with the platform.
    """

    distance: Annotated[Length, Reach]
    angle: Annotated[Radians, Turn]

    def vector(self, platform: Any) -> Float[Array, " d"]:
        planar = self.distance * direction(platform.heading + jnp.pi + self.angle)
        return planar if platform.position.size < 3 else jnp.append(planar, 0.0)


class Displacement(Offset, type="displacement"):
    """Constant offset along the axes of the global frame."""

    by: Annotated[Number, Unit("m or ft", length=0), Place]

    def vector(self, platform: Any) -> Float[Array, " d"]:
        return self.by


class Region(Component):
    """A part of space attached to a platform.

    It is a pure function of the platforms and is recomputed at every step.
    """

    dimensions: ClassVar[tuple[int, ...]] = (1, 2, 3)
    """Dimensions of space in which the region is what its name says."""
    name: str
    on: PlatformName
    offset: Offset | None = None  # None: centred on the platform

    def contains(self, offset: Float[Array, " d"]) -> Bool[Array, ""]:
        """Return whether a point is inside, given its offset from the region's centre."""
        raise NotImplementedError

    def place(self, platforms: Mapping[str, Any]) -> RegionState:
        """Return where the region is and which of the other platforms are inside.

        Args:
            platforms: the states of all platforms, by name.

        Raises:
            ValueError: the offset has another dimension than the platform's position.
        """
        centre = platforms[self.on].position
        if self.offset is not None:
            offset = self.offset.vector(platforms[self.on])
            if offset.shape != centre.shape:
                raise ValueError(
                    f"expected an offset of {centre.size} numbers, found {offset.size}"
                )
            centre = centre + offset
        others = {name: other for name, other in platforms.items() if name != self.on}
        inside = {name: self.contains(other.position - centre) for name, other in others.items()}
        return RegionState(position=centre, inside=inside)


class Sphere(Region, type="sphere"):
    """All points within `radius` of the centre: ‖r − c‖ ≤ ρ, Eqs. (7), (13).

    In the plane it is a disc, and on a line an interval.
    """

    radius: Annotated[Length, Reach]

    def contains(self, offset: Float[Array, " d"]) -> Bool[Array, ""]:
        return safe_norm(offset) <= self.radius


class Circle(Sphere, type="circle"):
    """All points of the plane within `radius` of the centre: ‖r − c‖ ≤ ρ, Eqs. (7), (13)."""

    dimensions: ClassVar[tuple[int, ...]] = (2,)


class Cylinder(Region, type="cylinder"):
    """All points within `radius` of the centre in x and y and half the `height` in z, Eq. (10)."""

    dimensions: ClassVar[tuple[int, ...]] = (3,)
    radius: Annotated[Length, Reach]
    height: Annotated[Length, Reach]

    def contains(self, offset: Float[Array, " 3"]) -> Bool[Array, ""]:
        x, y, z = offset
        return (safe_norm(jnp.stack([x, y])) <= self.radius) & (jnp.abs(z) <= self.height / 2.0)
