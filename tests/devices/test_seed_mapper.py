from collections.abc import Callable

import jax
import numpy as np
import pytest
from default_cases import thorough
from own_process import check_as_compiled_by_commands

import jaxsafe
from jaxsafe.agents.agent import Agent
from jaxsafe.agents.features import ApproachFeatures, DockingFeatures
from jaxsafe.agents.networks import GRU
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.hyperparameters import PPO
from jaxsafe.train.ppo import DIAGNOSTICS, TrainState
from jaxsafe.train.train import begin, chunk, programs

ENV = jaxsafe.make("docking2d")
AGENT = normalise(Agent(features=DockingFeatures()))
HYPER = normalise(PPO(num_envs=4, num_steps=32, num_epochs=2))
UPDATES = 5


def seeds(
    first: int, count: int, share: int = 1, updates: int = UPDATES, agent: Agent = AGENT
) -> TrainState:
    mapper = SeedMapper(count, (share,))
    shared = mapper.replicate((ENV, agent, HYPER))
    fresh, advance = programs(mapper, updates, UPDATES)
    state = fresh(shared, mapper.keys(first))
    return mapper.gather(advance(shared, state)[0] if updates else state)


@pytest.fixture(scope="module")
def three() -> TrainState:
    return seeds(0, 3)


def check_that_seeds_of_many_are_seeds_alone() -> None:
    many = seeds(0, 3)
    for seed in range(3):
        jax.tree.map(
            lambda of_many, alone, seed=seed: np.testing.assert_array_equal(
                of_many[seed], alone[0]
            ),
            many,
            seeds(seed, 1),
        )


def check_that_oriented_docking_starts_as_the_seed_alone() -> None:
    env = jaxsafe.make("docking2d_oriented")
    shared = env, normalise(Agent(features=ApproachFeatures())), normalise(PPO(num_envs=32))

    def starts(count: int) -> TrainState:
        mapper = SeedMapper(count)
        return mapper.gather(programs(mapper, 1, 1)[0](mapper.replicate(shared), mapper.keys(0)))

    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b[0]), starts(3), starts(1))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "check",
    [
        check_that_seeds_of_many_are_seeds_alone,
        check_that_oriented_docking_starts_as_the_seed_alone,
    ],
)
def test_a_seed_of_many_is_bit_for_bit_the_seed_alone(check: Callable[[], None]) -> None:
    check_as_compiled_by_commands(check)


@pytest.mark.thorough
@pytest.mark.parametrize(("updates", "share"), [thorough(0, 2), (UPDATES, 2)])
def test_devices_that_share_a_seed_train_what_one_trains_to_rounding(
    updates: int, share: int
) -> None:
    alone = seeds(0, 1, 1, updates)
    shared = seeds(0, 1, share, updates)
    if not updates:
        jax.tree.map(np.testing.assert_array_equal, alone, shared)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), alone, shared)
    assert alone.num_updates == updates


@pytest.mark.thorough
def test_devices_that_share_a_seed_log_the_diagnostics_of_the_whole_batch() -> None:
    agent = AGENT.replace(cost_critic=True)

    def curves(share: int) -> dict[str, np.ndarray]:
        mapper = SeedMapper(1, (share,))
        fresh, advance = programs(mapper, 2, 2)
        shared = mapper.replicate((ENV, agent, HYPER))
        return mapper.gather(advance(shared, fresh(shared, mapper.keys(0)))[1])

    alone, shared = curves(1), curves(2)
    for name in DIAGNOSTICS:
        np.testing.assert_allclose(shared[name], alone[name], rtol=1e-3, atol=1e-5, err_msg=name)


@pytest.mark.thorough
def test_devices_share_a_seed_whose_networks_remember() -> None:
    agent = normalise(Agent(actor=GRU(hidden=(4,), units=4)))
    alone = seeds(0, 1, 1, updates=2, agent=agent)
    shared = seeds(0, 1, 2, updates=2, agent=agent)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4),
        (alone.params, alone.memory),
        (shared.params, shared.memory),
    )


@pytest.mark.thorough
def test_a_seed_is_to_rounding_the_same_run_under_vmap(three: TrainState) -> None:
    keys = jax.vmap(jax.random.key)(np.arange(3))

    def train(shared: tuple, key: jax.Array) -> TrainState:
        return chunk(shared, begin(shared, key), UPDATES, UPDATES)[0]

    together = jax.jit(jax.vmap(train, in_axes=(None, 0)))((ENV, AGENT, HYPER), keys)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), three.params, together.params
    )


def test_seeds_differ(three: TrainState) -> None:
    kernel = three.params["actor"]["hidden_0"]["kernel"]
    assert np.abs(kernel[0] - kernel[1]).max() > 0.01


def test_seeds_are_spread_over_devices_and_padded() -> None:
    mapper = SeedMapper(3)
    assert len(jax.devices()) == 2  # as the settings of the tests ask
    assert mapper.mesh.size == 2
    assert mapper.num_local_devices == 2
    assert mapper.padded == 4
    np.testing.assert_array_equal(mapper.pad(np.array([5, 6, 7])), [5, 6, 7, 7])


def test_devices_share_a_seed_where_there_are_more_than_seeds() -> None:
    assert SeedMapper(1, (1, 2)).mesh.shape == {"seeds": 1, "envs": 2}
    assert SeedMapper(2, (1, 2)).mesh.shape == {"seeds": 2, "envs": 1}
    assert SeedMapper(1, (1,)).mesh.size == 1
    assert SeedMapper(3, (2,)).mesh.shape == {"seeds": 1, "envs": 2}
    with pytest.raises(ConfigError, match=r"^devices_per_seed: found 4, there are 2 devices$"):
        SeedMapper(1, (4,))
