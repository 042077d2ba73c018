"""Vectors of the simulated world: positions, velocities, body axes and fixed directions.

Statuses, constraints and observations use them, for instance for the angle between two directions.
All are given in the global frame.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Component
from jaxsafe.simulation.geometry import Heading, no_direction, rotation, to_global, wrong_size
from jaxsafe.types import PlaceName, RadiansPerSecond, Sim, place


class Vector(Component):
    """Base of vectors that follow from the simulated world."""

    def value(self, sim: Sim) -> Float[Array, " d"]:
        """Return the vector in the global frame, shape (d,)."""
        raise NotImplementedError


class PlaceVector(Vector):
    """Base of vectors that a platform or region has, relative to another one if it is named."""

    quantity: ClassVar[str]
    """The field of the state of a platform or region that holds the vector."""
    of: PlaceName
    relative_to: PlaceName | None = None

    def value(self, sim: Sim) -> Float[Array, " d"]:
        own = getattr(place(sim, self.of), self.quantity)
        if self.relative_to is None:
            return own
        return own - getattr(place(sim, self.relative_to), self.quantity)


class Position(PlaceVector, type="position"):
    """The position of a platform or of a region's centre.

    With `relative_to` it is the position relative to that platform or centre.
    """

    quantity: ClassVar[str] = "position"


class Velocity(PlaceVector, type="velocity"):
    """The velocity of a platform or of a region's centre.

    With `relative_to` it is the velocity relative to that platform or centre.
    """

    quantity: ClassVar[str] = "velocity"


class BodyDirection(Vector, type="body"):
    """A direction that is fixed to a platform or region, such as that of a camera.

    `along` is given in the body frame. The direction is a unit vector.
    """

    of: PlaceName
    along: Heading

    def problem(self) -> str | None:
        return no_direction(self.along, "along")

    def misfits(self, env: Any) -> dict[str, str]:
        return wrong_size(env, along=self.along)

    def value(self, sim: Sim) -> Float[Array, " d"]:
        return to_global(place(sim, self.of).orientation, _unit(self.along))


class FixedDirection(Vector, type="fixed"):
    """A direction of the global frame, such as that of the sun.

    With a `rate` it turns about the z axis. In Hill's frame the sun turns at minus the mean motion.
    The direction is a unit vector.
    """

    along: Heading
    rate: RadiansPerSecond = 0.0

    def problem(self) -> str | None:
        return no_direction(self.along, "along")

    def misfits(self, env: Any) -> dict[str, str]:
        return wrong_size(env, along=self.along)

    def value(self, sim: Sim) -> Float[Array, " d"]:
        unit = _unit(self.along)
        if unit.size == 1:
            return unit
        level = to_global(rotation(self.rate * sim.time), unit[:2])
        return jnp.concatenate([level, unit[2:]])


def _unit(vector: Float[Array, " d"]) -> Float[Array, " d"]:
    return vector / jnp.sqrt(jnp.sum(vector * vector))
