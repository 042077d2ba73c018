import json
from pathlib import Path
from typing import Any

import pytest
from tiny_run import TINY

from jaxsafe.commands.train import main
from jaxsafe.train.host.comparison import csv_rows, latex
from jaxsafe.train.host.log import headline
from jaxsafe.train.host.results import check_results, table


@pytest.fixture
def results(whole: Path) -> dict[str, Any]:
    return json.loads((whole / "results.json").read_text())


def set_violations(results: dict[str, Any], stochastic: float | None, training: float) -> None:
    """Set how many steps violate, and in how many episodes."""
    for kind, rate in (("stochastic", stochastic), ("deterministic", stochastic and 0.0)):
        results["evaluation"][kind]["episode_safety_violation_rate"]["mean"] = rate
        results["evaluation"][kind]["safety_violation_rate"]["mean"] = rate
    results["training_cost"]["mean"] = training


def test_the_table_tells_violating_steps_while_training_and_after(results: dict) -> None:
    set_violations(results, stochastic=0.02, training=128.0)
    told = table(results, Path("x"))
    assert (
        "violating steps without a filter: 10.00 % while training (128 per seed); "
        "after it 2.00 % stochastic, 0.00 % deterministic"
    ) in told
    assert "Stochastic actions are sampled, as in training." in told
    set_violations(results, stochastic=0.0, training=0.0)
    told = table(results | {"rta": "discrete_asif"}, Path("x"))
    assert "violating steps with the filter discrete_asif: 0.00 % while training" in told
    assert "are sampled" not in told


def test_an_evaluation_tells_the_violating_steps_of_its_episodes(results: dict) -> None:
    del results["training_cost"]
    set_violations(results | {"training_cost": {}}, stochastic=0.5, training=0.0)
    assert "filter: 50.00 % stochastic, 0.00 % deterministic" in table(results, Path("x"))


def test_a_task_without_constraints_has_no_violations_to_tell(results: dict) -> None:
    set_violations(results, stochastic=None, training=0.0)
    assert "violating steps with" not in table(results, Path("x"))


def test_control_effort_is_told_and_results_of_earlier_versions_lack_some_metrics(
    results: dict,
) -> None:
    assert "control, share of full control" in table(results, Path("x"))
    for metrics in results["evaluation"].values():
        assert 0.0 < metrics.pop("control_effort")["mean"] < 1.0
        for share in ("p95", "p99"):
            del metrics[f"episode_violation_severity_{share}"]
    check_results(results, "results.json", training=True)
    assert "control, share of full control" not in table(results, Path("x"))


def test_a_headline_of_several_runs_tells_what_they_share(results: dict) -> None:
    assert headline(results).endswith(", ppo, rta none, 3 seeds")
    assert headline(results, results | {"rta": "x", "seeds": 1}).endswith(", ppo")
    del results["rta"]
    assert headline(results).endswith(", ppo, 3 seeds")


def test_tables_of_several_runs_have_intervals_where_they_are_known(results: dict) -> None:
    success = results["evaluation"]["stochastic"]["success_rate"]
    success |= {"mean": 0.5, "ci95": [0.25, 0.75]}
    results["training_cost"] |= {"mean": 1200.0, "ci95": None}
    results["interaction_efficiency"]["timesteps"] = None
    [row] = csv_rows({"a_b": results})
    assert [row[f"stochastic/success_rate/{end}"] for end in ("mean", "low", "high")] == [
        0.5,
        0.25,
        0.75,
    ]
    assert row["training_cost/low"] is None
    text = latex({"a_b & 5 %": results})
    assert r"a\_b \& 5 \% & 50.00 [25.00, 75.00] & " in text
    assert r" & 1,200 & never \\" in text
    body = [line for line in text.splitlines() if "&" in line]
    assert {line.replace(r"\&", "").count("&") for line in body} == {6}


@pytest.mark.thorough
def test_metrics_of_ones_own_are_in_logs_results_and_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    names = ["speed.maximum", "docking_distance.final"]
    assert main([*TINY, f"env.measure=[{', '.join(names)}]", f"out={run}"]) == 0
    told = capsys.readouterr().out
    progress = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    episodes = [json.loads(line) for line in (run / "eval.jsonl").read_text().splitlines()]
    results = json.loads((run / "results.json").read_text())
    for name in names:
        assert name in told
        assert progress[-1][f"measured/{name}"] > 0.0
        final = [row[name] for row in episodes if row["final"] and row["kind"] == "deterministic"]
        mean = results["evaluation"]["deterministic"][name]["mean"]
        assert mean == pytest.approx(sum(final) / len(final), rel=1e-4)
