"""The set in which an aircraft in space can keep its place beside another one within a bound.

Proposition 15 of docs/safety/proofs.md proves it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.certificate import Faults
from jaxsafe.rta.tube_in_space import SLOW_MODE, TubeInSpace
from jaxsafe.simulation.dubins import Dubins3D
from jaxsafe.simulation.trig import cos_acute, tan_acute, wrap
from jaxsafe.types import Number

if TYPE_CHECKING:
    from jaxsafe.environment import Environment
    from jaxsafe.rta.backups import MatchVelocity, VelocityMatched

LARGEST_MIXED = 3.28
"""Largest ψ + c ψ̇ in the set, times the speed, in units of its `tolerance`."""

LARGEST_LATERAL = 4.0
"""Largest speed across the lead's course in the set, in units of its `tolerance`."""

LARGEST_ASTRAY = 5.43
"""Largest difference of the relative velocity from the one aimed at, in units of `tolerance`."""

LARGEST_PULL = 5.5
"""Largest speed away from the lead that is aimed at in the set, in units of `tolerance`."""

LONGEST_AWAY_TIME = 25.0
"""Largest `away_time` [s] of `match_velocity` for which Proposition 15 is proved."""

CLOSE = 1.001
"""Numbers of this ratio count as equal in a proof, because every proof has more reserve."""


def in_formation(
    own: Any, lead: Any, gravity: Number, slowest: Number, tube: TubeInSpace, tolerance: Number
) -> Bool[Array, ""]:
    """Return whether all velocities and all banks of a tube are in the set of Proposition 15.

    Args:
        own: the predicted state of the agent.
        lead: the state of the lead, which flies straight.
        gravity: g [ft/s²].
        slowest: the least speed of the agent [ft/s].
        tube: the tube about the agent's state.
        tolerance: F, the size of the set [ft/s].
    """
    level_speed = lead.speed * cos_acute(lead.flight_path_angle)
    heading_error = wrap(own.heading - lead.heading, -jnp.pi, 2.0 * jnp.pi)
    sideways = gravity * tan_acute(own.roll)
    own_speed = jnp.maximum(own.speed - tube.speed, slowest)
    strongest = (jnp.abs(sideways) + tube.sideways) / own_speed
    mixed = jnp.abs(heading_error + SLOW_MODE * sideways / own.speed) + tube.slow
    mixed += SLOW_MODE * strongest * tube.speed / own.speed
    climb = jnp.abs(own.flight_path_angle - lead.flight_path_angle) + tube.climb
    return (
        (level_speed * mixed <= LARGEST_MIXED * tolerance)
        & (level_speed * (jnp.abs(heading_error) + tube.heading) <= LARGEST_LATERAL * tolerance)
        & (level_speed * strongest <= tolerance)
        & (jnp.abs(own.speed - lead.speed) + tube.speed <= tolerance)
        & (lead.speed * climb <= tolerance)
    )


def formation_faults(
    env: Environment,
    bound: UncertaintyBound,
    terminal: VelocityMatched,
    backups: Sequence[MatchVelocity],
    state: Any,
    name: str,
    extremes: Mapping[str, tuple[Number, Number]],
    lowest: Float[Array, ""],
    authority: Mapping[str, Float[Array, ""]],
) -> Faults:
    """Return what is missing for Propositions 14 and 15.

    Args:
        env: the environment.
        bound: the filter's bound.
        terminal: the terminal set.
        backups: the backup controllers `match_velocity`.
        state: the state of the lead.
        name: the name of the lead.
        extremes: the smallest and the largest value of each of the lead's controls.
        lowest: the distance T that the filter keeps, the margin included [ft].
        authority: how far each control can be changed both ways from 0, times the step.
    """
    plant = cast(Dubins3D, env.agent_platform)
    slowest, fastest = plant.speed_limits
    tolerance = terminal.tolerance  # F
    outer = jnp.stack([backup.clearance for backup in backups])  # C
    gain = jnp.stack([jnp.asarray(backup.away_gain, env.dt.dtype) for backup in backups])  # κ
    zone = jnp.min(jnp.stack([backup.dead_zone for backup in backups]))

    missing = outer - lowest  # Q
    astray = LARGEST_ASTRAY * tolerance
    relative_speed = jnp.max(gain * missing) + astray  # U
    steepest = gain * jnp.maximum((missing + bound.position) / (lowest - bound.position), 1.0)
    unknown = bound.process * env.dt + bound.velocity + jnp.max(steepest) * bound.position
    needed = 1.05 * (jnp.max(steepest) * relative_speed + unknown)
    climb_limits = plant.flight_path_angle_limits
    steep = jnp.minimum(jnp.minimum(-climb_limits[0], climb_limits[1]), 0.35)
    turns = 1.1 * (LARGEST_LATERAL + 1.0) * tolerance / (0.93 * slowest)
    moves = jnp.stack([jnp.asarray(end) for ends in extremes.values() for end in ends])
    return {
        "rta.bound in space is proved for steps of 1 s alone": jnp.abs(env.dt - 1.0) > 1e-3,
        f"rta.bound in space is proved for a lead that flies straight, and {name!r} may not": (
            jnp.any(moves != 0.0) | (state.roll != 0.0)
        ),
        "rta.bound is larger than tolerance of velocity_matched allows": ~(
            (needed <= CLOSE * tolerance) & (bound.position < 0.5 * lowest)
        ),
        (
            "rta.bound: clearance of match_velocity is too small or too large"
            " for tolerance of velocity_matched"
        ): ~(
            (jnp.min(gain * missing) * CLOSE >= astray)
            & (jnp.max(gain * missing) <= CLOSE * LARGEST_PULL * tolerance)
        ),
        "rta.bound in space is proved for an away_time of at most 25 s": ~(
            jnp.min(gain) * CLOSE >= 1.0 / LONGEST_AWAY_TIME
        ),
        "rta.bound: clearance of velocity_matched is below that of match_velocity": ~(
            terminal.clearance * CLOSE >= jnp.max(outer)
        ),
        f"rta.bound: {name!r} flies too close to the agent's slowest or fastest speed": ~(
            (state.speed - relative_speed >= slowest) & (state.speed + relative_speed <= fastest)
        ),
        "rta.bound: tolerance of velocity_matched is too large for the speed of the aircraft": ~(
            relative_speed <= 0.033 * state.speed
        ),
        f"rta.bound: {name!r} climbs or dives too steeply": ~(
            jnp.abs(state.flight_path_angle) + 1.1 * relative_speed / slowest <= steep
        ),
        "rta.bound: the agent rolls, climbs or accelerates too slowly": ~(
            (2.1 * tolerance <= authority["roll_rate"] * plant.gravity)
            & (1.2 * tolerance <= authority["flight_path_angle_rate"] * slowest)
            & (1.2 * tolerance <= authority["acceleration"])
        ),
        "rta.bound: dead_zone of match_velocity is too small": ~(turns <= jnp.minimum(zone, 0.15)),
    }
