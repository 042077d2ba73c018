"""Training as pure functions: of one seed, and the programs that train all seeds on their devices."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.agents.agent import Agent
from jaxsafe.devices.seed_mapper import SPLIT_BY_ENV, SPLIT_BY_SEED, SeedMapper, isolated
from jaxsafe.devices.shard import WHOLE, Shard
from jaxsafe.environment import Environment
from jaxsafe.schema.component import normalise
from jaxsafe.train import ppo, recent_episodes
from jaxsafe.train.ppo import PPO, TrainState
from jaxsafe.types import Key

STATE = ppo.over_devices(SPLIT_BY_SEED, SPLIT_BY_ENV)
"""How the training states of all seeds lie on the devices."""


Curves = dict[str, jax.Array]
"""By column of the progress log, [updates]: means over the last 100 episodes, and counts."""

Callback = Callable[[TrainState, Curves], bool | None]
"""Called on the host with the state and the curves of the updates since the last call. True stops."""

CALLS = 50
"""How often a callback is called in a training, if nothing else is said."""


def train(
    env: Environment,
    agent: Agent,
    hyperparameters: PPO,
    key: Key,
    num_updates: int,
    callback: Callback | None = None,
    every: int | None = None,
) -> tuple[TrainState, Curves]:
    """Train one seed.

    Without a callback this is a pure function of its arguments: `jax.jit` compiles it, `jax.vmap`
    trains over keys, numbers of the environment and hyperparameters. It does what
    `python -m jaxsafe.train` does with the same options and the key `jax.random.key(seed)`.

    Args:
        env: the environment.
        agent: what the networks see and how large they are.
        hyperparameters: those of PPO. `resolve({"env": "docking3d"})` returns a task's recipe:
            `config.agent` and `config.ppo`.
        key: a typed PRNG key.
        num_updates: how many batches of `hyperparameters.batch_size` steps are collected and learnt
            from. A static number. Schedules run over that many.
        callback: called on the host after every `every` updates, for logs or a stop of one's own.
        every: updates between two calls; a fiftieth of the training, if it is None.

    Returns:
        The state, of which `average` holds the parameters for `agent.policy`, and the curves.
    """
    shared = (env, normalise(agent), normalise(hyperparameters))
    start = jax.jit(isolated(begin))
    piece = jax.jit(isolated(chunk), static_argnums=(2, 3))
    state = start(shared, key)
    if callback is None:
        return piece(shared, state, num_updates, num_updates)
    every = every or max(1, num_updates // CALLS)
    pieces: list[Curves] = []
    for done in range(0, num_updates, every):
        state, curves = piece(shared, state, min(every, num_updates - done), num_updates)
        pieces.append(curves)
        if callback(state, curves):
            break
    return state, jax.tree.map(lambda *parts: jnp.concatenate(parts), *pieces)


def programs(mapper: SeedMapper, length: int, limit: int) -> tuple[Any, Any]:
    """What a training of all seeds runs on its devices, to be called or lowered; `shared` is `(env, agent, hyper)`.

    Args:
        mapper: of the seeds.
        length: updates at a time.
        limit: updates of the whole run.

    Returns:
        `(shared, keys) -> state` for `begin`, and `(shared, state) -> (state, curves)` for `chunk`.
    """

    def advance(shared: tuple, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        return chunk(shared, state, length, limit, mapper.shard)

    fresh = mapper.map(partial(begin, shard=mapper.shard), out_specs=STATE, as_pair=True)
    return fresh, mapper.map(advance, in_specs=STATE, out_specs=(STATE, SPLIT_BY_SEED))


def begin(shared: tuple, key: jax.Array, shard: Shard = WHOLE) -> TrainState:
    """Fresh networks and episodes of one seed."""
    env, agent, hyper = shared
    return ppo.init(env, agent, hyper, key, shard)


def chunk(
    shared: tuple, state: TrainState, length: int, limit: int, shard: Shard = WHOLE
) -> tuple[TrainState, dict[str, jax.Array]]:
    """`length` updates of one seed, fewer at the end of the run, with the averages of the window after each.

    A seed that has diverged is counted on and otherwise left as it is.
    """
    env, agent, hyper = shared

    def leave(state: TrainState) -> TrainState:
        return state.replace(num_updates=jnp.minimum(state.num_updates + 1, limit))

    def one(state: TrainState, _: None) -> tuple[TrainState, dict[str, jax.Array]]:
        going = (state.num_updates < limit) & ~ppo.diverged(state)
        state = jax.lax.cond(
            going, lambda s: ppo.update(env, agent, hyper, limit, s, shard), leave, state
        )
        counts = {
            "update": state.num_updates,
            "count": state.window.count,
            "cost": recent_episodes.total_cost(state.window),
            "diverged": ppo.diverged(state),
        }
        if agent.cost_critic:
            counts["multiplier"] = state.multiplier
        return state, {**counts, **recent_episodes.means(state.window, env.outcomes)}

    return jax.lax.scan(one, state, None, length=length)
