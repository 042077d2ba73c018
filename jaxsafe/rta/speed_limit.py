"""Formulas that are proved for a speed limit that grows with the distance from a chief.

They hold for whatever numbers the environment has, and docs/safety/proofs.md proves them. They say
how far h can fall within a step, where thrust still holds the limit, and how far a braking
spacecraft goes. A filter asks them before it certifies anything.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.processors.constraint import SpeedLimit
from jaxsafe.processors.status import Distance, Speed, VelocityLimit
from jaxsafe.simulation.cwh import Anchor, Spacecraft
from jaxsafe.simulation.double_integrator import DoubleIntegrator
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.transition import constraint
from jaxsafe.types import Number, Record, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

MAX_ORBIT_ANGLE_PER_STEP = 0.05
"""Largest angle of the chief's orbit in a step [rad] for which the proofs' series hold."""

_POINT_MASSES = (Spacecraft, DoubleIntegrator)
"""Platforms with a thruster pair per axis. A double integrator moves as at a mean motion of 0."""


class SpeedLimitFacts(Record):
    """Numbers of a speed limit ν₀ + ν₁ max(r − r₀, 0) and of the spacecraft that keeps it."""

    floor: Float[Array, ""]  # ν₀ [m/s]
    slope: Float[Array, ""]  # ν₁ [1/s]
    constant_to: Float[Array, ""]  # r₀ [m]
    mean_motion: Float[Array, ""]  # n [rad/s], not negative; 0 without gravity
    weakest: Float[Array, ""]  # least acceleration by thrust of any axis and direction [m/s²]
    strongest: Float[Array, ""]  # largest acceleration by thrust [m/s²]
    spin: Float[Array, ""]  # highest rate at which the thrust turns [rad/s]
    axes: Float[Array, ""]  # number of axes of a point mass
    mass: Float[Array, ""]  # m [kg]
    dt: Float[Array, ""]  # length of a step [s]

    def limit(self, distance: Number) -> Any:
        """Return the speed limit [m/s] at a distance [m]."""
        return self.floor + self.slope * jnp.maximum(distance - self.constant_to, 0.0)

    def needed_margin(self, distance: Number) -> Any:
        """Return the least h [m/s] at both ends of a step with which h ≥ 0 within the step.

        This is Proposition 4 of docs/safety/proofs.md, for a step from a distance [m].
        """
        speed = self.limit(distance) * (1.0 + self.slope * self.dt)
        way = speed * self.dt
        nearest = distance - way
        apart = (nearest > self.constant_to) & (nearest > 0.0)
        dip = jnp.minimum(
            way, jnp.where(apart, way**2 / (4.0 * jnp.where(apart, nearest, 1.0)), way)
        )
        return self._needed(distance + way, speed, dip)

    @property
    def least_margin(self) -> Any:
        """Needed margin [m/s] near the chief, where a step may pass through the least limit."""
        near = 2.0 * self.floor * self.dt + self.constant_to
        speed = (self.floor + 2.0 * self.slope * self.floor * self.dt) * (
            1.0 + self.slope * self.dt
        )
        return self._needed(near, speed, speed * self.dt)

    def _needed(self, distance: Any, speed: Any, dip: Any) -> Any:
        """Return the margin of Proposition 4.

        In its terms `held` is c₀, `turning` is c and dt² · `drift` / 2 is E.

        Args:
            distance: largest distance ‖r‖ on the step [m].
            speed: largest speed limit V on the step [m/s].
            dip: twice how far the distance may fall below the line between its ends [m].
        """
        n = self.mean_motion
        dt = self.dt
        held = 0.5 * dt * (self.slope + 2.0 * n)
        turning = held + 0.5 * dt * self.spin
        drift = 3.0 * n**2 * speed + self.spin * n * (3.0 * n * distance + 2.0 * speed)
        bend = held * self.slope * speed * dt + turning**2 * speed / 2.0 + 0.5 * dt**2 * drift
        return bend / 4.0 + self.slope * dip / 2.0

    def room(self, distance: Number, margin: Number) -> Any:
        """Return the acceleration [m/s²] that a braking point mass has to spare (Proposition 3).

        Where it is positive, a step of braking from h = `margin` keeps h at `margin` or above.

        Args:
            distance: the distance from the chief [m].
            margin: h at the beginning of the step [m/s].
        """
        n = self.mean_motion
        dt = self.dt
        speed = self.limit(distance)
        steepest = jnp.maximum(3.0 * n**2, self.slope**2 + jnp.where(self.axes > 2, n**2, 0.0))
        tide = 3.0 * n**2 * distance
        push = self.strongest
        second_order = (n * dt) ** 2 * (4.0 * n * distance + 2.0 * speed + push * dt)
        second_order += 0.5 * self.slope * dt**2 * (tide + 2.0 * n * speed + push)
        second_order += (tide * dt) ** 2 / (2.0 * jnp.maximum(speed - margin, 1e-6))
        inwards = self.slope * jnp.maximum(self.floor - margin, self.slope * self.constant_to)
        return self.weakest - inwards - steepest * distance - second_order / dt

    def farthest(self, distance: Number, speed: Number) -> Any:
        """Return the largest distance [m] from the chief that a braking point mass reaches.

        It is infinite if the point mass may never stop.

        Args:
            distance: the distance from the chief at the beginning [m].
            speed: the speed at the beginning [m/s].
        """
        n = self.mean_motion
        dt = self.dt
        tide = 3.0 * n**2
        slowing = (
            0.99 * self.weakest - tide * distance - n**2 * dt * (8.0 * n * distance + 4.0 * speed)
        )
        root = slowing**2 - tide * speed**2
        stops = (slowing > 0.0) & (root > 0.0)
        way = speed**2 / jnp.where(stops, slowing + jnp.sqrt(jnp.where(stops, root, 1.0)), 1.0)
        return jnp.where(stops, distance + way + speed * dt, jnp.inf)


def speed_limit_facts(env: Environment, name: str) -> SpeedLimitFacts | None:
    """Return the facts of a speed limit, or None if nothing is proved of it.

    None is returned if the constraint, the plant or the chief is of another class than in the
    proofs, or if the agent does not have all actuators.
    """
    limited = constraint(env, name)
    plant: Any = env.agent_platform
    plant_class = type(plant)
    if type(limited) is not SpeedLimit or plant_class not in (*_POINT_MASSES, OrientedSpacecraft):
        return None
    statuses = {status.name: status for status in env.status}
    speed = statuses[limited.speed]
    limit = statuses[limited.velocity_limit]
    if type(speed) is not Speed or speed.of != env.agent or type(limit) is not VelocityLimit:
        return None
    distance = statuses[limit.distance]
    if type(distance) is not Distance or chief(env, distance) is None:
        return None
    actuators = {actuator.name: actuator for actuator in env.actuators}
    if not set(plant.inputs) <= set(actuators):
        return None
    pushes = plant.inputs if plant_class in _POINT_MASSES else plant.inputs[:1]
    thrusters = [actuators[push] for push in pushes]
    weakest = jnp.min(
        jnp.stack([jnp.minimum(-thruster.low, thruster.high) for thruster in thrusters])
    )
    strongest = jnp.max(
        jnp.stack([jnp.maximum(-thruster.low, thruster.high) for thruster in thrusters])
    )
    zero = jnp.zeros_like(env.dt)
    spin = zero if plant_class in _POINT_MASSES else jnp.max(jnp.abs(plant.attitude_rate_limits))
    return SpeedLimitFacts(
        floor=limit.floor,
        slope=limit.slope,
        constant_to=limit.constant_to,
        mean_motion=zero if plant_class is DoubleIntegrator else jnp.abs(plant.mean_motion),
        weakest=jnp.maximum(weakest, 0.0) / plant.mass,
        strongest=strongest * len(pushes) ** 0.5 / plant.mass,
        spin=spin,
        axes=zero + len(pushes),
        mass=plant.mass,
        dt=env.dt,
    )


def lowered(env: Environment, name: str, by: Number) -> Environment:
    """Return the environment with a lower speed limit.

    Args:
        env: the environment.
        name: the name of the constraint.
        by: what is subtracted from the limit [m/s].
    """
    limited = constraint(env, name)
    assert isinstance(limited, SpeedLimit)
    statuses = tuple(
        status.replace(floor=status.floor - by)
        if isinstance(status, VelocityLimit) and status.name == limited.velocity_limit
        else status
        for status in env.status
    )
    return env.replace(status=statuses)


def chief(env: Environment, distance: Distance) -> str | None:
    """Return the name of the anchor that a distance of the agent is measured from, or None."""
    others = {distance.of, distance.to} - {env.agent}
    if len(others) != 1 or env.agent not in (distance.of, distance.to):
        return None
    (other,) = others
    return other if type(env.platform(other)) is Anchor else None


def distance_and_speed(env: Environment, sim: Sim) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the agent's distance from the origin of Hill's frame [m] and its speed [m/s]."""
    own = sim.platforms[env.agent]
    return safe_norm(own.position), safe_norm(own.velocity)


def off_centre(env: Environment, sim: Sim) -> Any:
    """Return whether an anchor is elsewhere than at the origin of Hill's frame.

    The proofs take the chief to be at the origin, because a spacecraft elsewhere would not stay at
    rest.
    """
    anchors = [platform.name for platform in env.platforms if type(platform) is Anchor]
    displaced = [jnp.any(sim.platforms[name].position != 0.0) for name in anchors]
    return jnp.any(jnp.stack(displaced))
