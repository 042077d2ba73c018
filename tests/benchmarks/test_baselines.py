import csv
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import jax
import pytest
from baselines import __main__ as command
from baselines import run as running
from baselines.measures import failed_seeds, finished, samples_per_second, steps_to, wall_to
from baselines.page import DIRECTORY, Report, _gap, _number, _percent, _rate
from baselines.plan import KINDS, SHIPPED, Item, best_seed, plan
from baselines.record import keep, kept
from tiny_run import TINY

from jaxsafe.commands import evaluate as evaluate
from jaxsafe.commands import train as train
from jaxsafe.config import override
from jaxsafe.config.arguments import Arguments
from jaxsafe.envs import TASKS
from jaxsafe.rollout import reset_batch
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.options import resolve_all

DOCS = Path(__file__).parents[2] / "docs"
REST = [word for word in TINY if not word.startswith("env=")]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[list[str]]:
    """Return the commands that a report runs.

    They run in this process, which has compiled their programs already.
    """
    made: list[list[str]] = []

    def call(module: str, words: Sequence[str]) -> None:
        made.append([module, *words])
        assert {"jaxsafe.train": train, "jaxsafe.evaluate": evaluate}[module].main(words) == 0

    monkeypatch.setattr(running, "_call", call)
    few = {"heavy": ["env.deputy.mass=24"], SHIPPED: ["seed=1"]}
    monkeypatch.setattr(
        Item,
        "evaluations",
        property(lambda item: few if item.kind == "engineered_features" else {}),
    )
    monkeypatch.chdir(tmp_path)
    return made


def pages(out: str) -> str:
    """Return the text of all pages of a report."""
    files = [Path(out, "baselines.md"), *sorted(Path(out, "results").iterdir())]
    return "\n".join(file.read_text() for file in files)


@pytest.mark.thorough
def test_a_report_trains_evaluates_and_writes_the_pages_once(calls: list[list[str]]) -> None:
    words = ["tasks=docking2d", "kinds=engineered_features", "policies=best", *REST]
    assert command.main(words) == 0
    page = pages("report")
    assert f"`python benchmarks/baselines {shlex.join(words)}`" in page
    for section in (
        "Interaction efficiency",
        "After training",
        "Quality of docking",
        "Violations",
        "Farther starts",
        "The best policies",
    ):
        assert f"## {section}" in page
    results = json.loads(Path("runs/report/docking2d-engineered_features/results.json").read_text())
    rate = results["evaluation"]["deterministic"]["episode_safety_violation_rate"]["mean"]
    assert f"| docking2d | engineered_features | deterministic | {100 * rate:.2f} [" in page
    best = best_seed(results)
    run = Path("runs/report/docking2d-engineered_features")
    assert (
        Path("best/docking2d.npz").read_bytes()
        == (run / "policy" / f"seed_{best}.npz").read_bytes()
    )
    shipped = json.loads((run / "evaluations" / SHIPPED / "results.json").read_text())["evaluation"]
    rate = shipped["stochastic"]["success_rate"]
    assert f"| docking2d | {best} | {100 * rate['mean']:.2f} % |" in page
    assert len(rate["per_seed"]) == 1
    assert (
        f"jaxsafe evaluate run=runs/docking2d-engineered_features/policy/seed_{best}.npz"
        f" episodes=6 seed=1\n"
    ) in page
    for file in (
        "docking2d_training.png",
        "docking2d_seeds.png",
        "docking2d_trajectories.png",
        "docking2d_speed_distance.png",
        "docking2d.gif",
    ):
        assert Path("report/baselines", file).stat().st_size > 1000
        assert f"(../baselines/{file})" in page
    with open("report/baselines/docking2d-engineered_features.csv") as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["step"]), int(row["seed"])) for row in rows] == [
        (64 * (i + 1), s) for i in range(20) for s in range(3)
    ]
    assert {"success_rate", "return", "cost"} <= rows[0].keys()
    assert [module for module, *_ in calls] == ["jaxsafe.train", *3 * ["jaxsafe.evaluate"]]
    assert command.main(words) == 0  # all records are there
    shutil.rmtree("runs")
    assert command.main([*words, "train=false"]) == 0
    assert pages("report") == page
    assert len(calls) == 4


@pytest.mark.thorough
def test_a_report_in_parts_makes_the_page_of_one(
    calls: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["tasks=docking2d", "film=false", *REST]
    assert command.main([*words, "kinds=[engineered_features,observation_only]"]) == 0
    whole = pages("report")
    for kind in ("observation_only", "engineered_features"):
        assert command.main([*words, f"kinds={kind}", "out=parts"]) == 0
    parts = pages("parts")
    assert [line for line in whole.splitlines() if "|" in line] == [
        line for line in parts.splitlines() if "|" in line
    ]
    assert parts.count("- `python benchmarks/baselines") == 2
    assert sum(module == "jaxsafe.train" for module, *_ in calls) == 2

    record = Path("parts/baselines/docking2d-engineered_features.json")
    content = json.loads(record.read_text())
    for option in ("recipe", "like"):  # an older version had no such options
        del content["options"]["training"][option]
    del content["options"]["training"]["ppo"]["complete_episodes"]
    del content["options"]["environment"]["tied"]
    record.write_text(json.dumps(content))
    assert command.main([*words, "kinds=observation_only", "out=parts"]) == 0
    assert pages("parts") == parts

    content["options"]["training"]["ppo"]["gamma"] = 0.5
    record.write_text(json.dumps(content))
    capsys.readouterr()
    assert command.main([*words, "kinds=observation_only", "out=parts"]) == 0
    assert (
        f"{record}: was made with other options and is left out; report it again"
        in capsys.readouterr().out
    )
    assert "engineered_features |" not in pages("parts")


@pytest.mark.thorough
def test_an_evaluation_with_other_options_than_today_s_is_left_out_and_made_anew(
    calls: list[list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["tasks=docking2d", "kinds=engineered_features", "film=false", *REST]
    assert command.main(words) == 0
    assert "| docking2d | heavy |" in pages("report")
    heavier = {"heavy": ["env.deputy.mass=30"], SHIPPED: ["seed=1"]}
    monkeypatch.setattr(
        Item,
        "evaluations",
        property(lambda item: heavier if item.kind == "engineered_features" else {}),
    )
    records, old = kept(
        plan(["docking2d"], ["engineered_features"], REST), Path("report/baselines")
    )
    assert list(records[0].evaluations) == [SHIPPED]
    assert old == [
        "report/baselines/docking2d-engineered_features.json: its evaluation 'heavy' was made with"
        " other options and is left out; report it again"
    ]
    assert command.main(words) == 0
    assert calls[-1][:2] == ["jaxsafe.evaluate", "run=runs/report/docking2d-engineered_features"]
    assert "env.deputy.mass=30" in calls[-1]
    assert len(calls) == 4
    assert "| docking2d | heavy |" in pages("report")


@pytest.mark.thorough
def test_a_record_is_of_the_commit_that_trained_it(
    calls: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["tasks=docking2d", "kinds=observation_only", *REST]
    for now, trained in (("first", "first"), ("second", "first")):
        monkeypatch.setattr(run_directory, "commit", lambda now=now: now)
        assert command.main(words) == 0
        assert (
            f"`python benchmarks/baselines {shlex.join(words)}` on commit {trained}:"
            f" docking2d-observation_only"
        ) in pages("report")
    assert len(calls) == 1


@pytest.mark.thorough
def test_the_pages_of_the_project_are_those_of_its_records_and_of_todays_recipes() -> None:
    records, old = kept(plan([*TASKS], [*KINDS], [f"seeds={command.SEEDS}"]), DOCS / DIRECTORY)
    assert len(records) == len(TASKS) * len(KINDS), old
    written = Report(records).pages(DOCS / DIRECTORY)
    assert [name for name, text in written.items() if (DOCS / name).read_text() != text] == []
    assert {f"results/{file.name}" for file in (DOCS / "results").iterdir()} < written.keys()


@pytest.mark.thorough
def test_an_interrupted_report_goes_on(calls: list[list[str]], whole: Path) -> None:
    run = Path("runs/report/docking2d-engineered_features")
    assert train.main([*TINY, f"out={run}"]) == 0
    (run / "results.json").unlink()
    (run / "evaluations" / "heavy").mkdir(parents=True)
    (run / "evaluations" / "heavy" / "eval.jsonl").write_text("")  # left by a run that was killed
    assert command.main(["tasks=docking2d", "kinds=engineered_features", "film=false", *REST]) == 0
    assert calls[0] == ["jaxsafe.train", f"resume={run}"]
    assert len(calls) == 3


@pytest.mark.thorough
def test_a_report_killed_while_its_figures_were_drawn_draws_them(calls: list[list[str]]) -> None:
    run = Path("runs/report/docking2d-engineered_features")
    words = ["tasks=docking2d", "kinds=engineered_features", "film=false", *REST]
    assert train.main([*TINY, f"out={run}"]) == 0
    pictures = {file.name: file.read_bytes() for file in (run / "figures").iterdir()}
    (run / "figures").rename(run / "figures.part")
    (run / "figures.part" / "trajectories.png").write_bytes(b"half")
    (run / "figures.part" / "old.png").write_bytes(b"of another version")
    assert command.main(words) == 0
    assert calls[0] == ["jaxsafe.train", f"resume={run}"]
    assert {file.name: file.read_bytes() for file in (run / "figures").iterdir()} == pictures
    for name in ("trajectories.png", "speed_distance.png"):
        assert Path("report/baselines", f"docking2d_{name}").read_bytes() == pictures[name]


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (".json", r"(?s)^.*$", "{}", "options: expected a mapping, found nothing"),
        (".json", r"(?s)^.*$", "null", "expected a mapping, found None"),
        (".json", r'"command": ".*"', '"command": 1', "command: expected text, found 1"),
        (
            ".json",
            r'"timesteps": null',
            '"timesteps": "x"',
            "interaction_efficiency.timesteps: expected a whole number",
        ),
        (
            ".json",
            r'"seeds": 3,\n    "seed": 0,',
            '"seeds": 3,',
            "results: seed: expected a whole number ≥ 0, found",
        ),
        (".csv", r"(?s)^.*$", "seed,step\n1,2\n", "row 1: "),
        (".csv", r"(?m)^0,64,", "0,x,", "row 1: step: expected a whole number ≥ 0, found 'x'"),
        (".csv", r"(?s)^.*$", "\0", "csv"),
    ],
)
def test_a_broken_record_is_left_out_with_a_line_that_says_so(
    calls: list[list[str]], whole: Path, file: str, old: str, new: str, message: str
) -> None:
    [item] = plan(["docking2d"], ["observation_only"], REST)
    shutil.copytree(whole, "run")
    keep(item, Path("run"), Path("report"), "python benchmarks/baselines")
    assert len(kept([item], Path("report"))[0]) == 1
    path = Path("report", f"{item.name}{file}")
    text, count = re.subn(old, lambda _: new, path.read_text(), count=1)
    assert count
    path.write_text(text)
    records, [line] = kept([item], Path("report"))
    assert not records
    assert line.startswith(f"report/{item.name}{file}")
    assert message in line
    assert line.endswith("it is left out, report it again")
    assert "\n" not in line


def test_a_run_whose_configuration_is_broken_is_told(calls: list[list[str]]) -> None:
    run = Path("runs/report/docking2d-observation_only")
    run.mkdir(parents=True)
    for text in (
        "{}",
        "null",
        "env: x\ntraining: 1\nenvironment: {}",
        "env: x\ntraining: {}\nenvironment: []",
    ):
        (run / "config.yaml").write_text(text)
        with pytest.raises(ConfigError, match=r"docking2d-observation_only/config\.yaml: "):
            command.main(["tasks=docking2d", "kinds=observation_only", *REST])


def test_what_is_not_known_is_a_dash_on_the_page_and_a_seed_without_success_failed(
    whole: Path,
) -> None:
    unknown = {"mean": None, "ci95": None, "iqm": None, "per_seed": [None, 1.0, 1.0]}
    assert (_percent(unknown), _number(unknown), _rate(unknown, 100, 3)) == ("–", "–", "–")
    bound = {"return": 2.95, "length": 400.5}
    assert _gap("average_return", 2.9, bound) == "0.050"
    assert _gap("episode_length", 412.0, bound) == "11.5"
    assert _gap("control_usage", 0.5, bound) == _gap("episode_length", None, bound) == "–"
    results = {
        "seed": 4,
        "evaluation": {way: {"success_rate": unknown} for way in ("stochastic", "deterministic")},
    }
    assert failed_seeds(results) == [4]


def test_ctrl_c_gives_the_training_time_to_save(tmp_path: Path) -> None:
    saving = (
        f"import time, pathlib; time.sleep(1.0); pathlib.Path({str(tmp_path / 'saved')!r}).touch()"
    )
    process = subprocess.Popen([sys.executable, "-c", saving])
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        running._wait(process)
    assert process.returncode == 0
    assert (tmp_path / "saved").exists()


def test_a_termination_of_the_report_is_passed_on() -> None:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM)).start()
    assert running._wait(process) == -signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is not process.terminate


@pytest.mark.thorough
def test_old_runs_do_not_pass_as_new_ones(calls: list[list[str]]) -> None:
    assert train.main([*TINY, "out=runs/report/docking2d-engineered_features"]) == 0
    with pytest.raises(ConfigError, match=r"runs: .* was trained with other options; remove it"):
        command.main(["tasks=docking2d", "kinds=engineered_features", *REST, "ppo.gamma=0.9"])
    assert not calls


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["tasks=docking4d"],
            "tasks: found 'docking4d'. Did you mean 'docking3d'? Choose from rejoin2d",
        ),
        (
            ["kinds=[engineered_features,plane]"],
            "kinds: found 'plane'; choose from engineered_features, observation_only,"
            " many_envs, shortest_time, discrete, observation_only_discrete, rta,"
            " rta_no_punishment",
        ),
        (["tasks=[]"], "tasks: expected at least one of rejoin2d"),
        (["film=gif"], "film: expected true or false, found 'gif'"),
        (["sedes=3"], "sedes: unknown option 'sedes'"),
    ],
)
def test_bad_options_of_report_are_told(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        command.main(words)
    assert str(raised.value).startswith(message)


@pytest.mark.thorough
def test_every_command_of_the_plan_is_valid() -> None:
    from jaxsafe.envs import adapt

    items = plan([*TASKS], [*KINDS], ["seeds=10"])
    assert len({item.name for item in items}) == 40
    for item in items:
        [(config, env, _)] = resolve_all(Arguments.parse(item.words).options)
        assert config.seeds == 10
        for words in item.evaluations.values():
            arguments = Arguments.parse(words)
            rta = arguments.pop_text("rta")
            arguments.pop("seed")
            changed = adapt(env, item.task, arguments.pop_overrides(), rta=rta)
            assert changed.observation_size == env.observation_size
            assert not arguments.options


def test_the_wall_time_to_a_level_waits_for_twenty_episodes_of_every_seed() -> None:
    rates = [(None, 1.0, 9), (1.0, 1.0, 19), (0.9, 0.9, 20), (0.92, 0.98, 30), (1.0, 1.0, 40)]
    curves = [
        {
            "seed": seed,
            "step": 10 * index,
            "success_rate": row[seed],
            "episodes": row[2],
            "wall_s": index + seed / 10,
        }
        for seed in (0, 1)
        for index, row in enumerate(rates)
    ]
    assert wall_to(0.95, curves) == 3.1
    assert wall_to(0.9, curves) == 2.1
    assert wall_to(0.99, curves) == 4.1
    assert wall_to(0.99, [row for row in curves if row["step"] < 40]) is None
    assert steps_to(0.9, curves) == 20
    assert steps_to(0.9, curves, at_least=25) == 30
    assert steps_to(0.9, curves, at_least=100) is None


def test_samples_a_second_are_those_of_all_seeds_after_the_first_update():
    curves = [
        {"seed": seed, "step": 100 * i, "wall_s": 20.0 + 2 * i}
        for seed in (3, 4)
        for i in (1, 2, 3)
    ]
    assert samples_per_second(curves) == 2 * 200 / 4
    assert samples_per_second(curves[:1]) is None


def test_the_best_policy_succeeds_most_then_violates_least_then_has_the_highest_return() -> None:
    def results(
        success: list[float], violating: list[float | None], value: list[float | None]
    ) -> dict:
        names = ("success_rate", "episode_safety_violation_rate", "average_return")
        columns = dict(
            zip(
                names,
                ({"per_seed": per_seed} for per_seed in (success, violating, value)),
                strict=True,
            )
        )
        return {"seed": 5, "evaluation": {"deterministic": columns}}

    assert best_seed(results([0.9, 1.0, 0.8], [0.0, 0.1, 0.0], [9.0, 1.0, 9.0])) == 6
    assert best_seed(results([1.0, 1.0, 0.8], [0.2, 0.1, 0.0], [9.0, 1.0, 9.0])) == 6
    assert best_seed(results([1.0, 1.0, 1.0], [0.1, 0.1, 0.1], [1.0, None, 2.0])) == 7
    assert best_seed(results([0.0, 0.0], [None, None], [None, None])) == 5


@pytest.mark.thorough
def test_trainings_with_a_filter_start_where_it_promises_safety() -> None:
    begin = jax.jit(reset_batch, static_argnums=2)
    for item in plan(["docking2d_oriented"], ["rta", "rta_no_punishment"], ["seeds=2"]):
        [(_, env, _)] = resolve_all(Arguments.parse(item.words).options)
        [deputy] = [platform for platform in env.platforms if platform.name == "deputy"]
        [share] = [start.share for start in deputy.start if start.name == "velocity"]
        fastest = override(env, {"deputy.start.velocity.share": [share[1], share[1]]})
        _, timestep = begin(fastest, jax.random.key(0), 20_000)
        assert timestep.info.rta.certified.all()


def test_a_seed_failed_if_it_did_either_way_and_finished_episodes_are_those_by_the_step() -> None:
    rates = {"stochastic": [0.95, 0.949, 1.0], "deterministic": [1.0, 1.0, 0.3]}
    results = {
        "seed": 7,
        "evaluation": {way: {"success_rate": {"per_seed": rate}} for way, rate in rates.items()},
    }
    assert failed_seeds(results) == [8, 9]
    curves = [
        {"seed": seed, "step": 100 * i, "episodes": 10 * i + seed}
        for seed in (3, 4)
        for i in (1, 2, 3)
    ]
    assert finished(curves, 200) == 23.5
    assert finished(curves, 250) == 23.5
