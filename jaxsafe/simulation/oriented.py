"""A spacecraft that thrusts along its body axis and turns with a reaction wheel, Eqs. (18)-(20)."""

from __future__ import annotations

from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.cwh import (
    MASS,
    MEAN_MOTION,
    MeanMotion,
    cwh_acceleration,
    cwh_flow,
    cwh_response,
)
from jaxsafe.simulation.geometry import direction, rotation
from jaxsafe.simulation.integrate import NODES, WEIGHTS, ramp, through_pieces, time_to_limit
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.trig import sin_cos, wrap
from jaxsafe.types import Kilograms, Number, Record, Seconds

RATE_LIMIT = jnp.pi / 90.0
"""Highest attitude rate [rad/s], Table 4: 2°/s."""


class OrientedState(Record):
    """State of an oriented spacecraft relative to the origin of Hill's frame."""

    position: Annotated[Float[Array, " 2"], Unit("m")]  # r
    velocity: Annotated[Float[Array, " 2"], Unit("m/s")]  # v
    # F Δt / m, the velocity change by the thrust of the last step.
    delta_v: Annotated[Float[Array, " 1"], Unit("m/s")]
    # θ from the x axis to the body's x axis, in [−π, π).
    attitude: Annotated[Float[Array, ""], Unit("rad")]
    attitude_rate: Annotated[Float[Array, ""], Unit("rad/s")]  # θ̇

    @property
    def heading(self) -> Float[Array, ""]:
        """Heading of the body's x axis: the attitude."""
        return self.attitude

    @property
    def orientation(self) -> Float[Array, "2 2"]:
        """Rotation from the body frame to Hill's frame."""
        return rotation(self.attitude)


class OrientedSpacecraft(Platform, type="oriented_spacecraft"):
    """A spacecraft in the plane that turns, Eq. (20).

    Its controls are `thrust` [N] along the body axis and `attitude_acceleration` [rad/s²].
    The term −D ψ̇/I_zz of the reaction wheel is commanded directly, as θ̈.
    """

    dimension: Annotated[int, Range(2, 2)] = 2
    mass: Kilograms = MASS
    mean_motion: MeanMotion = MEAN_MOTION
    attitude_rate_limits: Annotated[
        Number, Unit("rad/s", length=2), Range(largest=1e6, infinite=True)
    ] = (-RATE_LIMIT, RATE_LIMIT)

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("thrust", "attitude_acceleration")

    def rest(self) -> OrientedState:
        zero = jnp.zeros((), jnp.result_type(float))
        zeros = jnp.zeros(2, zero.dtype)
        return OrientedState(
            position=zeros,
            velocity=zeros,
            delta_v=zero[None],
            attitude=zero,
            attitude_rate=zero,
        )

    def settle(self, state: OrientedState) -> OrientedState:
        return state.replace(attitude=wrapped(state.attitude))

    def step(self, state: OrientedState, controls: Controls, dt: Seconds) -> OrientedState:
        """Return the state after `dt` seconds.

        The motion without thrust is the exact flow of Eq. (12). The step adds the response to the
        turning thrust to it: the thrust is a sum of impulses at the nodes of a quadrature, and the
        flow carries each impulse to the end of the step.
        """
        limits = self.attitude_rate_limits
        turn = controls.get("attitude_acceleration", 0.0)
        first_rate = ramp(state.attitude_rate, rate=0.0, limits=limits, t=0.0)
        final_rate = ramp(first_rate, rate=turn, limits=limits, t=dt)
        thrust = controls.get("thrust", 0.0) / self.mass

        def fly(before: list[Any], begin: Number, length: Number) -> list[Any]:
            attitude, rate, acceleration, *moved = before
            for node, weight in zip(NODES, WEIGHTS, strict=True):
                elapsed = node * length
                sine, cosine = sin_cos(attitude + rate * elapsed + acceleration * elapsed**2 / 2.0)
                impulse = thrust * weight * length
                response = cwh_response(
                    vx=impulse * cosine,
                    vy=impulse * sine,
                    n=self.mean_motion,
                    t=dt - begin - elapsed,
                )
                moved = [total + part for total, part in zip(moved, response, strict=True)]
            attitude = attitude + length * (rate + acceleration * length / 2.0)
            return [attitude, final_rate, still, *moved]

        stop = time_to_limit(first_rate, rate=turn, limits=limits, dt=dt)
        position, velocity = cwh_flow(
            r=state.position,
            v=state.velocity,
            a=jnp.zeros_like(state.position),
            n=self.mean_motion,
            t=dt,
        )
        still = jnp.zeros_like(first_rate)
        start = [state.attitude, first_rate, still + turn, *position, *velocity]
        attitude, _, _, *moved = through_pieces(fly, start, [stop], dt)
        return OrientedState(
            position=jnp.stack(moved[:2]),
            velocity=jnp.stack(moved[2:]),
            delta_v=(thrust * dt)[None],
            attitude=wrapped(attitude),
            attitude_rate=final_rate,
        )

    def derivative(self, state: OrientedState, controls: Controls) -> OrientedState:
        """Return the right-hand side of Eq. (20), which holds within the attitude rate limits."""
        thrust = controls.get("thrust", 0.0) / self.mass * direction(state.attitude)
        acceleration = cwh_acceleration(
            r=state.position, v=state.velocity, a=thrust, n=self.mean_motion
        )
        turn = jnp.asarray(controls.get("attitude_acceleration", 0.0), acceleration.dtype)
        return OrientedState(
            position=state.velocity,
            velocity=acceleration,
            delta_v=jnp.zeros_like(state.delta_v),
            attitude=state.attitude_rate,
            attitude_rate=turn,
        )


def wrapped(angle: Float[Array, ""]) -> Float[Array, ""]:
    """Return the angle in [−π, π). An angle that lies there already keeps all its bits."""
    turned = wrap(angle, -jnp.pi, 2.0 * jnp.pi)
    turned = jnp.where(turned < jnp.pi, turned, -jnp.pi)
    return jnp.where((angle >= -jnp.pi) & (angle < jnp.pi), angle, turned)
