"""Random starts: each initializer draws one field of a platform's state.

They are described in Section 4 "Initialization" and in Tables 3 and 4. Initializers run in the
order in which they are listed, platform after platform. So a later one may refer to a field that is
drawn earlier or to an earlier platform.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.schema.component import ANY, Component, Range, Unit
from jaxsafe.simulation.geometry import direction, safe_norm
from jaxsafe.types import (
    Key,
    MetresPerSecond,
    Number,
    PerSecond,
    Place,
    PlatformName,
    Reach,
    Sim,
    Turn,
)

TWO_PI = 2.0 * jnp.pi

Interval = Annotated[Number, Unit("m or ft", length=2), Place]
Distances = Annotated[Number, Unit("m or ft", length=2), Reach]
Angles = Annotated[Number, Unit("rad", length=2), Turn]
Shares = Annotated[Number, Unit("1", length=2), Range(0.0, largest=1e3)]


class Initializer(Component):
    """Base of initializers. Each draws the state field that it is named after."""

    name: str

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Array:
        """Return a value of the field.

        Args:
            key: a typed PRNG key.
            drawn: this platform's fields that are drawn so far, by name.
            sim: the simulation with the platforms that are placed so far.
        """
        raise NotImplementedError


class Direction(Component):
    """A random direction whose azimuth and, in space, polar angle are each uniform.

    In space it is therefore not uniform on the sphere. On a line there is no azimuth, and each of
    the two directions is as likely as the other.
    """

    azimuth: Angles | None = (0.0, TWO_PI)
    polar: Angles | None = None

    def problem(self) -> str | None:
        if self.azimuth is None and self.polar is not None:
            return "a polar range needs an azimuth; a direction on a line has neither"
        return None

    @property
    def dimension(self) -> int:
        """Number of elements of the direction: 1 on a line, 2 in the plane, 3 in space."""
        return 1 + (self.azimuth is not None) + (self.polar is not None)

    @property
    def intervals(self) -> tuple[Float[Array, " 2"], ...]:
        """Intervals of the numbers to draw: one on a line or in the plane, two in space."""
        if self.azimuth is None:
            return (jnp.array([-1.0, 1.0]),)
        return (self.azimuth,) if self.polar is None else (self.azimuth, self.polar)

    def vector(self, *drawn: Float[Array, ""]) -> Float[Array, " d"]:
        """Return the unit vector that the drawn numbers stand for, one number per interval."""
        if self.azimuth is None:
            return jnp.where(drawn[0] < 0.0, -1.0, 1.0)[None]
        return direction(*drawn)


class Fixed(Initializer, type="fixed"):
    """The same start in every episode."""

    value: Annotated[Number, Unit("physical", length=ANY), Place]

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Array:
        return self.value


class Uniform(Initializer, type="uniform"):
    """A value drawn uniformly between bounds, independently in each component.

    This is the paper's generic initializer.
    """

    low: Annotated[Number, Unit("physical", length=ANY), Place]
    high: Annotated[Number, Unit("physical", length=ANY), Place]

    def problem(self) -> str | None:
        if self.low.shape != self.high.shape or not np.all(
            np.asarray(self.low) <= np.asarray(self.high)
        ):
            return f"expected low ≤ high, found {self.low.tolist()} and {self.high.tolist()}"
        return None

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Array:
        return self.low + (self.high - self.low) * jax.random.uniform(
            key, self.low.shape, self.low.dtype
        )


class AtDistance(Initializer, type="at_distance"):
    """A position at a random distance and in a random direction from another platform."""

    about: PlatformName
    distance: Distances
    direction: Direction = Direction()

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Float[Array, " d"]:
        distance, *angles = uniform(key, self.distance, *self.direction.intervals)
        return sim.platforms[self.about].position + distance * self.direction.vector(*angles)


class AroundAtAltitude(Initializer, type="around_at_altitude"):
    """A position at a random horizontal distance and azimuth from another platform.

    Its altitude z is random and does not depend on the other platform.
    """

    about: PlatformName
    distance: Distances
    azimuth: Angles = (0.0, TWO_PI)
    altitude: Interval

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Float[Array, " 3"]:
        distance, azimuth, altitude = uniform(key, self.distance, self.azimuth, self.altitude)
        return jnp.append(
            sim.platforms[self.about].position[:2] + distance * direction(azimuth), altitude
        )


class BelowSpeedLimit(Initializer, type="below_speed_limit"):
    """A velocity in a random direction, at a uniform share of the limit ν₀ + ν₁‖r‖, Eq. (14).

    The position r, relative to the platform `about`, is the one drawn before.
    """

    about: PlatformName
    floor: Annotated[MetresPerSecond, Range(0.0, largest=1e9)]
    slope: Annotated[PerSecond, Range(0.0, largest=1e3)]
    share: Shares = (0.0, 1.0)
    direction: Direction = Direction()

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Float[Array, " d"]:
        share, *angles = uniform(key, self.share, *self.direction.intervals)
        limit = self.floor + self.slope * safe_norm(
            drawn["position"] - sim.platforms[self.about].position
        )
        return limit * share * self.direction.vector(*angles)


def uniform(key: Key, *intervals: Float[Array, " 2"]) -> Float[Array, " n"]:
    """Return a number drawn uniformly from each interval [low, high].

    All numbers come from one draw, because every draw compiles to a loop of its own.
    """
    low, high = jnp.stack(intervals, axis=-1)
    return low + (high - low) * jax.random.uniform(key, low.shape, low.dtype)
