"""Spacecraft near a chief on an elliptic orbit: nonlinear relative motion in a Kepler field.

The frame is Hill's frame of the chief: x points away from the planet's centre, z along the angular
momentum of the chief's orbit, and y completes the right-handed frame. On a circular orbit y points
along the velocity. The thrust is constant over a step in this frame.

With the chief's radius R, true anomaly ν, eccentricity e and k = μ/R³, the equations are

    ẍ = 2ν̇ẏ + ν̈y + k e cos ν x − k F (R + x) + aₓ
    ÿ = −2ν̇ẋ − ν̈x + k e cos ν y − k F y + a_y
    z̈ = −k z − k F z + a_z

where F = (R/‖R x̂ + r‖)³ − 1. They are exact (Alfriend, Vadali, Gurfil, How and Breger: Spacecraft
Formation Flying, 2010, chapter 4). Differences of nearly equal numbers are written as products:
ν̇² − k is k e cos ν, and F is a function of q = (2Rx + ‖r‖²)/R² (Encke's method; Battin: An
Introduction to the Mathematics and Methods of Astrodynamics, 1999, section 8.4). So single
precision keeps its digits at distances of metres.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.cwh import MEAN_MOTION, Spacecraft, SpacecraftState
from jaxsafe.simulation.integrate import runge_kutta
from jaxsafe.simulation.oriented import wrapped
from jaxsafe.simulation.trig import sin_cos
from jaxsafe.types import Number, Radians, Seconds, Turn

EARTH = 3.986004418e14
"""Gravitational parameter μ of the Earth [m³/s²]."""


class TwoBodyState(SpacecraftState):
    """State of a spacecraft relative to a chief on an elliptic orbit, and the chief's anomaly."""

    true_anomaly: Annotated[Float[Array, ""], Unit("rad")]  # ν of the chief, in [−π, π)


class Frame(NamedTuple):
    """Motion of the chief, and so of its Hill's frame, at one instant."""

    radius: Any  # R, the chief's distance from the planet's centre [m]
    turn: Any  # angular rate about z [rad/s]
    turn_rate: Any  # its derivative [rad/s²]
    pull: Any  # k = μ/R³ [1/s²]
    stretch: Any  # turn² − k [1/s²]


class TwoBody(Spacecraft, type="two_body"):
    """A point mass with one thruster pair per axis, near a chief on an elliptic orbit.

    The orbit is given by its mean motion n, eccentricity e and the true anomaly ν at the start. Its
    semi-major axis is (μ/n²)^⅓. Gravity is that of a point or of a sphere. A step is integrated by
    `substeps` Runge-Kutta steps of order 4.

    Its controls are `thrust_x`, `thrust_y` and, in space, `thrust_z` [N].
    """

    mean_motion: Annotated[
        Number, Unit("rad/s"), Range(0.0, open_low=True, smallest=1e-9, largest=10.0)
    ] = MEAN_MOTION
    eccentricity: Annotated[Number, Unit("1"), Range(0.0, 0.99)] = 0.0
    true_anomaly: Annotated[Radians, Turn] = 0.0
    gravitational_parameter: Annotated[
        Number, Unit("m³/s²"), Range(0.0, open_low=True, smallest=1.0, largest=1e30)
    ] = EARTH
    substeps: Annotated[int, Range(1, largest=1000)] = 1

    def rest(self) -> Any:
        return TwoBodyState(
            **vars(super().rest()),
            true_anomaly=wrapped(jnp.asarray(self.true_anomaly, jnp.result_type(float))),
        )

    def settle(self, state: Any) -> Any:
        return state.replace(true_anomaly=wrapped(state.true_anomaly))

    def step(self, state: Any, controls: Controls, dt: Seconds) -> Any:
        """Return the state after `dt` seconds, by Runge-Kutta steps."""
        moved = runge_kutta(
            lambda now: self.derivative(now, controls), state, dt=dt, substeps=self.substeps
        )
        return self.settle(moved.replace(delta_v=self._thrust_acceleration(controls) * dt))

    def derivative(self, state: Any, controls: Controls) -> Any:
        frame = self._frame(state.true_anomaly)
        acceleration = relative_acceleration(
            r=state.position,
            v=state.velocity,
            a=self._thrust_acceleration(controls),
            frame=frame,
        )
        return TwoBodyState(
            position=state.velocity,
            velocity=acceleration,
            delta_v=jnp.zeros_like(acceleration),
            true_anomaly=frame.turn,
        )

    def _frame(self, true_anomaly: Float[Array, ""]) -> Frame:
        """Return the motion of the chief at a true anomaly [rad]."""
        sine, cosine = sin_cos(true_anomaly)
        w = 1.0 + self.eccentricity * cosine
        pull = self._base_rate**2 * w**3
        return Frame(
            radius=self._parameter / w,
            turn=self._base_rate * w**2,
            turn_rate=-2.0 * pull * self.eccentricity * sine,
            pull=pull,
            stretch=pull * self.eccentricity * cosine,
        )

    @property
    def _parameter(self) -> Any:
        """Semi-latus rectum p = a (1 − e²) [m]."""
        semi_major_axis = (self.gravitational_parameter / self.mean_motion**2) ** (1.0 / 3.0)
        return semi_major_axis * (1.0 - self.eccentricity**2)

    @property
    def _base_rate(self) -> Any:
        """√(μ/p³) [rad/s], which is the mean motion on a circular orbit."""
        return self.mean_motion / (1.0 - self.eccentricity**2) ** 1.5


def relative_acceleration(
    r: Float[Array, " d"], v: Float[Array, " d"], a: Float[Array, " d"], frame: Frame
) -> Float[Array, " d"]:
    """Return the relative acceleration in the Hill's frame of a chief on a Kepler orbit.

    Args:
        r: position [m], shape (d,), d = 2 or 3.
        v: velocity [m/s], shape (d,).
        a: thrust acceleration F/m [m/s²], shape (d,).
        frame: the motion of the frame.

    Returns:
        Acceleration [m/s²], shape (d,).
    """
    radius, turn, turn_rate, pull, stretch = frame
    x, y = r[0], r[1]
    fall = pull * inverse_power(gain(r / radius), 3)  # kF
    acceleration = [
        2.0 * turn * v[1] + turn_rate * y + stretch * x - fall * (radius + x),
        -2.0 * turn * v[0] - turn_rate * x + stretch * y - fall * y,
    ]
    if r.shape[0] == 3:
        acceleration.append(-(pull + fall) * r[2])
    return jnp.stack(acceleration) + a


def gain(xi: Float[Array, " d"]) -> Float[Array, ""]:
    """Return q = ‖x̂ + ξ‖² − 1, where ξ is a position divided by the chief's radius."""
    return 2.0 * xi[0] + jnp.sum(xi * xi)


def inverse_power(q: Float[Array, ""], power: int) -> Float[Array, ""]:
    """Return (1 + q)^(−m/2) − 1 without cancellation, for an odd power m.

    With s = (1 + q)^(m/2) it is (1 − s)/s, and s − 1 is ((1 + q)^m − 1)/(s + 1).
    """
    polynomial = jnp.zeros_like(q)
    for k in range(power, 0, -1):
        polynomial = (polynomial + math.comb(power, k)) * q
    root = jnp.sqrt(1.0 + q) * (1.0 + q) ** (power // 2)
    return -polynomial / ((root + 1.0) * root)
