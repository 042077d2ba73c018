"""Control law for rejoin: pursuit of the rejoin point, and formation hold."""

from __future__ import annotations

from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.control.law import ControlLaw, wrong_controls
from jaxsafe.control.observed import Needs
from jaxsafe.environment import Environment
from jaxsafe.schema.component import Range, Unit
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.simulation.trig import arctan, wrap
from jaxsafe.types import (
    Length,
    Number,
    PerSecond,
    PlatformName,
    Positive,
    RegionName,
    Seconds,
    Sim,
)


class Pursuit(ControlLaw, type="pursuit"):
    """Pursuit of a region that moves with a lead, and then formation hold.

    The desired velocity is the lead's plus `gain` times d, where d is the vector to the region's
    centre. The second part is at most `closing`. So the error decays like exp(−`gain` t) once it is
    small. Far away the agent closes in at a constant speed, on a course near that of the lead. In
    the plane the agent takes the desired heading and speed as fast as its bounds allow.

    In space it banks for the turn e/`response`, where e is the error of the heading, and takes the
    desired flight path angle. It flies around the lead at the distance `clearance`: towards it the
    speed is at most `yielding` times the distance that is left.

    The numbers are chosen by hand. The paper observes no distance beyond 1000 ft, and 1000 ft times
    `gain` is `closing`. So the law returns the same control from the observation as from the whole
    state.
    """

    lead: PlatformName = "lead"
    region: RegionName = "rejoin_region"
    gain: Annotated[PerSecond, Positive] = 0.15
    closing: Annotated[Number, Unit("ft/s"), Positive] = 150.0
    clearance: Annotated[Length, Range(0.0)] = 300.0
    yielding: Annotated[PerSecond, Positive] = 0.22
    response: Seconds = 4.0

    def needs(self, env: Environment) -> Needs:
        plant = env.agent_platform
        if not isinstance(plant, Dubins2D | Dubins3D):
            raise ConfigError(
                f"controller: pursuit flies dubins2d and dubins3d; {env.agent} is a "
                f"{plant.type_name}"
            )
        in_space = isinstance(plant, Dubins3D)
        turns = ("roll_rate", "flight_path_angle_rate") if in_space else ("heading_rate",)
        controls = (*turns, "acceleration")
        if not {*env.action_names} <= {*controls}:
            raise wrong_controls(env, self, controls)
        regions = [region.name for region in env.regions]
        others = [other.name for other in env.platforms if other.name != env.agent]
        for name, names in ((self.region, regions), (self.lead, others)):
            if name not in names:
                existing = ", ".join(names) or "none"
                raise ConfigError(f"controller: pursuit follows {name!r}; there is {existing}")
        angles = ("roll", "flight_path_angle") if in_space else ()
        own = [(env.agent, what) for what in ("velocity", *angles)]
        return [
            *own,
            *((self.lead, what) for what in ("position", "velocity")),
            (self.region, "position"),
        ]

    def control(self, env: Environment, design: Any, sim: Sim) -> Float[Array, " m"]:
        own = sim.platforms[env.agent]
        plant = env.agent_platform
        way = sim.regions[self.region].position - own.position
        lead = sim.platforms[self.lead]
        change = self.gain * way
        change *= jnp.minimum(1.0, self.closing / jnp.maximum(safe_norm(change), 1e-6))
        desired = lead.velocity + self._around(change, lead.position - own.position)
        course = jnp.arctan2(desired[1], desired[0])
        error = wrap(course - own.heading, -jnp.pi, 2.0 * jnp.pi)
        controls = {"acceleration": (safe_norm(desired) - own.speed) / env.dt}
        if isinstance(plant, Dubins3D):
            lowest, highest = plant.roll_limits
            bank = arctan(own.speed * error / (self.response * plant.gravity))
            climb = jnp.arctan2(-desired[2], safe_norm(desired[:2]))
            controls["roll_rate"] = (jnp.clip(bank, lowest, highest) - own.roll) / env.dt
            controls["flight_path_angle_rate"] = (climb - own.flight_path_angle) / env.dt
        else:
            controls["heading_rate"] = error / env.dt
        return jnp.stack([controls[name] for name in env.action_names])

    def _around(
        self, change: Float[Array, " d"], to_lead: Float[Array, " d"]
    ) -> Float[Array, " d"]:
        """Return `change`, a velocity relative to the lead, turned aside if it leads into the lead.

        The speed towards the lead is at most `yielding` · (distance − `clearance`). Where that cuts
        it, the speed across grows instead, so that the whole speed stays the same.
        """
        distance = safe_norm(to_lead)
        towards = to_lead / jnp.maximum(distance, 1e-6)
        inwards = jnp.sum(change * towards)
        allowed = jnp.minimum(inwards, self.yielding * (distance - self.clearance))
        across = change - inwards * towards
        size = jnp.sqrt(jnp.maximum(jnp.sum(change * change) - allowed**2, 0.0))
        across *= size / jnp.maximum(safe_norm(across), 1e-6)
        return jnp.where(allowed < inwards, allowed * towards + across, change)
