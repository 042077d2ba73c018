"""What is proved of a speed limit that grows with the distance from a chief, for whatever numbers the environment has.

The formulas are those of docs/rta.md: how far h can fall within a step, where thrust still holds the limit, and how far a
braking craft goes. A filter asks them before it certifies anything.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.processors.constraint import SpeedLimit
from jaxsafe.processors.status import Distance, Speed, VelocityLimit
from jaxsafe.simulation.cwh import Anchor, Spacecraft
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.transition import constraint
from jaxsafe.types import Number, Record, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

LARGEST_TURN = 0.05
"""Largest angle of the chief's orbit in a step [rad] for which the expansions of docs/rta.md hold."""


class SpeedLimitFacts(Record):
    """The numbers of a speed limit ν₀ + ν₁ max(r − r₀, 0) and of the spacecraft that keeps it."""

    floor: Float[Array, ""]  # ν₀ [m/s]
    slope: Float[Array, ""]  # ν₁ [1/s]
    constant_to: Float[Array, ""]  # r₀ [m]
    mean_motion: Float[Array, ""]  # n [rad/s], positive
    weakest: Float[Array, ""]  # acceleration [m/s²] that is there in every direction, for a point mass along every axis
    strongest: Float[Array, ""]  # largest acceleration by thrust [m/s²]
    spin: Float[Array, ""]  # fastest turn of the thrust [rad/s]
    axes: Float[Array, ""]  # number of axes of a point mass
    dt: Float[Array, ""]  # length of a step [s]

    def limit(self, distance: Number) -> Any:
        """The speed limit at a distance."""
        return self.floor + self.slope * jnp.maximum(distance - self.constant_to, 0.0)

    def needed_margin(self, distance: Number) -> Any:
        """The h that both ends of a step need at least so that h ≥ 0 within it (Proposition 4)."""
        speed = self.limit(distance) * (1.0 + self.slope * self.dt)
        way = speed * self.dt
        nearest = distance - way
        apart = (nearest > self.constant_to) & (nearest > 0.0)
        dip = jnp.minimum(way, jnp.where(apart, way**2 / (4.0 * jnp.where(apart, nearest, 1.0)), way))
        return self._needed(distance + way, speed, dip)

    @property
    def least_margin(self) -> Any:
        """`needed_margin` near the chief, where a step may pass through the least limit."""
        near = 2.0 * self.floor * self.dt + self.constant_to
        speed = (self.floor + 2.0 * self.slope * self.floor * self.dt) * (1.0 + self.slope * self.dt)
        return self._needed(near, speed, speed * self.dt)

    def _needed(self, distance: Any, speed: Any, dip: Any) -> Any:
        n, dt = self.mean_motion, self.dt
        held = 0.5 * dt * (self.slope + 2.0 * n)
        turning = held + 0.5 * dt * self.spin
        drift = 3.0 * n**2 * speed + self.spin * n * (3.0 * n * distance + 2.0 * speed)
        bend = held * self.slope * speed * dt + turning**2 * speed / 2.0 + 0.5 * dt**2 * drift
        return bend / 4.0 + self.slope * dip / 2.0

    def room(self, distance: Number, margin: Number) -> Any:
        """What a point mass that brakes has left [m/s²] at a distance, where h is `margin` (Proposition 3).

        Where it is positive, a step of braking keeps h at `margin` or above.
        """
        n, dt, speed = self.mean_motion, self.dt, self.limit(distance)
        steepest = jnp.maximum(3.0 * n**2, self.slope**2 + jnp.where(self.axes > 2, n**2, 0.0))
        tide, push = 3.0 * n**2 * distance, self.strongest
        second = (n * dt) ** 2 * (4.0 * n * distance + 2.0 * speed + push * dt)
        second += 0.5 * self.slope * dt**2 * (tide + 2.0 * n * speed + push)
        second += (tide * dt) ** 2 / (2.0 * jnp.maximum(speed - margin, 1e-6))
        inwards = self.slope * jnp.maximum(self.floor - margin, self.slope * self.constant_to)
        return self.weakest - inwards - steepest * distance - second / dt

    def farthest(self, distance: Number, speed: Number) -> Any:
        """How far from the chief a braking point mass is at most until it stops; infinite if it may never."""
        n, dt = self.mean_motion, self.dt
        tide = 3.0 * n**2
        slowing = 0.99 * self.weakest - tide * distance - n**2 * dt * (8.0 * n * distance + 4.0 * speed)
        root = slowing**2 - tide * speed**2
        stops = (slowing > 0.0) & (root > 0.0)
        way = speed**2 / jnp.where(stops, slowing + jnp.sqrt(jnp.where(stops, root, 1.0)), 1.0)
        return jnp.where(stops, distance + way + speed * dt, jnp.inf)


def speed_limit_facts(env: Environment, name: str) -> SpeedLimitFacts | None:
    """The facts of a constraint; None where it, the plant or the chief is of a kind that nothing is proved of."""
    limited = constraint(env, name)
    plant: Any = env.agent_platform
    kind = type(plant)
    if type(limited) is not SpeedLimit or kind not in (Spacecraft, OrientedSpacecraft):
        return None
    statuses = {status.name: status for status in env.status}
    speed, limit = statuses[limited.speed], statuses[limited.velocity_limit]
    if type(speed) is not Speed or speed.of != env.agent or type(limit) is not VelocityLimit:
        return None
    distance = statuses[limit.distance]
    if type(distance) is not Distance or chief(env, distance) is None:
        return None
    pushes = plant.inputs if kind is Spacecraft else plant.inputs[:1]
    actuators = {one.name: one for one in env.actuators}
    if not set(plant.inputs) <= set(actuators):
        return None
    weakest = jnp.min(jnp.stack([jnp.minimum(-actuators[one].low, actuators[one].high) for one in pushes]))
    strongest = jnp.max(jnp.stack([jnp.maximum(-actuators[one].low, actuators[one].high) for one in pushes]))
    still = jnp.zeros_like(env.dt)
    spin = still if kind is Spacecraft else jnp.max(jnp.abs(plant.attitude_rate_limits))
    return SpeedLimitFacts(
        floor=limit.floor,
        slope=limit.slope,
        constant_to=limit.constant_to,
        mean_motion=jnp.abs(plant.mean_motion),
        weakest=jnp.maximum(weakest, 0.0) / plant.mass,
        strongest=strongest * len(pushes) ** 0.5 / plant.mass,
        spin=spin,
        axes=still + len(pushes),
        dt=env.dt,
    )


def chief(env: Environment, distance: Distance) -> str | None:
    """The platform at rest from which a distance of the agent is measured; None if there is none."""
    others = {distance.of, distance.to} - {env.agent}
    if len(others) != 1 or env.agent not in (distance.of, distance.to):
        return None
    (other,) = others
    return other if type(env.platform(other)) is Anchor else None


def distance_and_speed(env: Environment, sim: Sim) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Distance from the origin of Hill's frame, and speed, of the agent."""
    own = sim.platforms[env.agent]
    return safe_norm(own.position), safe_norm(own.velocity)


def off_centre(env: Environment, sim: Sim) -> Any:
    """Whether a platform that rests is elsewhere than at the origin of Hill's frame, where it would not rest."""
    resting = [sim.platforms[one.name].position for one in env.platforms if type(one) is Anchor]
    return jnp.any(jnp.stack([jnp.any(position != 0.0) for position in resting]))
