"""Conditions under which the proofs for the packaged backup controllers and terminal sets hold.

The propositions are those of docs/safety/proofs.md. Each function returns in words what is missing
at a state, as `BackupController.faults` does. Some terminal sets are proved for one backup
controller alone. Its class is the argument `keeper`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.processors.constraint import Separation
from jaxsafe.processors.status import DeltaV, Distance
from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.certificate import BackupController, Faults
from jaxsafe.rta.certified import CertifiedRTA
from jaxsafe.rta.formation import CLOSE, formation_faults
from jaxsafe.rta.speed_limit import (
    MAX_ORBIT_ANGLE_PER_STEP,
    SpeedLimitFacts,
    distance_and_speed,
    off_centre,
    speed_limit_facts,
)
from jaxsafe.rta.tube import errors_after_delay
from jaxsafe.simulation.controllers import Uncontrolled
from jaxsafe.simulation.cwh import MEAN_MOTION, Anchor, Spacecraft
from jaxsafe.simulation.double_integrator import DoubleIntegrator
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.simulation.scripted import Command, Constant, Scripted
from jaxsafe.transition import bounds, constraint, remembering_statuses, status_names
from jaxsafe.types import Number, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment
    from jaxsafe.rta.backups import (
        AlignAndBrake,
        AlignedOrSlow,
        MatchVelocity,
        Slow,
        VelocityMatched,
    )

Aircraft = Dubins2D | Dubins3D

# `python benchmarks/terminal_set.py` proves the following numbers for the numbers of
# docking2d_oriented and for steps of 1 s. They are those of Proposition 8.

PROVED_ANGLE = math.radians(75.0)
"""Largest angle from the thrust axis to the velocity [rad] at which `aligned_or_slow` may begin.

From there, at any spin, `align_and_brake` never lets the angle grow beyond `LARGEST_ANGLE`.
"""

LARGEST_ANGLE = math.radians(80.2)
"""Largest angle from the thrust axis to the velocity at the ends of steps [rad]."""

ANGLE_WITHIN_STEP = math.radians(3.0)
"""Increase of that angle within a step [rad].

The body turns by 2° and the velocity by less than 1°.
"""

STEPS_TO_ALIGN = 77.0
"""Steps from any angle and spin until the thrust axis is along the velocity.

It takes 20 steps to `PROVED_ANGLE` and then 57.
"""

PROVED_WHEEL = math.pi / 180.0
"""Largest angular acceleration of the body by the reaction wheel [rad/s²]."""

PROVED_SPIN = math.pi / 90.0
"""Highest turn rate of the body [rad/s]."""

PROVED_THRUST = (2.0 / 12.0) / 0.17
"""Largest acceleration by thrust, as a share of the speed limit at the chief [1/s]."""

PROVED_MARGIN = 2.5e-4 / 0.17
"""Margin that the first step of a certificate must gain, as a share of that speed limit."""

MOST_LOST = 0.03
"""Largest h [m/s] that a `bound` may cost while `align_and_brake` is rehearsed."""

PLANAR_AWAY_TIME = 10
"""The `away_time` [s] of `match_velocity` for which Proposition 13 is proved."""


def brake_faults(env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
    """Return what is missing for Propositions 3, 4 and 11: `brake` keeps a speed limit."""
    if type(env.agent_platform) not in (Spacecraft, DoubleIntegrator):
        fault = "brake is proved to keep a speed limit for a spacecraft or double_integrator alone"
        return {fault: _true()}
    if slow := slow_actuators(env, "brake"):
        return slow
    speed_limits = _speed_limits(env, rta)
    if isinstance(speed_limits, str):
        return {speed_limits: _true()}
    distance, speed = distance_and_speed(env, sim)
    faults = {"the chief is not at the origin": off_centre(env, sim)}
    bound = rta.bound
    within = "" if bound is None else " within rta.bound"
    for name, facts in zip(rta.constraints, speed_limits, strict=True):
        margin = rta.required_margin(env, name)
        braking = facts
        needed = margin
        farthest = facts.farthest(distance, speed)
        if bound is not None:
            braking = bound.reduced(facts)
            needed = margin + bound.lost([facts], facts.strongest)
            errors = bound.errors_after(facts, bound.errors(facts), facts.strongest)
            farthest = braking.farthest(distance + errors.position, speed + errors.velocity)
        distance_to_hold = jnp.where(jnp.isfinite(farthest), farthest, 0.0)
        faults_of_limit = {
            "mean motion and step are too large": facts.mean_motion * env.dt
            > MAX_ORBIT_ANGLE_PER_STEP,
            f"margin is not below the speed limit at the chief{within}": ~(needed < facts.floor),
            f"thrust cannot stop the spacecraft{within}": ~jnp.isfinite(farthest),
            f"thrust cannot hold the speed limit{within}": ~(
                braking.room(distance_to_hold, margin) > 0.0
            ),
            "margin is too small for what the limit changes within a step": ~(
                facts.needed_margin(distance_to_hold) <= margin
            ),
        }
        for fault, applies in faults_of_limit.items():  # several limits may share a fault
            faults[fault] = applies | faults.get(fault, False)
    return faults


def align_and_brake_faults(
    env: Environment, sim: Sim, rta: CertifiedRTA, backup: AlignAndBrake
) -> Faults:
    """Return what is missing for Propositions 4 and 8, apart from the terminal set."""
    plant = env.agent_platform
    if type(plant) is not OrientedSpacecraft:
        fault = "align_and_brake is proved to keep a speed limit for an oriented spacecraft alone"
        return {fault: _true()}
    if slow := slow_actuators(env, "align_and_brake"):
        return slow
    if rta.terminal is None:
        fault = "align_and_brake keeps no speed limit by itself: give a horizon and a terminal set"
        return {fault: _true()}
    if env.action_names != plant.inputs:
        names = ", ".join(plant.inputs)
        return {f"align_and_brake expects the actuators {names} in this order": _true()}
    if tuple(rta.constraints) != (backup.constraint,):
        return {f"align_and_brake {backup.name!r} keeps {backup.constraint!r} alone": _true()}
    speed_limits = _speed_limits(env, rta)
    if isinstance(speed_limits, str):
        return {speed_limits: _true()}
    (facts,) = speed_limits
    kept = 2.0 * backup.least_kept(env)
    required = rta.required_margin(env, backup.constraint)
    wheel = env.actuators[1]
    distance, _ = distance_and_speed(env, sim)
    n = facts.mean_motion
    slope = facts.slope
    rate_limits = plant.attitude_rate_limits
    relative_rates = (
        n / MEAN_MOTION,
        slope / (2.0 * MEAN_MOTION),
        3.0 * n**2 / jnp.maximum(slope, 1e-9) / (1.5 * MEAN_MOTION),
    )
    first_gain = (kept - required) / facts.floor
    return {
        "the chief is not at the origin": off_centre(env, sim),
        "align_and_brake is proved for steps of 1 s alone": ~_is(env.dt, 1.0),
        "align_and_brake is proved for a wheel of 1°/s² alone": ~(
            _is(wheel.high, PROVED_WHEEL) & _is(-wheel.low, PROVED_WHEEL)
        ),
        "align_and_brake is proved for turns of up to 2°/s alone": ~(
            _is(rate_limits[1], PROVED_SPIN) & _is(-rate_limits[0], PROVED_SPIN)
        ),
        "align_and_brake is proved for `aligned` of 6° and `steep` of 75° alone": ~(
            _is(backup.aligned, math.pi / 30) & _is(backup.steep, PROVED_ANGLE)
        ),
        "mean motion or slope of the limit differ too much from those"
        " that align_and_brake is proved for": ~(
            functools.reduce(jnp.maximum, relative_rates) <= CLOSE
        ),
        "the speed limit at the chief is not above where it begins to grow": ~(
            slope * facts.constant_to <= facts.floor
        ),
        "thrust is too strong for what align_and_brake is proved for": ~(
            facts.strongest / facts.floor <= CLOSE * PROVED_THRUST
        ),
        "margin of the filter and of align_and_brake do not go together": ~(
            (kept >= required) & (first_gain <= CLOSE * PROVED_MARGIN)
        ),
        "margin is too small for what the limit changes within a step": ~(
            rta.lowest(env, sim, sim) >= facts.needed_margin(distance)
        ),
    }


def rehearsed_faults(
    env: Environment, rta: CertifiedRTA, backup: BackupController, keeper: type[BackupController]
) -> Faults:
    """Return what is missing for Proposition 16: a limit within a bound on what is not known.

    Args:
        env: the environment, with the limit that is lower by what the bound may cost.
        rta: the filter.
        backup: the backup controller that is rehearsed.
        keeper: the class of backup controllers for which it is proved.
    """
    if type(backup) is not keeper:
        return {"rehearsed is proved for align_and_brake alone": _true()}
    bound = rta.bound
    if bound is None:
        return {}
    if bound.delay:
        return {"rta.bound.delay is not proved for rehearsed": _true()}
    return {
        "rta.bound.mass and misalignment are not proved for rehearsed": (
            (bound.mass > 0.0) | (bound.misalignment > 0.0)
        ),
        f"bound costs more than {MOST_LOST:g} m/s of the speed limit": ~(
            rta.lost(env) <= MOST_LOST
        ),
    }


def slow_faults(
    env: Environment, rta: CertifiedRTA, terminal: Slow, keeper: type[BackupController]
) -> Faults:
    """Return what is missing for the proof that `slow` is safe and that `brake` keeps it."""
    if _packaged_but(keeper, rta):
        return {"slow is proved to be kept by brake alone": _true()}
    if late := slow_actuators(env, "slow"):
        return late
    above = [
        terminal.speed + rta.required_margin(env, name) > facts.floor
        for name in rta.constraints
        if (facts := speed_limit_facts(env, name))
    ]
    if not above:
        return {}
    fault = "speed of slow is too close to the speed limit at the chief"
    return {fault: jnp.any(jnp.stack(above))}


def at_rest_faults(
    env: Environment, sim: Sim, rta: CertifiedRTA, keeper: type[BackupController]
) -> Faults:
    """Return what is missing for Proposition 9: `brake` keeps a spacecraft at rest in its place."""
    plant: Any = env.agent_platform
    if type(plant) is not Spacecraft or not set(plant.inputs) <= set(env.action_names):
        return {"at_rest is proved for a spacecraft with all thrusters alone": _true()}
    if late := slow_actuators(env, "at_rest"):
        return late
    if _packaged_but(keeper, rta):
        return {"at_rest is proved to be kept by brake alone": _true()}
    moving = [
        platform.name
        for platform in env.platforms
        if platform.name != env.agent and type(platform) is not Anchor
    ]
    if moving:
        return {f"at_rest is proved where all others rest, and {moving[0]!r} may move": _true()}
    remembering = remembering_statuses(env, rta.constraints)
    if remembering:
        fault = f"at_rest is proved for constraints without memory, and {remembering[0]!r} has one"
        return {fault: _true()}
    distance, _ = distance_and_speed(env, sim)
    low, high = bounds(env)
    weakest = jnp.min(jnp.minimum(-low, high)) / plant.mass
    n = jnp.abs(plant.mean_motion)
    faults = {
        "mean motion and step are too large": n * env.dt > MAX_ORBIT_ANGLE_PER_STEP,
        "thrust cannot hold the spacecraft at rest": ~(3.0 * n**2 * distance < 0.9 * weakest),
    }
    for name in rta.constraints:
        facts = speed_limit_facts(env, name)
        if facts:
            fault = f"margin of {name!r} is too small for what the limit changes within a step"
            required = rta.required_margin(env, name)
            faults[fault] = ~(facts.needed_margin(distance) <= required)
    return faults


def coast_faults(env: Environment, rta: CertifiedRTA) -> Faults:
    """Return what is missing for the proof that `coast` keeps the constraints."""
    if late := slow_actuators(env, "coast"):
        return late
    low, high = bounds(env)
    faults = {"coast needs actuators that can give no control": jnp.any((low > 0.0) | (high < 0.0))}
    for name in rta.constraints:
        if not _is_budget(env, name):
            faults[f"coast is proved to keep budgets alone, and {name!r} is none"] = _true()
    return faults


def aligned_or_slow_faults(
    env: Environment,
    sim: Sim,
    rta: CertifiedRTA,
    terminal: AlignedOrSlow,
    keeper: type[BackupController],
) -> Faults:
    """Return what is missing for Proposition 8: `align_and_brake` keeps the set."""
    if _packaged_but(keeper, rta):
        return {"aligned_or_slow is proved to be kept by align_and_brake alone": _true()}
    if late := slow_actuators(env, "aligned_or_slow"):
        return late
    speed_limits = _speed_limits(env, rta)
    if isinstance(speed_limits, str):
        return {speed_limits: _true()}
    too_far = [
        ~(_farthest(env, sim, facts) <= _held_to(facts, rta.required_margin(env, name)))
        for name, facts in zip(rta.constraints, speed_limits, strict=True)
    ]
    too_fast = [terminal.speed > CLOSE * 0.75 * facts.floor for facts in speed_limits]
    return {
        "thrust cannot hold the speed limit where the turn along the velocity leads": jnp.any(
            jnp.stack(too_far)
        ),
        "speed of aligned_or_slow is above 3/4 of the speed limit at the chief": jnp.any(
            jnp.stack(too_fast)
        ),
        "angle of aligned_or_slow is larger than 75°": terminal.angle > CLOSE * PROVED_ANGLE,
    }


def _farthest(env: Environment, sim: Sim, facts: SpeedLimitFacts) -> Any:
    """Return the largest distance [m] from the chief that `align_and_brake` may reach."""
    distance, speed = distance_and_speed(env, sim)
    # cos 8° ≥ 0.98: the axis is aligned to 6°, and the body turns by 2° within a step.
    aligned = facts.replace(weakest=0.98 * facts.weakest)
    return aligned.farthest(distance + STEPS_TO_ALIGN * env.dt * speed, speed)


def _held_to(facts: SpeedLimitFacts, margin: Number) -> Any:
    """Return the distance [m] up to which thrust holds the limit at the largest angle."""
    share = math.cos(LARGEST_ANGLE + ANGLE_WITHIN_STEP) / 1.01
    spare = facts.weakest * share - margin / facts.dt - facts.slope * facts.floor
    return spare / jnp.maximum(jnp.maximum(3.0 * facts.mean_motion**2, facts.slope**2), 1e-12)


def velocity_matched_faults(
    env: Environment,
    sim: Sim,
    rta: CertifiedRTA,
    terminal: VelocityMatched,
    keeper: type[MatchVelocity],
) -> Faults:
    """Return what is missing for Propositions 6, 7 and 12 to 15: `match_velocity` keeps the set."""
    agent = env.agent
    others = {terminal.of, terminal.to} - {agent}
    plant = cast(Aircraft, env.agent_platform)
    if (
        agent not in (terminal.of, terminal.to)
        or len(others) != 1
        or type(plant) not in (Dubins2D, Dubins3D)
    ):
        return {
            "velocity_matched is proved for an aircraft that is the agent, and another one": _true()
        }
    (name,) = others
    lead = cast(Aircraft, env.platform(name))
    if late := slow_actuators(env, "velocity_matched"):
        return late
    if type(lead) is not type(plant):
        return {"velocity_matched is proved for two aircraft of one kind": _true()}
    proved = [backup.proved for backup in rta.backups]
    keepers = [backup for backup in proved if type(backup) is keeper]
    if _packaged_but(keeper, rta) or any(backup.lead != name for backup in keepers):
        fault = f"velocity_matched is proved to be kept by match_velocity of {name!r} alone"
        return {fault: _true()}
    limits = [cast(Separation, constraint(env, limit)) for limit in rta.constraints]
    if not all(_separates(env, limit, {agent, name}) for limit in limits):
        return {f"velocity_matched keeps separations of {agent!r} and {name!r} alone": _true()}
    kept = jnp.stack([limit.minimum + rta.required_margin(env, limit.name) for limit in limits])
    if type(lead.controller) not in (Uncontrolled, Scripted):
        return {f"what {name!r} may do is not known: give it a script": _true()}
    script = lead.controller.commands if type(lead.controller) is Scripted else ()
    commands = {command.name: command for command in script}
    extremes = {
        control: commands[control].extremes() if control in commands else (0.0, 0.0)
        for control in lead.inputs
    }
    state = sim.platforms[name]
    slowest, fastest = plant.speed_limits
    least, most = extremes["acceleration"]
    steady = (least == 0.0) & (most == 0.0)
    own_speed = (state.speed >= slowest) & (state.speed <= fastest)
    any_speed = (lead.speed_limits[0] >= slowest) & (lead.speed_limits[1] <= fastest)
    faults = {
        "clearance of velocity_matched is below the separation and the margin": jnp.any(
            ~(kept <= terminal.clearance)
        ),
        f"{name!r} may fly at speeds that the agent cannot": ~jnp.where(
            steady, own_speed, any_speed
        ),
    }
    if rta.bound is not None:
        return faults | _faults_with_bound(
            env,
            rta.bound,
            terminal=terminal,
            backups=keepers,
            state=state,
            name=name,
            extremes=extremes,
            limits=limits,
            kept=kept,
        )
    if type(plant) is Dubins2D:
        zones = [backup.dead_zone for backup in keepers]
        return faults | _faults_in_plane(
            env, terminal=terminal, dead_zones=zones, name=name, extremes=extremes
        )
    return faults | _faults_in_space(
        env, terminal=terminal, state=state, name=name, commands=commands, extremes=extremes
    )


def _faults_in_plane(
    env: Environment,
    terminal: VelocityMatched,
    dead_zones: Sequence[Number],
    name: str,
    extremes: Mapping[str, tuple[Number, Number]],
) -> Faults:
    """Return what is missing for Proposition 6.

    Args:
        env: the environment.
        terminal: the terminal set.
        dead_zones: the dead zones of the backup controllers [rad].
        name: the name of the lead.
        extremes: the smallest and the largest value of each of the lead's controls.
    """
    error = 1.01 * terminal.tolerance / cast(Aircraft, env.agent_platform).speed_limits[0]
    spare = {"heading_rate": error / env.dt, "acceleration": terminal.tolerance / env.dt}
    ranges = {actuator.name: (actuator.low, actuator.high) for actuator in env.actuators}
    too_fast = []
    for control, (least, most) in extremes.items():
        low, high = ranges.get(control, (0.0, 0.0))
        too_fast.append(~((least - spare[control] >= low) & (most + spare[control] <= high)))
    turns = [jnp.abs(rate) for rate in (*extremes["heading_rate"], *ranges.get("heading_rate", ()))]
    return {
        f"{name!r} may turn or accelerate faster than the agent can copy": jnp.any(
            jnp.stack(too_fast)
        ),
        "drift of velocity_matched is less than a step": ~(terminal.drift * CLOSE >= env.dt),
        "tolerance of velocity_matched is too large": ~(
            error < functools.reduce(jnp.minimum, dead_zones, 0.05)
        ),
        "an aircraft turns too far within a step": ~(
            functools.reduce(jnp.maximum, turns) * env.dt <= 0.85
        ),
    }


def _faults_with_bound(
    env: Environment,
    bound: UncertaintyBound,
    terminal: VelocityMatched,
    backups: Sequence[MatchVelocity],
    state: Any,
    name: str,
    extremes: Mapping[str, tuple[Number, Number]],
    limits: Sequence[Separation],
    kept: Float[Array, " c"],
) -> Faults:
    """Return what is missing for Propositions 12 and 13, or in space for 14 and 15.

    Args:
        env: the environment.
        bound: the filter's bound.
        terminal: the terminal set.
        backups: the backup controllers `match_velocity`.
        state: the state of the lead.
        name: the name of the lead.
        extremes: the smallest and the largest value of each of the lead's controls.
        limits: the separations of the filter.
        kept: the distance that each of them asks for, with its margin [ft].
    """
    plant = cast(Aircraft, env.agent_platform)
    if bound.delay and type(plant) is Dubins3D:
        return {"rta.bound.delay is not proved for aircraft in space": _true()}
    if bound.delay:
        bound = bound.after_delay(errors_after_delay(env, bound))
    unknown_thrust: Faults = {
        "rta.bound.mass is not proved for aircraft": bound.mass > 0.0,
        "rta.bound.misalignment is not proved for aircraft": bound.misalignment > 0.0,
    }
    dt = env.dt
    ranges = {actuator.name: (actuator.low, actuator.high) for actuator in env.actuators}
    authority = {
        control: dt * jnp.minimum(-low, high) for control, (low, high) in ranges.items()
    } | {control: jnp.zeros_like(dt) for control in plant.inputs if control not in ranges}
    if type(plant) is Dubins3D:
        return unknown_thrust | formation_faults(
            env,
            bound,
            terminal=terminal,
            backups=backups,
            state=state,
            name=name,
            extremes=extremes,
            lowest=jnp.max(kept),
            authority=authority,
        )
    if any(backup.away_time != PLANAR_AWAY_TIME for backup in backups):
        return {"rta.bound in the plane is proved for an away_time of 10 s alone": _true()}
    slowest, fastest = plant.speed_limits
    minimum = jnp.min(jnp.stack([limit.minimum for limit in limits]))
    outer = jnp.stack([backup.clearance for backup in backups])
    zones = jnp.stack([backup.dead_zone for backup in backups])

    away_gain = 1.0 / PLANAR_AWAY_TIME
    unknown = bound.velocity + away_gain * bound.position
    wrong = 1.2 * (unknown + bound.process * dt)  # η
    away = away_gain * (jnp.max(outer) - terminal.clearance + 0.5 * dt * wrong)  # A
    difference = terminal.tolerance + away + unknown
    turn = dt * jnp.maximum(*map(jnp.abs, extremes["heading_rate"]))
    angle = turn + 1.05 * difference / slowest
    return unknown_thrust | {
        "rta.bound is larger than velocity_matched is proved for": ~(
            (wrong <= CLOSE * 0.02 * slowest) & ((away + wrong) * dt <= 0.1 * jnp.min(kept))
        ),
        f"rta.bound is proved for a lead of constant speed, and {name!r} may change its speed": (
            jnp.any(jnp.stack(extremes["acceleration"]) != 0.0)
        ),
        f"rta.bound: {name!r} flies too close to the agent's slowest or fastest speed": ~(
            (state.speed - away - unknown >= slowest) & (state.speed + away + unknown <= fastest)
        ),
        f"rta.bound: {name!r} may turn faster than the agent can copy within it": ~(
            (angle <= authority["heading_rate"]) & (turn <= CLOSE * 0.17)
        ),
        "rta.bound: the agent accelerates too slowly for tolerance of velocity_matched": ~(
            difference <= authority["acceleration"]
        ),
        "rta.bound: dead_zone of match_velocity is too small": ~(angle <= jnp.min(zones)),
        "drift of velocity_matched is less than a step": ~(terminal.drift * CLOSE >= dt),
        "rta.bound: tolerance of velocity_matched is too small or too large": ~(
            (terminal.tolerance >= 1.04 * away + wrong)
            & (terminal.tolerance <= CLOSE * 0.05 * slowest)
        ),
        "rta.bound: clearance of velocity_matched is too small": ~(
            terminal.clearance * CLOSE >= jnp.max(kept) + 1.5 * dt * wrong
        ),
        "rta.bound: clearance of match_velocity is too small or too large": ~(
            (jnp.min(outer) * CLOSE >= terminal.clearance + wrong / (0.8 * away_gain))
            & (jnp.max(outer) <= 2.0 * (minimum - bound.position))
            & (away <= 0.03 * slowest)
        ),
        "rta.bound is proved for steps of at most 1 s": dt > CLOSE,
    }


def _faults_in_space(
    env: Environment,
    terminal: VelocityMatched,
    state: Any,
    name: str,
    commands: Mapping[str, Command],
    extremes: Mapping[str, tuple[Number, Number]],
) -> Faults:
    """Return what is missing for Proposition 7.

    Args:
        env: the environment.
        terminal: the terminal set.
        state: the state of the lead.
        name: the name of the lead.
        commands: the lead's script, by control.
        extremes: the smallest and the largest value of each of the lead's controls.
    """
    plant = cast(Dubins3D, env.agent_platform)
    turn = commands.get("heading_rate")
    if turn is not None and type(turn) is not Constant:
        fault = f"{name!r} may change its turn, which in space the agent cannot copy in time"
        return {fault: _true()}
    bank_tangent = jnp.tan(state.roll)
    if turn is not None:
        bank_tangent = turn.at * state.speed / plant.gravity
    moves = [
        jnp.asarray(value != 0.0)
        for control, ends in extremes.items()
        if control != "heading_rate"
        for value in ends
    ]
    max_bank = jnp.minimum(-plant.roll_limits[0], plant.roll_limits[1])
    low, high = plant.flight_path_angle_limits
    max_climb = jnp.minimum(jnp.minimum(-low, high), 0.35)
    return {
        f"{name!r} may change its speed, its roll or its angle of climb": jnp.any(jnp.stack(moves)),
        f"{name!r} turns faster than the agent can copy": ~(
            jnp.abs(bank_tangent) <= 0.98 * jnp.tan(max_bank)
        ),
        f"{name!r} climbs or dives steeper than the agent can": ~(
            jnp.abs(state.flight_path_angle) <= max_climb
        ),
        "velocity_matched in space is proved for steps of at most 1 s": env.dt > CLOSE,
        "velocity_matched in space is proved for a drift of 9 s and a lag of 1 s": ~(
            (terminal.drift * CLOSE >= 9.0) & (terminal.lag * CLOSE >= 1.0)
        ),
    }


def slow_actuators(env: Environment, proved: str) -> Faults:
    """Return what is missing where an actuator has a lag or a rate limit.

    Args:
        env: the environment.
        proved: the type of the part whose proof needs controls that act at once.
    """
    slow = [actuator.name for actuator in env.actuators if not actuator.at_once]
    if not slow:
        return {}
    fault = (
        f"{proved} is proved for actuators that act at once,"
        f" and {slow[0]} has a time_constant or a rate_limit"
    )
    return {fault: _true()}


def _is_budget(env: Environment, name: str) -> bool:
    """Return whether a constraint rests on sums of the agent's Δv alone."""
    statuses = {status.name: status for status in env.status}
    sums = [statuses[status] for status in status_names([constraint(env, name)])]
    added = [statuses[status] for status in status_names(sums)]
    return (
        bool(sums and added)
        and all(total.remembers for total in sums)
        and all(type(status) is DeltaV and status.of == env.agent for status in added)
    )


def _true() -> Bool[Array, ""]:
    return jnp.ones((), bool)


def _is(value: Number, expected: float) -> Bool[Array, ""]:
    """Return whether a number is the expected one, up to `CLOSE`."""
    return jnp.abs(value - expected) <= (CLOSE - 1.0) * abs(expected)


def _speed_limits(env: Environment, rta: CertifiedRTA) -> list[SpeedLimitFacts] | str:
    """Return the facts of all speed limits of a filter.

    If one of its constraints is no speed limit, or one that no proof covers, return a fault.
    """
    facts_by_name = {name: speed_limit_facts(env, name) for name in rta.constraints}
    unknown = next((name for name, facts in facts_by_name.items() if facts is None), None)
    if unknown:
        return (
            f"constraint {unknown!r} is no speed limit about a chief"
            " that all thrusters of the agent can keep"
        )
    return [facts for facts in facts_by_name.values() if facts]


def _packaged_but(keeper: type[BackupController], rta: CertifiedRTA) -> bool:
    """Return whether a filter has a packaged backup controller of another class than `keeper`.

    Backup controllers of users do not count, because nothing is known of them here.
    """
    classes = [type(backup.proved) for backup in rta.backups]
    return any(
        backup_class.__module__ == keeper.__module__ and backup_class is not keeper
        for backup_class in classes
    )


def _separates(env: Environment, limit: Any, platforms: set[str]) -> bool:
    """Return whether a constraint is the separation of two platforms."""
    if type(limit) is not Separation:
        return False
    status = next(status for status in env.status if status.name == limit.distance)
    return type(status) is Distance and {status.of, status.to} == platforms
