"""Statuses: named facts about the simulated world.

They are computed in order, so a later status may use an earlier one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.processors.processor import Processor
from jaxsafe.schema.component import Range
from jaxsafe.simulation.geometry import closest_approach, safe_norm
from jaxsafe.types import (
    FlagName,
    Length,
    MetresPerSecond,
    Number,
    PerSecond,
    PlatformName,
    Reach,
    Record,
    RegionName,
    Sim,
    StatusName,
)

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


class Status(Processor):
    """Base of all statuses."""

    def on_the_way(self, env: Environment, before: Sim, sim: Sim) -> Any:
        """Return the output over the step from `before` to `sim`.

        For distances it is a lower bound on the way between the two. For other statuses it is the
        output at `sim`.
        """
        return self.process(self.init(sim), sim)


class Distance(Status, type="distance"):
    """Distance ‖r_of − r_to‖ between two platforms."""

    of: PlatformName
    to: PlatformName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(self._apart(sim))

    def on_the_way(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, ""]:
        bend = _bend(env, before, sim, self.of) + _bend(env, before, sim, self.to)
        return closest_approach(self._apart(before), self._apart(sim)) - bend

    def _apart(self, sim: Sim) -> Float[Array, " d"]:
        return sim.platforms[self.of].position - sim.platforms[self.to].position


class RegionDistance(Status, type="region_distance"):
    """Distance of a platform to the centre of a region."""

    of: PlatformName
    region: RegionName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(self._apart(sim))

    def on_the_way(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, ""]:
        bend = _bend(env, before, sim, self.of)  # the region is assumed to move on a straight line
        return closest_approach(self._apart(before), self._apart(sim)) - bend

    def _apart(self, sim: Sim) -> Float[Array, " d"]:
        return sim.platforms[self.of].position - sim.regions[self.region].position


class InRegion(Status, type="in_region"):
    """Whether a platform is inside a region, Eq. (13)."""

    of: PlatformName
    region: RegionName

    def process(self, memory: Any, sim: Sim) -> Bool[Array, ""]:
        return sim.regions[self.region].inside[self.of]


class Hold(Record):
    """Memory of `TimeHeld`."""

    held: Bool[Array, ""]  # whether the status is true
    steps: Int[Array, ""]  # since the status became true
    time: Float[Array, ""]  # the same in s


class TimeHeld(Status, type="time_held"):
    """Time [s] since a boolean status became true, 0 while the status is false.

    With `first_sample` the step on which the status becomes true counts already. The sample at
    reset never counts.
    """

    status: FlagName
    first_sample: bool = False

    def init(self, sim: Sim) -> Hold:
        return Hold(
            held=jnp.asarray(sim.status[self.status]),
            steps=jnp.zeros((), jnp.int32),
            time=jnp.zeros_like(sim.time),
        )

    def increment(self, memory: Hold, sim: Sim, dt: Number) -> Hold:
        held = sim.status[self.status]
        steps = jnp.where(held & (memory.held | self.first_sample), memory.steps + 1, 0)
        return Hold(held=held, steps=steps, time=steps.astype(memory.time.dtype) * dt)

    def process(self, memory: Hold, sim: Sim) -> Float[Array, ""]:
        return memory.time


class Speed(Status, type="speed"):
    """Speed ‖v‖ of a platform."""

    of: PlatformName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(sim.platforms[self.of].velocity)


class VelocityLimit(Status, type="velocity_limit"):
    """Speed limit ν₀ + ν₁‖r‖ [m/s], which grows with a distance ‖r‖, Eqs. (14), (17).

    With `constant_to` only the part of the distance beyond it counts, so the limit is ν₀ up to
    there.
    """

    distance: StatusName
    floor: Annotated[MetresPerSecond, Range(0.0, largest=1e9)]
    slope: Annotated[PerSecond, Range(0.0, largest=1e3)]
    constant_to: Annotated[Length, Reach] = 0.0

    def problem(self) -> str | None:
        if self.floor == 0.0 and (self.slope == 0.0 or self.constant_to > 0.0):
            return (
                "expected a limit above 0 away from the centre: a floor,"
                " or a slope that begins there"
            )
        return None

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        distance = sim.status[self.distance]
        return self.floor + self.slope * jnp.maximum(distance - self.constant_to, 0.0)


class DeltaV(Status, type="delta_v"):
    """Velocity change ‖u/m‖Δt [m/s] by the thrust of the last step, 0 at reset.

    The control u is the one that acted, after run time assurance.
    """

    of: PlatformName
    norm: Literal["l1", "l2"] = "l2"

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        delta_v = sim.platforms[self.of].delta_v
        return safe_norm(delta_v) if self.norm == "l2" else jnp.sum(jnp.abs(delta_v))


def _bend(env: Environment, before: Sim, sim: Sim, name: str) -> Float[Array, ""]:
    """Return how far a platform's path may leave the straight line between two instants."""
    duration = sim.time - before.time
    return env.platform(name).bend(before.platforms[name], sim.platforms[name], duration)
