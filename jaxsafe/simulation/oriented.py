"""A spacecraft that thrusts along its body axis and turns with a reaction wheel, Eqs. (18)-(20)."""

from __future__ import annotations

from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.cwh import MASS, MEAN_MOTION, MeanMotion, cwh_acceleration, cwh_flow
from jaxsafe.simulation.geometry import direction, rotation
from jaxsafe.simulation.integrate import NODES, WEIGHTS, ramp, time_to_limit
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.trig import wrap
from jaxsafe.types import Kilograms, Number, Record, Seconds

RATE_LIMIT = jnp.pi / 90.0
"""Fastest turn [rad/s], Table 4: 2°/s."""


class OrientedState(Record):
    """State of an oriented spacecraft relative to the origin of Hill's frame."""

    position: Annotated[Float[Array, " 2"], Unit("m")]  # r
    velocity: Annotated[Float[Array, " 2"], Unit("m/s")]  # v
    delta_v: Annotated[Float[Array, " 1"], Unit("m/s")]  # velocity change F Δt / m bought with thrust in the last step
    attitude: Annotated[Float[Array, ""], Unit("rad")]  # θ from x to the body's x axis, in [−π, π)
    attitude_rate: Annotated[Float[Array, ""], Unit("rad/s")]  # θ̇

    @property
    def heading(self) -> Float[Array, ""]:
        """The attitude."""
        return self.attitude

    @property
    def orientation(self) -> Float[Array, "2 2"]:
        """Rotation from the body frame to Hill's frame."""
        return rotation(self.attitude)


class OrientedSpacecraft(Platform, type="oriented_spacecraft"):
    """A planar spacecraft with `thrust` [N] along its body axis and an `attitude_acceleration` [rad/s²], Eq. (20).

    The reaction wheel's −D ψ̇/I_zz is commanded directly as θ̈.
    """

    dimension: Annotated[int, Range(2, 2)] = 2
    mass: Kilograms = MASS
    mean_motion: MeanMotion = MEAN_MOTION
    attitude_rate_limits: Annotated[Number, Unit("rad/s", length=2), Range(largest=1e6, infinite=True)] = (
        -RATE_LIMIT,
        RATE_LIMIT,
    )

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("thrust", "attitude_acceleration")

    def rest(self) -> OrientedState:
        zero = jnp.zeros((), jnp.result_type(float))
        planar = jnp.zeros(2, zero.dtype)
        return OrientedState(planar, planar, zero[None], zero, zero)

    def settle(self, state: OrientedState) -> OrientedState:
        return state.replace(attitude=wrapped(state.attitude))

    def step(self, state: OrientedState, controls: Controls, dt: Seconds) -> OrientedState:
        """Advance by the exact flow of Eq. (12) and, for the turning thrust, quadrature of its impulse responses."""
        limits, turn = self.attitude_rate_limits, controls.get("attitude_acceleration", 0.0)
        start = ramp(state.attitude_rate, 0.0, limits, 0.0)
        final = ramp(start, turn, limits, dt)
        thrust = controls.get("thrust", 0.0) / self.mass

        still, attitude = jnp.zeros_like(state.position), state.attitude
        position, velocity = cwh_flow(state.position, state.velocity, still, self.mean_motion, dt)
        stop = time_to_limit(start, turn, limits, dt)
        for begin, length, rate, acceleration in ((0.0, stop, start, turn), (stop, dt - stop, final, 0.0)):
            for node, weight in zip(NODES, WEIGHTS, strict=True):
                after = node * length
                angle = attitude + rate * after + acceleration * after**2 / 2.0
                kick = thrust * weight * length * direction(angle)
                pushed = cwh_flow(still, kick, still, self.mean_motion, dt - begin - after)
                position, velocity = position + pushed[0], velocity + pushed[1]
            attitude = attitude + length * (rate + acceleration * length / 2.0)
        return OrientedState(position, velocity, (thrust * dt)[None], wrapped(attitude), final)

    def derivative(self, state: OrientedState, controls: Controls) -> OrientedState:
        """Eq. (20) within the limits of the attitude rate."""
        push = controls.get("thrust", 0.0) / self.mass * direction(state.attitude)
        rate = cwh_acceleration(state.position, state.velocity, push, self.mean_motion)
        turn = jnp.asarray(controls.get("attitude_acceleration", 0.0), rate.dtype)
        return OrientedState(state.velocity, rate, jnp.zeros_like(state.delta_v), state.attitude_rate, turn)


def wrapped(angle: Float[Array, ""]) -> Float[Array, ""]:
    """The angle in [−π, π); one that lies there is not touched by rounding."""
    turned = wrap(angle, -jnp.pi, 2.0 * jnp.pi)
    turned = jnp.where(turned < jnp.pi, turned, -jnp.pi)
    return jnp.where((angle >= -jnp.pi) & (angle < jnp.pi), angle, turned)
