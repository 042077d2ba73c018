"""What the rejoin tasks share: Sections 3 and 4, Tables 3, 5, 7 and 9. Lengths in ft, speeds in ft/s."""

from __future__ import annotations

import jax.numpy as jnp

from jaxsafe.processors.constraint import Constraint, Separation
from jaxsafe.processors.observation import Observation, Observe, ObserveRegion
from jaxsafe.processors.reward import DistanceChange, Failure, FirstTime, Reward, Success, WhileIn
from jaxsafe.processors.status import Distance, InRegion, RegionDistance, Status, TimeHeld
from jaxsafe.processors.terminal import Held, Terminal, Timeout, TooClose, TooFar
from jaxsafe.simulation.geometry import Aspect
from jaxsafe.simulation.initializers import Uniform
from jaxsafe.simulation.scripted import Constant, Scripted

TWO_PI = 2.0 * jnp.pi

HOLD = 20.0
"""Time to stay in the rejoin region [s], Table 9."""

SAFE_DISTANCE = 100.0
"""ρ_c of Eqs. (8), (11): the smallest distance to the lead [ft]."""

REJOIN_POINT = Aspect(distance=500.0, angle=jnp.pi / 3)
"""Eq. (6): behind the lead, 60° from its tail [ft]."""

LEAD_DISTANCES = (5000.0, 10_000.0)
"""Distance of the wingman from the lead at the start [ft], Table 3."""

STRAIGHT = Scripted(commands=(Constant(name="heading_rate", at=0.0),))
"""The lead keeps its heading rate and its speed."""

HEADING = Uniform(name="heading", low=0.0, high=TWO_PI)
LEAD_SPEED = Uniform(name="speed", low=250.0, high=300.0)
WINGMAN_SPEED = Uniform(name="speed", low=200.0, high=400.0)


def rejoin_status() -> tuple[Status, ...]:
    """Where the wingman is relative to the lead and to the rejoin region, and for how long it has been inside."""
    return (
        InRegion(name="in_rejoin", of="wingman", region="rejoin_region"),
        TimeHeld(name="rejoin_time", status="in_rejoin"),
        Distance(name="lead_distance", of="wingman", to="lead"),
        RegionDistance(name="rejoin_distance", of="wingman", region="rejoin_region"),
    )


def rejoin_constraints() -> tuple[Constraint, ...]:
    """Safe separation, Eqs. (8), (11)."""
    return (Separation(name="collision", distance="lead_distance", minimum=SAFE_DISTANCE),)


def rejoin_terminal(farthest: float, timeout: float) -> tuple[Terminal, ...]:
    """Table 9."""
    return (
        Held(name="success", time="rejoin_time", duration=HOLD),
        TooClose(name="crash", distance="lead_distance", limit=SAFE_DISTANCE),
        TooFar(name="distance", distance="lead_distance", limit=farthest),
        Timeout(name="timeout", limit=timeout),
    )


def rejoin_reward(timeout: float) -> tuple[Reward, ...]:
    """Table 7."""
    return (
        DistanceChange(name="distance_change", distance="lead_distance", half_distance=5000.0, scale=2.0),
        WhileIn(name="in_rejoin", status="in_rejoin", value=0.1),
        FirstTime(name="in_rejoin_first_time", status="in_rejoin", value=0.25),
        Success(name="success", outcome="success", value=2.0, time_scale=timeout),
        Failure(name="failure", values={"crash": -1.0, "distance": -1.0, "timeout": -1.0}),
    )


def rejoin_observation(dimension: int) -> tuple[Observation, ...]:
    """Table 5: magnitudes and directions, seen from the wingman."""
    near, fast = ((unit, *(1.0,) * dimension) for unit in (1000.0, 400.0))
    seen = {"frame": "wingman", "form": "magnorm", "clip": (-1.0, 1.0)}
    return (
        Observe(name="lead_position", of="lead", what="position", relative_to="wingman", scale=near, **seen),
        ObserveRegion(name="rejoin_position", region="rejoin_region", relative_to="wingman", scale=near, **seen),
        Observe(name="wingman_velocity", of="wingman", what="velocity", scale=fast, **seen),
        Observe(name="lead_velocity", of="lead", what="velocity", scale=fast, **seen),
    )


RELEASED = {
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
"""What the released code does otherwise."""
