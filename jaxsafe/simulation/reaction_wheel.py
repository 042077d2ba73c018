"""An oriented spacecraft whose reaction wheel has a speed of its own, Eqs. (18)-(20)."""

from __future__ import annotations

from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.oriented import OrientedSpacecraft, OrientedState
from jaxsafe.types import Number, Seconds

Inertia = Annotated[Number, Unit("kg·m²"), Range(0.0, open_low=True, smallest=1e-12, largest=1e12)]
"""Moment of inertia about an axis [kg·m²]."""


class ReactionWheelState(OrientedState):
    """State of an oriented spacecraft and its reaction wheel."""

    wheel_speed: Annotated[Float[Array, ""], Unit("rad/s")]  # ψ, relative to the spacecraft


class ReactionWheelSpacecraft(OrientedSpacecraft, type="reaction_wheel_spacecraft"):
    """A spacecraft in the plane that turns by a reaction wheel, I_zz θ̈ = −D ψ̇, Eq. (18).

    Its controls are `thrust` [N] along the body axis and `wheel_acceleration` ψ̇ [rad/s²]. The
    wheel's speed ψ is a state. Where the wheel or the body reaches its limit, the wheel keeps its
    speed for the rest of the step, and so does the body. I_zz θ̇ + D ψ never changes.

    Instead of the wheel's acceleration it may be given that of the body, `attitude_acceleration` θ̈
    [rad/s²], as for `oriented_spacecraft`. The wheel's acceleration is then −I_zz θ̈/D.

    The inertias are those of the 6U CubeSat of the published code, whose wheel turns at 576 rad/s
    at most.
    """

    inertia: Inertia = 0.0573
    wheel_inertia: Inertia = 4.1e-5
    wheel_speed_limits: (
        Annotated[Number, Unit("rad/s", length=2), Range(largest=1e6, infinite=True)] | None
    ) = None

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("thrust", "wheel_acceleration", "attitude_acceleration")

    def rest(self) -> ReactionWheelState:
        oriented = super().rest()
        return ReactionWheelState(**vars(oriented), wheel_speed=jnp.zeros_like(oriented.attitude))

    def step(self, state: Any, controls: Controls, dt: Seconds) -> ReactionWheelState:
        """Return the state after `dt` seconds: that of a body which turns by the wheel's torque."""
        body = OrientedSpacecraft.step(self._limited(state), state, self._turning(controls), dt)
        turned = body.attitude_rate - state.attitude_rate
        wheel_speed = state.wheel_speed - self._ratio * turned
        if self.wheel_speed_limits is not None:
            low, high = self.wheel_speed_limits
            wheel_speed = jnp.clip(
                wheel_speed,
                jnp.minimum(low, state.wheel_speed),
                jnp.maximum(high, state.wheel_speed),
            )
        return ReactionWheelState(**vars(body), wheel_speed=wheel_speed)

    def derivative(self, state: Any, controls: Controls) -> ReactionWheelState:
        """Return the right-hand side of Eqs. (18) and (20), which holds within the limits."""
        body = super().derivative(state, self._turning(controls))
        return ReactionWheelState(**vars(body), wheel_speed=-self._ratio * body.attitude_rate)

    @property
    def _ratio(self) -> Number:
        """I_zz/D: the wheel turns that many times faster than the body."""
        return self.inertia / self.wheel_inertia

    def _turning(self, controls: Controls) -> Controls:
        """Return the controls with the body's acceleration −D ψ̇/I_zz in place of the wheel's."""
        if "wheel_acceleration" not in controls:
            return controls
        return {**controls, "attitude_acceleration": -controls["wheel_acceleration"] / self._ratio}

    def _limited(self, state: Any) -> ReactionWheelSpacecraft:
        """Return this spacecraft with the attitude rates that the wheel's limits leave."""
        if self.wheel_speed_limits is None:
            return self
        low, high = self.wheel_speed_limits
        rate = state.attitude_rate
        lowest = rate - jnp.maximum(high - state.wheel_speed, 0.0) / self._ratio
        highest = rate + jnp.maximum(state.wheel_speed - low, 0.0) / self._ratio
        limits = jnp.stack(
            [
                jnp.maximum(lowest, self.attitude_rate_limits[0]),
                jnp.minimum(highest, self.attitude_rate_limits[1]),
            ]
        )
        return self.replace(attitude_rate_limits=limits)
