"""3D spacecraft docking: fly the deputy to within 0.5 m of the chief without exceeding the speed limit (Section 3)."""

from __future__ import annotations

from jaxsafe.environment import Environment
from jaxsafe.envs._docking import (
    chief,
    deputy,
    docking_constraints,
    docking_observation,
    docking_reward,
    docking_status,
    docking_terminal,
)
from jaxsafe.simulation.geometry import Sphere

TIMEOUT = 2000.0
"""Longest episode [s], Table 10."""


def docking3d() -> Environment:
    """The task as in Tables 4, 6, 8 and 10."""
    return Environment(
        agent="deputy",
        dt=1.0,
        platforms=(chief(3), deputy(3)),
        regions=(Sphere(name="docking_region", on="chief", radius=0.5),),
        status=docking_status(),
        constraints=docking_constraints(),
        terminal=docking_terminal(TIMEOUT),
        reward=docking_reward(TIMEOUT),
        observation=docking_observation(),
    )
