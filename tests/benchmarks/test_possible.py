"""The script that looks for the best flights finds good ones, and scores them as the task does."""

from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.bounds import best_possible
from jaxsafe.rollout import reset_batch

LENGTH = 600


@pytest.fixture
def possible(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import possible  # pyright: ignore[reportMissingImports]

    return possible


def test_one_push_docks_for_little_more_than_the_least_delta_v(possible: ModuleType) -> None:
    env = jaxsafe.make("docking1d")
    starts = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(1), 8)
    push = possible.transfers(env, starts[0], LENGTH)
    rest = np.zeros((8, LENGTH + 1 - possible.PUSHED, 1))
    before, after = possible.improve(
        env,
        possible.coast,
        possible.docking_loss,
        starts,
        jnp.asarray(np.concatenate([push, rest], axis=1), jnp.float32),
        jnp.asarray(np.arange(LENGTH + 1) < possible.PUSHED, jnp.float32),
        jnp.full(8, float(LENGTH)),
        0.0005,
        40,
    )
    first, found = possible.scored(env, before), possible.scored(env, after)
    bounds = best_possible(env, starts[0])
    assert found.succeeded.sum() >= 6
    better = first.succeeded & found.succeeded
    assert (found.delta_v < first.delta_v + 1e-4)[better].all()
    assert (found.delta_v >= bounds["delta_v"])[found.succeeded].all()
    # An arrival after 600 s is 0.11 m/s faster than one after 2001 s, the latest one.
    assert (found.delta_v < bounds["delta_v"] + 0.2)[found.succeeded].all()
    assert (found.length >= bounds["length"])[found.succeeded].all()


@pytest.mark.thorough
def test_a_deputy_that_turns_first_docks_for_little_more_too(possible: ModuleType) -> None:
    env = jaxsafe.make("docking2d_oriented")
    starts = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(1), 6)
    push = possible.transfers(env, starts[0], 1600)
    actions = np.zeros((6, 1601, 2))
    actions[:, : push.shape[1]] = push
    fly = jax.vmap(lambda start, own: possible.fly(env, possible.coast, start, own))
    found = possible.scored(env, jax.jit(fly)(starts, jnp.asarray(actions, jnp.float32)))
    least = best_possible(env, starts[0])["delta_v"]
    assert found.succeeded.all()
    assert (least <= found.delta_v).all()
    assert (found.delta_v < 1.2 * least).all()
