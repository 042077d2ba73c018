"""A loaded policy knows what it is for and acts within the bounds of the actuators."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe import ConfigError
from jaxsafe.agents import GRU, Agent, read_policy, save_policy
from jaxsafe.agents.policy_file import find_policy
from jaxsafe.agents.trained_policy import trained_policy
from jaxsafe.rollout import RecurrentPolicy

POLICY = """\
Policy of docking2d, most probable action
  observation  6 numbers: position.x, position.y, velocity.x, velocity.y, speed, velocity_limit
  action       2 numbers in [-1, 1]: thrust_x from -1 to 1 N; thrust_y from -1 to 1 N
  network      mlp, hidden (64, 64), activation tanh, layer_norm False
  features     approach
  trained      preset engineered_features, seed 2, 500,736 steps"""


def test_a_policy_prints_what_it_is_for() -> None:
    policy = jaxsafe.load_policy("docking2d")
    assert policy.task == "docking2d"
    assert policy.action_names == ("thrust_x", "thrust_y")
    assert policy.observation_names == jaxsafe.make("docking2d").observation_names
    assert repr(policy) == POLICY


def test_a_sample_outside_the_bounds_is_what_the_controller_makes_of_it() -> None:
    saved = read_policy(find_policy("docking2d"))
    observation = jax.random.normal(jax.random.key(0), (500, saved.env.observation_size))
    wide = {**saved.params, "log_std": jnp.ones(2)}
    free = jax.jit(saved.agent.policy(saved.env, wide, False))(jax.random.key(1), observation)
    policy = trained_policy(saved.env, saved.agent, wide, saved.about, deterministic=False)
    action = policy(jax.random.key(1), observation)
    assert np.abs(free).max() > 1.5
    np.testing.assert_array_equal(action, np.clip(free, -1.0, 1.0))


def test_another_observation_is_refused_in_one_line() -> None:
    policy = jaxsafe.load_policy("docking2d")
    with pytest.raises(
        ConfigError,
        match=r"^observation: expected 6 numbers on the last axis, as docking2d observes, "
        r"found shape \(4, 8\)$",
    ):
        policy(jax.random.key(0), jnp.zeros((4, 8)))
    env = jaxsafe.make("docking3d")
    with pytest.raises(ConfigError, match=r"observation: expected 6 numbers"):
        jaxsafe.rollout(env, policy, jax.random.key(0), num_steps=1)


@pytest.mark.thorough
def test_a_policy_that_remembers_is_described_and_checked_too(tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d")
    agent = Agent(actor=GRU(hidden=(4,), units=3))
    params = agent.init(jax.random.key(0), env)
    save_policy(tmp_path / "gru.npz", env, agent, params, {"env": "docking2d"})
    policy = jaxsafe.load_policy(tmp_path / "gru.npz")
    assert isinstance(policy, RecurrentPolicy)
    assert "network      gru, hidden (4,), units 3" in repr(policy)
    action, memory = policy.act(jax.random.key(0), jnp.zeros((5, 6)), jnp.zeros((5, 3)))
    assert action.shape == (5, 2)
    assert memory.shape == (5, 3)
    with pytest.raises(ConfigError, match="observation: expected 6 numbers"):
        policy.act(jax.random.key(0), jnp.zeros(5), policy.memory)


@pytest.mark.thorough
def test_a_policy_of_mixed_actions_comes_back_from_its_file(tmp_path: Path) -> None:
    env = jaxsafe.make(
        "docking2d", {"deputy.controller.actuators.thrust_y.discrete": True}, actions="mixed"
    )
    agent = Agent(log_std=1.0)
    params = agent.init(jax.random.key(0), env)
    save_policy(tmp_path / "mixed.npz", env, agent, params, {"env": "docking2d"})
    policy = jaxsafe.load_policy(tmp_path / "mixed.npz", deterministic=False)
    line = "2 numbers and indices: thrust_x from -1 to 1 N; thrust_y, 11 points from -1 to 1 N"
    assert line in repr(policy)
    assert policy.env.num_action_points == (0, 11)
    action = np.asarray(policy(jax.random.key(1), jnp.zeros((200, 6))))
    assert np.abs(action[:, 0]).max() == 1.0
    assert set(action[:, 1]) <= set(range(11))
    assert len(set(action[:, 1])) > 3
