"""Functions of a policy that can be exported.

They are its network, its action on an observation, its control of a state, and the closed loop.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.distributions import Gaussian, Joint
from jaxsafe.agents.imported_policy import ForeignPolicy
from jaxsafe.agents.policy_file import SavedPolicy
from jaxsafe.environment import Environment, reset_to, step
from jaxsafe.schema.errors import ConfigError
from jaxsafe.types import State, TimeStep
from jaxsafe.uncertain import random_parts

Function = Callable[[Float[Array, "batch i"]], Float[Array, "batch o"]]
"""A function of a batch of vectors."""


class Exported(NamedTuple):
    """A function of a batch of vectors, with a name for each element of its input and output."""

    function: Function
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def network(saved: SavedPolicy) -> Exported:
    """Return the actor alone.

    It is a function from the features that the actor sees to the means of its actions. If actions
    are discrete, it returns their logits. If they are mixed, it returns the means of the continuous
    ones and then the logits of the others.

    Raises:
        ConfigError: the policy remembers.
    """
    _require_no_memory(saved)
    observation = jax.ShapeDtypeStruct((saved.env.observation_size,), jnp.float32)
    size = jax.eval_shape(lambda x: saved.agent.inputs(saved.env, x), observation).shape[0]
    points = saved.env.num_action_points or (0,) * saved.env.action_size
    means = [name for name, count in zip(saved.env.action_names, points, strict=True) if not count]
    names = (*means, *(f"logit_{i}" for i in range(sum(points))))

    def function(features: Array) -> Array:
        distribution = saved.agent.distribution(saved.env, saved.params, features)
        if isinstance(distribution, Joint):
            parts = [distribution.normal.mean, distribution.choices.logits]
            return jnp.concatenate(parts, axis=-1)
        return distribution.mean if isinstance(distribution, Gaussian) else distribution.logits

    return Exported(function, tuple(f"feature_{i}" for i in range(size)), names)


def _require_no_memory(saved: SavedPolicy | ForeignPolicy) -> None:
    """Refuse a policy that remembers, because an exported function has nowhere to keep a memory.

    Raises:
        ConfigError: the policy remembers.
    """
    if isinstance(saved.agent, Agent) and saved.agent.actor.recurrent:
        raise ConfigError(
            f"run: the actor is {saved.agent.actor.type_name!r}, which remembers; "
            "an exported function has no memory"
        )


def action(saved: SavedPolicy | ForeignPolicy) -> Exported:
    """Return the function from an observation to the action that the environment takes.

    The action is the mode of the policy's distribution. Computing the features is part of the
    function.

    Raises:
        ConfigError: the policy remembers.
    """
    _require_no_memory(saved)

    def function(observation: Array) -> Array:
        inputs = saved.agent.inputs(saved.env, observation)
        return saved.agent.distribution(saved.env, saved.params, inputs).mode().astype(jnp.float32)

    return Exported(function, saved.env.observation_names, saved.env.action_names)


def control(saved: SavedPolicy | ForeignPolicy) -> Exported:
    """Return the function from a start to the control that acts first, in physical units.

    The start is the state in which an episode begins, with the elements of `state_names`.

    Raises:
        ConfigError: the policy remembers, or the environment is random in every step.
    """
    _require_nothing_random(saved.env)
    act = action(saved).function

    def first_control(start: Array) -> Array:
        env = saved.env.replace(decision_period=1)
        state, timestep = reset_to(env, _placed(env, start))
        _, following = step(env, state, _as_action(env, act(timestep.observation)))
        return following.info.control_actual

    return Exported(jax.vmap(first_control), state_names(saved.env), saved.env.action_names)


def closed_loop(saved: SavedPolicy | ForeignPolicy, steps: int, unrolled: bool = False) -> Exported:
    """Return the function from a start to every safety margin h on the way.

    The margins are those at the start and the smallest of each step. The way is safe if all of them
    are ≥ 0.

    Args:
        saved: the policy.
        steps: number of steps.
        unrolled: whether the function has no loop. An ONNX graph must not have one. XLA would take
            minutes to compile a function without a loop.

    Raises:
        ConfigError: the policy remembers, or the environment is random in every step.
    """
    _require_nothing_random(saved.env)
    act = action(saved).function
    env = saved.env
    world = env.replace(decision_period=1)

    def margins(timestep: TimeStep) -> Array:
        return jnp.stack([timestep.info.margins[constraint.name] for constraint in env.constraints])

    def advance(carry: tuple[State, Array], _: Any) -> tuple[tuple[State, Array], Array]:
        state, observation = carry
        action = _as_action(env, act(observation))
        within_step = []
        for _ in range(env.decision_period):
            state, timestep = step(world, state, action)
            observation = timestep.observation
            within_step.append(margins(timestep))
        return (state, observation), functools.reduce(jnp.minimum, within_step)

    def all_margins(start: Array) -> Array:
        state, timestep = reset_to(env, _placed(env, start))
        carry = (state, timestep.observation)
        at_start = margins(timestep)
        if not unrolled:
            return jnp.concatenate([at_start, jax.lax.scan(advance, carry, None, steps)[1].ravel()])
        on_the_way = [at_start]
        for _ in range(steps):
            carry, smallest = advance(carry, None)
            on_the_way.append(smallest)
        return jnp.concatenate(on_the_way)

    names = tuple(
        f"{constraint.name}_{t}" for t in range(steps + 1) for constraint in env.constraints
    )
    return Exported(jax.vmap(all_margins), state_names(env), names)


def state_names(env: Environment) -> tuple[str, ...]:
    """Return the names of the numbers that a start draws, in the order of the exported state.

    A name is `platform.field`, or `platform.field.axis` for an element of a vector.
    """
    names = []
    for path, size in _fields(env):
        names += [path] if size == 0 else [f"{path}.{'xyz'[axis]}" for axis in range(size)]
    return tuple(names)


def _fields(env: Environment) -> list[tuple[str, int]]:
    """Return the path and the number of elements of each field that a start draws.

    The number is 0 for a scalar.
    """
    fields = []
    for platform in env.platforms:
        rest = platform.rest()
        for name in platform.random_fields:
            shape = jnp.shape(getattr(rest, name))
            fields.append((f"{platform.name}.{name}", shape[0] if shape else 0))
    return fields


def _require_nothing_random(env: Environment) -> None:
    """Refuse an environment with disturbances or errors that are drawn in every step.

    Raises:
        ConfigError: the environment has some.
    """
    random = random_parts(env)
    if random:
        raise ConfigError(
            f"{random[0]} is random in every step, and an exported function is not; take it out"
        )


def _placed(env: Environment, start: Array) -> dict[str, dict[str, Array]]:
    """Return a start as `reset_to` takes it, from the vector of its numbers."""
    placed: dict[str, dict[str, Array]] = {}
    at = 0
    for path, size in _fields(env):
        platform, field = path.split(".")
        placed.setdefault(platform, {})[field] = start[at : at + size] if size else start[at]
        at += size or 1
    return placed


def _as_action(env: Environment, action: Array) -> Array:
    return action.astype(jnp.int32) if env.action_kind == "discrete" else action
