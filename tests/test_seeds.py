from typing import Any

import jax
import numpy as np
import pytest

import jaxsafe
from jaxsafe.component import normalise
from jaxsafe.train.agent import Agent
from jaxsafe.train.ppo import PPO, TrainState, init, update
from jaxsafe.train.seeds import SeedMapper

ENV = jaxsafe.make("docking2d")
AGENT = normalise(Agent(features="docking"))
HYPER = normalise(PPO(num_envs=4, num_steps=32, num_epochs=2))
UPDATES = 5


def train(shared: tuple, key: jax.Array) -> TrainState:
    env, agent, ppo = shared
    return jax.lax.fori_loop(0, UPDATES, lambda _, s: update(env, agent, ppo, UPDATES, s), init(env, agent, ppo, key))


def seeds(first: int, count: int) -> dict[str, Any]:
    mapper = SeedMapper(count)
    state = mapper.map(train)(mapper.replicate((ENV, AGENT, HYPER)), mapper.keys(first))
    return mapper.gather({"params": state.params, "observation": state.observation})


@pytest.fixture(scope="module")
def three() -> TrainState:
    return seeds(0, 3)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_seed_of_many_is_bit_for_bit_the_seed_alone(three: dict[str, Any], seed: int) -> None:
    alone = seeds(seed, 1)
    jax.tree.map(lambda many, one: np.testing.assert_array_equal(many[seed], one[0]), three["params"], alone["params"])
    np.testing.assert_array_equal(three["observation"][seed], alone["observation"][0])


def test_a_seed_is_to_rounding_the_same_run_under_vmap(three: dict[str, Any]) -> None:
    keys = jax.vmap(jax.random.key)(np.arange(3))
    together = jax.jit(jax.vmap(train, in_axes=(None, 0)))((ENV, AGENT, HYPER), keys)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), three["params"], together.params)


def test_seeds_differ(three: dict[str, Any]) -> None:
    kernel = three["params"]["actor"][0]["kernel"]
    assert np.abs(kernel[0] - kernel[1]).max() > 0.01


def test_seeds_are_spread_over_devices_and_padded() -> None:
    mapper = SeedMapper(3)
    assert len(jax.devices()) == 2  # as the test settings ask
    assert mapper.mesh.size == 2
    assert mapper.padded == 4
    np.testing.assert_array_equal(mapper.pad(np.array([5, 6, 7])), [5, 6, 7, 7])
