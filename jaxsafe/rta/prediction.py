"""Prediction over many steps, and what it assumes of the other platforms."""

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
