"""What the docking tasks share: Sections 3 and 4, Tables 4, 6, 8 and 10. Lengths in m, speeds in m/s, forces in N."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp

from jaxsafe.processors.constraint import Constraint, SpeedLimit
from jaxsafe.processors.observation import Observation, Observe, ObserveStatus
from jaxsafe.processors.reward import Bound, DeltaVCost, DistanceChange, Failure, Reward, Success, VelocityConstraint
from jaxsafe.processors.status import DeltaV, Distance, InRegion, Speed, Status, VelocityLimit
from jaxsafe.processors.terminal import Crashed, Docked, Terminal, Timeout, TooFar
from jaxsafe.simulation.controllers import Actuator, Continuous
from jaxsafe.simulation.cwh import MEAN_MOTION, Anchor, Spacecraft
from jaxsafe.simulation.initializers import AtDistance, BelowSpeedLimit, Direction, Initializer

DOCKING_SPEED = 0.2
"""ν₀ of Eq. (14): the speed limit at the chief [m/s]."""

LIMIT_SLOPE = 2.0 * MEAN_MOTION
"""ν₁ of Eq. (14): growth of the speed limit with distance [1/s]."""

PLANAR = Direction()
SPATIAL = Direction(polar=(0.0, jnp.pi))


def chief(dimension: int) -> Anchor:
    """The passive target at the origin, Table 4."""
    return Anchor(name="chief", dimension=dimension)


def deputy_start(direction: Direction) -> tuple[Initializer, ...]:
    """100-150 m away, at a random velocity within the speed limit, Table 4."""
    return (
        AtDistance(name="position", about="chief", distance=(100.0, 150.0), direction=direction),
        BelowSpeedLimit(name="velocity", about="chief", floor=DOCKING_SPEED, slope=LIMIT_SLOPE, direction=direction),
    )


def deputy(dimension: Literal[2, 3]) -> Spacecraft:
    """The active spacecraft, Table 4."""
    return Spacecraft(
        name="deputy",
        dimension=dimension,
        start=deputy_start(PLANAR if dimension == 2 else SPATIAL),
        controller=Continuous(
            actuators=tuple(Actuator(name=f"thrust_{axis}", low=-1.0, high=1.0, points=11) for axis in "xyz"[:dimension])
        ),
    )


def docking_status() -> tuple[Status, ...]:
    """Distance, region, speed and its limit, and the Δv of the step."""
    return (
        Distance(name="docking_distance", of="deputy", to="chief"),
        InRegion(name="in_docking", of="deputy", region="docking_region"),
        Speed(name="speed", of="deputy"),
        VelocityLimit(name="velocity_limit", distance="docking_distance", floor=DOCKING_SPEED, slope=LIMIT_SLOPE),
        DeltaV(name="delta_v", of="deputy", norm="l2"),
        DeltaV(name="delta_v_l1", of="deputy", norm="l1"),
    )


def docking_constraints() -> tuple[Constraint, ...]:
    """The speed limit, Eqs. (14), (17)."""
    return (SpeedLimit(name="velocity_limit", speed="speed", velocity_limit="velocity_limit"),)


def docking_terminal(timeout: float) -> tuple[Terminal, ...]:
    """Table 10; the bound on the velocity constraint's reward stands with that reward."""
    return (
        Docked(name="success", in_docking="in_docking", speed="speed", velocity_limit="velocity_limit"),
        Crashed(name="crash", in_docking="in_docking", speed="speed", velocity_limit="velocity_limit"),
        TooFar(name="distance", distance="docking_distance", limit=40_000.0),
        Timeout(name="timeout", limit=timeout),
    )


def docking_reward(timeout: float) -> tuple[Reward, ...]:
    """Table 8."""
    return (
        DistanceChange(name="distance_change", distance="docking_distance", half_distance=100.0, scale=2.0),
        VelocityConstraint(
            name="velocity_constraint",
            speed="speed",
            velocity_limit="velocity_limit",
            offset=-0.01,
            scale=-0.01,
            bound=Bound(below=-5.0, outcome="velocity"),
        ),
        DeltaVCost(name="delta_v", delta_v="delta_v", scale=-0.01),
        Success(name="success", outcome="success", value=2.0, time_scale=timeout),
        Failure(name="failure", values={"crash": -1.0, "distance": -1.0, "timeout": -1.0, "velocity": 0.0}),
    )


def docking_observation() -> tuple[Observation, ...]:
    """Table 6, in Hill's frame."""
    return (
        Observe(name="position", of="deputy", what="position", scale=100.0),
        Observe(name="velocity", of="deputy", what="velocity", scale=0.5),
        *speed_observation(),
    )


def speed_observation() -> tuple[Observation, ...]:
    """The last two rows of each part of Table 6."""
    return (
        ObserveStatus(name="speed", status="speed"),
        ObserveStatus(name="velocity_limit", status="velocity_limit"),
    )


RELEASED = {
    "status.velocity_limit.constant_to": 0.5,
    "status.delta_v.norm": "l1",
    "terminal.success.apart": True,
    "terminal.distance.inclusive": True,
    "terminal": ["success", "timeout", "distance", "crash"],
}
"""What the released code does otherwise."""
