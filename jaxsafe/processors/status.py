"""Statuses: named facts about the simulated world, computed in order, so a later one may use an earlier one."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.component import Range
from jaxsafe.processors.processor import Processor
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.types import MetresPerSecond, PerSecond, PlatformName, RegionName, Sim, StatusName


class Status(Processor):
    """Base of all statuses."""


class Distance(Status, type="distance"):
    """Distance ‖r_of − r_to‖ between two platforms."""

    of: PlatformName
    to: PlatformName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(sim.platforms[self.of].position - sim.platforms[self.to].position)


class InRegion(Status, type="in_region"):
    """Whether a platform is inside a region, Eq. (13)."""

    of: PlatformName
    region: RegionName

    def process(self, memory: Any, sim: Sim) -> Bool[Array, ""]:
        return sim.regions[self.region].inside[self.of]


class Speed(Status, type="speed"):
    """Speed ‖v‖ of a platform."""

    of: PlatformName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(sim.platforms[self.of].velocity)


class VelocityLimit(Status, type="velocity_limit"):
    """Distance-dependent speed limit ν₀ + ν₁‖r‖, Eqs. (14), (17)."""

    distance: StatusName
    floor: Annotated[MetresPerSecond, Range(0.0)]
    slope: Annotated[PerSecond, Range(0.0)]

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return self.floor + self.slope * sim.status[self.distance]


class DeltaV(Status, type="delta_v"):
    """Velocity change bought with thrust in the last step, ‖u/m‖Δt, 0 at reset; u is the control that acted."""

    of: PlatformName
    norm: Literal["l1", "l2"] = "l2"

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        delta_v = sim.platforms[self.of].delta_v
        return safe_norm(delta_v) if self.norm == "l2" else jnp.sum(jnp.abs(delta_v))
