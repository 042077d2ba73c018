"""Backup controllers and the sets in which they stay safe for ever."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.processors.constraint import Separation
from jaxsafe.processors.status import Distance
from jaxsafe.rta.asif import linear, speed_ball
from jaxsafe.rta.filter import BackupController, CertifiedRTA, Faults, TerminalSet
from jaxsafe.rta.projection import project_box_ball
from jaxsafe.rta.speed_limit import (
    LARGEST_TURN,
    SpeedLimitFacts,
    distance_and_speed,
    off_centre,
    speed_limit_facts,
)
from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Uncontrolled
from jaxsafe.simulation.cwh import MEAN_MOTION, Spacecraft
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.geometry import direction, safe_norm
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.simulation.scripted import Constant, Scripted
from jaxsafe.simulation.trig import arctan, wrap
from jaxsafe.transition import Others, bounds, constraint, undirected
from jaxsafe.types import ConstraintName, Length, Number, PlatformName, Positive, Radians, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

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


class Brake(BackupController, type="brake"):
    """Thrust that brings the velocity to 0 at the end of the step, or as near as the bounds allow (dead beat)."""

    def control(self, env: Environment, sim: Sim, later: Others) -> Float[Array, " m"]:
        plant, names = env.agent_platform, env.action_names

        def velocity(u: Float[Array, " m"]) -> Array:
            return plant.step(sim.platforms[env.agent], dict(zip(names, u, strict=True)), env.dt).velocity

        drift, pushed = linear(velocity, jnp.zeros(len(names), env.dt.dtype))
        return -jnp.sum(pushed * drift[None], axis=-1) / jnp.max(jnp.sum(pushed * pushed, axis=-1))

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if rta.terminal is not None and type(rta.terminal) is not Slow:
            return {}
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


class AlignAndBrake(BackupController, type="align_and_brake"):
    """Turns the thrust axis along the velocity and brakes, for an oriented spacecraft.

    The attitude follows the rate sign(e) √(1.6 α abs(e)) for the error e between ±body axis and velocity, α the bound of
    the wheel. While abs(e) > `aligned` the thrust is the smallest that keeps the speed limit with twice the `margin`, which
    holds the boundary while the craft turns; then it nulls the velocity along the body. Where no thrust keeps the limit, it
    brakes, but not while abs(e) > `steep`: thrust so far across the velocity turns it away as fast as the body follows.
    """

    constraint: ConstraintName
    margin: Annotated[Number, Unit("m/s"), Range(0.0)]
    aligned: Annotated[Radians, Positive] = jnp.pi / 30
    steep: Annotated[Radians, Positive] = jnp.pi * 5 / 12

    def control(self, env: Environment, sim: Sim, later: Others) -> Float[Array, " 2"]:
        plant = cast(OrientedSpacecraft, env.agent_platform)
        state = sim.platforms[env.agent]
        low, high = bounds(env)
        error = misalignment(state)
        ceiling = plant.attitude_rate_limits[1]
        rate = jnp.sign(error) * jnp.minimum(ceiling, _safe_sqrt(1.6 * high[1] * jnp.abs(error)))
        turn = jnp.clip((rate - state.attitude_rate) / env.dt, low[1], high[1])

        margin = 2.0 * self._margin(env)
        ball = speed_ball(env, sim, jnp.stack([jnp.zeros_like(turn), turn]), self.constraint, margin, free=1)
        hold, feasible = project_box_ball(jnp.zeros(1, turn.dtype), low[:1], high[:1], *ball)
        hold = jnp.where(feasible | (jnp.abs(error) <= self.steep), hold[0], 0.0)
        along = jnp.sum(state.velocity * direction(state.attitude))
        brake = -along * plant.mass / env.dt
        return jnp.stack([jnp.where(jnp.abs(error) <= self.aligned, brake, hold), turn])

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if rta.terminal is not None and type(rta.terminal) is not AlignedOrSlow:
            return {}
        if type(env.agent_platform) is not OrientedSpacecraft:
            return {"align_and_brake is proved to keep a speed limit for an oriented spacecraft alone": _true()}
        if rta.terminal is None:
            return {"align_and_brake keeps no speed limit by itself: give a horizon and a terminal set": _true()}
        if env.action_names != env.agent_platform.inputs:
            return {f"align_and_brake expects the actuators {', '.join(env.agent_platform.inputs)} in this order": _true()}
        if tuple(rta.constraints) != (self.constraint,):
            return {f"align_and_brake {self.name!r} keeps {self.constraint!r} alone": _true()}
        found = _speed_limits(env, rta)
        if isinstance(found, str):
            return {found: _true()}
        (facts,), kept, required = found, 2.0 * self._margin(env), rta.required_margin(env)
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
                _is(self.aligned, math.pi / 30) & _is(self.steep, PROVED_ANGLE)
            ),
            "mean motion or slope of the limit differ too much from those that align_and_brake is proved for": ~(
                functools.reduce(jnp.maximum, rates) <= EQUAL
            ),
            "the speed limit at the chief is not above where it begins to grow": ~(
                slope * facts.constant_to <= facts.floor
            ),
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

    def duration(self, env: Environment) -> Number:
        """A reversal of the spin, and the turn out of the angles beyond 75°."""
        return 12.0 + jnp.zeros_like(env.dt)

    def _margin(self, env: Environment) -> Number:
        facts = speed_limit_facts(env, self.constraint)
        return self.margin if facts is None else jnp.maximum(self.margin, facts.least_margin)


class Slow(TerminalSet, type="slow"):
    """Hardly any speed: below a speed limit everywhere, and a brake that can stop within a few steps keeps it so."""

    speed: Annotated[Number, Unit("m/s"), Positive]

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        return safe_norm(sim.platforms[env.agent].velocity) <= self.speed

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if _packaged_but(Brake, rta):
            return {"slow is proved to be kept by brake alone": _true()}
        found = [facts for name in rta.constraints if (facts := speed_limit_facts(env, name))]
        above = [self.speed + rta.required_margin(env) > facts.floor for facts in found]
        return {"speed of slow is too close to the speed limit at the chief": jnp.any(jnp.stack(above))} if above else {}


class AlignedOrSlow(TerminalSet, type="aligned_or_slow"):
    """The thrust axis within `angle` of the velocity, so that braking has authority, or hardly any speed."""

    angle: Annotated[Radians, Positive]
    speed: Annotated[Number, Unit("m/s"), Positive]

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        state = sim.platforms[env.agent]
        return (jnp.abs(misalignment(state)) <= self.angle) | (safe_norm(state.velocity) <= self.speed)

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if _packaged_but(AlignAndBrake, rta):
            return {"aligned_or_slow is proved to be kept by align_and_brake alone": _true()}
        found = _speed_limits(env, rta)
        if isinstance(found, str):
            return {found: _true()}
        margin = rta.required_margin(env)
        farther = [~(self._farthest(env, sim, facts) <= self._held_to(facts, margin)) for facts in found]
        fast = [self.speed > EQUAL * 0.75 * facts.floor for facts in found]
        return {
            "thrust cannot hold the speed limit where the turn along the velocity leads": jnp.any(jnp.stack(farther)),
            "speed of aligned_or_slow is above 3/4 of the speed limit at the chief": jnp.any(jnp.stack(fast)),
            "angle of aligned_or_slow is larger than 75°": self.angle > EQUAL * PROVED_ANGLE,
        }

    def _farthest(self, env: Environment, sim: Sim, facts: SpeedLimitFacts) -> Any:
        """How far from the chief a craft is at most until the backup has stopped it."""
        distance, speed = distance_and_speed(env, sim)
        almost = facts.replace(weakest=0.98 * facts.weakest)  # aligned to 6°, and what the body turns within a step
        return almost.farthest(distance + STEPS_TO_ALIGN * env.dt * speed, speed)

    def _held_to(self, facts: SpeedLimitFacts, margin: Number) -> Any:
        """The distance up to which thrust holds the limit at the largest angle off the velocity."""
        share = math.cos(LARGEST_ANGLE + ANGLE_WITHIN_A_STEP) / 1.01
        spare = facts.weakest * share - margin / facts.dt - facts.slope * facts.floor
        return spare / jnp.maximum(jnp.maximum(3.0 * facts.mean_motion**2, facts.slope**2), 1e-12)


class MatchVelocity(BackupController, type="match_velocity"):
    """Turns one way to the lead's heading and takes its speed; then the relative position stays as it is.

    In the plane it takes the heading and the speed that the lead will have after the step. In space it banks by
    tan φ = v ω/g for the turn ω = 0.25 e + ψ̇_lead of the present heading error e, and climbs or dives at the steepest angle
    while the error is large, abs(e) above 0.45 rad, less so down to 0.15 rad, then flies the lead's angle.

    Rounding moves two aircraft of equal velocity, far from the origin by 0.01 ft a step. So where it is closer than
    `clearance` it takes the lead's velocity plus w = 0.1 s⁻¹ (`clearance` − ‖r‖) r/‖r‖, to first order.
    """

    lead: PlatformName
    clearance: Annotated[Length, Range(0.0)]
    turn: Literal["left", "right"]
    climb: Literal["up", "down"] | None = None  # in space
    dead_zone: Annotated[Radians, Range(0.0)] = 0.2
    within_limits: ClassVar[bool] = True

    def control(self, env: Environment, sim: Sim, later: Others) -> Float[Array, " m"]:
        own, lead, ahead = sim.platforms[env.agent], sim.platforms[self.lead], later[self.lead]
        sign = 1.0 if self.turn == "left" else -1.0
        away = self._away(own.position - lead.position)
        level = jnp.sum(lead.velocity[:2] ** 2)
        faster = jnp.sum(away * lead.velocity) / lead.speed
        goal = ahead.heading if self.climb is None else lead.heading
        goal += (lead.velocity[0] * away[1] - lead.velocity[1] * away[0]) / level
        error = sign * wrap(sign * (goal - own.heading), -self.dead_zone, 2.0 * jnp.pi)
        speed = jnp.clip(ahead.speed + faster, *cast(Aircraft, env.agent_platform).speed_limits)
        wanted = {"acceleration": (speed - own.speed) / env.dt}
        if self.climb is None:
            wanted["heading_rate"] = error / env.dt
        else:
            steeper = (faster * lead.velocity[2] / lead.speed - away[2]) / jnp.sqrt(level)
            turning = (ahead.heading - lead.heading) / env.dt
            wanted |= self._in_space(env, own, error, turning, ahead.flight_path_angle + steeper)
        return jnp.stack([wanted[name] for name in env.action_names])

    def duration(self, env: Environment) -> Number:
        """A full turn, and in space the roll that begins it."""
        if self.climb is None:
            return (2.0 * jnp.pi - self.dead_zone) / _authority(env, "heading_rate") + 2.0 * env.dt
        plant = cast(Dubins3D, env.agent_platform)
        bank = jnp.minimum(-plant.roll_limits[0], plant.roll_limits[1])
        turn = 2.0 * jnp.pi * plant.speed_limits[1] / (plant.gravity * jnp.tan(bank))
        return turn + bank / _authority(env, "roll_rate")

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if rta.terminal is None:
            return {"match_velocity keeps no separation by itself: give a horizon and a terminal set": _true()}
        return {}

    def _away(self, apart: Float[Array, " d"]) -> Float[Array, " d"]:
        distance = safe_norm(apart)
        return 0.1 * jnp.maximum(self.clearance - distance, 0.0) * apart / jnp.maximum(distance, 1.0)

    def _in_space(self, env: Environment, own: Any, error: Array, turning: Array, angle: Array) -> dict[str, Array]:
        plant = cast(Dubins3D, env.agent_platform)
        bank = arctan(own.speed * (0.25 * error + turning) / plant.gravity)
        bank = jnp.clip(bank, plant.roll_limits[0], plant.roll_limits[1])
        lowest, highest = plant.flight_path_angle_limits
        steep = lowest if self.climb == "up" else highest  # ż = −v sin γ
        level = jnp.clip(angle, lowest, highest)
        share = jnp.clip((jnp.abs(error) - 0.15) / 0.3, 0.0, 1.0)
        gamma = level + share * (steep - level)
        return {
            "roll_rate": (bank - own.roll) / env.dt,
            "flight_path_angle_rate": (gamma - own.flight_path_angle) / env.dt,
        }


class VelocityMatched(TerminalSet, type="velocity_matched"):
    """Relative speed below `tolerance` and, with `drift` seconds of it, still at least `clearance` apart.

    Where turning is a state, `lag` seconds of the relative acceleration count as relative speed.
    """

    of: PlatformName
    to: PlatformName
    tolerance: Annotated[Number, Unit("ft/s"), Positive]
    clearance: Annotated[Length, Positive]
    drift: Annotated[Number, Unit("s"), Range(0.0)] = 1.0
    lag: Annotated[Number, Unit("s"), Range(0.0)] = 0.0

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        one, other = sim.platforms[self.of], sim.platforms[self.to]
        accelerating = _acceleration(env, sim, self.of) - _acceleration(env, sim, self.to)
        relative = safe_norm(one.velocity - other.velocity) + self.lag * safe_norm(accelerating)
        apart = safe_norm(one.position - other.position)
        return (relative < self._tolerance(env)) & (apart >= self.clearance + self.drift * relative)

    def _tolerance(self, env: Environment) -> Number:
        """`tolerance`, or in space what the proof and the rates of the actuators allow, if that is less."""
        plant = env.agent_platform
        if type(plant) is not Dubins3D:
            return self.tolerance
        slowest, dt = plant.speed_limits[0], env.dt
        allowed = [
            0.02 * slowest,
            0.13 * plant.gravity,
            _authority(env, "acceleration") * dt,
            0.98 * _authority(env, "flight_path_angle_rate") * dt * slowest,
            _authority(env, "roll_rate") * dt * plant.gravity / 1.07,
        ]
        return functools.reduce(jnp.minimum, allowed, self.tolerance)

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        agent = env.agent
        others = {self.of, self.to} - {agent}
        plant = cast(Aircraft, env.agent_platform)
        if agent not in (self.of, self.to) or len(others) != 1 or type(plant) not in (Dubins2D, Dubins3D):
            return {"velocity_matched is proved for an aircraft that is the agent, and another one": _true()}
        (name,) = others
        lead = cast(Aircraft, env.platform(name))
        if type(lead) is not type(plant):
            return {"velocity_matched is proved for two aircraft of one kind": _true()}
        if _packaged_but(MatchVelocity, rta) or any(one.lead != name for one in rta.backups if type(one) is MatchVelocity):
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
                jnp.stack([~(limit.minimum + margin <= self.clearance) for limit in limits])
            ),
            f"{name!r} may fly at speeds that the agent cannot": ~jnp.where(steady, own_speed, any_speed),
        }
        if type(plant) is Dubins2D:
            return faults | self._faults_in_plane(env, rta, name, extremes)
        return faults | self._faults_in_space(env, state, name, commands, extremes)

    def _faults_in_plane(self, env: Environment, rta: CertifiedRTA, name: str, extremes: Any) -> Faults:
        """What is missing for Proposition 6."""
        error = 1.01 * self.tolerance / cast(Aircraft, env.agent_platform).speed_limits[0]
        spare = {"heading_rate": error / env.dt, "acceleration": self.tolerance / env.dt}
        ranges = {one.name: (one.low, one.high) for one in env.actuators}
        faster = []
        for control, (least, most) in extremes.items():
            low, high = ranges.get(control, (0.0, 0.0))
            faster.append(~((least - spare[control] >= low) & (most + spare[control] <= high)))
        turns = [jnp.abs(rate) for rate in (*extremes["heading_rate"], *ranges.get("heading_rate", ()))]
        zones = [one.dead_zone for one in rta.backups if type(one) is MatchVelocity]
        return {
            f"{name!r} may turn or accelerate faster than the agent can copy": jnp.any(jnp.stack(faster)),
            "drift of velocity_matched is less than a step": ~(self.drift * EQUAL >= env.dt),
            "tolerance of velocity_matched is too large": ~(error < functools.reduce(jnp.minimum, zones, 0.05)),
            "an aircraft turns too far within a step": ~(functools.reduce(jnp.maximum, turns) * env.dt <= 0.85),
        }

    def _faults_in_space(self, env: Environment, state: Any, name: str, commands: Any, extremes: Any) -> Faults:
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
                (self.drift * EQUAL >= 9.0) & (self.lag * EQUAL >= 1.0)
            ),
        }


def _acceleration(env: Environment, sim: Sim, name: str) -> Float[Array, " d"]:
    """v̇ of a platform, the agent's without control."""
    platform, state = env.platform(name), sim.platforms[name]
    controls = {} if name == env.agent else undirected(platform, sim)
    return jax.jvp(lambda state: state.velocity, (state,), (platform.derivative(state, controls),))[1]


def misalignment(state: Any) -> Float[Array, ""]:
    """Angle from the nearer end of the body's axis to the velocity, in [−π/2, π/2); 0 at rest."""
    course = jnp.arctan2(state.velocity[1], jnp.where(safe_norm(state.velocity) > 0.0, state.velocity[0], 1.0))
    return wrap(course - state.attitude, -jnp.pi / 2, jnp.pi)


def _safe_sqrt(x: Array) -> Array:
    positive = x > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


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
    return any(type(one).__module__ == __name__ and type(one) is not kind for one in rta.backups)


def _separates(env: Environment, limit: Any, platforms: set[str]) -> bool:
    """Whether a constraint is the separation of two platforms."""
    if type(limit) is not Separation:
        return False
    status = next(one for one in env.status if one.name == limit.distance)
    return type(status) is Distance and {status.of, status.to} == platforms


def _authority(env: Environment, name: str) -> Any:
    """The largest value of a control that is there in both directions; 0 without such an actuator."""
    actuators = {one.name: one for one in env.actuators}
    if name not in actuators:
        return jnp.zeros_like(env.dt)
    return jnp.maximum(jnp.minimum(-actuators[name].low, actuators[name].high), 0.0)
