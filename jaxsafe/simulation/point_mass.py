"""Aircraft as a point mass with lift, drag and thrust: three degrees of freedom.

With speed v, flight path angle κ = −γ (positive in a climb), bank φ, heading ψ, weight W, thrust T
and load factor n = L/W, the equations are

    v̇ = g (T − D)/W − g sin κ
    κ̇ = g (n cos φ − cos κ)/v
    ψ̇ = g n sin φ/(v cos κ)

with the drag D = q S (C_D0 + K C_L²), the lift n W = q S C_L and q = ρ v²/2 (Vinh: Flight Mechanics
of High-Performance Aircraft, 1993). The earth is flat, the air is at rest and equally dense
everywhere, the thrust acts along the velocity, and there is no sideslip. The state is that of
`dubins3d`, with ż = −v sin γ as in Eq. (9). Lengths are in ft and forces in lbf.
"""

from __future__ import annotations

from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.dubins import Dubins3D, Dubins3DState
from jaxsafe.simulation.integrate import ramp, runge_kutta
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.trig import sin_cos
from jaxsafe.types import Number, Seconds

_POSITIVE = Range(0.0, open_low=True, smallest=1e-9, largest=1e9)

Weight = Annotated[Number, Unit("lbf"), _POSITIVE]
Area = Annotated[Number, Unit("ft²"), _POSITIVE]
Density = Annotated[Number, Unit("slug/ft³"), _POSITIVE]
LiftCoefficient = Annotated[Number, Unit("1"), _POSITIVE]
DragCoefficient = Annotated[Number, Unit("1"), Range(0.0, largest=1e3)]


class PointMassAircraft(Dubins3D, type="point_mass_aircraft"):
    """An aircraft that thrust, lift and drag move.

    It is steered by `thrust` [lbf], `load_factor` [g] and `roll_rate` [rad/s]. Thrust and load
    factor are brought within their limits, and the load factor also within what the wing can lift
    at the speed. A step is integrated by `substeps` Runge-Kutta steps of order 4. At a limit the
    speed and the angles rest.

    Without a `load_factor` the wing follows a `flight_path_angle_rate` [rad/s], and without a
    `thrust` the engine follows an `acceleration` [ft/s²], each as far as it can. So the controls of
    `dubins3d` steer it too. Where neither is given, the angle or the speed is held.

    The numbers are of the size of a light jet trainer at 10,000 ft.
    """

    weight: Weight = 6_600.0
    wing_area: Area = 184.0
    air_density: Density = 0.001756
    zero_lift_drag: DragCoefficient = 0.02
    induced_drag: DragCoefficient = 0.064
    largest_lift: LiftCoefficient = 1.4
    thrust_limits: Annotated[Number, Unit("lbf", length=2), Range(largest=1e9)] = (0.0, 2_050.0)
    load_factor_limits: Annotated[Number, Unit("1", length=2), Range(largest=1e3)] = (-2.5, 6.0)
    substeps: Annotated[int, Range(1, largest=1000)] = 2

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("thrust", "load_factor", "roll_rate", "flight_path_angle_rate", "acceleration")

    def step(self, state: Dubins3DState, controls: Controls, dt: Seconds) -> Dubins3DState:
        """Return the state after `dt` seconds, by Runge-Kutta steps."""
        return runge_kutta(
            lambda now: self._resting(now, self.derivative(now, controls)),
            self._within(state),
            dt=dt,
            substeps=self.substeps,
            limit=self._within,
        )

    step_within_limits = Platform.step_within_limits  # not the shortcut of `Dubins3D`

    def derivative(self, state: Dubins3DState, controls: Controls) -> Dubins3DState:
        """Return the right-hand side of the equations, which hold within the limits."""
        sin_gamma, cos_gamma = sin_cos(state.flight_path_angle)
        sin_roll, cos_roll = sin_cos(state.roll)
        speed = state.speed
        lifting = 0.5 * self.air_density * speed**2 * self.wing_area  # q S [lbf]
        stall = lifting * self.largest_lift / self.weight
        turning = self.gravity / speed
        pitch_rate = controls.get("flight_path_angle_rate", 0.0)
        low, high = self.load_factor_limits
        factor = jnp.clip(
            controls.get("load_factor", (cos_gamma - pitch_rate / turning) / cos_roll),
            jnp.maximum(low, -stall),
            jnp.minimum(high, stall),
        )
        lift_coefficient = factor * self.weight / lifting
        drag = lifting * (self.zero_lift_drag + self.induced_drag * lift_coefficient**2)
        push = controls.get("acceleration", 0.0) / self.gravity - sin_gamma
        thrust = jnp.clip(controls.get("thrust", drag + self.weight * push), *self.thrust_limits)
        return Dubins3DState(
            position=state.velocity,
            heading=turning * factor * sin_roll / cos_gamma,
            speed=self.gravity * ((thrust - drag) / self.weight + sin_gamma),
            flight_path_angle=turning * (cos_gamma - factor * cos_roll),
            roll=jnp.asarray(controls.get("roll_rate", 0.0), speed.dtype),
        )

    held = Platform.held  # a commanded heading rate is not among the inputs

    def bend(self, before: Dubins3DState, after: Dubins3DState, dt: Seconds) -> Float[Array, ""]:
        """Return how far the path may leave the straight line from `before` to `after`.

        This adds ‖Δa‖Δt²/54 to the bound for any platform, because the lift turns with the bank.
        """
        lift = self.gravity * jnp.max(jnp.abs(self.load_factor_limits))
        change = lift * jnp.abs(after.roll - before.roll)
        return Platform.bend(self, before, after, dt) + change * dt**2 / 54.0

    def _within(self, state: Dubins3DState) -> Dubins3DState:
        """Return the state with speed and angles brought within their limits."""
        limits = self._limits()
        return state.replace(
            **{
                name: ramp(getattr(state, name), rate=0.0, limits=limits[name], t=0.0)
                for name in limits
            }
        )

    def _resting(self, state: Dubins3DState, rates: Dubins3DState) -> Dubins3DState:
        """Return the rates with 0 in place of those that lead beyond a limit that is reached."""
        resting = {}
        for name, (low, high) in self._limits().items():
            value = getattr(state, name)
            rate = getattr(rates, name)
            outwards = ((value >= high) & (rate > 0.0)) | ((value <= low) & (rate < 0.0))
            resting[name] = jnp.where(outwards, 0.0, rate)
        return rates.replace(**resting)
