"""How far two aircraft move relative to each other until their velocities match.

Proposition 16 of docs/safety/proofs.md. The bounds serve to certify a state without a prediction.
Most states are so far from the lead that nothing else is needed.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.tube_in_space import TURN_GAIN
from jaxsafe.simulation.controllers import Uncontrolled
from jaxsafe.simulation.dubins import Dubins3D
from jaxsafe.simulation.scripted import Scripted

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

ZONE_RESERVE = 0.02
"""What is left of the dead zone [rad], so that the turn does not go the other way round."""

TAIL = 5.5
"""Largest ∫|e| dt of the end of a turn in space [s], in units of the heading error e before it."""

TAIL_STEPS = 14
"""Steps in which the end of a turn in space takes e from 4 times the turn's rate to nothing."""

STEADY_CLIMB = 0.14
"""Heading error [rad] from which on `match_velocity` may climb or dive."""


def authority(env: Environment, name: str) -> Any:
    """Return the largest value that a control can take in both directions.

    It is 0 without such an actuator.
    """
    actuators = {actuator.name: actuator for actuator in env.actuators}
    if name not in actuators:
        return jnp.zeros_like(env.dt)
    return jnp.maximum(jnp.minimum(-actuators[name].low, actuators[name].high), 0.0)


def flies_straight(env: Environment, name: str, state: Any) -> Bool[Array, ""]:
    """Return whether an aircraft keeps its velocity for ever, for all that is known of it."""
    controller = env.platform(name).controller
    if type(controller) not in (Uncontrolled, Scripted):
        return jnp.zeros((), bool)
    commands = controller.commands if type(controller) is Scripted else ()
    moves = [jnp.asarray(end) for command in commands for end in command.extremes()]
    level = state.roll == 0.0 if hasattr(state, "roll") else jnp.ones((), bool)
    return functools.reduce(lambda still, end: still & (end == 0.0), moves, level)


class Manoeuvre(NamedTuple):
    """A bound on the way of `match_velocity` until both velocities are the same."""

    drift: Float[Array, ""]  # largest change of the relative position [ft]
    duration: Float[Array, ""]  # longest time that it takes [s]
    possible: Bool[Array, ""]  # whether the bound holds at all


def in_plane(env: Environment, own: Any, lead: Any, error: Float[Array, ""]) -> Manoeuvre:
    """Return the bound for two aircraft at one altitude.

    Args:
        env: the environment.
        own: the agent's state.
        lead: the state of the lead, which flies straight at a constant speed.
        error: the angle of the turn to come [rad].
    """
    turn = authority(env, "heading_rate")
    angle = jnp.minimum(jnp.abs(error), jnp.pi)
    turned = 4.0 / turn * (1.0 - jnp.cos(angle / 2.0)) + env.dt * jnp.minimum(angle, turn * env.dt)
    slower, duration = _speeding_up(env, own, lead)
    return Manoeuvre(
        drift=lead.speed * turned + slower,
        duration=jnp.abs(error) / turn + duration + 2.0 * env.dt,
        possible=jnp.ones((), bool),
    )


def in_space(
    env: Environment, own: Any, lead: Any, error: Float[Array, ""], side: float, dead_zone: Any
) -> Manoeuvre:
    """Return the bound for two aircraft in space.

    Args:
        env: the environment.
        own: the agent's state.
        lead: the state of the lead, which flies straight at a constant speed and angle.
        error: the angle of the turn to come [rad]. It is negative if the turn goes against `side`.
        side: 1 for a controller that turns to the left, −1 for one that turns to the right.
        dead_zone: largest turn against `side` [rad].
    """
    plant = cast(Dubins3D, env.agent_platform)
    roll_rate = authority(env, "roll_rate")
    climb_rate = authority(env, "flight_path_angle_rate")
    slowest = jnp.minimum(own.speed, lead.speed)
    fastest = jnp.maximum(own.speed, lead.speed)

    # While the wings come level the aircraft still turns by ∫ g tan φ/v dt.
    steepest_bank = jnp.minimum(-plant.roll_limits[0], plant.roll_limits[1])
    still_turned = -plant.gravity / (slowest * roll_rate) * jnp.log(jnp.cos(own.roll))
    level = error - side * jnp.sign(own.roll) * still_turned
    least = jnp.minimum(error, level)
    most = jnp.maximum(error, level)
    possible = (least >= ZONE_RESERVE - dead_zone) & (most <= 2.0 * jnp.pi - 2.0 * dead_zone)
    levels_out = error * level <= 0.0  # the bank is too steep for what is left of the turn
    levels_out |= jnp.abs(level) > jnp.abs(error)  # or it is to the wrong side
    largest = jnp.maximum(jnp.abs(least), jnp.abs(most))
    levelling = jnp.where(levels_out, jnp.abs(own.roll) / roll_rate, 0.0)

    # Rolling in delays the turn. Then it has the full rate, and at its end the rate of `TURN_GAIN`.
    bank = jnp.minimum(jnp.arctan(fastest * TURN_GAIN * largest / plant.gravity), steepest_bank)
    delay = levelling + bank / (2.0 * roll_rate) + env.dt
    turn = plant.gravity * jnp.tan(steepest_bank) / fastest
    last = jnp.minimum(largest, turn / TURN_GAIN)
    angle = jnp.minimum(largest, jnp.pi)
    full = 4.0 / turn * jnp.maximum(jnp.cos(last / 2.0) - jnp.cos(largest / 2.0), 0.0)
    turned = delay * 2.0 * jnp.sin(angle / 2.0) + full + TAIL * last

    # It may climb or dive at the steepest angle until little of the turn is left.
    lowest, highest = plant.flight_path_angle_limits
    wrong_climb = jnp.abs(own.flight_path_angle - lead.flight_path_angle)
    steepest_climb = jnp.maximum(highest - lead.flight_path_angle, lead.flight_path_angle - lowest)
    climbs = largest > STEADY_CLIMB
    climb = jnp.where(climbs, jnp.maximum(wrong_climb, steepest_climb), wrong_climb)
    to_the_tail = (largest - last) / turn
    to_steady = jnp.log(jnp.maximum(last / STEADY_CLIMB, 1.0)) / TURN_GAIN + 2.0 * env.dt
    climbing = jnp.where(climbs, delay + to_the_tail + to_steady, 0.0)
    climbed = climb * climbing + climb**2 / (2.0 * climb_rate) + climb * env.dt / 2.0

    slower, to_speed = _speeding_up(env, own, lead)
    duration = delay + to_the_tail + TAIL_STEPS * env.dt + climb / climb_rate + to_speed
    return Manoeuvre(
        drift=lead.speed * (turned + climbed) + slower, duration=duration, possible=possible
    )


def _speeding_up(env: Environment, own: Any, lead: Any) -> tuple[Array, Array]:
    """Return ∫|v − v_lead| dt [ft] until both speeds are the same, and how long that takes [s]."""
    acceleration = authority(env, "acceleration")
    difference = jnp.abs(own.speed - lead.speed)
    drift = difference**2 / (2.0 * acceleration) + difference * env.dt / 2.0
    return drift, difference / acceleration
