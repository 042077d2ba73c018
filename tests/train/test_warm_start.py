"""Trainings that start from another one, and runs that go on after their end."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from tiny_run import TINY, final_state

import jaxsafe
from jaxsafe.agents.policy_file import read_policy
from jaxsafe.commands.train import main
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host.options import resolve

LONGER = ["resume=run", "steps=2560"]
SHORT = [word for word in TINY if not word.startswith(("env=", "agent.", "steps="))]
"""Options of a tiny run that say neither what is trained nor for how long."""


def first_params(run: Path, words: list[str]) -> list[dict]:
    """Return what each seed of a training starts from: it learns nothing in its only update."""
    frozen = [
        "steps=64",
        "ppo.learning_rate=1e-30",
        "ppo.final_learning_rate=0",
        "ppo.noise_decay=0",
    ]
    assert main(["env=docking2d", *SHORT, *frozen, f"out={run}", *words]) == 0
    return [read_policy(run / "policy" / f"seed_{seed}.npz").params for seed in range(3)]


@pytest.mark.thorough
def test_every_seed_starts_from_its_own_policy_of_a_run(whole: Path, tmp_path: Path) -> None:
    words = [f"from={whole}", "env.reward.delta_v.scale=-0.02"]
    for seed, params in enumerate(first_params(tmp_path / "run", words)):
        before = read_policy(whole / "policy" / f"seed_{seed}.npz").params
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), params, before)


@pytest.mark.thorough
def test_all_seeds_start_from_one_policy(whole: Path, tmp_path: Path) -> None:
    policy = whole / "policy" / "seed_1.npz"
    for params in first_params(tmp_path / "run", [f"from={policy}"]):
        before = read_policy(policy).params
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), params, before)


@pytest.mark.thorough
def test_python_starts_from_parameters() -> None:
    config, env, _ = resolve({"env": "docking2d", "ppo.num_envs": 4, "ppo.num_steps": 8})
    key = jax.random.key(0)
    state, _ = jaxsafe.train(env, config.agent, config.ppo, key, 1)
    frozen = config.ppo.replace(learning_rate=0.0, final_learning_rate=0.0, noise_decay=0.0)
    again, _ = jaxsafe.train(env, config.agent, frozen, key, 1, params=state.params)
    jax.tree.map(np.testing.assert_array_equal, again.params, state.params)


@pytest.mark.thorough
def test_a_run_that_has_ended_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*TINY, "out=run"]) == 0
    ended = json.loads(Path("run/results.json").read_text())
    assert main(LONGER) == 0
    assert json.loads(Path("run/results_1280.json").read_text()) == ended
    assert json.loads(Path("run/results.json").read_text())["steps"] == 2560
    assert final_state(Path("run"))["updates"] == 40
    rows = [json.loads(row) for row in Path("run/progress.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows][:: len(rows) - 1] == [64, 2560]
    with pytest.raises(ConfigError, match="steps: expected more than the 2,560 of run"):
        main(LONGER)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["from=nowhere"], "from: no run in 'nowhere'"),
        (["from=pretraned/docking2d"], "no policy file. Did you mean 'pretrained/docking2d'"),
        (["from=pretrained/docking9d"], "is no .npz file and not pretrained. Did you mean"),
        (["from=pretrained/docking2d"], "agent.actor.hidden: the training starts from pretrained"),
    ],
)
def test_what_no_training_can_start_from_is_told(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        main([*TINY, *words])


@pytest.mark.thorough
def test_networks_of_another_shape_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        ConfigError, match=r"from: actor/hidden_0/kernel: expected .*20, 64.*found .*15, 64"
    ):
        main(["env=docking3d", *SHORT, "steps=64", "from=pretrained/docking2d"])
    assert not Path("runs").exists() or not [*Path("runs").iterdir()]
