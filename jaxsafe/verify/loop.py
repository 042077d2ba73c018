"""The closed loop that is proved: its state, its first and its following step, and its property.

The state of the loop is what moves of the agent's platform and of the platforms around it, such as
position and velocity, and the action that is held in the next step. One step of the loop is
`jaxsafe.step` followed by the policy.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval
from jaxtyping import Array, Float

from jaxsafe.environment import Environment, action_bounds, reset_to, step
from jaxsafe.processors.constraint import Separation, SpeedLimit
from jaxsafe.processors.status import Distance, InRegion, Speed, VelocityLimit
from jaxsafe.processors.terminal import Crashed, Docked, Timeout, TooFar
from jaxsafe.rollout import Policy
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.cwh import Anchor, Spacecraft, ThrustedSpacecraft
from jaxsafe.simulation.double_integrator import DoubleIntegrator
from jaxsafe.simulation.dubins import Dubins2D
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.regions import Sphere
from jaxsafe.simulation.scripted import Scripted
from jaxsafe.types import Sim, State
from jaxsafe.verify.program import Program, trace

POINT_MASS = ("position", "velocity")

FIELDS: Mapping[type[Platform], tuple[str, ...]] = {
    Spacecraft: POINT_MASS,
    DoubleIntegrator: POINT_MASS,
    OrientedSpacecraft: (*POINT_MASS, "attitude", "attitude_rate"),
    Dubins2D: ("position", "heading", "speed"),
}
"""The fields that move of each type of platform about which something can be proved."""

CRAFT = (Spacecraft, DoubleIntegrator, OrientedSpacecraft)
"""Platforms that keep a speed limit. The others are aircraft, which keep a distance."""

ENDS = (Docked, Crashed, TooFar, Timeout)
"""Ends of episodes that `docks` allows for. docs/verification.md shows that success is first."""

Property = Literal["safe", "docks"]
"""What can be proved: the limit is kept in all steps, or until the agent has docked."""

SINGLE = 2.0**-24
"""Unit roundoff of single precision."""


class Part(NamedTuple):
    """A field of a platform's state that is part of the state of a loop."""

    platform: str
    field: str
    size: int | None
    """Number of elements, None for a single number."""
    name: str
    """What a box calls it. The fields of the agent go without the name of the platform."""

    @property
    def columns(self) -> list[str]:
        """Return what each number is, such as `position.x` or `lead.heading`."""
        if self.size is None:
            return [self.name]
        return [f"{self.name}.{axis}" for axis in "xyz"[: self.size]]


def parts(env: Environment) -> list[Part]:
    """Return the parts of the state of an environment's loop, those of the agent first."""
    own = env.agent_platform
    found = []
    for platform in (own, *(item for item in env.platforms if item is not own)):
        rest = platform.rest()
        for field in FIELDS.get(type(platform), ()):
            shape = jnp.shape(getattr(rest, field))
            name = field if platform is own else f"{platform.name}.{field}"
            found.append(Part(platform.name, field, shape[0] if shape else None, name))
    return found


def columns(env: Environment) -> list[str]:
    """Return what each number of a box is."""
    return [column for part in parts(env) for column in part.columns]


class Plant(NamedTuple):
    """What the bound between two samples needs to know of the plant and of its constraint."""

    mean_motion: float
    """The mean motion [rad/s], 0 without an orbit."""
    acceleration: float
    """The largest acceleration by the thrust [m/s²], or of two aircraft to each other [ft/s²]."""
    slope: float
    """The growth of the margin with the distance: [1/s] for a speed limit, 1 for a distance."""
    dt: float
    turn_rate: float = 0.0
    """The highest rate at which the thrust turns [rad/s]."""


class Loop(NamedTuple):
    """A closed loop that something can be proved about.

    Its state is that of the platforms, and the action. The programs return the next state and the
    margin h that belongs to it. With the property `docks` they also return the depth in the docking
    region. For aircraft, position and velocity relative to the other one follow.
    """

    first: Program
    """The program of the start. It does not look at the action in its state."""
    following: Program
    """The program of every further step."""
    columns: tuple[str, ...]
    """What each number of the state is, without the action."""
    dimension: int
    """Number of axes of the position."""
    actions: int
    plant: Plant
    curved: bool
    """Whether the plant is not linear."""
    motion: int
    """The first output of position and velocity, which the bound between samples is about."""
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
        names = [constraint.name for constraint in env.constraints]
        low, high = (
            jnp.stack([jnp.asarray(x, jnp.float64) for x in ends]) for ends in action_bounds(env)
        )
        aircraft = not isinstance(env.agent_platform, CRAFT)
        own = columns(env)
        size = len(own)
        template = reset_to(env, start_of(env, jnp.ones(size)))[0]
        _require_markov(env, template, size)

        def act(observation: Array) -> Array:
            action = policy(jax.random.key(0), observation[None])[0]
            return jnp.clip(action.astype(observation.dtype), low, high)

        def outputs(state: State, timestep: Any) -> Array:
            margins = jnp.stack([timestep.info.margins[name] for name in names])
            seen = [_moving(env, state), act(timestep.observation), margins]
            if region is not None:
                seen.append(depth(env, region, state.sim)[None])
            if aircraft:
                seen.append(_relative(env, state))
            return jnp.concatenate(seen)

        def first(y: Array) -> Array:
            return outputs(*reset_to(env, start_of(env, y[:size])))

        def following(y: Array) -> Array:
            state = placed(env, template, y[:size])
            return outputs(*step(env, state, y[size:]))

        total = size + env.action_size
        return Loop(
            first=trace(first, total, unit),
            following=trace(following, total, unit),
            columns=tuple(own),
            dimension=env.agent_platform.dimension,
            actions=env.action_size,
            plant=_plant(env),
            curved=not isinstance(env.agent_platform, Spacecraft | DoubleIntegrator),
            motion=total + 1 if aircraft else 0,
            property=property,
        )


def _moving(env: Environment, state: State) -> Array:
    """Return the state of a loop without the action."""
    fields = [getattr(state.sim.platforms[part.platform], part.field) for part in parts(env)]
    return jnp.concatenate([jnp.atleast_1d(field) for field in fields])


def _relative(env: Environment, state: State) -> Array:
    """Return position and velocity of the agent relative to the aircraft it keeps away from."""
    own, other = (state.sim.platforms[name] for name in _kept_apart(env))
    return jnp.concatenate([own.position - other.position, own.velocity - other.velocity])


def placed(env: Environment, state: State, x: Float[Array, " s"]) -> State:
    """Return a state with the platforms as the state of a loop says."""
    platforms = {
        name: state.sim.platforms[name].replace(**fields)
        for name, fields in start_of(env, x).items()
    }
    return state.replace(sim=state.sim.replace(platforms={**state.sim.platforms, **platforms}))


def start_of(env: Environment, x: Float[Array, " s"]) -> dict[str, dict[str, Any]]:
    """Return a start for `reset_to` from the state of a loop without the action."""
    start: dict[str, dict[str, Any]] = {}
    place = 0
    for part in parts(env):
        end = place + (part.size or 1)
        value = x[place] if part.size is None else x[place:end]
        start.setdefault(part.platform, {})[part.field] = value
        place = end
    return start


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
    for platform in env.platforms:
        if type(platform) not in FIELDS and type(platform) is not Anchor:
            kind = platform.type_name or type(platform).__name__
            known = ", ".join(str(item.type_name) for item in FIELDS)
            raise ConfigError(
                f"env: no bound between two steps for the platform {kind!r}; choose from {known}"
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
    """Return why a constraint is not one that the bound between samples is about.

    That is the speed limit of Eq. (14) for spacecraft, and the separation of Eq. (8) for aircraft.
    It is an empty string if the constraint is.
    """
    if not isinstance(env.agent_platform, CRAFT):
        return _wrong_separation(env, constraint)
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


def _wrong_separation(env: Environment, constraint: Any) -> str:
    """Return why a constraint is not a separation from an aircraft whose controls are known."""
    if type(constraint) is not Separation:
        return "it is no separation"
    distance = next(item for item in env.status if item.name == constraint.distance)
    aircraft = {item.name: item for item in env.platforms if type(item) in FIELDS}
    if type(distance) is not Distance or not {distance.of, distance.to} <= aircraft.keys():
        return "its distance is not between two platforms"
    if env.agent not in (distance.of, distance.to):
        return f"its distance is not that of {env.agent}"
    other = _kept_apart(env)[1]
    controller = aircraft[other].controller
    if type(controller) is not Scripted or not all(
        np.isfinite(command.extremes()).all() for command in controller.commands
    ):
        return f"nothing bounds the controls of {other}"
    return ""


def _kept_apart(env: Environment) -> tuple[str, str]:
    """Return the names of the agent and of the aircraft that it keeps away from."""
    [constraint] = env.constraints
    assert isinstance(constraint, Separation)
    distance = next(item for item in env.status if item.name == constraint.distance)
    assert isinstance(distance, Distance)
    return env.agent, distance.to if distance.of == env.agent else distance.of


ROUNDED = 1.0 + 1e-6
"""A factor that covers how the loop rounds an acceleration."""


def _plant(env: Environment) -> Plant:
    platform = env.agent_platform
    controls = {item.name: (float(item.low), float(item.high)) for item in env.actuators}
    [constraint] = env.constraints
    if isinstance(platform, Dubins2D):
        [other] = [item for item in env.platforms if item.name == _kept_apart(env)[1]]
        assert isinstance(other, Dubins2D)
        assert isinstance(other.controller, Scripted)
        scripted = {item.name: item.extremes() for item in other.controller.commands}
        acceleration = _acceleration(platform, controls) + _acceleration(other, scripted)
        return Plant(mean_motion=0.0, acceleration=acceleration, slope=1.0, dt=float(env.dt))
    assert isinstance(platform, ThrustedSpacecraft | OrientedSpacecraft)
    assert isinstance(constraint, SpeedLimit)
    turning = isinstance(platform, OrientedSpacecraft)
    thrusts = [_size(controls["thrust"])] if turning else [*map(_size, controls.values())]
    limit = next(item for item in env.status if item.name == constraint.velocity_limit)
    assert isinstance(limit, VelocityLimit)
    return Plant(
        mean_motion=float(getattr(platform, "mean_motion", 0.0)),
        acceleration=ROUNDED * float(np.linalg.norm(thrusts)) / float(platform.mass),
        slope=float(limit.slope),
        dt=float(env.dt),
        turn_rate=ROUNDED * _size(platform.attitude_rate_limits) if turning else 0.0,
    )


def _acceleration(platform: Dubins2D, controls: Mapping[str, Any]) -> float:
    """Return the largest acceleration of an aircraft: v̇ along and v ψ̇ across its path [ft/s²]."""
    along, turn = (_size(controls.get(name, 0.0)) for name in ("acceleration", "heading_rate"))
    return ROUNDED * float(np.hypot(along, turn * float(platform.speed_limits[1])))


def _size(interval: Any) -> float:
    """Return the largest absolute value in an interval."""
    return float(np.abs(np.asarray(interval)).max())


def _require_markov(env: Environment, template: State, size: int) -> None:
    """Check that the state of the loop decides everything that a step and a policy see.

    Args:
        env: the environment.
        template: a state.
        size: number of elements of the loop's state, without the action.

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
        seen = (_moving(env, state), timestep.observation, timestep.info.margins)
        return seen, jax.tree.leaves(state)

    closed, shapes = jax.make_jaxpr(looked_at, return_shape=True)(
        leaves, jnp.zeros(env.action_size)
    )
    count = len(jax.tree.leaves(shapes[0]))
    jaxpr = closed.jaxpr
    kept = [jaxpr.outvars[count + i] is jaxpr.invars[i] for i in range(len(leaves))]
    used = partial_eval.dce_jaxpr(jaxpr, [i < count for i in range(len(jaxpr.outvars))])[1]
    moving = {f"sim.platforms.{part.platform}.{part.field}" for part in parts(env)}
    begun = jax.make_jaxpr(lambda x: jax.tree.leaves(reset_to(env, start_of(env, x))[0]))(
        jnp.zeros(size)
    ).jaxpr
    for index, (path, stays, needed) in enumerate(zip(paths, kept, used, strict=False)):
        chosen = [i == index for i in range(len(paths))]
        # What a step leaves as it is must also be the same from every start.
        stays = stays and not any(partial_eval.dce_jaxpr(begun, chosen)[1])
        if needed and not stays and path not in moving:
            raise ConfigError(f"env: the loop remembers {path}; a proof needs one that does not")
