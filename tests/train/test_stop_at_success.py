"""A training that ends before its steps, because every seed succeeds often enough."""

import json
from pathlib import Path
from typing import Any

import pytest
from tiny_run import TINY, assert_same_end, logs

from jaxsafe.commands import train as command
from jaxsafe.commands import tune
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host import run_directory
from jaxsafe.train.recent_episodes import SIZE

EASY = [*TINY, "env.regions.docking_region.radius=200", "stop_at_success=0.9"]
"""Every episode begins inside the docking region. It ends at once, most often with a success.

An update has 64 steps of each seed, so two updates fill the window.
"""


@pytest.fixture(autouse=True)
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxsafe.runs.figures.draw_all", lambda run: [])


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "run"
    assert command.main([*EASY, f"out={run}"]) == 0
    return run


def steps(run: Path) -> list[int]:
    """Return the steps of the updates in the progress log."""
    return sorted({row["step"] for row in logs(run)["progress.jsonl"]})


def results(run: Path) -> dict[str, Any]:
    return json.loads((run / "results.json").read_text())


def test_training_ends_with_the_first_full_window_of_successes(ended: Path) -> None:
    *before, last = steps(ended)
    rows = logs(ended)["progress.jsonl"]
    assert all(row["success_rate"] >= 0.9 for row in rows)
    assert all(row["episodes"] >= SIZE for row in rows if row["step"] == last)
    assert any(row["episodes"] < SIZE for row in rows if row["step"] == before[-1])
    assert results(ended)["steps"] == last < 1280


def test_it_is_evaluated_and_saved_as_at_the_end(ended: Path) -> None:
    (last,) = {row["step"] for row in logs(ended)["eval.jsonl"] if row["final"]}
    assert last == steps(ended)[-1]
    assert {row["step"] for row in logs(ended)["eval.jsonl"]} == {last}
    assert [file.name for file in (ended / "checkpoints").iterdir()] == [str(last)]
    assert len([*(ended / "policy").iterdir()]) == 3


def test_it_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command.main([*EASY, f"out={tmp_path / 'run'}"])
    told = f"every seed succeeds in 90% of its last {SIZE} episodes: training ends at step 128\n"
    assert told in capsys.readouterr().out


def test_a_run_that_was_killed_before_its_evaluation_trains_no_further(
    tmp_path: Path, ended: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr("jaxsafe.runs.training.finish", lambda training: pytest.fail("killed"))
        with pytest.raises(pytest.fail.Exception, match="killed"):
            command.main([*EASY, f"out={run}"])
    assert command.main([f"resume={run}"]) == 0
    assert_same_end(run, ended)


def test_more_steps_are_trained_to_their_end(tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert command.main([*EASY, f"out={run}"]) == 0
    assert command.main([f"resume={run}", "steps=1920"]) == 0
    assert steps(run) == [*range(64, 1921, 64)]
    assert run_directory.read(run, "run")[0].stop_at_success is None


def test_a_curriculum_comes_to_its_end_first(tmp_path: Path) -> None:
    curriculum = "ppo.curriculum={deputy.start.position.distance: [90, 100]}"
    run = tmp_path / "run"
    assert command.main([*EASY, curriculum, "ppo.curriculum_share=0.5", f"out={run}"]) == 0
    assert steps(run)[-1] == 640


def test_a_sweep_refuses_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="stop_at_success: all trainings of a sweep"):
        tune.main([*EASY, "sweep.ppo.gamma=0.9,0.99", f"out={tmp_path / 'sweep'}"])
