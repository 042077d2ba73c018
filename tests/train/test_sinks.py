"""The progress of a training goes to TensorBoard, Weights & Biases and MLflow.

The calls are tested with modules that note them. The libraries themselves are tried where they are
installed, without a network.
"""

import importlib.util
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tiny_run import TINY, logs

from jaxsafe.commands import train as command
from jaxsafe.config.arguments import Arguments
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.log import ProgressLog
from jaxsafe.train.host.options import resolve
from jaxsafe.train.host.sinks import LIBRARIES, METRICS_PER_REQUEST, MLflow, open_sinks

Point = tuple[str, int, float]
"""Name, step and value of a number that a service got."""


class FakeWandB:
    """The functions of `wandb` that the sink calls."""

    def __init__(self) -> None:
        self.opened: list[dict[str, Any]] = []
        self.points: list[Point] = []
        self.finished = 0

    def init(self, **options: Any) -> Any:
        self.opened.append(options)
        return SimpleNamespace(log=self.log, finish=self.finish)

    def log(self, values: dict[str, float], step: int) -> None:
        self.points += [(name, step, value) for name, value in values.items()]

    def finish(self) -> None:
        self.finished += 1


class FakeMLflow:
    """The functions of `mlflow` that the sink calls. It is module and client in one."""

    def __init__(self) -> None:
        self.experiments: list[str] = []
        self.runs: list[tuple[str, str]] = []
        self.params: dict[str, str] = {}
        self.points: list[Point] = []
        self.requests: list[int] = []
        self.status = ""
        self.entities = SimpleNamespace(
            Param=lambda key, value: (key, value),
            Metric=lambda key, value, timestamp, step: (key, step, value),
        )

    def MlflowClient(self) -> "FakeMLflow":  # noqa: N802
        return self

    def get_experiment_by_name(self, name: str) -> Any:
        known = name in self.experiments
        return SimpleNamespace(experiment_id=f"id of {name}") if known else None

    def create_experiment(self, name: str) -> str:
        self.experiments.append(name)
        return f"id of {name}"

    def create_run(self, experiment_id: str, run_name: str) -> Any:
        self.runs.append((experiment_id, run_name))
        return SimpleNamespace(info=SimpleNamespace(run_id=f"run {len(self.runs)}"))

    def log_batch(self, run_id: str, metrics: Any = (), params: Any = ()) -> None:
        assert run_id == "run 1"
        self.points += metrics
        self.params |= dict(params)
        self.requests.append(len(metrics))

    def update_run(self, run_id: str, status: str) -> None:
        self.status = status

    def set_terminated(self, run_id: str) -> None:
        self.status = "FINISHED"


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> FakeWandB:
    fake = FakeWandB()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


@pytest.fixture
def mlflow(monkeypatch: pytest.MonkeyPatch) -> FakeMLflow:
    fake = FakeMLflow()
    monkeypatch.setitem(sys.modules, "mlflow", fake)
    return fake


def expected(run: Path) -> list[Point]:
    """Return every number of a progress log but for the clock."""
    return [
        (f"{name}/seed_{row['seed']}", row["step"], value)
        for row in logs(run)["progress.jsonl"]
        for name, value in row.items()
        if name not in ("seed", "step", "diverged") and value is not None
    ]


def without_clock(points: list[Point]) -> list[Point]:
    return [point for point in points if not point[0].startswith("wall_s/")]


@pytest.mark.thorough
def test_every_number_of_the_progress_log_goes_to_every_sink(
    tmp_path: Path, wandb: FakeWandB, mlflow: FakeMLflow
) -> None:
    run = tmp_path / "run"
    words = ["tensorboard=true", "wandb=true", "mlflow=docking"]
    assert command.main([*TINY, *words, f"out={run}"]) == 0
    assert without_clock(wandb.points) == expected(run)
    assert without_clock(mlflow.points) == expected(run)
    assert ("value_loss/seed_2", 64) in [point[:2] for point in mlflow.points]
    (events,) = (run / "tensorboard").iterdir()
    content = events.read_bytes()
    for name in ("return/seed_1", "approx_kl/seed_0"):
        count = sum(point[0] == name for point in expected(run))
        assert content.count(name.encode()) == count > 10
    (opened,) = wandb.opened
    assert (opened["project"], opened["name"]) == ("jaxsafe", "run")
    assert opened["config"]["env"] == "docking2d"
    assert opened["config"]["ppo.num_envs"] == 4
    assert wandb.finished == 1
    assert mlflow.runs == [("id of docking", "run")]
    assert (mlflow.params["seeds"], mlflow.params["agent.actor.hidden"]) == ("3", "[8]")
    assert max(mlflow.requests) < 2 * METRICS_PER_REQUEST
    assert mlflow.status == "FINISHED"


@pytest.mark.thorough
def test_a_resumed_run_goes_on_in_the_same_run_of_a_service(
    tmp_path: Path, whole: Path, wandb: FakeWandB, mlflow: FakeMLflow
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    (run / "results.json").unlink()
    shutil.rmtree(run / "checkpoints" / "1280")
    config = run / "config.yaml"
    text = (
        config.read_text().replace("wandb: null", "wandb: a").replace("mlflow: null", "mlflow: b")
    )
    config.write_text(text)
    open_sinks(False, "a", "b", run, 0, {})["mlflow"].close()
    assert mlflow.status == "FINISHED"
    assert command.main([f"resume={run}"]) == 0
    first, second = (opened["id"] for opened in wandb.opened)
    assert first == second
    assert {opened["resume"] for opened in wandb.opened} == {"allow"}
    assert len(mlflow.runs) == 1
    later = [point for point in expected(run) if point[1] > 960]
    assert without_clock(wandb.points) == without_clock(mlflow.points) == later


def test_an_option_is_a_name_or_says_whether() -> None:
    for word, project in (("true", "jaxsafe"), ("false", None), ("a", "a")):
        options = Arguments.parse(["env=docking2d", f"wandb={word}"]).options
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(sys.modules, "wandb", FakeWandB())
            assert resolve(options)[0].wandb == project
    with pytest.raises(ConfigError, match=r"^mlflow: expected a name, found 5$"):
        resolve({"env": "docking2d", "mlflow": 5})


@pytest.mark.parametrize("option", LIBRARIES)
def test_a_missing_library_is_one_line_before_there_is_a_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    monkeypatch.setitem(sys.modules, LIBRARIES[option], None)
    hint = rf"^{option}: {LIBRARIES[option]} is not installed; in a clone .*'\.\[{option}\]'$"
    with pytest.raises(ConfigError, match=hint):
        command.main([*TINY, f"{option}=true", f"out={tmp_path / 'run'}"])
    assert not (tmp_path / "run").exists()


def test_a_service_that_refuses_the_run_is_one_line(tmp_path: Path, wandb: FakeWandB) -> None:
    def refuse(**_: Any) -> None:
        raise RuntimeError("no API key\ncall wandb login")

    wandb.init = refuse
    with pytest.raises(
        ConfigError, match=r"^wandb: the run cannot be opened: RuntimeError: no API key$"
    ):
        open_sinks(False, "x", None, tmp_path, 0, {})


def test_a_service_that_fails_later_is_left_out(
    tmp_path: Path, wandb: FakeWandB, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError("network is down")

    log = ProgressLog(tmp_path, 0, 0)
    log.sinks = open_sinks(True, "x", None, tmp_path, 0, {})
    log.write([{"seed": 0, "step": 1, "return": 1.0}])
    wandb.log = fail
    log.sinks["wandb"]._run.log = fail  # pyright: ignore[reportAttributeAccessIssue]
    for step in (2, 3):
        log.write([{"seed": 0, "step": step, "return": None}])
    assert capsys.readouterr().out == (
        "wandb: OSError: network is down; the training goes on without it\n"
    )
    assert [*log.sinks] == ["tensorboard"]
    log.close()
    assert len((tmp_path / "progress.jsonl").read_text().splitlines()) == 3


def test_mlflow_gets_names_that_it_takes(tmp_path: Path, mlflow: FakeMLflow) -> None:
    sink = MLflow("x", tmp_path, {})
    sink.write(5, 0, {"reward/a$b": 1.0, "return": 2.0})
    assert mlflow.points == []  # they wait for more
    sink.close()
    assert mlflow.points == [("reward/a_b/seed_0", 5, 1.0), ("return/seed_0", 5, 2.0)]


def test_a_run_directory_of_an_older_version_has_no_sinks(tmp_path: Path, whole: Path) -> None:
    lines = (whole / "config.yaml").read_text().splitlines(keepends=True)
    older = [line for line in lines if line.strip() not in ("wandb: null", "mlflow: null")]
    assert len(older) == len(lines) - 2
    (tmp_path / "config.yaml").write_text("".join(older))
    config, _, _ = run_directory.read(tmp_path, "run")
    assert (config.tensorboard, config.wandb, config.mlflow) == (False, None, None)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.skipif(not importlib.util.find_spec("wandb"), reason="wandb is not installed")
def test_wandb_itself_keeps_a_run_without_a_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    sinks = [
        open_sinks(False, "x", None, tmp_path / name, 0, {"ppo.gamma": 0.9})["wandb"]
        for name in ("one", "other")  # both at the same time, as with env=all
    ]
    for sink in sinks:
        sink.write(64, 0, {"return": 1.0, "reward/success": 0.5})
        sink.write(64, 1, {"return": 2.0})
        sink.close()
    for name in ("one", "other"):
        number = (tmp_path / name / "wandb_id").read_text()
        (file,) = (tmp_path / name / "wandb").glob(f"offline-run-*/run-{number}.wandb")
        content = file.read_bytes()
        assert b"reward/success/seed_0" in content
        assert b"return/seed_1" in content


@pytest.mark.filterwarnings("ignore")
@pytest.mark.skipif(not importlib.util.find_spec("mlflow"), reason="mlflow is not installed")
def test_mlflow_itself_keeps_a_run_in_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "store").as_uri())
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    for step in (64, 128):  # the second goes on with the same run
        sink = open_sinks(False, None, "x", tmp_path, 0, {"ppo.gamma": 0.9})["mlflow"]
        sink.write(step, 0, {"return": 1.0, "reward/success": 0.5 * step})
        sink.close()
    import mlflow

    client = mlflow.MlflowClient()
    run = client.get_run((tmp_path / "mlflow_id").read_text())
    assert (run.info.status, run.data.params) == ("FINISHED", {"ppo.gamma": "0.9"})
    history = client.get_metric_history(run.info.run_id, "reward/success/seed_0")
    assert [(point.step, point.value) for point in history] == [(64, 32.0), (128, 64.0)]
