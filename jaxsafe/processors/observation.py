"""Observations (Tables 5 and 6).

Each is shifted by its offset, divided by its scale and clipped. Together they are one vector.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.processors.processor import Processor
from jaxsafe.schema.component import ANY, Range, Unit
from jaxsafe.schema.errors import choices_text
from jaxsafe.simulation.geometry import direction, mag_norm, to_body
from jaxsafe.simulation.vectors import Vector
from jaxsafe.types import (
    MAX_DISTANCE,
    AnyStatusName,
    Number,
    PlaceName,
    PlatformName,
    RegionName,
    Sim,
    place,
)

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

Scale = Annotated[Number, Unit("as observed", length=ANY), Range(nonzero=True, smallest=1e-12)]
"""One divisor for all elements of an observation, or one for each."""

Shift = Annotated[Number, Unit("as observed", length=ANY), Range(largest=MAX_DISTANCE)]
"""One offset of all elements of an observation, or one for each."""

Clip = Annotated[Number, Unit("1", length=2), Range(infinite=True)]
"""Lowest and highest value of an observation after scaling."""

Deviation = Annotated[Number, Unit("as observed", length=ANY), Range(0.0, largest=MAX_DISTANCE)]
"""One standard deviation for all elements of an observation, or one for each."""


class Observation(Processor):
    """Base of all observations.

    A subclass writes `measure`, which returns a vector in physical units. What is observed is
    (vector − `offset`)/`scale`, clipped to `clip`. So an offset that is the mean and a scale that
    is the standard deviation standardise it. Each is one number for all elements or one for each.

    A sensor adds its `bias` and normal `noise` of a standard deviation in physical units. With the
    probability `dropout` it gives all elements of the last reading again. A reading arrives `delay`
    actions late, but the first one of an episode arrives at once.
    """

    scale: Scale = 1.0
    clip: Clip | None = None
    offset: Shift | None = None
    bias: Shift | None = None
    noise: Deviation | None = None
    dropout: Annotated[Number, Unit("1"), Range(0.0, 1.0)] | None = None
    delay: Annotated[int, Range(0, largest=1000)] = 0

    @property
    def exact(self) -> bool:
        """Whether the sensor makes no error."""
        return self.bias is None and not (self.draws or self.delay)

    @property
    def draws(self) -> bool:
        """Whether the sensor draws random numbers."""
        return self.noise is not None or self.dropout is not None

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
        return self.scaled(self.measure(memory, sim))

    def read(
        self, measured: Float[Array, " k"], readings: Float[Array, "delay+1 k"] | None, key: Any
    ) -> tuple[Float[Array, " k"], Float[Array, "delay+1 k"]]:
        """Return what arrives from the sensor, and the readings under way, the oldest one first.

        Args:
            measured: the true vector.
            readings: the readings under way before, or None at the start of an episode.
            key: a key for this sensor and this instant. A sensor that draws nothing does not use
                it.

        Raises:
            ValueError: `bias` or `noise` has another number of elements than the vector.
        """
        self._check_lengths(measured, ("bias", "noise"))
        reading = measured if self.bias is None else measured + self.bias
        if self.draws:
            noise_key, dropout_key = jax.random.split(key)
            if self.noise is not None:
                normal = jax.random.normal(noise_key, measured.shape, measured.dtype)
                reading = reading + self.noise * normal
            if self.dropout is not None and readings is not None:
                dropped = jax.random.bernoulli(dropout_key, self.dropout)
                reading = jnp.where(dropped, readings[-1], reading)
        if readings is None:
            readings = jnp.tile(reading, (self.delay + 1, 1))
        else:
            readings = jnp.concatenate([readings[1:], reading[None]])
        return readings[0], readings

    def _check_lengths(self, measured: Float[Array, " k"], names: tuple[str, ...]) -> None:
        """Check that fields have one number, or one for each element of the measured vector.

        Raises:
            ValueError: a field has another number of elements.
        """
        for name in names:
            value = getattr(self, name)
            if value is not None and jnp.shape(value) not in ((), measured.shape):
                raise ValueError(
                    f"{name}: expected 1 or {measured.size} numbers, found {jnp.size(value)}"
                )

    def scaled(self, measured: Float[Array, " k"]) -> Float[Array, " k"]:
        """Return the vector that is observed for one in physical units."""
        self._check_lengths(measured, ("scale", "offset"))
        shifted = measured if self.offset is None else measured - self.offset
        scaled = shifted / self.scale
        return scaled if self.clip is None else jnp.clip(scaled, self.clip[0], self.clip[1])


class VectorObservation(Observation):
    """Base of observed vectors, given in a frame and in a form.

    `frame` names the platform or region whose body frame is used. None stands for the global
    frame. The form `rectangular` is the components, and `magnorm` is the magnitude and the
    direction, Eq. (21).
    """

    frame: PlaceName | None = None
    form: Literal["rectangular", "magnorm"] = "rectangular"

    def vector(self, sim: Sim) -> Float[Array, " d"]:
        """Return the vector in the global frame, in physical units."""
        raise NotImplementedError

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        vector = jnp.atleast_1d(self.vector(sim))
        if self.frame is not None:
            vector = to_body(place(sim, self.frame).orientation, vector)
        return mag_norm(vector) if self.form == "magnorm" else vector

    def labels(self, sim: Sim) -> tuple[str, ...]:
        if self.form == "rectangular":
            return super().labels(sim)
        size = self.measure((), sim).size - 1
        return (f"{self.name}.magnitude", *(f"{self.name}.{axis}" for axis in _axis_names(size)))


class Observe(VectorObservation, type="observe"):
    """A quantity of a platform: a field of its state, or its velocity.

    A region has the quantities `position` and `velocity`. With `relative_to` the same quantity of
    that platform or region is subtracted.
    """

    of: PlaceName
    what: str
    relative_to: PlaceName | None = None

    def misfits(self, env: Environment) -> dict[str, str]:
        return _not_observable(env, self.what, self.of, self.relative_to or self.of)

    def vector(self, sim: Sim) -> Float[Array, " d"]:
        own = getattr(place(sim, self.of), self.what)
        if self.relative_to is None:
            return own
        return own - getattr(place(sim, self.relative_to), self.what)


class ObserveRegion(VectorObservation, type="observe_region"):
    """The position of a region's centre, relative to a platform or region if one is named."""

    region: RegionName
    relative_to: PlaceName | None = None

    def vector(self, sim: Sim) -> Float[Array, " d"]:
        centre = sim.regions[self.region].position
        if self.relative_to is None:
            return centre
        return centre - place(sim, self.relative_to).position


class ObserveVector(VectorObservation, type="observe_vector"):
    """A vector of the world, such as the velocity of a region or the direction of the sun."""

    what: Vector

    def vector(self, sim: Sim) -> Float[Array, " d"]:
        return self.what.value(sim)


class ObserveOrientation(Observation, type="observe_orientation"):
    """The orientation of a platform or region, in numbers that do not jump.

    In the plane it is [cos θ, sin θ] of the angle θ of the body's x axis. In space it is the first
    two columns of the rotation matrix, which are the body's x and y axes. The z axis follows from
    them. With `frame` the axes are seen from the body frame of that platform or region.
    """

    of: PlaceName
    frame: PlaceName | None = None

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        orientation = place(sim, self.of).orientation
        axes = [orientation[:, i] for i in range(orientation.shape[0] - 1)]
        if self.frame is not None:
            seen_from = place(sim, self.frame).orientation
            axes = [to_body(seen_from, axis) for axis in axes]
        return jnp.concatenate(axes)

    def labels(self, sim: Sim) -> tuple[str, ...]:
        if self.measure((), sim).size == 2:
            return (f"{self.name}.cos", f"{self.name}.sin")
        return tuple(f"{self.name}.{axis}_axis.{component}" for axis in "xy" for component in "xyz")


class ObserveControl(Observation, type="observe_control"):
    """The control of the last step in physical units, 0 at reset, in the order of the action.

    `actual` is the control that acted, after run time assurance, and `desired` is what the agent
    asked for. A scale of the limits gives the last action in [−1, 1].
    """

    which: Literal["actual", "desired"] = "actual"

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " actuators"]:
        return sim.control_actual if self.which == "actual" else sim.control_desired

    def labels(self, sim: Sim) -> tuple[str, ...]:
        return tuple(f"{self.name}.{index}" for index in range(sim.control_actual.size))


class ObserveTime(Observation, type="observe_time"):
    """The time [s] since the start of the episode."""

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " 1"]:
        return sim.time[None]


class ObserveAngle(Observation, type="observe_angle"):
    """An angle θ of a platform's state, as [cos θ, sin θ]. These two do not jump at ±π."""

    of: PlatformName
    what: str

    def misfits(self, env: Environment) -> dict[str, str]:
        return _not_observable(env, self.what, self.of)

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " 2"]:
        return direction(getattr(sim.platforms[self.of], self.what))

    def labels(self, sim: Sim) -> tuple[str, ...]:
        return (f"{self.name}.cos", f"{self.name}.sin")


class ObserveStatus(Observation, type="observe_status"):
    """The value of a status, as a number."""

    status: AnyStatusName

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        return jnp.atleast_1d(jnp.asarray(sim.status[self.status], jnp.result_type(float)))


def _not_observable(env: Environment, what: str, *places: str) -> dict[str, str]:
    """Return what is wrong with a quantity, if one of the platforms or regions does not have it."""
    platforms = {platform.name: platform for platform in env.platforms}
    for name in places:
        quantities = platforms[name].quantities() if name in platforms else ("position", "velocity")
        if what not in quantities:
            return {"what": f"{name} has no quantity {what!r}{choices_text(what, quantities)}"}
    return {}


def _axis_names(size: int) -> list[str]:
    return list("xyz"[:size]) if size <= 3 else [str(index) for index in range(size)]
