"""Aircraft whose rates follow their commands with a first-order lag: Dubins models with inertia.

Each rate u of Eqs. (5) and (9) becomes a state that obeys τu̇ = command − u. The angles and the
speed are integrated exactly, also where they rest at a limit. The position is a Gauss-Legendre
quadrature of order 6 over `substeps` equal parts of the step. Without lag, τ → 0, they are the
models of `dubins`.
"""

from __future__ import annotations

from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.dubins import (
    Dubins2D,
    Dubins2DState,
    Dubins3D,
    Dubins3DState,
    flight_direction,
    moved_by,
    weighted_sum,
)
from jaxsafe.simulation.integrate import (
    NODES,
    PARTIAL_WEIGHTS,
    WEIGHTS,
    lagged,
    lagged_integral,
    lagged_ramp,
    turning_time,
)
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.trig import sin_cos, sin_cos_acute
from jaxsafe.types import Number, Seconds

Lag = Annotated[Number, Unit("s"), Range(0.0, open_low=True, smallest=1e-3, largest=1e6)]
"""Time constant τ of a first-order lag [s]."""

Substeps = Annotated[int, Range(1, largest=1000)]
"""Number of parts into which a step is divided."""

Command = tuple[Array, Array, Number]
"""A rate, the command that it follows, and the time constant of its lag."""


class LaggedDubins2DState(Dubins2DState):
    """State of an aircraft at one altitude whose rates have a lag."""

    heading_rate: Annotated[Float[Array, ""], Unit("rad/s")]  # ψ̇
    acceleration: Annotated[Float[Array, ""], Unit("ft/s²")]  # v̇ within the speed limits


class LaggedDubins2D(Dubins2D, type="dubins2d_lag"):
    """An aircraft whose turn and acceleration follow `heading_rate` and `acceleration` with a lag.

    The commands are in rad/s and ft/s², as in Eq. (5).
    """

    heading_rate_lag: Lag = 0.5
    acceleration_lag: Lag = 1.0
    substeps: Substeps = 2

    def rest(self) -> LaggedDubins2DState:
        state = super().rest()
        zero = jnp.zeros_like(state.speed)
        return LaggedDubins2DState(**vars(state), heading_rate=zero, acceleration=zero)

    def step(self, state: Any, controls: Controls, dt: Seconds) -> LaggedDubins2DState:
        """Return the state after `dt` seconds, exact but for the quadrature of the position."""
        turn = _command(controls, "heading_rate", self.heading_rate_lag, state.heading_rate)
        push = _command(controls, "acceleration", self.acceleration_lag, state.acceleration)
        first_speed = jnp.clip(state.speed, *self.speed_limits)
        turning = turning_time(*push)

        def heading(t: Number) -> Array:
            return state.heading + lagged_integral(*turn, t)

        def speed(t: Number) -> Array:
            return lagged_ramp(first_speed, *push, turning, limits=self.speed_limits, t=t)

        def one_part(moved: list[Array], begin: Array) -> tuple[list[Array], None]:
            for node, weight in zip(NODES, WEIGHTS, strict=True):
                t = begin + node * h
                way = weight * h * speed(t)
                sine, cosine = sin_cos(heading(t))
                moved = [moved[0] + way * cosine, moved[1] + way * sine]
            return moved, None

        h = dt / self.substeps
        still = [jnp.zeros_like(state.speed)] * 2
        moved, _ = jax.lax.scan(one_part, still, h * jnp.arange(self.substeps, dtype=h.dtype))
        return LaggedDubins2DState(
            position=moved_by(state.position, moved),
            heading=heading(dt),
            speed=speed(dt),
            heading_rate=lagged(*turn, dt),
            acceleration=lagged(*push, dt),
        )

    step_within_limits = Platform.step_within_limits  # not the shortcut of `Dubins2D`

    def derivative(self, state: Any, controls: Controls) -> LaggedDubins2DState:
        """Return the right-hand side, which holds within the limits."""
        return LaggedDubins2DState(
            position=state.velocity,
            heading=state.heading_rate,
            speed=state.acceleration,
            heading_rate=_slope(
                _command(controls, "heading_rate", self.heading_rate_lag, state.heading_rate)
            ),
            acceleration=_slope(
                _command(controls, "acceleration", self.acceleration_lag, state.acceleration)
            ),
        )

    def bend(self, before: Any, after: Any, dt: Seconds) -> Float[Array, ""]:
        """Return how far the path may leave the straight line from `before` to `after`.

        This adds ‖Δa‖Δt²/54 to the bound for any platform, as `dubins3d` does, where Δa is what the
        acceleration may change. The acceleration is v̇ along and v ψ̇ across the velocity.
        """
        along = jnp.abs(before.acceleration) + jnp.abs(after.acceleration)
        across = _change_of_product(
            factor=self.speed_limits[1],
            factor_change=along * dt,
            rate=jnp.maximum(jnp.abs(before.heading_rate), jnp.abs(after.heading_rate)),
            rate_change=jnp.abs(after.heading_rate - before.heading_rate),
        )
        return Platform.bend(self, before, after, dt) + (along + across) * dt**2 / 54.0


class LaggedDubins3DState(Dubins3DState):
    """State of an aircraft in space whose rates have a lag."""

    roll_rate: Annotated[Float[Array, ""], Unit("rad/s")]  # φ̇ within the limits of the roll
    flight_path_angle_rate: Annotated[Float[Array, ""], Unit("rad/s")]  # γ̇ within its limits
    acceleration: Annotated[Float[Array, ""], Unit("ft/s²")]  # v̇ within the speed limits


class LaggedDubins3D(Dubins3D, type="dubins3d_lag"):
    """An aircraft in space whose rates follow their commands with a lag.

    The commands are `roll_rate`, `flight_path_angle_rate` [rad/s] and `acceleration` [ft/s²], as in
    Eq. (9). It takes no `heading_rate`.
    """

    roll_rate_lag: Lag = 0.3
    flight_path_angle_rate_lag: Lag = 0.5
    acceleration_lag: Lag = 1.0
    substeps: Substeps = 2

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("roll_rate", "flight_path_angle_rate", "acceleration")

    def rest(self) -> LaggedDubins3DState:
        state = super().rest()
        zero = jnp.zeros_like(state.speed)
        return LaggedDubins3DState(
            **vars(state), roll_rate=zero, flight_path_angle_rate=zero, acceleration=zero
        )

    def step(self, state: Any, controls: Controls, dt: Seconds) -> LaggedDubins3DState:
        """Return the state after `dt` seconds.

        Roll, flight path angle and speed are exact. Heading and position are quadratures.
        """
        rates = self._rates(state, controls)
        limits = self._limits()
        turning = {name: turning_time(*rate) for name, rate in rates.items()}

        def at(t: Number) -> list[Array]:
            return [
                lagged_ramp(
                    jnp.clip(getattr(state, name), *limits[name]),
                    *rates[name],
                    turning[name],
                    limits=limits[name],
                    t=t,
                )
                for name in ("roll", "flight_path_angle", "speed")
            ]

        def one_part(before: list[Array], begin: Array) -> tuple[list[Array], None]:
            heading, *moved = before
            nodes = [at(begin + node * h) for node in NODES]
            turns = [h * self._turn_rate(sin_cos_acute(roll), speed) for roll, _, speed in nodes]
            for (_, gamma, speed), weight, partial in zip(
                nodes, WEIGHTS, PARTIAL_WEIGHTS, strict=True
            ):
                ahead = sin_cos(heading + weighted_sum(partial, turns))
                forward = flight_direction(ahead, sin_cos_acute(gamma))
                way = weight * h * speed
                moved = [total + way * part for total, part in zip(moved, forward, strict=True)]
            return [heading + weighted_sum(WEIGHTS, turns), *moved], None

        h = dt / self.substeps
        still = jnp.zeros_like(state.speed)
        (heading, *moved), _ = jax.lax.scan(
            one_part,
            [state.heading, still, still, still],
            h * jnp.arange(self.substeps, dtype=h.dtype),
        )
        roll, gamma, speed = at(dt)
        return LaggedDubins3DState(
            position=moved_by(state.position, moved),
            heading=heading,
            speed=speed,
            flight_path_angle=gamma,
            roll=roll,
            roll_rate=lagged(*rates["roll"], dt),
            flight_path_angle_rate=lagged(*rates["flight_path_angle"], dt),
            acceleration=lagged(*rates["speed"], dt),
        )

    step_within_limits = Platform.step_within_limits  # not the shortcut of `Dubins3D`

    def derivative(self, state: Any, controls: Controls) -> LaggedDubins3DState:
        """Return the right-hand side, which holds within the limits."""
        rates = self._rates(state, controls)
        return LaggedDubins3DState(
            position=state.velocity,
            heading=self._turn_rate(sin_cos(state.roll), state.speed),
            speed=state.acceleration,
            flight_path_angle=state.flight_path_angle_rate,
            roll=state.roll_rate,
            roll_rate=_slope(rates["roll"]),
            flight_path_angle_rate=_slope(rates["flight_path_angle"]),
            acceleration=_slope(rates["speed"]),
        )

    def bend(self, before: Any, after: Any, dt: Seconds) -> Float[Array, ""]:
        """Return how far the path may leave the straight line from `before` to `after`.

        This adds ‖Δa‖Δt²/54 to the bound for any platform, where Δa is what the acceleration may
        change. The acceleration is v̇ along the velocity, v γ̇ across it upwards, and g tan φ cos γ
        across it sideways.
        """
        along = jnp.abs(before.acceleration) + jnp.abs(after.acceleration)
        rates = [state.flight_path_angle_rate for state in (before, after)]
        largest_rate = jnp.abs(rates[0]) + jnp.abs(rates[1])
        upwards = _change_of_product(
            factor=self.speed_limits[1],
            factor_change=along * dt,
            rate=largest_rate,
            rate_change=largest_rate,
        )
        rolled = (jnp.abs(before.roll_rate) + jnp.abs(after.roll_rate)) * dt
        bank = jnp.minimum(
            jnp.maximum(jnp.abs(before.roll), jnp.abs(after.roll)) + rolled,
            jnp.max(jnp.abs(self.roll_limits)),
        )
        sideways = self.gravity * rolled / jnp.cos(bank) ** 2
        change = along + upwards + sideways
        return Platform.bend(self, before, after, dt) + change * dt**2 / 54.0

    def _rates(self, state: Any, controls: Controls) -> dict[str, Command]:
        """Return rate, command and time constant of each field that a command moves."""
        return {
            "roll": _command(controls, "roll_rate", self.roll_rate_lag, state.roll_rate),
            "flight_path_angle": _command(
                controls,
                "flight_path_angle_rate",
                self.flight_path_angle_rate_lag,
                state.flight_path_angle_rate,
            ),
            "speed": _command(controls, "acceleration", self.acceleration_lag, state.acceleration),
        }


def _command(controls: Controls, name: str, time_constant: Number, rate: Array) -> Command:
    """Return a rate, the command that it follows, and the time constant of its lag."""
    return rate, jnp.asarray(controls.get(name, 0.0), rate.dtype), time_constant


def _slope(command: Command) -> Array:
    """Return the rate at which a rate with a lag changes."""
    rate, target, time_constant = command
    return (target - rate) / time_constant


def _change_of_product(factor: Any, factor_change: Any, rate: Any, rate_change: Any) -> Any:
    """Return a bound on the change of a product, given bounds on its factors and their changes."""
    return factor * rate_change + factor_change * rate
