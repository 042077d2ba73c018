"""Numbers of the environment move while a training goes on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host.options import resolve
from jaxsafe.train.hyperparameters import PPO, on_the_way
from jaxsafe.train.ppo import init, update

DISTANCE = "deputy.start.position.distance"
FAR = {f"env.{DISTANCE}": [100.0, 10_000.0]}


def test_numbers_move_by_a_factor_and_then_stay() -> None:
    env = jaxsafe.make("docking2d", {DISTANCE: [100.0, 10_000.0]})
    ppo = normalise(PPO(curriculum={DISTANCE: [100.0, 1000.0]}, curriculum_share=0.5))
    for progress, highest in ((0.0, 1e3), (0.25, np.sqrt(1e7)), (0.5, 1e4), (1.0, 1e4)):
        distance = _distance(on_the_way(env, ppo, progress))
        np.testing.assert_allclose(distance, [100.0, highest], rtol=1e-5)


def _distance(env: jaxsafe.Environment) -> jax.Array:
    return env.agent_platform.start[0].distance  # type: ignore[attr-defined]


def test_a_number_that_may_be_negative_moves_by_a_difference() -> None:
    env = jaxsafe.make("docking2d")
    ppo = normalise(PPO(curriculum={"reward.delta_v.scale": 0.0}, curriculum_share=1.0))
    moved = on_the_way(env, ppo, 0.5)
    term = next(term for term in moved.reward if term.name == "delta_v")
    assert float(term.scale) == pytest.approx(-0.005)  # type: ignore[attr-defined]


def test_tied_numbers_follow() -> None:
    env = jaxsafe.make("docking2d")
    ppo = normalise(PPO(curriculum={"terminal.timeout.limit": 500.0}))
    term = next(term for term in on_the_way(env, ppo, 0.0).reward if term.name == "success")
    assert float(term.time_scale) == 500.0  # type: ignore[attr-defined]


def test_starts_of_a_training_move_away() -> None:
    """Episodes end after two steps, so the environments always show recent starts."""
    env = jaxsafe.make("docking2d", {DISTANCE: [9000.0, 10_000.0], "terminal.timeout.limit": 1.0})
    agent = resolve({"env": "docking2d", "preset": "observation_only"})[0].agent
    ppo = PPO(num_envs=8, num_steps=4, num_epochs=1, curriculum={DISTANCE: [90.0, 100.0]})
    ppo = normalise(ppo)
    state = jax.jit(init)(env, agent, ppo, jax.random.key(0))
    seen = [_distances(state)]
    step = jax.jit(update)
    for _ in range(8):
        state, _ = step(env, agent, ppo, 8, state)
        seen.append(_distances(state))
    assert seen[0].max() < 110.0
    assert seen[-1].min() > 8900.0
    middle = np.median(seen, axis=1)
    assert (np.diff(middle[:4]) > 0.0).all()
    assert 150.0 < middle[2] < 8000.0


def _distances(state: object) -> np.ndarray:
    position = state.env_state.sim.platforms["deputy"].position  # type: ignore[attr-defined]
    return np.asarray(jnp.linalg.norm(position, axis=-1))


@pytest.mark.parametrize(
    ("curriculum", "message"),
    [
        ({"deputy.start.position.distanc": [1.0, 2.0]}, "ppo.curriculum.deputy.start.position"),
        ({DISTANCE: 100.0}, "distance"),
        ({DISTANCE: [-5.0, 100.0]}, "distance"),
        ({"reward.success.outcome": 1.0}, "outcome"),
    ],
)
def test_a_curriculum_that_does_not_fit_is_told_in_one_line(
    curriculum: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        resolve({"env": "docking2d", "ppo.curriculum": curriculum})
    assert "\n" not in str(caught.value)


def test_a_curriculum_stands_in_the_options_of_a_training() -> None:
    config, env, _ = resolve({"env": "docking2d", **FAR, "ppo.curriculum": {DISTANCE: [100, 150]}})
    np.testing.assert_allclose(config.ppo.curriculum[DISTANCE], [100.0, 150.0])
    np.testing.assert_allclose(_distance(env), [100.0, 10_000.0])
