"""2D aircraft rejoin: fly the wingman to the rejoin point of the lead and stay there for 20 s (Section 3)."""

from __future__ import annotations

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
from jaxsafe.simulation.controllers import Actuator, Continuous
from jaxsafe.simulation.dubins import Dubins2D
from jaxsafe.simulation.geometry import Circle
from jaxsafe.simulation.initializers import AtDistance, Uniform

TIMEOUT = 1000.0
"""Longest episode [s], Table 9."""


def rejoin2d() -> Environment:
    """The task as in Tables 3, 5, 7 and 9."""
    lead = Dubins2D(
        name="lead",
        start=(Uniform(name="position", low=(5000.0, 5000.0), high=(10_000.0, 10_000.0)), HEADING, LEAD_SPEED),
        controller=STRAIGHT,
    )
    wingman = Dubins2D(
        name="wingman",
        start=(AtDistance(name="position", about="lead", distance=LEAD_DISTANCES), HEADING, WINGMAN_SPEED),
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
        terminal=rejoin_terminal(farthest=40_000.0, timeout=TIMEOUT),
        reward=rejoin_reward(TIMEOUT),
        observation=rejoin_observation(2),
    )


RELEASED = _rejoin.RELEASED | {
    "wingman.controller.actuators.heading_rate.low": -0.174533,
    "wingman.controller.actuators.heading_rate.high": 0.174533,
}
"""What the released code does otherwise."""
