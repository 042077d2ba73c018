"""Observations (Tables 5 and 6).

Each is divided by its scale and clipped. Together they are one vector.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.processors.processor import Processor
from jaxsafe.schema.component import ANY, Range, Unit
from jaxsafe.simulation.geometry import direction, mag_norm, to_body
from jaxsafe.types import AnyStatusName, Number, PlatformName, RegionName, Sim

Scale = Annotated[Number, Unit("as observed", length=ANY), Range(nonzero=True, smallest=1e-12)]
"""One divisor for all elements of an observation, or one for each."""

Clip = Annotated[Number, Unit("1", length=2), Range(infinite=True)]
"""Lowest and highest value of an observation after scaling."""


class Observation(Processor):
    """Base of all observations.

    A subclass writes `measure`, which returns a vector in physical units. The vector is then
    divided by `scale`, which is one divisor for all elements or one for each, and clipped to
    `clip`.
    """

    scale: Scale = 1.0
    clip: Clip | None = None

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        """Return the observed vector in physical units, shape (k,)."""
        raise NotImplementedError

    def labels(self, sim: Sim) -> tuple[str, ...]:
        """Return a name for each of the k elements."""
        size = self.measure(self.init(sim), sim).size
        if size <= 1:
            return (self.name,)
        return tuple(f"{self.name}.{axis}" for axis in _axis_names(size))

    def process(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        measured = self.measure(memory, sim)
        if jnp.shape(self.scale) not in ((), measured.shape):
            raise ValueError(
                f"scale: expected 1 or {measured.size} numbers, found {jnp.size(self.scale)}"
            )
        scaled = measured / self.scale
        return scaled if self.clip is None else jnp.clip(scaled, self.clip[0], self.clip[1])


class VectorObservation(Observation):
    """Base of observed vectors, given in a frame and in a form.

    `frame` names the platform whose body frame is used. None stands for the global frame. The form
    `rectangular` is the components, and `magnorm` is the magnitude and the direction, Eq. (21).
    """

    frame: PlatformName | None = None
    form: Literal["rectangular", "magnorm"] = "rectangular"

    def vector(self, sim: Sim) -> Float[Array, " d"]:
        """Return the vector in the global frame, in physical units."""
        raise NotImplementedError

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        vector = jnp.atleast_1d(self.vector(sim))
        if self.frame is not None:
            vector = to_body(sim.platforms[self.frame].orientation, vector)
        return mag_norm(vector) if self.form == "magnorm" else vector

    def labels(self, sim: Sim) -> tuple[str, ...]:
        if self.form == "rectangular":
            return super().labels(sim)
        size = self.measure((), sim).size - 1
        return (f"{self.name}.magnitude", *(f"{self.name}.{axis}" for axis in _axis_names(size)))


class Observe(VectorObservation, type="observe"):
    """A quantity of a platform: a field of its state, or its velocity.

    With `relative_to` the same quantity of that platform is subtracted.
    """

    of: PlatformName
    what: str
    relative_to: PlatformName | None = None

    def vector(self, sim: Sim) -> Float[Array, " d"]:
        own = getattr(sim.platforms[self.of], self.what)
        if self.relative_to is None:
            return own
        return own - getattr(sim.platforms[self.relative_to], self.what)


class ObserveRegion(VectorObservation, type="observe_region"):
    """The position of a region's centre, relative to a platform if one is named."""

    region: RegionName
    relative_to: PlatformName | None = None

    def vector(self, sim: Sim) -> Float[Array, " d"]:
        centre = sim.regions[self.region].position
        if self.relative_to is None:
            return centre
        return centre - sim.platforms[self.relative_to].position


class ObserveAngle(Observation, type="observe_angle"):
    """An angle θ of a platform's state, given as [cos θ, sin θ], which does not jump at ±π."""

    of: PlatformName
    what: str

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " 2"]:
        return direction(getattr(sim.platforms[self.of], self.what))

    def labels(self, sim: Sim) -> tuple[str, ...]:
        return (f"{self.name}.cos", f"{self.name}.sin")


class ObserveStatus(Observation, type="observe_status"):
    """The value of a status, as a number."""

    status: AnyStatusName

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        return jnp.atleast_1d(jnp.asarray(sim.status[self.status], jnp.result_type(float)))


def _axis_names(size: int) -> list[str]:
    return list("xyz"[:size]) if size <= 3 else [str(index) for index in range(size)]
