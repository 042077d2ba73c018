"""Aircraft: Dubins models in the plane, Eq. (5), and in space, Eq. (9). Lengths in ft, speeds in ft/s.

Controls are held over a step. A state that reaches its limit rests there for the remainder of the step, and positions
follow from that: exactly in the plane, by Gauss-Legendre quadrature of order 6 in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.geometry import direction, rotation
from jaxsafe.simulation.integrate import (
    NODES,
    PARTIAL_WEIGHTS,
    WEIGHTS,
    pieces,
    ramp,
    sine_ratios,
    time_to_limit,
)
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.trig import arctan, sin_cos, sin_cos_acute
from jaxsafe.types import Number, Record, Seconds

GRAVITY = 32.17
"""Acceleration of gravity g [ft/s²]."""

SPEEDS = (200.0, 400.0)
"""Slowest and fastest flight [ft/s], Table 3."""

SpeedLimits = Annotated[Number, Unit("ft/s", length=2), Range(0.0, open_low=True, smallest=1e-3, largest=1e9)]
AngleLimits = Annotated[
    Number, Unit("rad", length=2), Range(-jnp.pi / 2, jnp.pi / 2, open_low=True, open_high=True, largest=1.57)
]

Ramps = Sequence[tuple[Any, Any, Any]]
"""Value, rate and limits of what changes linearly over a step."""


class Dubins2DState(Record):
    """State of an aircraft at one altitude."""

    position: Annotated[Float[Array, " 2"], Unit("ft")]  # x, y
    heading: Annotated[Float[Array, ""], Unit("rad")]  # ψ from x towards y, not wrapped
    speed: Annotated[Float[Array, ""], Unit("ft/s")]  # v

    @property
    def velocity(self) -> Float[Array, " 2"]:
        """Velocity v (cos ψ, sin ψ)."""
        return self.speed[..., None] * direction(self.heading)

    @property
    def orientation(self) -> Float[Array, "2 2"]:
        """Rotation from the body frame, x forwards, to the global one."""
        return rotation(self.heading)


class Dubins2D(Platform, type="dubins2d"):
    """An aircraft steered by `heading_rate` [rad/s] and `acceleration` [ft/s²], Eq. (5)."""

    dimension: Annotated[int, Range(2, 2)] = 2
    speed_limits: SpeedLimits = SPEEDS

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("heading_rate", "acceleration")

    def rest(self) -> Dubins2DState:
        zero = jnp.zeros((), jnp.result_type(float))
        return Dubins2DState(jnp.zeros(2, zero.dtype), zero, zero + self.speed_limits[0])

    def step(self, state: Dubins2DState, controls: Controls, dt: Seconds) -> Dubins2DState:
        """Advance by the exact solution."""
        if "acceleration" not in controls:
            return self.step_within_limits(state, controls, dt)
        turn, acceleration = controls.get("heading_rate", 0.0), controls["acceleration"]
        speed = ramp(state.speed, 0.0, self.speed_limits, 0.0)
        final = ramp(speed, acceleration, self.speed_limits, dt)
        stop = time_to_limit(speed, acceleration, self.speed_limits, dt)
        moved = _arc(state.heading, speed, turn, acceleration, stop)
        moved = moved + _arc(state.heading + turn * stop, final, turn, 0.0, dt - stop)
        return Dubins2DState(state.position + moved, state.heading + turn * dt, final)

    def step_within_limits(self, state: Dubins2DState, controls: Controls, dt: Seconds) -> Dubins2DState:
        """`step` in one arc."""
        turn, acceleration = controls.get("heading_rate", 0.0), controls.get("acceleration", 0.0)
        speed = ramp(state.speed, 0.0, self.speed_limits, 0.0)
        moved = _arc(state.heading, speed, turn, acceleration, dt)
        final = ramp(speed, acceleration, self.speed_limits, dt)
        return Dubins2DState(state.position + moved, state.heading + turn * dt, final)

    def derivative(self, state: Dubins2DState, controls: Controls) -> Dubins2DState:
        """Eq. (5) within the limits."""
        turn, acceleration = (_number(controls, name, state.speed) for name in ("heading_rate", "acceleration"))
        return Dubins2DState(state.velocity, turn, acceleration)


class Dubins3DState(Record):
    """State of an aircraft in space, Eq. (9); ż = −v sin γ."""

    position: Annotated[Float[Array, " 3"], Unit("ft")]  # x, y, z
    heading: Annotated[Float[Array, ""], Unit("rad")]  # ψ, not wrapped
    speed: Annotated[Float[Array, ""], Unit("ft/s")]  # v
    flight_path_angle: Annotated[Float[Array, ""], Unit("rad")]  # γ
    roll: Annotated[Float[Array, ""], Unit("rad")]  # φ

    @property
    def velocity(self) -> Float[Array, " 3"]:
        """Velocity v (cos ψ cos γ, sin ψ cos γ, −sin γ)."""
        return self.speed[..., None] * jnp.stack(_forward(sin_cos(self.heading), sin_cos(self.flight_path_angle)), axis=-1)

    @property
    def orientation(self) -> Float[Array, "3 3"]:
        """Rotation from the body frame, x forwards, to the global one: ZYX Euler angles ψ, γ, φ."""
        matrix = rotation(self.heading, self.flight_path_angle, self.roll)
        return jax.lax.optimization_barrier(matrix)  # else XLA computes its sines again for each element of each vector


class Dubins3D(Platform, type="dubins3d"):
    """An aircraft steered by `roll_rate`, `flight_path_angle_rate` [rad/s] and `acceleration` [ft/s²], Eq. (9).

    Instead of a roll rate it takes a `heading_rate` [rad/s]: then it banks within the step to the angle φ of that
    coordinated turn, tan φ = ψ̇ v/g.
    """

    dimension: Annotated[int, Range(3, 3)] = 3
    speed_limits: SpeedLimits = SPEEDS
    flight_path_angle_limits: AngleLimits = (-jnp.pi / 9, jnp.pi / 9)
    roll_limits: AngleLimits = (-jnp.pi / 3, jnp.pi / 3)
    gravity: Annotated[Number, Unit("ft/s²"), Range(0.0, open_low=True, smallest=1e-6, largest=1e6)] = GRAVITY

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("roll_rate", "flight_path_angle_rate", "acceleration", "heading_rate")

    def rest(self) -> Dubins3DState:
        zero = jnp.zeros((), jnp.result_type(float))
        return Dubins3DState(jnp.zeros(3, zero.dtype), zero, zero + self.speed_limits[0], zero, zero)

    def step(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Dubins3DState:
        """Advance by quadrature over the pieces between which no limit is reached, within 1e-3 ft in 1 s, mostly 1e-5."""
        ramps = self._ramps(state, controls, dt)
        spans = pieces([time_to_limit(*each, dt) for each in ramps if each[1] is not None], dt)

        # A loop, not four copies: it keeps what it computed for one piece, where XLA would compute it again for each use.
        # On a GPU four copies took half as long again with a million environments, and less time with fewer.
        still = jnp.zeros_like(state.heading)
        start = (state.heading, still, still, still)
        (heading, *moved), _ = jax.lax.scan(lambda carry, span: (self._fly(ramps, carry, span), None), start, spans)
        return self._arrived(state, ramps, dt, heading, moved)

    def step_within_limits(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Dubins3DState:
        """`step` in one piece."""
        ramps = self._ramps(state, controls, dt)
        heading, *moved = self._fly(ramps, (state.heading, 0.0, 0.0, 0.0), (jnp.zeros_like(dt), dt))
        return self._arrived(state, ramps, dt, heading, moved)

    def _ramps(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Ramps:
        """Those of roll, flight path angle and speed; the rate of what no control moves is None."""
        ramps = [
            (state.roll, self._roll_rate(state, controls, dt), self.roll_limits),
            (state.flight_path_angle, controls.get("flight_path_angle_rate"), self.flight_path_angle_limits),
            (state.speed, controls.get("acceleration"), self.speed_limits),
        ]
        return [(ramp(x, 0.0, limits, 0.0), rate, limits) for x, rate, limits in ramps]

    def _fly(self, ramps: Ramps, before: tuple[Any, ...], span: tuple[Array, Array]) -> tuple[Any, ...]:
        """Heading and way moved after a piece of the step, of which begin and length are given, from those before it."""
        (heading, *moved), (begin, length) = before, span
        nodes = [[ramp(*each, begin + node * length) for each in ramps] for node in NODES]
        turns = [self._turn(sin_cos_acute(roll), speed) * length for roll, _, speed in nodes]
        for (_, gamma, speed), weight, partial in zip(nodes, WEIGHTS, PARTIAL_WEIGHTS, strict=True):
            forward = _forward(sin_cos(heading + _dot(partial, turns)), sin_cos_acute(gamma))
            moved = [total + weight * length * speed * part for total, part in zip(moved, forward, strict=True)]
        return (heading + _dot(WEIGHTS, turns), *moved)

    def _arrived(
        self, state: Dubins3DState, ramps: Ramps, dt: Seconds, heading: Array, moved: Sequence[Array]
    ) -> Dubins3DState:
        roll, gamma, speed = (ramp(*each, dt) for each in ramps)
        return Dubins3DState(state.position + jnp.stack(moved), heading, speed, gamma, roll)

    def derivative(self, state: Dubins3DState, controls: Controls) -> Dubins3DState:
        """Eq. (9) within the limits; a commanded heading rate is that of the turn, the bank staying as it is."""
        names = ("acceleration", "flight_path_angle_rate", "roll_rate")
        acceleration, gamma, roll = (_number(controls, name, state.speed) for name in names)
        turn = controls.get("heading_rate", self._turn(sin_cos(state.roll), state.speed))
        return Dubins3DState(state.velocity, turn, acceleration, gamma, roll)

    def held(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Controls:
        if "heading_rate" not in controls:
            return controls
        others = {name: value for name, value in controls.items() if name != "heading_rate"}
        return {**others, "roll_rate": self._roll_rate(state, controls, dt)}

    def bend(self, before: Dubins3DState, after: Dubins3DState, dt: Seconds) -> Float[Array, ""]:
        """As for any platform, and for the acceleration across the velocity, which changes with the roll.

        While it passes from one value to another, in whatever way, the path leaves that of its mean by ‖Δa‖Δt²/54 at most.
        """
        across = [self.gravity * jnp.tan(state.roll) * jnp.cos(state.flight_path_angle) for state in (before, after)]
        return super().bend(before, after, dt) + jnp.abs(across[1] - across[0]) * dt**2 / 54.0

    def _turn(self, bank: tuple[Array, Array], speed: Array) -> Array:
        """Heading rate ψ̇ = g/v tan φ from the sine and cosine of the bank φ, by one division."""
        return self.gravity * bank[0] / (speed * bank[1])

    def _roll_rate(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Any:
        if "heading_rate" not in controls:
            return controls.get("roll_rate")
        return (arctan(controls["heading_rate"] * state.speed / self.gravity) - state.roll) / dt


def _number(controls: Controls, name: str, like: Array) -> Array:
    return jnp.asarray(controls.get(name, 0.0), like.dtype)


def _forward(heading: tuple[Array, Array], gamma: tuple[Array, Array]) -> tuple[Array, Array, Array]:
    """Direction of flight (cos ψ cos γ, sin ψ cos γ, −sin γ) from the sines and cosines of both angles."""
    (y, x), (z, level) = heading, gamma
    return x * level, y * level, -z


def _dot(weights: Sequence[float], values: Sequence[Array]) -> Any:
    return sum(weight * value for weight, value in zip(weights, values, strict=True))


def _arc(heading: Any, speed: Any, turn: Any, acceleration: Any, t: Any) -> Float[Array, " 2"]:
    """∫₀ᵗ (v + aτ) (cos(ψ + ωτ), sin(ψ + ωτ)) dτ, about the heading at half time.

    With h = ωt/2: along that heading t (v + at/2) sin h/h, across it a t² (sin h/h − cos h)/(2h).
    """
    half = turn * t / 2.0
    s1, c2, s3 = sine_ratios(half)
    along = t * (speed + acceleration * t / 2.0) * s1
    across = acceleration * t * t * half * (c2 - s3) / 2.0
    forward = direction(heading + half)
    return along * forward + across * jnp.stack([-forward[1], forward[0]])
