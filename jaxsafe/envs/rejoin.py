"""Aircraft rejoin: fly the wingman to the rejoin point of the lead and stay there for 20 s.

Sections 3 and 4, Tables 3, 5, 7 and 9 of the paper. Lengths are in ft, speeds in ft/s and angles in
rad.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

from jaxsafe.control.pursuit import Pursuit
from jaxsafe.environment import Environment
from jaxsafe.envs.task import Controllers, Filters, Task
from jaxsafe.processors.constraint import Constraint, Separation
from jaxsafe.processors.observation import Observation, Observe, ObserveRegion
from jaxsafe.processors.reward import (
    DistanceChange,
    Failure,
    FirstTime,
    Reward,
    Success,
    WhileIn,
)
from jaxsafe.processors.status import Distance, InRegion, RegionDistance, Status, TimeHeld
from jaxsafe.processors.terminal import Held, Terminal, Timeout, TooClose, TooFar
from jaxsafe.rta.asif import ExplicitASIF, ImplicitASIF, Polynomial
from jaxsafe.rta.backups import MatchVelocity, VelocityMatched
from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.simplex import CollisionSimplex, Simplex
from jaxsafe.schema.ties import Tie, Ties
from jaxsafe.simulation.controllers import Actuator, Continuous
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.initializers import AroundAtAltitude, AtDistance, Uniform
from jaxsafe.simulation.regions import Aspect, Circle, Cylinder
from jaxsafe.simulation.scripted import Constant, Scripted

HOLD = 20.0
"""Time to stay in the rejoin region [s], Table 9."""

SAFE_DISTANCE = 100.0
"""ρ_c of Eqs. (8), (11): the smallest distance to the lead [ft]."""

REJOIN_TIES: Ties = {
    "terminal.crash.limit": Tie(to="constraints.collision.minimum"),  # ρ_c of Table 9
    "reward.success.time_scale": Tie(to="terminal.timeout.limit"),  # t_max of Table 7
}
"""Numbers that follow others."""

REJOIN_POINT = Aspect(distance=500.0, angle=jnp.pi / 3)
"""Eq. (6): 500 ft from the lead, 60° from its tail."""

LEAD_DISTANCES = (5000.0, 10_000.0)
"""Distance of the wingman from the lead at the start [ft], Table 3."""

STRAIGHT = Scripted(commands=(Constant(name="heading_rate", at=0.0),))
"""The controller of the lead, which keeps its heading and its speed."""

HEADING = Uniform(name="heading", low=0.0, high=2.0 * jnp.pi)
LEAD_SPEED = Uniform(name="speed", low=250.0, high=300.0)
WINGMAN_SPEED = Uniform(name="speed", low=200.0, high=400.0)


def rejoin2d() -> Environment:
    """Return the rejoin in the plane."""
    timeout = 1000.0
    lead_position = Uniform(name="position", low=(5000.0, 5000.0), high=(10_000.0, 10_000.0))
    wingman_position = AtDistance(name="position", about="lead", distance=LEAD_DISTANCES)
    lead = Dubins2D(
        name="lead",
        start=(lead_position, HEADING, LEAD_SPEED),
        controller=STRAIGHT,
    )
    wingman = Dubins2D(
        name="wingman",
        start=(wingman_position, HEADING, WINGMAN_SPEED),
        controller=Continuous(
            actuators=(
                Actuator(name="heading_rate", low=-0.17, high=0.17, points=5),
                Actuator(name="acceleration", low=-96.5, high=96.5, points=5),
            )
        ),
    )
    return Environment(
        agent="wingman",
        dt=1.0,
        platforms=(lead, wingman),
        regions=(Circle(name="rejoin_region", on="lead", offset=REJOIN_POINT, radius=150.0),),
        status=rejoin_status(),
        constraints=rejoin_constraints(),
        terminal=rejoin_terminal(farthest=40_000.0, timeout=timeout),
        reward=rejoin_reward(timeout),
        observation=rejoin_observation(2),
        tied=REJOIN_TIES,
    )


def rejoin3d() -> Environment:
    """Return the rejoin in space."""
    timeout = 2000.0
    lead_position = Uniform(
        name="position",
        low=(5000.0, 5000.0, 12_000.0),
        high=(10_000.0, 10_000.0, 14_000.0),
    )
    wingman_position = AroundAtAltitude(
        name="position",
        about="lead",
        distance=LEAD_DISTANCES,
        altitude=(10_000.0, 16_000.0),
    )
    lead = Dubins3D(
        name="lead",
        start=(lead_position, HEADING, LEAD_SPEED),
        controller=STRAIGHT,
    )
    wingman = Dubins3D(
        name="wingman",
        start=(wingman_position, HEADING, WINGMAN_SPEED),
        controller=Continuous(
            actuators=(
                Actuator(name="roll_rate", low=-0.17, high=0.17, points=5),
                Actuator(name="flight_path_angle_rate", low=-0.09, high=0.09, points=5),
                Actuator(name="acceleration", low=-96.5, high=96.5, points=5),
            )
        ),
    )
    region = Cylinder(
        name="rejoin_region",
        on="lead",
        offset=REJOIN_POINT,
        radius=100.0,
        height=300.0,
    )
    return Environment(
        agent="wingman",
        dt=1.0,
        platforms=(lead, wingman),
        regions=(region,),
        status=rejoin_status(),
        constraints=rejoin_constraints(),
        terminal=rejoin_terminal(farthest=100_000.0, timeout=timeout),
        reward=rejoin_reward(timeout),
        observation=(
            *rejoin_observation(3),
            _observe_angle("roll", jnp.pi / 3),
            _observe_angle("flight_path_angle", jnp.pi / 9),
        ),
        tied=REJOIN_TIES,
    )


def rejoin_status() -> tuple[Status, ...]:
    """Return whether the wingman is in the rejoin region and since when, and its distances."""
    return (
        InRegion(name="in_rejoin", of="wingman", region="rejoin_region"),
        TimeHeld(name="rejoin_time", status="in_rejoin"),
        Distance(name="lead_distance", of="wingman", to="lead"),
        RegionDistance(name="rejoin_distance", of="wingman", region="rejoin_region"),
    )


def rejoin_constraints() -> tuple[Constraint, ...]:
    """Return the safe separation, Eqs. (8), (11)."""
    return (Separation(name="collision", distance="lead_distance", minimum=SAFE_DISTANCE),)


def rejoin_terminal(farthest: float, timeout: float) -> tuple[Terminal, ...]:
    """Return the terminal conditions of Table 9."""
    return (
        Held(name="success", time="rejoin_time", duration=HOLD),
        TooClose(name="crash", distance="lead_distance", limit=SAFE_DISTANCE),
        TooFar(name="distance", distance="lead_distance", limit=farthest),
        Timeout(name="timeout", limit=timeout),
    )


def rejoin_reward(timeout: float) -> tuple[Reward, ...]:
    """Return the reward terms of Table 7."""
    failures = {"crash": -1.0, "distance": -1.0, "timeout": -1.0}
    return (
        DistanceChange(
            name="distance_change",
            distance="lead_distance",
            half_distance=5000.0,
            scale=2.0,
        ),
        WhileIn(name="in_rejoin", status="in_rejoin", value=0.1),
        FirstTime(name="in_rejoin_first_time", status="in_rejoin", value=0.25),
        Success(name="success", outcome="success", value=2.0, time_scale=timeout),
        Failure(name="failure", values=failures),
    )


def rejoin_observation(dimension: int) -> tuple[Observation, ...]:
    """Return the vectors of Table 5, as magnitudes and directions seen from the wingman."""
    lengths = (1000.0, *(1.0,) * dimension)
    speeds = (400.0, *(1.0,) * dimension)
    seen = {"frame": "wingman", "form": "magnorm", "clip": (-1.0, 1.0)}
    position = {"relative_to": "wingman", "scale": lengths, **seen}
    velocity = {"what": "velocity", "scale": speeds, **seen}
    return (
        Observe(name="lead_position", of="lead", what="position", **position),
        ObserveRegion(name="rejoin_position", region="rejoin_region", **position),
        Observe(name="wingman_velocity", of="wingman", **velocity),
        Observe(name="lead_velocity", of="lead", **velocity),
    )


def _observe_angle(name: str, scale: float) -> Observe:
    return Observe(name=name, of="wingman", what=name, scale=scale, clip=(-1.0, 1.0))


RELEASED: Mapping[str, Any] = {
    "status.rejoin_time.first_sample": True,
    "terminal.success.inclusive": False,
    "terminal.success.apart": True,
    "terminal.crash.inclusive": False,
    "terminal.distance.inclusive": True,
    "terminal": ["success", "crash", "timeout", "distance"],
    "reward.distance_change.distance": "rejoin_distance",
    "reward.in_rejoin.both_samples": True,
    "reward.in_rejoin_first_time.count_start": False,
}
"""What the released code does otherwise in both tasks, by dotted path."""

RELEASED_2D: Mapping[str, Any] = RELEASED | {
    "wingman.controller.actuators.heading_rate.low": -0.174533,
    "wingman.controller.actuators.heading_rate.high": 0.174533,
}

RELEASED_3D: Mapping[str, Any] = RELEASED | {
    "wingman.controller.actuators.flight_path_angle_rate.low": -0.17,
    "wingman.controller.actuators.flight_path_angle_rate.high": 0.17,
    "wingman.controller.actuators.roll_rate.low": -0.09,
    "wingman.controller.actuators.roll_rate.high": 0.09,
    "wingman.controller.actuators": ["flight_path_angle_rate", "roll_rate", "acceleration"],
}
"""The same in space. In the released code the ailerons drive γ, and the elevator drives φ."""

MATCH_2D: dict[str, Any] = {
    "constraints": ("collision",),
    "margin": 1.0,  # [ft], by which the prediction and the plant may differ in float32
    "backups": tuple(
        MatchVelocity(name=turn, lead="lead", clearance=101.0, turn=turn)
        for turn in ("left", "right")
    ),
    "horizon": 40,
    "terminal": VelocityMatched(of="wingman", to="lead", tolerance=1.0, clearance=101.0),
}
"""Filters that keep a way out open: a left or right turn until the wingman flies as the lead."""

ROBUST_2D: dict[str, Any] = MATCH_2D | {
    "backups": tuple(
        MatchVelocity(name=turn, lead="lead", clearance=157.0, turn=turn, dead_zone=0.5)
        for turn in ("left", "right")
    ),
    "horizon": 44,
    "terminal": VelocityMatched(of="wingman", to="lead", tolerance=10.0, clearance=107.0),
    "bound": UncertaintyBound(process=1.0),  # [ft/s²]
}
"""The same within an uncertainty bound. The distances suffice for the largest one allowed."""

MATCH_3D: dict[str, Any] = {
    "constraints": ("collision",),
    "margin": 2.0,
    "backups": tuple(
        MatchVelocity(name=f"{turn}_{climb}", lead="lead", clearance=102.0, turn=turn, climb=climb)
        for turn in ("left", "right")
        for climb in ("up", "down")
    ),
    "horizon": 60,
    "terminal": VelocityMatched(
        of="wingman",
        to="lead",
        tolerance=4.0,
        clearance=102.0,
        drift=9.0,
        lag=1.0,
    ),
}
"""Filters that keep a way out open in space, where a turn may also climb or dive."""

ROBUST_3D: dict[str, Any] = MATCH_3D | {
    "backups": tuple(
        MatchVelocity(
            name=f"{turn}_{climb}",
            lead="lead",
            clearance=204.0,
            turn=turn,
            climb=climb,
            dead_zone=0.5,
            away_time=25,
        )
        for turn in ("left", "right")
        for climb in ("up", "down")
    ),
    "horizon": 72,
    "terminal": VelocityMatched(of="wingman", to="lead", tolerance=0.75, clearance=204.0),
    "bound": UncertaintyBound(process=0.3),  # [ft/s²]
}
"""The same within an uncertainty bound. In space turning takes longer."""

_ALPHA = Polynomial(linear=0.2)
"""Strengthening function of the filters from the literature, Eq. (3)."""


def _explicit_asif(backup: MatchVelocity) -> ExplicitASIF:
    """Return the paper's continuous-time filter for comparison. Its solution acts unchecked."""
    return ExplicitASIF(
        constraints=("collision",),
        backups=(backup,),
        enforce=False,
        strengthening=_ALPHA,
        degree=2,
    )


FILTERS_2D: Filters = {
    "default": lambda: Simplex(**MATCH_2D),
    "implicit_simplex": lambda: Simplex(**MATCH_2D),
    "implicit_asif": lambda: ImplicitASIF(**MATCH_2D),
    "robust": lambda: Simplex(**ROBUST_2D),
    "explicit_asif": lambda: _explicit_asif(MATCH_2D["backups"][0]),
    "released": lambda: CollisionSimplex(other="lead"),
}

FILTERS_3D: Filters = {
    "default": lambda: Simplex(**MATCH_3D),
    "implicit_simplex": lambda: Simplex(**MATCH_3D),
    "implicit_asif": lambda: ImplicitASIF(**MATCH_3D),
    "robust": lambda: Simplex(**ROBUST_3D),
    "explicit_asif": lambda: _explicit_asif(MATCH_3D["backups"][0]),
}

CONTROLLERS: Controllers = {"pursuit": Pursuit}

TASKS = (
    Task(
        name="rejoin2d",
        environment=rejoin2d,
        released=RELEASED_2D,
        filters=FILTERS_2D,
        controllers=CONTROLLERS,
        gymnasium_id="jaxsafe/Rejoin2D-v0",
        recipe="rejoin2d.yaml",
        paper_steps=300_000,
        reference_returns={"random": -1.705, "expert": 5.437},
    ),
    Task(
        name="rejoin3d",
        environment=rejoin3d,
        released=RELEASED_3D,
        filters=FILTERS_3D,
        controllers=CONTROLLERS,
        gymnasium_id="jaxsafe/Rejoin3D-v0",
        recipe="rejoin3d.yaml",
        paper_steps=2_300_000,
        reference_returns={"random": -1.701, "expert": 5.467},
    ),
)
"""The tasks of this domain."""
