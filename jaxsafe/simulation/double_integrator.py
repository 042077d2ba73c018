"""Spacecraft far from any planet: a double integrator in one, two or three dimensions."""

from __future__ import annotations

import jax.numpy as jnp

from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.cwh import SpacecraftState, ThrustedSpacecraft
from jaxsafe.types import Seconds


class DoubleIntegrator(ThrustedSpacecraft, type="double_integrator"):
    """A point mass with one thruster pair per axis and no gravity: r̈ = F/m.

    Its controls are `thrust_x` and, in the plane and in space, `thrust_y` and `thrust_z` [N].
    """

    def step(self, state: SpacecraftState, controls: Controls, dt: Seconds) -> SpacecraftState:
        """Return the state after `dt` seconds: the exact solution for constant thrust."""
        thrust = self._thrust_acceleration(controls)
        return SpacecraftState(
            position=state.position + dt * (state.velocity + 0.5 * dt * thrust),
            velocity=state.velocity + dt * thrust,
            delta_v=dt * thrust,
        )

    def derivative(self, state: SpacecraftState, controls: Controls) -> SpacecraftState:
        thrust = self._thrust_acceleration(controls)
        return SpacecraftState(
            position=state.velocity, velocity=thrust, delta_v=jnp.zeros_like(thrust)
        )
