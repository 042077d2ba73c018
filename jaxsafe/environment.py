"""The generic environment: `reset` and `step` as pure functions, in the order of Figs. 8, 9 and 11 of the paper.

Nothing here knows a task. An `Environment` is the pytree of its own parameters, so `jax.jit(jaxsafe.step)` traces every
number of it: changing them compiles nothing anew, and `vmap` over environments sweeps them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.component import Component
from jaxsafe.errors import ConfigError, nearest
from jaxsafe.processors.constraint import Constraint
from jaxsafe.processors.observation import Observation
from jaxsafe.processors.reward import Reward
from jaxsafe.processors.status import Status
from jaxsafe.processors.terminal import Terminal
from jaxsafe.simulation.controllers import Controls
from jaxsafe.simulation.geometry import Region
from jaxsafe.simulation.platform import Platform
from jaxsafe.types import Info, Key, Memory, PlatformName, Seconds, Sim, State, TimeStep


class Environment(Component):
    """A task: platforms and regions, and the processors that give their state a meaning."""

    agent: PlatformName
    dt: Seconds = 1.0
    platforms: tuple[Platform, ...]
    regions: tuple[Region, ...] = ()
    status: tuple[Status, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    terminal: tuple[Terminal, ...]
    reward: tuple[Reward, ...]
    observation: tuple[Observation, ...]

    def reset(self, key: Key) -> tuple[State, TimeStep]:
        """Same as `jaxsafe.reset(env, key)`."""
        return reset(self, key)

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        """Same as `jaxsafe.step(env, state, action)`."""
        return step(self, state, action)

    @property
    def agent_platform(self) -> Platform:
        """The platform that the actions drive."""
        return next(platform for platform in self.platforms if platform.name == self.agent)

    @property
    def outcomes(self) -> tuple[str, ...]:
        """What `info.outcome` indexes: `running`, the terminal conditions, the reward bounds, in their listed order."""
        bounds = [term.bound.outcome for term in self.reward if term.bound]
        return ("running", *(condition.name for condition in self.terminal), *bounds)

    @property
    def can_truncate(self) -> bool:
        """Whether any end is a truncation."""
        return "truncated" in self._ends.values()

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

    @property
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
        return {condition.name: condition.ends for condition in self.terminal} | bounds


def reset(env: Environment, key: Key) -> tuple[State, TimeStep]:
    """Draw a random start of an episode.

    Args:
        env: the environment.
        key: a typed PRNG key, `jax.random.key(seed)`.

    Returns:
        The state and the first time step: reward and cost as of no step taken, `terminated` and `truncated` False.
    """
    sim = _blank(env)
    for platform, key_i in zip(env.platforms, jax.random.split(key, len(env.platforms)), strict=True):
        sim = sim.replace(platforms={**sim.platforms, platform.name: platform.reset(key_i, sim)})
    return _begin(env, sim)


def reset_to(env: Environment, start: Mapping[str, Mapping[str, Any]]) -> tuple[State, TimeStep]:
    """Start an episode from chosen platform states: `{"deputy": {"position": [100, 0, 0], "velocity": [0, 0.1, 0]}}`.

    Args:
        env: the environment.
        start: by platform name, by state field; every field that is random at reset must be given.

    Raises:
        ConfigError: a platform or field is unknown, or a random field is missing or has another shape.
    """
    known = {platform.name: platform for platform in env.platforms}
    for name in start:
        if name not in known:
            raise ConfigError(f"reset_to: unknown platform {name!r}; choose from {nearest(name, known)}")
    platforms = {name: platform.place(start.get(name, {})) for name, platform in known.items()}
    return _begin(env, _blank(env).replace(platforms=platforms))


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
    action = _checked(env, action)
    controls = env.agent_platform.controller.control(action)
    platforms = {platform.name: _advance(env, platform, state.sim, controls) for platform in env.platforms}
    num_steps = state.num_steps + 1
    sim = _blank(env).replace(time=num_steps.astype(env.dt.dtype) * env.dt, platforms=platforms)

    sim, status_memory = _statuses(env, sim, state.memory.status, env.dt)
    sim, outcome = _terminal(env, sim)
    sim, outcome, reward_memory, terms, totals = _rewards(env, sim, outcome, state)
    observation, observation_memory = _observations(env, sim, state.memory.observation, env.dt)

    memory = Memory(status_memory, reward_memory, observation_memory)
    desired = jnp.stack([controls[name] for name in env.action_names])
    info = _info(env, sim, outcome, terms, totals, desired)
    reward = jnp.asarray(sum(terms.values()))
    return State(sim, memory, totals, num_steps), _time_step(env, sim, observation, reward, info)


def _blank(env: Environment) -> Sim:
    never = {name: jnp.zeros((), bool) for name in env.outcomes[1:]}
    return Sim(jnp.zeros_like(env.dt), {}, {}, {}, never)


def _begin(env: Environment, sim: Sim) -> tuple[State, TimeStep]:
    """Initialise all processors from placed platforms: `init` and `process`, no `increment`."""
    sim, status_memory = _statuses(env, sim, None, env.dt)
    ended, outcome = _terminal(env, sim)
    observation, observation_memory = _observations(env, sim, None, env.dt)
    memory = Memory(status_memory, {term.name: term.init(sim) for term in env.reward}, observation_memory)
    zero = jnp.zeros((), observation.dtype)
    terms = {term.name: zero for term in env.reward}
    info = _info(env, ended, outcome, terms, terms, jnp.zeros(env.action_size, observation.dtype))
    state = State(ended, memory, terms, jnp.zeros((), jnp.int32))
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


def _advance(env: Environment, platform: Platform, sim: Sim, controls: Controls) -> Any:
    """The platform's next state, from the old simulation: all platforms move at once."""
    own = controls if platform.name == env.agent else platform.controller.control(jnp.zeros(0))
    return platform.step(sim.platforms[platform.name], own, env.dt)


def _statuses(env: Environment, sim: Sim, memory: Mapping[str, Any] | None, dt: Any) -> tuple[Sim, dict[str, Any]]:
    """Regions, then statuses in order; each sees only those before it. Without memory: the start of an episode."""
    sim = sim.replace(regions={region.name: region.place(sim.platforms) for region in env.regions})
    memories = {}
    for status in env.status:
        own = status.init(sim) if memory is None else status.increment(memory[status.name], sim, dt)
        sim = sim.replace(status={**sim.status, status.name: status.process(own, sim)})
        memories[status.name] = own
    return sim, memories


def _terminal(env: Environment, sim: Sim) -> tuple[Sim, Array]:
    """The first condition that holds is the outcome."""
    outcome = jnp.zeros((), jnp.int32)
    for index, condition in enumerate(env.terminal, start=1):
        outcome = jnp.where((outcome == 0) & condition.reached(sim), index, outcome)
    return _mark(env, sim, outcome), outcome


def _rewards(env: Environment, sim: Sim, outcome: Array, state: State) -> tuple[Sim, Array, dict, dict, dict]:
    """Reward terms in order; a bounded term may end the episode, and the terms after it see that."""
    memories, terms, totals = {}, {}, {}
    for term in env.reward:
        memories[term.name] = own = term.increment(state.memory.reward[term.name], sim, env.dt)
        terms[term.name] = value = term.process(own, sim)
        totals[term.name] = total = state.reward_totals[term.name] + value
        if term.bound:
            index = env.outcomes.index(term.bound.outcome)
            outcome = jnp.where((outcome == 0) & (total < term.bound.below), index, outcome)
            sim = _mark(env, sim, outcome)
    return sim, outcome, memories, terms, totals


def _observations(
    env: Environment, sim: Sim, memory: Mapping[str, Any] | None, dt: Any
) -> tuple[Float[Array, " observation"], dict[str, Any]]:
    memories, parts = {}, []
    for item in env.observation:
        memories[item.name] = own = item.init(sim) if memory is None else item.increment(memory[item.name], sim, dt)
        parts.append(item.process(own, sim))
    return jnp.concatenate(parts), memories


def _mark(env: Environment, sim: Sim, outcome: Array) -> Sim:
    return sim.replace(ended={name: outcome == index for index, name in enumerate(env.outcomes) if index})


def _info(env: Environment, sim: Sim, outcome: Array, terms: dict, totals: dict, control: Array) -> Info:
    margins = {constraint.name: constraint.margin(sim) for constraint in env.constraints}
    severity = {
        constraint.name: jnp.maximum(-margins[constraint.name], 0.0) / constraint.limit(sim)
        for constraint in env.constraints
    }
    return Info(outcome, sim.status, terms, totals, control, control, jnp.zeros((), bool), margins, severity)


def _time_step(env: Environment, sim: Sim, observation: Array, reward: Array, info: Info) -> TimeStep:
    violated = jnp.any(jnp.array([margin < 0.0 for margin in info.margins.values()], bool))
    ends = {
        kind: [sim.ended[name] for name, how in env._ends.items() if how == kind] for kind in ("terminated", "truncated")
    }
    terminated, truncated = (jnp.any(jnp.array(ends[kind], bool)) for kind in ("terminated", "truncated"))
    return TimeStep(observation, reward, violated.astype(observation.dtype), terminated, truncated, info)
