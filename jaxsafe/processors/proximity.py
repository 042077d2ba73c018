"""Statuses and constraints of spacecraft near another: room to brake, and drift without thrust."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.processors.constraint import Constraint
from jaxsafe.processors.status import Status
from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.cwh import MEAN_MOTION, MeanMotion, cwh_flow
from jaxsafe.simulation.geometry import closest_approach, safe_norm
from jaxsafe.types import (
    Extent,
    Length,
    Number,
    PlaceName,
    PlatformName,
    Positive,
    Seconds,
    Sim,
    place,
)

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


class BrakingDistance(Constraint, type="braking_distance"):
    """Room to stop before a sphere around another platform or a region's centre: h = d − c²/2a.

    d is the distance to the sphere, c the speed towards it, or 0 if the platform moves away, and a
    the `deceleration`. So h ≥ 0 is c ≤ √(2ad), as in Dunlap, van Wijk and Hobbs, arXiv:2302.02885.
    The platform stays outside of the sphere, or inside of it.
    """

    of: PlaceName
    to: PlaceName
    radius: Annotated[Length, Extent]
    stay: Literal["outside", "inside"] = "outside"
    deceleration: Annotated[Number, Unit("m/s² or ft/s²"), Positive]

    def margin(self, sim: Sim) -> Float[Array, ""]:
        own = place(sim, self.of)
        other = place(sim, self.to)
        apart = own.position - other.position
        distance = safe_norm(apart)
        outwards = jnp.sum(apart * (own.velocity - other.velocity))
        outwards = outwards / jnp.where(distance > 0.0, distance, 1.0)
        sign = 1.0 if self.stay == "outside" else -1.0
        closing = jnp.maximum(-sign * outwards, 0.0)
        return sign * (distance - self.radius) - closing**2 / (2.0 * self.deceleration)

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return self.radius


class DriftDistance(Status, type="drift_distance"):
    """Lower bound of the least distance to an anchor in the next `duration` seconds without thrust.

    Instead of an anchor it may be the centre of a region at rest. A separation of this status makes
    a spacecraft passively safe, as in Dunlap, van Wijk and Hobbs, arXiv:2302.02885. The drift is
    the closed form of Clohessy-Wiltshire motion. The result is the smallest distance on the
    straight lines between `samples` + 1 instants, less what the drift may bend between two of them
    (Proposition 10 of docs/safety/proofs.md).
    """

    of: PlatformName
    to: PlaceName
    duration: Seconds
    samples: Annotated[int, Range(1, largest=1000)] = 60
    mean_motion: MeanMotion = MEAN_MOTION
    """Mean motion n of the orbit, the same as that of the platform `of`."""

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        places, _ = self._drift(sim)
        nearest = jnp.min(jax.vmap(closest_approach)(places[:-1], places[1:]))
        return nearest - self._acceleration(sim) * self._interval**2 / 8.0

    def on_the_way(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, ""]:
        first, first_speeds = self._drift(before)
        last, last_speeds = self._drift(sim)
        interval = self._interval
        # `nearest` is how near the places of the drift come while the state moves from one end of
        # the step to the other. `reach` is how far the drift gets in half an interval, so it covers
        # the time between two of its instants.
        reach = jnp.maximum(first_speeds, last_speeds) * interval / 2.0
        nearest = jnp.min(jax.vmap(closest_approach)(first, last) - reach)
        acceleration = jnp.maximum(self._acceleration(before), self._acceleration(sim))
        return nearest - acceleration * interval**2 / 8.0 - self._bend(env, before, sim)

    @property
    def _interval(self) -> Number:
        return self.duration / self.samples

    def _drift(self, sim: Sim) -> tuple[Float[Array, "n d"], Float[Array, " n"]]:
        """Return the places relative to the anchor and the speeds at the instants of the drift."""
        own = sim.platforms[self.of]
        still = jnp.zeros_like(own.position)
        times = jnp.linspace(0.0, 1.0, self.samples + 1) * self.duration

        def at(time: Number) -> tuple[Array, Array]:
            return cwh_flow(r=own.position, v=own.velocity, a=still, n=self.mean_motion, t=time)

        places, velocities = jax.vmap(at)(times)
        return places - place(sim, self.to).position, safe_norm(velocities)

    def _acceleration(self, sim: Sim) -> Float[Array, ""]:
        """Return the largest acceleration [m/s²] of the drift, whose path is a moving ellipse."""
        own = sim.platforms[self.of]
        n = self.mean_motion
        r = own.position
        v = own.velocity
        ellipse = [2.0 * (3.0 * n * r[0] + 2.0 * v[1]), 2.0 * v[0]]
        across = [n * r[2], v[2]] if r.shape[0] == 3 else []
        return jnp.abs(n) * safe_norm(jnp.stack(ellipse + across))

    def _bend(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, ""]:
        """Return how far a place of the drift may leave its chord while the state moves a step."""
        plant = env.platform(self.of)
        first = before.platforms[self.of]
        last = sim.platforms[self.of]
        dt = sim.time - before.time
        n = jnp.abs(self.mean_motion)
        change = safe_norm(last.velocity - first.velocity)
        speed = jnp.maximum(safe_norm(first.velocity), safe_norm(last.velocity))
        # 1.1 covers the change of the acceleration within the step.
        of_velocity = 1.1 * (3.0 * n**2 * speed * dt + 2.0 * n * change) * dt / 8.0
        angle = n * self.duration
        of_place = (1.0 + 1.5 * angle**2 + angle**3) * plant.bend(first, last, dt)
        return of_place + self.duration * (1.0 + angle + angle**2) * of_velocity
