"""Training as pure functions.

`train` trains one seed. `programs` returns the programs that train all seeds on their devices.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.networks import Params
from jaxsafe.devices.seed_mapper import SPLIT_BY_ENV, SPLIT_BY_SEED, SeedMapper, isolated
from jaxsafe.devices.shard import WHOLE, Shard
from jaxsafe.environment import Environment
from jaxsafe.schema.component import normalise
from jaxsafe.train import ppo, recent_episodes
from jaxsafe.train.hyperparameters import (
    PPO,
    check_complete_episodes,
    check_cost_limit,
    check_curriculum,
)
from jaxsafe.train.ppo import Diagnostics, TrainState
from jaxsafe.types import Key

STATE = ppo.by_axes(SPLIT_BY_SEED, SPLIT_BY_ENV)
"""Sharding of the training states of all seeds."""

Curves = dict[str, jax.Array]
"""Curves of a training, [updates] each, by column of the progress log.

They are means over the last 100 episodes, counts, and the diagnostics of each update.
"""

Callback = Callable[[TrainState, Curves], bool | None]
"""A function on the host. Its arguments are the state and the curves since the last call.

If it returns True the training stops.
"""

CALLS = 50
"""Number of calls of a callback in a training for which `every` is not given."""


def train(
    env: Environment,
    agent: Agent,
    hyperparameters: PPO,
    key: Key,
    num_updates: int,
    callback: Callback | None = None,
    every: int | None = None,
    params: Params | None = None,
) -> tuple[TrainState, Curves]:
    """Train one seed.

    Without a callback this is a pure function of its arguments. `jax.jit` compiles it, and
    `jax.vmap` trains over keys, numbers of the environment, or hyperparameters. With the key
    `jax.random.key(seed)` it does what `jaxsafe train` does with the same options.

    Args:
        env: the environment.
        agent: what the networks see and how large they are.
        hyperparameters: hyperparameters of PPO. `resolve({"env": "docking3d"})` returns a task's
            recipe, with `config.agent` and `config.ppo`.
        key: a typed PRNG key.
        num_updates: how many batches of `hyperparameters.batch_size` steps are collected and learnt
            from. It is a static number. Schedules run over that many updates.
        callback: a function that is called on the host after every `every` updates, for instance to
            write logs or to stop the training.
        every: number of updates between two calls. None stands for a fiftieth of the training.
        params: parameters to start from, such as `state.average` of another training. None stands
            for fresh ones.

    Returns:
        The state and the curves. `state.average` holds the parameters for `agent.policy`.

    Raises:
        ConfigError: an episode may be longer than the batch with `complete_episodes`, or a limit of
            the cost is for no constraint of the environment, or the curriculum does not fit it.
    """
    check_complete_episodes(env, hyperparameters)
    check_cost_limit(env, agent, hyperparameters)
    check_curriculum(env, hyperparameters)
    shared = (env, normalise(agent), normalise(hyperparameters))
    state = _begin(shared, key)
    if params is not None:
        state = state.replace(params=params, average=params)
    if callback is None:
        return _chunk(shared, state, num_updates, num_updates)
    every = every or max(1, num_updates // CALLS)
    pieces: list[Curves] = []
    for done in range(0, num_updates, every):
        state, curves = _chunk(shared, state, min(every, num_updates - done), num_updates)
        pieces.append(curves)
        if callback(state, curves):
            break
    return state, jax.tree.map(lambda *parts: jnp.concatenate(parts), *pieces)


def programs(mapper: SeedMapper, length: int, limit: int) -> tuple[Any, Any]:
    """Return the two programs that train all seeds, to be called or lowered.

    Args:
        mapper: the mapper of the seeds.
        length: number of updates at a time.
        limit: number of updates of the whole run.

    Returns:
        `(shared, keys) -> state` for `begin`, and `(shared, state) -> (state, curves)` for `chunk`.
        `shared` is `(env, agent, hyper)`, and the other arrays have a leading axis of seeds.
    """

    def advance(shared: tuple, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        return chunk(shared, state, length, limit, mapper.shard)

    fresh = mapper.map(partial(begin, shard=mapper.shard), out_specs=STATE, as_pair=True)
    return fresh, mapper.map(advance, in_specs=STATE, out_specs=(STATE, SPLIT_BY_SEED))


def begin(shared: tuple, key: jax.Array, shard: Shard = WHOLE) -> TrainState:
    """Return the state of one seed with fresh networks and episodes.

    Args:
        shared: `(env, agent, hyper)`.
        key: the key of the seed.
        shard: the part of the environments that this device has.
    """
    env, agent, hyper = shared
    return ppo.init(env, agent, hyper, key, shard)


def chunk(
    shared: tuple, state: TrainState, length: int, limit: int, shard: Shard = WHOLE
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Train one seed for `length` updates, or for fewer at the end of the run.

    A seed that has diverged is left as it is, except that its updates are counted.

    Args:
        shared: `(env, agent, hyper)`.
        state: the state of the seed.
        length: number of updates.
        limit: number of updates of the whole run.
        shard: the part of the environments that this device has.

    Returns:
        The state, and the curves: counts and averages over the window after each update, and the
        diagnostics of the update. They are NaN where a seed is left as it is.
    """
    env, agent, hyper = shared

    def leave(state: TrainState) -> tuple[TrainState, Diagnostics]:
        state = state.replace(num_updates=jnp.minimum(state.num_updates + 1, limit))
        return state, ppo.no_diagnostics(agent)

    def one_update(
        carry: tuple[TrainState, jax.Array], _: None
    ) -> tuple[tuple[TrainState, jax.Array], dict[str, jax.Array]]:
        state, diverged = carry
        going = (state.num_updates < limit) & ~diverged
        state, diagnostics = jax.lax.cond(
            going, lambda s: ppo.update(env, agent, hyper, limit, s, shard), leave, state
        )
        diverged = ppo.diverged(state)
        counts = {
            "update": state.num_updates,
            "count": state.window.count,
            "cost": recent_episodes.total_cost(state.window),
            "diverged": diverged,
        }
        if agent.cost_names:
            for index, name in enumerate(agent.cost_names):
                counts[f"multiplier/{name}"] = ppo.price(state)[index]
        elif agent.cost_critic:
            counts["multiplier"] = ppo.price(state)
        means = recent_episodes.means(
            state.window, env.outcomes, env.successes, severity=env.cost == "severity"
        )
        return (state, diverged), {**counts, **means, **diagnostics}

    (state, _), curves = jax.lax.scan(one_update, (state, ppo.diverged(state)), None, length=length)
    return state, curves


# Every call of `isolated` returns a new function, which JAX would compile again.
_begin = jax.jit(isolated(begin))
_chunk = jax.jit(isolated(chunk), static_argnums=(2, 3))
