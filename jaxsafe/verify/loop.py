"""The closed loop that is proved: its state, its first and its following step, and its property.

The state of the loop is the position and the velocity of the agent's platform, and the action that
is held in the next step. One step of the loop is `jaxsafe.step` followed by the policy.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval
from jaxtyping import Array, Float

from jaxsafe.environment import Environment, action_bounds, reset_to, step
from jaxsafe.processors.constraint import SpeedLimit
from jaxsafe.processors.status import Distance, InRegion, Speed, VelocityLimit
from jaxsafe.processors.terminal import Crashed, Docked, Timeout, TooFar
from jaxsafe.rollout import Policy
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.cwh import Anchor, Spacecraft, ThrustedSpacecraft
from jaxsafe.simulation.double_integrator import DoubleIntegrator
from jaxsafe.simulation.regions import Sphere
from jaxsafe.types import Sim, State
from jaxsafe.verify.program import Program, trace

FIELDS = ("position", "velocity")
"""The fields of the agent's platform that move."""

ENDS = (Docked, Crashed, TooFar, Timeout)
"""Ends of episodes that `docks` allows for. docs/verification.md shows that success is first."""

Property = Literal["safe", "docks"]
"""What can be proved: the limit is kept in all steps, or until the agent has docked."""

SINGLE = 2.0**-24
"""Unit roundoff of single precision."""


def columns(dimension: int) -> list[str]:
    """Return what each number of a box is, such as `position.x`."""
    return [f"{field}.{axis}" for field in FIELDS for axis in "xyz"[:dimension]]


class Plant(NamedTuple):
    """What the bound between two samples needs to know of the plant and of the speed limit."""

    mean_motion: float
    acceleration: float
    """The largest acceleration by the thrust [m/s²]."""
    slope: float
    """The growth of the speed limit with the distance [1/s]."""
    dt: float


class Loop(NamedTuple):
    """A closed loop that something can be proved about.

    Its state is (position, velocity, action). The programs return the next state and the margin h
    that belongs to it. With the property `docks` they also return the depth in the docking region.
    """

    first: Program
    """The program of the start. It does not look at the action in its state."""
    following: Program
    """The program of every further step."""
    dimension: int
    """Number of axes of the position."""
    actions: int
    plant: Plant
    property: Property = "safe"


def closed_loop(
    env: Environment, policy: Policy, arithmetic: str = "float32", property: Property = "safe"
) -> Loop:
    """Return the closed loop of an environment and a policy.

    Args:
        env: the environment.
        policy: `policy(key, observation)` returns actions for a batch of observations. It must be
            deterministic.
        arithmetic: `float32` for the loop as it runs in single precision, `real` for that of real
            numbers with the same parameters.
        property: what is to be proved of it.

    Raises:
        ConfigError: the loop is random, remembers, or has a part that no proof covers.
    """
    _require_provable(env)
    region = docking_region(env) if property == "docks" else None
    unit = {"float32": SINGLE, "real": 0.0}[arithmetic]
    with jax.enable_x64(True):
        env = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), env)
        dimension = env.agent_platform.dimension
        names = [constraint.name for constraint in env.constraints]
        low, high = (
            jnp.stack([jnp.asarray(x, jnp.float64) for x in ends]) for ends in action_bounds(env)
        )
        template = reset_to(env, start_of(env, jnp.ones(2 * dimension)))[0]
        _require_markov(env, template, dimension)

        def act(observation: Array) -> Array:
            action = policy(jax.random.key(0), observation[None])[0]
            return jnp.clip(action.astype(observation.dtype), low, high)

        def outputs(state: State, timestep: Any) -> Array:
            own = state.sim.platforms[env.agent]
            margins = jnp.stack([timestep.info.margins[name] for name in names])
            seen = [own.position, own.velocity, act(timestep.observation), margins]
            if region is not None:
                seen.append(depth(env, region, state.sim)[None])
            return jnp.concatenate(seen)

        def first(y: Array) -> Array:
            return outputs(*reset_to(env, start_of(env, y[: 2 * dimension])))

        def following(y: Array) -> Array:
            state = placed(env, template, y[: 2 * dimension])
            return outputs(*step(env, state, y[2 * dimension :]))

        size = 2 * dimension + env.action_size
        return Loop(
            first=trace(first, size, unit),
            following=trace(following, size, unit),
            dimension=dimension,
            actions=env.action_size,
            plant=_plant(env),
            property=property,
        )


def placed(env: Environment, state: State, x: Float[Array, " 2d"]) -> State:
    """Return a state with the agent's platform at (position, velocity)."""
    own = state.sim.platforms[env.agent]
    position, velocity = jnp.split(x, 2)
    own = own.replace(position=position, velocity=velocity)
    platforms = {**state.sim.platforms, env.agent: own}
    return state.replace(sim=state.sim.replace(platforms=platforms))


def start_of(env: Environment, x: Float[Array, " 2d"]) -> dict[str, dict[str, Any]]:
    """Return a start for `reset_to` from (position, velocity) of the agent's platform."""
    half = x.shape[0] // 2
    return {env.agent: {"position": x[:half], "velocity": x[half:]}}


def docking_region(env: Environment) -> Sphere:
    """Return the region in which an episode ends with a success if the limit is kept.

    Raises:
        ConfigError: the environment has no such region, or no proof covers it.
    """
    ends = [item for item in env.terminal if isinstance(item, Docked)]
    if len(ends) != 1:
        raise ConfigError(
            f"property: docks needs one end of the type docked, and the environment has {len(ends)}"
        )
    for item in env.terminal:
        if type(item) not in ENDS:
            kind = item.type_name or type(item).__name__
            raise ConfigError(
                f"property: docks has no rule for the end {item.name} of the type {kind}"
            )
    [end] = ends
    [constraint] = env.constraints
    status = next(item for item in env.status if item.name == end.in_docking)
    regions = {item.name: item for item in env.regions}
    region = regions[status.region] if type(status) is InRegion else None
    anchors = {item.name for item in env.platforms if type(item) is Anchor}
    if not (
        isinstance(region, Sphere)
        and isinstance(status, InRegion)
        and status.of == env.agent
        and region.offset is None
        and region.on in anchors | {None}
    ):
        raise ConfigError(
            f"property: docks needs {end.in_docking} to be about {env.agent} in a circle or a "
            "sphere around an anchor"
        )
    for name in ("speed", "velocity_limit"):
        if getattr(end, name) != getattr(constraint, name):
            raise ConfigError(
                f"property: docks needs one speed limit; terminal.{end.name}.{name} is not that of "
                f"constraints.{constraint.name}"
            )
    return region


def depth(env: Environment, region: Sphere, sim: Sim) -> Float[Array, ""]:
    """Return how deep the agent is in a region [m]. It is outside if that is negative."""
    centre = sim.regions[region.name].position
    return -region.signed_distance(sim.platforms[env.agent].position - centre)


def _require_provable(env: Environment) -> None:
    """Refuse loops that nothing can be proved about.

    Raises:
        ConfigError: nothing can be proved about the loop.
    """
    if env.rta is not None:
        raise ConfigError(
            "rta: no rule for a filter in the loop; prove the policy alone with rta=none, "
            "and see docs/safety for what the filter itself guarantees"
        )
    if env.randomize:
        path = next(iter(env.randomize))
        raise ConfigError(f"env: {path} is random in every episode; give it one value")
    if env.uncertainty:
        raise ConfigError(f"env: uncertainty.{env.uncertainty[0].name} is in the loop; take it out")
    for item in env.observation:
        if not item.exact:
            raise ConfigError(f"env: observation.{item.name} has errors of a sensor; take them out")
    if env.decision_period != 1:
        raise ConfigError(f"env: decision_period: expected 1, found {env.decision_period}")
    if env.action_kind != "continuous":
        raise ConfigError(f"env: expected continuous actions, found {env.action_kind} ones")
    plant = env.agent_platform
    if type(plant) not in (Spacecraft, DoubleIntegrator):
        kind = plant.type_name or type(plant).__name__
        raise ConfigError(
            f"env: no bound between two steps for the platform {kind!r}; "
            "choose from spacecraft, double_integrator"
        )
    for actuator in env.actuators:
        if not actuator.at_once:
            raise ConfigError(f"env: the actuator {actuator.name} has a lag, which is a memory")
    if not env.constraints:
        raise ConfigError("property: safe needs a safety constraint, and the environment has none")
    for constraint in env.constraints:
        problem = _wrong_limit(env, constraint)
        if problem:
            raise ConfigError(f"env: no bound between two steps for {constraint.name}: {problem}")
    if len(env.constraints) != 1:
        raise ConfigError(f"env: expected one constraint, found {len(env.constraints)}")


def _wrong_limit(env: Environment, constraint: Any) -> str:
    """Return why a constraint is not the speed limit of Eq. (14), or an empty string."""
    if type(constraint) is not SpeedLimit:
        return "it is no speed_limit"
    statuses = {item.name: item for item in env.status}
    limit = statuses[constraint.velocity_limit]
    speed = statuses[constraint.speed]
    if type(limit) is not VelocityLimit or type(speed) is not Speed:
        return "its limit or its speed is another status"
    distance = statuses[limit.distance]
    if type(distance) is not Distance or {distance.of, speed.of} != {env.agent}:
        return "its distance is another status"
    if distance.to not in {item.name for item in env.platforms if type(item) is Anchor}:
        return "its distance is not to an anchor"
    return "constant_to is not 0" if float(limit.constant_to) else ""


def _plant(env: Environment) -> Plant:
    platform = env.agent_platform
    assert isinstance(platform, ThrustedSpacecraft)
    largest = [
        max(abs(float(actuator.low)), abs(float(actuator.high))) for actuator in env.actuators
    ]
    [constraint] = env.constraints
    assert isinstance(constraint, SpeedLimit)
    limit = next(item for item in env.status if item.name == constraint.velocity_limit)
    assert isinstance(limit, VelocityLimit)
    rounding = 1.0 + 1e-6  # the loop rounds the acceleration
    return Plant(
        mean_motion=float(getattr(platform, "mean_motion", 0.0)),
        acceleration=rounding * float(np.linalg.norm(largest)) / float(platform.mass),
        slope=float(limit.slope),
        dt=float(env.dt),
    )


def _require_markov(env: Environment, template: State, dimension: int) -> None:
    """Check that position, velocity and action decide everything that a step and a policy see.

    Raises:
        ConfigError: a step or the policy looks at something else of the state that changes.
    """
    leaves, tree = jax.tree.flatten(template)
    paths = [
        jax.tree_util.keystr(path, simple=True, separator=".")
        for path, _ in jax.tree.leaves_with_path(template)
    ]

    def looked_at(leaves: list[Array], action: Array) -> Any:
        state, timestep = step(env, jax.tree.unflatten(tree, leaves), action)
        own = state.sim.platforms[env.agent]
        seen = (own.position, own.velocity, timestep.observation, timestep.info.margins)
        return seen, jax.tree.leaves(state)

    closed, shapes = jax.make_jaxpr(looked_at, return_shape=True)(
        leaves, jnp.zeros(env.action_size)
    )
    count = len(jax.tree.leaves(shapes[0]))
    jaxpr = closed.jaxpr
    kept = [jaxpr.outvars[count + i] is jaxpr.invars[i] for i in range(len(leaves))]
    used = partial_eval.dce_jaxpr(jaxpr, [i < count for i in range(len(jaxpr.outvars))])[1]
    moving = {f"sim.platforms.{env.agent}.{field}" for field in FIELDS}
    begun = jax.make_jaxpr(lambda x: jax.tree.leaves(reset_to(env, start_of(env, x))[0]))(
        jnp.zeros(2 * dimension)
    ).jaxpr
    for index, (path, stays, needed) in enumerate(zip(paths, kept, used, strict=False)):
        chosen = [i == index for i in range(len(paths))]
        # What a step leaves as it is must also be the same from every start.
        stays = stays and not any(partial_eval.dce_jaxpr(begun, chosen)[1])
        if needed and not stays and path not in moving:
            raise ConfigError(f"env: the loop remembers {path}; a proof needs one that does not")
