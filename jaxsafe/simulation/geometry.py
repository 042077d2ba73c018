"""Norms with safe gradients, directions, and the regions of space that tasks refer to (Section 4, Tables 3 and 4)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.component import Component, Range
from jaxsafe.types import Metres, PlatformName, RegionState


def safe_norm(vector: Float[Array, " d"]) -> Float[Array, ""]:
    """Euclidean norm ‖v‖ whose gradient at v = 0 is 0 instead of NaN.

    Double where: the root must not see 0 in either branch, because `where` multiplies the untaken branch's infinite
    derivative by zero.
    """
    squared = jnp.sum(vector * vector, axis=-1)
    positive = squared > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def direction(azimuth: Float[Array, ""], polar: Float[Array, ""] | None = None) -> Float[Array, " d"]:
    """Unit vector at an azimuth from x [rad], in the plane; with a polar angle from z [rad], in space."""
    planar = jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth)])
    return planar if polar is None else jnp.append(jnp.sin(polar) * planar, jnp.cos(polar))


class Region(Component):
    """A part of space attached to a platform; a pure function of the platforms, recomputed at every step."""

    name: str
    on: PlatformName

    def contains(self, offset: Float[Array, " d"]) -> Bool[Array, ""]:
        """Whether a point, given by its offset from the region's centre, is inside."""
        raise NotImplementedError

    def place(self, platforms: Mapping[str, Any]) -> RegionState:
        """Centre of the region, and which of the other platforms are inside."""
        centre = platforms[self.on].position
        others = {name: other for name, other in platforms.items() if name != self.on}
        return RegionState(centre, {name: self.contains(other.position - centre) for name, other in others.items()})


class Sphere(Region, type="sphere"):
    """All points within `radius` of the centre: ‖r − c‖ ≤ ρ, Eq. (13)."""

    radius: Annotated[Metres, Range(0.0)]

    def contains(self, offset: Float[Array, " d"]) -> Bool[Array, ""]:
        return safe_norm(offset) <= self.radius


class Circle(Sphere, type="circle"):
    """The sphere of a planar task, named as in Tables 3 and 4."""
