import copy
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from default_cases import thorough
from orbax.checkpoint import CheckpointManager
from tiny_run import TINY, assert_same_end, final_state, logs

from jaxsafe.agents.policy_file import load_policy, read_policy
from jaxsafe.commands import cli
from jaxsafe.commands import config as config_command
from jaxsafe.commands import evaluate as evaluate
from jaxsafe.commands import train as command
from jaxsafe.devices import processes
from jaxsafe.envs import TASKS
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import write_rows
from jaxsafe.train.host import checkpoint, restore, run_directory
from jaxsafe.train.host.checkpoint import Checkpoints
from jaxsafe.train.host.options import recipe, resolve
from jaxsafe.train.host.session import Clock, Training
from jaxsafe.train.ppo import DIAGNOSTICS
from jaxsafe.types import Record


@pytest.fixture(autouse=True)
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the figures of a run, which take half of its time. `whole` has them."""
    monkeypatch.setattr("jaxsafe.runs.figures.draw_all", lambda run: [])


def test_a_run_directory_holds_everything(whole: Path) -> None:
    names = {path.name for path in whole.iterdir()}
    assert names == {
        "config.yaml",
        "progress.jsonl",
        "progress.csv",
        "eval.jsonl",
        "episodes.jsonl",
        "checkpoints",
        "policy",
        "figures",
        "results.json",
    }
    assert {path.name for path in (whole / "policy").iterdir()} == {
        "seed_0.npz",
        "seed_1.npz",
        "seed_2.npz",
    }
    assert {path.name for path in (whole / "figures").iterdir()} == {
        "training_steps.png",
        "learning_steps.png",
        "trajectories.png",
        "speed_distance.png",
    }


def test_progress_has_a_row_for_every_update_of_every_seed(whole: Path) -> None:
    rows = logs(whole)["progress.jsonl"]
    assert [(row["step"], row["seed"]) for row in rows] == [
        (64 * (u + 1), seed) for u in range(20) for seed in range(3)
    ]
    last = rows[-1]
    outcomes = ("success", "crash", "distance", "timeout", "velocity")
    assert sum(last[f"outcome/{name}"] for name in outcomes) == pytest.approx(1.0, abs=1e-5)
    assert 0.0 < last["control_effort"] < 1.0
    terms = ("distance_change", "velocity_constraint", "delta_v", "success", "failure")
    assert sum(last[f"reward/{name}"] for name in terms) == pytest.approx(last["return"], abs=1e-4)
    for row in rows:  # what is learnt is known before an episode has ended
        learnt = {name: row[name] for name in DIAGNOSTICS if name != "cost_value_loss"}
        assert all(np.isfinite(value) for value in learnt.values())
    assert rows[0]["learning_rate"] > last["learning_rate"] > 0.0
    assert rows[0]["gamma"] < last["gamma"] < 1.0
    csv = (whole / "progress.csv").read_text().splitlines()
    assert len(csv) == len(rows) + 1
    assert csv[0].startswith("seed,step,wall_s")


def test_every_column_of_the_progress_log_is_explained(whole: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "logs.md").read_text(encoding="utf-8")
    columns = {*logs(whole)["progress.jsonl"][0], "wall_s", "multiplier", *DIAGNOSTICS}
    general = {re.sub("/.*", "/NAME", name) for name in columns}
    assert {name for name in general if f"`{name}`" not in page} == set()


def test_results_follow_the_schema(whole: Path) -> None:
    results = json.loads((whole / "results.json").read_text())
    assert (results["algorithm"], results["rta"]) == ("ppo", "none")
    assert {
        "env",
        "preset",
        "seeds",
        "steps",
        "wall_s",
        "compile_s",
        "versions",
        "interaction_efficiency",
    } < set(results)
    assert results["compile_s"] < results["training_computation_time"] < results["wall_s"]
    assert set(results["interaction_efficiency"]) == {"timesteps", "per_seed"}
    for kind in ("stochastic", "deterministic"):
        for metric in results["evaluation"][kind].values():
            assert set(metric) == {"mean", "ci95", "iqm", "per_seed"}
            assert len(metric["per_seed"]) == 3
    rows = [
        row for row in logs(whole)["eval.jsonl"] if row["final"] and row["kind"] == "stochastic"
    ]
    assert len(rows) == 3 * 6
    mean = results["evaluation"]["stochastic"]["average_return"]["mean"]
    assert mean == pytest.approx(np.mean([row["return"] for row in rows]), rel=1e-4)


def test_logged_episodes_hold_states_controls_statuses_and_rewards(whole: Path) -> None:
    rows = logs(whole)["episodes.jsonl"]
    # Episodes are logged in early learning and then at each evaluation.
    assert {row["step"] for row in rows} == {
        0,
        64,
        128,
        256,
        320,
        640,
        960,
        1280,
    }
    episode = [row for row in rows if row["step"] == 640]
    assert [row["t"] for row in episode] == list(range(len(episode)))
    assert [row["outcome"] for row in episode[:-1]] == ["running"] * (len(episode) - 1)
    assert episode[-1]["outcome"] != "running"
    assert set(episode[0]["control_actual"]) == {"thrust_x", "thrust_y"}
    assert sum(episode[3]["reward_terms"].values()) == pytest.approx(episode[3]["reward"], abs=1e-5)


class _CrashError(Exception):
    pass


def _crash_at(
    monkeypatch: pytest.MonkeyPatch, owner: type, name: str, call: int, after: bool
) -> None:
    original: Callable[..., Any] = getattr(owner, name)
    calls = iter(range(1, 1000))

    def crashing(*args: Any, **kwargs: Any) -> Any:
        last = next(calls) == call
        if last and not after:
            raise _CrashError
        result = original(*args, **kwargs)
        if last:
            raise _CrashError
        return result

    monkeypatch.setattr(owner, name, crashing)


@pytest.mark.parametrize(
    ("name", "call", "after"),
    [
        thorough("_record", 1, True),  # records the untrained policy
        thorough("_record", 3, True),
        thorough("_write_progress", 3, True),  # before any checkpoint
        ("_write_progress", 7, True),  # rows that the checkpoint does not know
        thorough("_evaluate", 2, True),
        thorough("_save", 2, False),  # everything written but the checkpoint
        thorough("_save", 4, True),  # trained, not yet evaluated
        thorough("_run_episodes", 6, True),  # in the middle of the last evaluation
    ],
)
def test_a_crashed_run_resumes_to_the_same_end(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch, name: str, call: int, after: bool
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        _crash_at(patch, Training, name, call, after)
        with pytest.raises(_CrashError):
            command.main([*TINY, f"out={run}"])
    assert command.main([f"resume={run}"]) == 0
    assert_same_end(run, whole)


def test_the_first_evaluation_measures_the_policies_before_training_too(whole: Path) -> None:
    rows = [row for row in logs(whole)["eval.jsonl"] if not row["final"]]
    assert list(dict.fromkeys(row["step"] for row in rows)) == [0, 320, 640, 960, 1280]
    assert [row["episode_cost/velocity_limit"] for row in rows] == [
        row["violating_steps"] for row in rows
    ]
    # The episode of step 0 that is logged step by step is one of them.
    [first] = [row for row in rows if (row["step"], row["seed"], row["episode"]) == (0, 0, 0)]
    logged = [row for row in logs(whole)["episodes.jsonl"] if row["step"] == 0]
    assert len(logged) == first["length"] + 1
    assert sum(row["reward"] for row in logged[1:]) == pytest.approx(first["return"], abs=1e-3)


@pytest.mark.thorough
def test_a_crash_after_the_first_evaluation_does_not_repeat_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    often = [word for word in TINY if "checkpoint_every" not in word]
    with monkeypatch.context() as patch:
        _crash_at(patch, Training, "_evaluate", 1, True)
        with pytest.raises(_CrashError):
            command.main([*often, "checkpoint_every=128", f"out={run}"])
    assert command.main([f"resume={run}"]) == 0
    rows = logs(run)["eval.jsonl"]
    assert len([row for row in rows if row["step"] == 0]) == 3 * 4


@pytest.mark.thorough
@pytest.mark.parametrize("when", ["before", thorough("after")])
def test_a_kill_while_the_last_checkpoint_is_written_anew_loses_nothing(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        _crash_at(patch, CheckpointManager, "save", call=5, after=when == "after")
        with pytest.raises(_CrashError):
            command.main([*TINY, f"out={run}"])
    assert (run / "checkpoints" / "1280.before").exists()
    assert (run / "checkpoints" / "1280").exists() == (when == "after")
    with monkeypatch.context() as patch:
        patch.setattr(
            Training,
            "train",
            lambda self, progress: self.step == 1280 or pytest.fail(f"went back to {self.step}"),
        )
        assert command.main([f"resume={run}"]) == 0
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == [
        "1280",
        "320",
        "640",
        "960",
    ]
    assert_same_end(run, whole)


@pytest.mark.thorough
def test_a_run_has_one_command_at_work_on_it(tmp_path: Path, whole: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    (run / "results.json").unlink()
    with (
        processes.own_files(run),
        pytest.raises(
            ConfigError,
            match=f"^{run}: another command is at work on this run; wait for its end, or stop it$",
        ),
    ):
        command.main([f"resume={run}"])
    assert command.main([f"resume={run}"]) == 0


@pytest.mark.thorough
def test_a_refused_training_leaves_its_directory_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise ConfigError("ppo.num_envs: this training needs 9 GiB")

    with monkeypatch.context() as patch:
        patch.setattr("jaxsafe.devices.memory.require", refused)
        with pytest.raises(ConfigError, match="needs 9 GiB"):
            command.main([*TINY, f"out={tmp_path / 'run'}"])
    assert not (tmp_path / "run").exists()
    assert command.main([*TINY, f"out={tmp_path / 'run'}"]) == 0


@pytest.mark.thorough
@pytest.mark.parametrize("step", [448, thorough(1280)])  # the second with nothing is left to train
def test_ctrl_c_stops_after_a_chunk_with_a_checkpoint_and_resumes(
    tmp_path: Path,
    whole: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    step: int,
) -> None:
    run = tmp_path / "run"
    original = Training._write_progress

    def interrupt(self: Training, *args: Any) -> None:
        original(self, *args)
        if self.step == step:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Training, "_write_progress", interrupt)
        assert command.main([*TINY, f"out={run}"]) == cli.INTERRUPTED
    assert (
        f"stopped at step {step:,}; go on with: jaxsafe train resume={run}"
        in capsys.readouterr().out
    )
    assert command.main([f"resume={run}"]) == 0
    assert_same_end(run, whole)


def _two_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let docking2d and a twin of it be all tasks, so that both run the program of `whole`."""
    two = {"docking2d": TASKS["docking2d"], "twin": TASKS["docking2d"]}
    for module in (
        "jaxsafe.envs",
        "jaxsafe.envs.task",
        "jaxsafe.train.host.options",
        "jaxsafe.train.host.run_directory",
    ):
        monkeypatch.setattr(f"{module}.TASKS", two)


@pytest.mark.thorough
def test_all_tasks_run_one_after_another_and_resume(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _two_tasks(monkeypatch)
    path = tmp_path / "all"
    words = [word for word in TINY if not word.startswith("env=")]
    given = {word.partition("=")[0] for word in words} | {"preset"}
    same = [
        f"{key}={value}" for key, value in recipe("docking2d", None).items() if key not in given
    ]
    original = Training._write_progress

    def interrupt(self: Training, *args: Any) -> None:
        original(self, *args)
        if self.run.name == "twin" and self.step == 448:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Training, "_write_progress", interrupt)
        assert command.main(["env=all", *words, *same, f"out={path}"]) == cli.INTERRUPTED
    assert f"go on with: jaxsafe train resume={path}" in capsys.readouterr().out
    # All tasks are trained before the first is evaluated.
    assert not list(path.rglob("results.json"))
    with monkeypatch.context() as patch:
        _crash_at(patch, Training, "evaluate_finally", call=2, after=False)
        with pytest.raises(_CrashError):
            command.main([f"resume={path}"])
    capsys.readouterr()
    assert command.main([f"resume={path}"]) == 0
    said = capsys.readouterr().out
    assert f"{path / 'docking2d'} is complete" in said
    last = [line.split() for line in said.splitlines()[-2:]]
    assert [line[:2] for line in last] == [["docking2d", "1,280"], ["twin", "1,280"]]
    for name in ("docking2d", "twin"):
        assert logs(path / name) == logs(whole)


def test_the_clocks_of_runs_that_take_turns_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter(range(0, 1000, 10))
    monkeypatch.setattr(time, "monotonic", lambda: next(now))
    first = Clock(spent=3.0)
    other = Clock()
    with first:  # from 0 to 10
        pass
    with other:  # from 20
        assert first.seconds == 13.0
        assert other.seconds == 10.0  # asked at 30, and running to 40
    with first:  # from 50 to 60
        pass
    assert (first.seconds, other.seconds) == (23.0, 20.0)


def test_options_that_do_not_fit_all_tasks_are_told_with_the_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        ConfigError, match=r"^env=all: rejoin2d: env.deputy: unknown field 'deputy'"
    ):
        command.main(["env=all", "env.deputy.mass=14"])
    assert not list(tmp_path.iterdir())


def test_resuming_a_complete_run_changes_nothing(
    whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in whole.rglob("*")}
    assert command.main([f"resume={whole}"]) == 0
    assert "is complete" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in whole.rglob("*")} == before


@pytest.mark.thorough
def test_runs_without_a_name_take_the_next_free_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "docking2d").mkdir(parents=True)
    assert command.main(TINY) == 0
    assert (tmp_path / "runs" / "docking2d-2" / "results.json").exists()


@pytest.mark.thorough
def test_evaluation_only_at_the_end_finds_what_evaluation_on_the_way_does(
    tmp_path: Path, whole: Path
) -> None:
    run = tmp_path / "run"
    assert (
        command.main(
            [
                *(word for word in TINY if "eval_every" not in word),
                "eval_every=1000000",
                f"out={run}",
            ]
        )
        == 0
    )
    for name in ("eval.jsonl", "episodes.jsonl"):
        assert logs(run)[name] == [row for row in logs(whole)[name] if row["step"] == 1280]


def test_a_policy_file_acts_like_the_trained_network(whole: Path) -> None:
    env, agent, params, about = read_policy(whole / "policy" / "seed_1.npz")
    trained = jax.tree.map(lambda x: x[1], final_state(whole)["state"].params)
    jax.tree.map(np.testing.assert_array_equal, params, trained)
    _, timestep = env.reset(jax.random.key(0))
    action = load_policy(whole / "policy" / "seed_1.npz")(jax.random.key(1), timestep.observation)
    expected, _ = agent.act(env, trained, jax.random.key(1), timestep.observation, True)
    # The two are not compiled as one program.
    np.testing.assert_allclose(action, expected, rtol=1e-6)
    assert about == {"env": "docking2d", "preset": "engineered_features", "seed": 1, "step": 1280}


@pytest.mark.slow
def test_twenty_kills_at_random_moments_change_nothing(tmp_path: Path) -> None:
    """Kill runs twenty times at random moments and resume each until it ends.

    Each must equal a run that was left alone.
    """
    longer = [
        *(word.replace("=320", "=4000") for word in TINY if not word.startswith("steps")),
        "steps=40000",
    ]
    call = [sys.executable, "-m", "jaxsafe.train"]
    whole = tmp_path / "whole"
    rng = random.Random(0)
    # The second run finds its programs compiled, as the runs to be killed will.
    for out in (
        tmp_path / "first",
        whole,
    ):
        begin = time.monotonic()
        subprocess.run([*call, *longer, f"out={out}"], check=True, capture_output=True)
        usual = time.monotonic() - begin
    assert_same_end(tmp_path / "first", whole)
    kills = ended = 0
    while kills < 20 or not ended:
        run = tmp_path / f"run-{ended}"
        arguments = [f"resume={run}"] if (run / "config.yaml").exists() else [*longer, f"out={run}"]
        process = subprocess.Popen(
            [*call, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            process.wait(timeout=rng.uniform(0.1, 0.9) * usual if kills < 20 else None)
        except subprocess.TimeoutExpired:
            process.send_signal(rng.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGINT]))
            process.wait()
            kills += 1
        if (run / "figures").exists():
            assert_same_end(run, whole)
            ended += 1


@pytest.mark.slow
@pytest.mark.parametrize("task", ["docking2d", "docking3d"])
def test_the_default_recipe_learns_to_dock(tmp_path: Path, task: str) -> None:
    assert (
        command.main(
            [f"env={task}", "seeds=2", "seed=2000", "episodes=200", f"out={tmp_path / 'run'}"]
        )
        == 0
    )
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    for kind in ("stochastic", "deterministic"):
        assert min(results["evaluation"][kind]["success_rate"]["per_seed"]) > 0.9


def test_a_recipe_travels_with_the_file_of_an_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    config_command.main(["docking2d", "recipes=true"])
    text = capsys.readouterr().out
    Path("mine.yaml").write_text(text, encoding="utf-8")
    for preset in ({}, {"preset": "many_envs"}):
        of_file = resolve({"env": "mine.yaml", **preset})
        config, env, _ = resolve({"env": "docking2d", **preset})
        assert of_file[:2] == (config.replace(recipe="mine.yaml"), env)
    assert of_file[2] == "mine"
    given, _, _ = resolve({"env": "mine.yaml", "ppo.gamma": 0.5, "steps": 99})
    assert (float(given.ppo.gamma), given.steps) == (0.5, 99)
    with pytest.raises(
        ConfigError, match=r"^preset: unknown preset 'x'; choose from engineered_features, "
    ):
        resolve({"env": "mine.yaml", "preset": "x"})
    environment = text.partition("recipes:")[0]
    for recipes, place in (
        (
            "{mine: {ppo: {gama: 1}}}",
            r"mine\.ppo\.gama: unknown option 'gama'\. Did you mean 'gamma'",
        ),
        ("{a: {steps: 0}, b: {}}", r"a\.steps: expected a whole number ≥ 1, found 0"),
    ):
        Path("mine.yaml").write_text(f"{environment}recipes: {recipes}\n", encoding="utf-8")
        with pytest.raises(ConfigError, match=rf"^mine\.yaml: recipes\.{place}"):
            resolve({"env": "mine.yaml"})
    assert resolve({"env": "mine.yaml", "preset": "b"})[0].preset == "b"
    Path("mine.yaml").write_text(environment, encoding="utf-8")
    assert resolve({"env": "mine.yaml"})[0].steps == 500_000


@pytest.mark.thorough
def test_nothing_is_lost_when_checkpoints_are_missing(
    tmp_path: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    shutil.rmtree(run / "checkpoints")
    for name in ("results.json", "progress.csv"):
        (run / name).unlink()
    assert command.main([f"resume={run}"]) == 0
    assert "checkpoints after step 0 are missing" in capsys.readouterr().out
    assert (run / "progress.jsonl.bak").read_bytes() == (whole / "progress.jsonl").read_bytes()
    assert len((run / "progress.csv").read_text().splitlines()) == len(
        (whole / "progress.csv").read_text().splitlines()
    )
    assert_same_end(run, whole)


@pytest.mark.thorough
def test_a_damaged_progress_log_is_told_before_anything_is_done(
    tmp_path: Path, whole: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    (run / "results.json").unlink()
    (run / "progress.jsonl").unlink()
    with pytest.raises(
        ConfigError, match=r"progress\.jsonl: expected 60 rows up to step 1280, found 0"
    ):
        command.main([f"resume={run}"])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("value", "message"),
    [
        ('"many"', "not a row of this log: episodes: expected"),
        ("[1, 2]", "not a row of this log: episodes: expected"),
        ("[" * 40 + "]" * 40, "not a line of JSON"),
        ("[" * 10**5 + "]" * 10**5, "not a line of JSON"),
    ],
    ids=["text", "list", "nested", "deeply nested"],
)
def test_a_run_does_not_go_on_from_a_row_of_another_form(
    tmp_path: Path, whole: Path, value: str, message: str
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    (run / "results.json").unlink()
    log = run / "progress.jsonl"
    first, second, *others = log.read_text().splitlines(keepends=True)
    second = re.sub(r'"episodes": \d+', f'"episodes": {value}', second)
    log.write_text("".join([first, second, *others]))
    with pytest.raises(ConfigError, match=rf"progress\.jsonl, line 2: {message}"):
        command.main([f"resume={run}"])


@pytest.mark.thorough
def test_a_run_that_an_older_version_began_does_not_go_on(tmp_path: Path, whole: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    (run / "results.json").unlink()
    shutil.rmtree(run / "checkpoints" / "1280")
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    older = [{k: v for k, v in row.items() if k not in DIAGNOSTICS} for row in rows]
    write_rows(run / "progress.jsonl", older)
    with pytest.raises(
        ConfigError,
        match=r"progress\.jsonl: another version of jaxsafe began it; columns differ in"
        r" action_std, approx_kl, .*; begin a new run$",
    ):
        command.main([f"resume={run}"])


@pytest.mark.thorough
def test_a_log_that_lost_its_end_is_gone_back_to_the_checkpoint_that_it_covers(
    tmp_path: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    (run / "results.json").unlink()
    lines = (run / "progress.jsonl").read_text().splitlines(keepends=True)
    # The log goes up to step 960, with 15 whole updates of 3 seeds.
    (run / "progress.jsonl").write_text("".join(lines[:47]) + lines[47][:9])
    assert command.main([f"resume={run}"]) == 0
    assert (
        "progress.jsonl ends before the checkpoint of step 1,280: going on from 960"
        in capsys.readouterr().out
    )
    assert_same_end(run, whole)


def flip(file: Path, place: float, bit: int) -> None:
    content = bytearray(file.read_bytes())
    content[int(place * len(content))] ^= 1 << bit
    file.write_bytes(content)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(3))
def test_a_flipped_bit_in_a_checkpoint_is_told_or_changes_nothing(
    tmp_path: Path, whole: Path, seed: int
) -> None:
    draw = random.Random(seed)
    expected = final_state(whole)
    refused = 0
    for number in range(4):
        run = tmp_path / str(number)
        shutil.copytree(whole / "checkpoints" / "1280", run / "checkpoints" / "1280")
        shutil.copy(whole / "config.yaml", run)
        data = sorted((run / "checkpoints").rglob("d/*"), key=lambda file: -file.stat().st_size)[:2]
        flip(
            [*data, run / "checkpoints" / "1280" / "facts" / "metadata"][number % 3],
            draw.random(),
            draw.randrange(8),
        )
        try:
            state = final_state(run)
        except ConfigError:
            refused += 1
        else:
            jax.tree.map(np.testing.assert_array_equal, state, expected)
    assert refused


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "seeds: 3",
            "seeds: 5",
            r"config\.yaml: training\.seeds: found 5, but the checkpoints were made with 3; put",
        ),
        ("seed: 0", "seed: 1", r"config\.yaml: training\.seed: found 1, but .* made with 0"),
        ("gamma: 0.", "gamma: 0.1", r"config\.yaml: training\.ppo\.gamma: found 0\.1"),
        ("dt: 1.0", "dt: 2.0", r"config\.yaml: environment\.dt: found 2\.0, but .* made with 1\.0"),
        (
            "hidden: [8]",
            "hidden: [9]",
            r"config\.yaml: training\.agent\.actor\.hidden\.\[0\]: found 9",
        ),
    ],
)
def test_a_checkpoint_is_tied_to_the_configuration_that_made_it(
    tmp_path: Path, whole: Path, old: str, new: str, message: str
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    (run / "results.json").unlink()
    text = (run / "config.yaml").read_text()
    assert old in text
    (run / "config.yaml").write_text(text.replace(old, new))
    for main, option in ((command.main, "resume"), (evaluate.main, "run")):
        with pytest.raises(ConfigError, match=message):
            main([f"{option}={run}"])


def test_a_run_may_go_on_for_longer_and_look_at_itself_more_often(
    tmp_path: Path, whole: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(
        text.replace("steps: 1280", "steps: 1500").replace("eval_every: 320", "eval_every: 64")
    )
    jax.tree.map(np.testing.assert_array_equal, final_state(run), final_state(whole))


def test_a_field_that_is_newer_than_a_checkpoint_has_its_default_in_it(whole: Path) -> None:
    config, env, _ = run_directory.read(whole, "run")
    now = restore.made_from(env, config)
    before = copy.deepcopy(now)
    del before["environment"]["terminal"][0]["success"], before["training"]["ppo"]["gae_lambda"]
    assert restore._as_of_today(before)["environment"] == now["environment"]
    before["environment"]["dt"] = 2.0
    assert restore._as_of_today(before)["environment"]["dt"] == 2.0
    assert restore._as_of_today("x") == "x"


def without_newer(tree: Any) -> Any:
    """Return the records of a state as they were before the fields in `NEWER`."""
    if not isinstance(tree, Record):
        return tree
    kept = {
        name: without_newer(value)
        for name, value in vars(tree).items()
        if name not in restore.NEWER
    }
    return type("Older", (Record,), {"__annotations__": dict.fromkeys(kept, Any)})(**kept)


def test_a_new_run_has_no_directory_of_checkpoints_before_the_first(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, create=True)
    assert checkpoints.steps == []
    assert not checkpoints.directory.exists()
    checkpoints.save(1, {"x": np.zeros(2)}, {})
    assert checkpoints.steps == [1]


def test_a_checkpoint_from_before_the_newer_arrays_were_kept_is_read(
    tmp_path: Path, whole: Path
) -> None:
    config, env, _ = run_directory.read(whole, "run")
    like = restore.structure(env, config)
    content = jax.tree.map(lambda leaf: np.ones_like(checkpoint._empty(leaf)), like)
    checkpoints = Checkpoints(tmp_path, create=True)
    facts = {"updates": 20, "wall_s": 1.0, "compile_s": 1.0}
    checkpoints.save(1280, {**content, "state": without_newer(content["state"])}, facts)
    names = (tmp_path / "checkpoints" / "1280" / "state" / "_METADATA").read_text()
    assert not any(f"'{name}'" in names for name in restore.NEWER)
    found = Checkpoints(tmp_path).restore(1280, like, restore.NEWER)
    assert not found["state"].env_state.sim.control_desired.any()
    assert found["state"].env_state.sim.time.all()
    jax.tree.map(np.testing.assert_array_equal, found["best"], content["best"])
    # What is read can be written again.
    checkpoints.restore(1280, like, restore.NEWER)
    checkpoints.save(2560, content, facts)
    assert checkpoints.restore(2560, like)["state"].env_state.sim.control_desired.all()


def test_a_checkpoint_whose_states_kept_what_ended_is_read(tmp_path: Path, whole: Path) -> None:
    config, env, _ = run_directory.read(whole, "run")
    flags = dict.fromkeys(env.outcomes[1:], np.ones((config.seeds, config.ppo.num_envs), bool))
    like = restore.structure(env, config)
    content = jax.tree.map(lambda leaf: np.ones_like(checkpoint._empty(leaf)), like)
    older = {**content, "state": restore._with_ended(content["state"], flags)}
    checkpoints = Checkpoints(tmp_path, create=True)
    step = 20 * config.ppo.batch_size
    checkpoints.save(step, older, {"updates": 20, "wall_s": 1.0, "compile_s": 1.0})
    found, _ = restore.restore(Checkpoints(tmp_path), step, env, config)
    assert found["state"].env_state.sim.ended == {}
    for read, written in zip(
        (found["best"], found["state"].env_state),
        (content["best"], content["state"].env_state),
        strict=True,
    ):
        jax.tree.map(np.testing.assert_array_equal, read, written)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["sha256", "made_from", "updates", "wall_s", None])
def test_facts_of_a_checkpoint_are_checked_and_those_of_before_are_known(
    tmp_path: Path, whole: Path, name: str | None
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    file = run / "checkpoints" / "1280" / "facts" / "metadata"
    facts = json.loads(file.read_text())
    if name is None:  # checkpoints once had no digests
        file.write_text(json.dumps({key: facts[key] for key in ("updates", "wall_s", "compile_s")}))
        jax.tree.map(np.testing.assert_array_equal, final_state(run), final_state(whole))
        return
    for value in (None, "x", -1, [[]], 10**30):
        file.write_text(json.dumps({**facts, name: value}))
        with pytest.raises(ConfigError, match=r"checkpoint|config\.yaml"):
            final_state(run)
    file.write_text(json.dumps([facts]))
    with pytest.raises(ConfigError, match="facts: expected a mapping"):
        final_state(run)


@pytest.mark.thorough
def test_a_corrupt_checkpoint_leaves_one_line_on_standard_error(
    tmp_path: Path, whole: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    (run / "results.json").unlink()
    for manifest in (run / "checkpoints" / "1280").rglob("manifest.ocdbt"):
        manifest.write_bytes(b"")
    call = [sys.executable, "-m", "jaxsafe.train", f"resume={run}"]
    process = subprocess.run(call, capture_output=True, text=True, check=False)
    assert process.returncode == 2
    assert process.stderr.count("\n") == 1, process.stderr
    assert "checkpoint cannot be read" in process.stderr


FULL = """
import resource, sys
from pathlib import Path
import numpy as np
from jaxsafe.commands import cli
from jaxsafe.train.host.checkpoint import Checkpoints

def main(argv):
    checkpoints = Checkpoints(Path(argv[0]), create=True)
    checkpoints.save(1, {"a": np.zeros(3)}, {})
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
    checkpoints.save(int(argv[1]), {"a": np.random.default_rng(0).random(200_000)}, {})

cli.run(main, str, cli.at_once)
"""


@pytest.mark.thorough
@pytest.mark.parametrize("step", [1, 2])
def test_a_checkpoint_without_room_is_one_line_and_leaves_the_one_before(
    tmp_path: Path, step: int
) -> None:
    call = [sys.executable, "-c", FULL, str(tmp_path), str(step)]
    process = subprocess.run(call, capture_output=True, text=True, check=False)
    assert process.returncode == 2
    [line] = process.stderr.splitlines()
    assert line.startswith(
        f"error: {tmp_path}/checkpoints/{step}: checkpoint cannot be written: File too large"
    )
    assert Checkpoints(tmp_path).steps == [1]
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["1"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("limit", "column", "options"),
    [
        ("3", "multiplier", []),
        (
            "{velocity_limit: 3}",
            "multiplier/velocity_limit",
            [
                "ppo.multiplier_proportional=0.3",
                "ppo.multiplier_derivative=0.5",
                "env.cost=severity",
            ],
        ),
    ],
)
def test_ppo_lagrangian_runs_logs_its_multiplier_and_resumes(
    tmp_path: Path, limit: str, column: str, options: list[str]
) -> None:
    words = [*TINY, "algorithm=ppo_lagrangian", f"cost_limit={limit}", *options]
    straight = tmp_path / "straight"
    stopped = tmp_path / "stopped"
    assert command.main([*words, f"out={straight}"]) == 0
    rows = logs(straight)["progress.jsonl"]
    assert all(row[column] > 0.0 for row in rows if row["episodes"])
    assert len({row[column] for row in rows}) > 3
    assert all(row["cost_value_loss"] >= 0.0 for row in rows)
    policy = load_policy(straight / "policy" / "seed_0.npz")
    assert policy(jax.random.key(0), np.zeros(6, np.float32)).shape == (2,)
    shutil.copytree(straight, stopped)
    last = max(
        int(path.name) for path in (stopped / "checkpoints").iterdir() if path.name.isdecimal()
    )
    shutil.rmtree(stopped / "checkpoints" / str(last))
    (stopped / "results.json").unlink()
    assert command.main([f"resume={stopped}"]) == 0
    resumed = logs(stopped)["progress.jsonl"]
    assert [row[column] for row in resumed] == [row[column] for row in rows]
    if limit != "3":  # docking has one constraint
        column = "episode_cost/velocity_limit"
        assert [row[column] for row in resumed] == [row["episode_severity"] for row in rows]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["algorithm=ppo_lagrangian"], "cost_limit: missing; the violating steps"),
        (
            ["algorithm=ppo_lagrangian", "ppo.multiplier_rate=0", "ppo.multiplier_derivative=1"],
            "cost_limit: missing; the violating steps",
        ),
        (
            ["algorithm=ppo_lagrangian", "cost_limit=1", "ppo.multiplier=500"],
            r"ppo.multiplier: expected a number in \[0.0001, 100\], found 500",
        ),
        (["cost_limit=5"], "cost_limit: plain PPO has none; add algorithm=ppo_lagrangian"),
        (["algorithm=ppo_lagrangian", "cost_limit=-1"], "cost_limit: expected a number ≥ 0"),
        (
            ["algorithm=ppo_lagrangian", "cost_limit={velocity: 1}"],
            "cost_limit: unknown constraint 'velocity'. Did you mean 'velocity_limit'.",
        ),
        (
            ["algorithm=ppo_lagrangian", "cost_limit={velocity_limit:1}"],
            "cost_limit, line 1: .* write a space after the colon: velocity_limit: 1$",
        ),
        (
            ["algorithm=ppo_lagrangian", "cost_limit={}"],
            "cost_limit: expected a constraint; choose from velocity_limit",
        ),
        (
            ["algorithm=ppo_lagrangian", "cost_limit={velocity_limit: -1}"],
            "cost_limit.velocity_limit: expected a number ≥ 0, found -1",
        ),
        (
            ["agent.cost_names=[velocity_limit]"],
            "agent.cost_names: follows from the algorithm; give cost_limit={NAME: N}",
        ),
        (
            ["algorithm=ppo_lagrangian", "cost_limit=1", "ppo.multiplier={velocity_limit: 0.1}"],
            "cost_limit: expected a number for each of velocity_limit, as ppo.multiplier has, "
            "found 1",
        ),
        (
            ["algorithm=ppo_lagrangian", "ppo.multiplier={velocity_limit: 0}"],
            r"ppo.multiplier.velocity_limit: expected a number in \[0.0001, 100\], found 0",
        ),
        (
            ["algorithm=trpo"],
            "algorithm: found .trpo.. Did you mean 'ppo'. Choose from ppo, ppo_lagrangian",
        ),
        (
            ["agent.cost_critic=true"],
            "agent.cost_critic: follows from the algorithm; give algorithm=ppo_lagrangian",
        ),
        (
            ["algorithm=ppo_lagrangian", "cost_limit=1", "ppo.cost_limit=2"],
            "ppo.cost_limit: follows from the algorithm",
        ),
        (
            ["ppo.multiplier_rate=0.1"],
            "ppo.multiplier_rate: plain PPO has none; add algorithm=ppo_lagrangian",
        ),
        (
            ["algorithm=ppo_lagrangian", "cost_limit=1", "ppo.gamma=1"],
            "ppo.gamma: expected less than 1 with algorithm=ppo",
        ),
    ],
)
def test_a_cost_limit_needs_the_algorithm_for_it(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        command.main(["env=docking2d", *words])
