"""Adversaries at work on an environment, with or without a filter, and what is counted while they are.

Violations are counted at the samples, and inside the steps by moving the platforms to `PARTS` instants of each with the
control held, separations also between two of them. A margin or a state that is not a number is a violation.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.environment import Environment, drawn, extremes, step
from jaxsafe.evaluate.adversaries import ADVERSARIES
from jaxsafe.processors.terminal import time_limit
from jaxsafe.rollout import reset_batch
from jaxsafe.schema.dotted_paths import set_path
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.controllers import Continuous
from jaxsafe.transition import bounds, commanded, smallest_margin
from jaxsafe.types import Key, Number, Sim, State, TimeStep

PARTS = 8
KNOTS, HOLD = 8, 8
"""Controls of a sequence that the search optimises, and for how many steps each is held."""

POPULATION = 64
ELITE = 8
ROUNDS = 8
SEARCH = "search"

_EVENTS = ("violating", "violating_inside", "intervening", "uncertified", "infeasible")
_ADDED = (*_EVENTS, "steps", "ended", "correction", "unsafe_starts")
_LOWEST = ("lowest", "lowest_inside")
Counts = dict[str, Float[Array, " n"]]


def attack(env: Environment, name: str, num_steps: int, num_lanes: int, key: Key) -> dict[str, Any]:
    """Let one adversary act.

    Args:
        env: the environment, with or without run time assurance.
        name: one of `adversaries.ADVERSARIES`, or `search`: the cross-entropy method on sequences of `KNOTS` controls, each
            held for `HOLD` steps, from random starts, which minimises the smallest h on the way against the filter.
        num_steps: steps in each lane, `longest_episode` for whole ones; the search divides all of them into its sequences.
        num_lanes: episodes side by side.
        key: a typed PRNG key.

    Returns:
        Plain numbers: steps, episodes, violations, worst margins, interventions, mean correction, unsafe starts. Episodes
        are those that ended, or, where some lane has none that did, the first parts of one in each lane. Where nothing was
        violated, the share of episodes with a violation is below `violation_bound` with 95 % confidence, by the rule of
        three. It is None after a violation, and for the search, whose episodes do not depend on chance alone.
    """
    physical = _with_physical_actions(env)
    if name == SEARCH:
        starts = max(1, round(num_steps * num_lanes / (KNOTS * HOLD * POPULATION * ROUNDS)))
        counts, begun = _search(physical, starts, key), starts * POPULATION * ROUNDS
        whole, episodes = False, begun
    else:
        counts = _follow(physical, name, num_steps, num_lanes, key)
        ended = int(np.sum(counts["ended"]))
        whole, begun = bool(np.all(counts["ended"] > 0)), num_lanes + ended
        episodes = ended if whole else num_lanes
    found = {one: np.asarray(value, float) for one, value in counts.items()}
    total = {one: found[one].sum() for one in _ADDED}
    steps = int(total["steps"])
    clean = not (total["violating"] or total["violating_inside"])
    return {
        "policy": name,
        "steps": steps,
        "episodes": episodes,
        "violating_steps": int(total["violating"]),
        "violating_steps_inside": int(total["violating_inside"]),
        "worst_margin": _finite_or_none(found["lowest"].min()),
        "worst_margin_inside": _finite_or_none(found["lowest_inside"].min()),
        "intervention_rate": float(total["intervening"] / steps),
        "mean_correction": float(total["correction"] / steps),
        "uncertified_steps": int(total["uncertified"]),
        "infeasible_steps": int(total["infeasible"]),
        "unsafe_starts": float(total["unsafe_starts"] / begun),
        "whole_episodes": whole,
        "violation_bound": 3.0 / episodes if clean and name != SEARCH else None,
    }


def longest_episode(env: Environment) -> int:
    """Return the number of steps after which every episode has ended by its time limit, also where that is random.

    Raises:
        ConfigError: the task has no time limit.
    """
    low, high = extremes(env)
    limit = time_limit(high)
    if limit is None:
        raise ConfigError("steps: the task has no time limit, so give the number of steps")
    return math.ceil(float(limit) / float(low.dt)) + 2  # a timeout needs t > limit, and limit / dt may round down


@functools.partial(jax.jit, static_argnums=(1, 2, 3))
def _follow(env: Environment, name: str, num_steps: int, num_lanes: int, key: Key) -> Counts:
    """A policy from the task's own starts; episodes begin anew where they end."""

    def one(carry: tuple[State, Counts], key: Key) -> tuple[tuple[State, Counts], None]:
        state, counts = carry
        key_act, key_reset = jax.random.split(key)
        keys = jax.random.split(key_act, num_lanes)
        controls = jax.vmap(lambda state, key: ADVERSARIES[name](drawn(env, state.parameters), state.sim, key))(state, keys)
        after, done, facts = _step(env, state, controls)
        fresh, first = reset_batch(env, key_reset, num_lanes)
        facts["unsafe_starts"] = done & _unsafe(first)
        following = jax.vmap(lambda over, *pair: jax.tree.map(lambda a, b: jnp.where(over, a, b), *pair))(
            done, fresh, after
        )
        return (following, _add(counts, facts)), None

    key_start, key_run = jax.random.split(key)
    state, first = reset_batch(env, key_start, num_lanes)
    counts = {**_nothing(num_lanes), "unsafe_starts": _unsafe(first).astype(jnp.float32)}
    return jax.lax.scan(one, (state, counts), jax.random.split(key_run, num_steps))[0][1]


@functools.partial(jax.jit, static_argnums=1)
def _search(env: Environment, num_starts: int, key: Key) -> Counts:
    """The cross-entropy method, one start after another; what follows the end of an episode is not counted."""
    low, high = bounds(env)
    middle, half = (high + low) / 2.0, (high - low) / 2.0

    def sequences(state: State, controls: Float[Array, "t p m"]) -> Counts:
        def one(carry: tuple[State, Array, Counts], control: Array) -> tuple[tuple[State, Array, Counts], None]:
            state, running, counts = carry
            after, done, facts = _step(env, state, control)
            unseen = {name: jnp.where(running, value, jnp.inf if name in _LOWEST else 0.0) for name, value in facts.items()}
            return (after, running & ~done, _add(counts, unseen)), None

        states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (POPULATION, *leaf.shape)), state)
        start = (states, jnp.ones(POPULATION, bool), _nothing(POPULATION))
        return jax.lax.scan(one, start, controls)[0][2]

    def improve(carry: tuple[Array, Array], key: Key, state: State) -> tuple[tuple[Array, Array], Counts]:
        mean, spread = carry
        drawn = mean + spread * jax.random.normal(key, (POPULATION, *mean.shape))
        controls = middle + half * jnp.clip(drawn, -1.0, 1.0)
        counts = sequences(state, jnp.repeat(jnp.moveaxis(controls, 0, 1), HOLD, axis=0))
        best = drawn[jnp.argsort(counts["lowest_inside"])[:ELITE]]
        return (jnp.mean(best, axis=0), jnp.std(best, axis=0) + 0.05), counts

    def one_start(key: Key) -> Counts:
        key_start, key_search = jax.random.split(key)
        state, first = jax.tree.map(lambda leaf: leaf[0], reset_batch(env, key_start, 1))
        begin = jnp.zeros((KNOTS, low.shape[0])), jnp.full((KNOTS, low.shape[0]), 2.0)
        improved = functools.partial(improve, state=state)
        _, counts = jax.lax.scan(improved, begin, jax.random.split(key_search, ROUNDS))
        counts = {name: jnp.min(value) if name in _LOWEST else jnp.sum(value) for name, value in counts.items()}
        return counts | {"unsafe_starts": _unsafe(first) * float(POPULATION * ROUNDS)}

    return jax.lax.map(one_start, jax.random.split(key, num_starts))


def _step(env: Environment, state: State, controls: Float[Array, "n m"]) -> tuple[State, Array, Counts]:
    """One step of all lanes: the states after it, which episodes ended, and what happened."""
    after, timestep = jax.vmap(step, in_axes=(None, 0, 0))(env, state, controls)
    info, zero = timestep.info, jnp.zeros_like(timestep.reward)
    lowest = jax.vmap(lambda state: smallest_margin(drawn(env, state.parameters), state.sim))(after)
    inside = jax.vmap(lambda state, control: _inside(drawn(env, state.parameters), state.sim, control))(
        state, info.control_actual
    )
    finite = jax.vmap(_finite)(after)
    lowest, inside = (jnp.where(jnp.isnan(one), -jnp.inf, one) for one in (lowest, inside))
    facts = {
        "steps": zero + 1.0,
        "violating": ~(lowest >= 0.0) | ~finite,
        "violating_inside": ~(inside >= 0.0) | ~finite,
        "ended": timestep.done,
        "intervening": info.intervening,
        "correction": zero if info.rta is None else info.rta.correction,
        "uncertified": zero + 1.0 if info.rta is None else ~info.rta.certified | ~finite,
        "infeasible": zero if info.rta is None else ~info.rta.feasible,
        "unsafe_starts": zero,
        "lowest": lowest,
        "lowest_inside": inside,
    }
    return after, timestep.done, {name: value.astype(jnp.float32) for name, value in facts.items()}


def _inside(env: Environment, before: Sim, control: Float[Array, " m"]) -> Float[Array, ""]:
    """The smallest h within a step."""
    before = before.replace(regions={}, status={})
    later = jax.vmap(lambda share: within_step(env, before, control, share))(jnp.arange(1, PARTS + 1) / PARTS)
    earlier = jax.tree.map(lambda start, way: jnp.concatenate([start[None], way[:-1]]), before, later)
    return jnp.min(jax.vmap(lambda a, b: smallest_margin(env, b, a))(earlier, later))


def within_step(env: Environment, before: Sim, control: Float[Array, " m"], share: Number) -> Sim:
    """The simulation after a share of a step, all controls being those of the whole step."""
    platforms = {}
    for platform in env.platforms:
        state = before.platforms[platform.name]
        controls = platform.held(state, commanded(env, platform, before, control), env.dt)
        platforms[platform.name] = platform.step(state, controls, env.dt * share)
    return before.replace(time=before.time + env.dt * share, platforms=platforms, regions={}, status={})


def _finite(state: State) -> Array:
    return functools.reduce(jnp.logical_and, [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(state.sim.platforms)])


def _finite_or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _nothing(num_lanes: int) -> Counts:
    counts: Counts = {name: jnp.zeros(num_lanes) for name in _ADDED}
    return counts | {name: jnp.full(num_lanes, jnp.inf) for name in _LOWEST}


def _add(counts: Counts, facts: Counts) -> Counts:
    return {
        name: jnp.minimum(value, facts[name]) if name in _LOWEST else value + facts[name] for name, value in counts.items()
    }


def _unsafe(first: TimeStep) -> Array:
    """Which starts are outside the safe set, as far as is known."""
    if first.info.rta is not None:
        return ~first.info.rta.certified
    return ~(jnp.min(jnp.stack(list(first.info.margins.values())), axis=0) >= 0.0)


def _with_physical_actions(env: Environment) -> Environment:
    """The environment with the agent's actions in physical units."""
    actuators = tuple(one.replace(rescale=False) for one in env.actuators)
    return set_path(env, f"{env.agent}.controller", Continuous(actuators=actuators))
