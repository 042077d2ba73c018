"""Safety constraints h ≥ 0.

They are evaluated at every step for `cost`, for `margins` and for the safety metrics of Section 5.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.processors.status import on_itself
from jaxsafe.processors.strengthening import Strengthening
from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.simulation.geometry import angle_between
from jaxsafe.simulation.vectors import Vector
from jaxsafe.types import (
    Extent,
    Length,
    Number,
    PlaceName,
    Radians,
    Reach,
    ShapeName,
    Sim,
    StatusName,
)

Bound = Annotated[Number, Unit("physical"), Range(largest=1e12)]
"""A limit of a status, in the unit of the status."""

Scale = Annotated[Number, Unit("physical"), Range(0.0, open_low=True, smallest=1e-12, largest=1e12)]
"""The violation −h, in the unit of h, whose severity is 1."""

SlackCost = Annotated[Number, Unit("1"), Range(0.0, open_low=True)]
"""Cost σ of missing a constraint."""


class Constraint(Component):
    """A signed margin h, which is safe where h ≥ 0, and a limit.

    The severity of a violation is −h as a share of the limit. The optional fields say how filters
    treat this constraint. A field that is left out has the value that the filter has for it.
    """

    name: str
    required_margin: Annotated[Number, Unit("the unit of the constraint"), Range(0.0)] | None = None
    """The h that a certificate asks for."""
    strengthening: Strengthening | None = None
    """The function α of the barrier row, for filters that have such rows."""
    degree: Annotated[int, Range(1, 3)] | None = None
    """How often h is differentiated until the control reaches it."""
    slack: SlackCost | None = None
    """The cost σ of missing the barrier row."""
    priority: Annotated[int, Range(0, largest=1000)] = 0
    """Barrier rows that cannot be met together are given up from the lowest priority on."""
    between: ClassVar[bool] = False
    """Whether h can fall far below 0 between two safe instants.

    If so, filters also bound h between the instants, with `Status.on_the_way`.
    """

    def margin(self, sim: Sim) -> Float[Array, ""]:
        """Return h in the unit of the limit."""
        raise NotImplementedError

    def limit(self, sim: Sim) -> Float[Array, ""]:
        """Return the limit at this step, which is positive."""
        raise NotImplementedError

    def margin_between(self, now: Sim, on_the_way: Sim) -> Float[Array, ""]:
        """Return the h of a predicted step. If `between`, it is a lower bound over the whole step.

        Args:
            now: the simulation after the step.
            on_the_way: the same with lower bounds of distances and depths within the step.
        """
        return self.margin(on_the_way if self.between else now)


class SpeedLimit(Constraint, type="speed_limit"):
    """The margin h = v_limit − ‖v‖ [m/s], Eqs. (14), (17)."""

    speed: StatusName
    velocity_limit: StatusName

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.velocity_limit] - sim.status[self.speed]

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.velocity_limit]


class Separation(Constraint, type="separation"):
    """The margin h = distance − minimum, Eqs. (8), (11)."""

    between: ClassVar[bool] = True
    distance: StatusName
    minimum: Annotated[Length, Extent]

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.distance] - self.minimum

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return self.minimum


class LowerLimit(Constraint, type="lower_limit"):
    """The margin h = status − minimum.

    A filter bounds it between two samples if the status is a distance or falls with a distance.
    """

    between: ClassVar[bool] = True
    status: StatusName
    minimum: Bound
    scale: Scale = 1.0

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.status] - self.minimum

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return self.scale

    def margin_between(self, now: Sim, on_the_way: Sim) -> Float[Array, ""]:
        # For a status that grows when a distance falls, the margin on the way is no lower bound.
        return jnp.minimum(self.margin(now), self.margin(on_the_way))


class UpperLimit(Constraint, type="upper_limit"):
    """The margin h = maximum − status. A filter keeps it at samples."""

    status: StatusName
    maximum: Bound
    scale: Scale = 1.0

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return self.maximum - sim.status[self.status]

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return self.scale


class KeepOut(Constraint, type="keep_out"):
    """The margin h = distance to the boundary of a region − clearance, negative inside the region.

    The distance is that of a platform, or of the centre of another region, such as the tip of a
    boom that a platform carries.
    A filter bounds it between two samples, so nothing slips through a corner of the region.
    """

    between: ClassVar[bool] = True
    of: PlaceName
    region: ShapeName
    clearance: Annotated[Length, Reach] = 0.0
    scale: Annotated[Length, Extent] = 1.0

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return sim.regions[self.region].distance[self.of] - self.clearance

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return self.scale

    def misfits(self, env: Any) -> dict[str, str]:
        return on_itself(env, self.of, self.region)


class KeepIn(KeepOut, type="keep_in"):
    """The margin h = depth below the boundary of a region − clearance, negative outside the region.

    A filter bounds it between two samples.
    """

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return sim.regions[self.region].depth[self.of] - self.clearance


class ConeConstraint(Constraint, type="cone"):
    """The margin between an angle and the half angle of a cone [rad].

    The angle is that between the `axis` of the cone and the direction to a target. `keep` says
    whether the target must stay inside the cone, such as a docking port in a camera's view, or
    outside, such as the sun. A filter keeps it at samples.
    """

    axis: Vector
    target: Vector
    half_angle: Annotated[Radians, Range(0.0, jnp.pi, open_low=True)]
    keep: Literal["inside", "outside"]

    def margin(self, sim: Sim) -> Float[Array, ""]:
        room = self.half_angle - angle_between(self.axis.value(sim), self.target.value(sim))
        return room if self.keep == "inside" else -room

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return self.half_angle
