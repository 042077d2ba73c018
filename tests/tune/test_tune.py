import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_run import TINY

from jaxsafe.commands import cli
from jaxsafe.commands import tune as command
from jaxsafe.config.arguments import Arguments
from jaxsafe.schema import yaml12
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host.options import recipe
from jaxsafe.tune.batched_training import BatchedTraining
from jaxsafe.tune.results import _flat, _key
from jaxsafe.tune.settings import Span, alike, pop_sweep, settings

BASE = [word for word in TINY if not word.startswith("ppo.num_steps")]
GAMMA = recipe("docking2d", None)["ppo.gamma"]
SWEEP = [*BASE, f"sweep.ppo.gamma=[{GAMMA},0.99]", "sweep.ppo.num_steps=[16,32]"]


def options(*words: str) -> Arguments:
    swept = {word.partition("=")[0] for word in words}
    return Arguments.parse(
        [*(word for word in TINY if f"sweep.{word.partition('=')[0]}" not in swept), *words]
    )


def results(path: Path) -> dict[int, dict[str, Any]]:
    rows = [json.loads(line) for line in (path / "settings.jsonl").read_text().splitlines()]
    return {row["setting"]: row for row in rows}


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sweep") / "whole"
    assert command.main([*SWEEP, f"out={path}"]) == 0
    return path


def test_a_grid_has_every_combination() -> None:
    arguments = options(
        "sweep.ppo.gamma=[0.9,0.95,1]", "sweep.env.reward.delta_v.scale=[-0.01,-0.02]"
    )
    chosen = settings(arguments, pop_sweep(arguments), None, 0)
    assert len({tuple(setting.changes.values()) for setting in chosen}) == 6
    for setting in chosen:
        assert float(setting.config.ppo.gamma) == pytest.approx(setting.changes["ppo.gamma"])
        term = next(term for term in setting.env.reward if term.name == "delta_v")
        assert float(term.scale) == pytest.approx(setting.changes["env.reward.delta_v.scale"])  # type: ignore[attr-defined]
    assert alike(chosen, range(6)) == [list(range(6))]


@pytest.mark.thorough
def test_draws_lie_in_their_range_and_can_be_repeated() -> None:
    arguments = options("sweep.ppo.learning_rate=log(1e-4,1e-2)", "sweep.ppo.gamma=[0.9,0.99]")
    sweep = pop_sweep(arguments)
    assert sweep["ppo.learning_rate"] == Span(1e-4, 1e-2, log=True)
    first, again, other = (settings(arguments, sweep, 30, draw) for draw in (0, 0, 1))
    assert [setting.changes for setting in first] == [setting.changes for setting in again]
    assert [setting.changes for setting in first] != [setting.changes for setting in other]
    rates = np.array([setting.changes["ppo.learning_rate"] for setting in first])
    assert ((rates >= 1e-4) & (rates <= 1e-2)).all()
    # half of the rates are below, because the logarithm is uniform
    assert 6 < (rates < 1e-3).sum() < 24
    assert {setting.changes["ppo.gamma"] for setting in first} == {0.9, 0.99}


def test_settings_that_differ_in_sizes_are_compiled_apart() -> None:
    arguments = options("sweep.agent.actor.hidden=[[8],[8,8]]", "sweep.ppo.clip=[0.1,0.2]")
    chosen = settings(arguments, pop_sweep(arguments), None, 0)
    assert alike(chosen, range(4)) == [[0, 1], [2, 3]]
    assert alike(chosen, [1, 2]) == [[1], [2]]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "sweep: nothing to sweep; for instance sweep.ppo.gamma=0.95,0.97,0.99"),
        (
            ["sweep.ppo.gamma=0.9"],
            (
                "sweep.ppo.gamma: expected values a,b,…, uniform(low,high) or log(low,high),"
                " found 0.9"
            ),
        ),
        (["sweep.ppo.gamma=[]"], "sweep.ppo.gamma: expected values"),
        (
            ["sweep.ppo.gamma=log(0,1)"],
            "sweep.ppo.gamma: expected low < high, for log above 0, found 'log(0,1)'",
        ),
        (["sweep.ppo.gamma=uniform(a,b)"], "sweep.ppo.gamma: expected two numbers in the brackets"),
        (["sweep.ppo.gamma=uniform(0.9,1)"], "sweep.ppo.gamma: a range needs samples=N"),
        (["sweep.ppo.gamma=[0.9,1.5]"], "ppo.gamma: expected a number in [0, 1], found 1.5"),
        (["sweep.ppo.gama=[0.9]"], "ppo.gama: unknown option 'gama'"),
        (
            ["sweep.seeds=[1,2]"],
            "sweep.seeds: must be the same in all settings; give seeds=… instead",
        ),
        (
            ["sweep.agent.actor.hidden=[[8]]"],
            "sweep.agent.actor.hidden: agent.actor.hidden is given as well; leave one out",
        ),
        (
            ["sweep.ppo.clip=[0.1]", "rank=speed"],
            "rank: unknown order 'speed'; choose from steps, success, deterministic",
        ),
        (["sweep.ppo.clip=[0.1]", "samples=0"], "samples: expected a whole number ≥ 1, found 0"),
        (
            ["sweep.env=[docking2d,docking3d]"],
            "sweep.env: must be the same in all settings; give env=… instead",
        ),
        (["resume=nowhere"], "resume: no sweep in 'nowhere'"),
    ],
)
def test_what_cannot_be_swept_is_said_in_one_line(words: list[str], message: str) -> None:
    given = words if any(word.startswith("resume") for word in words) else [*TINY, *words]
    with pytest.raises(ConfigError) as raised:
        command.main(given)
    assert str(raised.value).startswith(message)


@pytest.mark.thorough
def test_a_setting_learns_what_the_same_training_learns(swept: Path, whole: Path) -> None:
    """The other training is that of the fixture `whole`.

    It has the same options. γ and batches of 16 steps are as in the recipe and in `TINY`.
    """
    row = next(
        row
        for row in results(swept).values()
        if (row["ppo.gamma"], row["ppo.num_steps"]) == (GAMMA, 16)
    )
    progress = [json.loads(line) for line in (whole / "progress.jsonl").read_text().splitlines()]
    for seed in range(3):
        own = [setting for setting in progress if setting["seed"] == seed]
        assert row["curve"]["steps"] == [setting["step"] for setting in own]
        np.testing.assert_allclose(
            row["curve"]["success_rate"][seed],
            [setting["success_rate"] or 0.0 for setting in own],
            atol=1e-4,
        )
        assert row["training_return"][seed] == pytest.approx(own[-1]["return"], rel=1e-4)
    assert (
        row["interaction_efficiency"]
        == json.loads((whole / "results.json").read_text())["interaction_efficiency"]
    )
    evaluation = json.loads((whole / "results.json").read_text())["evaluation"]
    for kind, metrics in evaluation.items():
        for name, metric in metrics.items():
            chosen, expected = (
                np.array(values, float)
                for values in (row["evaluation"][kind][name], metric["per_seed"])
            )
            np.testing.assert_allclose(chosen, expected, rtol=1e-4, err_msg=name)
    other = next(
        row
        for row in results(swept).values()
        if (row["ppo.gamma"], row["ppo.num_steps"]) == (0.99, 16)
    )
    assert other["training_return"] != row["training_return"]


@pytest.mark.thorough
def test_the_table_ranks_every_setting(swept: Path) -> None:
    rows = list(csv.DictReader((swept / "results.csv").read_text().splitlines()))
    assert sorted(row["setting"] for row in rows) == ["0", "1", "2", "3"]
    assert {(row["ppo.gamma"], row["ppo.num_steps"]) for row in rows} == {
        (g, n) for g in (str(GAMMA), "0.99") for n in ("16", "32")
    }
    assert (swept / "curves.png").stat().st_size > 10_000
    ranked = json.loads((swept / "results.json").read_text())["settings"]
    assert [str(row["setting"]) for row in ranked] == [row["setting"] for row in rows]


@pytest.mark.parametrize(
    ("rank", "order"), [("steps", [2, 0, 1]), ("success", [1, 0, 2]), ("deterministic", [0, 2, 1])]
)
def test_each_rank_has_its_best_first(rank: str, order: list[int]) -> None:
    def row(steps: int | None, success: float, deterministic: float) -> dict[str, Any]:
        chosen = {
            "stochastic": {"success_rate": [success]},
            "deterministic": {"success_rate": [deterministic]},
        }
        curve = {"success_rate": [[0.5]]}
        return {
            "interaction_efficiency": {"timesteps": steps},
            "evaluation": chosen,
            "curve": curve,
        }

    rows = [row(200, 0.8, 1.0), row(None, 0.9, 0.7), row(100, 0.7, 0.9)]
    assert sorted(range(3), key=lambda index: _key(rows[index], rank)) == order


@pytest.mark.thorough
def test_the_table_leaves_out_violations_that_were_not_counted(swept: Path) -> None:
    row = results(swept)[0]
    assert "violating" in _flat(row, ())
    unmeasured = {"episode_safety_violation_rate": [None] * 3}
    evaluation = {kind: metrics | unmeasured for kind, metrics in row["evaluation"].items()}
    assert "violating" not in _flat(row | {"evaluation": evaluation}, ())


def test_a_group_of_one_trains_once() -> None:
    arguments = options("sweep.agent.actor.hidden=[[8],[8,8]]")
    chosen = settings(arguments, pop_sweep(arguments), None, 0)
    assert BatchedTraining(chosen[0], 1).at_once == 1


@pytest.mark.thorough
def test_a_sweep_does_not_go_on_by_another_recipe(swept: Path, tmp_path: Path) -> None:
    path = tmp_path / "older"
    shutil.copytree(swept, path)
    content = yaml12.read(path / "sweep.yaml")
    content["first"]["training"]["ppo"]["clip"] = 0.37
    (path / "sweep.yaml").write_text(yaml12.write(content))
    with pytest.raises(
        ConfigError, match=f"resume: the recipe or the environment of {path} has changed"
    ):
        command.main([f"resume={path}"])


@pytest.mark.thorough
def test_a_killed_sweep_goes_on_and_ends_the_same(swept: Path, tmp_path: Path) -> None:
    path = tmp_path / "killed"
    path.mkdir()
    (path / "sweep.yaml").write_text((swept / "sweep.yaml").read_text())
    lines = (swept / "settings.jsonl").read_text().splitlines(keepends=True)
    (path / "settings.jsonl").write_text(lines[0] + lines[1][:40])
    assert command.main([f"resume={path}"]) == 0
    assert results(path) == results(swept)
    assert (path / "results.csv").read_text() == (swept / "results.csv").read_text()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("sweep.yaml", "{}", "sweep.yaml: request: expected a mapping, found nothing"),
        ("sweep.yaml", "null", "sweep.yaml: expected a mapping, found None"),
        ("sweep.yaml", "[]", r"sweep.yaml: expected a mapping, found \[\]"),
        (
            "sweep.yaml",
            "{request: {1: 2}, first: {}}",
            "sweep.yaml: request: expected text, found 1",
        ),
        (
            "settings.jsonl",
            '{"setting": 0}',
            "row 1: interaction_efficiency: expected a mapping, found nothing",
        ),
        (
            "settings.jsonl",
            '{"setting": "0"}',
            "line 1: not a row of this log: setting: expected a whole number",
        ),
        (
            "settings.jsonl",
            '{"setting": 4}',
            "row 1: setting: expected one of the 4 settings, each once, found 4",
        ),
        (
            "settings.jsonl",
            ("ppo.gamma", 0.5),
            r"row 1: ppo\.gamma: expected 0\..* in setting 0, found 0\.5",
        ),
        (
            "settings.jsonl",
            ("training_success", [1, 2, 3]),
            "training_success: expected a list of length 3, each a number",
        ),
        (
            "settings.jsonl",
            ("curve", {"steps": []}),
            "curve.steps: expected a list of length 20, each a whole number",
        ),
    ],
)
def test_broken_files_of_a_sweep_are_told(
    swept: Path, tmp_path: Path, name: str, text: Any, message: str
) -> None:
    path = tmp_path / "sweep"
    path.mkdir()
    for file in ("sweep.yaml", "settings.jsonl"):
        shutil.copy(swept / file, path)
    if not isinstance(text, str):
        text = json.dumps(results(swept)[0] | dict([text]))
    (path / name).write_text(f"{text}\n")
    with pytest.raises(ConfigError, match=message):
        command.main([f"resume={path}"])


def test_an_interrupted_sweep_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxsafe.tune.batched_training.train_all", interrupted)
    assert command.main([*SWEEP, f"out={tmp_path / 'sweep'}"]) == cli.INTERRUPTED
    said = capsys.readouterr().out.splitlines()[-1]
    assert said == (
        f"stopped with 0 of 4 settings; go on with: jaxsafe tune resume={tmp_path / 'sweep'}"
    )


def test_the_settings_of_a_sweep_may_be_like_a_run(whole: Path) -> None:
    arguments = Arguments({"like": str(whole), "ppo.num_envs": 8})
    found = settings(arguments, {"ppo.gamma": [0.5, 0.75]}, None, 0)
    assert [float(setting.config.ppo.gamma) for setting in found] == [0.5, 0.75]
    assert {(setting.config.ppo.num_envs, setting.config.steps) for setting in found} == {(8, 1280)}
