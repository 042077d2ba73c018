"""An actor that corrects a control law."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.agents.agent import Agent, check_agent
from jaxsafe.agents.features import FarOrientedFeatures
from jaxsafe.agents.networks import GRU, MLP
from jaxsafe.commands.train import main as train
from jaxsafe.control import LQR, PD, Align, Pursuit
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from tests.default_cases import thorough

KEY = jax.random.key(5)


@pytest.mark.parametrize(
    ("task", "law"),
    [
        thorough("docking2d", PD()),
        ("docking2d_oriented", Align()),
        ("rejoin2d", Pursuit()),
    ],
)
def test_the_policy_is_the_law_plus_the_actor(task: str, law: Any) -> None:
    env = jaxsafe.make(task)
    agent = normalise(Agent(controller=law, actor=MLP(hidden=(8,))))
    params = agent.init(KEY, env)
    _, starts = jax.vmap(lambda key: jaxsafe.reset(env, key))(jax.random.split(KEY, 6))
    expected = law.policy(env)(KEY, starts.observation)
    inputs = agent.inputs(env, starts.observation)
    np.testing.assert_array_equal(inputs[:, : env.action_size], expected)
    np.testing.assert_array_equal(inputs[:, env.action_size :], starts.observation)

    params["actor"]["output"]["kernel"] *= 0.0
    for shift in (0.0, 0.25):
        params["actor"]["output"]["bias"] += shift
        action, _ = agent.act(env, params, KEY, starts.observation, deterministic=True)
        np.testing.assert_allclose(action, expected + shift, atol=1e-6)


def test_an_actor_that_remembers_corrects_a_law_too() -> None:
    env = jaxsafe.make("docking1d")
    agent = normalise(Agent(controller=PD(), actor=GRU(hidden=(4,), units=3)))
    params = agent.init(KEY, env)
    params["actor"] = jax.tree.map(jnp.zeros_like, params["actor"])
    _, timestep = jaxsafe.reset(env, KEY)
    action, _ = agent.act(env, params, KEY, timestep.observation, True, agent.actor.memory())
    np.testing.assert_allclose(action, PD().policy(env)(KEY, timestep.observation), atol=1e-6)


@pytest.mark.parametrize(
    ("task", "changes", "agent", "message"),
    [
        (
            "docking2d",
            {},
            Agent(controller=LQR()),
            "agent.controller: 'lqr' computes gains before it flies, but the numbers of the"
            " environment may change in a training; choose pd, align or pursuit",
        ),
        (
            "docking2d",
            {"actions": "discrete"},
            Agent(controller=PD()),
            "agent.controller: needs continuous actions, found discrete ones; leave it out",
        ),
        (
            "docking2d",
            {},
            Agent(controller=Align(), features=FarOrientedFeatures()),
            "agent.features: 'far_oriented' needs an oriented_spacecraft with the control 'thrust';"
            " choose approach",
        ),
        (
            "docking2d",
            {},
            Agent(controller=Align()),
            "controller: align flies an oriented_spacecraft; deputy is a spacecraft",
        ),
    ],
)
def test_what_an_actor_cannot_correct(
    task: str, changes: dict[str, Any], agent: Agent, message: str
) -> None:
    with pytest.raises(ConfigError) as error:
        check_agent(agent, jaxsafe.make(task, **changes))
    assert str(error.value) == message


@pytest.mark.thorough
def test_a_policy_that_corrects_a_law_is_trained_kept_and_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["env=docking1d", "agent.controller={type: pd, share: 0.9}", "seed=2", "out=run"]
    assert train([*words, "agent.log_std=-2", "steps=4000", "episodes=10"]) == 0
    policy = jaxsafe.load_policy("run/policy/seed_2.npz")
    env = jaxsafe.make("docking1d")
    _, timestep = jaxsafe.reset(env, KEY)
    law = PD(share=0.9).policy(env)(KEY, timestep.observation)
    np.testing.assert_allclose(policy(KEY, timestep.observation), law, atol=0.2)
    assert jaxsafe.evaluate(env, policy, episodes=20)["success_rate"] == 1.0
