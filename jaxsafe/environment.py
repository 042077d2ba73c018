"""The generic environment: `reset` and `step` as pure functions, in the order of Figs. 8, 9 and 11 of the paper.

Nothing here knows a task. An `Environment` is the pytree of its own parameters, so `jax.jit(jaxsafe.step)` traces every
number of it: changing them compiles nothing anew, and `vmap` over environments sweeps them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxsafe.processors.constraint import Constraint
from jaxsafe.processors.observation import Observation
from jaxsafe.processors.reward import Reward
from jaxsafe.processors.status import Status
from jaxsafe.processors.terminal import Terminal
from jaxsafe.rta.filter import RTA
from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.schema.dotted_paths import references, set_path
from jaxsafe.schema.errors import ConfigError, nearest, part, show
from jaxsafe.simulation.controllers import Actuator
from jaxsafe.simulation.geometry import Region
from jaxsafe.simulation.initializers import uniform
from jaxsafe.simulation.platform import Platform, placed
from jaxsafe.transition import advance, update_statuses
from jaxsafe.types import (
    Info,
    Key,
    Memory,
    Number,
    ParameterPath,
    PlatformName,
    RTAInfo,
    Sim,
    State,
    TimeStep,
)

Parameters = Mapping[str, Float[Array, ""]]

SUCCESS = "success"
"""The outcome that success rates count."""

DIVERGED = "diverged"
"""The outcome of an episode whose state is not finite. It comes last in `Environment.outcomes`."""


class Environment(Component):
    """A task: platforms and regions, and the processors that give their state a meaning.

    `randomize` names numbers of the environment by dotted path with the interval from which each episode draws them.
    """

    shorthand: ClassVar[str | None] = "platforms"

    agent: PlatformName
    dt: Annotated[Number, Unit("s"), Range(0.0, open_low=True, smallest=1e-6, largest=1e5)] = 1.0
    platforms: tuple[Platform, ...]
    regions: tuple[Region, ...] = ()
    status: tuple[Status, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    terminal: tuple[Terminal, ...]
    reward: tuple[Reward, ...]
    observation: tuple[Observation, ...]
    randomize: Mapping[ParameterPath, Annotated[Number, Unit("physical", length=2)]] = dataclasses.field(
        default_factory=dict
    )
    rta: RTA | None = None

    def reset(self, key: Key) -> tuple[State, TimeStep]:
        """Same as `jaxsafe.reset(env, key)`."""
        return reset(self, key)

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        """Same as `jaxsafe.step(env, state, action)`."""
        return step(self, state, action)

    def platform(self, name: str) -> Platform:
        """A platform by name."""
        return next(platform for platform in self.platforms if platform.name == name)

    @property
    def agent_platform(self) -> Platform:
        """The platform that the actions drive."""
        return self.platform(self.agent)

    @property
    def outcomes(self) -> tuple[str, ...]:
        """What `info.outcome` indexes: `running`, terminal conditions and reward bounds in their order, and `diverged`."""
        bounds = [term.bound.outcome for term in self.reward if term.bound]
        return ("running", *(condition.name for condition in self.terminal), *bounds, DIVERGED)

    @property
    def success(self) -> int:
        """The index of the outcome `success`; −1, which nothing ends with, where the task has none."""
        return self.outcomes.index(SUCCESS) if SUCCESS in self.outcomes else -1

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """The actuators, in the order of the action; empty where the agent's controller lists none."""
        return getattr(self.agent_platform.controller, "actuators", ())

    @property
    def action_names(self) -> tuple[str, ...]:
        """The actuators, in the order of the action."""
        return self.agent_platform.controller.names

    @property
    def action_size(self) -> int:
        """Number of elements of an action."""
        return len(self.action_names)

    @property
    def num_action_points(self) -> tuple[int, ...]:
        """Number of choices of each element of a discrete action; `()` if actions are continuous."""
        return self.agent_platform.controller.points

    @functools.cached_property  # asked for often, and each answer traces a reset
    def observation_names(self) -> tuple[str, ...]:
        """A name for each element of the observation."""
        names: list[str] = []

        def probe(key: Key) -> None:
            sim = reset(self, key)[0].sim
            names.extend(label for item in self.observation for label in item.labels(sim))

        jax.eval_shape(probe, jax.random.key(0))
        return tuple(names)

    @property
    def observation_size(self) -> int:
        """Number of elements of the observation."""
        return len(self.observation_names)

    @property
    def _ends(self) -> dict[str, str]:
        bounds = {term.bound.outcome: term.bound.ends for term in self.reward if term.bound}
        return {condition.name: condition.ends for condition in self.terminal} | bounds | {DIVERGED: "terminated"}


def require_success(env: Environment) -> None:
    """Refuse an environment in which nothing would count as a success.

    Raises:
        ConfigError: no outcome is called `success`.
    """
    if env.success < 0:
        found = ", ".join(env.outcomes[1:-1])
        raise ConfigError(
            f"terminal: no outcome is called {SUCCESS!r}, so nothing would count as one; call the goal so, among {found}"
        )


def reset(env: Environment, key: Key) -> tuple[State, TimeStep]:
    """Draw a random start of an episode.

    Args:
        env: the environment.
        key: a typed PRNG key, `jax.random.key(seed)`.

    Returns:
        The state and the first time step: reward and cost as of no step taken, `terminated` and `truncated` False.
    """
    parameters = _draw_parameters(env, key)
    env = drawn(env, parameters)
    sim = _blank(env)
    for platform, key_i in zip(env.platforms, jax.random.split(key, len(env.platforms)), strict=True):
        with part("platforms", platform.name):
            sim = sim.replace(platforms={**sim.platforms, platform.name: platform.reset(key_i, sim)})
    return _with_own_buffers(_begin(env, sim, parameters), beside=env)


def reset_to(
    env: Environment, start: Mapping[str, Mapping[str, Any]], parameters: Mapping[str, Any] | None = None
) -> tuple[State, TimeStep]:
    """Start an episode from chosen platform states: `{"deputy": {"position": [100, 0, 0], "velocity": [0, 0.1, 0]}}`.

    Args:
        env: the environment.
        start: by platform name, by state field; every field that is random at reset must be given.
        parameters: by dotted path, the numbers that `env.randomize` draws; all of them must be given.

    Raises:
        ConfigError: a platform, field or parameter is unknown, or a random one is missing or has another shape.
    """
    for what, value in (("platforms", start), ("parameters", {} if parameters is None else parameters)):
        if not isinstance(value, Mapping):
            raise ConfigError(f"reset_to: expected {what} by name, found {show(value)}")
    parameters = _chosen_parameters(env, parameters or {})
    env = drawn(env, parameters)
    known = {platform.name: platform for platform in env.platforms}
    for name in start:
        if name not in known:
            raise ConfigError(f"reset_to: unknown platform {show(name)}; choose from {nearest(name, known)}")
    platforms = {name: platform.place(start.get(name, {})) for name, platform in known.items()}
    return _with_own_buffers(_begin(env, _blank(env).replace(platforms=platforms), parameters), beside=(env, start))


def step(env: Environment, state: State, action: Array) -> tuple[State, TimeStep]:
    """Advance one time step. Never resets by itself, and never looks at an earlier outcome.

    Args:
        env: the environment.
        state: as returned by `reset` or `step`.
        action: float in [−1, 1], shape (action_size,), clipped; or, with discrete actions, int indices of that shape,
            clipped to 0 … points − 1.

    Returns:
        The next state and the time step that led there.

    Raises:
        ConfigError: the action has another shape, or is not whole numbers where actions are discrete.
    """
    env = drawn(env, state.parameters)
    action = _checked(env, action)
    controls = env.agent_platform.controller.control(action, state.sim)
    desired = jnp.stack([controls[name] for name in env.action_names])
    actual, rta_memory, assurance = _assure(env, state, desired)
    platforms = advance(env, state.sim, actual).platforms
    num_steps = state.num_steps + 1
    sim = _blank(env).replace(time=num_steps.astype(env.dt.dtype) * env.dt, platforms=platforms)
    sim = sim.replace(intervening=jnp.zeros((), bool) if assurance is None else rta_memory.intervening)

    sim, status_memory = update_statuses(env, sim, state.memory.status)
    sim = _terminal(env, sim)
    sim, reward_memory, terms, totals = _rewards(env, sim, state)
    observation, observation_memory = _observations(env, sim, state.memory.observation)

    memory = Memory(status_memory, reward_memory, observation_memory, rta_memory)
    info = _info(env, sim, terms, totals, desired, actual, assurance)
    timestep = _time_step(env, sim, observation, jnp.asarray(sum(terms.values())), info)
    return State(sim, memory, totals, num_steps, state.parameters), timestep


def _with_own_buffers(started: tuple[State, TimeStep], beside: Any) -> tuple[State, TimeStep]:
    """Copy arrays that stand in several places, or `beside` the state, so that the state may be donated.

    A compiled reset returns an array for each place by itself.
    """
    seen = {id(leaf) for leaf in jax.tree.leaves(beside)}

    def own(leaf: Any) -> Any:
        shared = id(leaf) in seen and not isinstance(leaf, Tracer)
        seen.add(id(leaf))
        return jnp.copy(leaf) if shared else leaf

    return jax.tree.map(own, started)


def _draw_parameters(env: Environment, key: Key) -> Parameters:
    """Numbers for one episode, from a key of their own so that platforms start alike with and without them."""
    if not env.randomize:
        return {}
    paths = sorted(env.randomize)  # which number a path gets must not depend on the order in which they were written
    drawn = uniform(jax.random.fold_in(key, len(env.platforms)), *(env.randomize[path] for path in paths))
    return dict(zip(paths, drawn, strict=True))


def _chosen_parameters(env: Environment, parameters: Mapping[str, Any]) -> Parameters:
    for path in parameters:
        if path not in env.randomize:
            known = nearest(path, env.randomize) or "none"
            raise ConfigError(f"reset_to: parameter {show(path)} is not random; choose from {known}")
    for path in env.randomize:
        if path not in parameters:
            raise ConfigError(f"reset_to: parameter {path!r} is missing: it is random at reset, so give it")
    return {path: placed(f"parameter {path}", parameters[path], env.dt) for path in env.randomize}


def drawn(env: Environment, parameters: Parameters) -> Environment:
    """The environment with what an episode has drawn of it, `state.parameters`."""
    for path, value in parameters.items():
        env = set_path(env, path, value)
    return env


def extremes(env: Environment) -> tuple[Environment, Environment]:
    """Return the environment with the least and with the greatest value of each number that is random."""
    low, high = ({path: interval[i] for path, interval in env.randomize.items()} for i in (0, 1))
    return drawn(env, low), drawn(env, high)


def _blank(env: Environment) -> Sim:
    never = {name: jnp.zeros((), bool) for name in env.outcomes[1:]}
    return Sim(jnp.zeros_like(env.dt), {}, {}, {}, never, jnp.zeros((), bool))


def _begin(env: Environment, sim: Sim, parameters: Parameters) -> tuple[State, TimeStep]:
    """Initialise all processors from placed platforms: `init` and `process`, no `increment`."""
    sim, status_memory = update_statuses(env, sim, None)
    ended = _terminal(env, sim)
    observation, observation_memory = _observations(env, sim, None)
    reward_memory = {}
    for term in env.reward:
        with part("reward", term.name):
            reward_memory[term.name] = term.init(sim)
    zero = jnp.zeros((), observation.dtype)
    terms = {term.name: zero for term in env.reward}
    rta_memory, assurance = (), None
    if env.rta is not None:
        with part("rta"):
            rta_memory, assurance = env.rta.begin(env, sim)
    still = jnp.zeros(env.action_size, observation.dtype)
    info = _info(env, ended, terms, terms, still, still, assurance)
    memory = Memory(status_memory, reward_memory, observation_memory, rta_memory)
    state = State(ended, memory, terms, jnp.zeros((), jnp.int32), parameters)
    timestep = _time_step(env, sim, observation, zero, info)  # `sim` ended nothing: the first step is always taken
    return state, timestep.replace(cost=zero)


def _checked(env: Environment, action: Array) -> Array:
    """Shapes and types are known while tracing; JAX itself would clamp an index out of range and say nothing."""
    action = jnp.asarray(action)
    if action.shape != (env.action_size,):
        raise ConfigError(
            f"action: expected shape {(env.action_size,)} ({', '.join(env.action_names)}), found {action.shape}"
        )
    if env.num_action_points and not jnp.issubdtype(action.dtype, jnp.integer):
        raise ConfigError(
            f"action: expected whole numbers, indices of {env.num_action_points} points, found {action.dtype}"
        )
    return action


def _terminal(env: Environment, sim: Sim) -> Sim:
    """The first condition that holds ends the episode; those that stand apart end it beside the others.

    A state that is not finite ends it before all of them: no comparison with such numbers means anything.
    """
    diverged = _diverged(env, sim)
    ended, over = {DIVERGED: diverged}, diverged
    for condition in env.terminal:
        with part("terminal", condition.name):
            reached = condition.reached(sim)
            ended[condition.name] = reached & ~(diverged if condition.apart else over)
            over = over if condition.apart else over | reached
    return sim.replace(ended={**sim.ended, **ended})


def _diverged(env: Environment, sim: Sim) -> Bool[Array, ""]:
    """Whether the state is not finite, or a status that ends or judges the episode is not a number.

    Of the other platforms the position is looked at: whatever else of them is not finite shows there a step later. To look
    at each number by itself, or at statuses that nothing needs, cost up to a third of a step.
    """
    positions = [sim.platforms[platform.name].position for platform in env.platforms if platform.name != env.agent]
    numbers = [*positions, *filter(_is_float, jax.tree.leaves(sim.platforms[env.agent]))]
    finite = jnp.isfinite(jnp.concatenate([jnp.ravel(number) for number in numbers]))
    judged = [sim.status[name] for name in _judging(env)]
    return ~jnp.all(finite) | _any(jnp.isnan(value) for value in judged if _is_float(value))


def _judging(env: Environment) -> list[str]:
    """The statuses that terminal conditions and constraints name."""
    found = (reference for item in (*env.terminal, *env.constraints) for reference in references(item, ""))
    return list(dict.fromkeys(name for _, refers, name in found if refers.section == "status"))


def _is_float(value: Array) -> bool:
    return jnp.issubdtype(value.dtype, jnp.floating)


def _rewards(env: Environment, sim: Sim, state: State) -> tuple[Sim, dict, dict, dict]:
    """Reward terms in order; a bounded term may end the episode, and the terms after it see that."""
    memories, terms, totals = {}, {}, {}
    for term in env.reward:
        with part("reward", term.name):
            memories[term.name] = own = term.increment(state.memory.reward[term.name], sim, env.dt)
            terms[term.name] = value = term.process(own, sim)
            totals[term.name] = total = state.reward_totals[term.name] + value
        if term.bound:
            apart = {condition.name for condition in env.terminal if condition.apart}
            over = _any(ended for name, ended in sim.ended.items() if name not in apart)
            sim = sim.replace(ended={**sim.ended, term.bound.outcome: (total < term.bound.below) & ~over})
    return sim, memories, terms, totals


def _observations(
    env: Environment, sim: Sim, memory: Mapping[str, Any] | None
) -> tuple[Float[Array, " observation"], dict[str, Any]]:
    memories, parts = {}, []
    for item in env.observation:
        with part("observation", item.name):
            own = item.init(sim) if memory is None else item.increment(memory[item.name], sim, env.dt)
            parts.append(item.process(own, sim))
        memories[item.name] = own
    return jnp.concatenate(parts), memories


def _assure(env: Environment, state: State, desired: Array) -> tuple[Array, Any, RTAInfo | None]:
    """The control that acts: the desired one, or what run time assurance makes of it."""
    if env.rta is None:
        return desired, (), None
    with part("rta"):
        return env.rta.filter(env, state.sim, state.memory.rta, desired)


def _info(
    env: Environment, sim: Sim, terms: dict, totals: dict, desired: Array, actual: Array, assurance: RTAInfo | None
) -> Info:
    outcome = jnp.zeros((), jnp.int32)
    for index, name in reversed(list(enumerate(env.outcomes))[1:]):
        outcome = jnp.where(sim.ended[name], index, outcome)
    margins, severity = {}, {}
    for constraint in env.constraints:
        with part("constraints", constraint.name):
            margins[constraint.name] = margin = constraint.margin(sim)
            excess = jnp.maximum(-margin, 0.0) / constraint.limit(sim)
            known = jnp.where(jnp.isfinite(excess), excess, 1.0)  # a margin that is not a number lacks the whole limit
            severity[constraint.name] = jnp.where(margin >= 0.0, 0.0, known)
    return Info(outcome, sim.status, terms, totals, desired, actual, sim.intervening, margins, severity, assurance)


def _time_step(env: Environment, sim: Sim, observation: Array, reward: Array, info: Info) -> TimeStep:
    violated = sim.ended[DIVERGED] | _any(~(margin >= 0.0) for margin in info.margins.values())
    kinds = ("terminated", "truncated")
    terminated, truncated = (_any(sim.ended[name] for name, how in env._ends.items() if how == kind) for kind in kinds)
    return TimeStep(observation, reward, violated.astype(observation.dtype), terminated, truncated, info)


def _any(flags: Iterable[Array]) -> Array:
    return functools.reduce(jnp.logical_or, flags, jnp.zeros((), bool))
