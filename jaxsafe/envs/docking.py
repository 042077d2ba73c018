"""Spacecraft docking: fly the deputy to within 0.5 m of the chief and keep to the speed limit.

Sections 3 and 4, Tables 4, 6, 8 and 10 of the paper. Lengths are in m, speeds in m/s and forces in
N.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import jax.numpy as jnp

from jaxsafe.control.docking import LQR, MPC, PD, Align
from jaxsafe.environment import Environment
from jaxsafe.envs.task import Controllers, Filters, Task
from jaxsafe.processors.constraint import Constraint, SpeedLimit
from jaxsafe.processors.observation import Observation, Observe, ObserveAngle, ObserveStatus
from jaxsafe.processors.reward import (
    Bound,
    DeltaVCost,
    DistanceChange,
    Failure,
    Reward,
    Success,
    VelocityConstraint,
)
from jaxsafe.processors.status import DeltaV, Distance, InRegion, Speed, Status, VelocityLimit
from jaxsafe.processors.terminal import Crashed, Docked, Terminal, Timeout, TooFar
from jaxsafe.rta.asif import DiscreteASIF, ExplicitASIF, ImplicitASIF, Polynomial
from jaxsafe.rta.backups import AlignAndBrake, AlignedOrSlow, Brake, Slow
from jaxsafe.rta.backups_with_memory import Rehearsed
from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.simplex import Simplex
from jaxsafe.schema.ties import Tie, Ties
from jaxsafe.simulation.controllers import Actuator, Continuous
from jaxsafe.simulation.cwh import MEAN_MOTION, Anchor, Spacecraft
from jaxsafe.simulation.double_integrator import DoubleIntegrator
from jaxsafe.simulation.initializers import (
    AtDistance,
    BelowSpeedLimit,
    Direction,
    Initializer,
    Uniform,
)
from jaxsafe.simulation.oriented import RATE_LIMIT, OrientedSpacecraft
from jaxsafe.simulation.regions import Circle, Region, Sphere

DOCKING_SPEED = 0.2
"""ν₀ of Eq. (14): the speed limit at the chief [m/s]."""

LIMIT_SLOPE = 2.0 * MEAN_MOTION
"""ν₁ of Eq. (14): growth of the speed limit with distance [1/s]."""

DOCKING_RADIUS = 0.5
"""Radius of the docking region around the chief [m], Section 3."""

START_DISTANCES = (100.0, 150.0)
"""Smallest and largest distance of a start from the chief [m], Table 4."""

DOCKING_TIES: Ties = {
    "deputy.start.velocity.floor": Tie(to="status.velocity_limit.floor"),
    "deputy.start.velocity.slope": Tie(to="status.velocity_limit.slope"),
    "reward.success.time_scale": Tie(to="terminal.timeout.limit"),  # t_max of Table 8
}
"""Numbers that follow others. So a start is within the speed limit, whatever the limit is."""

ORBIT_TIES: Ties = {
    **DOCKING_TIES,
    "status.velocity_limit.slope": Tie(to="deputy.mean_motion", times=2.0),  # ν₁ = 2n, Eq. (14)
}
"""Numbers that follow others where there is an orbit."""

ONE_DEGREE = jnp.pi / 180.0

LINEAR = Direction(azimuth=None)
PLANAR = Direction()
SPATIAL = Direction(polar=(0.0, jnp.pi))


def docking(dimension: Literal[1, 2, 3]) -> Environment:
    """Return docking on a line, in the plane or in space, without orientation.

    On a line there is no orbit, so the deputy is a double integrator there.
    """
    timeout = 2000.0
    return Environment(
        agent="deputy",
        dt=1.0,
        platforms=(Anchor(name="chief", dimension=dimension), deputy(dimension)),
        regions=(docking_region(dimension),),
        status=docking_status(),
        constraints=docking_constraints(),
        terminal=docking_terminal(timeout),
        reward=docking_reward(timeout),
        observation=(
            Observe(name="position", of="deputy", what="position", scale=100.0),
            Observe(name="velocity", of="deputy", what="velocity", scale=0.5),
            *speed_observation(),
        ),
        tied=DOCKING_TIES if dimension == 1 else ORBIT_TIES,
    )


def docking_oriented() -> Environment:
    """Return docking in the plane with thrust along the body axis and a reaction wheel."""
    timeout = 3000.0
    attitude = Uniform(name="attitude", low=0.0, high=2.0 * jnp.pi)
    deputy = OrientedSpacecraft(
        name="deputy",
        start=(*deputy_start(PLANAR), attitude),
        controller=Continuous(
            actuators=(
                Actuator(name="thrust", low=-1.0, high=2.0, points=11, zero_centred=True),
                Actuator(name="attitude_acceleration", low=-ONE_DEGREE, high=ONE_DEGREE, points=11),
            )
        ),
    )
    chief_from_deputy: dict[str, Any] = {"of": "chief", "what": "position", "relative_to": "deputy"}
    return Environment(
        agent="deputy",
        dt=1.0,
        platforms=(Anchor(name="chief", dimension=2), deputy),
        regions=(docking_region(2),),
        status=docking_status(),
        constraints=docking_constraints(),
        terminal=docking_terminal(timeout),
        reward=docking_reward(timeout),
        observation=(
            Observe(name="position", frame="deputy", scale=100.0, **chief_from_deputy),
            Observe(name="velocity", of="deputy", what="velocity", frame="deputy", scale=0.5),
            ObserveAngle(name="attitude", of="deputy", what="attitude", scale=-1.0),
            Observe(name="attitude_rate", of="deputy", what="attitude_rate", scale=RATE_LIMIT),
            *speed_observation(),
        ),
        tied=ORBIT_TIES,
    )


def deputy(dimension: Literal[1, 2, 3]) -> Spacecraft | DoubleIntegrator:
    """Return the active spacecraft, Table 4."""
    thrusters = [f"thrust_{axis}" for axis in "xyz"[:dimension]]
    platform = DoubleIntegrator if dimension == 1 else Spacecraft
    return platform(
        name="deputy",
        dimension=dimension,
        start=deputy_start({1: LINEAR, 2: PLANAR, 3: SPATIAL}[dimension]),
        controller=Continuous(
            actuators=tuple(
                Actuator(name=name, low=-1.0, high=1.0, points=11) for name in thrusters
            )
        ),
    )


def deputy_start(direction: Direction) -> tuple[Initializer, ...]:
    """Return the start of Table 4: 100 to 150 m away, at a random velocity within the limit."""
    return (
        AtDistance(name="position", about="chief", distance=START_DISTANCES, direction=direction),
        BelowSpeedLimit(
            name="velocity",
            about="chief",
            floor=DOCKING_SPEED,
            slope=LIMIT_SLOPE,
            direction=direction,
        ),
    )


def docking_region(dimension: Literal[1, 2, 3]) -> Region:
    """Return the docking region around the chief, Section 3."""
    shape = Circle if dimension == 2 else Sphere
    return shape(name="docking_region", on="chief", radius=DOCKING_RADIUS)


def docking_status() -> tuple[Status, ...]:
    """Return the distance, whether the deputy is docking, its speed and the limit, and the Δv."""
    return (
        Distance(name="docking_distance", of="deputy", to="chief"),
        InRegion(name="in_docking", of="deputy", region="docking_region"),
        Speed(name="speed", of="deputy"),
        VelocityLimit(
            name="velocity_limit",
            distance="docking_distance",
            floor=DOCKING_SPEED,
            slope=LIMIT_SLOPE,
        ),
        DeltaV(name="delta_v", of="deputy", norm="l2"),
        DeltaV(name="delta_v_l1", of="deputy", norm="l1"),
    )


def docking_constraints() -> tuple[Constraint, ...]:
    """Return the speed limit, Eqs. (14), (17)."""
    return (SpeedLimit(name="velocity_limit", speed="speed", velocity_limit="velocity_limit"),)


def docking_terminal(timeout: float) -> tuple[Terminal, ...]:
    """Return the terminal conditions of Table 10, without the one that is a bound of the reward."""
    return (
        Docked(
            name="success",
            in_docking="in_docking",
            speed="speed",
            velocity_limit="velocity_limit",
        ),
        Crashed(
            name="crash",
            in_docking="in_docking",
            speed="speed",
            velocity_limit="velocity_limit",
        ),
        TooFar(name="distance", distance="docking_distance", limit=40_000.0),
        Timeout(name="timeout", limit=timeout),
    )


def docking_reward(timeout: float) -> tuple[Reward, ...]:
    """Return the reward terms of Table 8."""
    failures = {"crash": -1.0, "distance": -1.0, "timeout": -1.0, "velocity": 0.0}
    return (
        DistanceChange(
            name="distance_change",
            distance="docking_distance",
            half_distance=100.0,
            scale=2.0,
        ),
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
        Failure(name="failure", values=failures),
    )


def speed_observation() -> tuple[Observation, ...]:
    """Return the last two rows of each part of Table 6: the speed and its limit."""
    return (
        ObserveStatus(name="speed", status="speed"),
        ObserveStatus(name="velocity_limit", status="velocity_limit"),
    )


RELEASED: Mapping[str, Any] = {
    "status.velocity_limit.constant_to": 0.5,
    "status.delta_v.norm": "l1",
    "terminal.success.apart": True,
    "terminal.distance.inclusive": True,
    "terminal": ["success", "timeout", "distance", "crash"],
}
"""What the released code does otherwise, by dotted path."""

RELEASED_ORIENTED: Mapping[str, Any] = RELEASED | {
    "deputy.start.attitude.low": -jnp.pi,
    "deputy.start.attitude.high": jnp.pi,
    "observation.position.of": "deputy",
    "observation.position.relative_to": "chief",
    "observation.attitude_rate.scale": 0.0349066,
}
"""What the released code of oriented docking does otherwise, by dotted path."""

LIMIT_MARGIN = 2.5e-4
"""Margin of the filters below the speed limit at samples [m/s].

It makes the limit hold inside a step as well. Near the chief the distance falls below its values at
the samples, by up to half the way of a step.
"""

BRAKE: dict[str, Any] = {
    "constraints": ("velocity_limit",),
    "margin": LIMIT_MARGIN,
    "backups": (Brake(name="brake"),),
}
"""Filters without a horizon: braking holds the limit from one step to the next.

The proof is in docs/safety/proofs.md.
"""

SMALL_BOUND = UncertaintyBound(
    process=0.001, mass=0.02, misalignment=0.02, position=0.1, velocity=0.001
)
"""The bound of the preset `robust`, unless another one is given.

It allows for a push of 1 mm/s in a step, an error of 2 % of the mass, a thrust that is off by 0.02
rad, and a measured state that is wrong by 10 cm and 1 mm/s.
"""

STOP: dict[str, Any] = {**BRAKE, "horizon": 16, "terminal": Slow(speed=0.19)}
"""Filters that predict braking until hardly any speed is left, as if there were no proof for it."""

TURN: dict[str, Any] = {
    "constraints": ("velocity_limit",),
    "margin": LIMIT_MARGIN,
    "backups": (AlignAndBrake(name="align", constraint="velocity_limit", margin=LIMIT_MARGIN),),
    "horizon": 14,
    "terminal": AlignedOrSlow(angle=math.radians(75.0), speed=0.15),
}
"""Filters of the oriented spacecraft, which must turn before it can brake."""

ROBUST_TURN: dict[str, Any] = TURN | {
    "backups": (Rehearsed(name="rehearsed", backup=TURN["backups"][0]),),
    "terminal": AlignedOrSlow(angle=math.radians(75.0), speed=0.125),
    "bound": UncertaintyBound(process=1e-4),  # [m/s²]
}
"""The same within an uncertainty bound. What is slow suffices for the largest one allowed."""

_ALPHA = Polynomial(linear=0.05, cubic=0.1)
"""Strengthening function of the filters from the literature, Eq. (3)."""


def _explicit_asif(backup: AlignAndBrake | Brake) -> ExplicitASIF:
    """Return the paper's continuous-time filter for comparison. Its solution acts unchecked."""
    return ExplicitASIF(
        constraints=("velocity_limit",),
        backups=(backup,),
        enforce=False,
        strengthening=_ALPHA,
    )


FILTERS: Filters = {
    "default": lambda: DiscreteASIF(**BRAKE),
    "robust": lambda: DiscreteASIF(**BRAKE, bound=SMALL_BOUND),
    "discrete_asif": lambda: DiscreteASIF(**BRAKE),
    "explicit_simplex": lambda: Simplex(**BRAKE),
    "implicit_simplex": lambda: Simplex(**STOP),
    "implicit_asif": lambda: ImplicitASIF(**STOP),
    "explicit_asif": lambda: _explicit_asif(BRAKE["backups"][0]),
}

FILTERS_ORIENTED: Filters = {
    "default": lambda: Simplex(**TURN),
    "robust": lambda: Simplex(**ROBUST_TURN),
    "implicit_simplex": lambda: Simplex(**TURN),
    "implicit_asif": lambda: ImplicitASIF(**TURN),
    "explicit_asif": lambda: _explicit_asif(TURN["backups"][0]),
}

CONTROLLERS: Controllers = {"pd": PD, "lqr": LQR, "mpc": MPC}

CONTROLLERS_ORIENTED: Controllers = {"align": Align}

TASKS = (
    Task(
        name="docking2d",
        environment=lambda: docking(2),
        released=RELEASED,
        filters=FILTERS,
        controllers=CONTROLLERS,
        gymnasium_id="jaxsafe/Docking2D-v0",
        recipe="docking2d.yaml",
        paper_steps=340_000,
        reference_returns={"random": -5.951, "expert": 2.855},
    ),
    Task(
        name="docking3d",
        environment=lambda: docking(3),
        released=RELEASED,
        filters=FILTERS,
        controllers=CONTROLLERS,
        gymnasium_id="jaxsafe/Docking3D-v0",
        recipe="docking3d.yaml",
        paper_steps=660_000,
        reference_returns={"random": -5.954, "expert": 2.811},
    ),
    Task(
        name="docking2d_oriented",
        environment=docking_oriented,
        released=RELEASED_ORIENTED,
        filters=FILTERS_ORIENTED,
        controllers=CONTROLLERS_ORIENTED,
        gymnasium_id="jaxsafe/Docking2DOriented-v0",
        recipe="docking2d_oriented.yaml",
        paper_steps=1_500_000,
        reference_returns={"random": -5.858, "expert": 2.919},
    ),
)
"""The tasks of this domain."""

STARTERS = (
    Task(
        name="docking1d",
        environment=lambda: docking(1),
        filters=FILTERS,
        controllers=CONTROLLERS,
        gymnasium_id="jaxsafe/Docking1D-v0",
        recipe="docking1d.yaml",
        starter=True,
    ),
)
"""A small task to begin with. The paper does not have it, but its published code does."""
