"""Aircraft: Dubins models in the plane, Eq. (5), and in space, Eq. (9).

Lengths are in ft and speeds in ft/s. Controls are held over a step. A state that reaches its limit
rests there for the remainder of the step. Positions follow from that: exactly in the plane, and by
Gauss-Legendre quadrature of order 6 in space.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.geometry import direction, rotation, safe_norm
from jaxsafe.simulation.integrate import (
    NODES,
    PARTIAL_WEIGHTS,
    WEIGHTS,
    ramp,
    sine_ratios,
    through_pieces,
    time_to_limit,
)
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.trig import arctan, cos_acute, sin_cos, sin_cos_acute, tan_acute
from jaxsafe.types import Number, Record, Seconds

GRAVITY = 32.17
"""Acceleration of gravity g [ft/s²]."""

SPEED_LIMITS = (200.0, 400.0)
"""Lowest and highest speed of an aircraft [ft/s], Table 3."""

SpeedLimits = Annotated[
    Number, Unit("ft/s", length=2), Range(0.0, open_low=True, smallest=1e-3, largest=1e9)
]
AngleLimits = Annotated[
    Number,
    Unit("rad", length=2),
    Range(-jnp.pi / 2, jnp.pi / 2, open_low=True, open_high=True, largest=1.57),
]

Ramps = Sequence[tuple[Any, Any, Any]]
"""Value, rate and limits of each quantity that changes linearly over a step."""


class Dubins2DState(Record):
    """State of an aircraft that stays at one altitude."""

    position: Annotated[Float[Array, " 2"], Unit("ft")]  # x, y
    heading: Annotated[Float[Array, ""], Unit("rad")]  # ψ from x towards y, not wrapped
    speed: Annotated[Float[Array, ""], Unit("ft/s")]  # v

    @property
    def velocity(self) -> Float[Array, " 2"]:
        """Velocity v (cos ψ, sin ψ)."""
        return self.speed[..., None] * direction(self.heading)

    @property
    def orientation(self) -> Float[Array, "2 2"]:
        """Rotation from the body frame, whose x axis points forwards, to the global frame."""
        return rotation(self.heading)


class Dubins2D(Platform, type="dubins2d"):
    """An aircraft steered by `heading_rate` [rad/s] and `acceleration` [ft/s²], Eq. (5)."""

    dimension: Annotated[int, Range(2, 2)] = 2
    speed_limits: SpeedLimits = SPEED_LIMITS

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("heading_rate", "acceleration")

    def rest(self) -> Dubins2DState:
        zero = jnp.zeros((), jnp.result_type(float))
        return Dubins2DState(
            position=jnp.zeros(2, zero.dtype),
            heading=zero,
            speed=zero + self.speed_limits[0],
        )

    def step(self, state: Dubins2DState, controls: Controls, dt: Seconds) -> Dubins2DState:
        """Return the state after `dt` seconds.

        The solution is exact: one arc until the speed reaches its limit, and one at the limit.
        """
        if "acceleration" not in controls:
            return self.step_within_limits(state, controls, dt)
        turn = controls.get("heading_rate", 0.0)
        acceleration = controls["acceleration"]
        speed = ramp(state.speed, rate=0.0, limits=self.speed_limits, t=0.0)
        final_speed = ramp(speed, rate=acceleration, limits=self.speed_limits, t=dt)
        stop = time_to_limit(speed, rate=acceleration, limits=self.speed_limits, dt=dt)

        def fly(before: list[Any], begin: Number, length: Number) -> list[Any]:
            heading, speed, acceleration, *moved = before
            arc = _arc(heading=heading, speed=speed, turn=turn, acceleration=acceleration, t=length)
            moved = [total + part for total, part in zip(moved, arc, strict=True)]
            return [heading + turn * length, final_speed, still, *moved]

        still = jnp.zeros_like(speed)
        start = [state.heading, speed, still + acceleration, still, still]
        _, _, _, *moved = through_pieces(fly, start, [stop], dt)
        return Dubins2DState(
            position=moved_by(state.position, moved),
            heading=state.heading + turn * dt,
            speed=final_speed,
        )

    def step_within_limits(
        self, state: Dubins2DState, controls: Controls, dt: Seconds
    ) -> Dubins2DState:
        """Return the state after `dt` seconds, as `step` does, but with a single arc."""
        turn = controls.get("heading_rate", 0.0)
        acceleration = controls.get("acceleration", 0.0)
        speed = ramp(state.speed, rate=0.0, limits=self.speed_limits, t=0.0)
        moved = _arc(heading=state.heading, speed=speed, turn=turn, acceleration=acceleration, t=dt)
        final_speed = ramp(speed, rate=acceleration, limits=self.speed_limits, t=dt)
        return Dubins2DState(
            position=moved_by(state.position, moved),
            heading=state.heading + turn * dt,
            speed=final_speed,
        )

    def with_velocity(self, state: Dubins2DState, velocity: Float[Array, " 2"]) -> Dubins2DState:
        return state.replace(
            heading=state.heading + _turn(state.velocity, velocity),
            speed=jnp.clip(safe_norm(velocity), *self.speed_limits),
        )

    def derivative(self, state: Dubins2DState, controls: Controls) -> Dubins2DState:
        """Return the right-hand side of Eq. (5), which holds within the limits."""
        turn = _control(controls, "heading_rate", like=state.speed)
        acceleration = _control(controls, "acceleration", like=state.speed)
        return Dubins2DState(position=state.velocity, heading=turn, speed=acceleration)


class Dubins3DState(Record):
    """State of an aircraft in space, Eq. (9), with ż = −v sin γ."""

    position: Annotated[Float[Array, " 3"], Unit("ft")]  # x, y, z
    heading: Annotated[Float[Array, ""], Unit("rad")]  # ψ, not wrapped
    speed: Annotated[Float[Array, ""], Unit("ft/s")]  # v
    flight_path_angle: Annotated[Float[Array, ""], Unit("rad")]  # γ
    roll: Annotated[Float[Array, ""], Unit("rad")]  # φ

    @property
    def velocity(self) -> Float[Array, " 3"]:
        """Velocity v (cos ψ cos γ, sin ψ cos γ, −sin γ)."""
        forward = flight_direction(sin_cos(self.heading), sin_cos(self.flight_path_angle))
        return self.speed[..., None] * jnp.stack(forward, axis=-1)

    @property
    def orientation(self) -> Float[Array, "3 3"]:
        """Rotation from the body frame, whose x axis points forwards, to the global frame.

        Its ZYX Euler angles are ψ, γ and φ.
        """
        matrix = rotation(self.heading, self.flight_path_angle, self.roll)
        # Without the barrier XLA computes the sines again for each element of each vector that is
        # turned.
        return jax.lax.optimization_barrier(matrix)


class Dubins3D(Platform, type="dubins3d"):
    """An aircraft in space, Eq. (9).

    It is steered by `roll_rate`, `flight_path_angle_rate` [rad/s] and `acceleration` [ft/s²].
    Instead of a roll rate it may be given a `heading_rate` [rad/s]. Then it banks within the step
    to the angle φ of that coordinated turn, tan φ = ψ̇ v/g.
    """

    dimension: Annotated[int, Range(3, 3)] = 3
    speed_limits: SpeedLimits = SPEED_LIMITS
    flight_path_angle_limits: AngleLimits = (-jnp.pi / 9, jnp.pi / 9)
    roll_limits: AngleLimits = (-jnp.pi / 3, jnp.pi / 3)
    gravity: Annotated[
        Number, Unit("ft/s²"), Range(0.0, open_low=True, smallest=1e-6, largest=1e6)
    ] = GRAVITY

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("roll_rate", "flight_path_angle_rate", "acceleration", "heading_rate")

    def rest(self) -> Dubins3DState:
        zero = jnp.zeros((), jnp.result_type(float))
        return Dubins3DState(
            position=jnp.zeros(3, zero.dtype),
            heading=zero,
            speed=zero + self.speed_limits[0],
            flight_path_angle=zero,
            roll=zero,
        )

    def step(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Dubins3DState:
        """Return the state after `dt` seconds.

        Heading and position are quadratures over the pieces of the step in which no limit is
        reached. The error of the position is below 1e-3 ft for a step of 1 s, and mostly 1e-5 ft.
        """
        ramps = self._ramps(state, controls, dt)
        stops = [time_to_limit(*quantity, dt) for quantity in ramps if quantity[1] is not None]
        still = jnp.zeros_like(state.heading)
        start = (state.heading, still, still, still)
        # On a GPU unrolled pieces took half as long again with a million environments, and less
        # time with fewer environments.
        heading, *moved = through_pieces(functools.partial(self._fly, ramps), start, stops, dt)
        return self._arrived(state, ramps, dt, heading=heading, moved=moved)

    def step_within_limits(
        self, state: Dubins3DState, controls: Controls, dt: Seconds
    ) -> Dubins3DState:
        """Return the state after `dt` seconds, as `step` does, but from a single piece."""
        ramps = self._ramps(state, controls, dt)
        start = (state.heading, 0.0, 0.0, 0.0)
        heading, *moved = self._fly(ramps, start, jnp.zeros_like(dt), dt)
        return self._arrived(state, ramps, dt, heading=heading, moved=moved)

    def _limits(self) -> dict[str, Any]:
        """Return the limits of the state fields that have some, by name."""
        return {
            "speed": self.speed_limits,
            "flight_path_angle": self.flight_path_angle_limits,
            "roll": self.roll_limits,
        }

    def _ramps(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Ramps:
        """Return the ramps of roll, flight path angle and speed.

        A quantity that no control moves has the rate None.
        """
        ramps = [
            (state.roll, self._roll_rate(state, controls, dt), self.roll_limits),
            (
                state.flight_path_angle,
                controls.get("flight_path_angle_rate"),
                self.flight_path_angle_limits,
            ),
            (state.speed, controls.get("acceleration"), self.speed_limits),
        ]
        return [
            (ramp(x, rate=0.0, limits=limits, t=0.0), rate, limits) for x, rate, limits in ramps
        ]

    def _fly(
        self, ramps: Ramps, before: tuple[Any, ...], begin: Number, length: Number
    ) -> tuple[Any, ...]:
        """Return the heading and the displacement after one piece of the step.

        Args:
            ramps: roll, flight path angle and speed, as ramps from the beginning of the step.
            before: the heading, and the displacement along x, y and z, before the piece.
            begin: the beginning of the piece [s].
            length: the length of the piece [s].
        """
        heading, *moved = before
        nodes = [[ramp(*quantity, begin + node * length) for quantity in ramps] for node in NODES]
        turns = [self._turn_rate(sin_cos_acute(roll), speed) * length for roll, _, speed in nodes]
        for (_, gamma, speed), weight, partial in zip(nodes, WEIGHTS, PARTIAL_WEIGHTS, strict=True):
            forward = flight_direction(
                sin_cos(heading + weighted_sum(partial, turns)), sin_cos_acute(gamma)
            )
            moved = [
                total + weight * length * speed * part
                for total, part in zip(moved, forward, strict=True)
            ]
        return (heading + weighted_sum(WEIGHTS, turns), *moved)

    def _arrived(
        self,
        state: Dubins3DState,
        ramps: Ramps,
        dt: Seconds,
        heading: Array,
        moved: Sequence[Array],
    ) -> Dubins3DState:
        """Return the state after the step, given its heading and its displacement."""
        roll, gamma, speed = (ramp(*quantity, dt) for quantity in ramps)
        return Dubins3DState(
            position=moved_by(state.position, moved),
            heading=heading,
            speed=speed,
            flight_path_angle=gamma,
            roll=roll,
        )

    def with_velocity(self, state: Dubins3DState, velocity: Float[Array, " 3"]) -> Dubins3DState:
        climb = jnp.arctan2(-velocity[2], safe_norm(velocity[:2]))
        return state.replace(
            heading=state.heading + _turn(state.velocity, velocity),
            flight_path_angle=jnp.clip(climb, *self.flight_path_angle_limits),
            speed=jnp.clip(safe_norm(velocity), *self.speed_limits),
        )

    def derivative(self, state: Dubins3DState, controls: Controls) -> Dubins3DState:
        """Return the right-hand side of Eq. (9), which holds within the limits.

        If a `heading_rate` is given, the heading changes at this rate, and the bank stays as it is.
        """
        acceleration = _control(controls, "acceleration", like=state.speed)
        gamma_rate = _control(controls, "flight_path_angle_rate", like=state.speed)
        roll_rate = _control(controls, "roll_rate", like=state.speed)
        turn = controls.get("heading_rate", self._turn_rate(sin_cos(state.roll), state.speed))
        return Dubins3DState(
            position=state.velocity,
            heading=turn,
            speed=acceleration,
            flight_path_angle=gamma_rate,
            roll=roll_rate,
        )

    def held(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Controls:
        if "heading_rate" not in controls:
            return controls
        others = {name: value for name, value in controls.items() if name != "heading_rate"}
        return {**others, "roll_rate": self._roll_rate(state, controls, dt)}

    def bend(self, before: Dubins3DState, after: Dubins3DState, dt: Seconds) -> Float[Array, ""]:
        """Return how far the path may leave the straight line from `before` to `after`.

        The bound for any platform is enlarged, because the acceleration a across the velocity
        changes with the roll. However a gets from its first value to its last, the path leaves that
        of the mean acceleration by ‖Δa‖Δt²/54 at most.
        """
        across = [
            self.gravity * tan_acute(state.roll) * cos_acute(state.flight_path_angle)
            for state in (before, after)
        ]
        return super().bend(before, after, dt) + jnp.abs(across[1] - across[0]) * dt**2 / 54.0

    def _turn_rate(self, bank: tuple[Array, Array], speed: Array) -> Array:
        """Return the heading rate ψ̇ = g/v tan φ, given (sin φ, cos φ), with only one division."""
        return self.gravity * bank[0] / (speed * bank[1])

    def _roll_rate(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Any:
        """Return the roll rate, which follows from a `heading_rate` if one is given, or None."""
        if "heading_rate" not in controls:
            return controls.get("roll_rate")
        return (arctan(controls["heading_rate"] * state.speed / self.gravity) - state.roll) / dt


def _turn(before: Float[Array, " d"], after: Float[Array, " d"]) -> Float[Array, ""]:
    """Return the angle from one velocity to another in the horizontal plane [rad]."""
    across = before[0] * after[1] - before[1] * after[0]
    along = before[0] * after[0] + before[1] * after[1]
    return jnp.arctan2(across, along)


def _control(controls: Controls, name: str, like: Array) -> Array:
    return jnp.asarray(controls.get(name, 0.0), like.dtype)


def flight_direction(
    heading: tuple[Array, Array], gamma: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Return the direction of flight (cos ψ cos γ, sin ψ cos γ, −sin γ).

    Args:
        heading: (sin ψ, cos ψ).
        gamma: (sin γ, cos γ) of the flight path angle.
    """
    sin_heading, cos_heading = heading
    sin_gamma, cos_gamma = gamma
    return cos_heading * cos_gamma, sin_heading * cos_gamma, -sin_gamma


def moved_by(position: Float[Array, " d"], moved: Sequence[Array]) -> Float[Array, " d"]:
    """Return a position after a displacement along each axis.

    It is a stack of sums, because XLA computes the sum with a stack one number at a time.
    """
    return jnp.stack([x + part for x, part in zip(position, moved, strict=True)])


def weighted_sum(weights: Sequence[float], values: Sequence[Array]) -> Any:
    """Return the sum of some values, each times its weight."""
    return sum(weight * value for weight, value in zip(weights, values, strict=True))


def _arc(heading: Any, speed: Any, turn: Any, acceleration: Any, t: Any) -> tuple[Any, Any]:
    """Return the displacement ∫₀ᵗ (v + aτ) (cos(ψ + ωτ), sin(ψ + ωτ)) dτ along x and y.

    It is computed along and across the heading at half time. With h = ωt/2 the part along it is
    t (v + at/2) sin h/h, and the part across it is a t² (sin h/h − cos h)/(2h).

    Args:
        heading: ψ at the beginning [rad].
        speed: v at the beginning [ft/s].
        turn: heading rate ω [rad/s].
        acceleration: a [ft/s²].
        t: time [s].
    """
    half = turn * t / 2.0
    s1, c2, s3 = sine_ratios(half)
    along = t * (speed + acceleration * t / 2.0) * s1
    across = acceleration * t * t * half * (c2 - s3) / 2.0
    sine, cosine = sin_cos(heading + half)
    return along * cosine - across * sine, along * sine + across * cosine
