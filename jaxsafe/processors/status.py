"""Statuses: named facts about the simulated world, each a number or a truth value.

They are computed in order, so a later status may use an earlier one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.processors.processor import Limit, Processor, Side, beyond
from jaxsafe.schema.component import ANY, Range, Unit
from jaxsafe.schema.errors import choices_text
from jaxsafe.simulation.between import bend
from jaxsafe.simulation.geometry import angle_between, closest_approach, safe_norm, to_body
from jaxsafe.simulation.vectors import Vector
from jaxsafe.types import (
    AnyStatusName,
    FlagName,
    Length,
    MetresPerSecond,
    Number,
    PerSecond,
    PlaceName,
    PlatformName,
    Reach,
    Record,
    RegionName,
    ShapeName,
    Sim,
    StatusName,
    place,
)

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


Weight = Annotated[Number, Unit("physical"), Range(largest=1e12)]
"""A factor or a summand of a status."""


class Status(Processor):
    """Base of all statuses."""

    per_step: ClassVar[bool] = False
    """Whether the value belongs to the last step and not to the instant after it.

    With a `decision_period`, `info` has the sum of such values over its steps.
    """

    def on_the_way(self, env: Environment, before: Sim, sim: Sim) -> Any:
        """Return the output over the step from `before` to `sim`.

        For distances it is a lower bound on the way between the two. For other statuses it is the
        output at `sim`.
        """
        return self.process(self.init(sim), sim)

    def vectors(self) -> tuple[tuple[str, str], ...]:
        """Return the vectors whose norm this status is, as places and fields.

        If one of their numbers is NaN, so is the status.
        """
        return ()


class Distance(Status, type="distance"):
    """Distance ‖r_of − r_to‖ between two platforms or centres of regions."""

    of: PlaceName
    to: PlaceName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(_apart(sim, self.of, self.to))

    def vectors(self) -> tuple[tuple[str, str], ...]:
        return (self.of, "position"), (self.to, "position")

    def on_the_way(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, ""]:
        return _nearest(env, before, sim, self.of, self.to)


class RegionDistance(Status, type="region_distance"):
    """Distance of a platform or of a region's centre to the centre of a region."""

    of: PlaceName
    region: RegionName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(place(sim, self.of).position - sim.regions[self.region].position)

    def on_the_way(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, ""]:
        return _nearest(env, before, sim, self.of, self.region)

    def misfits(self, env: Environment) -> dict[str, str]:
        return on_itself(env, self.of, self.region)


class SignedDistance(Status, type="signed_distance"):
    """Distance of a platform or a region's centre to the boundary of a region, negative inside."""

    of: PlaceName
    region: ShapeName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return sim.regions[self.region].distance[self.of]

    def misfits(self, env: Environment) -> dict[str, str]:
        return on_itself(env, self.of, self.region)


class InRegion(Status, type="in_region"):
    """Whether a platform or the centre of another region is inside a region, Eq. (13)."""

    of: PlaceName
    region: RegionName

    def misfits(self, env: Environment) -> dict[str, str]:
        return on_itself(env, self.of, self.region)

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


class ElapsedTime(Status, type="elapsed_time"):
    """Time [s] since the start of the episode."""

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return sim.time


class Speed(Status, type="speed"):
    """Speed ‖v‖ of a platform or of a region's centre."""

    of: PlaceName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(place(sim, self.of).velocity)

    def vectors(self) -> tuple[tuple[str, str], ...]:
        # The thrust's change of velocity is part of the velocity.
        return (self.of, "velocity"), (self.of, "delta_v")


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

    per_step: ClassVar[bool] = True
    of: PlatformName
    norm: Literal["l1", "l2"] = "l2"

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        delta_v = sim.platforms[self.of].delta_v
        return safe_norm(delta_v) if self.norm == "l2" else jnp.sum(jnp.abs(delta_v))


class RelativeSpeed(Status, type="relative_speed"):
    """Speed ‖v_of − v_to‖ of two platforms or centres of regions against each other."""

    of: PlaceName
    to: PlaceName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(place(sim, self.of).velocity - place(sim, self.to).velocity)


class Angle(Status, type="angle"):
    """Angle [rad] between two vectors, from 0 to π. It is 0 where one of them is 0."""

    first: Vector
    second: Vector

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return angle_between(self.first.value(sim), self.second.value(sim))


class Magnitude(Status, type="magnitude"):
    """Magnitude ‖v‖ of a vector."""

    vector: Vector

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(self.vector.value(sim))


class VectorComponent(Status, type="component"):
    """One component of a vector.

    `frame` names the platform or region along whose body axis it is. None stands for the global
    frame.
    """

    vector: Vector
    axis: Literal["x", "y", "z"]
    frame: PlaceName | None = None

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        vector = self.vector.value(sim)
        if self.frame is not None:
            vector = to_body(place(sim, self.frame).orientation, vector)
        return vector["xyz".index(self.axis)]

    def misfits(self, env: Environment) -> dict[str, str]:
        axes = "xyz"[: env.agent_platform.dimension]
        if self.axis in axes:
            return {}
        return {"axis": f"found {self.axis!r}{choices_text(self.axis, axes)}"}


class ControlStatus(Status):
    """Base of statuses of the control of the last step, which is 0 at reset.

    `actual` is the control that acted, after run time assurance, and `desired` is what the agent
    asked for.
    """

    which: Literal["actual", "desired"] = "actual"

    def control(self, sim: Sim) -> Float[Array, " actuators"]:
        """Return the control in physical units and in the order of the action."""
        return sim.control_actual if self.which == "actual" else sim.control_desired


class ControlComponent(ControlStatus, type="control"):
    """One control of the last step, in its physical unit.

    `element` is its index in `env.action_names`. The first one is 0.
    """

    element: Annotated[int, Range(0, largest=1000)]

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return self.control(sim)[self.element]

    def misfits(self, env: Environment) -> dict[str, str]:
        if self.element < env.action_size:
            return {}
        elements = ", ".join(f"{i} ({name})" for i, name in enumerate(env.action_names))
        return {"element": f"found {self.element}; choose from {elements}"}


class ControlNorm(ControlStatus):
    """Base of statuses that measure the size of a control.

    Each control is divided by its `scale`, which is one number for all or one for each. The size is
    the Euclidean norm `l2`, or the sum of magnitudes `l1`.
    """

    scale: Annotated[
        Number, Unit("physical", length=ANY), Range(0.0, open_low=True, smallest=1e-12)
    ] = 1.0
    norm: Literal["l1", "l2"] = "l2"

    def size(self, control: Float[Array, " actuators"]) -> Float[Array, ""]:
        scaled = control / self.scale
        return safe_norm(scaled) if self.norm == "l2" else jnp.sum(jnp.abs(scaled))

    def misfits(self, env: Environment) -> dict[str, str]:
        if jnp.shape(self.scale) in ((), (env.action_size,)):
            return {}
        found = jnp.size(self.scale)
        return {"scale": f"expected 1 or {env.action_size} numbers, found {found}"}


class ControlEffort(ControlNorm, type="control_effort"):
    """Size ‖u/scale‖ of the control of the last step."""

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return self.size(self.control(sim))


class Last(Record):
    """Memory of `Change` and `ControlChange`."""

    value: Array  # on the last sample
    change: Array  # since the sample before

    @classmethod
    def begin(cls, value: Array) -> Last:
        """Return the memory at the start of an episode."""
        return cls(value=value, change=jnp.zeros_like(value))

    def move(self, value: Array) -> Last:
        """Return the memory after a step."""
        return Last(value=value, change=value - self.value)


class ControlChange(ControlNorm, type="control_change"):
    """Size ‖(u_t − u_(t−1))/scale‖ of the change of the control. The first step changes it from 0.

    It is 0 for a smooth control.
    """

    def init(self, sim: Sim) -> Last:
        return Last.begin(self.control(sim))

    def increment(self, memory: Last, sim: Sim, dt: Number) -> Last:
        return memory.move(self.control(sim))

    def process(self, memory: Last, sim: Sim) -> Float[Array, ""]:
        return self.size(memory.change)


class Change(Status, type="change"):
    """Change of a status over the last step, 0 at reset."""

    status: StatusName

    def init(self, sim: Sim) -> Last:
        return Last.begin(sim.status[self.status])

    def increment(self, memory: Last, sim: Sim, dt: Number) -> Last:
        return memory.move(sim.status[self.status])

    def process(self, memory: Last, sim: Sim) -> Float[Array, ""]:
        return memory.change


class Accumulator(Status, type="accumulator"):
    """Sum of a status over the steps of the episode, such as the Δv that is used up.

    With `per_second` the status is a rate, and each step adds status·Δt. A truth value counts as 1
    or 0. The sample at reset adds nothing. Filters predict the sum too.
    """

    status: AnyStatusName
    per_second: bool = False

    def init(self, sim: Sim) -> Float[Array, ""]:
        return jnp.zeros_like(sim.time)

    def increment(self, memory: Float[Array, ""], sim: Sim, dt: Number) -> Float[Array, ""]:
        value = jnp.asarray(sim.status[self.status], memory.dtype)
        return memory + (value * dt if self.per_second else value)

    def process(self, memory: Float[Array, ""], sim: Sim) -> Float[Array, ""]:
        return memory


class Norm(Status, type="norm"):
    """Euclidean norm of several statuses."""

    statuses: tuple[StatusName, ...]

    def problem(self) -> str | None:
        return None if self.statuses else "expected at least one status"

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return safe_norm(jnp.stack([sim.status[name] for name in self.statuses]))


class LinearCombination(Status, type="linear_combination"):
    """Sum of statuses, each times its weight, and of an offset."""

    weights: Mapping[StatusName, Weight]
    offset: Weight = 0.0

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        total = self.offset
        for name, weight in self.weights.items():
            total = total + weight * sim.status[name]
        return total


class Threshold(Status, type="threshold"):
    """Whether a status is above or below a limit. If `inclusive`, the limit itself counts."""

    status: StatusName
    limit: Limit
    side: Side
    inclusive: bool = False

    def process(self, memory: Any, sim: Sim) -> Bool[Array, ""]:
        return beyond(sim.status[self.status], self.limit, self.side, self.inclusive)


class And(Status, type="and"):
    """Whether all of some boolean statuses are true."""

    statuses: tuple[FlagName, ...]

    def problem(self) -> str | None:
        return None if self.statuses else "expected at least one status"

    def process(self, memory: Any, sim: Sim) -> Bool[Array, ""]:
        return jnp.all(jnp.stack([sim.status[name] for name in self.statuses]))


class Or(And, type="or"):
    """Whether at least one of some boolean statuses is true."""

    def process(self, memory: Any, sim: Sim) -> Bool[Array, ""]:
        return jnp.any(jnp.stack([sim.status[name] for name in self.statuses]))


class Not(Status, type="not"):
    """Whether a boolean status is false."""

    status: FlagName

    def process(self, memory: Any, sim: Sim) -> Bool[Array, ""]:
        return jnp.logical_not(sim.status[self.status])


def on_itself(env: Environment, of: str, region: str) -> dict[str, str]:
    """Return what is wrong if a region is related to itself or to what carries it."""
    if of == region:
        return {"of": "it is the region itself; choose another"}
    if all((other.name, other.on) != (region, of) for other in env.regions):
        return {}
    return {"of": f"region {region!r} is on {of!r} itself; choose another"}


def _apart(sim: Sim, of: str, to: str) -> Float[Array, " d"]:
    return place(sim, of).position - place(sim, to).position


def _nearest(env: Environment, before: Sim, sim: Sim, of: str, to: str) -> Float[Array, ""]:
    """Return a lower bound of the distance of two platforms or regions within the step to `sim`."""
    bends = bend(env, before, sim, of) + bend(env, before, sim, to)
    return closest_approach(_apart(before, of, to), _apart(sim, of, to)) - bends
