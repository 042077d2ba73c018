"""Training by name from Python does what the command does, and a run is an object."""

import os
import re
import signal
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from tiny_run import TINY, assert_same_end

import jaxsafe
from jaxsafe import ConfigError
from jaxsafe.config.arguments import Arguments
from jaxsafe.runs.training import _tell_idle_cores
from jaxsafe.storage.columns import table
from jaxsafe.storage.files import read_json
from jaxsafe.train.host.session import Training


def options(words: list[str]) -> dict[str, Any]:
    """Return options of the command line as arguments of a call, without the task."""
    given = Arguments.parse(words).options
    return {name: value for name, value in given.items() if name != "env"}


@pytest.fixture(autouse=True)
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the figures of the trainings here. `whole` has them."""
    monkeypatch.setattr("jaxsafe.runs.figures.draw_all", lambda run: [])


@pytest.fixture(scope="module")
def run(whole: Path) -> Any:
    return jaxsafe.open_run(whole)


def test_a_call_trains_bit_for_bit_what_the_command_trains(
    whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    given = {**options(TINY), "seeds": np.int64(3), "out": tmp_path / "run"}
    trained = jaxsafe.train("docking2d", **given, progress=False)
    assert capfd.readouterr().out == ""
    assert trained.path == tmp_path / "run"
    assert_same_end(trained.path, whole)
    assert trained.results["evaluation"] == jaxsafe.open_run(whole).results["evaluation"]


@pytest.mark.thorough
def test_a_run_is_stopped_and_resumed_and_trained_for_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    path = tmp_path / "run"
    original = Training._write_progress

    def interrupt(self: Training, *arguments: Any) -> None:
        original(self, *arguments)
        os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Training, "_write_progress", interrupt)
        with pytest.raises(KeyboardInterrupt):
            jaxsafe.train("docking2d", **options(TINY), out=path)
    said = capsys.readouterr().out
    assert said.endswith(f"go on with: jaxsafe.train(resume={str(path)!r})\n")
    with pytest.raises(ConfigError, match=r"has not finished; go on with jaxsafe.train\(resume="):
        jaxsafe.open_run(path)
    run = jaxsafe.train(resume=path)
    assert run.results["steps"] == 1280
    assert run.resume(steps=1600, progress=False).results["steps"] == 1600


def test_a_run_knows_its_results_and_logs(run: Any, whole: Path) -> None:
    assert run.results == read_json(whole / "results.json")
    assert run.task == "docking2d"
    assert run.seeds == [0, 1, 2]
    assert len(run.progress["step"]) == 3 * 20
    assert set(run.progress["seed"]) == {0, 1, 2}
    assert run.progress["return"].dtype == float
    episodes = run.episodes
    assert {"step", "final", "episode", "platforms.deputy.position.x"} <= set(episodes)
    last = episodes["final"]
    assert set(np.asarray(episodes["step"])[np.asarray(last)]) == {1280}


def test_without_pandas_logs_are_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    columns = table([{"a": {"b": [1.0, 2.0]}, "c": "x"}, {"a": {"b": [3.0, None]}, "c": "y"}])
    assert list(columns) == ["a.b.x", "a.b.y", "c"]
    np.testing.assert_array_equal(columns["a.b.y"], [2.0, np.nan])
    assert columns["c"].tolist() == ["x", "y"]


def test_a_run_has_the_policies_that_it_saved(run: Any, whole: Path) -> None:
    observation = jax.random.uniform(jax.random.key(0), (5, run.env.observation_size))
    saved = jaxsafe.load_policy(whole / "policy" / "seed_1.npz")
    policy = run.policy(seed=1)
    np.testing.assert_array_equal(
        policy(jax.random.key(0), observation), saved(jax.random.key(0), observation)
    )
    assert policy.about == saved.about
    assert run.policy(checkpoint=320).about["step"] == 320
    assert run.policy(checkpoint="best").task == "docking2d"
    with pytest.raises(ConfigError, match="seed: expected one of 0 to 2, found 3"):
        run.policy(seed=3)
    with pytest.raises(
        ConfigError, match=r"checkpoint: found 'lest'\. Did you mean 'last'\? Choose from last"
    ):
        run.policy(checkpoint="lest")
    with pytest.raises(ConfigError, match=r"checkpoint: found '9+\.\.\.; choose from last, best"):
        run.policy(checkpoint="9" * 5000)
    with pytest.raises(ConfigError, match="no step a number of thousands of digits in"):
        run.policy(checkpoint="9" * 4000)
    with pytest.raises(ConfigError, match="found 'a number of thousands of digits'; choose"):
        run.policy(checkpoint=10**5000)


@pytest.mark.thorough
def test_a_run_draws_its_figures_for_a_notebook(run: Any, whole: Path) -> None:
    figures = run.plot()
    assert {f"{name}.png" for name in figures} == {
        path.name for path in (whole / "figures").iterdir()
    }
    assert figures._repr_html_().count("data:image/png;base64,") == len(figures)
    with pytest.raises(
        ConfigError, match=r"x: unknown axis 'step'\. Did you mean 'steps'\? Choose from steps"
    ):
        run.plot(x="step")


def test_a_run_prints_what_it_is_and_what_came_of_it(run: Any, whole: Path) -> None:
    text = repr(run)
    assert text.splitlines()[0] == f"Run {whole}"
    for line in (
        "  task             docking2d, preset ",
        "  seeds            0 to 2, 1,280 steps each",
        "  filter           none",
    ):
        assert line in text
    assert re.search(r"  success +\S+% stochastic, \S+% deterministic, worst seed \S+%\n", text)
    assert re.search(r"  violating steps +\S+ % while training \(\d+ per seed\); after it ", text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": "docking2"}, "env: unknown task 'docking2'"),
        ({"env": "all"}, "env: expected one task, found 'all'"),
        ({"env": "docking2d", "sedes": 2}, "sedes: unknown option 'sedes'"),
        ({"env": "docking2d", "ppo.gama": 0.9}, "ppo.gama: unknown option 'gama'"),
        (
            {"env": jaxsafe.make("docking2d"), "seeds": 2},
            "train: an environment needs agent, hyper",
        ),
        ({"resume": "nowhere"}, "resume: no run in 'nowhere'"),
    ],
)
def test_a_wrong_call_is_refused_in_one_line(
    arguments: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message) as caught:
        jaxsafe.train(**arguments)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_run_that_is_resumed_keeps_its_options(whole: Path) -> None:
    with pytest.raises(ConfigError, match="seeds: the run has its options; only steps is given"):
        jaxsafe.train(resume=whole, seeds=4)  # type: ignore[call-overload]
    assert jaxsafe.train(resume=whole).path == whole
    with pytest.raises(ConfigError, match=r"env: .*whole is a run; resume=.* goes on with it"):
        jaxsafe.train(whole)


def test_seeds_that_cannot_share_the_cores_are_told(
    whole: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("jaxsafe.runs.training.usable_cores", lambda: 8)
    _tell_idle_cores(whole)
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(jax, "local_device_count", lambda: 1)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    _tell_idle_cores(whole)
    assert capsys.readouterr().out == (
        "training 3 seeds on one of 8 cores, because JAX was in use before; "
        "in a new session call jaxsafe.train first\n"
    )


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="run: no run in "):
        jaxsafe.open_run(tmp_path)
    with pytest.raises(ConfigError, match=r"write jaxsafe\.load_policy\('pretrained/docking2d'\)"):
        jaxsafe.open_run("pretrained/docking2d")


def test_a_run_in_place_of_a_policy_is_told_how_it_has_some(whole: Path) -> None:
    call = re.escape(f"is a run; jaxsafe.open_run({str(whole)!r}).policy() returns its policy")
    with pytest.raises(ConfigError, match=call):
        jaxsafe.load_policy(whole)
