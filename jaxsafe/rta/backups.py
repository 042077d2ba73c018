"""Backup controllers and the sets in which they stay safe for ever."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.component import Range, Unit
from jaxsafe.rta.asif import linear, speed_ball
from jaxsafe.rta.filter import BackupController, TerminalSet
from jaxsafe.rta.prediction import Others, bounds, undirected
from jaxsafe.rta.projection import project_box_ball
from jaxsafe.simulation.geometry import direction, safe_norm
from jaxsafe.simulation.trig import arctan, wrap
from jaxsafe.types import ConstraintName, Length, Number, PlatformName, Positive, Radians, Sim


class Brake(BackupController, type="brake"):
    """Thrust that brings the velocity to 0 at the end of the step, or as near as the bounds allow (dead beat)."""

    def control(self, env: Any, sim: Sim, later: Others) -> Float[Array, " m"]:
        plant, names = env.agent_platform, env.action_names

        def velocity(u: Float[Array, " m"]) -> Array:
            return plant.step(sim.platforms[env.agent], dict(zip(names, u, strict=True)), env.dt).velocity

        drift, pushed = linear(velocity, jnp.zeros(len(names), env.dt.dtype))
        return -jnp.sum(pushed * drift, axis=-1) / jnp.max(jnp.sum(pushed * pushed, axis=-1))


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

    def control(self, env: Any, sim: Sim, later: Others) -> Float[Array, " 2"]:
        state = sim.platforms[env.agent]
        low, high = bounds(env)
        error = misalignment(state)
        ceiling = env.agent_platform.attitude_rate_limits[1]
        rate = jnp.sign(error) * jnp.minimum(ceiling, _safe_sqrt(1.6 * high[1] * jnp.abs(error)))
        turn = jnp.clip((rate - state.attitude_rate) / env.dt, low[1], high[1])

        ball = speed_ball(env, sim, jnp.stack([jnp.zeros_like(turn), turn]), self.constraint, 2.0 * self.margin, free=1)
        hold, feasible = project_box_ball(jnp.zeros(1, turn.dtype), low[:1], high[:1], *ball)
        hold = jnp.where(feasible | (jnp.abs(error) <= self.steep), hold[0], 0.0)
        along = jnp.sum(state.velocity * direction(state.attitude))
        brake = -along * env.agent_platform.mass / env.dt
        return jnp.stack([jnp.where(jnp.abs(error) <= self.aligned, brake, hold), turn])


class Slow(TerminalSet, type="slow"):
    """Hardly any speed: below a speed limit everywhere, and a brake that can stop within a few steps keeps it so."""

    speed: Annotated[Number, Unit("m/s"), Positive]

    def contains(self, env: Any, sim: Sim) -> Bool[Array, ""]:
        return safe_norm(sim.platforms[env.agent].velocity) <= self.speed


class AlignedOrSlow(TerminalSet, type="aligned_or_slow"):
    """The thrust axis within `angle` of the velocity, so that braking has authority, or hardly any speed."""

    angle: Annotated[Radians, Positive]
    speed: Annotated[Number, Unit("m/s"), Positive]

    def contains(self, env: Any, sim: Sim) -> Bool[Array, ""]:
        state = sim.platforms[env.agent]
        return (jnp.abs(misalignment(state)) <= self.angle) | (safe_norm(state.velocity) <= self.speed)


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

    def control(self, env: Any, sim: Sim, later: Others) -> Float[Array, " m"]:
        own, lead, ahead = sim.platforms[env.agent], sim.platforms[self.lead], later[self.lead]
        sign = 1.0 if self.turn == "left" else -1.0
        away = self._away(own.position - lead.position)
        level = jnp.sum(lead.velocity[:2] ** 2)
        faster = jnp.sum(away * lead.velocity) / lead.speed
        goal = ahead.heading if self.climb is None else lead.heading
        goal += (lead.velocity[0] * away[1] - lead.velocity[1] * away[0]) / level
        error = sign * wrap(sign * (goal - own.heading), -self.dead_zone, 2.0 * jnp.pi)
        speed = jnp.clip(ahead.speed + faster, *env.agent_platform.speed_limits)
        wanted = {"acceleration": (speed - own.speed) / env.dt}
        if self.climb is None:
            wanted["heading_rate"] = error / env.dt
        else:
            steeper = (faster * lead.velocity[2] / lead.speed - away[2]) / jnp.sqrt(level)
            turning = (ahead.heading - lead.heading) / env.dt
            wanted |= self._in_space(env, own, error, turning, ahead.flight_path_angle + steeper)
        return jnp.stack([wanted[name] for name in env.action_names])

    def _away(self, apart: Float[Array, " d"]) -> Float[Array, " d"]:
        distance = safe_norm(apart)
        return 0.1 * jnp.maximum(self.clearance - distance, 0.0) * apart / jnp.maximum(distance, 1.0)

    def _in_space(self, env: Any, own: Any, error: Array, turning: Array, angle: Array) -> dict[str, Array]:
        plant = env.agent_platform
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

    def contains(self, env: Any, sim: Sim) -> Bool[Array, ""]:
        one, other = sim.platforms[self.of], sim.platforms[self.to]
        accelerating = _acceleration(env, sim, self.of) - _acceleration(env, sim, self.to)
        relative = safe_norm(one.velocity - other.velocity) + self.lag * safe_norm(accelerating)
        apart = safe_norm(one.position - other.position)
        return (relative < self.tolerance) & (apart >= self.clearance + self.drift * relative)


def _acceleration(env: Any, sim: Sim, name: str) -> Float[Array, " d"]:
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
