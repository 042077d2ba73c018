"""How the parts of `uncertainty` act in a step, and the keys from which they draw.

The environment steps with these functions. Its filters do not know of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.errors import part
from jaxsafe.types import Key, Sim, State

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


def begun(env: Environment, sim: Sim, key: Any) -> dict[str, Any]:
    """Return what the parts of `uncertainty` remember at the start of an episode, by name of part.

    Args:
        env: the environment.
        sim: the simulation at the start.
        key: the key of the start, () if nothing is random.
    """
    memories = {}
    for index, item in enumerate(env.uncertainty):
        with part("uncertainty", item.name):
            memories[item.name] = item.init(env, sim, part_key(key, index))
    return memories


def measured(env: Environment, sim: Sim, memory: Mapping[str, Any]) -> Sim:
    """Return the simulation as filters and observations see it, with errors of navigation.

    Args:
        env: the environment.
        sim: the true simulation.
        memory: what the parts of `env.uncertainty` remember, by name.
    """
    for item in env.uncertainty:
        with part("uncertainty", item.name):
            sim = item.measured(env, sim, memory[item.name])
    return sim


def random_parts(env: Environment) -> list[str]:
    """Return the paths of the parts that draw random numbers in every step."""
    uncertain = [f"uncertainty.{item.name}" for item in env.uncertainty if item.draws]
    return uncertain + [f"observation.{item.name}" for item in env.observation if item.draws]


def episode_words(key: Key, stream: int) -> Any:
    """Return the two words of an episode's threefry key, drawn from a key of any kind.

    A state holds the words in place of the key, so that all its leaves are arrays of numbers.

    Args:
        key: the key of the reset.
        stream: a number that no other draw from `key` uses.

    Returns:
        Words of shape (2,) and type uint32.
    """
    return jax.random.bits(jax.random.fold_in(key, stream), (2,), jnp.uint32)


def step_key(words: Any, num_steps: Array) -> Any:
    """Return the key of a step from the words of the episode's key. From () return ()."""
    if isinstance(words, tuple):
        return words
    return jax.random.fold_in(episode_key(words), num_steps)


def episode_key(words: Array) -> Key:
    """Return the key of an episode from its words, whatever kind of key JAX makes by default."""
    return jax.random.wrap_key_data(words, impl="threefry2x32")


def part_key(key: Any, index: int) -> Any:
    """Return the key of a part from the key of the step. From () return ()."""
    return key if isinstance(key, tuple) else jax.random.fold_in(key, index)


def received(
    env: Environment, state: State, key: Any, control: Float[Array, " m"]
) -> tuple[Float[Array, " m"], dict[str, Any]]:
    """Return the control that the plant receives, and what the parts of `uncertainty` remember.

    Args:
        env: the environment.
        state: the state before the step.
        key: the key of the step, () if nothing is random.
        control: the control of the step, after run time assurance.
    """
    memories: dict[str, Any] = {}
    for index, item in enumerate(env.uncertainty):
        with part("uncertainty", item.name):
            memory = item.increment(
                env, state.sim, part_key(key, index), state.memory.uncertainty[item.name], control
            )
            control = item.received(env, state.sim, memory, control)
        memories[item.name] = memory
    return control, memories


def arriving(
    env: Environment, sim: Sim, memory: Mapping[str, Any], control: Float[Array, " m"]
) -> Float[Array, " m"]:
    """Return the control that the plant receives in a step, given what the parts remember in it.

    Args:
        env: the environment.
        sim: the simulation before the step.
        memory: what the parts of `env.uncertainty` remember in the step, by name.
        control: the control of the step, after run time assurance.
    """
    for item in env.uncertainty:
        control = item.received(env, sim, memory[item.name], control)
    return control


def disturbed(
    env: Environment, memory: Mapping[str, Any], platforms: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Return the platforms after a step, disturbed by the parts of `uncertainty`.

    Args:
        env: the environment.
        memory: what the parts of `env.uncertainty` remember in the step, by name.
        platforms: the platforms after the step as the model predicts them, by name.
    """
    for item in env.uncertainty:
        with part("uncertainty", item.name):
            platforms = item.moved(env, memory[item.name], platforms)
    return platforms
