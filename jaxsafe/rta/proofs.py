"""What the proofs of the packaged backup controllers and terminal sets need of the numbers of an environment."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any, cast

import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxsafe.processors.constraint import Separation
from jaxsafe.processors.status import Distance
from jaxsafe.rta.filter import BackupController, CertifiedRTA, Faults
from jaxsafe.rta.speed_limit import LARGEST_TURN, SpeedLimitFacts, distance_and_speed, off_centre, speed_limit_facts
from jaxsafe.simulation.controllers import Uncontrolled
from jaxsafe.simulation.cwh import MEAN_MOTION, Spacecraft
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.simulation.scripted import Constant, Scripted
from jaxsafe.transition import constraint
from jaxsafe.types import Number, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment
    from jaxsafe.rta.backups import AlignAndBrake, AlignedOrSlow, MatchVelocity, Slow, VelocityMatched

Aircraft = Dubins2D | Dubins3D

PROVED_ANGLE = math.radians(75.0)
"""From this misalignment or less, at any spin, `align_and_brake` never lets it grow beyond `LARGEST_ANGLE`. This and the
numbers below are what `python benchmarks/terminal_set.py` proves with those of docking2d_oriented and steps of 1 s."""

LARGEST_ANGLE = math.radians(80.2)
ANGLE_WITHIN_A_STEP = math.radians(3.0)
"""What the body's turn of 2° and the course's of less than 1° add within a step."""

STEPS_TO_ALIGN = 77.0
"""From any angle and spin until the thrust axis is along the velocity: 20 to `PROVED_ANGLE`, then 57."""

PROVED_WHEEL = math.pi / 180.0
"""Largest acceleration of the body by the reaction wheel [rad/s²]."""

PROVED_SPIN = math.pi / 90.0
"""Fastest turn of the body [rad/s]."""

PROVED_PUSH = (2.0 / 12.0) / 0.2
"""The largest acceleration by thrust as a share of the speed limit at the chief [1/s]."""

PROVED_MARGIN = 2.5e-4 / 0.2
"""What the first step of a certificate has to win of the margin, as a share of the same limit."""

EQUAL = 1.001
"""Numbers this close are taken to be those of the proof, which has more reserve."""


def brake_faults(env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
    """Return what is missing at a state for Propositions 3 and 4: `brake` keeps a speed limit."""
    if type(env.agent_platform) is not Spacecraft:
        return {"brake is proved to keep a speed limit for a spacecraft alone": _true()}
    found = _speed_limits(env, rta)
    if isinstance(found, str):
        return {found: _true()}
    (distance, speed), margin = distance_and_speed(env, sim), rta.required_margin(env)
    faults = {"the chief is not at the origin": off_centre(env, sim)}
    for facts in found:
        farthest = facts.farthest(distance, speed)
        known = jnp.where(jnp.isfinite(farthest), farthest, 0.0)
        faults |= {
            "mean motion and step are too large": facts.mean_motion * env.dt > LARGEST_TURN,
            "margin is not below the speed limit at the chief": ~(margin < facts.floor),
            "thrust cannot stop the spacecraft": ~jnp.isfinite(farthest),
            "thrust cannot hold the speed limit": ~(facts.room(known, margin) > 0.0),
            "margin is too small for what the limit changes within a step": ~(facts.needed_margin(known) <= margin),
        }
    return faults


def align_and_brake_faults(env: Environment, sim: Sim, rta: CertifiedRTA, backup: AlignAndBrake) -> Faults:
    """Return what is missing at a state for Propositions 4 and 8, apart from the terminal set."""
    if type(env.agent_platform) is not OrientedSpacecraft:
        return {"align_and_brake is proved to keep a speed limit for an oriented spacecraft alone": _true()}
    if rta.terminal is None:
        return {"align_and_brake keeps no speed limit by itself: give a horizon and a terminal set": _true()}
    if env.action_names != env.agent_platform.inputs:
        return {f"align_and_brake expects the actuators {', '.join(env.agent_platform.inputs)} in this order": _true()}
    if tuple(rta.constraints) != (backup.constraint,):
        return {f"align_and_brake {backup.name!r} keeps {backup.constraint!r} alone": _true()}
    found = _speed_limits(env, rta)
    if isinstance(found, str):
        return {found: _true()}
    (facts,), kept, required = found, 2.0 * backup.kept_margin(env), rta.required_margin(env)
    wheel = env.actuators[1]
    distance, _ = distance_and_speed(env, sim)
    n, slope, limits = facts.mean_motion, facts.slope, env.agent_platform.attitude_rate_limits
    rates = (n / MEAN_MOTION, slope / (2.0 * MEAN_MOTION), 3.0 * n**2 / jnp.maximum(slope, 1e-9) / (1.5 * MEAN_MOTION))
    first = (kept - required) / facts.floor
    return {
        "the chief is not at the origin": off_centre(env, sim),
        "align_and_brake is proved for steps of 1 s alone": ~_is(env.dt, 1.0),
        "align_and_brake is proved for a wheel of 1°/s² alone": ~(
            _is(wheel.high, PROVED_WHEEL) & _is(-wheel.low, PROVED_WHEEL)
        ),
        "align_and_brake is proved for turns of up to 2°/s alone": ~(
            _is(limits[1], PROVED_SPIN) & _is(-limits[0], PROVED_SPIN)
        ),
        "align_and_brake is proved for `aligned` of 6° and `steep` of 75° alone": ~(
            _is(backup.aligned, math.pi / 30) & _is(backup.steep, PROVED_ANGLE)
        ),
        "mean motion or slope of the limit differ too much from those that align_and_brake is proved for": ~(
            functools.reduce(jnp.maximum, rates) <= EQUAL
        ),
        "the speed limit at the chief is not above where it begins to grow": ~(slope * facts.constant_to <= facts.floor),
        "thrust is too strong for what align_and_brake is proved for": ~(
            facts.strongest / facts.floor <= EQUAL * PROVED_PUSH
        ),
        "margin of the filter and of align_and_brake do not go together": ~(
            (kept >= required) & (first <= EQUAL * PROVED_MARGIN)
        ),
        "margin is too small for what the limit changes within a step": ~(
            rta.lowest(env, sim, sim) >= facts.needed_margin(distance)
        ),
    }


def slow_faults(env: Environment, rta: CertifiedRTA, terminal: Slow, keeper: type[BackupController]) -> Faults:
    """Return what is missing for the proof that `slow` is safe and that `brake` keeps it."""
    if _packaged_but(keeper, rta):
        return {"slow is proved to be kept by brake alone": _true()}
    found = [facts for name in rta.constraints if (facts := speed_limit_facts(env, name))]
    above = [terminal.speed + rta.required_margin(env) > facts.floor for facts in found]
    return {"speed of slow is too close to the speed limit at the chief": jnp.any(jnp.stack(above))} if above else {}


def aligned_or_slow_faults(
    env: Environment, sim: Sim, rta: CertifiedRTA, terminal: AlignedOrSlow, keeper: type[BackupController]
) -> Faults:
    """Return what is missing at a state for Proposition 8: `align_and_brake` keeps the set."""
    if _packaged_but(keeper, rta):
        return {"aligned_or_slow is proved to be kept by align_and_brake alone": _true()}
    found = _speed_limits(env, rta)
    if isinstance(found, str):
        return {found: _true()}
    margin = rta.required_margin(env)
    farther = [~(_farthest(env, sim, facts) <= _held_to(facts, margin)) for facts in found]
    fast = [terminal.speed > EQUAL * 0.75 * facts.floor for facts in found]
    return {
        "thrust cannot hold the speed limit where the turn along the velocity leads": jnp.any(jnp.stack(farther)),
        "speed of aligned_or_slow is above 3/4 of the speed limit at the chief": jnp.any(jnp.stack(fast)),
        "angle of aligned_or_slow is larger than 75°": terminal.angle > EQUAL * PROVED_ANGLE,
    }


def _farthest(env: Environment, sim: Sim, facts: SpeedLimitFacts) -> Any:
    """How far from the chief a craft is at most until the backup has stopped it."""
    distance, speed = distance_and_speed(env, sim)
    almost = facts.replace(weakest=0.98 * facts.weakest)  # aligned to 6°, and what the body turns within a step
    return almost.farthest(distance + STEPS_TO_ALIGN * env.dt * speed, speed)


def _held_to(facts: SpeedLimitFacts, margin: Number) -> Any:
    """The distance up to which thrust holds the limit at the largest angle off the velocity."""
    share = math.cos(LARGEST_ANGLE + ANGLE_WITHIN_A_STEP) / 1.01
    spare = facts.weakest * share - margin / facts.dt - facts.slope * facts.floor
    return spare / jnp.maximum(jnp.maximum(3.0 * facts.mean_motion**2, facts.slope**2), 1e-12)


def velocity_matched_faults(
    env: Environment, sim: Sim, rta: CertifiedRTA, terminal: VelocityMatched, keeper: type[MatchVelocity]
) -> Faults:
    """Return what is missing at a state for Proposition 6 or 7: `match_velocity` keeps the set."""
    agent = env.agent
    others = {terminal.of, terminal.to} - {agent}
    plant = cast(Aircraft, env.agent_platform)
    if agent not in (terminal.of, terminal.to) or len(others) != 1 or type(plant) not in (Dubins2D, Dubins3D):
        return {"velocity_matched is proved for an aircraft that is the agent, and another one": _true()}
    (name,) = others
    lead = cast(Aircraft, env.platform(name))
    if type(lead) is not type(plant):
        return {"velocity_matched is proved for two aircraft of one kind": _true()}
    if _packaged_but(keeper, rta) or any(one.lead != name for one in rta.backups if type(one) is keeper):
        return {f"velocity_matched is proved to be kept by match_velocity of {name!r} alone": _true()}
    limits = [cast(Separation, constraint(env, one)) for one in rta.constraints]
    if not all(_separates(env, limit, {agent, name}) for limit in limits):
        return {f"velocity_matched keeps separations of {agent!r} and {name!r} alone": _true()}
    if type(lead.controller) not in (Uncontrolled, Scripted):
        return {f"what {name!r} may do is not known: give it a script": _true()}
    commands = {one.name: one for one in lead.controller.commands} if type(lead.controller) is Scripted else {}
    extremes = {one: commands[one].extremes() if one in commands else (0.0, 0.0) for one in lead.inputs}
    state, margin, (slowest, fastest) = sim.platforms[name], rta.required_margin(env), plant.speed_limits
    least, most = extremes["acceleration"]
    steady = (least == 0.0) & (most == 0.0)
    own_speed = (state.speed >= slowest) & (state.speed <= fastest)
    any_speed = (lead.speed_limits[0] >= slowest) & (lead.speed_limits[1] <= fastest)
    faults = {
        "clearance of velocity_matched is below the separation and the margin": jnp.any(
            jnp.stack([~(limit.minimum + margin <= terminal.clearance) for limit in limits])
        ),
        f"{name!r} may fly at speeds that the agent cannot": ~jnp.where(steady, own_speed, any_speed),
    }
    if type(plant) is Dubins2D:
        return faults | _faults_in_plane(env, rta, terminal, keeper, name, extremes)
    return faults | _faults_in_space(env, terminal, state, name, commands, extremes)


def _faults_in_plane(
    env: Environment,
    rta: CertifiedRTA,
    terminal: VelocityMatched,
    keeper: type[MatchVelocity],
    name: str,
    extremes: Any,
) -> Faults:
    """What is missing for Proposition 6."""
    error = 1.01 * terminal.tolerance / cast(Aircraft, env.agent_platform).speed_limits[0]
    spare = {"heading_rate": error / env.dt, "acceleration": terminal.tolerance / env.dt}
    ranges = {one.name: (one.low, one.high) for one in env.actuators}
    faster = []
    for control, (least, most) in extremes.items():
        low, high = ranges.get(control, (0.0, 0.0))
        faster.append(~((least - spare[control] >= low) & (most + spare[control] <= high)))
    turns = [jnp.abs(rate) for rate in (*extremes["heading_rate"], *ranges.get("heading_rate", ()))]
    zones = [one.dead_zone for one in rta.backups if type(one) is keeper]
    return {
        f"{name!r} may turn or accelerate faster than the agent can copy": jnp.any(jnp.stack(faster)),
        "drift of velocity_matched is less than a step": ~(terminal.drift * EQUAL >= env.dt),
        "tolerance of velocity_matched is too large": ~(error < functools.reduce(jnp.minimum, zones, 0.05)),
        "an aircraft turns too far within a step": ~(functools.reduce(jnp.maximum, turns) * env.dt <= 0.85),
    }


def _faults_in_space(
    env: Environment, terminal: VelocityMatched, state: Any, name: str, commands: Any, extremes: Any
) -> Faults:
    """What is missing for Proposition 7."""
    plant = cast(Dubins3D, env.agent_platform)
    if "heading_rate" in commands and type(commands["heading_rate"]) is not Constant:
        return {f"{name!r} may change its turn, which in space the agent cannot copy in time": _true()}
    turning = jnp.tan(state.roll)
    if "heading_rate" in commands:
        turning = commands["heading_rate"].at * state.speed / plant.gravity
    moved = [one != 0.0 for control, ends in extremes.items() if control != "heading_rate" for one in ends]
    bank = jnp.minimum(-plant.roll_limits[0], plant.roll_limits[1])
    climb = jnp.minimum(jnp.minimum(-plant.flight_path_angle_limits[0], plant.flight_path_angle_limits[1]), 0.35)
    return {
        f"{name!r} may change its speed, its roll or its angle of climb": jnp.any(
            jnp.stack([jnp.asarray(one) for one in moved])
        ),
        f"{name!r} turns faster than the agent can copy": ~(jnp.abs(turning) <= 0.98 * jnp.tan(bank)),
        f"{name!r} climbs or dives steeper than the agent can": ~(jnp.abs(state.flight_path_angle) <= climb),
        "velocity_matched in space is proved for steps of at most 1 s": env.dt > EQUAL,
        "velocity_matched in space is proved for a drift of 9 s and a lag of 1 s": ~(
            (terminal.drift * EQUAL >= 9.0) & (terminal.lag * EQUAL >= 1.0)
        ),
    }


def _true() -> Bool[Array, ""]:
    return jnp.ones((), bool)


def _is(value: Number, expected: float) -> Bool[Array, ""]:
    return jnp.abs(value - expected) <= (EQUAL - 1.0) * abs(expected)


def _speed_limits(env: Environment, rta: CertifiedRTA) -> list[SpeedLimitFacts] | str:
    """The facts of a filter's constraints, or what is missing if nothing is proved of one of them."""
    found = {name: speed_limit_facts(env, name) for name in rta.constraints}
    unknown = next((name for name, facts in found.items() if facts is None), None)
    if unknown:
        return f"constraint {unknown!r} is no speed limit about a chief that all thrusters of the agent can keep"
    return [facts for facts in found.values() if facts]


def _packaged_but(kind: type[BackupController], rta: CertifiedRTA) -> bool:
    """Whether a backup controller is one of this module and of another kind; of those of users nothing is known here."""
    return any(type(one).__module__ == kind.__module__ and type(one) is not kind for one in rta.backups)


def _separates(env: Environment, limit: Any, platforms: set[str]) -> bool:
    """Whether a constraint is the separation of two platforms."""
    if type(limit) is not Separation:
        return False
    status = next(one for one in env.status if one.name == limit.distance)
    return type(status) is Distance and {status.of, status.to} == platforms
