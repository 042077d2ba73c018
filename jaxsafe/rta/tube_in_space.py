"""Tubes about the predicted way of an aircraft in space, which banks in order to turn.

Proposition 14 of docs/safety/proofs.md proves them for steps of 1 s. So the formulas of the turn do
not contain the length of a step.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.tube import Tube, largest_turn, measured
from jaxsafe.simulation.dubins import Dubins3D
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.simulation.trig import arctan, cos_acute, tan_acute
from jaxsafe.types import Number, Record

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

TURN_GAIN = 0.25
"""Turn rate per heading error that `match_velocity` asks for in space [1/s]."""

SLOW_MODE = 0.7192
"""Time c [s] for which ψ + c ψ̇ shrinks by the factor 0.6952 in each step of the turn."""

FAST_MODE = 2.7808
"""Time c [s] for which ψ + c ψ̇ shrinks by the factor 0.1798 in each step of the turn."""


class TubeInSpace(Tube):
    """How far the true state of an aircraft in space may be from the predicted one."""

    climb: Float[Array, ""]  # of the flight path angle [rad]
    sideways: Float[Array, ""]  # of g tan φ, the acceleration across the velocity [ft/s²]
    # Of the mixtures ψ + c g tan φ/v̄, with the predicted speed v̄ and the two times c above [rad].
    slow: Float[Array, ""]
    fast: Float[Array, ""]

    def velocity(self, speed: Number) -> Any:
        return self.speed + speed * safe_norm(jnp.stack([self.heading, self.climb]))


class Pursuit(Record):
    """What `match_velocity` asks for in a step of the prediction, and how wrong that may be."""

    error: Float[Array, ""]  # heading error ē [rad]
    apart: Float[Array, ""]  # difference of the velocities that are aimed at [ft/s]
    lead_level_speed: Float[Array, ""]  # horizontal speed of the lead [ft/s]
    spare_acceleration: Float[Array, ""]  # how far the command is from its bounds, times 1 s [ft/s]
    spare_climb: Float[Array, ""]  # the same of the flight path angle rate [rad]
    # How far the flight path angle that is aimed at may change because ē is wrong [rad].
    climb_by_error: Float[Array, ""]


def first_in_space(
    env: Environment, bound: UncertaintyBound, before: Any, after: Any
) -> TubeInSpace:
    """Return the tube one step after a measured state, with the same control on both ways.

    Args:
        env: the environment.
        bound: the bound on what is not known.
        before: the measured state.
        after: the predicted state after the step.
    """
    plant = cast(Dubins3D, env.agent_platform)
    plain = measured(bound, before)
    climb = plain.heading
    heading = largest_turn(bound.velocity, before.speed * _level(plant, before, climb))
    zero = jnp.zeros_like(plain.position)
    tube = TubeInSpace(
        position=plain.position,
        heading=heading,
        speed=plain.speed,
        climb=climb,
        sideways=zero,
        slow=heading,
        fast=heading,
    )
    by_speed = _turn_by_speed(plant, before, after, speed=tube.speed, sideways=zero)
    turned = heading + by_speed
    kept = tube.replace(heading=turned, slow=turned, fast=turned)
    return _moved(env, bound, tube=tube, kept=kept, turn=by_speed, before=before, after=after)


def next_in_space(
    env: Environment,
    bound: UncertaintyBound,
    tube: TubeInSpace,
    before: Any,
    after: Any,
    pursuit: Pursuit,
) -> TubeInSpace:
    """Return the tube after a step in which both ways turn to the heading of the lead.

    Args:
        env: the environment.
        bound: the bound on what is not known.
        tube: the tube before the step.
        before: the predicted state before the step.
        after: the predicted state after the step.
        pursuit: what the controller asks for.
    """
    plant = cast(Dubins3D, env.agent_platform)
    g = plant.gravity
    own_speed = jnp.maximum(before.speed - tube.speed, plant.speed_limits[0])
    wrong_heading = wrong_course(plant, bound, tube, before, pursuit)
    wrong_climb = largest_turn(bound.velocity, own_speed) + pursuit.climb_by_error
    wrong_climb += pursuit.apart / pursuit.lead_level_speed
    speed = jnp.maximum(tube.speed - pursuit.spare_acceleration, bound.velocity + pursuit.apart)
    climb = jnp.maximum(tube.climb - pursuit.spare_climb, wrong_climb)

    # The bank that is asked for, as g tan φ, and how far the true one may be from it.
    speed_error = tube.speed + bound.velocity
    asked = TURN_GAIN * before.speed * pursuit.error
    noise = (before.speed + speed_error) * wrong_heading
    noise = TURN_GAIN * (noise + speed_error * (jnp.abs(pursuit.error) + tube.heading))
    change = noise + TURN_GAIN * before.speed * tube.heading
    lowest, highest = g * tan_acute(plant.roll_limits[0]), g * tan_acute(plant.roll_limits[1])
    least_asked = jnp.clip(asked - change, lowest, highest)
    most_asked = jnp.clip(asked + change, lowest, highest)
    asked_kept = jnp.clip(asked, lowest, highest)
    change_kept = jnp.maximum(most_asked - asked_kept, asked_kept - least_asked)
    now = g * tan_acute(before.roll)
    least_roll = arctan(jnp.maximum(now - tube.sideways, lowest) / g)
    most_roll = arctan(jnp.minimum(now + tube.sideways, highest) / g)

    # Which kinds of bank change may occur on the true way, or between it and the predicted one. The
    # bank follows what is asked for, rests at its limit, or changes at the fastest roll.
    roll = next(actuator for actuator in env.actuators if actuator.name == "roll_rate")
    down, up = roll.low * env.dt, roll.high * env.dt
    least_step = arctan(least_asked / g) - most_roll
    most_step = arctan(most_asked / g) - least_roll
    only_down = most_step <= down
    only_up = least_step >= up
    may_down = (least_step < down) | only_down
    may_up = (most_step > up) | only_up
    only_limit = (least_asked == most_asked) & ~may_down & ~may_up
    may_follow = ~(only_down | only_up | only_limit)
    may_rest = (asked + change > highest) | (asked - change < lowest)
    may_rest = may_rest & ~(only_down | only_up)
    downwards = _stretches(plant, least_roll, most_roll, down)
    upwards = _stretches(plant, least_roll, most_roll, up)
    # The true bank change is a mixture of those kinds. The first has the share ϑ = 1 of what is
    # asked for. The others have ϑ = 0 and a share μ of the bank before the step.
    kinds = [(jnp.zeros_like(now), may_rest)]
    kinds += [(share, may_down) for share in downwards] + [(share, may_up) for share in upwards]
    stays = may_rest | may_down | may_up
    follows = may_follow | ~stays
    most_share = functools.reduce(jnp.maximum, [jnp.where(may, share, 0.0) for share, may in kinds])
    least_share = functools.reduce(
        jnp.minimum, [jnp.where(may, share, most_share) for share, may in kinds]
    )

    # ψ after the step is ψ + a δ₀ + b δ₁, with the turn rates δ = g tan φ/v at its ends.
    widest = jnp.maximum(jnp.where(may_follow, change_kept, 0.0), most_share * tube.sideways)
    bank = jnp.maximum(jnp.abs(least_roll), jnp.abs(most_roll))
    bank = jnp.maximum(bank, arctan((g * tan_acute(jnp.abs(after.roll)) + widest) / g))
    bank = jnp.minimum(bank, jnp.maximum(plant.roll_limits[1], -plant.roll_limits[0]))
    rolled = jnp.abs(after.roll - before.roll) + (tube.sideways + widest) / g
    rolled = jnp.minimum(rolled, jnp.maximum(up, -down))
    stretch = (cos_acute(jnp.maximum(bank - rolled, 0.0)) / cos_acute(bank)) ** 2
    slow = jnp.minimum(before.speed, after.speed)
    fast = jnp.maximum(before.speed, after.speed)
    least = (0.5 - rolled * tan_acute(bank) / 3.0) * after.speed / fast
    most = (0.5 + (stretch - 1.0) / 6.0) * after.speed / slow

    largest = functools.partial(
        largest_mixture,
        tube,
        before.speed,
        ratio=before.speed / after.speed,
        weights=(least, most),
        shares=(least_share, most_share),
        follows=follows,
        stays=stays,
    )
    by_noise = jnp.where(follows, noise / after.speed, 0.0)
    turn_rate = largest(0.0, 1.0) + by_noise
    heading = largest(1.0, 0.0) + most * by_noise
    slow_mode = largest(1.0, SLOW_MODE) + (most + SLOW_MODE) * by_noise
    fast_mode = largest(1.0, FAST_MODE) + (most + FAST_MODE) * by_noise

    sideways = jnp.minimum(widest, after.speed * turn_rate)
    by_speed = _turn_by_speed(
        plant,
        before,
        after,
        speed=jnp.maximum(tube.speed, speed),
        sideways=stretch * jnp.maximum(tube.sideways, sideways),
    )
    turn = stretch * jnp.maximum(tube.sideways, sideways) / slow + by_speed
    kept = tube.replace(
        heading=jnp.minimum(tube.heading + turn, heading + by_speed),
        speed=speed,
        climb=climb,
        sideways=sideways,
        slow=slow_mode + by_speed,
        fast=fast_mode + by_speed,
    )
    return _moved(env, bound, tube=tube, kept=kept, turn=turn, before=before, after=after)


def largest_mixture(
    tube: TubeInSpace,
    speed: Number,
    of_heading: float,
    of_turn: float,
    ratio: Number,
    weights: tuple[Number, Number],
    shares: tuple[Number, Number],
    follows: Bool[Array, ""],
    stays: Bool[Array, ""],
) -> Any:
    """Return a bound on x ψ + y δ after a step without noise, for the turn rate δ = g tan φ/v̄.

    It is a weighted sum of the heading and the turn rate before the step, whose weights are linear
    in each of a, b, ϑ and μ. So it is largest where these are at a corner.

    Args:
        tube: the tube before the step.
        speed: the predicted speed before the step [ft/s].
        of_heading: x.
        of_turn: y [s].
        ratio: the predicted speed before the step over that after it.
        weights: the least and the largest value of a and b.
        shares: the least and the largest μ.
        follows: whether the bank may follow what is asked for, so that ϑ = 1 and μ = 0.
        stays: whether the bank may follow anything else, so that ϑ = 0.
    """
    a = [of_heading * weight for weight in weights]
    b = [of_heading * weight + of_turn for weight in weights]
    zero = jnp.zeros_like(tube.heading)
    sums = [
        (
            jnp.where(follows, of_heading - TURN_GAIN * ratio * of_last, zero),
            jnp.where(follows, ratio * of_first, zero),
        )
        for of_first, of_last in itertools.product(a, b)
    ]
    least = a[0] + jnp.minimum(b[0] * shares[0], b[0] * shares[1])
    sums += [
        (jnp.where(stays, of_heading, zero), jnp.where(stays, ratio * turn, zero))
        for turn in (least, a[1] + b[1] * shares[1])
    ]
    return _largest_sum(tube, tube.sideways / speed, sums)


def _largest_sum(tube: TubeInSpace, turn: Number, sums: Sequence[tuple[Array, Array]]) -> Any:
    """Return a bound on all weighted sums of the heading and the turn rate in a tube.

    A tube bounds the heading, the turn rate and two mixtures of both. Any two of these four bounds
    bound a sum, and the best pair counts.

    Args:
        tube: the tube.
        turn: the largest turn rate in the tube [rad/s].
        sums: the weights of the heading and of the turn rate [s] in each sum.
    """
    # A sum is x ψ + y δ. In the other pairs of axes its weights are x, y and these two differences.
    apart = FAST_MODE - SLOW_MODE
    pairs = []
    for of_heading, of_turn in sums:
        x, y = jnp.abs(of_heading), jnp.abs(of_turn)
        slow = jnp.abs(of_turn - SLOW_MODE * of_heading)
        fast = jnp.abs(of_turn - FAST_MODE * of_heading)
        pairs.append(
            (
                x * tube.heading + y * turn,
                x * tube.slow + slow * turn,
                x * tube.fast + fast * turn,
                (slow * tube.heading + y * tube.slow) / SLOW_MODE,
                (fast * tube.heading + y * tube.fast) / FAST_MODE,
                (fast * tube.slow + slow * tube.fast) / apart,
            )
        )
    bounds = [functools.reduce(jnp.maximum, pair) for pair in zip(*pairs, strict=True)]
    return functools.reduce(jnp.minimum, bounds)


def _stretches(plant: Dubins3D, low: Number, high: Number, step: Number) -> tuple[Any, Any]:
    """Return the least and the largest ratio of 1/cos² of a bank after a roll to that before it.

    Args:
        plant: the aircraft.
        low: the least bank before the roll [rad].
        high: the largest bank before the roll [rad].
        step: what the roll adds to the bank [rad]. It adds nothing beyond the limits of the bank.
    """
    limits = plant.roll_limits
    ends = [
        jnp.clip(bank, limits[0] - jnp.minimum(step, 0.0), limits[1] - jnp.maximum(step, 0.0))
        for bank in (low, high)
    ]
    ratios = [(cos_acute(end) / cos_acute(end + step)) ** 2 for end in ends]
    return jnp.minimum(*ratios), jnp.maximum(*ratios)


def wrong_course(
    plant: Dubins3D, bound: UncertaintyBound, tube: TubeInSpace, before: Any, pursuit: Pursuit
) -> Any:
    """Return how wrong the heading error that the true control acts on may be [rad].

    Args:
        plant: the aircraft.
        bound: the bound on what is not known.
        tube: the tube before the step.
        before: the predicted state before the step.
        pursuit: what the controller asks for.
    """
    own_speed = jnp.maximum(before.speed - tube.speed, plant.speed_limits[0])
    level_speed = own_speed * _level(plant, before, tube.climb)
    return largest_turn(bound.velocity, level_speed) + pursuit.apart / pursuit.lead_level_speed


def _moved(
    env: Environment,
    bound: UncertaintyBound,
    tube: TubeInSpace,
    kept: TubeInSpace,
    turn: Number,
    before: Any,
    after: Any,
) -> TubeInSpace:
    """Return the tube after a step at whose end the disturbance has changed the velocity.

    Args:
        env: the environment.
        bound: the bound on what is not known.
        tube: the tube before the step.
        kept: what the controls leave of it by the end of the step, without the disturbance.
        turn: how far the headings may move apart within the step [rad].
        before: the predicted state before the step.
        after: the predicted state after the step.
    """
    plant = cast(Dubins3D, env.agent_platform)
    push = bound.process * env.dt
    own_speed = jnp.maximum(after.speed - kept.speed, plant.speed_limits[0])
    turned = largest_turn(push, own_speed * _level(plant, after, kept.climb))
    fastest = jnp.maximum(before.speed, after.speed)
    within = tube.replace(heading=tube.heading + turn, speed=kept.speed, climb=kept.climb)
    apart = tube.velocity(fastest) + within.velocity(fastest)
    return kept.replace(
        position=tube.position + 0.5 * env.dt * (apart + push),
        heading=kept.heading + turned,
        speed=kept.speed + push,
        climb=kept.climb + largest_turn(push, own_speed),
        slow=kept.slow + turned,
        fast=kept.fast + turned,
    )


def _level(plant: Dubins3D, state: Any, climb: Number) -> Any:
    """Return the least cosine of a flight path angle in a tube."""
    limits = plant.flight_path_angle_limits
    steepest = jnp.maximum(limits[1], -limits[0])
    return cos_acute(jnp.minimum(jnp.abs(state.flight_path_angle) + climb, steepest))


def _turn_by_speed(
    plant: Dubins3D, before: Any, after: Any, speed: Number, sideways: Number
) -> Any:
    """Return how far a wrong speed turns the true heading from the predicted one in a step [rad].

    Args:
        plant: the aircraft.
        before: the predicted state before the step.
        after: the predicted state after the step.
        speed: how far the true speed may be from the predicted one [ft/s].
        sideways: how far g tan φ may be from the predicted one [ft/s²].
    """
    slow = jnp.minimum(before.speed, after.speed)
    bank = jnp.maximum(jnp.abs(before.roll), jnp.abs(after.roll))
    acceleration = plant.gravity * tan_acute(bank) + sideways
    return acceleration * speed / (slow * jnp.maximum(slow - speed, plant.speed_limits[0]))
