"""The generic environment: `reset` and `step` as pure functions.

They follow the order of Figs. 8, 9 and 11 of the paper.

Nothing here knows a task. An `Environment` is the pytree of its own parameters, so
`jax.jit(jaxsafe.step)` traces every number of it. Changing a number compiles nothing again, and
`vmap` over environments sweeps numbers.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import operator
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxsafe import worst_case as worst_case  # its parts can stand in `uncertainty`
from jaxsafe.processors.constraint import Constraint
from jaxsafe.processors.observation import Observation
from jaxsafe.processors.reward import Reward
from jaxsafe.processors.status import Status
from jaxsafe.processors.terminal import Terminal, time_limit
from jaxsafe.rta.filter import RTA
from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.schema.describe import Described, Rows, brief, unbroken
from jaxsafe.schema.dotted_paths import set_path
from jaxsafe.schema.errors import ConfigError, choices_text, part, show
from jaxsafe.schema.ties import Tie, follow
from jaxsafe.simulation.controllers import Actuator
from jaxsafe.simulation.initializers import uniform
from jaxsafe.simulation.platform import Platform, placed
from jaxsafe.simulation.regions import Region
from jaxsafe.simulation.uncertainty import Uncertainty
from jaxsafe.transition import (
    advance,
    status_names,
    update_statuses,
    with_centres,
    with_memory,
)
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
    require_key,
    units,
)
from jaxsafe.uncertain import (
    begun,
    disturbed,
    episode_words,
    measured,
    part_key,
    random_parts,
    received,
    step_key,
)

Parameters = Mapping[str, Float[Array, ""]]
"""Numbers of an environment that are drawn for an episode, by dotted path."""

SUCCESS = "success"
"""The outcome that counts as success where it is not marked."""

DIVERGED = "diverged"
"""The outcome of an episode whose state is not finite. It comes last in `Environment.outcomes`."""


class Environment(Described, Component):
    """A task: platforms and regions, and the processors that give their state a meaning.

    The world moves `dt` seconds a step. The agent acts on every `decision_period`-th of these
    steps, and its control is held in between.

    `randomize` names numbers of the environment by dotted path, each with the interval from which
    every episode draws it. `tied` names numbers that follow other numbers when these are changed or
    drawn, such as a slope that is twice the mean motion.

    `cost` says what a step costs that violates a constraint: 1, or its `severity`, which is how far
    the constraint is violated as a share of its limit.

    `measure` names metrics of one's own, which trainings and evaluations report. Each is a status
    and what to take of it over the steps of an episode, such as `speed.maximum`: the `mean`, the
    `maximum`, the `minimum` or the `final` value.

    `uncertainty` lists how the world differs from its model: disturbances, faults, delays. No
    filter knows of them.
    """

    shorthand: ClassVar[str | None] = "platforms"
    _task: ClassVar[str] = ""

    agent: PlatformName
    dt: Annotated[Number, Unit("s"), Range(0.0, open_low=True, smallest=1e-6, largest=1e5)] = 1.0
    decision_period: Annotated[int, Range(1, largest=10_000)] = 1
    platforms: tuple[Platform, ...]
    regions: tuple[Region, ...] = ()
    status: tuple[Status, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    cost: Literal["violation", "severity"] = "violation"
    measure: tuple[str, ...] = ()
    uncertainty: tuple[Uncertainty, ...] = ()
    terminal: tuple[Terminal, ...]
    reward: tuple[Reward, ...]
    observation: tuple[Observation, ...]
    randomize: Mapping[ParameterPath, Annotated[Number, Unit("physical", length=2)]] = (
        dataclasses.field(default_factory=dict)
    )
    tied: Mapping[str, Tie] = dataclasses.field(default_factory=dict)
    rta: RTA | None = None

    def reset(self, key: Key) -> tuple[State, TimeStep]:
        """Draw a random start of an episode: `jaxsafe.reset(env, key)`."""
        return reset(self, key)

    def step(self, state: State, action: Array) -> tuple[State, TimeStep]:
        """Advance by one action: `jaxsafe.step(env, state, action)`."""
        return step(self, state, action)

    @property
    def task(self) -> str:
        """The name of the task, for messages. It is empty after a transformation of JAX."""
        return self._task

    def platform(self, name: str) -> Platform:
        """Return a platform by name."""
        return next(platform for platform in self.platforms if platform.name == name)

    @property
    def agent_platform(self) -> Platform:
        """The platform that the actions drive."""
        return self.platform(self.agent)

    @property
    def outcomes(self) -> tuple[str, ...]:
        """The names of the outcomes, in the order in which `info.outcome` counts them.

        They are `running`, the terminal conditions in their order, the outcomes of bounded reward
        terms in their order, and `diverged`.
        """
        bounds = [term.bound.outcome for term in self.reward if term.bound]
        return ("running", *(condition.name for condition in self.terminal), *bounds, DIVERGED)

    @property
    def successes(self) -> tuple[str, ...]:
        """The names of the outcomes that count as success, in the order of `outcomes`.

        They are the outcomes marked by `success: true`. The outcome called `success` counts without
        a mark, unless it is marked by `success: false`.
        """
        bounds = {term.bound.outcome: term.bound.success for term in self.reward if term.bound}
        marks = {condition.name: condition.success for condition in self.terminal} | bounds
        return tuple(
            name for name, mark in marks.items() if (name == SUCCESS if mark is None else mark)
        )

    @property
    def success_indices(self) -> tuple[int, ...]:
        """The indices in `outcomes` of the outcomes that count as success."""
        return tuple(map(self.outcomes.index, self.successes))

    def succeeded(self, outcome: Any) -> Any:
        """Return which episodes succeeded, as booleans of the shape of `outcome`.

        Args:
            outcome: how they ended, as `info.outcome`. It may be an array of any shape.
        """
        flags = [outcome == index for index in self.success_indices]
        # No outcome is below 0, so without a success among the outcomes none has succeeded.
        return functools.reduce(operator.or_, flags) if flags else outcome < 0

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """The actuators in the order of the action. Empty if the agent's controller lists none."""
        return getattr(self.agent_platform.controller, "actuators", ())

    @property
    def action_names(self) -> tuple[str, ...]:
        """The names of the actuators in the order of the action."""
        return self.agent_platform.controller.names

    @property
    def action_size(self) -> int:
        """The number of elements of an action."""
        return len(self.action_names)

    @property
    def num_action_points(self) -> tuple[int, ...]:
        """The number of choices for each element of an action, 0 for a continuous element.

        It is `()` if all are continuous.
        """
        return self.agent_platform.controller.points

    @property
    def action_kind(self) -> Literal["continuous", "discrete", "mixed"]:
        """The kind of actions: vectors of numbers, of indices, or of both."""
        points = self.num_action_points
        if not any(points):
            return "continuous"
        return "discrete" if all(points) else "mixed"

    @functools.cached_property  # asked for often, and each answer traces a reset
    def observation_names(self) -> tuple[str, ...]:
        """A name for each element of the observation."""
        names: list[str] = []

        def append_names(key: Key) -> None:
            sim = reset(self, key)[0].sim
            names.extend(label for item in self.observation for label in item.labels(sim))

        jax.eval_shape(append_names, jax.random.key(0))
        return tuple(names)

    @property
    def observation_size(self) -> int:
        """The number of elements of the observation."""
        return len(self.observation_names)

    def named(self, task: str) -> Self:
        """Return this environment with the name of a task."""
        env = copy.copy(self)
        object.__setattr__(env, "_task", task)
        return env

    def replace(self, **changes: Any) -> Self:
        env = super().replace(**changes)
        object.__setattr__(env, "_task", self._task)
        return env

    def _heading(self) -> str:
        return f"Environment {self.task}".rstrip()

    def _rows(self) -> Rows:
        others = [platform.name for platform in self.platforms if platform.name != self.agent]
        beside = f" beside {', '.join(others)}" if others else ""
        held = f", an action for {self.decision_period} steps" if self.decision_period > 1 else ""
        yield "agent", f"{self.agent}{beside}, {brief(self.dt)} s a step{held}"
        try:
            names = self.observation_names
        except Exception:  # a transformation of JAX may put other things in the place of numbers
            names = [item.name for item in self.observation]
        yield "observation", f"{len(names)} numbers: {', '.join(names)}"
        yield "action", action_text(self)
        yield "reward", ", ".join(term.name for term in self.reward)
        outcomes = [
            f"{name} ({ends})" if ends == "truncated" else name for name, ends in self._ends.items()
        ]
        yield "ends", ", ".join(outcomes)
        yield "constraints", ", ".join(constraint.name for constraint in self.constraints)
        yield "filter", filter_name(self)
        if self.uncertainty:
            yield "uncertainty", ", ".join(item.name for item in self.uncertainty)
        for path, interval in self.randomize.items():
            yield "random", f"{path} in {brief(interval)}"

    @property
    def _ends(self) -> dict[str, str]:
        """How an episode with an outcome ends, `terminated` or `truncated`, by outcome."""
        bounds = {term.bound.outcome: term.bound.ends for term in self.reward if term.bound}
        conditions = {condition.name: condition.ends for condition in self.terminal}
        return conditions | bounds | {DIVERGED: "terminated"}


def require_environment(place: str, env: Any) -> None:
    """Refuse something else where an environment is needed, such as the name of a task.

    Args:
        place: the function and the argument, for the message.
        env: the argument.

    Raises:
        ConfigError: it is no environment.
    """
    if not isinstance(env, Environment):
        example = show(env) if isinstance(env, str) else "'docking2d'"
        raise ConfigError(
            f"{place}: expected an environment, such as jaxsafe.make({example}), found {show(env)}"
        )


def require_success(env: Environment) -> None:
    """Refuse an environment in which nothing would count as a success.

    Raises:
        ConfigError: no outcome is called `success` or marked as one.
    """
    if not env.successes:
        outcomes = ", ".join(env.outcomes[1:-1])
        raise ConfigError(
            "terminal: no outcome counts as a success; mark one with success: true, "
            f"among {outcomes}"
        )


def filter_name(env: Environment) -> str:
    """Return the kind of run time assurance that acts in an environment, or `none`."""
    return "none" if env.rta is None else env.rta.type_name or type(env.rta).__name__


def length_unit(env: Environment) -> str | None:
    """Return the unit of positions, m or ft, or None if the agent's platform names none."""
    return units(type(env.agent_platform.shapes())).get("position")


def control_unit(name: str, length: str | None) -> str | None:
    """Return the unit of a control by the words in its name, or None if it is not known.

    Args:
        name: the name of the control.
        length: the unit of lengths.
    """
    units_by_word = {
        "thrust": "lbf" if length == "ft" else "N",
        "load_factor": "g",
        "rate": "rad/s",
        "wheel_acceleration": "rad/s²",
        "attitude_acceleration": "rad/s²",
        "acceleration": f"{length}/s²",
    }
    return next((unit for word, unit in units_by_word.items() if word in name), None)


def action_bounds(env: Environment) -> tuple[list[Any], list[Any]]:
    """Return the lowest values that make a difference in an action, and the highest.

    Each list has a value for each element of the action. They are −1 and 1 where the actuator
    rescales, −∞ and ∞ where it takes the tanh of an action, and otherwise the actuator's own limits
    in physical units. If episodes draw a limit at random, the widest one that can be drawn counts.
    For an index they are 0 and points − 1.
    """
    if env.action_kind == "continuous" and acts_within_one(env):
        return [-1.0] * env.action_size, [1.0] * env.action_size
    pairs = list(zip(*map(_action_ranges, extremes(env)), strict=True))
    low = [jnp.minimum(a[0], b[0]) for a, b in pairs]
    high = [jnp.maximum(a[1], b[1]) for a, b in pairs]
    return low, high


def acts_within_one(env: Environment) -> bool:
    """Return whether every continuous element of an action is in [−1, 1]."""
    return all(
        actuator.rescale and actuator.post_activation == "clip" for actuator in env.actuators
    )


def _action_ranges(env: Environment) -> list[tuple[Any, Any]]:
    points = env.num_action_points or (0,) * len(env.actuators)
    return [
        (0.0, count - 1.0) if count else actuator.action_range
        for actuator, count in zip(env.actuators, points, strict=True)
    ]


def action_text(env: Environment) -> str:
    """Return what an action is: its kind, and each control that it sets with bounds and unit."""
    points = env.num_action_points or (0,) * env.action_size
    parts = []
    for index, name in enumerate(env.action_names):
        text = f"{name}, {points[index]} points" if points[index] else name
        if env.actuators:
            actuator = env.actuators[index]
            text += f" from {brief(actuator.low)} to {brief(actuator.high)}"
            text += f" {control_unit(name, length_unit(env)) or ''}"
        parts.append(unbroken(text))
    kind = {
        "continuous": "numbers in [-1, 1]" if acts_within_one(env) else "numbers",
        "discrete": "indices",
        "mixed": "numbers and indices",
    }[env.action_kind]
    return f"{env.action_size} {kind}: {'; '.join(parts)}"


def reset(env: Environment, key: Key) -> tuple[State, TimeStep]:
    """Draw a random start of an episode.

    Args:
        env: the environment.
        key: a typed PRNG key, `jax.random.key(seed)`.

    Returns:
        The state and the first time step, whose reward and cost are 0, and whose `terminated` and
        `truncated` are False.

    Raises:
        ConfigError: the key is a plain number.
    """
    require_environment("reset: env", env)
    require_key("reset: key", key)
    parameters = _draw_parameters(env, key)
    env = drawn(env, parameters)
    sim = empty_sim(env)
    platform_keys = jax.random.split(key, len(env.platforms))
    for platform, platform_key in zip(env.platforms, platform_keys, strict=True):
        with part("platforms", platform.name):
            platform_state = platform.reset(platform_key, with_centres(env, sim, platform))
            sim = sim.replace(platforms={**sim.platforms, platform.name: platform_state})
    return _with_own_buffers(_begin(env, sim, parameters, key), others=env)


def reset_to(
    env: Environment,
    start: Mapping[str, Mapping[str, Any]],
    parameters: Mapping[str, Any] | None = None,
    key: Key | None = None,
) -> tuple[State, TimeStep]:
    """Start an episode from chosen platform states.

    An example of a start is `{"deputy": {"position": [100, 0, 0], "velocity": [0, 0.1, 0]}}`.

    Args:
        env: the environment.
        start: the fields of states, by platform name and field name. Every field that is random at
            reset must be given.
        parameters: the numbers that `env.randomize` draws, by dotted path. All of them must be
            given.
        key: a typed PRNG key, from which disturbances and errors of sensors are drawn. It must be
            given if the environment has any.

    Returns:
        The state and the first time step, as `reset` returns them.

    Raises:
        ConfigError: a platform, field or parameter is unknown, or a random one is missing or has
            another shape, or the key is missing.
    """
    require_environment("reset_to: env", env)
    parameters = {} if parameters is None else parameters
    for label, argument in {"platforms": start, "parameters": parameters}.items():
        if not isinstance(argument, Mapping):
            raise ConfigError(f"reset_to: expected {label} by name, found {show(argument)}")
    parameters = _chosen_parameters(env, parameters)
    env = drawn(env, parameters)
    names = [platform.name for platform in env.platforms]
    for name in start:
        if name not in names:
            raise ConfigError(f"reset_to: unknown platform {show(name)}{choices_text(name, names)}")
    platforms = {
        platform.name: platform.place(start.get(platform.name, {})) for platform in env.platforms
    }
    sim = empty_sim(env).replace(platforms=platforms)
    random = random_parts(env)
    if random and key is None:
        raise ConfigError(f"reset_to: {random[0]} is random in every step, so give a key")
    return _with_own_buffers(_begin(env, sim, parameters, key), others=(env, start, key))


def step(env: Environment, state: State, action: Array) -> tuple[State, TimeStep]:
    """Advance one time step, or as many as `decision_period` says.

    A step never resets by itself, and never looks at an earlier outcome. With a `decision_period`
    the control of the action is held for several steps of the world, and the filter, statuses and
    rewards see each of them. Nothing moves after a step that ends the episode. `Info` says which of
    its values are summed over these steps.

    Args:
        env: the environment.
        state: the state that `reset` or `step` returned.
        action: floats in [−1, 1] of shape (action_size,), which are clipped. Discrete actions are
            int indices of the same shape, clipped to 0 … points − 1. Mixed actions are floats of
            the same shape, in which indices are rounded to whole numbers.

    Returns:
        The next state, and the time step that led there.

    Raises:
        ConfigError: the state is something else, or the action has another shape, or is not whole
            numbers where actions are discrete.
    """
    require_environment("step: env", env)
    if not isinstance(state, State):
        raise ConfigError(
            f"step: state: expected the State that reset or step returned, found {show(state)}"
        )
    env = drawn(env, state.parameters)
    action = _checked(env, action)
    controls = env.agent_platform.controller.control(action, state.sim)
    desired = jnp.stack([controls[name] for name in env.action_names])
    taken = _world_step(env, state, desired)
    if env.decision_period == 1:
        return taken

    def hold(taken: tuple[State, TimeStep], _: None) -> tuple[tuple[State, TimeStep], None]:
        before, so_far = taken
        after, timestep = _world_step(env, before, desired)
        following = (after, _together(env, so_far, timestep))
        return jax.tree.map(lambda a, b: jnp.where(so_far.done, a, b), taken, following), None

    (after, timestep), _ = jax.lax.scan(hold, taken, length=env.decision_period - 1)
    # `control_actual` is still a sum, and becomes the mean here.
    count = (after.num_steps - state.num_steps).astype(desired.dtype)
    info = timestep.info.replace(control_actual=timestep.info.control_actual / count)
    return after, timestep.replace(info=info)


def _world_step(env: Environment, state: State, desired: Array) -> tuple[State, TimeStep]:
    """Advance the world by `dt` seconds.

    Args:
        env: the environment, with the numbers of this episode.
        state: the state before the step.
        desired: the control that the agent asks for, in physical units and action order.
    """
    actual, rta_memory, rta_info = _filtered(env, state, desired)
    num_steps = state.num_steps + 1
    key = step_key(state.key, num_steps)
    arriving, uncertainty_memory = received(env, state, key, actual)
    later = advance(env, state.sim, arriving)
    platforms = disturbed(env, uncertainty_memory, later.platforms)
    sim = empty_sim(env).replace(
        time=num_steps.astype(env.dt.dtype) * env.dt,
        platforms=platforms,
        actuators=later.actuators,
    )
    intervening = jnp.zeros((), bool) if rta_info is None else rta_memory.intervening
    sim = sim.replace(intervening=intervening, control_desired=desired, control_actual=actual)

    sim, status_memory = update_statuses(env, sim, state.memory.status)
    sim = _update_ended(env, sim)
    sim, reward_memory, terms, totals = _rewards(env, sim, state)
    observation, observation_memory, readings = _observations(
        env, measured(env, sim, uncertainty_memory), key, state.memory
    )

    info = _info(env, sim, terms=terms, totals=totals, rta_info=rta_info)
    timestep = _time_step(
        env, sim, observation=observation, reward=jnp.asarray(sum(terms.values())), info=info
    )
    memory = Memory(
        status=status_memory,
        reward=reward_memory,
        observation=observation_memory,
        rta=rta_memory,
        uncertainty=uncertainty_memory,
        sensors=readings,
    )
    state = State(
        sim=_for_next_step(sim),
        memory=memory,
        reward_totals=totals,
        num_steps=num_steps,
        parameters=state.parameters,
        key=state.key,
    )
    return state, timestep


def _together(env: Environment, before: TimeStep, now: TimeStep) -> TimeStep:
    """Combine the time step of the earlier steps of an action with the time step of the last one.

    Values that are not named here are those of the last step. The controls that acted are summed.
    """
    earlier = before.info
    info = now.info
    add = functools.partial(jax.tree.map, jnp.add)
    summed = {status.name for status in env.status if status.per_step}
    status = {
        name: earlier.status[name] + value if name in summed else value
        for name, value in info.status.items()
    }
    rta = info.rta
    if rta is not None and earlier.rta is not None:
        rta = rta.replace(
            correction=jnp.maximum(earlier.rta.correction, rta.correction),
            feasible=earlier.rta.feasible & rta.feasible,
            certified=earlier.rta.certified & rta.certified,
            predicted_margin=jnp.minimum(earlier.rta.predicted_margin, rta.predicted_margin),
            constraint=jnp.where(rta.constraint >= 0, rta.constraint, earlier.rta.constraint),
        )
    info = info.replace(
        status=status,
        reward_terms=add(earlier.reward_terms, info.reward_terms),
        control_actual=earlier.control_actual + info.control_actual,
        intervening=earlier.intervening | info.intervening,
        margins=jax.tree.map(jnp.minimum, earlier.margins, info.margins),
        severity=jax.tree.map(jnp.maximum, earlier.severity, info.severity),
        rta=rta,
    )
    return now.replace(
        reward=before.reward + now.reward,
        cost=jnp.maximum(before.cost, now.cost),
        costs=jax.tree.map(jnp.maximum, before.costs, now.costs),
        info=info,
    )


def _with_own_buffers(started: tuple[State, TimeStep], others: Any) -> tuple[State, TimeStep]:
    """Copy arrays that stand in several places, so that the state may be donated.

    A compiled reset needs no copies, because it returns an array of its own for each place.

    Args:
        started: a state and its time step. An array that stands there twice is copied.
        others: a tree. Its arrays are copied where they stand in `started` as well.
    """
    seen = {id(leaf) for leaf in jax.tree.leaves(others)}

    def own(leaf: Any) -> Any:
        shared = id(leaf) in seen and not isinstance(leaf, Tracer)
        seen.add(id(leaf))
        return jnp.copy(leaf) if shared else leaf

    return jax.tree.map(own, started)


def _draw_parameters(env: Environment, key: Key) -> Parameters:
    """Draw the random numbers of the environment for one episode.

    They have a key of their own, so that platforms start alike with and without them.
    """
    if not env.randomize:
        return {}
    # Which number a path gets must not depend on the order in which the paths were written.
    paths = sorted(env.randomize)
    own_key = jax.random.fold_in(key, len(env.platforms))
    numbers = uniform(own_key, *(env.randomize[path] for path in paths))
    return dict(zip(paths, numbers, strict=True))


def _chosen_parameters(env: Environment, parameters: Mapping[str, Any]) -> Parameters:
    """Check the numbers that a user chose in place of random ones, and convert them."""
    for path in parameters:
        if path not in env.randomize:
            hint = choices_text(path, env.randomize)
            raise ConfigError(f"reset_to: parameter {show(path)} is not random{hint}")
    for path in env.randomize:
        if path not in parameters:
            raise ConfigError(
                f"reset_to: parameter {path!r} is missing: it is random at reset, so give it"
            )
    return {path: placed(f"parameter {path}", parameters[path], env.dt) for path in env.randomize}


def drawn(env: Environment, parameters: Parameters) -> Environment:
    """Return the environment with the numbers that an episode has drawn, `state.parameters`.

    The numbers that are tied to them follow.
    """
    for path, value in parameters.items():
        env = set_path(env, path, value)
    return follow(env, env.tied, parameters)


def extremes(env: Environment) -> tuple[Environment, Environment]:
    """Return the environment with the least and with the greatest value of every random number."""
    low = {path: interval[0] for path, interval in env.randomize.items()}
    high = {path: interval[1] for path, interval in env.randomize.items()}
    return drawn(env, low), drawn(env, high)


def longest_episode(env: Environment) -> Float[Array, ""] | None:
    """Return the number of actions after which every episode has ended by its time limit.

    A random time limit counts with its largest value, and a random length of a step with its
    smallest. None is returned if the task has no time limit.
    """
    low, high = extremes(env)
    limit = time_limit(high)
    if limit is None:
        return None
    # Two more: a timeout needs t > limit, and limit / dt may round down.
    return jnp.ceil((jnp.ceil(limit / low.dt) + 2.0) / env.decision_period)


def empty_sim(env: Environment) -> Sim:
    """Return a simulation at time 0 without platforms and controls, in which nothing has ended.

    Actuators with a lag or a rate limit give 0, or the limit nearest to it.
    """
    no_control = jnp.zeros(env.action_size, env.dt.dtype)
    return Sim(
        time=jnp.zeros_like(env.dt),
        platforms={},
        regions={},
        status={},
        ended={name: jnp.zeros((), bool) for name in env.outcomes[1:]},
        intervening=jnp.zeros((), bool),
        control_desired=no_control,
        control_actual=no_control,
        actuators={
            actuator.name: jnp.clip(jnp.zeros_like(env.dt), actuator.low, actuator.high)
            for actuator in env.actuators
            if not actuator.at_once
        },
    )


def _begin(
    env: Environment, sim: Sim, parameters: Parameters, key: Key | None
) -> tuple[State, TimeStep]:
    """Initialise all processors from placed platforms: `init` and `process`, no `increment`."""
    # Uncertainty has a key of its own, so that platforms start alike with and without it.
    key_words: Any = ()
    if key is not None and random_parts(env):
        key_words = episode_words(key, len(env.platforms) + 1)
    first_key = step_key(key_words, jnp.zeros((), jnp.int32))
    sim, status_memory = update_statuses(env, sim, {})
    uncertainty_memory = begun(env, sim, first_key)
    seen = measured(env, sim, uncertainty_memory)
    ended = _update_ended(env, sim)
    observation, observation_memory, readings = _observations(env, seen, first_key, None)
    reward_memory = {}
    for term in env.reward:
        with part("reward", term.name):
            reward_memory[term.name] = term.init(sim)
    zero = jnp.zeros((), observation.dtype)
    terms = {term.name: zero for term in env.reward}
    rta_memory = ()
    rta_info = None
    if env.rta is not None:
        with part("rta"):
            rta_memory, rta_info = env.rta.begin(
                modelled(env), with_memory(env, seen, status_memory)
            )
    info = _info(env, ended, terms=terms, totals=terms, rta_info=rta_info)
    memory = Memory(
        status=status_memory,
        reward=reward_memory,
        observation=observation_memory,
        rta=rta_memory,
        uncertainty=uncertainty_memory,
        sensors=readings,
    )
    state = State(
        sim=_for_next_step(sim),
        memory=memory,
        reward_totals=terms,
        num_steps=jnp.zeros((), jnp.int32),
        parameters=parameters,
        key=key_words,
    )
    # The time step is made of `sim`, in which nothing has ended. The first step is always taken.
    timestep = _time_step(env, sim, observation=observation, reward=zero, info=info)
    return state, timestep.replace(cost=zero, costs=dict.fromkeys(timestep.costs, zero))


def _checked(env: Environment, action: Array) -> Array:
    """Check the shape and the type of an action, which are known while tracing.

    JAX itself would clamp an index out of range and say nothing.
    """
    expected = (env.action_size,)
    names = ", ".join(env.action_names)
    try:
        action = jnp.asarray(action)
    except (TypeError, ValueError):  # text, None, or rows of different lengths
        raise ConfigError(
            f"action: expected shape {expected} ({names}), found {show(action)}"
        ) from None
    if action.shape != expected:
        batched = action.shape[1:] == expected
        advice = "; for a batch, write jax.vmap around step" if batched else ""
        raise ConfigError(
            f"action: expected shape {expected} ({names}), found {action.shape}{advice}"
        )
    kind = env.action_kind
    if kind == "mixed":
        return action.astype(env.dt.dtype)
    if kind == "discrete" and not jnp.issubdtype(action.dtype, jnp.integer):
        raise ConfigError(
            f"action: expected whole numbers, indices of {env.num_action_points} points, "
            f"found {action.dtype}"
        )
    return action


def _update_ended(env: Environment, sim: Sim) -> Sim:
    """Return the simulation with what ended the episode.

    The first terminal condition that holds ends it. Conditions that stand apart end it besides. If
    the state is not finite, no condition counts but `diverged`, because comparisons with such
    numbers mean nothing.
    """
    diverged = _diverged(env, sim)
    ended = {DIVERGED: diverged}
    over = diverged
    for condition in env.terminal:
        with part("terminal", condition.name):
            reached = condition.reached(sim)
            ended[condition.name] = reached & ~(diverged if condition.apart else over)
            over = over if condition.apart else over | reached
    return sim.replace(ended={**sim.ended, **ended})


def _for_next_step(sim: Sim) -> Sim:
    """Return the simulation as a state keeps it: without what ended, which no step looks at."""
    return sim.replace(ended={})


def _diverged(env: Environment, sim: Sim) -> Bool[Array, ""]:
    """Return whether a status that ends or judges the episode is NaN, or the state is not finite.

    A vector whose norm is such a status is not checked by itself: if it has a NaN, so has the
    status, and an infinite norm is beyond any limit. Of other platforms only the position is
    checked. Any other number of theirs that is not finite shows in the position a step later.
    Checks of each number took up to a third of the time of a step.
    """
    judging = set(status_names((*env.terminal, *env.constraints)))
    statuses = [status for status in env.status if status.name in judging]
    seen = {vector for status in statuses for vector in status.vectors()}
    agent = sim.platforms[env.agent]
    own = {field: () for name, field in seen if name == env.agent and hasattr(agent, field)}
    others = [
        sim.platforms[platform.name].position
        for platform in env.platforms
        if platform.name != env.agent and (platform.name, "position") not in seen
    ]
    flags = []
    # One sum and one comparison, because several comparisons take longer.
    if values := list(filter(_is_float, (sim.status[status.name] for status in statuses))):
        flags.append(jnp.isnan(functools.reduce(operator.add, map(jnp.abs, values))))
    if numbers := [*others, *filter(_is_float, jax.tree.leaves(agent.replace(**own)))]:
        together = jnp.concatenate([jnp.ravel(number) for number in numbers])
        flags.append(~jnp.all(jnp.isfinite(together)))
    return _any(flags)


def _is_float(value: Array) -> bool:
    return jnp.issubdtype(value.dtype, jnp.floating)


def _rewards(env: Environment, sim: Sim, state: State) -> tuple[Sim, dict, dict, dict]:
    """Compute the reward terms in order.

    A bounded term may end the episode, and the terms after it see that.

    Returns:
        The simulation with what ended the episode. Then, each by name of the term: the memories,
        the values of this step, and the totals in this episode.
    """
    memories = {}
    terms = {}
    totals = {}
    for term in env.reward:
        with part("reward", term.name):
            memory = term.increment(state.memory.reward[term.name], sim, env.dt)
            value = term.process(memory, sim)
            total = state.reward_totals[term.name] + value
        memories[term.name] = memory
        terms[term.name] = value
        totals[term.name] = total
        if term.bound:
            apart = {condition.name for condition in env.terminal if condition.apart}
            over = _any(ended for name, ended in sim.ended.items() if name not in apart)
            below = (total < term.bound.below) & ~over
            sim = sim.replace(ended={**sim.ended, term.bound.outcome: below})
    return sim, memories, terms, totals


def _observations(
    env: Environment, sim: Sim, key: Any, memory: Memory | None
) -> tuple[Float[Array, " observation"], dict[str, Any], dict[str, Any]]:
    """Return the observation, what its parts remember, and the readings that are under way.

    The latter two are by name of the part. A reading is under way while its sensor delays it.

    Args:
        env: the environment.
        sim: the simulation, as it is measured.
        key: the key of the step, () if nothing is random.
        memory: the memory before the step. None at the start of an episode.
    """
    memories = {}
    readings = {}
    values = []
    for index, item in enumerate(env.observation):
        name = item.name
        with part("observation", name):
            own = (
                item.init(sim)
                if memory is None
                else item.increment(memory.observation[name], sim, env.dt)
            )
            if item.exact:
                values.append(item.process(own, sim))
            else:
                under_way = None if memory is None else memory.sensors[name]
                own_key = part_key(key, len(env.uncertainty) + index)
                reading, readings[name] = item.read(item.measure(own, sim), under_way, own_key)
                values.append(item.scaled(reading))
        memories[name] = own
    return jnp.concatenate(values), memories, readings


def _filtered(env: Environment, state: State, desired: Array) -> tuple[Array, Any, RTAInfo | None]:
    """Return the control that acts, and the memory and the info of run time assurance.

    Without run time assurance the desired control acts.
    """
    if env.rta is None:
        return desired, (), None
    with part("rta"):
        sim = measured(env, state.sim, state.memory.uncertainty)
        sim = with_memory(env, sim, state.memory.status)
        return env.rta.filter(modelled(env), sim, state.memory.rta, desired)


def modelled(env: Environment) -> Environment:
    """Return the environment as its filter takes it to be, with the numbers of `rta.model`."""
    return env if env.rta is None else drawn(env, env.rta.model)


def _info(
    env: Environment,
    sim: Sim,
    *,
    terms: dict,
    totals: dict,
    rta_info: RTAInfo | None,
) -> Info:
    outcome = jnp.zeros((), jnp.int32)
    for index, name in reversed(list(enumerate(env.outcomes))[1:]):
        outcome = jnp.where(sim.ended[name], index, outcome)
    margins = {}
    severity = {}
    for constraint in env.constraints:
        with part("constraints", constraint.name):
            margin = constraint.margin(sim)
            excess = jnp.maximum(-margin, 0.0) / constraint.limit(sim)
            # A margin that is not a number counts as a violation by the whole limit.
            finite_excess = jnp.where(jnp.isfinite(excess), excess, 1.0)
            margins[constraint.name] = margin
            severity[constraint.name] = jnp.where(margin >= 0.0, 0.0, finite_excess)
    return Info(
        outcome=outcome,
        ended=sim.ended,
        status=sim.status,
        reward_terms=terms,
        reward_totals=totals,
        control_desired=sim.control_desired,
        control_actual=sim.control_actual,
        intervening=sim.intervening,
        margins=margins,
        severity=severity,
        rta=rta_info,
    )


def _time_step(
    env: Environment, sim: Sim, *, observation: Array, reward: Array, info: Info
) -> TimeStep:
    dtype = observation.dtype
    # A margin that is not a number is violated too.
    costs = {name: (~(margin >= 0.0)).astype(dtype) for name, margin in info.margins.items()}
    if env.cost == "severity":
        costs = {name: severity.astype(dtype) for name, severity in info.severity.items()}
    terminated = _any(sim.ended[name] for name, ends in env._ends.items() if ends == "terminated")
    truncated = _any(sim.ended[name] for name, ends in env._ends.items() if ends == "truncated")
    return TimeStep(
        observation=observation,
        reward=reward,
        cost=functools.reduce(jnp.maximum, costs.values(), sim.ended[DIVERGED].astype(dtype)),
        terminated=terminated,
        truncated=truncated,
        info=info,
        costs=costs,
    )


def _any(flags: Iterable[Array]) -> Array:
    return functools.reduce(jnp.logical_or, flags, jnp.zeros((), bool))
