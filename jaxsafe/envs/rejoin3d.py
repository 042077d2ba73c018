"""3D aircraft rejoin: fly the wingman to the rejoin point of the lead and stay there for 20 s (Section 3)."""

from __future__ import annotations

import jax.numpy as jnp

from jaxsafe.environment import Environment
from jaxsafe.envs import _rejoin
from jaxsafe.envs._rejoin import (
    HEADING,
    LEAD_DISTANCES,
    LEAD_SPEED,
    REJOIN_POINT,
    STRAIGHT,
    WINGMAN_SPEED,
    rejoin_constraints,
    rejoin_observation,
    rejoin_reward,
    rejoin_status,
    rejoin_terminal,
)
from jaxsafe.processors.observation import Observe
from jaxsafe.simulation.controllers import Actuator, Continuous
from jaxsafe.simulation.dubins import Dubins3D
from jaxsafe.simulation.geometry import Cylinder
from jaxsafe.simulation.initializers import AroundAtAltitude, Uniform

TIMEOUT = 2000.0
"""Longest episode [s], Table 9."""


def rejoin3d() -> Environment:
    """The task as in Tables 3, 5, 7 and 9."""
    low, high = (5000.0, 5000.0, 12_000.0), (10_000.0, 10_000.0, 14_000.0)
    around = AroundAtAltitude(name="position", about="lead", distance=LEAD_DISTANCES, altitude=(10_000.0, 16_000.0))
    wingman = Dubins3D(
        name="wingman",
        start=(around, HEADING, WINGMAN_SPEED),
        controller=Continuous(
            actuators=(
                Actuator(name="roll_rate", low=-0.17, high=0.17, points=5),
                Actuator(name="flight_path_angle_rate", low=-0.09, high=0.09, points=5),
                Actuator(name="acceleration", low=-96.5, high=96.5, points=5),
            )
        ),
    )
    return Environment(
        agent="wingman",
        dt=1.0,
        platforms=(
            Dubins3D(
                name="lead", start=(Uniform(name="position", low=low, high=high), HEADING, LEAD_SPEED), controller=STRAIGHT
            ),
            wingman,
        ),
        regions=(Cylinder(name="rejoin_region", on="lead", offset=REJOIN_POINT, radius=100.0, height=300.0),),
        status=rejoin_status(),
        constraints=rejoin_constraints(),
        terminal=rejoin_terminal(farthest=100_000.0, timeout=TIMEOUT),
        reward=rejoin_reward(TIMEOUT),
        observation=(
            *rejoin_observation(3),
            Observe(name="roll", of="wingman", what="roll", scale=jnp.pi / 3, clip=(-1.0, 1.0)),
            Observe(name="flight_path_angle", of="wingman", what="flight_path_angle", scale=jnp.pi / 9, clip=(-1.0, 1.0)),
        ),
    )


RELEASED = _rejoin.RELEASED | {
    "wingman.controller.actuators.flight_path_angle_rate.low": -0.17,
    "wingman.controller.actuators.flight_path_angle_rate.high": 0.17,
    "wingman.controller.actuators.roll_rate.low": -0.09,
    "wingman.controller.actuators.roll_rate.high": 0.09,
    "wingman.controller.actuators": ["flight_path_angle_rate", "roll_rate", "acceleration"],
}
"""What the released code does otherwise: its ailerons drive γ, its elevator φ."""
