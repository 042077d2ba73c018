"""Backup controllers and the sets in which they stay safe for ever."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.asif import linear, speed_ball
from jaxsafe.rta.filter import BackupController, CertifiedRTA, Faults, TerminalSet
from jaxsafe.rta.projection import project_box_ball
from jaxsafe.rta.proofs import (
    align_and_brake_faults,
    aligned_or_slow_faults,
    brake_faults,
    slow_faults,
    velocity_matched_faults,
)
from jaxsafe.rta.speed_limit import speed_limit_facts
from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.geometry import direction, safe_norm
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.simulation.trig import arctan, wrap
from jaxsafe.transition import Others, bounds, undirected
from jaxsafe.types import ConstraintName, Length, Number, PlatformName, Positive, Radians, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

Aircraft = Dubins2D | Dubins3D


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
        return brake_faults(env, sim, rta)


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

        margin = 2.0 * self.kept_margin(env)
        ball = speed_ball(env, sim, jnp.stack([jnp.zeros_like(turn), turn]), self.constraint, margin, free=1)
        hold, feasible = project_box_ball(jnp.zeros(1, turn.dtype), low[:1], high[:1], *ball)
        hold = jnp.where(feasible | (jnp.abs(error) <= self.steep), hold[0], 0.0)
        along = jnp.sum(state.velocity * direction(state.attitude))
        brake = -along * plant.mass / env.dt
        return jnp.stack([jnp.where(jnp.abs(error) <= self.aligned, brake, hold), turn])

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if rta.terminal is not None and type(rta.terminal) is not AlignedOrSlow:
            return {}
        return align_and_brake_faults(env, sim, rta, self)

    def duration(self, env: Environment) -> Number:
        """A reversal of the spin, and the turn out of the angles beyond 75°."""
        return 12.0 + jnp.zeros_like(env.dt)

    def kept_margin(self, env: Environment) -> Number:
        facts = speed_limit_facts(env, self.constraint)
        return self.margin if facts is None else jnp.maximum(self.margin, facts.least_margin)


class Slow(TerminalSet, type="slow"):
    """Hardly any speed: below a speed limit everywhere, and a brake that can stop within a few steps keeps it so."""

    speed: Annotated[Number, Unit("m/s"), Positive]

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        return safe_norm(sim.platforms[env.agent].velocity) <= self.speed

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        return slow_faults(env, rta, self, Brake)


class AlignedOrSlow(TerminalSet, type="aligned_or_slow"):
    """The thrust axis within `angle` of the velocity, so that braking has authority, or hardly any speed."""

    angle: Annotated[Radians, Positive]
    speed: Annotated[Number, Unit("m/s"), Positive]

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        state = sim.platforms[env.agent]
        return (jnp.abs(misalignment(state)) <= self.angle) | (safe_norm(state.velocity) <= self.speed)

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        return aligned_or_slow_faults(env, sim, rta, self, AlignAndBrake)


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
            return {"match_velocity keeps no separation by itself: give a horizon and a terminal set": jnp.ones((), bool)}
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
        return velocity_matched_faults(env, sim, rta, self, MatchVelocity)


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


def _authority(env: Environment, name: str) -> Any:
    """The largest value of a control that is there in both directions; 0 without such an actuator."""
    actuators = {one.name: one for one in env.actuators}
    if name not in actuators:
        return jnp.zeros_like(env.dt)
    return jnp.maximum(jnp.minimum(-actuators[name].low, actuators[name].high), 0.0)
