"""Starts of adversaries: those of the task, or such at the edge of what a filter certifies."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.environment import drawn, reset, reset_to
from jaxsafe.evaluate.adversaries import other_platform
from jaxsafe.processors.terminal import TooFar
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.types import Key, Sim, State, TimeStep

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

MAX_DOUBLINGS = 16.0
"""A distance or a speed is halved or doubled at most so often on the way to an edge."""

BISECTIONS = 16
"""Number of halvings of a search for an edge. It is then found to 0.02 %."""


def unsafe(first: TimeStep) -> Bool[Array, ...]:
    """Return which starts are outside the safe set.

    With a filter these are the starts that it does not certify, and otherwise those that violate a
    constraint.
    """
    if first.info.rta is not None:
        return ~first.info.rta.certified
    return ~(jnp.min(jnp.stack(list(first.info.margins.values())), axis=0) >= 0.0)


def edge_start(env: Environment, key: Key) -> tuple[State, TimeStep]:
    """Draw a start at an edge of the states that a filter certifies.

    A start of the task is drawn. First the agent's distance from the other platform changes, then
    its speed. The distance becomes as small as it may be, as large as it may be, or one between.
    The speed becomes as small or as large as it may be, or stays as it is. Each change ends by
    bisection where the filter would no longer certify the start, or where an episode would end. No
    distance is larger than that at which the task ends an episode. Without a filter the edge is
    that of the safe set.

    Args:
        env: the environment.
        key: a typed PRNG key.

    Returns:
        What `reset` returns.
    """
    key_distance, key_speed, key_share = jax.random.split(jax.random.fold_in(key, 1), 3)
    state, first = reset(env, key)
    own = drawn(env, state.parameters)
    nearest, farthest = -MAX_DOUBLINGS, _doublings_to_farthest(own, state.sim)
    between = nearest / 2.0 + (farthest - nearest / 2.0) * jax.random.uniform(key_share)
    distances = jnp.stack([jnp.full_like(between, nearest), farthest, between, between])
    speeds = jnp.array([-MAX_DOUBLINGS, MAX_DOUBLINGS, 0.0])
    goal = jnp.stack(
        [jax.random.choice(key_distance, distances), jax.random.choice(key_speed, speeds)]
    )

    def place(doublings: Float[Array, " 2"]) -> tuple[State, TimeStep]:
        agent = _changed(own, state.sim, *jnp.exp2(doublings))
        platforms = {**state.sim.platforms, env.agent: agent}
        start = {name: vars(platform) for name, platform in platforms.items()}
        return reset_to(env, start, state.parameters, key)

    def halve(count: Array, carry: tuple[State, TimeStep, Array, Array]) -> tuple:
        *best, doublings, way = carry
        which = count // BISECTIONS
        way = way.at[which].multiply(0.5)
        tried = doublings.at[which].add(way[which])
        new_state, new_first = place(tried)
        allowed = ~unsafe(new_first) & (new_first.info.outcome == 0)
        kept = jax.tree.map(
            functools.partial(jnp.where, allowed),
            (new_state, new_first, tried),
            (*best, doublings),
        )
        return *kept, way

    carry = (state, first, jnp.zeros_like(goal), goal)
    state, first, *_ = jax.lax.fori_loop(0, 2 * BISECTIONS, halve, carry)
    return state, first


STARTS: dict[str, Callable[[Environment, Key], tuple[State, TimeStep]]] = {
    "task": reset,
    "edges": edge_start,
}
"""All kinds of starts by name."""


def _changed(
    env: Environment, sim: Sim, distance: Float[Array, ""], speed: Float[Array, ""]
) -> Any:
    """Return the state of the agent with another distance and another speed.

    Args:
        env: the environment.
        sim: the simulation.
        distance: what the distance from the other platform is multiplied by.
        speed: what the speed is multiplied by.
    """
    own = sim.platforms[env.agent]
    centre = other_platform(env, sim).position
    moved = env.agent_platform.with_velocity(own, speed * own.velocity)
    return moved.replace(position=centre + distance * (own.position - centre))


def _doublings_to_farthest(env: Environment, sim: Sim) -> Float[Array, ""]:
    """Return how often the agent's distance can be doubled before the task ends an episode."""
    limits = [condition.limit for condition in env.terminal if isinstance(condition, TooFar)]
    apart = sim.platforms[env.agent].position - other_platform(env, sim).position
    doublings = [jnp.log2(limit / jnp.maximum(safe_norm(apart), 1e-6)) for limit in limits]
    return jnp.clip(jnp.min(jnp.stack([*doublings, MAX_DOUBLINGS])), 0.0, MAX_DOUBLINGS)
