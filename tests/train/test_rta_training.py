"""Training and evaluating with run time assurance in the loop.

The tests check what PPO is told of interventions, and what is reported.
"""

import json
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_run import TINY

import jaxsafe
from jaxsafe.agents.agent import Agent
from jaxsafe.agents.networks import MLP
from jaxsafe.commands.evaluate import main as evaluate
from jaxsafe.commands.train import main as train
from jaxsafe.config.arguments import Arguments
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.options import TrainConfig, resolve
from jaxsafe.train.hyperparameters import PPO
from jaxsafe.train.ppo import Transition, collect, init

step = jax.jit(jaxsafe.step)
FAST = {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, 0.405]}}


def resolved(*words: str) -> tuple[TrainConfig, jaxsafe.Environment]:
    return resolve(Arguments.parse(["env=docking2d", *words]).options)[:2]


@cache
def collected(learns_from: str) -> Transition:
    env = jaxsafe.make("docking2d", rta="default")
    agent = normalise(Agent(actor=MLP(hidden=(8,))))
    ppo = normalise(PPO(num_envs=16, num_steps=32, learns_from=learns_from))
    state = init(env, agent, ppo, jax.random.key(0))
    return jax.jit(lambda state, key: collect(env, agent, ppo, state, key)[1])(
        state, jax.random.key(1)
    )


@pytest.mark.thorough
def test_ppo_learns_from_the_desired_or_the_actual_control() -> None:
    desired = np.asarray(collected("desired").action)
    actual = np.asarray(collected("actual").action)
    altered = (desired != actual).any(axis=-1)
    assert 0.01 < altered.mean() < 0.9
    assert (np.abs(actual[altered]) <= 1.0).all()  # what acted was within its bounds
    assert (np.abs(desired[~altered]) == np.abs(actual[~altered])).all()


@pytest.mark.thorough
def test_the_log_probability_is_that_of_the_stored_action() -> None:
    env = jaxsafe.make("docking2d", rta="default")
    agent = normalise(Agent(actor=MLP(hidden=(8,))))
    ppo = normalise(PPO(num_envs=16, num_steps=32, learns_from="actual"))
    params = init(env, agent, ppo, jax.random.key(0)).params
    transition = collected("actual")
    expected = agent.distribution(env, params, transition.inputs).log_prob(transition.action)
    np.testing.assert_allclose(transition.log_prob, expected, rtol=1e-4, atol=1e-4)


def test_an_intervention_costs_what_its_term_says() -> None:
    _, env = resolved("rta=default", "env.reward.intervention.scale=-0.25")
    state, first = jaxsafe.reset_to(env, FAST)
    assert first.info.reward_terms["intervention"] == 0.0
    for push, cost in [(1.0, -0.25), (-1.0, 0.0)]:
        _, timestep = step(env, state, jnp.array([0.0, push]))
        assert timestep.info.intervening == (cost < 0.0)
        assert timestep.info.reward_terms["intervention"] == cost


def test_interventions_are_punished_where_there_is_a_filter_and_nothing_else_is_asked() -> None:
    for words, told, punished in [
        (["rta=default"], "punishment", True),
        (["rta=default", "rta_training=punishment"], "punishment", True),
        (["rta=default", "rta_training=no_punishment"], "no_punishment", False),
        (["rta=default", "rta_training=corrected_action"], "corrected_action", False),
        ([], None, False),
    ]:
        config, env = resolved(*words)
        assert config.rta_training == told
        assert ("intervention" in [term.name for term in env.reward]) == punished


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["rta_training=no_punishment"],
            r"^rta_training: 'no_punishment' needs run time assurance, for instance rta=default",
        ),
        (
            ["rta_training=punishment"],
            r"^rta_training: 'punishment' needs run time assurance, for instance rta=default",
        ),
        (["rta=default", "rta_training=punishd"], r"^rta_training: .*Did you mean 'punishment'"),
        (
            ["rta=default", "rta_training=corrected_action", "actions=discrete"],
            r"^ppo\.learns_from: .*use actions=continuous",
        ),
        (["rta=released"], r"^rta: docking2d has no preset 'released'"),
    ],
)
def test_what_does_not_go_together_is_told(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        resolved(*words)


def test_corrected_is_a_setting_of_ppo() -> None:
    config, env = resolved("rta=default", "rta_training=corrected_action")
    assert config.ppo.learns_from == "actual"
    assert env.rta is not None
    assert resolved()[0].ppo.learns_from == "desired"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("rta") / "run"
    assert train([*TINY, "seed=2", "rta=explicit_simplex", f"out={out}"]) == 0
    return out


def results(path: Path) -> Any:
    return json.loads((path / "results.json").read_text())["evaluation"]["stochastic"]


@pytest.mark.thorough
def test_a_run_reports_how_often_it_was_corrected(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert results(run)["intervention_rate"]["mean"] > 0.0
    assert results(run)["episode_safety_violation_rate"]["mean"] == 0.0
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert any(row["intervention_share"] for row in rows)
    assert any(row["reward/intervention"] for row in rows)
    logged = [
        json.loads(line) for file in run.rglob("*.jsonl") for line in file.read_text().splitlines()
    ]
    steps = [row["rta"] for row in logged if "rta" in row]
    assert any(row["intervening"] for row in steps)
    assert all(row["certified"] for row in steps)


@pytest.mark.thorough
def test_an_evaluation_switches_the_filter(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate([f"run={run}", "episodes=6", f"out={tmp_path / 'own'}"]) == 0
    assert results(tmp_path / "own") == results(run)
    assert "steps with an intervention" in capsys.readouterr().out
    assert evaluate([f"run={run}", "episodes=6", "rta=none", f"out={tmp_path / 'none'}"]) == 0
    assert "intervention" not in capsys.readouterr().out
    assert results(tmp_path / "none")["intervention_rate"]["mean"] is None
    assert results(tmp_path / "none")["episode_safety_violation_rate"]["mean"] > 0.0
    assert json.loads((tmp_path / "none" / "results.json").read_text())["changes"] == {
        "rta": "none"
    }
    assert (
        evaluate([f"run={run}", "episodes=6", "rta=discrete_asif", f"out={tmp_path / 'other'}"])
        == 0
    )
    assert results(tmp_path / "other") != results(run)
    with pytest.raises(ConfigError, match=r"^rta: docking2d has no preset 'of'"):
        evaluate([f"run={run}", "rta=of"])


@pytest.mark.thorough
def test_a_run_of_an_older_version_is_read_by_the_new_names(tmp_path: Path) -> None:
    config, env = resolved("rta=default", f"out={tmp_path / 'run'}")
    run = run_directory.create(config, env, "docking2d")
    file = run / "config.yaml"
    file.write_text(file.read_text().replace("rta_training: punishment", "rta_training: punished"))
    assert "punished" in file.read_text()
    assert run_directory.read(run, "run")[0].rta_training == "punishment"
