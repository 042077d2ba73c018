"""Backup controllers and the sets in which they stay safe for ever."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.rta.asif import linear, speed_ball
from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.certificate import BackupController, Faults, TerminalSet
from jaxsafe.rta.certified import CertifiedRTA
from jaxsafe.rta.formation import in_formation
from jaxsafe.rta.projection import project_box_ball
from jaxsafe.rta.proofs import (
    Aircraft,
    align_and_brake_faults,
    aligned_or_slow_faults,
    at_rest_faults,
    brake_faults,
    coast_faults,
    slow_faults,
    velocity_matched_faults,
)
from jaxsafe.rta.speed_limit import distance_and_speed, speed_limit_facts
from jaxsafe.rta.tube import Tube, after_step, largest_turn, measured
from jaxsafe.rta.tube_in_space import (
    TURN_GAIN,
    Pursuit,
    TubeInSpace,
    first_in_space,
    next_in_space,
    wrong_course,
)
from jaxsafe.schema.component import Range, Unit, fields
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.geometry import direction, dot, safe_norm
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.simulation.trig import arctan, wrap
from jaxsafe.transition import Others, bounds, undirected
from jaxsafe.types import ConstraintName, Length, Number, PlatformName, Positive, Radians, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

SLOW_SHARE = 0.7
"""Share of the speed limit up to which any angle of the thrust axis leaves time to turn."""

LOST = 1e6
"""Radius [ft] of a tube that nothing is known about."""

ROUNDING = 1e-4
"""Error [rad] of headings in single precision, with a large reserve."""


class Brake(BackupController, type="brake"):
    """Thrust that brings the velocity to 0 at the end of the step (dead beat).

    Where the bounds do not allow that, the thrust brings it as near to 0 as they do.
    """

    knows_bound: ClassVar[bool] = True

    def control(self, env: Environment, sim: Sim, later: Others) -> Float[Array, " m"]:
        plant = env.agent_platform
        names = env.action_names

        def velocity_after(u: Float[Array, " m"]) -> Array:
            controls = dict(zip(names, u, strict=True))
            return plant.step(sim.platforms[env.agent], controls, env.dt).velocity

        drift, gain = linear(velocity_after, jnp.zeros(len(names), env.dt.dtype))
        return -jnp.sum(gain * drift[None], axis=-1) / jnp.max(jnp.sum(gain * gain, axis=-1))

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if rta.terminal is not None and type(rta.terminal) is not Slow:
            return {}  # the proof is then that of the other terminal set
        return brake_faults(env, sim, rta)


class Coast(BackupController, type="coast"):
    """No control at all. It keeps limits of what the agent's controls may add up to."""

    def control(self, env: Environment, sim: Sim, later: Others) -> Float[Array, " m"]:
        return jnp.zeros(env.action_size, env.dt.dtype)

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        return coast_faults(env, rta) if rta.terminal is None else {}


class AlignAndBrake(BackupController, type="align_and_brake"):
    """A turn of the thrust axis along the velocity, then braking, for an oriented spacecraft.

    Let e be the angle from the nearer end of the body axis to the velocity, and α the bound of the
    wheel. The attitude follows the rate sign(e) √(1.6 α abs(e)).

    While abs(e) > `aligned` the thrust is the smallest that keeps the speed limit with twice the
    `margin`. That holds the boundary while the spacecraft turns. Where no thrust keeps the limit,
    it brakes as well as the bounds allow, but not while abs(e) > `steep`. Thrust so far across the
    velocity would turn the velocity away as fast as the body follows.

    Once abs(e) is at most `aligned`, the thrust nulls the velocity along the body.
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

        margin = 2.0 * self.least_kept(env)
        beta, p, k = speed_ball(
            env,
            sim,
            control=jnp.stack([jnp.zeros_like(turn), turn]),
            name=self.constraint,
            margin=margin,
            free=1,
        )
        hold, feasible = project_box_ball(
            u=jnp.zeros(1, turn.dtype), low=low[:1], high=high[:1], beta=beta, p=p, k=k
        )
        hold = jnp.where(feasible | (jnp.abs(error) <= self.steep), hold[0], 0.0)
        along = dot(state.velocity, direction(state.attitude))
        brake = -along * plant.mass / env.dt
        return jnp.stack([jnp.where(jnp.abs(error) <= self.aligned, brake, hold), turn])

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if rta.terminal is not None and type(rta.terminal) is not AlignedOrSlow:
            return {}  # the proof is then that of the other terminal set
        return align_and_brake_faults(env, sim, rta, backup=self)

    def duration(self, env: Environment) -> Number:
        """Return 12 s: a reversal of the spin and the turn out of the angles beyond 75°."""
        return 12.0 + jnp.zeros_like(env.dt)

    def keeps_from(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        """Return whether Proposition 8 holds from a state.

        h must be at least what the controller holds. The axis must be within `steep` of the
        velocity, or the speed well below the limit.
        """
        facts = speed_limit_facts(env, self.constraint)
        if facts is None:
            return jnp.zeros((), bool)
        distance, speed = distance_and_speed(env, sim)
        limit = facts.limit(distance)
        aligned = jnp.abs(misalignment(sim.platforms[env.agent])) <= self.steep
        return (speed <= limit - 2.0 * self.least_kept(env)) & (
            aligned | (speed <= SLOW_SHARE * limit)
        )

    def least_kept(self, env: Environment) -> Number:
        """Return `margin`, or more if the speed limit needs more near the chief [m/s]."""
        facts = speed_limit_facts(env, self.constraint)
        return self.margin if facts is None else jnp.maximum(self.margin, facts.least_margin)


class Slow(TerminalSet, type="slow"):
    """States with hardly any speed.

    They are below a speed limit everywhere. A brake that can stop within a few steps keeps them so.
    """

    speed: Annotated[Number, Unit("m/s"), Positive]

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        return safe_norm(sim.platforms[env.agent].velocity) <= self.speed

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        return slow_faults(env, rta, terminal=self, keeper=Brake)


class AtRest(TerminalSet, type="at_rest"):
    """States of a spacecraft that hardly moves.

    `brake` keeps it where it is. So whatever depends on position and velocity alone stays as it is.
    """

    speed: Annotated[Number, Unit("m/s"), Positive] = 1e-4

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        return safe_norm(sim.platforms[env.agent].velocity) <= self.speed

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        return at_rest_faults(env, sim, rta, keeper=Brake)


class AlignedOrSlow(TerminalSet, type="aligned_or_slow"):
    """States with the thrust axis within `angle` of the velocity, or with hardly any speed.

    Within the angle braking has authority.
    """

    angle: Annotated[Radians, Positive]
    speed: Annotated[Number, Unit("m/s"), Positive]

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        state = sim.platforms[env.agent]
        return (jnp.abs(misalignment(state)) <= self.angle) | (
            safe_norm(state.velocity) <= self.speed
        )

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        return aligned_or_slow_faults(env, sim, rta, terminal=self, keeper=AlignAndBrake)


class MatchVelocity(BackupController, type="match_velocity"):
    """A turn to one side, up to the lead's heading, at the lead's speed.

    Afterwards the relative position stays as it is.

    In the plane it takes the heading and the speed that the lead will have after the step. In space
    it banks by tan φ = v ω/g for the turn ω = 0.25 e + ψ̇_lead, where e is the present heading
    error. It climbs or dives at the steepest angle while abs(e) is above 0.45 rad, less steeply
    down to 0.15 rad, and then flies the lead's angle.

    Far from the origin, rounding moves two aircraft of equal velocity closer or apart by 0.01 ft a
    step. So where the agent is closer than `clearance`, it takes the lead's velocity plus
    w = (`clearance` − ‖r‖) r/‖r‖ / `away_time`, to first order. That time is in whole seconds.
    """

    lead: PlatformName
    clearance: Annotated[Length, Range(0.0)]
    turn: Literal["left", "right"]
    climb: Literal["up", "down"] | None = None  # None in the plane
    dead_zone: Annotated[Radians, Range(0.0)] = 0.2
    away_time: Annotated[int, Range(1, largest=1000)] = 10
    within_limits: ClassVar[bool] = True

    def control(self, env: Environment, sim: Sim, later: Others) -> Float[Array, " m"]:
        own = sim.platforms[env.agent]
        lead = sim.platforms[self.lead]
        lead_after = later[self.lead]
        plant = cast(Aircraft, env.agent_platform)
        away, faster, level_squared, error = self._aim(own, lead, lead_after)
        speed = jnp.clip(lead_after.speed + faster, plant.speed_limits[0], plant.speed_limits[1])
        controls = {"acceleration": (speed - own.speed) / env.dt}
        if self.climb is None:
            controls["heading_rate"] = error / env.dt
        else:
            steeper = (faster * lead.velocity[2] / lead.speed - away[2]) / jnp.sqrt(level_squared)
            lead_turn = (lead_after.heading - lead.heading) / env.dt
            angle = lead_after.flight_path_angle + steeper
            controls |= self._in_space(env, own, error=error, lead_turn=lead_turn, angle=angle)
        return jnp.stack([controls[name] for name in env.action_names])

    def _aim(self, own: Any, lead: Any, lead_after: Any) -> tuple[Array, Array, Array, Array]:
        """Return what the controller aims at.

        The four values are w [ft/s], its part along the lead's velocity [ft/s], the square of the
        lead's horizontal speed [ft²/s²], and the heading error [rad].
        """
        away = self._away(own.position - lead.position)
        level_squared = dot(lead.velocity[:2], lead.velocity[:2])
        faster = dot(away, lead.velocity) / lead.speed
        goal = lead_after.heading if self.climb is None else lead.heading
        goal += (lead.velocity[0] * away[1] - lead.velocity[1] * away[0]) / level_squared
        error = self._sign * wrap(self._sign * (goal - own.heading), -self.dead_zone, 2.0 * jnp.pi)
        return away, faster, level_squared, error

    def duration(self, env: Environment) -> Number:
        """Return the time [s] of a full turn and, in space, of the roll that begins it."""
        if self.climb is None:
            return (2.0 * jnp.pi - self.dead_zone) / _authority(env, "heading_rate") + 2.0 * env.dt
        plant = cast(Dubins3D, env.agent_platform)
        bank = jnp.minimum(-plant.roll_limits[0], plant.roll_limits[1])
        turn = 2.0 * jnp.pi * plant.speed_limits[1] / (plant.gravity * jnp.tan(bank))
        return turn + bank / _authority(env, "roll_rate")

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if rta.terminal is None:
            fault = (
                "match_velocity keeps no separation by itself: give a horizon and a terminal set"
            )
            return {fault: jnp.ones((), bool)}
        return {}

    @property
    def has_tubes(self) -> bool:
        return True

    def first_tube(
        self, env: Environment, before: Sim, after: Sim, bound: UncertaintyBound
    ) -> Tube:
        own = before.platforms[env.agent]
        moved = after.platforms[env.agent]
        if self.climb is not None:
            return first_in_space(env, bound, before=own, after=moved)
        tube = measured(bound, own)
        return after_step(env, bound, tube=tube, before=own, after=moved)

    def next_tube(
        self, env: Environment, before: Sim, after: Sim, bound: UncertaintyBound, tube: Tube
    ) -> Tube:
        own = before.platforms[env.agent]
        lead = before.platforms[self.lead]
        moved = after.platforms[env.agent]
        asked = dict(zip(env.action_names, self.control(env, before, after.platforms), strict=True))

        # How far the velocities that the true and the predicted control aim at may be apart.
        reach = tube.position + bound.position
        distance = safe_norm(own.position - lead.position)
        too_close = jnp.maximum(self.clearance - (distance - reach), 0.0)
        apart = self.away_gain * jnp.minimum(reach, 2.0 * too_close)
        if self.climb is not None:
            tube = cast(TubeInSpace, tube)
            plant = cast(Dubins3D, env.agent_platform)
            # Where the agent is closer than half the clearance, w turns faster than it grows.
            apart *= jnp.maximum(too_close / jnp.maximum(distance - reach, 1.0), 1.0)
            *_, error = self._aim(own, lead, after.platforms[self.lead])
            pursuit = Pursuit(
                error=error,
                apart=apart,
                lead_level_speed=safe_norm(lead.velocity[:2]),
                spare_acceleration=_spare(env, asked, "acceleration"),
                spare_climb=_spare(env, asked, "flight_path_angle_rate"),
                climb_by_error=jnp.zeros_like(error),
            )
            wrong_heading = wrong_course(plant, bound, tube, own, pursuit)
            largest = tube.heading + wrong_heading
            share = _climb_share(jnp.abs(error))
            changes = [
                _climb_share(jnp.abs(error) + largest) - share,
                share - _climb_share(jnp.maximum(jnp.abs(error) - largest, 0.0)),
            ]
            lowest, highest = plant.flight_path_angle_limits
            to_steep = jnp.abs(self._steepest(plant) - lead.flight_path_angle)
            to_steep += self.away_gain * too_close / lead.speed
            by_error = jnp.minimum(to_steep, highest - lowest) * jnp.maximum(*changes)
            pursuit = pursuit.replace(climb_by_error=by_error)
            wider: Tube = next_in_space(
                env, bound, tube=tube, before=own, after=moved, pursuit=pursuit
            )
            to_turn = self._sign * error + self.dead_zone
        else:
            plant = cast(Dubins2D, env.agent_platform)
            slowest = plant.speed_limits[0] - bound.process * env.dt
            own_speed = jnp.maximum(own.speed - tube.speed, slowest)
            wrong_heading = largest_turn(bound.velocity, own_speed) + apart / lead.speed
            kept = tube.replace(
                heading=jnp.maximum(
                    tube.heading - _spare(env, asked, "heading_rate"), wrong_heading
                ),
                speed=jnp.maximum(
                    tube.speed - _spare(env, asked, "acceleration"), bound.velocity + apart
                ),
            )
            wider = after_step(env, bound, tube=tube, before=own, after=moved, kept=kept)
            to_turn = self._sign * asked["heading_rate"] * env.dt + self.dead_zone

        # Nothing is known where only one of the true and the predicted way may turn the long way
        # round.
        doubt = tube.heading + wrong_heading + ROUNDING
        same_way = (to_turn >= doubt) & (to_turn + doubt < 2.0 * jnp.pi)
        return wider.replace(position=jnp.where(same_way, wider.position, LOST))

    def merged(
        self, others: Sequence[BackupController], index: Int[Array, ""]
    ) -> BackupController | None:
        sides = [other for other in others if type(other) is MatchVelocity]
        alike = [side.replace(name="", turn=self.turn, climb=self.climb) for side in sides]
        in_space = {side.climb is not None for side in sides}
        structures = {jax.tree.structure(side) for side in alike}
        if len(sides) < len(others) or len(in_space) > 1 or len(structures) > 1:
            return None
        chosen = jax.tree.map(lambda *numbers: jnp.stack(numbers)[index], *alike)
        numbers = {name: getattr(chosen, name) for name in fields(MatchVelocity)}
        left = jnp.array([side.turn == "left" for side in sides])[index]
        up = jnp.array([side.climb == "up" for side in sides])[index]
        return EitherWay(**numbers, left=left, up=up)

    @property
    def away_gain(self) -> float:
        """Speed away from the lead per foot that the agent is too close [1/s]."""
        return 1.0 / self.away_time

    @property
    def _sign(self) -> Number:
        return 1.0 if self.turn == "left" else -1.0

    def _steepest(self, plant: Dubins3D) -> Number:
        """Return the flight path angle [rad] of the climb or dive."""
        lowest, highest = plant.flight_path_angle_limits
        return lowest if self.climb == "up" else highest  # ż = −v sin γ

    def _away(self, apart: Float[Array, " d"]) -> Float[Array, " d"]:
        """Return w, the velocity away from the lead where the agent is too close."""
        distance = safe_norm(apart)
        missing = jnp.maximum(self.clearance - distance, 0.0)
        return self.away_gain * missing * apart / jnp.maximum(distance, 1.0)

    def _in_space(
        self, env: Environment, own: Any, error: Array, lead_turn: Array, angle: Array
    ) -> dict[str, Array]:
        """Return the controls of roll and climb in space.

        Args:
            env: the environment.
            own: the agent's state.
            error: the heading error e [rad].
            lead_turn: the lead's heading rate ψ̇_lead [rad/s].
            angle: the flight path angle to fly once the error is small [rad].
        """
        plant = cast(Dubins3D, env.agent_platform)
        bank = arctan(own.speed * (TURN_GAIN * error + lead_turn) / plant.gravity)
        bank = jnp.clip(bank, plant.roll_limits[0], plant.roll_limits[1])
        lowest, highest = plant.flight_path_angle_limits
        steep = self._steepest(plant)
        level = jnp.clip(angle, lowest, highest)
        share = _climb_share(jnp.abs(error))
        gamma = level + share * (steep - level)
        return {
            "roll_rate": (bank - own.roll) / env.dt,
            "flight_path_angle_rate": (gamma - own.flight_path_angle) / env.dt,
        }


class EitherWay(MatchVelocity):
    """A `match_velocity` whose turn and climb are numbers, so that they may differ in a batch."""

    left: Bool[Array, ""]
    up: Bool[Array, ""]

    @property
    def _sign(self) -> Number:
        return jnp.where(self.left, 1.0, -1.0)

    def _steepest(self, plant: Dubins3D) -> Number:
        lowest, highest = plant.flight_path_angle_limits
        return jnp.where(self.up, lowest, highest)


class VelocityMatched(TerminalSet, type="velocity_matched"):
    """States in which two aircraft have nearly the same velocity and are far enough apart.

    The relative speed is below `tolerance`. After `drift` seconds at that speed the aircraft are
    still at least `clearance` apart. In space, where the turn follows from the state, `lag` seconds
    of the relative acceleration count as relative speed.
    """

    of: PlatformName
    to: PlatformName
    tolerance: Annotated[Number, Unit("ft/s"), Positive]
    clearance: Annotated[Length, Positive]
    drift: Annotated[Number, Unit("s"), Range(0.0)] = 1.0
    lag: Annotated[Number, Unit("s"), Range(0.0)] = 0.0
    knows_bound: ClassVar[bool] = True

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        of = sim.platforms[self.of]
        to = sim.platforms[self.to]
        acceleration = _acceleration(env, sim, self.of) - _acceleration(env, sim, self.to)
        speed = safe_norm(of.velocity - to.velocity) + self.lag * safe_norm(acceleration)
        distance = safe_norm(of.position - to.position)
        return (speed < self._tolerance(env)) & (distance >= self.clearance + self.drift * speed)

    def contains_tube(self, env: Environment, sim: Sim, tube: Tube) -> Bool[Array, ""]:
        of = sim.platforms[self.of]
        to = sim.platforms[self.to]
        if isinstance(tube, TubeInSpace):
            plant = cast(Dubins3D, env.agent_platform)
            own, lead = (of, to) if self.of == env.agent else (to, of)
            matched = in_formation(
                own, lead, plant.gravity, plant.speed_limits[0], tube, tolerance=self.tolerance
            )
            return matched & (
                safe_norm(of.position - to.position) - tube.position >= self.clearance
            )
        speed = safe_norm(of.velocity - to.velocity)
        speed += tube.velocity(sim.platforms[env.agent].speed)
        distance = safe_norm(of.position - to.position) - tube.position
        return (speed < self.tolerance) & (distance >= self.clearance + self.drift * speed)

    def _tolerance(self, env: Environment) -> Number:
        """Return `tolerance`, or less if in space the proof or the actuators allow only less.

        The bounds are those of Proposition 7 in docs/safety/proofs.md.
        """
        plant = env.agent_platform
        if type(plant) is not Dubins3D:
            return self.tolerance
        slowest = plant.speed_limits[0]
        dt = env.dt
        allowed = [
            0.02 * slowest,
            0.13 * plant.gravity,
            _authority(env, "acceleration") * dt,
            0.98 * _authority(env, "flight_path_angle_rate") * dt * slowest,
            _authority(env, "roll_rate") * dt * plant.gravity / 1.07,
        ]
        return functools.reduce(jnp.minimum, allowed, self.tolerance)

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        return velocity_matched_faults(env, sim, rta, terminal=self, keeper=MatchVelocity)


def _acceleration(env: Environment, sim: Sim, name: str) -> Float[Array, " d"]:
    """Return the acceleration v̇ of a platform. That of the agent is without control."""
    platform = env.platform(name)
    state = sim.platforms[name]
    controls = {} if name == env.agent else undirected(platform, sim)
    derivative = platform.derivative(state, controls)
    return jax.jvp(lambda state: state.velocity, (state,), (derivative,))[1]


def _spare(env: Environment, asked: Mapping[str, Number], name: str) -> Any:
    """Return by how much a control could be changed both ways within its bounds, times the step.

    Args:
        env: the environment.
        asked: the controls by name, before they are clipped.
        name: the name of the control.
    """
    actuator = next(actuator for actuator in env.actuators if actuator.name == name)
    spare = jnp.minimum(asked[name] - actuator.low, actuator.high - asked[name])
    return env.dt * jnp.maximum(spare, 0.0)


def _climb_share(error: Array) -> Any:
    """Return the share of the steepest climb that is flown at a size of the heading error."""
    return jnp.clip((error - 0.15) / 0.3, 0.0, 1.0)


def misalignment(state: Any) -> Float[Array, ""]:
    """Return the angle from the nearer end of the body's axis to the velocity, in [−π/2, π/2).

    It is 0 at rest.
    """
    course = jnp.arctan2(
        state.velocity[1], jnp.where(safe_norm(state.velocity) > 0.0, state.velocity[0], 1.0)
    )
    return wrap(course - state.attitude, -jnp.pi / 2, jnp.pi)


def _safe_sqrt(x: Array) -> Array:
    positive = x > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _authority(env: Environment, name: str) -> Any:
    """Return the largest value that a control can take in both directions.

    It is 0 without such an actuator.
    """
    actuators = {actuator.name: actuator for actuator in env.actuators}
    if name not in actuators:
        return jnp.zeros_like(env.dt)
    return jnp.maximum(jnp.minimum(-actuators[name].low, actuators[name].high), 0.0)
