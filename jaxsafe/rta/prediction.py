"""What a filter may ask of the environment: where a control leads, how safe a state is, and the bounds of the controls.

Prediction uses the plant's own map over one step, so a certificate speaks about the very state that the step will reach.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.errors import part
from jaxsafe.simulation.controllers import Controls
from jaxsafe.types import Sim


def advance(env: Any, sim: Sim, control: Float[Array, " m"]) -> Sim:
    """The simulation one step later under a control of the agent in physical units.

    All platforms move at once. Regions and statuses are left out.
    """
    platforms = {}
    for platform in env.platforms:
        with part("platforms", platform.name):
            controls = commanded(env, platform, sim, control)
            platforms[platform.name] = platform.step(sim.platforms[platform.name], controls, env.dt)
    return sim.replace(time=sim.time + env.dt, platforms=platforms, regions={}, status={})


def commanded(env: Any, platform: Any, sim: Sim, control: Float[Array, " m"]) -> Controls:
    """The controls of a platform: the agent's are given, the others follow their controllers."""
    if platform.name == env.agent:
        return dict(zip(env.action_names, control, strict=True))
    return platform.controller.control(jnp.zeros(0), sim)


def judge(env: Any, sim: Sim, before: Sim | None = None) -> Sim:
    """Regions and statuses from the platforms alone; statuses with memory are taken as at a reset.

    With `before`, one step earlier, distances are lower bounds on the way from there, so that nothing slips through between
    two instants.
    """
    sim = sim.replace(regions={region.name: region.place(sim.platforms) for region in env.regions}, status={})
    earlier = None if before is None else judge(env, before)
    for status in env.status:
        value = status.process(status.init(sim), sim) if earlier is None else status.on_the_way(earlier, sim)
        sim = sim.replace(status={**sim.status, status.name: value})
    return sim


def constraint(env: Any, name: str) -> Any:
    """A safety constraint by name."""
    return next(one for one in env.constraints if one.name == name)


def smallest_margin(
    env: Any, sim: Sim, before: Sim | None = None, names: Collection[str] | None = None
) -> Float[Array, ""]:
    """The smallest h of some safety constraints, None for all.

    With `before`, one step earlier, of constraints that can be broken between two instants (`Constraint.between`) a lower
    bound on the way from there counts.
    """
    now = judge(env, sim)
    way = now if before is None else judge(env, sim, before)
    chosen = [one for one in env.constraints if names is None or one.name in names]
    return jnp.min(jnp.stack([one.margin(way if one.between else now) for one in chosen]))


def bounds(env: Any) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Lowest and highest control, physical units, in action order."""
    actuators = env.agent_platform.controller.actuators
    return jnp.stack([one.low for one in actuators]), jnp.stack([one.high for one in actuators])
