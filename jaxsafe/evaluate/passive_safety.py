"""Passive safety: whether a spacecraft stays away from another one if its thrust fails for good."""

from __future__ import annotations

import math

from jaxsafe.config import override
from jaxsafe.environment import Environment
from jaxsafe.processors.proximity import DriftDistance
from jaxsafe.processors.status import Threshold
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.cwh import Anchor, Spacecraft
from jaxsafe.simulation.oriented import OrientedSpacecraft

SAMPLES = 240
"""Number of chords of a drift, 25 s each in low orbit.

Flights of docking3d had bounds at most 0.25 m below the least distance.
"""


def with_passive_safety(env: Environment, radius: float) -> Environment:
    """Return the environment with the status `passively_safe` and two metrics.

    A state is passively safe if the agent stays outside of a sphere around the chief for one orbit
    without thrust. The status `drift_bound` is a lower bound of the least distance [m] in this
    orbit. So a state that counts as passively safe is so. The metrics are `passively_safe.mean` and
    `drift_bound.minimum`.

    Args:
        env: the environment.
        radius: the radius of the sphere [m].

    Raises:
        ConfigError: the agent does not fly by Clohessy-Wiltshire dynamics, there is not exactly one
            anchor, or a status has one of the names.
    """
    agent = env.platform(env.agent)
    anchors = [platform.name for platform in env.platforms if type(platform) is Anchor]
    # Subclasses have other dynamics, which do not drift as the closed form says.
    if (
        not isinstance(agent, Spacecraft | OrientedSpacecraft)
        or type(agent) not in (Spacecraft, OrientedSpacecraft)
        or len(anchors) != 1
    ):
        raise ConfigError(
            "passive_safety: expected an agent that is a spacecraft or an oriented_spacecraft, "
            f"and one anchor, found {agent.type_name} and {len(anchors)} anchors"
        )
    drift = DriftDistance(
        name="drift_bound",
        of=agent.name,
        to=anchors[0],
        duration=2.0 * math.pi / agent.mean_motion,
        samples=SAMPLES,
        mean_motion=agent.mean_motion,
    )
    safe = Threshold(
        name="passively_safe", status="drift_bound", limit=radius, side="above", inclusive=True
    )
    status = [*env.status, drift, safe]
    measure = [*env.measure, "passively_safe.mean", "drift_bound.minimum"]
    return override(env, {"status": status, "measure": measure})
