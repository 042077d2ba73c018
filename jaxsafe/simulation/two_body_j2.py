"""Spacecraft near a chief in orbit about an oblate planet: relative motion with J2.

The frame is Hill's frame of the chief, as in `two_body`. It turns with the chief's osculating
orbit: at the rate ω_z about the angular momentum and at ω_x about the radius. The state of the
chief is its osculating orbit: the eccentricity vector (e cos ω, e sin ω) from the ascending node,
the inclination i, the argument of latitude θ, and the relative change η of the angular momentum
h = h₀ (1 + η). They follow Gauss's equations, driven by the acceleration of J2. Along the radius,
the track and the normal this acceleration is, with f = 3/2 J2 μ Rₑ²/R⁴,

    f_r = −f (1 − 3 sin²i sin²θ),  f_t = −f sin²i sin 2θ,  f_n = −f sin 2i sin θ.

The node itself has no influence on the motion. The equations of the deputy are those of Xu and
Wang (Nonlinear Dynamic Equations of Satellite Relative Motion Around an Oblate Earth, Journal of
Guidance, Control, and Dynamics 31(5), 2008), with differences of nearly equal numbers written as
products.
"""

from __future__ import annotations

from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.cwh import SpacecraftState
from jaxsafe.simulation.geometry import direction
from jaxsafe.simulation.oriented import wrapped
from jaxsafe.simulation.trig import sin_cos
from jaxsafe.simulation.two_body import (
    Frame,
    TwoBody,
    gain,
    inverse_power,
    relative_acceleration,
)
from jaxsafe.types import Extent, Number, Radians, Turn

EARTH_J2 = 1.08262668e-3
"""Second zonal harmonic J2 of the Earth."""

EARTH_RADIUS = 6_378_137.0
"""Equatorial radius Rₑ of the Earth [m]."""


class TwoBodyJ2State(SpacecraftState):
    """State of a spacecraft relative to a chief, and the chief's osculating orbit."""

    eccentricity_vector: Annotated[Float[Array, " 2"], Unit("1")]  # e cos ω, e sin ω
    inclination: Annotated[Float[Array, ""], Unit("rad")]  # i
    argument_of_latitude: Annotated[Float[Array, ""], Unit("rad")]  # θ, in [−π, π)
    momentum_change: Annotated[Float[Array, ""], Unit("1")]  # η


class TwoBodyJ2(TwoBody, type="two_body_j2"):
    """A point mass with one thruster pair per axis, near a chief about an oblate planet.

    The orbit is given by its osculating elements at the start: mean motion n, eccentricity e, true
    anomaly ν, argument of perigee ω and inclination i. A step is integrated by `substeps`
    Runge-Kutta steps of order 4.

    Its controls are `thrust_x`, `thrust_y` and `thrust_z` [N].
    """

    dimension: Annotated[int, Range(3, 3)] = 3
    argument_of_perigee: Annotated[Radians, Turn] = 0.0
    inclination: Annotated[Radians, Range(0.0, 3.1415927)] = 0.9
    j2: Annotated[Number, Unit("1"), Range(-1.0, 1.0)] = EARTH_J2
    equatorial_radius: Annotated[Number, Unit("m"), Extent] = EARTH_RADIUS

    def rest(self) -> TwoBodyJ2State:
        zero = jnp.zeros((), jnp.result_type(float))
        perigee = zero + self.argument_of_perigee
        return TwoBodyJ2State(
            position=jnp.zeros(3, zero.dtype),
            velocity=jnp.zeros(3, zero.dtype),
            delta_v=jnp.zeros(3, zero.dtype),
            eccentricity_vector=self.eccentricity * direction(perigee),
            inclination=zero + self.inclination,
            argument_of_latitude=wrapped(perigee + self.true_anomaly),
            momentum_change=zero,
        )

    def settle(self, state: TwoBodyJ2State) -> TwoBodyJ2State:
        return state.replace(argument_of_latitude=wrapped(state.argument_of_latitude))

    def derivative(self, state: TwoBodyJ2State, controls: Controls) -> TwoBodyJ2State:
        sin_i, cos_i = sin_cos(state.inclination)
        sin_t, cos_t = sin_cos(state.argument_of_latitude)
        e_x, e_y = state.eccentricity_vector
        momentum = 1.0 + state.momentum_change
        e_cos = e_x * cos_t + e_y * sin_t
        e_sin = e_x * sin_t - e_y * cos_t
        w = 1.0 + e_cos  # p/R
        radius = self._parameter * momentum**2 / w
        turn = self._base_rate * w**2 / momentum**3  # ω_z
        pull = turn**2 / w  # μ/R³

        f = 1.5 * self.j2 * (self.equatorial_radius / radius) ** 2 * pull * radius
        along = radius * turn  # h/R, the speed across the radius
        f_radius = -f * (1.0 - 3.0 * (sin_i * sin_t) ** 2) / along
        f_track = -2.0 * f * sin_i**2 * sin_t * cos_t / along
        f_normal = -2.0 * f * sin_i * cos_i * sin_t / along  # also ω_x
        precession = -2.0 * f * (cos_i * sin_t) ** 2 / along  # of the node, times cos i
        inclination_rate = cos_t * f_normal
        latitude_rate = turn - precession

        frame = Frame(
            radius=radius,
            turn=turn,
            turn_rate=f_track * turn - 2.0 * pull * e_sin,
            pull=pull,
            stretch=pull * e_cos,
        )
        tilt = f_normal
        tilt_rate = -2.0 * f / along * (
            (cos_i**2 - sin_i**2) * inclination_rate * sin_t + sin_i * cos_i * cos_t * latitude_rate
        ) - tilt * (f_track + 3.0 * turn * e_sin / w)
        x, y, z = state.position
        _, v_y, v_z = state.velocity
        tilting = [
            -tilt * turn * z,
            2.0 * tilt * v_z + tilt_rate * z + tilt**2 * y,
            -2.0 * tilt * v_y - tilt * turn * x - tilt_rate * y + tilt**2 * z,
        ]
        acceleration = relative_acceleration(
            r=state.position,
            v=state.velocity,
            a=self._thrust_acceleration(controls) + jnp.stack(tilting),
            frame=frame,
        )
        axis = jnp.stack([sin_i * sin_t, sin_i * cos_t, cos_i])  # of the planet
        acceleration = acceleration - f * oblateness(state.position / radius, axis)

        e_rates = [
            w * sin_t * f_radius + ((w + 1.0) * cos_t + e_x) * f_track + e_y * precession,
            -w * cos_t * f_radius + ((w + 1.0) * sin_t + e_y) * f_track - e_x * precession,
        ]
        return TwoBodyJ2State(
            position=state.velocity,
            velocity=acceleration,
            delta_v=jnp.zeros_like(acceleration),
            eccentricity_vector=jnp.stack(e_rates),
            inclination=inclination_rate,
            argument_of_latitude=latitude_rate,
            momentum_change=momentum * f_track,
        )


def oblateness(xi: Float[Array, " 3"], axis: Float[Array, " 3"]) -> Float[Array, " 3"]:
    """Return the difference of the pulls of J2 on deputy and chief, divided by −f.

    With d = x̂ + ξ, u = d·ẑ and A = (1 − 5u²/d²)/d⁵, the pull on the deputy is −f (A d + 2u ẑ/d⁵).

    Args:
        xi: position ξ of the deputy, divided by the chief's radius.
        axis: ẑ, the axis of the planet in Hill's frame.
    """
    q = gain(xi)
    fifth = inverse_power(q, 5)  # 1/d⁵ − 1
    seventh = inverse_power(q, 7)
    rise = jnp.sum(axis * xi)  # u of the deputy less that of the chief
    u = axis[0] + rise
    more = fifth - 5.0 * (rise * (u + axis[0]) + u**2 * seventh)  # A of the deputy less the chief's
    factor = 1.0 + fifth - 5.0 * u**2 * (1.0 + seventh)  # A
    along_x = jnp.zeros_like(xi).at[0].set(more)
    return factor * xi + along_x + 2.0 * (rise + u * fifth) * axis
