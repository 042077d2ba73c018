"""The tables in the pages are those of the results in the repository."""

import importlib
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
from submission_files import write_policies, write_run

from jaxsafe.envs import TASKS, make
from jaxsafe.runs.protocol import TRAINING, findings, read_submission
from jaxsafe.schema.errors import ConfigError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import tables  # pyright: ignore[reportMissingImports]

    return tables


def test_the_tables_of_the_pages_are_current(tables: ModuleType) -> None:
    stale = [
        str(page)
        for page, text in tables.pages().items()
        if text != page.read_text(encoding="utf-8")
    ]
    assert stale == [], "run benchmarks/tables.py"


def test_the_sizes_of_the_tasks_in_the_readme_are_those_of_the_environments(
    tables: ModuleType,
) -> None:
    assert list(tables.FACTS) == list(TASKS)
    for task, facts in tables.FACTS.items():
        env = make(task)
        assert (facts.observation, facts.actions) == (env.observation_size, env.action_size), task


def test_another_result_makes_another_table(tables: ModuleType) -> None:
    rows = [
        {
            "task": "docking2d",
            "num_envs": 64,
            "lane": 200,
            "seed": 2048,
            "predicted": 2**20,
            "measured": 3 * 2**20,
        }
    ]
    assert tables.memory({"num_steps": 32, "runs": rows}).splitlines() == [
        "| predicted / measured | an environment | a seed without them | 64 × 32 |",
        "|---|---|---|---|",
        "| docking2d | 200 B | 2 KiB | 1 / 3 |",
    ]


def test_a_page_without_the_table_is_named(
    tables: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        tables, "TABLES", [("memory", lambda _: "| a | b |\n|---|---|", "docs/scaling.md")]
    )
    with pytest.raises(
        ValueError,
        match=r"docs/scaling.md: found 0 tables that begin with \| a \| b \|; expected one",
    ):
        tables.pages()


def test_submissions_have_rows_after_our_own(
    tables: ModuleType, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    submitted = tmp_path / "submitted"
    monkeypatch.setattr(tables, "SUBMITTED", submitted)
    before = tables.reported({}).splitlines()
    write_run(whole, submitted / "me-docking2d")
    write_policies(whole, submitted / "others-docking2d")
    training = submitted / "others-docking2d" / TRAINING
    violating = [2_000] * 10
    content = {"algorithm": "SAC", "steps": 1_000_000, "violating_steps": violating}
    training.write_text(json.dumps(content))
    rows = tables.reported({}).splitlines()
    new = [row for row in rows if row not in before]
    results = json.loads((submitted / "me-docking2d" / "results.json").read_text())
    success = [
        f"{100 * results['evaluation'][kind]['success_rate']['mean']:.2f}"
        for kind in ("stochastic", "deterministic")
    ]
    cost = results["training_cost"]["mean"]
    assert new == [
        f"| docking2d | me | 10 | never | {success[0]} / {success[1]} | {cost:,.0f} "
        "| [me-docking2d](submitted/me-docking2d/results.json) |",
        f"| docking2d | others | 10 | – | – / {success[1]} | 2,000 "
        "| [others-docking2d](submitted/others-docking2d/0/results.json) |",
    ]
    own = next(index for index, row in enumerate(rows) if "docking2d-rta" in row)
    assert rows[own + 1 : own + 3] == new
    assert [row for row in rows if row not in new] == before


def test_a_submission_that_lacks_something_is_refused(
    tables: ModuleType, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "SUBMITTED", tmp_path)
    write_policies(whole, tmp_path / "me-docking2d")
    with pytest.raises(ConfigError, match="me-docking2d: lacks steps and violating steps of the"):
        tables.reported({})
    (tmp_path / "me-docking2d").rename(tmp_path / "me-docking3d")
    with pytest.raises(ConfigError, match=r"expected a directory NAME-TASK .* those of docking2d"):
        tables.reported({})


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("kind", ["engineered_features", "rta"])
def test_our_own_rows_lack_only_what_the_page_says(task: str, kind: str) -> None:
    submission = read_submission(str(ROOT / "docs" / "baselines" / f"{task}-{kind}.json"))
    assert submission.task == task
    found = {finding.what: finding for finding in findings(submission)}
    lacking = {what for what, finding in found.items() if not finding.reported}
    expected = {"the fixed starts of the task"}
    if not (task.startswith("rejoin") and kind == "rta"):
        expected |= {"the tail of the severity of violations", "with and without a filter"}
        filtered = found["with and without a filter"]
        assert "lacks the tail of the severity of violations; " in filtered.detail
    if (task, kind) == ("docking2d_oriented", "rta"):
        expected.add("the task as it is")
        assert "with other deputy.start.velocity.share" in found["the task as it is"].detail
    assert lacking == expected


@pytest.mark.parametrize(
    ("values", "goal", "most", "text"),
    [
        ([3.0, 5.0], 4.0, False, "**3.0** to 5.0"),
        ([3.0, 5.0], 2.0, False, "3.0 to 5.0"),
        ([0.5], 0.4, True, "**0.50**"),
        ([0.3], 0.4, True, "0.30"),
        ([12345.0], 20_000, False, "**12,345**"),
    ],
)
def test_a_missed_goal_is_bold(
    tables: ModuleType, values: list[float], goal: float, most: bool, text: str
) -> None:
    assert tables._reached(values, goal, most) == text


def test_a_rounded_value_never_looks_as_if_it_reached_the_goal(tables: ModuleType) -> None:
    assert tables._reached([1.596], 1.6) == "**1.596**"
    assert tables._reached([2.96], 3.0) == "**2.96**"


@pytest.fixture
def accelerator(tables: ModuleType) -> ModuleType:
    del tables  # the fixture puts the benchmarks on the path
    return importlib.import_module("accelerator")


@pytest.mark.thorough
def test_the_accelerator_script_measures_and_says_what_it_skips(
    accelerator: ModuleType, tables: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "accelerator.json"
    words = [
        "minutes=3",
        "parts=environments",
        "tasks=docking2d",
        "sizes=1,8",
        "repeats=1",
        f"out={out}",
    ]
    monkeypatch.setattr(sys, "argv", ["accelerator.py", *words])
    accelerator.main()
    content = json.loads(out.read_text())
    environments = content["parts"]["environments"]
    measured = {
        row["environments"]: row["steps_per_s"]
        for row in environments["rows"]
        if row["task"] == "docking2d"
    }
    assert set(measured) == {1, 8}
    assert all(rate > 0 for rate in measured.values())
    assert all("Pendulum" in reason for reason in environments["skipped"])
    assert any(
        line.startswith("| docking2d |")
        for line in tables.accelerator_environments(content).splitlines()
    )


def test_what_the_accelerator_script_has_no_time_for_is_named(
    accelerator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "accelerator.json"
    monkeypatch.setattr(accelerator, "GRACE", 0.0)
    monkeypatch.setattr(
        sys, "argv", ["accelerator.py", "minutes=0", "parts=learning", f"out={out}"]
    )
    accelerator.main()
    assert json.loads(out.read_text())["parts"]["learning"] == {
        "seconds": pytest.approx(0.0, abs=30.0),
        "rows": [],
        "skipped": ["learning: the rest, out of time"],
    }


def test_the_tests_of_the_accelerator_script_are_there(accelerator: ModuleType) -> None:
    for test in accelerator.TESTS:
        file, _, name = test.partition("::")
        text = (ROOT / file).read_text(encoding="utf-8")
        assert not name or re.search(rf"^def {name}\(", text, re.M), test
