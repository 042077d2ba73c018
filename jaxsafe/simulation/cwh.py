"""Spacecraft in Hill's frame: Clohessy-Wiltshire motion, Eqs. (12), (16).

The x axis points away from the Earth and the y axis along the orbit. The thrust is constant over a
step (zero-order hold), so the linear equations are solved in closed form and the step is exact.
"""

from __future__ import annotations

from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.integrate import sine_ratios
from jaxsafe.simulation.platform import Platform
from jaxsafe.types import Kilograms, Number, RadiansPerSecond, Record, Seconds

MEAN_MOTION = 0.001027
"""Mean motion n of the chief's orbit [rad/s], Table 4."""

MASS = 12.0
"""Mass m of the deputy [kg], Table 4."""

MeanMotion = Annotated[RadiansPerSecond, Range(largest=10.0)]
"""Mean motion of an orbit [rad/s]."""


class SpacecraftState(Record):
    """State of a spacecraft relative to the origin of Hill's frame."""

    position: Annotated[Float[Array, " d"], Unit("m")]  # r
    velocity: Annotated[Float[Array, " d"], Unit("m/s")]  # v
    # F Δt / m, the velocity change by the thrust of the last step.
    delta_v: Annotated[Float[Array, " d"], Unit("m/s")]

    @property
    def heading(self) -> Float[Array, ""]:
        """Heading 0, because a point mass keeps the axes of Hill's frame."""
        return jnp.zeros_like(self.position[..., 0])

    @property
    def orientation(self) -> Float[Array, "d d"]:
        """Rotation from the body frame to Hill's frame: the identity."""
        identity = jnp.eye(self.position.shape[-1], dtype=self.position.dtype)
        return jnp.broadcast_to(identity, (*self.position.shape, self.position.shape[-1]))


class Anchor(Platform, type="anchor"):
    """A spacecraft at rest at the origin of Hill's frame, such as the chief.

    The origin is an equilibrium of Eqs. (12), (16).
    """

    def rest(self) -> SpacecraftState:
        zeros = jnp.zeros(self.dimension, jnp.result_type(float))
        return SpacecraftState(position=zeros, velocity=zeros, delta_v=zeros)

    @property
    def can_be_pushed(self) -> bool:
        return type(self) is not Anchor

    def step(self, state: SpacecraftState, controls: Controls, dt: Seconds) -> SpacecraftState:
        return state

    def derivative(self, state: SpacecraftState, controls: Controls) -> SpacecraftState:
        zeros = jnp.zeros_like(state.position)
        return SpacecraftState(position=zeros, velocity=zeros, delta_v=zeros)


class ThrustedSpacecraft(Anchor):
    """Base of point masses with one thruster pair per axis.

    Their controls are `thrust_x`, `thrust_y` and `thrust_z` [N], one for each axis of space.
    """

    mass: Kilograms = MASS

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(f"thrust_{axis}" for axis in "xyz"[: self.dimension])

    def _thrust_acceleration(self, controls: Controls) -> Float[Array, " d"]:
        return jnp.stack([controls.get(name, 0.0) for name in self.inputs]) / self.mass


class Spacecraft(ThrustedSpacecraft, type="spacecraft"):
    """A point mass with one thruster pair per axis, near a chief on a circular orbit.

    Its controls are `thrust_x`, `thrust_y` and, in space, `thrust_z` [N].
    """

    dimension: Annotated[int, Range(2, 3)]
    mean_motion: MeanMotion = MEAN_MOTION

    def step(self, state: SpacecraftState, controls: Controls, dt: Seconds) -> SpacecraftState:
        """Return the state after `dt` seconds: the exact solution for constant thrust."""
        thrust = self._thrust_acceleration(controls)
        position, velocity = cwh_flow(
            r=state.position, v=state.velocity, a=thrust, n=self.mean_motion, t=dt
        )
        return SpacecraftState(position=position, velocity=velocity, delta_v=thrust * dt)

    def derivative(self, state: SpacecraftState, controls: Controls) -> SpacecraftState:
        thrust = self._thrust_acceleration(controls)
        acceleration = cwh_acceleration(
            r=state.position, v=state.velocity, a=thrust, n=self.mean_motion
        )
        return SpacecraftState(
            position=state.velocity,
            velocity=acceleration,
            delta_v=jnp.zeros_like(acceleration),
        )


def cwh_acceleration(
    r: Float[Array, " d"], v: Float[Array, " d"], a: Float[Array, " d"], n: Number
) -> Float[Array, " d"]:
    """Return the relative acceleration in Hill's frame, Eqs. (12), (16).

    ẍ = 2nẏ + 3n²x + aₓ,  ÿ = −2nẋ + a_y,  z̈ = −n²z + a_z

    Args:
        r: position [m], shape (d,), d = 2 or 3.
        v: velocity [m/s], shape (d,).
        a: thrust acceleration F/m [m/s²], shape (d,).
        n: mean motion [rad/s].

    Returns:
        Acceleration [m/s²], shape (d,).
    """
    planar = [2.0 * n * v[1] + 3.0 * n**2 * r[0] + a[0], -2.0 * n * v[0] + a[1]]
    return jnp.stack(planar + [-(n**2) * r[2] + a[2]] * (r.shape[0] == 3))


def cwh_flow(
    r: Float[Array, " d"], v: Float[Array, " d"], a: Float[Array, " d"], n: Number, t: Number
) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
    """Return position and velocity after a time t under constant thrust, solving Eqs. (12), (16).

    With τ = nt and the entire functions s₁ = sin τ/τ, c₂ = (1 − cos τ)/τ² and s₃ = (τ − sin τ)/τ³,
    every coefficient is a product without cancellation. So float32 keeps its precision at
    τ = 0.001, and n = 0 gives the double integrator.

    Args:
        r: position [m], shape (d,), d = 2 or 3.
        v: velocity [m/s], shape (d,).
        a: thrust acceleration F/m [m/s²], shape (d,).
        n: mean motion [rad/s].
        t: time [s].

    Returns:
        Position [m] and velocity [m/s], each of shape (d,).
    """
    tau = n * t
    s1, c2, s3 = sine_ratios(tau)
    along, across, straight, sine, versine = _impulse_coefficients(tau, t, s1, c2)
    third = 2.0 * tau * s3 * t * t  # 2(τ − sin τ)/n²
    x, y = r[0], r[1]
    vx, vy = v[0], v[1]
    ax, ay = a[0], a[1]
    position = [
        x + 3.0 * versine * x + along * vx + across * vy + t * t * c2 * ax + third * ay,
        y
        - 6.0 * tau**3 * s3 * x
        - across * vx
        + straight * vy
        - third * ax
        + t * t * (4.0 * c2 - 1.5) * ay,
    ]
    velocity = [
        vx + 3.0 * n * sine * x - versine * vx + 2.0 * sine * vy + along * ax + across * ay,
        vy
        - 6.0 * n * versine * x
        - 2.0 * sine * vx
        - 4.0 * versine * vy
        - across * ax
        + straight * ay,
    ]
    if r.shape[0] == 3:
        z = r[2]
        vz = v[2]
        az = a[2]
        position.append(z - versine * z + along * vz + t * t * c2 * az)
        velocity.append(vz - n * sine * z - versine * vz + along * az)
    return jnp.stack(position), jnp.stack(velocity)


def cwh_response(vx: Number, vy: Number, n: Number, t: Number) -> tuple[Any, Any, Any, Any]:
    """Return position and velocity along x and y, a time t after an impulse in the plane.

    It is `cwh_flow` from rest at the origin, as single numbers.

    Args:
        vx: change of the velocity along x by the impulse [m/s].
        vy: the same along y.
        n: mean motion [rad/s].
        t: time [s].
    """
    tau = n * t
    s1, c2, _ = sine_ratios(tau)
    along, across, straight, sine, versine = _impulse_coefficients(tau, t, s1, c2)
    return (
        along * vx + across * vy,
        straight * vy - across * vx,
        vx - versine * vx + 2.0 * sine * vy,
        vy - 2.0 * sine * vx - 4.0 * versine * vy,
    )


def _impulse_coefficients(
    tau: Number, t: Number, s1: Number, c2: Number
) -> tuple[Any, Any, Any, Any, Any]:
    """Return sin τ/n, 2(1 − cos τ)/n, 4 sin τ/n − 3t, sin τ and 1 − cos τ."""
    half = 2.0 * tau * c2  # 2(1 − cos τ)/τ
    return t * s1, t * half, t * (4.0 * s1 - 3.0), tau * s1, tau * tau * c2
