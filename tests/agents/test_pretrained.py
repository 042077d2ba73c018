"""The policies that come with the package."""

from pathlib import Path

import jax
import numpy as np
import pytest

import jaxsafe
from jaxsafe.agents.policy_file import find_policy, read_policy
from jaxsafe.commands.evaluate import main
from jaxsafe.envs import TASKS
from jaxsafe.evaluate.episodes import run_episodes
from jaxsafe.schema.errors import ConfigError


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_a_policy_trained_in_it(task: str) -> None:
    saved = read_policy(find_policy(task))
    assert saved.about["env"] == task
    assert saved.env == jaxsafe.make(task)
    assert find_policy(task).stat().st_size < 200_000
    _, timestep = saved.env.reset(jax.random.key(0))
    action = jaxsafe.load_policy(task)(jax.random.key(0), timestep.observation)
    assert action.shape == (saved.env.action_size,)
    assert np.isfinite(action).all()


def flown(task: str, episodes: int) -> float:
    """Return the share of successes."""
    env = jaxsafe.make(task)
    policy = jaxsafe.load_policy(task)
    episode_batch = jax.jit(lambda env, key: run_episodes(env, policy, key, episodes))(
        env, jax.random.key(7)
    )
    return float(np.mean(env.succeeded(np.asarray(episode_batch.outcome))))


@pytest.mark.thorough
def test_the_policy_of_docking_docks() -> None:
    assert flown("docking2d", 50) >= 0.98


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_every_policy_does_its_task(task: str) -> None:
    assert flown(task, 500) >= 0.98


def test_pretrained_policies_are_evaluated_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["run=pretrained/docking2d", "episodes=20", "deterministic=true"]) == 0
    assert (tmp_path / "evaluations" / "docking2d" / "last-20-seed0" / "results.json").is_file()


def test_an_unknown_name_is_told_with_those_that_are_known() -> None:
    with pytest.raises(
        ConfigError,
        match=r"not pretrained\. Did you mean 'docking3d'\? Choose from docking2d, ",
    ):
        jaxsafe.load_policy("docking")
