from typing import Any

import jax
import numpy as np
import pytest
from test_modes import CHECKED_WHILE_RUNNING, CHECKED_WHILE_TRACING

from jaxsafe import ConfigError

pytestmark = [pytest.mark.peer, pytest.mark.filterwarnings("default")]


@pytest.fixture
def make() -> Any:
    from jaxsafe.adapters.stable_baselines3 import SB3VecEnv

    return SB3VecEnv


def test_the_end_of_an_episode_is_told_as_the_library_wants_it(make: Any) -> None:
    env = make("docking2d", 3, {"terminal.timeout.limit": 2.0})
    env.seed(5)
    first = env.reset()
    zero = np.zeros((3, 2), np.float32)
    for _ in range(2):
        *_, done, infos = env.step(zero)
        assert not done.any()
        assert infos == [{"cost": 0.0, "costs": {"velocity_limit": 0.0}}] * 3
    observation, reward, done, infos = env.step(zero)
    assert done.all()
    assert reward.dtype == np.float32
    assert (observation != first).any()
    for index, info in enumerate(infos):
        assert (info["outcome"], info["is_success"], info["TimeLimit.truncated"]) == (
            "timeout",
            False,
            False,
        )
        assert (info["terminal_observation"] != observation[index]).any()
    env.seed(5)
    assert np.array_equal(env.reset(), first)


def test_a_limit_is_a_truncation(make: Any) -> None:
    env = make("docking2d", 2, max_episode_steps=1)
    env.reset()
    assert [info["TimeLimit.truncated"] for info in env.step(np.zeros((2, 2)))[3]] == [True, True]


def test_an_action_that_is_no_number_is_a_failure_that_costs(make: Any) -> None:
    env = make("docking2d", 2)
    env.reset()
    observation, _, done, infos = env.step(np.array([[0.0, 0.0], [np.nan, 0.0]]))
    assert done.tolist() == [False, True]
    assert (infos[1]["cost"], infos[1]["outcome"], infos[1]["is_success"]) == (
        1.0,
        "diverged",
        False,
    )
    assert np.isfinite(observation).all()


def test_options_place_environments_and_the_infos_of_starts_are_kept(make: Any) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv

    from jaxsafe import ConfigError
    from jaxsafe.adapters.gymnasium import GymEnv

    def placed(x: float) -> dict[str, Any]:
        return {"start": {"deputy": {"position": [x, 0.0], "velocity": [0.0, 0.0]}}}

    env = make("docking2d", 3, max_episode_steps=2)
    expected = DummyVecEnv([lambda: GymEnv("docking2d", max_episode_steps=2)] * 3)
    for options in (placed(30.0), [placed(20.0), {}, placed(40.0)], None):
        for batch in (env, expected):
            batch.seed(5)
            batch.set_options(options)
        np.testing.assert_allclose(env.reset(), expected.reset(), rtol=1e-6)
        for _ in range(5):  # options are for one reset
            np.testing.assert_allclose(
                env.step(np.ones((3, 2)))[0], expected.step(np.ones((3, 2)))[0], rtol=1e-5
            )
            for ours, theirs in zip(env.reset_infos, expected.reset_infos, strict=True):
                assert ours.keys() == theirs.keys()
                assert ours["margins"] == pytest.approx(theirs["margins"])
                assert ours["status"] == pytest.approx(theirs["status"])
                assert (ours["outcome"], type(ours["cost"])) == (
                    theirs["outcome"],
                    type(theirs["cost"]),
                )
    with pytest.raises(
        ConfigError, match="set_options: expected options for 3 environments, found"
    ):
        env.set_options([placed(20.0)])
    env.set_options({"stat": {}})
    with pytest.raises(
        ConfigError,
        match=r"options: unknown 'stat'\. Did you mean 'start'\? Choose from start, parameters",
    ):
        env.reset()


def test_the_library_accepts_single_environments() -> None:
    from stable_baselines3.common.env_checker import check_env

    from jaxsafe.adapters.gymnasium import GymEnv

    check_env(GymEnv("rejoin2d"))


@pytest.mark.slow
def test_its_ppo_learns_docking(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stable_baselines3")
    monkeypatch.syspath_prepend("examples")
    import stable_baselines3_docking2d as example

    model = example.train()
    for deterministic in (False, True):
        assert example.success_rate(model, deterministic) >= 0.95


MODES = CHECKED_WHILE_TRACING | CHECKED_WHILE_RUNNING | {"disable_jit": jax.disable_jit}


@pytest.mark.parametrize("mode", MODES)
def test_it_works_in_every_mode_of_jax(make: Any, mode: str) -> None:
    with MODES[mode]():
        env = make("docking2d", 3, max_episode_steps=2)
        env.seed(0)
        env.set_options({"start": {"deputy": {"position": [30.0, 0.0], "velocity": [-0.9, 0.0]}}})
        env.reset()
        for step in range(2):
            observation, _, done, _ = env.step(np.zeros((3, 2), np.float32))
            assert np.isfinite(observation).all()
            assert done.all() == (step == 1)


def test_actions_that_the_library_does_not_know_are_refused(make: Any) -> None:
    thrust_x = "deputy.controller.actuators.thrust_x"
    with pytest.raises(ConfigError, match=r"^actions: Stable-Baselines3 knows no mixed actions"):
        make("docking2d", 1, {f"{thrust_x}.discrete": True}, actions="mixed")
    with pytest.raises(
        ConfigError, match=r"^actuator thrust_x: Stable-Baselines3 needs actions with"
    ):
        make("docking2d", 1, {f"{thrust_x}.post_activation": "tanh"})
