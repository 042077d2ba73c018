"""How the world moves by one step, and how a state is judged.

The environment steps with these functions, and its filters predict with them. So a certificate
speaks about the very state that the step will reach.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Component
from jaxsafe.schema.dotted_paths import references
from jaxsafe.schema.errors import part
from jaxsafe.simulation.between import regions_on_the_way
from jaxsafe.simulation.controllers import Controls
from jaxsafe.types import RefersInDetail, RegionState, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment
    from jaxsafe.processors.constraint import Constraint
    from jaxsafe.simulation.platform import Platform
    from jaxsafe.simulation.regions import Region

Others = Mapping[str, Any]
"""The states of all platforms but the agent's, by name."""


def advance(
    env: Environment, sim: Sim, control: Float[Array, " m"], later: Others | None = None
) -> Sim:
    """Return the simulation one step later. All platforms move at once.

    Regions and statuses are left out. The control is that of the step, both as desired and as
    actual.

    Args:
        env: the environment.
        sim: the simulation before the step.
        control: the agent's control in physical units, in action order.
        later: the other platforms after the step, if `others_later` has already computed them.
    """
    platforms = {**(others_later(env, sim) if later is None else later)}
    plant = env.agent_platform
    with part("platforms", plant.name):
        controls, actuators = driven(env, sim, control)
        platforms[env.agent] = plant.step(sim.platforms[env.agent], controls, env.dt)
    later_world = later_sim(env, sim, platforms)
    later_world = later_world.replace(
        actuators=actuators, control_desired=control, control_actual=control
    )
    return remember(env, sim, later_world, env.dt)


def later_sim(env: Environment, sim: Sim, platforms: Others) -> Sim:
    """Return the simulation one step later, given its platforms then.

    A time close to a whole number of steps is rounded to it. Regions and statuses are left out, and
    the controls are those of `sim`.
    """
    time = sim.time + env.dt
    whole = jnp.round(time / env.dt) * env.dt
    time = jnp.where(jnp.abs(time - whole) < 1e-3 * env.dt, whole, time)
    return sim.replace(time=time, platforms=platforms, regions={}, status={})


def others_later(env: Environment, sim: Sim) -> Others:
    """Return the states of all platforms but the agent's one step later, by name.

    The agent's control in this step cannot change them.
    """
    later = {}
    for platform in env.platforms:
        if platform.name != env.agent:
            with part("platforms", platform.name):
                later[platform.name] = platform.step(
                    sim.platforms[platform.name], undirected(platform, sim), env.dt
                )
    return later


def commanded(
    env: Environment, platform: Platform, sim: Sim, control: Float[Array, " m"]
) -> Controls:
    """Return the controls of a platform by name.

    Args:
        env: the environment.
        platform: the platform.
        sim: the simulation.
        control: the agent's control in physical units, in action order. The other platforms follow
            their own controllers.
    """
    if platform.name == env.agent:
        return dict(zip(env.action_names, control, strict=True))
    return undirected(platform, sim)


def driven(
    env: Environment, sim: Sim, control: Float[Array, " m"]
) -> tuple[Controls, Mapping[str, Float[Array, ""]]]:
    """Return what the agent's plant receives over a step, and what its actuators give after it.

    Both are in physical units, by name. The second holds only actuators with a lag or a rate limit.

    Args:
        env: the environment.
        sim: the simulation before the step.
        control: the agent's control in physical units, in action order.
    """
    controls = dict(commanded(env, env.agent_platform, sim, control))
    after = {}
    for actuator in env.actuators:
        if not actuator.at_once:
            name = actuator.name
            controls[name], after[name] = actuator.follow(
                sim.actuators[name], controls[name], env.dt
            )
    return controls, after


def undirected(platform: Platform, sim: Sim) -> Controls:
    """Return the controls, by name, of a platform other than the agent's. No action reaches it."""
    return platform.controller.control(jnp.zeros(0), sim)


def place_regions(env: Environment, sim: Sim) -> Sim:
    """Return the simulation with its regions where the platforms put them."""
    regions: dict[str, RegionState] = {}
    moving, measured, related = _in_detail(env)

    def put(region: Region, guests: Mapping[str, RegionState]) -> None:
        with part("regions", region.name):
            regions[region.name] = region.place(
                {**sim.platforms, **guests},
                regions,
                moves=region.name in moving,
                measures=region.name in measured,
            )

    for region in env.regions:
        put(region, {})
    for region in env.regions:
        if names := related.get(region.name):
            put(region, {name: regions[name] for name in names})
    return sim.replace(regions=regions)


def with_centres(env: Environment, sim: Sim, platform: Platform) -> Sim:
    """Return the simulation with the centres of regions, if the start of a platform names some.

    Args:
        env: the environment.
        sim: the simulation with the platforms that are placed before this one.
        platform: the platform.
    """
    named = {name for _, refers, name in references(platform, "") if refers.section == "places"}
    if named <= sim.platforms.keys():
        return sim
    # Where a region stays in place, only the dimension of the platforms matters.
    platforms = {other.name: other.rest() for other in env.platforms} | {**sim.platforms}
    regions: dict[str, RegionState] = {}
    for region in regions_so_far(env, sim.platforms):
        with part("regions", region.name):
            placed = region.place(platforms, regions, moves=True)
        regions[region.name] = placed.replace(inside={})
    return sim.replace(regions=regions)


def regions_so_far(env: Environment, platforms: Container[str]) -> list[Region]:
    """Return the regions that some platforms carry, or that stay in place.

    Args:
        env: the environment.
        platforms: the names of the platforms.
    """
    found: dict[str, Region] = {}
    for region in env.regions:
        if region.on is None or region.on in platforms or region.on in found:
            found[region.name] = region
    return [*found.values()]


def _in_detail(env: Environment) -> tuple[set[str], set[str], Mapping[str, list[str]]]:
    """Return the regions for which some part needs more than position and content.

    Returns:
        The regions whose motion, and those whose distances, are named by some part. The last is,
        by region, the other regions whose centres it relates to: those that one part names
        together with it.
    """
    if not env.regions:
        return set(), set(), {}
    named = [found for found in references(env, "") if found[1].section in ("places", "regions")]
    detailed = [found for found in named if isinstance(found[1], RefersInDetail)]
    moving = {name for _, refers, name in detailed if refers.section == "places"}
    measured = {name for _, refers, name in detailed if refers.section == "regions"}
    names = {region.name for region in env.regions} - {platform.name for platform in env.platforms}
    of_part: dict[str, tuple[set[str], set[str]]] = {}
    for where, refers, name in named:
        if name in names:
            places, regions = of_part.setdefault(where.rpartition(".")[0], (set(), set()))
            (places if refers.section == "places" else regions).add(name)
    related: dict[str, set[str]] = {}
    for places, regions in of_part.values():
        for region in regions:
            related.setdefault(region, set()).update(places - {region})
    return moving, measured, {region: sorted(others) for region, others in related.items()}


def update_statuses(
    env: Environment, sim: Sim, memory: Mapping[str, Any], duration: Any = None
) -> tuple[Sim, dict[str, Any]]:
    """Place the regions, then compute the statuses in order.

    Each status sees only those before it.

    Args:
        env: the environment.
        sim: the simulation, with its platforms.
        memory: what the statuses remember from the step before, by name. Statuses that have no
            entry begin anew, as all do at the start of an episode.
        duration: length of the step [s]. None stands for `env.dt`.

    Returns:
        The simulation with regions and statuses, and what the statuses remember now.
    """
    duration = env.dt if duration is None else duration
    sim = place_regions(env, sim)
    memories = {}
    for status in env.status:
        with part("status", status.name):
            own = (
                status.increment(memory[status.name], sim, duration)
                if status.name in memory
                else status.init(sim)
            )
            sim = sim.replace(status={**sim.status, status.name: status.process(own, sim)})
        memories[status.name] = own
    return sim, memories


def with_memory(env: Environment, sim: Sim, memory: Mapping[str, Any]) -> Sim:
    """Return the simulation with what a prediction must know of the steps before it.

    That is the memory of every status on which a safety constraint rests.

    Args:
        env: the environment.
        sim: the simulation.
        memory: what the statuses remember, by name.
    """
    names = remembering_statuses(env)
    return sim.replace(remembered={name: memory[name] for name in names})


def remembering_statuses(env: Environment, constraints: Sequence[str] | None = None) -> list[str]:
    """Return the names of the statuses with memory on which some safety constraints rest.

    Args:
        env: the environment.
        constraints: names of the constraints. None stands for all.
    """
    chosen = [item for item in env.constraints if constraints is None or item.name in constraints]
    needed = set(status_names(chosen))
    for status in reversed(env.status):
        if status.name in needed:
            needed.update(status_names([status]))
    return [status.name for status in env.status if status.name in needed and status.remembers]


def remember(env: Environment, before: Sim, sim: Sim, duration: Any) -> Sim:
    """Return the simulation with what its statuses remember after a predicted step.

    Args:
        env: the environment.
        before: the simulation before the step.
        sim: the simulation after the step.
        duration: length of the step [s].
    """
    if not before.remembered:
        return sim
    memories = update_statuses(env, sim.replace(status={}), before.remembered, duration)[1]
    return sim.replace(remembered={name: memories[name] for name in before.remembered})


def status_names(parts: Iterable[Component]) -> Iterator[str]:
    """Yield the names of the statuses to which parts refer."""
    for item in parts:
        yield from (name for _, refers, name in references(item, "") if refers.section == "status")


def judge(env: Environment, sim: Sim, before: Sim | None = None) -> Sim:
    """Return the simulation with regions and statuses that follow from its platforms alone.

    A status uses the memory that `sim.remembered` has of it. Without one it begins anew, as at a
    reset.

    Args:
        env: the environment.
        sim: the simulation to judge.
        before: the simulation one step earlier. If it is given, distances, and depths inside
            regions, are lower bounds on the way from there, so that nothing slips through between
            two instants.
    """
    earlier = None if before is None else judge(env, before)
    sim = place_regions(env, sim.replace(status={}))
    if earlier is not None:
        sim = sim.replace(regions=regions_on_the_way(env, earlier, sim))
    for status in env.status:
        with part("status", status.name):
            if status.name in sim.remembered:
                value = status.process(sim.remembered[status.name], sim)
            elif earlier is None:
                value = status.process(status.init(sim), sim)
            else:
                value = status.on_the_way(env, earlier, sim)
        sim = sim.replace(status={**sim.status, status.name: value})
    return sim


def constraint(env: Environment, name: str) -> Constraint:
    """Return a safety constraint by name."""
    return next(constraint for constraint in env.constraints if constraint.name == name)


def margins_of(
    env: Environment, sim: Sim, before: Sim | None = None, names: Sequence[str] | None = None
) -> Float[Array, " c"]:
    """Return the margin h of each of some safety constraints.

    Args:
        env: the environment.
        sim: the simulation.
        before: the simulation one step earlier. If it is given, constraints that can be broken
            between two instants (`Constraint.between`) count with a lower bound on the way from
            there.
        names: names of the constraints, in the order of the result. None stands for all.
    """
    now = judge(env, sim)
    on_the_way = now if before is None else judge(env, sim, before)
    chosen = env.constraints if names is None else [constraint(env, name) for name in names]
    return jnp.stack([item.margin_between(now, on_the_way) for item in chosen])


def smallest_margin(
    env: Environment, sim: Sim, before: Sim | None = None, names: Sequence[str] | None = None
) -> Float[Array, ""]:
    """Return the smallest h of some safety constraints. Arguments are those of `margins_of`."""
    return jnp.min(margins_of(env, sim, before=before, names=names))


def bounds(env: Environment) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Return the lowest and the highest control in physical units, in action order."""
    low = jnp.stack([actuator.low for actuator in env.actuators])
    high = jnp.stack([actuator.high for actuator in env.actuators])
    return low, high
