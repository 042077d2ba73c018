"""What a filter may ask of the environment: where a control leads, how safe a state is, and the bounds of the controls.

Prediction uses the plant's own map over one step, so a certificate speaks about the very state that the step will reach.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.errors import part
from jaxsafe.simulation.controllers import Controls
from jaxsafe.types import Sim

T = TypeVar("T")
Others = Mapping[str, Any]
"""The states of all platforms but the agent's, by name."""


def advance(env: Any, sim: Sim, control: Float[Array, " m"], later: Others | None = None) -> Sim:
    """The simulation one step later under a control of the agent in physical units.

    All platforms move at once. Regions and statuses are left out. Where `others_later` is known already, give it.
    """
    platforms = {**(others_later(env, sim) if later is None else later)}
    plant = env.agent_platform
    with part("platforms", plant.name):
        platforms[env.agent] = plant.step(sim.platforms[env.agent], commanded(env, plant, sim, control), env.dt)
    return later_sim(env, sim, platforms)


def later_sim(env: Any, sim: Sim, platforms: Others) -> Sim:
    """The simulation one step later, from its platforms then. Its time is a whole number of steps, as in the plant."""
    time = sim.time + env.dt
    whole = jnp.round(time / env.dt) * env.dt
    time = jnp.where(jnp.abs(time - whole) < 1e-3 * env.dt, whole, time)
    return sim.replace(time=time, platforms=platforms, regions={}, status={})


def others_later(env: Any, sim: Sim) -> Others:
    """The platforms that are not the agent's one step later; no control of this step can change that."""
    later = {}
    for platform in env.platforms:
        if platform.name != env.agent:
            with part("platforms", platform.name):
                later[platform.name] = platform.step(sim.platforms[platform.name], undirected(platform, sim), env.dt)
    return later


def others_react(env: Any, sim: Sim) -> bool:
    """Whether any other platform looks at the agent's state, so that it moves otherwise after other controls.

    Found by tracing, so it costs nothing at run time: what looks at a mapped state is mapped itself.
    """

    def later(own: Any) -> Others:
        return others_later(env, sim.replace(platforms={**sim.platforms, env.agent: own}, regions={}, status={}))

    two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), sim.platforms[env.agent])
    try:
        jax.eval_shape(jax.vmap(later, out_axes=None), two)
    except ValueError:
        return True
    return False


def commanded(env: Any, platform: Any, sim: Sim, control: Float[Array, " m"]) -> Controls:
    """The controls of a platform: the agent's are given, the others follow their controllers."""
    if platform.name == env.agent:
        return dict(zip(env.action_names, control, strict=True))
    return undirected(platform, sim)


def undirected(platform: Any, sim: Sim) -> Controls:
    """The controls of a platform that is not the agent: no action reaches it."""
    return platform.controller.control(jnp.zeros(0), sim)


def judge(env: Any, sim: Sim, before: Sim | None = None) -> Sim:
    """Regions and statuses from the platforms alone; statuses with memory are taken as at a reset.

    With `before`, one step earlier, distances are lower bounds on the way from there, so that nothing slips through between
    two instants.
    """
    sim = sim.replace(regions={region.name: region.place(sim.platforms) for region in env.regions}, status={})
    earlier = None if before is None else judge(env, before)
    for status in env.status:
        value = status.process(status.init(sim), sim) if earlier is None else status.on_the_way(env, earlier, sim)
        sim = sim.replace(status={**sim.status, status.name: value})
    return sim


def repeat(function: Callable[[T], T], start: T, count: int) -> T:
    """A function applied over and over.

    Between two applications every number is a variable of its own. A batch of them is then contiguous, while in a batch of
    vectors XLA interleaves their elements and computes one at a time: for aircraft several times slower.
    """
    leaves, tree = jax.tree.flatten(start)
    shapes = [leaf.shape for leaf in leaves]

    def apart(whole: T) -> list[list[Array]]:
        return [list(leaf.reshape(-1)) for leaf in jax.tree.leaves(whole)]

    def together(parts: list[list[Array]]) -> T:
        return jax.tree.unflatten(tree, [jnp.stack(part).reshape(shape) for part, shape in zip(parts, shapes, strict=True)])

    parts, _ = jax.lax.scan(lambda parts, _: (apart(function(together(parts))), None), apart(start), length=count)
    return together(parts)


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
