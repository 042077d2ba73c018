"""Data for offline learning: whole episodes, whose every step is one that the environment took."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import minari
import numpy as np
import pytest

import jaxsafe
from jaxsafe.commands import policies
from jaxsafe.commands.dataset import main
from jaxsafe.config import dump
from jaxsafe.dataset import collect, collect_from_each, load_dataset, random_policy, save_dataset
from jaxsafe.dataset.files import facts
from jaxsafe.envs import TASKS
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host.checkpoint import Checkpoints

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SHORT = {"terminal.timeout.limit": 30.0}


@pytest.fixture(scope="module")
def env() -> Any:
    return jaxsafe.make("docking2d", SHORT)


@pytest.fixture(scope="module")
def data(env: Any) -> Any:
    return collect(env, random_policy(env), jax.random.key(0), 23)


def test_steps_of_an_episode_follow_each_other(data: Any) -> None:
    assert np.all(np.abs(data.action) <= 1.0)
    assert data.done[-1]
    goes_on = ~data.done[:-1]
    np.testing.assert_array_equal(
        data.observation[1:][goes_on], data.next_observation[:-1][goes_on]
    )
    lengths = [part.stop - part.start for part in data.episodes()]
    assert len(lengths) == 23
    assert sum(lengths) == len(data.reward)
    assert max(lengths) == 31  # the first step with t > limit
    assert np.any(data.observation[1:][~goes_on] != data.next_observation[:-1][~goes_on])


def test_a_step_is_what_the_environment_does(env: Any, data: Any) -> None:
    start = data.episodes()[1].start
    seen = data.observation[start]
    deputy = {"position": seen[:2] * 100.0, "velocity": seen[2:4] * 0.5}
    state, _ = jaxsafe.reset_to(env, {"deputy": deputy})
    for index in range(start, start + 5):
        state, timestep = jaxsafe.step(env, state, jnp.asarray(data.action[index]))
        np.testing.assert_allclose(timestep.observation, data.next_observation[index], atol=1e-5)
        np.testing.assert_allclose(timestep.reward, data.reward[index], atol=1e-5)
        assert float(timestep.cost) == data.costs[index].max()
        np.testing.assert_allclose(timestep.info.control_actual, data.control[index], atol=1e-6)


@pytest.fixture(scope="module")
def leaving() -> Any:
    """Return a task from which drift leads out early or late, or not before the timeout."""
    return jaxsafe.make(
        "docking2d", {"terminal.distance.limit": 155.0, "terminal.timeout.limit": 300.0}
    )


def test_each_of_several_policies_flies_as_many_whole_episodes(leaving: Any) -> None:
    def pushing(parameters: Any) -> Any:
        return lambda key, observation: jnp.full((len(observation), 2), parameters)

    thrusts = [jnp.float32(x) for x in (-0.5, 0.0, 0.25)]
    data = collect_from_each(leaving, pushing, thrusts, jax.random.key(1), 7)
    episodes = data.episodes()
    of_episode = [set(data.action[part, 0].tolist()) for part in episodes]
    assert of_episode == 7 * [{-0.5}] + 7 * [{0.0}] + 7 * [{0.25}]
    assert all(data.terminated[part.stop - 1] for part in episodes)
    means = [
        np.mean([part.stop - part.start for part in episodes[first : first + 7]])
        for first in (0, 7, 14)
    ]
    assert max(means) > 1.5 * min(means)  # as many of each, although they differ in length


def test_long_episodes_are_as_frequent_as_in_an_evaluation(leaving: Any) -> None:
    policy = random_policy(leaving)
    data = collect(leaving, policy, jax.random.key(2), 150)  # more than run side by side
    lengths = np.array([part.stop - part.start for part in data.episodes()])
    assert len(lengths) == 150
    assert np.mean(lengths == 301) > 0.15
    measured = jaxsafe.evaluate(leaving, policy, episodes=1000)["episode_length"]
    error = lengths.std() / np.sqrt(len(lengths))
    assert facts(leaving, data)["mean_length"] == pytest.approx(measured, abs=3.0 * error)


def test_episodes_that_a_timeout_truncates_are_part_of_the_averages() -> None:
    env = jaxsafe.make("docking2d", {**SHORT, "terminal.timeout.ends": "truncated"})
    data = collect(env, random_policy(env), jax.random.key(0), 3)
    header = facts(env, data)
    assert data.truncated.sum() == header["episodes"] == 3
    assert header["mean_length"] == 31
    assert header["given_up"] == 0


def test_an_episode_that_never_ends_is_given_up_and_counted() -> None:
    endless = {"terminal": ["success", "crash", "distance"], "reward": ["distance_change"]}
    env = jaxsafe.make("docking2d", endless)
    data = collect(env, lambda key, x: jnp.zeros((len(x), 2)), jax.random.key(0), 2)
    header = facts(env, data)
    assert header["given_up"] == header["episodes"] == data.truncated.sum() == 2
    assert header["mean_length"] == 10_000
    assert header["success_rate"] == 0.0


@pytest.mark.parametrize("number", [0, -1, 2.5])
def test_a_number_of_episodes_is_whole_and_positive(env: Any, number: Any) -> None:
    with pytest.raises(ConfigError, match="num_episodes: expected a whole number ≥ 1, found"):
        collect(env, random_policy(env), jax.random.key(0), number)


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_random_actions_are_uniform_in_their_bounds(actions: str) -> None:
    env = jaxsafe.make("docking2d", actions=actions)
    drawn = np.asarray(random_policy(env)(jax.random.key(0), jnp.zeros((4000, 6))))
    if actions == "continuous":
        assert np.abs(drawn).max() <= 1.0
        assert np.abs(drawn.mean(axis=0)).max() < 0.04
        return
    points = env.num_action_points[0]
    counts = np.bincount(drawn[:, 0], minlength=points)
    assert len(counts) == points
    assert counts.min() > 0.8 * 4000 / points


def test_a_file_has_all_that_was_collected(env: Any, data: Any, tmp_path: Path) -> None:
    path = tmp_path / "data.npz"
    save_dataset(path, data, facts(env, data))
    again, header = load_dataset(path)
    for name, array in data._asdict().items():
        np.testing.assert_array_equal(getattr(again, name), array)
    assert header["constraints"] == ["velocity_limit"]
    assert header["steps"] == len(data.reward)
    assert header["episodes"] == 23
    returns = [data.reward[part].sum() for part in data.episodes()]
    assert header["mean_return"] == pytest.approx(np.mean(returns), rel=1e-5)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ConfigError, match=r"data\.npz: not a dataset, or a damaged one"):
        load_dataset(path)


def test_the_command_writes_data_of_random_actions(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "random.npz"
    words = ["env=docking2d", "kind=random", "episodes=3", "env.terminal.timeout.limit=20"]
    assert main([*words, f"out={out}"]) == 0
    assert "63 steps in 3 episodes of actions drawn uniformly\n" in capsys.readouterr().out
    data, header = load_dataset(out)
    assert header["kind"] == "random"
    assert header["rta"] == "none"
    assert header["changes"] == ["reward.success.time_scale", "terminal.timeout.limit"]
    assert header["reference_returns"] == {}  # those of the task are not of this one
    assert len(data.reward) == 63
    assert main([*words, f"out={out}", "rta=default"]) == 0
    assert "drawn uniformly, with the filter discrete_asif\n" in capsys.readouterr().out
    assert load_dataset(out)[1]["rta"] == "discrete_asif"


@pytest.mark.thorough
def test_data_of_all_checkpoints_are_of_all_seeds(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "data.npz"
    assert main([f"run={whole}", "kind=replay", "episodes=13", f"out={out}"]) == 0
    header = load_dataset(out)[1]
    assert header["training_steps"] == Checkpoints(whole).steps
    assert header["policies"] == 3 * len(Checkpoints(whole).steps)
    assert header["episodes"] % header["policies"] == 0
    assert 13 <= header["episodes"] < 13 + header["policies"]


def with_success(whole: Path, run: Path, *rates: float) -> Path:
    """Return a copy of a run whose checkpoints have these success rates in training."""
    shutil.copytree(whole, run)
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    steps = Checkpoints(run).steps
    for row in rows:
        row["success_rate"] = rates[sum(step < row["step"] for step in steps)]
    (run / "progress.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    return run


@pytest.mark.thorough
def test_medium_is_the_checkpoint_nearest_to_half_of_the_success(
    whole: Path, tmp_path: Path
) -> None:
    run = with_success(whole, tmp_path / "run", 0.0, 0.3, 0.8, 0.8)
    out = tmp_path / "data.npz"
    assert main([f"run={run}", "kind=medium", "episodes=3", f"out={out}"]) == 0
    header = load_dataset(out)[1]
    assert header["training_steps"] == Checkpoints(run).steps[1:2]
    assert header["policies"] == header["episodes"] == 3


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("rates", "message"),
    [
        ((0.0, 0.0, 0.0, 0.0), "ended without a success, so it has no data of kind=medium"),
        ((0.1, 0.9, 1.0, 1.0), "has 10%, 90%, 100%, 100%; train with a smaller checkpoint_every"),
    ],
)
def test_a_run_without_a_medium_policy_is_refused(
    rates: tuple[float, ...], message: str, whole: Path, tmp_path: Path
) -> None:
    run = with_success(whole, tmp_path / "run", *rates)
    with pytest.raises(ConfigError, match=message):
        main([f"run={run}", "kind=medium", "episodes=3"])


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["expert", "filtered", "medium"])
def test_a_training_that_has_not_ended_has_no_expert(
    kind: str, whole: Path, tmp_path: Path
) -> None:
    run = with_success(whole, tmp_path / "run", 0.0, 0.3, 0.8, 0.8)
    (run / "results.json").unlink()
    with pytest.raises(ConfigError, match=f"has not finished, and kind={kind} needs its end"):
        main([f"run={run}", f"kind={kind}", "episodes=3"])


@pytest.mark.thorough
def test_policies_that_diverged_are_left_out_and_told(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    diverged = [1]

    def spoil(leaf: jax.Array) -> jax.Array:
        return leaf.at[jnp.array(diverged)].set(jnp.nan)

    def load(run: str, checkpoint: str | None, before: Any = policies.load) -> Any:
        subject = before(run, checkpoint)
        return subject._replace(params=jax.tree.map(spoil, subject.params))

    monkeypatch.setattr("jaxsafe.commands.policies.load", load)
    out = tmp_path / "data.npz"
    assert main([f"run={whole}", "episodes=2", f"out={out}"]) == 0
    assert "left out because their training diverged: 1\n" in capsys.readouterr().out
    header = load_dataset(out)[1]
    assert (header["policies"], header["diverged"]) == (2, 1)
    diverged += [0, 2]
    with pytest.raises(ConfigError, match="diverged, so it has no policies"):
        main([f"run={whole}", "episodes=2"])


def test_the_header_names_the_environment_in_which_the_policies_act(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "data.npz"
    words = ["controller/lqr", "env=docking1d", "episodes=2", "env.terminal.timeout.limit=20"]
    assert main([*words, "kind=filtered", f"out={out}"]) == 0
    said = capsys.readouterr().out
    assert "42 steps in 2 episodes of controller/lqr, with the filter discrete_asif\n" in said
    header = load_dataset(out)[1]
    assert (header["task"], header["rta"]) == ("docking1d", "discrete_asif")
    assert header["training_steps"] == []
    other = tmp_path / "shorter.yaml"
    other.write_text(dump(jaxsafe.make("docking2d", SHORT, rta="explicit_simplex")))
    words = ["pretrained/docking2d", "kind=filtered", "episodes=2", f"env={other}"]
    assert main([*words, f"out={out}"]) == 0
    header = load_dataset(out)[1]
    assert (header["task"], header["rta"]) == ("shorter", "simplex")  # the filter of the file


def test_minari_reads_every_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    words = ["run=pretrained/docking2d", "episodes=8", "env.terminal.timeout.limit=40"]
    words += ["format=minari", "out=jaxsafe/docking2d/test-v0", "kind=filtered"]
    assert main(words) == 0
    assert "written to jaxsafe/docking2d/test-v0" in capsys.readouterr().out
    dataset = minari.load_dataset("jaxsafe/docking2d/test-v0")
    assert dataset.total_episodes == 8
    assert dataset.total_steps == 8 * 41
    for episode in dataset.iterate_episodes():
        assert len(episode.observations) == len(episode.actions) + 1
        assert len(episode.infos["costs"]["velocity_limit"]) == len(episode.observations)
        assert episode.terminations[-1] or episode.truncations[-1]
        assert dataset.spec.observation_space.contains(episode.observations[0])
        assert dataset.spec.action_space.contains(episode.actions[0])
    with pytest.raises(ConfigError, match="out: jaxsafe/docking2d/test-v0: "):
        main(words)


@pytest.mark.parametrize("kind", ["expert", "filtered"])
def test_minari_normalises_returns_between_those_of_the_task(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    name = f"jaxsafe/rejoin2d/{kind}-v0"
    words = ["pretrained/rejoin2d", "format=minari", f"kind={kind}", "episodes=2"]
    assert main([*words, "deterministic=true"]) == 0
    reference = TASKS["rejoin2d"].reference_returns
    dataset = minari.load_dataset(name)
    ends = np.array([reference["random"], reference["expert"]])
    np.testing.assert_allclose(minari.get_normalized_score(dataset, ends), [0.0, 1.0])
    spec = dataset.spec.env_spec
    assert (spec is None) if kind == "filtered" else (spec.id == TASKS["rejoin2d"].gymnasium_id)


@pytest.mark.parametrize("task", TASKS)
def test_the_references_of_a_task_are_those_that_were_measured(task: str) -> None:
    results = json.loads((BENCHMARKS / "results" / "datasets.json").read_text(encoding="utf-8"))
    measured = {
        row["kind"]: pytest.approx(row["mean_return"], abs=6e-4)
        for row in results["rows"]
        if row["task"] == task and row["kind"] != "filtered"
    }
    assert TASKS[task].reference_returns == measured


@pytest.mark.peer
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_learner_of_another_library_docks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("d3rlpy")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    import d3rlpy_docking2d as example  # pyright: ignore[reportMissingImports]

    path = tmp_path / "expert.npz"
    assert main(["run=pretrained/docking2d", "episodes=120", f"out={path}"]) == 0
    policy = example.as_policy(example.learn(load_dataset(path)[0]))
    results = jaxsafe.evaluate(jaxsafe.make("docking2d"), policy, episodes=100)
    assert results["success_rate"] >= 0.9
    assert results["episode_cost"] <= 1.0


def test_without_minari_nothing_is_collected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ConfigError, match="format: minari is not installed; pip install"):
        main(["env=docking2d", "kind=random", "format=minari", "episodes=1_000_000"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["kind=random"], "env: kind=random needs a task and no run"),
        (["kind=random", "env=docking2d", "run=pretrained/docking2d"], "needs a task and no run"),
        (["kind=random", "env=docking2d", "deterministic=true"], "deterministic"),
        ([], "run: missing; the policies"),
        (["run=docking2d"], "run: docking2d is a task"),
        (["run=pretrained/docking2d", "kind=replay"], "run: kind=replay needs the directory of a"),
        (["controller/lqr", "env=docking2d", "kind=medium"], "kind=medium needs the directory"),
        (
            ["pretrained/docking2d", "kind=filtered", "rta=none"],
            "rta: kind=filtered needs a filter",
        ),
        (["pretrained/docking2d", "episodes=0"], "episodes: expected a whole number ≥ 1"),
        (
            ["run=pretrained/docking2d", "out=data.csv"],
            r"out: expected NAME\.npz, found data\.csv",
        ),
        (["run=pretrained/docking2d", "kind=offline"], "kind: "),
    ],
)
def test_mistakes_are_named(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        main(words)
    assert "\n" not in str(caught.value)
