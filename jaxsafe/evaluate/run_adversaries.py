"""Runs of adversaries against an environment, with or without a filter, and counts of violations.

Violations are counted at the ends of the steps. They are also counted inside the steps: the
platforms are moved to `INSTANTS_PER_STEP` instants of each step with the control held, and
separations are checked between two instants as well. A margin or a state that is not a number is a
violation.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsafe import environment
from jaxsafe.autoreset import renew
from jaxsafe.config.arguments import MAX_COUNT
from jaxsafe.environment import Environment, drawn, step
from jaxsafe.evaluate.adversaries import ADVERSARIES
from jaxsafe.evaluate.edge_starts import STARTS, unsafe
from jaxsafe.rollout import draw_starts
from jaxsafe.schema.dotted_paths import set_path
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.controllers import Continuous
from jaxsafe.simulation.uncertainty import ChosenDisturbance
from jaxsafe.transition import (
    bounds,
    driven,
    remember,
    smallest_margin,
    undirected,
    with_memory,
)
from jaxsafe.types import Key, Number, Sim, State
from jaxsafe.uncertain import arriving, disturbed

INSTANTS_PER_STEP = 8
"""Number of instants of a step at which violations inside it are looked for."""

SEARCH = "search"
"""Name of the adversary that searches sequences of controls by the cross-entropy method."""

SEARCH_CONTROLS = 8
"""Number of controls of a sequence that the search optimises."""

SEARCH_HOLD_STEPS = 8
"""Number of steps for which each control of a sequence is held."""

SEARCH_POPULATION = 64
"""Number of sequences in each round of the search."""

SEARCH_ELITE = 8
"""Number of the best sequences that the next round is drawn from."""

SEARCH_ROUNDS = 8
"""Number of rounds of the search from each start."""

_EVENTS = (
    "violating",
    "violating_inside",
    "violating_certified",
    "intervening",
    "uncertified",
    "infeasible",
)
_SUMMED = (*_EVENTS, "steps", "begun", "ended", "correction", "unsafe_starts")
_LOWEST = ("lowest", "lowest_inside")

Counts = dict[str, Float[Array, " n"]]
"""Sums over the steps and lowest margins, for each environment of a batch."""


def attack(
    env: Environment,
    name: str,
    num_steps: int,
    num_envs: int,
    key: Key,
    starts: str = "task",
    among: Sequence[str] = (),
) -> dict[str, Any]:
    """Let one adversary act and return what was counted.

    Args:
        env: the environment, with or without run time assurance.
        name: one of `adversaries.ADVERSARIES`, or `search`. The search begins at random starts and
            minimises the smallest h on the way, against the filter if there is one. It is the
            cross-entropy method on sequences of `SEARCH_CONTROLS` controls, each held for
            `SEARCH_HOLD_STEPS` steps. Disturbances of type `chosen` are searched together with the
            controls.
        num_steps: the number of steps in each environment. `longest_episode` gives whole episodes.
            The search divides all steps into its sequences.
        num_envs: the number of environments that run side by side.
        key: a typed PRNG key.
        starts: where episodes begin, one of `edge_starts.STARTS`.
        among: names of adversaries that attack the same environment, one after the other. All but
            the search share a program, which is compiled at the first attack.

    Returns:
        Plain numbers: steps, episodes, violations, worst margins, interventions, mean correction
        and unsafe starts. `violating_certified_steps` are those after which a constraint is
        violated, at the sample or inside, although the filter has certified them.

        Only episodes that ended count. But if some environment has no such episode, each
        environment counts as one unfinished episode instead. If nothing was violated, the share of
        episodes with a violation is below `violation_bound` with 95 % confidence, by the rule of
        three. The bound is None after a violation. It is also None for the search, whose episodes
        do not depend on chance alone.
    """
    physical = _with_physical_actions(env)
    if name == SEARCH:
        steps_per_sequence = SEARCH_CONTROLS * SEARCH_HOLD_STEPS
        sequences_per_start = SEARCH_POPULATION * SEARCH_ROUNDS
        num_starts = max(
            1, round(num_steps * num_envs / (steps_per_sequence * sequences_per_start))
        )
        counts = _search(physical, num_starts, starts, key)
        episodes = num_starts * sequences_per_start
        whole = False
    else:
        names = tuple(other for other in among if other != SEARCH)
        names = names if name in names else (name,)
        index = jnp.array(names.index(name))
        counts = _follow(physical, names, num_steps, num_envs, starts, index, key)
        ended = int(np.sum(counts["ended"]))
        whole = bool(np.all(counts["ended"] > 0))
        episodes = ended if whole else num_envs
    values = {entry: np.asarray(value, float) for entry, value in counts.items()}
    total = {entry: values[entry].sum() for entry in _SUMMED}
    steps = int(total["steps"])
    clean = not (total["violating"] or total["violating_inside"])
    return {
        "policy": name,
        "steps": steps,
        "episodes": episodes,
        "violating_steps": int(total["violating"]),
        "violating_steps_inside": int(total["violating_inside"]),
        "violating_certified_steps": int(total["violating_certified"]),
        "worst_margin": _finite_or_none(values["lowest"].min()),
        "worst_margin_inside": _finite_or_none(values["lowest_inside"].min()),
        "intervention_rate": float(total["intervening"] / steps),
        "mean_correction": float(total["correction"] / steps),
        "uncertified_steps": int(total["uncertified"]),
        "infeasible_steps": int(total["infeasible"]),
        "unsafe_starts": float(total["unsafe_starts"] / total["begun"]),
        "whole_episodes": whole,
        "violation_bound": 3.0 / episodes if clean and name != SEARCH else None,
    }


def longest_episode(env: Environment) -> int:
    """Return the number of steps after which every episode has ended by its time limit.

    A random time limit counts with its largest value, and a random length of a step with its
    smallest. The number is at most `MAX_COUNT`, even if the time limit is so large that it stands
    for none.

    Raises:
        ConfigError: the task has no time limit.
    """
    steps = environment.longest_episode(env.replace(decision_period=1))
    if steps is None:
        raise ConfigError("steps: the task has no time limit, so give the number of steps")
    return int(min(float(steps), MAX_COUNT))  # single precision may give ∞


@functools.partial(jax.jit, static_argnums=(1, 2, 3, 4))
def _follow(
    env: Environment,
    names: tuple[str, ...],
    num_steps: int,
    num_envs: int,
    starts: str,
    index: Int[Array, ""],
    key: Key,
) -> Counts:
    """Run the adversary that an index chooses from `names`. A new episode begins where one ends."""
    adversaries = [ADVERSARIES[name] for name in names]

    def act(state: State, key: Key) -> Float[Array, " m"]:
        seen = (drawn(env, state.parameters), _remembering(env, state), key)
        return jax.lax.switch(index, adversaries, *seen)

    @jax.jit
    def draw(parameters: tuple[Environment, Key], indices: Array) -> tuple[State, Array]:
        state, first = draw_starts(*parameters, indices, start=STARTS[starts])
        return state, unsafe(first)

    def one_step(
        carry: tuple[State, Array, Counts], keys: tuple[Key, Key]
    ) -> tuple[tuple[State, Array, Counts], None]:
        state, begun, counts = carry
        key_start, key_act = keys
        state, unsafe_starts = renew(
            begun, draw, (env, key_start), (state, jnp.zeros(num_envs, bool))
        )
        controls = jax.vmap(act)(state, jax.random.split(key_act, num_envs))
        state, ended, step_counts = _step(env, state, controls)
        step_counts |= {
            "begun": begun.astype(jnp.float32),
            "unsafe_starts": unsafe_starts.astype(jnp.float32),
        }
        return (state, ended, _add(counts, step_counts)), None

    # The first starts are drawn in the loop too, because every copy of a filter compiles for long.
    key_start, key_run = jax.random.split(key)
    keys = jax.vmap(jax.random.split)(jax.random.split(key_run, num_steps))
    key_starts = jnp.concatenate([key_start[None], keys[:-1, 1]])
    shapes, _ = jax.eval_shape(draw, (env, key), jnp.arange(num_envs))
    nothing = jax.tree.map(functools.partial(_blank, key), shapes)
    carry = (nothing, jnp.ones(num_envs, bool), _empty_counts(num_envs))
    (_, _, counts), _ = jax.lax.scan(one_step, carry, (key_starts, keys[:, 0]))
    return counts


def _blank(key: Key, leaf: jax.ShapeDtypeStruct) -> Array:
    """Return an array of a shape and type, whatever its values. Keys have no zero."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(key, leaf.shape)
    return jnp.zeros(leaf.shape, leaf.dtype)


@functools.partial(jax.jit, static_argnums=(1, 2))
def _search(env: Environment, num_starts: int, starts: str, key: Key) -> Counts:
    """Search by the cross-entropy method from one start after another.

    Steps after the end of an episode are not counted.
    """
    low, high = bounds(env)
    middle = (high + low) / 2.0
    half = (high - low) / 2.0
    chosen = [item for item in env.uncertainty if isinstance(item, ChosenDisturbance)]
    sizes = [env.platform(item.on).dimension for item in chosen]
    splits = list(itertools.accumulate([low.shape[0], *sizes]))[:-1]

    def run(state: State, controls: Float[Array, "t p m"]) -> Counts:
        """Run all sequences of a population from one state."""

        def one_step(
            carry: tuple[State, Array, Counts], control: Array
        ) -> tuple[tuple[State, Array, Counts], None]:
            state, running, counts = carry
            control, *pushes = jnp.split(control, splits, axis=-1)
            for item, push in zip(chosen, pushes, strict=True):
                state = _with_push(state, item.name, item.bound * push)
            after, done, step_counts = _step(env, state, control)
            counted = {
                name: jnp.where(running, value, jnp.inf if name in _LOWEST else 0.0)
                for name, value in step_counts.items()
            }
            return (after, running & ~done, _add(counts, counted)), None

        states = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (SEARCH_POPULATION, *leaf.shape)), state
        )
        start = (states, jnp.ones(SEARCH_POPULATION, bool), _empty_counts(SEARCH_POPULATION))
        (_, _, counts), _ = jax.lax.scan(one_step, start, controls)
        return counts

    def improve(
        carry: tuple[Array, Array], key: Key, state: State
    ) -> tuple[tuple[Array, Array], Counts]:
        """Run a population that is drawn about a mean.

        Returns:
            The mean and the spread of the best sequences, and the counts of all.
        """
        mean, spread = carry
        population = mean + spread * jax.random.normal(key, (SEARCH_POPULATION, *mean.shape))
        shares = jnp.clip(population, -1.0, 1.0)
        controls = middle + half * shares[..., : low.shape[0]]
        controls = jnp.concatenate([controls, shares[..., low.shape[0] :]], axis=-1)
        held = jnp.repeat(jnp.moveaxis(controls, 0, 1), SEARCH_HOLD_STEPS, axis=0)
        counts = run(state, held)
        best = population[jnp.argsort(counts["lowest_inside"])[:SEARCH_ELITE]]
        # The spread is never 0, so that the search does not stop at what it has found.
        return (jnp.mean(best, axis=0), jnp.std(best, axis=0) + 0.05), counts

    def search_from_start(key: Key) -> Counts:
        key_start, key_search = jax.random.split(key)
        state, first = draw_starts(env, key_start, jnp.arange(1), start=STARTS[starts])
        state, first = jax.tree.map(lambda leaf: leaf[0], (state, first))
        shape = (SEARCH_CONTROLS, low.shape[0] + sum(sizes))
        begin = (jnp.zeros(shape), jnp.full(shape, 2.0))
        keys = jax.random.split(key_search, SEARCH_ROUNDS)
        _, counts = jax.lax.scan(functools.partial(improve, state=state), begin, keys)
        counts = {
            name: jnp.min(value) if name in _LOWEST else jnp.sum(value)
            for name, value in counts.items()
        }
        begun = float(SEARCH_POPULATION * SEARCH_ROUNDS)
        return counts | {"begun": begun, "unsafe_starts": unsafe(first) * begun}

    return jax.lax.map(search_from_start, jax.random.split(key, num_starts))


def _with_push(state: State, name: str, push: Float[Array, "n d"]) -> State:
    """Return states in which a chosen disturbance has the value `push` for the next step."""
    uncertainty = {**state.memory.uncertainty, name: push}
    return state.replace(memory=state.memory.replace(uncertainty=uncertainty))


def _step(
    env: Environment, state: State, controls: Float[Array, "n m"]
) -> tuple[State, Array, Counts]:
    """Step a batch of environments.

    Returns:
        The states after the step, which episodes ended, and what is counted.
    """
    after, timestep = jax.vmap(step, in_axes=(None, 0, 0))(env, state, controls)
    info = timestep.info
    zero = jnp.zeros_like(timestep.reward)

    def lowest_at(state: State) -> Float[Array, ""]:
        return smallest_margin(drawn(env, state.parameters), _remembering(env, state))

    def lowest_inside(
        state: State, memory: Mapping[str, Any], control: Float[Array, " m"]
    ) -> Float[Array, ""]:
        now = drawn(env, state.parameters)
        sim = _remembering(env, state)
        return _inside(now, sim, memory, arriving(now, sim, memory, control))

    lowest = jax.vmap(lowest_at)(after)
    inside = jax.vmap(lowest_inside)(state, after.memory.uncertainty, info.control_actual)
    finite = jax.vmap(_finite)(after)
    lowest = jnp.where(jnp.isnan(lowest), -jnp.inf, lowest)
    inside = jnp.where(jnp.isnan(inside), -jnp.inf, inside)
    violating = ~(lowest >= 0.0) | ~finite
    violating_inside = ~(inside >= 0.0) | ~finite
    certified = jnp.zeros_like(finite) if info.rta is None else info.rta.certified
    values = {
        "steps": zero + 1.0,
        "violating": violating,
        "violating_inside": violating_inside,
        "violating_certified": (violating | violating_inside) & certified,
        "ended": timestep.done,
        "intervening": info.intervening,
        "correction": zero if info.rta is None else info.rta.correction,
        "uncertified": zero + 1.0 if info.rta is None else ~info.rta.certified | ~finite,
        "infeasible": zero if info.rta is None else ~info.rta.feasible,
        "begun": zero,
        "unsafe_starts": zero,
        "lowest": lowest,
        "lowest_inside": inside,
    }
    return after, timestep.done, {name: value.astype(jnp.float32) for name, value in values.items()}


def _remembering(env: Environment, state: State) -> Sim:
    return with_memory(env, state.sim, state.memory.status)


def _inside(
    env: Environment, before: Sim, memory: Mapping[str, Any], control: Float[Array, " m"]
) -> Float[Array, ""]:
    """Return the smallest h within a step.

    Args:
        env: the environment, with the numbers of this episode.
        before: the simulation before the step.
        memory: the memories of the parts of `uncertainty` in that step.
        control: the control that the plant receives, shape (m,).
    """
    before = before.replace(regions={}, status={})
    shares = jnp.arange(1, INSTANTS_PER_STEP + 1) / INSTANTS_PER_STEP

    def at(share: Number) -> Sim:
        later = within_step(env, before, control, share)
        so_far = env.replace(dt=env.dt * share)
        return later.replace(platforms=disturbed(so_far, memory, later.platforms))

    later = jax.vmap(at)(shares)
    earlier = jax.tree.map(
        lambda first, instants: jnp.concatenate([first[None], instants[:-1]]), before, later
    )
    return jnp.min(jax.vmap(lambda a, b: smallest_margin(env, b, a))(earlier, later))


def within_step(env: Environment, before: Sim, control: Float[Array, " m"], share: Number) -> Sim:
    """Return the simulation after a share of a step.

    All controls have the values that they have for the whole step.

    Args:
        env: the environment.
        before: the simulation before the step.
        control: the agent's control in physical units and action order, shape (m,).
        share: the share of the step, in [0, 1].
    """
    platforms = {}
    for platform in env.platforms:
        state = before.platforms[platform.name]
        is_agent = platform.name == env.agent
        given = driven(env, before, control)[0] if is_agent else undirected(platform, before)
        controls = platform.held(state, given, env.dt)
        platforms[platform.name] = platform.step(state, controls, env.dt * share)
    time = before.time + env.dt * share
    later = before.replace(time=time, platforms=platforms, regions={}, status={})
    later = later.replace(control_desired=control, control_actual=control)
    return remember(env, before, later, env.dt * share)


def _finite(state: State) -> Array:
    leaves = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(state.sim.platforms)]
    return functools.reduce(jnp.logical_and, leaves)


def _finite_or_none(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _empty_counts(num_envs: int) -> Counts:
    counts: Counts = {name: jnp.zeros(num_envs) for name in _SUMMED}
    return counts | {name: jnp.full(num_envs, jnp.inf) for name in _LOWEST}


def _add(counts: Counts, more: Counts) -> Counts:
    """Return the counts with those of one more step added."""
    return {
        name: jnp.minimum(value, more[name]) if name in _LOWEST else value + more[name]
        for name, value in counts.items()
    }


def _with_physical_actions(env: Environment) -> Environment:
    """Return the environment with the agent's actions in physical units, one for every step.

    An adversary that acts on every step can do all that one with held actions can do.
    """
    physical = {"rescale": False, "post_activation": "clip", "discrete": False}
    actuators = tuple(actuator.replace(**physical) for actuator in env.actuators)
    env = env.replace(decision_period=1)
    return set_path(env, f"{env.agent}.controller", Continuous(actuators=actuators))
