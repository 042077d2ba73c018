"""Prediction over many steps, and whether the other platforms react to what the agent does."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxsafe.transition import Others, others_later
from jaxsafe.types import Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

T = TypeVar("T")


def others_react(env: Environment, sim: Sim) -> bool:
    """Return whether any other platform looks at the agent's state.

    If so, other platforms move differently after other controls of the agent. The answer is found
    by tracing, so it costs nothing at run time: whatever looks at a mapped state is mapped itself.
    """

    def later(agent_state: Any) -> Others:
        platforms = {**sim.platforms, env.agent: agent_state}
        return others_later(env, sim.replace(platforms=platforms, regions={}, status={}))

    two_states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), sim.platforms[env.agent])
    try:
        jax.eval_shape(jax.vmap(later, out_axes=None), two_states)
    except ValueError:  # an output is mapped, but `out_axes` says that none is
        return True
    return False


def repeat(function: Callable[[T], T], start: T, count: int) -> T:
    """Return the result of applying a function `count` times.

    Between two applications every number is a variable of its own, so a batch of each is
    contiguous. In a batch of vectors XLA would interleave their elements and compute one at a time,
    which is several times slower for aircraft.
    """
    leaves, tree = jax.tree.flatten(start)
    shapes = [leaf.shape for leaf in leaves]

    def split(value: T) -> list[list[Array]]:
        return [list(leaf.reshape(-1)) for leaf in jax.tree.leaves(value)]

    def join(numbers: list[list[Array]]) -> T:
        joined = [
            jnp.stack(part).reshape(shape) for part, shape in zip(numbers, shapes, strict=True)
        ]
        return jax.tree.unflatten(tree, joined)

    def apply(numbers: list[list[Array]], _: None) -> tuple[list[list[Array]], None]:
        return split(function(join(numbers))), None

    numbers, _ = jax.lax.scan(apply, split(start), length=count)
    return join(numbers)
