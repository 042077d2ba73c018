"""Tubes about the predicted way of an aircraft in the plane.

A tube holds every way that the aircraft may take within a bound on the disturbance and on the error
of the measured state. Proposition 12 of docs/safety/proofs.md proves it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.rta.bound import Errors, UncertaintyBound
from jaxsafe.simulation.dubins import Dubins2D
from jaxsafe.types import Number, Record

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


class Tube(Record):
    """How far the true state may be from the predicted one."""

    position: Float[Array, ""]  # [ft]
    heading: Float[Array, ""]  # [rad]
    speed: Float[Array, ""]  # [ft/s]

    def velocity(self, speed: Number) -> Any:
        """Return how far the velocity vectors may be apart at a predicted speed [ft/s]."""
        return self.speed + speed * self.heading


def measured(bound: UncertaintyBound, state: Any) -> Tube:
    """Return the tube about a measured state of an aircraft."""
    return Tube(
        position=bound.position + jnp.zeros_like(state.speed),
        heading=largest_turn(bound.velocity, state.speed),
        speed=bound.velocity + jnp.zeros_like(state.speed),
    )


def after_step(
    env: Environment,
    bound: UncertaintyBound,
    tube: Tube,
    before: Any,
    after: Any,
    kept: Tube | None = None,
) -> Tube:
    """Return the tube one step later.

    Within the step the differences of heading and speed change linearly. At its end the disturbance
    has changed the velocity.

    Args:
        env: the environment.
        bound: the bound on what is not known.
        tube: the tube before the step.
        before: the predicted state before the step.
        after: the predicted state after the step.
        kept: its heading and speed are what the controls leave of the differences by the end of the
            step. None stands for the same controls on both ways.
    """
    kept = tube if kept is None else kept
    push = bound.process * env.dt
    fastest = jnp.maximum(before.speed, after.speed)
    apart = tube.velocity(fastest) + kept.velocity(fastest)
    plant = cast(Dubins2D, env.agent_platform)
    own_speed = jnp.maximum(after.speed - kept.speed, plant.speed_limits[0])
    return Tube(
        position=tube.position + 0.5 * env.dt * (apart + push),
        heading=kept.heading + largest_turn(push, own_speed),
        speed=kept.speed + push,
    )


def errors_after_delay(env: Environment, bound: UncertaintyBound) -> Errors:
    """Return the errors of the state in which the next control of an aircraft begins to act.

    Until then both ways have the same controls. A difference of the headings counts as one of the
    velocities, so it grows with the speed.
    """
    plant = cast(Dubins2D, env.agent_platform)
    slowest, fastest = plant.speed_limits
    gains = [actuator.high for actuator in env.actuators if actuator.name == "acceleration"]
    faster = jnp.asarray(1.0 + sum(gains) * env.dt / slowest)
    faster = jnp.clip(faster, 1.0, fastest / slowest)
    position = bound.position
    velocity = bound.velocity
    push = 1.02 * bound.process * env.dt  # asin is longer than the sine
    for _ in range(bound.delay):
        position = position + env.dt * (0.5 * (3.0 + faster) * velocity + 0.5 * push)
        velocity = faster * velocity + push
    return Errors(position=jnp.asarray(position), velocity=jnp.asarray(velocity))


def largest_turn(change: Number, speed: Number) -> Float[Array, ""]:
    """Return the largest angle [rad] by which a change of the velocity turns it at a speed."""
    return jnp.arcsin(jnp.minimum(change / jnp.maximum(speed, 1e-3), 1.0))
