"""A seed whose networks or returns are not finite stops training.

It is never reported as a result.
"""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe_environments import Position, probe
from tiny_run import TINY

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.networks import MLP
from jaxsafe.commands import cli
from jaxsafe.commands import evaluate as evaluate
from jaxsafe.commands import train as command
from jaxsafe.commands import tune as tune
from jaxsafe.plot.compare import compare_curves
from jaxsafe.plot.curves import training_curves
from jaxsafe.runs.figures import progress
from jaxsafe.schema.component import normalise
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.checkpoint import Checkpoints
from jaxsafe.train.host.restore import structure
from jaxsafe.train.host.results import summary
from jaxsafe.train.host.session import Training
from jaxsafe.train.hyperparameters import PPO
from jaxsafe.train.ppo import DIAGNOSTICS, diverged, init

AT = 384
"""The step after which the networks of a seed are not finite. It lies between two evaluations."""


def rows(run: Path, name: str, seed: int) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (run / name).read_text().splitlines()]
    return [
        {key: value for key, value in row.items() if key != "wall_s"}
        for row in lines
        if row["seed"] == seed
    ]


def train(run: Path, monkeypatch: pytest.MonkeyPatch, spoilt: list[int]) -> None:
    """Train as the fixture `whole` does.

    The networks of the `spoilt` seeds get a NaN on the way.
    """
    original = Training._write_progress

    def spoil_in_time(self: Training, *args: Any) -> None:
        original(self, *args)
        if self.step == AT:

            def spoil(params: dict) -> dict:
                log_std = params["log_std"].at[jnp.array(spoilt)].set(jnp.nan)
                return {**params, "log_std": log_std}

            self.state = self.state.replace(
                params=spoil(self.state.params), average=spoil(self.state.average)
            )

    with monkeypatch.context() as patch:
        patch.setattr(Training, "_write_progress", spoil_in_time)
        assert command.main([*TINY, f"out={run}"]) == cli.DIVERGED


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("diverged") / "run"
    with pytest.MonkeyPatch.context() as patch:
        train(path, patch, [1])
    return path


def test_the_other_seeds_go_on_and_keep_their_bits(run: Path, whole: Path) -> None:
    for seed in (0, 2):
        for name in ("progress.jsonl", "eval.jsonl", "episodes.jsonl"):
            assert rows(run, name, seed) == rows(whole, name, seed)
        spoilt_run, sound_run = (
            np.load(path / "policy" / f"seed_{seed}.npz") for path in (run, whole)
        )
        assert all(
            spoilt_run[name].tobytes() == sound_run[name].tobytes() for name in spoilt_run.files
        )


def test_the_seed_stops_and_the_log_says_so(run: Path, whole: Path) -> None:
    log = rows(run, "progress.jsonl", 1)
    before = rows(whole, "progress.jsonl", 1)
    going = AT // 64
    assert log[:going] == before[:going]
    # Every update has a row all the same.
    assert [row["step"] for row in log] == [row["step"] for row in before]
    for row in log[going:]:
        assert row["diverged"] is True
        assert row["episodes"] == log[going - 1]["episodes"]
        assert {
            row[name] for name in ("success_rate", "return", "violating_share", "episode_cost")
        } == {None}
        assert {row.get(name) for name in DIAGNOSTICS} == {None}
    assert not any(row["diverged"] for row in before)
    assert {row["step"] for row in rows(run, "eval.jsonl", 1)} == {0, 320}


def test_no_figure_has_it_and_that_is_said(
    run: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, before = (json.loads((path / "results.json").read_text()) for path in (run, whole))
    assert results["diverged"] == [{"seed": 1, "step": AT + 64}]
    assert "diverged" not in before
    for kind in ("stochastic", "deterministic"):
        for name, metric in results["evaluation"][kind].items():
            values = before["evaluation"][kind][name]["per_seed"]
            assert metric["per_seed"] == [values[0], None, values[2]]
            assert metric["mean"] == (
                None if values[0] is None else pytest.approx((values[0] + values[2]) / 2)
            )
    assert results["training_cost"]["per_seed"][1] is None
    assert {path.name for path in (run / "policy").iterdir()} == {"seed_0.npz", "seed_2.npz"}
    assert command.main([f"resume={run}"]) == cli.DIVERGED
    capsys.readouterr()
    assert f"DIVERGED, and left out of the averages: seed 1 by step {AT + 64}" in summary(
        {"run": run}
    )


def test_its_best_checkpoint_is_one_from_before(run: Path) -> None:
    config, env, _ = run_directory.read(run, "run")
    content = Checkpoints(run).restore(1280, structure(env, config))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(content["best"]["params"]))
    assert not np.isfinite(content["state"].params["log_std"][1]).any()


@pytest.mark.thorough
def test_an_evaluation_says_the_same(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate.main([f"run={run}", "episodes=4", f"out={tmp_path / 'last'}"]) == cli.DIVERGED
    assert "DIVERGED, and left out of the averages: seed 1" in capsys.readouterr().out
    results = json.loads((tmp_path / "last" / "results.json").read_text())
    assert results["evaluation"]["stochastic"]["safety_violation_rate"]["per_seed"][1] is None
    assert rows(tmp_path / "last", "eval.jsonl", 1) == []
    assert (
        evaluate.main([f"run={run}", "episodes=4", "checkpoint=best", f"out={tmp_path / 'best'}"])
        == 0
    )


@pytest.mark.thorough
def test_a_run_of_which_every_seed_diverged_has_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    train(tmp_path / "run", monkeypatch, [0, 1, 2])
    told = capsys.readouterr().out
    assert f"seed 2 has diverged by step {AT + 64}" in told
    assert (
        f"DIVERGED, and left out of the averages: seeds 0 by step {AT + 64}, 1 by step {AT + 64},"
        " 2 by"
    ) in told
    assert "violating steps" not in told
    assert not (tmp_path / "run" / "policy").exists()
    assert "DIVERGED" in summary({"run": tmp_path / "run"})


@pytest.mark.thorough
def test_infinite_returns_count_too() -> None:
    agent = normalise(Agent(actor=MLP(hidden=(4,))))
    ppo = normalise(PPO(num_envs=2))
    state = init(probe(Position(name="reward")), agent, ppo, jax.random.key(0))
    assert not diverged(state)
    returns = state.window.episodes.episode_return
    for value in (jnp.inf, jnp.nan):
        episodes = state.window.episodes.replace(episode_return=returns.at[3].set(value))
        assert diverged(state.replace(window=state.window.replace(episodes=episodes)))


@pytest.mark.thorough
def test_a_sweep_ranks_it_last_and_marks_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sweep"
    rates = "[1e30,3e-3]"
    words = [
        f"sweep.ppo.learning_rate={rates}",
        "ppo.final_learning_rate=3e-3",
        "rank=success",
        f"out={path}",
    ]
    assert tune.main([*TINY, *words]) == 0
    told = capsys.readouterr().out
    first, last = json.loads((path / "results.json").read_text())["settings"]
    assert (first["setting"], last["setting"]) == (1, 0)
    assert "diverged" not in first
    assert [seed["seed"] for seed in last["diverged"]] == [0, 1, 2]
    assert set(last["evaluation"]["deterministic"]["safety_violation_rate"]) == {None}
    assert last["training_success"] == [0.0, 0.0, 0.0]
    assert (
        "setting 0: DIVERGED, and left out of the averages: seeds 0 by step 64, 1 by step 64, 2"
        " by step 64"
    ) in told
    assert (path / "results.csv").read_text().splitlines()[-1].endswith(",3")


def test_curves_leave_out_the_seeds_that_diverged_and_say_so(run: Path, whole: Path) -> None:
    broken = progress(run)
    sound = progress(whole)
    figure = training_curves(broken, "steps", "title")
    assert "without seed 1, which diverged" in figure.get_suptitle().replace("\n", " ")
    alone = [row for row in sound if row["seed"] != 1]
    expected = training_curves(alone, "steps", "title").axes[1].lines
    for line, other in zip(figure.axes[1].lines, expected, strict=True):
        np.testing.assert_array_equal(line.get_ydata(), other.get_ydata())
    compared = compare_curves({"broken": broken, "sound": sound}, "title")
    [legend] = compared.legends or filter(None, (axes.get_legend() for axes in compared.axes))
    names = [text.get_text() for text in legend.get_texts()]
    assert names[:2] == ["broken, without seed 1, which diverged", "sound"]
    every = [row | {"diverged": True, "return": None} for row in sound]
    assert "diverged" not in training_curves(every, "steps", "title").get_suptitle()
