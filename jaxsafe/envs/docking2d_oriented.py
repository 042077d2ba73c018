"""2D oriented spacecraft docking: as `docking2d`, with thrust along the body axis and a reaction wheel (Section 3)."""

from __future__ import annotations

import jax.numpy as jnp

from jaxsafe.environment import Environment
from jaxsafe.envs import _docking
from jaxsafe.envs._docking import (
    PLANAR,
    chief,
    deputy_start,
    docking_constraints,
    docking_reward,
    docking_status,
    docking_terminal,
    speed_observation,
)
from jaxsafe.processors.observation import Observe, ObserveAngle
from jaxsafe.simulation.controllers import Actuator, Continuous
from jaxsafe.simulation.geometry import Circle
from jaxsafe.simulation.initializers import Uniform
from jaxsafe.simulation.oriented import RATE_LIMIT, OrientedSpacecraft

TIMEOUT = 3000.0
"""Longest episode [s], Table 10."""


def docking2d_oriented() -> Environment:
    """The task as in Tables 4, 6, 8 and 10."""
    turn = jnp.pi / 180.0
    deputy = OrientedSpacecraft(
        name="deputy",
        start=(*deputy_start(PLANAR), Uniform(name="attitude", low=0.0, high=2.0 * jnp.pi)),
        controller=Continuous(
            actuators=(
                Actuator(name="thrust", low=-1.0, high=2.0, points=11, zero_centred=True),
                Actuator(name="attitude_acceleration", low=-turn, high=turn, points=11),
            )
        ),
    )
    return Environment(
        agent="deputy",
        dt=1.0,
        platforms=(chief(2), deputy),
        regions=(Circle(name="docking_region", on="chief", radius=0.5),),
        status=docking_status(),
        constraints=docking_constraints(),
        terminal=docking_terminal(TIMEOUT),
        reward=docking_reward(TIMEOUT),
        observation=(
            Observe(name="position", of="chief", what="position", relative_to="deputy", frame="deputy", scale=100.0),
            Observe(name="velocity", of="deputy", what="velocity", frame="deputy", scale=0.5),
            ObserveAngle(name="attitude", of="deputy", what="attitude", scale=-1.0),
            Observe(name="attitude_rate", of="deputy", what="attitude_rate", scale=RATE_LIMIT),
            *speed_observation(),
        ),
    )


RELEASED = _docking.RELEASED | {
    "deputy.start.attitude.low": -jnp.pi,
    "deputy.start.attitude.high": jnp.pi,
    "observation.position.of": "deputy",
    "observation.position.relative_to": "chief",
    "observation.attitude_rate.scale": 0.0349066,
}
"""What the released code does otherwise."""
