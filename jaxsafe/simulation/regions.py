"""Regions of space and where they are, Section 4 and Tables 3 and 4.

The signed distance of a point to a region is negative inside. Where it has a kink, its gradient is
finite.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.schema.component import Component, Range, choices
from jaxsafe.schema.errors import choices_text
from jaxsafe.simulation.geometry import (
    Coordinates,
    Heading,
    Sizes,
    closest_approach,
    direction,
    mag_norm,
    no_direction,
    safe_norm,
    to_body,
    to_global,
    wrong_size,
)
from jaxsafe.simulation.trig import sin_cos
from jaxsafe.types import (
    Length,
    PlaceName,
    Radians,
    Reach,
    RegionState,
    Turn,
)


class Offset(Component):
    """Position of a region's centre relative to what carries the region."""

    turns: ClassVar[bool] = True
    """Whether the offset turns with what carries the region."""

    def vector(self, platform: Any) -> Float[Array, " d"]:
        """Return the offset in the global frame, given the state of what carries the region."""
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

    turns: ClassVar[bool] = False
    by: Coordinates

    def vector(self, platform: Any) -> Float[Array, " d"]:
        return self.by


class BodyDisplacement(Offset, type="body_displacement"):
    """Constant offset along the body axes of what carries the region, with which it turns."""

    by: Coordinates

    def vector(self, platform: Any) -> Float[Array, " d"]:
        if self.by.shape != platform.position.shape:
            return self.by  # `Region.place` reports the wrong size
        return to_global(platform.orientation, self.by)


class Region(Component):
    """A part of space that is carried by a platform or by an earlier region.

    It is a pure function of the platforms and is recomputed at every step.
    """

    dimensions: ClassVar[tuple[int, ...]] = (1, 2, 3)
    """Dimensions of space in which a region of this type can be."""
    convex: ClassVar[bool] = False
    """Whether the region is convex. The distance on a line is then largest at an end."""
    name: str
    on: PlaceName | None
    """What carries the region. null stands for the origin, so that the region stays in place."""
    offset: Offset | None = None
    """The vector from what carries the region to its centre."""

    def contains(self, offset: Float[Array, " d"]) -> Bool[Array, ""]:
        """Return whether a point is inside.

        Args:
            offset: the point relative to the centre, in the region's axes, shape (d,).
        """
        raise NotImplementedError

    def signed_distance(self, offset: Float[Array, " d"]) -> Float[Array, ""]:
        """Return the distance of a point to the boundary, negative inside.

        It changes by no more than the point moves. Its absolute value may be less than the true
        distance. Then the docstring of the region says where.

        Args:
            offset: the point relative to the centre, in the region's axes, shape (d,).
        """
        raise NotImplementedError(f"a {self.type_name} knows no distance to its boundary")

    def nearest(self, before: Float[Array, " d"], after: Float[Array, " d"]) -> Float[Array, ""]:
        """Return a lower bound of the signed distance on the straight line between two offsets."""
        return _distance_on_line(self, before, after, -1.0)

    def farthest(self, before: Float[Array, " d"], after: Float[Array, " d"]) -> Float[Array, ""]:
        """Return an upper bound of the signed distance on the straight line between two offsets."""
        if self.convex:
            return jnp.maximum(self.signed_distance(before), self.signed_distance(after))
        return _distance_on_line(self, before, after, 1.0)

    def axes(self, carrier: Any) -> Float[Array, "d d"] | None:
        """Return the rotation from the region's axes to the global frame, given its carrier.

        None stands for the axes of the global frame.
        """
        return None

    def misfits(self, env: Any) -> dict[str, str]:
        if self.on is None and self.offset is not None and self.offset.turns:
            return {"offset": f"a {self.offset.type_name} turns with what carries it; give `on`"}
        space = env.agent_platform.dimension
        if space not in self.dimensions:
            fitting = [name for name, kind in choices(Region).items() if space in kind.dimensions]
            return {
                "": f"a {self.type_name} is no part of a space of {space} dimensions"
                f"{choices_text('', sorted(fitting))}"
            }
        return {}

    def place(
        self,
        platforms: Mapping[str, Any],
        regions: Mapping[str, RegionState] | None = None,
        moves: bool = False,
        measures: bool = False,
    ) -> RegionState:
        """Return where the region is and which of the other platforms are inside.

        Args:
            platforms: the states of all platforms, by name.
            regions: the states of the regions that are listed before this one, by name.
            moves: whether its velocity and orientation are needed.
            measures: whether the distances of the platforms to its boundary are needed.

        Raises:
            ValueError: the offset has another dimension than the positions.
        """
        positions = [state.position for state in platforms.values()]
        carrier = None if self.on is None else {**(regions or {}), **platforms}[self.on]
        centre = jnp.zeros_like(positions[0]) if carrier is None else carrier.position
        if self.offset is not None:
            offset = self.offset.vector(carrier)
            if offset.shape != centre.shape:
                raise ValueError(
                    f"expected an offset of {centre.size} numbers, found {offset.size}"
                )
            centre = centre + offset
        axes = self.axes(carrier)
        others = {
            name: other.position - centre for name, other in platforms.items() if name != self.on
        }
        if axes is not None:
            others = {name: to_body(axes, offset) for name, offset in others.items()}
        state = RegionState(
            position=centre,
            inside={name: self.contains(offset) for name, offset in others.items()},
        )
        if moves:
            state = state.replace(
                velocity=self._velocity(carrier, centre),
                orientation=jnp.eye(centre.size, dtype=centre.dtype) if axes is None else axes,
            )
        if measures:
            distance = {name: self.signed_distance(offset) for name, offset in others.items()}
            depth = {name: -value for name, value in distance.items()}
            state = state.replace(distance=distance, depth=depth)
        return state

    def _velocity(self, carrier: Any, centre: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return the velocity of the centre.

        Where the state of the carrier has an `attitude_rate`, the turn of the offset counts. The
        turn of an aircraft is a control and no part of its state, so there it is left out.
        """
        if carrier is None:
            return jnp.zeros_like(centre)
        rate = getattr(carrier, "attitude_rate", None)
        if rate is None or self.offset is None or not self.offset.turns:
            return carrier.velocity
        x, y = centre - carrier.position
        return carrier.velocity + rate * jnp.stack([-y, x])


LINE_SAMPLES = 8
"""Number of parts of a line on which the distance to a region is bounded.

The bound is off by at most a sixteenth of the length of the line.
"""


def _distance_on_line(
    region: Region, before: Float[Array, " d"], after: Float[Array, " d"], side: float
) -> Float[Array, ""]:
    """Return a bound of the signed distance on a straight line.

    It is an upper bound if `side` is 1, and a lower bound if it is −1. Between two samples the
    distance differs from their mean by no more than half the way between them.
    """
    shares = jnp.linspace(0.0, 1.0, LINE_SAMPLES + 1, dtype=before.dtype)
    offsets = [before + share * (after - before) for share in shares]
    distances = jnp.stack([region.signed_distance(offset) for offset in offsets])
    half_way = safe_norm(after - before) / (2.0 * LINE_SAMPLES)
    return side * jnp.max(side * (distances[:-1] + distances[1:]) / 2.0 + half_way)


class Sphere(Region, type="sphere"):
    """All points within `radius` of the centre: ‖r − c‖ ≤ ρ, Eqs. (7), (13).

    In the plane it is a disc, and on a line an interval.
    """

    convex: ClassVar[bool] = True
    radius: Annotated[Length, Reach]

    def contains(self, offset: Float[Array, " d"]) -> Bool[Array, ""]:
        return safe_norm(offset) <= self.radius

    def signed_distance(self, offset: Float[Array, " d"]) -> Float[Array, ""]:
        return safe_norm(offset) - self.radius

    def nearest(self, before: Float[Array, " d"], after: Float[Array, " d"]) -> Float[Array, ""]:
        return closest_approach(before, after) - self.radius


class Circle(Sphere, type="circle"):
    """All points of the plane within `radius` of the centre: ‖r − c‖ ≤ ρ, Eqs. (7), (13)."""

    dimensions: ClassVar[tuple[int, ...]] = (2,)


class Turned(Region):
    """Base of regions whose axes may turn with what carries them."""

    convex: ClassVar[bool] = True
    turns: bool = False
    """Whether the region's axes turn with what carries it. Else they are the global axes."""

    def axes(self, carrier: Any) -> Float[Array, "d d"] | None:
        return carrier.orientation if self.turns and carrier is not None else None


class Cylinder(Turned, type="cylinder"):
    """All points within `radius` of the centre in x and y and half the `height` in z, Eq. (10)."""

    dimensions: ClassVar[tuple[int, ...]] = (3,)
    radius: Annotated[Length, Reach]
    height: Annotated[Length, Reach]

    def contains(self, offset: Float[Array, " 3"]) -> Bool[Array, ""]:
        x, y, z = offset
        return (safe_norm(jnp.stack([x, y])) <= self.radius) & (jnp.abs(z) <= self.height / 2.0)

    def signed_distance(self, offset: Float[Array, " 3"]) -> Float[Array, ""]:
        x, y, z = offset
        beside = safe_norm(jnp.stack([x, y])) - self.radius
        return _beyond(jnp.stack([beside, jnp.abs(z) - self.height / 2.0]))


class Box(Turned, type="box"):
    """All points no farther from the centre than half the `size` along each axis."""

    size: Sizes

    def problem(self) -> str | None:
        return None if self.size.size else "expected a size of a number for each dimension"

    def contains(self, offset: Float[Array, " d"]) -> Bool[Array, ""]:
        return jnp.all(jnp.abs(offset) <= self.size / 2.0)

    def signed_distance(self, offset: Float[Array, " d"]) -> Float[Array, ""]:
        return _beyond(jnp.abs(offset) - self.size / 2.0)

    def misfits(self, env: Any) -> dict[str, str]:
        return super().misfits(env) or wrong_size(env, size=self.size)


class HalfSpace(Turned, type="half_space"):
    """All points on one side of a plane through the centre, the side to which `towards` points."""

    towards: Heading

    def problem(self) -> str | None:
        return no_direction(self.towards, "towards")

    def contains(self, offset: Float[Array, " d"]) -> Bool[Array, ""]:
        return self.signed_distance(offset) <= 0.0

    def signed_distance(self, offset: Float[Array, " d"]) -> Float[Array, ""]:
        return -jnp.sum(offset * mag_norm(self.towards)[1:])

    def nearest(self, before: Float[Array, " d"], after: Float[Array, " d"]) -> Float[Array, ""]:
        return jnp.minimum(self.signed_distance(before), self.signed_distance(after))

    def misfits(self, env: Any) -> dict[str, str]:
        return super().misfits(env) or wrong_size(env, towards=self.towards)


class Cone(Turned, type="cone"):
    """All points whose direction from the centre is within `half_angle` of the vector `towards`.

    The centre is the tip. With a `length` the cone ends that far along `towards`. Outside, beyond
    this end, the distance may then be less than the true one.
    """

    dimensions: ClassVar[tuple[int, ...]] = (2, 3)
    towards: Heading
    half_angle: Annotated[Radians, Range(0.0, jnp.pi / 2, open_low=True, open_high=True)]
    length: Annotated[Length, Reach] | None = None

    def problem(self) -> str | None:
        return no_direction(self.towards, "towards")

    def contains(self, offset: Float[Array, " d"]) -> Bool[Array, ""]:
        return self.signed_distance(offset) <= 0.0

    def signed_distance(self, offset: Float[Array, " d"]) -> Float[Array, ""]:
        axis = mag_norm(self.towards)[1:]
        along = jnp.sum(offset * axis)
        beside = safe_norm(offset - along * axis)
        sine, cosine = sin_cos(self.half_angle)
        to_side = beside * cosine - along * sine
        behind_tip = along * cosine + beside * sine < 0.0
        distance = jnp.where(behind_tip, safe_norm(offset), to_side)
        return distance if self.length is None else jnp.maximum(distance, along - self.length)

    def misfits(self, env: Any) -> dict[str, str]:
        return super().misfits(env) or wrong_size(env, towards=self.towards)


def _beyond(excess: Float[Array, " k"]) -> Float[Array, ""]:
    """Return the signed distance to a box, given how far a point is beyond each of its sides."""
    return safe_norm(jnp.maximum(excess, 0.0)) + jnp.minimum(jnp.max(excess), 0.0)
