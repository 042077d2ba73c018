"""Training as pure functions: chunks of updates of one seed, and the programs that train all seeds on their devices."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.devices.seed_mapper import SPLIT_BY_ENV, SPLIT_BY_SEED, SeedMapper
from jaxsafe.devices.shard import WHOLE, Shard
from jaxsafe.train import ppo, recent_episodes
from jaxsafe.train.ppo import TrainState

STATE = ppo.over_devices(SPLIT_BY_SEED, SPLIT_BY_ENV)
"""How the training states of all seeds lie on the devices."""


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
