import hashlib
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from default_cases import thorough
from PIL import Image

import jaxsafe
from jaxsafe.commands.evaluate import MAPS, main
from jaxsafe.commands.evaluation import Film
from jaxsafe.commands.policy_options import PolicyOptions, differences
from jaxsafe.config import dump
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.evaluate import episodes as episodes_module
from jaxsafe.evaluate import evaluator as seeds_module
from jaxsafe.evaluate.episodes import run_episodes
from jaxsafe.evaluate.evaluator import Evaluator, batch_keys
from jaxsafe.plot.start_map import PANELS, seen_from_the_other, start_map
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import read_rows


def zero(key: jax.Array, observation: jax.Array) -> jax.Array:
    return jax.numpy.zeros((*observation.shape[:-1], 2))


def test_the_runs_own_results_come_out_again(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([f"run={whole}", "episodes=6", f"out={tmp_path / 'again'}"]) == 0
    again = json.loads((tmp_path / "again" / "results.json").read_text())
    own = json.loads((whole / "results.json").read_text())
    for kind in ("stochastic", "deterministic"):
        assert again["evaluation"][kind] == own["evaluation"][kind]
        metrics = own["evaluation"][kind]  # docking has one constraint
        by_name = metrics["episode_cost/velocity_limit"]["per_seed"]
        assert by_name == pytest.approx(metrics["episode_cost"]["per_seed"])
        assert max(by_name) > 0.0
    assert "success rate" in capsys.readouterr().out
    rows = [
        json.loads(line) for line in (tmp_path / "again" / "eval.jsonl").read_text().splitlines()
    ]
    assert len(rows) == 2 * 3 * 6


def test_a_policy_file_gives_the_results_of_its_seed_and_a_film(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = whole / "policy" / "seed_2.npz"
    assert main([f"run={file}", "episodes=6", "deterministic=true", "render=gif"]) == 0
    place = tmp_path / "evaluations" / "seed_2" / "last-6-seed0"
    told = capsys.readouterr().out
    assert "docking2d, preset engineered_features, ppo, rta none, 1 seed, 1,280 steps each" in told
    film = (place / "episode_deterministic.gif").relative_to(tmp_path)
    assert f"film of seed 2, deterministic, episode 0: {film}" in told
    results = json.loads((place / "results.json").read_text())
    own = json.loads((whole / "results.json").read_text())["evaluation"]["deterministic"]
    assert results["seed"] == 2
    assert results["steps"] == 1280
    for name, metric in results["evaluation"]["deterministic"].items():
        # Two programs: without optimisation they may differ in the last bit.
        expected = np.array([own[name]["per_seed"][2]], float)
        np.testing.assert_allclose(np.array(metric["per_seed"], float), expected, rtol=1e-6)
    with Image.open(place / "episode_deterministic.gif") as image:
        assert image.n_frames > 10  # type: ignore[attr-defined]
    with pytest.raises(
        ConfigError, match=r"checkpoint: .* is a single policy; leave checkpoint=best out"
    ):
        main([f"run={file}", "checkpoint=best"])


@pytest.mark.thorough
def test_a_film_shows_the_episode_that_is_asked_for(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    filmed = []

    def animate(env: Any, episode: Any, path: Path, title: str) -> Path:
        filmed.append(episode)
        return path

    monkeypatch.setattr("jaxsafe.plot.animation.animate", animate)
    words = [f"run={whole}", "episodes=6", "deterministic=false", "render=gif", "film_seed=1"]
    for which in ("worst", "failing"):
        assert main([*words, f"film={which}", f"out={tmp_path / which}"]) == 0
    rows = read_rows(tmp_path / "worst" / "eval.jsonl")
    own = [row for row in rows if row["seed"] == 1]
    worst = min(own, key=lambda row: row["return"])
    failing = next(row for row in own if not row["success"])
    told = capsys.readouterr().out
    for (_, timesteps), row in zip(filmed, (worst, failing), strict=True):
        # The sampled actions are those of the evaluation.
        assert float(timesteps.reward[1:].sum()) == pytest.approx(row["return"], rel=1e-4)
        assert len(timesteps.reward) == row["length"] + 1
        assert f"film of seed 1, stochastic, episode {row['episode']}: " in told
    for more, message in (
        (["film_seed=3"], "film_seed: expected a seed from 0 to 2, found 3"),
        (["film=last"], "film: .*'last'; choose from first, failing, violating, worst"),
    ):
        with pytest.raises(ConfigError, match=message):
            main([*words[:-1], *more])
    with pytest.raises(ConfigError, match="film: means nothing without render=gif"):
        main([f"run={whole}", "film=worst"])


def test_starts_figures_logs_maps_and_gaps_of_an_evaluation(tmp_path: Path) -> None:
    place = tmp_path / "shown"
    words = ["run=controller/pd", "env=docking1d"]
    shown = ["render=png,jsonl", "film=first,worst", "map=success,violations", "bounds=true"]
    assert main([*words, "episodes=120", f"out={place}", *shown]) == 0
    rows = read_rows(place / "eval.jsonl")
    worst = min(rows, key=lambda row: row["return"])
    steps = read_rows(place / "episode_deterministic_worst.jsonl")
    assert len(steps) == worst["length"] + 1
    assert sum(step["reward"] for step in steps[1:]) == pytest.approx(worst["return"], rel=1e-3)
    for name in ("episode_deterministic_first.png", "map_deterministic.png"):
        with Image.open(place / name) as image:
            assert min(image.size) > 200
    # An evaluation from these starts is the same evaluation.
    cases = f"cases={place / 'starts.csv'}"
    assert main([*words, f"out={tmp_path / 'again'}", cases]) == 0
    again = read_rows(tmp_path / "again" / "eval.jsonl")
    assert [row["length"] for row in again] == [row["length"] for row in rows]
    assert "return_bound" not in again[0]
    metrics = json.loads((place / "results.json").read_text())["evaluation"]["deterministic"]
    for name, sign in (("return", -1.0), ("length", 1.0), ("delta_v", 1.0)):
        gaps = [sign * (row[name] - row[f"{name}_bound"]) for row in rows]
        assert metrics[f"{name}_gap"]["mean"] == pytest.approx(np.mean(gaps), rel=1e-3)
        assert min(gaps) > -1e-3
        assert len(set(gaps)) > 3
    assert metrics["length_gap"]["mean"] < 30.0


def test_all_failures_of_all_seeds_are_logged_at_once(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "logged"
    words = [f"run={whole}", "episodes=6", "deterministic=false", f"out={place}"]
    assert main([*words, "log=failing,violating"]) == 0
    rows = {(row["seed"], row["episode"]): row for row in read_rows(place / "eval.jsonl")}
    chosen = {
        number for number, row in rows.items() if not row["success"] or row["violating_steps"] > 0
    }
    logged: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for step in read_rows(place / "episodes.jsonl"):
        assert (step["kind"], step["final"], step["step"]) == ("stochastic", True, 1280)
        logged.setdefault((step["seed"], step["episode"]), []).append(step)
    assert {seed for seed, _ in chosen} == {0, 1, 2}
    assert list(logged) == sorted(chosen)
    for number, steps in logged.items():
        assert len(steps) == rows[number]["length"] + 1
        assert steps[-1]["outcome"] == rows[number]["outcome"]
        total = sum(step["reward"] for step in steps[1:])
        assert total == pytest.approx(rows[number]["return"], rel=1e-3)
    told = capsys.readouterr().out
    assert f"stochastic episodes, failing or violating: {len(chosen)} of 18: {place}" in told


def test_a_hidden_seed_is_shown_nowhere_and_can_be_checked_later(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = tmp_path / "secret.json"
    words = ["run=controller/pd", "env=docking1d", "episodes=20"]
    for place in ("hidden", "again"):
        assert main([*words, f"hidden_seed={secret}", f"out={tmp_path / place}"]) == 0
    seed, salt = json.loads(secret.read_text()).values()
    assert secret.stat().st_mode & 0o077 == 0
    assert [file.name for file in (tmp_path / "hidden").iterdir()] == ["results.json"]
    results = json.loads((tmp_path / "hidden" / "results.json").read_text())
    assert results["evaluation_seed"] is None
    text = f"{seed}:{salt}".encode()
    assert results["seed_commitment"] == hashlib.sha256(text).hexdigest()
    assert f"hidden seed: {results['seed_commitment']}" in capsys.readouterr().out
    again = json.loads((tmp_path / "again" / "results.json").read_text())
    assert again["evaluation"] == results["evaluation"]
    # Once the seed is shown, everybody can measure the same numbers.
    assert main([*words, f"seed={seed}", f"out={tmp_path / 'shown'}"]) == 0
    shown = json.loads((tmp_path / "shown" / "results.json").read_text())
    assert shown["evaluation"] == results["evaluation"]
    other = dict(zip(("seed", "salt"), (seed ^ 1, salt), strict=True))
    for content, message in (
        ({**other, "seed": -1}, "seed: expected a whole number from 0 to 2,147,483,647, found -1"),
        ({**other, "salt": "short"}, "salt: expected at least 32 letters, found 'short'"),
    ):
        secret.write_text(json.dumps(content))
        with pytest.raises(ConfigError, match=f"secret.json: {message}"):
            main([*words, f"hidden_seed={secret}", f"out={tmp_path / 'wrong'}"])
    for option in ("seed=1", "map=success", "render=png", "log=all"):
        with pytest.raises(ConfigError, match="means nothing beside hidden_seed"):
            main([*words, f"hidden_seed={secret}", option])


def test_a_map_has_x_along_the_heading_of_the_other_craft() -> None:
    env = jaxsafe.make("rejoin2d")
    start = {
        "lead": {"position": [5000.0, 5000.0], "heading": np.pi / 2, "speed": 250.0},
        "wingman": {"position": [5000.0, 11000.0], "heading": 0.0, "speed": 300.0},
    }
    state = jax.tree.map(lambda leaf: leaf[None], jaxsafe.reset_to(env, start)[0])
    np.testing.assert_allclose(seen_from_the_other(env, state), [[6000.0, 0.0]], atol=0.1)
    panels = {name: np.ones(1) for name in MAPS}
    assert list(PANELS) == list(MAPS)
    assert len(start_map(env, state, panels, "title").axes) == 2 * len(panels)


def test_a_film_of_what_did_not_happen_is_that_of_the_first_episode() -> None:
    env = jaxsafe.make("docking2d")
    flags = np.array([1, 1])
    sums: Any = SimpleNamespace(outcome=flags, violating_steps=np.zeros(2), episode_return=flags)
    for which in ("failing", "violating"):
        assert Film.choose(which, sums, env) is None
    assert Film.choose("first", sums, env) == 0


def test_a_film_is_of_the_first_seed_that_has_such_an_episode() -> None:
    env = jaxsafe.make("docking2d")
    success, crash = (env.outcomes.index(name) for name in ("success", "crash"))
    outcome = np.full((4, 3), success)
    outcome[1, 1] = outcome[2, 2] = outcome[3, 0] = crash
    sums: Any = run_episodes(env, zero, jax.random.key(0), 12)
    sums = jax.tree.map(lambda x: np.asarray(x).reshape(4, 3), sums)
    sums = sums.replace(outcome=outcome, violating_steps=np.zeros((4, 3)))
    assert Film(["gif"]).find("failing", sums, env, first=5) == (1, 1, "")
    # A policy that is not finite always fails.
    assert Film(["gif"]).find("failing", sums, env, first=5, left_out=[1]) == (2, 2, "")
    assert Film(["gif"], seed=8).find("failing", sums, env, first=5) == (3, 0, "")
    nowhere = (0, 0, "no violating episode of any seed; the first one is shown")
    assert Film(["gif"]).find("violating", sums, env, first=5) == nowhere
    there = (0, 0, "no failing episode of seed 5, but seed 6 has one; the first one is shown")
    assert Film(["gif"], seed=5).find("failing", sums, env, first=5) == there


@pytest.mark.thorough
def test_evaluations_get_directories_of_their_own(whole: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    before = (run / "results.json").read_bytes()
    for _ in range(2):
        assert main([f"run={run}", "episodes=2", "deterministic=true", "checkpoint=best"]) == 0
    changes = ["env.deputy.mass=24", "env.deputy.start.position.distance=100,110"]
    assert main([f"run={run}", "episodes=2", "checkpoint=640", *changes, "seed=3"]) == 0
    names = sorted(path.name for path in (run / "evaluations").iterdir())
    changed = "640-2-seed3-deputy.mass=24-deputy.start.position.distance=100_110"
    assert names == [changed, "best-2-seed0", "best-2-seed0-2"]
    assert (run / "results.json").read_bytes() == before
    results = json.loads((run / "evaluations" / changed / "results.json").read_text())
    assert results["changes"]["deputy.mass"] == 24
    assert (results["algorithm"], results["rta"]) == ("ppo", "none")
    assert results["steps"] == 640
    with pytest.raises(ConfigError, match="never overwritten"):
        main([f"run={run}", "episodes=2", f"out={run / 'evaluations' / 'best-2-seed0'}"])


def test_a_checkpoint_that_is_not_there_is_told_with_those_that_are(whole: Path) -> None:
    with pytest.raises(
        ConfigError,
        match=r"checkpoint: no step 641 in .*\. Did you mean '640'\? Choose from 320, 640, 960",
    ):
        main([f"run={whole}", "checkpoint=641"])
    with pytest.raises(
        ConfigError,
        match=r"checkpoint: found 'lst'\. Did you mean 'last'\? Choose from last, best, 320",
    ):
        main([f"run={whole}", "checkpoint=lst"])


@pytest.mark.thorough
@pytest.mark.parametrize("damage", ["cut", "garbage", "gone"])
def test_a_corrupt_checkpoint_is_told_in_one_line(whole: Path, tmp_path: Path, damage: str) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    for path in (run / "checkpoints" / "1280" / "state").rglob("*"):
        if path.is_file() and damage == "gone":
            path.unlink()
        elif path.is_file():
            path.write_bytes(
                path.read_bytes()[: path.stat().st_size // 2] if damage == "cut" else b"garbage"
            )
    with pytest.raises(ConfigError, match=r"1280: checkpoint cannot be read: ") as error:
        main([f"run={run}"])
    assert "\n" not in str(error.value)


@jax.tree_util.register_static
class Idle:
    """A policy that never pushes."""

    def policy(self, env: Any, params: Any, deterministic: Any) -> Any:
        return zero


@pytest.mark.thorough
@pytest.mark.parametrize(("timeout", "piece"), [thorough(30.0, 256), (30.0, 7), thorough(1e10, 7)])
def test_recorded_episodes_are_those_that_were_evaluated(
    timeout: float, piece: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(seeds_module, "RECORDED_STEPS_PER_CALL", piece)
    ends = {
        "terminal.timeout.limit": timeout,
        "terminal.distance.limit": 150.2 if timeout > 30.0 else 40e3,
    }
    env = jaxsafe.make("docking2d", {**ends, "deputy.start.position.distance": [150.0, 150.0]})
    monkeypatch.setattr(episodes_module, "MAX_STEPS", 40)
    episodes = run_episodes(env, zero, next(batch_keys(3, 1)), 10)
    for i, (states, timesteps) in enumerate(
        Evaluator(SeedMapper(1), env, Idle()).episodes({}, 3, 3)
    ):
        last = len(timesteps.reward) - 1
        assert last == int(episodes.length[i])
        assert int(timesteps.info.outcome[last]) == int(episodes.outcome[i])
        assert float(timesteps.reward[1:].sum()) == pytest.approx(
            float(episodes.episode_return[i]), rel=1e-5
        )
        np.testing.assert_allclose(states.sim.time, np.arange(last + 1))


def test_a_timeout_that_means_none_leaves_episodes_as_they_are() -> None:
    ends = {"deputy.start.position.distance": [150.0, 150.0], "terminal.distance.limit": 150.2}
    run = jax.jit(lambda env: run_episodes(env, zero, jax.random.key(1), 8))
    usual = run(jaxsafe.make("docking2d", {**ends, "terminal.timeout.limit": 50_000.0}))
    assert (np.asarray(usual.length) < 50_000).all()
    for timeout in (1e6, 1e7, 2.0**31, 1e10, 1e38):
        late = run(jaxsafe.make("docking2d", {**ends, "terminal.timeout.limit": timeout}))
        np.testing.assert_array_equal(late.length, usual.length)
        np.testing.assert_array_equal(late.outcome, usual.outcome)


@pytest.mark.thorough
def test_an_episode_that_does_not_end_is_given_up_and_that_is_told(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(episodes_module, "MAX_STEPS", 45)
    words = [
        f"run={whole / 'policy' / 'seed_0.npz'}",
        "episodes=2",
        "env.terminal.timeout.limit=1e10",
    ]
    assert main([*words, f"out={tmp_path / 'x'}"]) == 0
    told = (
        "episodes still running after 45 steps, given up and counted as failures: 2"
        " stochastic, 2 deterministic"
    )
    assert told in capsys.readouterr().out
    results = json.loads((tmp_path / "x" / "results.json").read_text())
    assert results["given_up"] == {"after_steps": 45, "stochastic": 2, "deterministic": 2}
    assert (
        json.loads((tmp_path / "x" / "eval.jsonl").read_text().splitlines()[0])["outcome"]
        == "running"
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("overrides", "steps"),
    [
        (
            {"dt": 0.3, "terminal.timeout.limit": 9.0},
            31,
        ),  # 9 / 0.3 is less than 30 in single precision
        ({"terminal.timeout.limit": 9.0, "randomize": {"dt": [0.5, 1.5]}}, 19),
        thorough(
            {"terminal.timeout.limit": 9.0, "randomize": {"terminal.timeout.limit": [5.0, 20.0]}},
            21,
        ),
    ],
)
def test_no_episode_is_cut_before_its_timeout(overrides: dict[str, Any], steps: int) -> None:
    env = jaxsafe.make("docking2d", overrides)
    episodes = run_episodes(env, zero, jax.random.key(0), 64)
    assert {env.outcomes[outcome] for outcome in np.asarray(episodes.outcome)} == {"timeout"}
    assert int(episodes.length.max()) <= steps


def test_a_change_of_the_observation_is_refused(whole: Path) -> None:
    with pytest.raises(ConfigError, match="env: the change gives observation_names"):
        main([f"run={whole}", "env.observation=[velocity,position,speed,velocity_limit]"])


def chosen(*words: str) -> PolicyOptions:
    return PolicyOptions.parse(["run=x", *words])


def test_a_policy_acts_in_another_environment_that_fits_it(tmp_path: Path) -> None:
    own = jaxsafe.make("docking2d", {"deputy.mass": 14.0})
    name = "docking2d"
    file = tmp_path / "mine.yaml"
    file.write_text(
        dump(jaxsafe.make("docking2d", {"deputy.mass": 24.0, "terminal.timeout.limit": 100.0}))
    )
    other = chosen(f"env={file}", "env.deputy.mass=30").change(own, name)
    assert float(other.platform("deputy").mass) == 30.0  # type: ignore[attr-defined]
    assert float(other.terminal[-1].limit) == 100.0  # type: ignore[attr-defined]
    assert dump(chosen("env=docking2d").change(own, name)) == dump(jaxsafe.make("docking2d"))
    assert dump(chosen().change(own, name)) == dump(own)
    released = chosen("variant=released").change(own, name)
    assert float(released.platform("deputy").mass) == 14.0  # type: ignore[attr-defined]
    assert released.outcomes == jaxsafe.make("docking2d", variant="released").outcomes


@pytest.mark.parametrize(
    ("actions", "words", "message"),
    [
        (
            "continuous",
            ["env=docking3d"],
            r"env: docking3d has observation_names .*, the policies of x have ",
        ),
        ("continuous", ["env=rejoin2d"], r"env: rejoin2d has observation_names"),
        (
            "continuous",
            ["env=docking2d_oriented"],
            r"env: docking2d_oriented has observation_names",
        ),
        (
            "continuous",
            ["env.observation=[velocity,position,speed,velocity_limit]"],
            "the change gives observation_names",
        ),
        ("continuous", ["env=FILE"], r"env: .*mine\.yaml has observation_names"),
        (
            "continuous",
            ["actions=discrete"],
            r"the change gives num_action_points \(11, 11\).*; give actions=continuous$",
        ),
        (
            "discrete",
            ["env=docking2d"],
            r"has num_action_points \(\), .* \(11, 11\); give actions=discrete$",
        ),
        (
            "discrete",
            ["env.deputy.controller.actuators.thrust_x.points=5"],
            r"num_action_points \(5, 11\), .*11\)$",
        ),
        (
            "discrete",
            ["actions=discret"],
            "actions: unknown kind 'discret'.*Did you mean 'discrete'",
        ),
        ("continuous", ["env=docking4d"], "env: unknown task 'docking4d'"),
        ("continuous", ["env=none.yaml"], r"none\.yaml"),
        ("continuous", ["variant=code"], "variant: unknown variant 'code'"),
        (
            "continuous",
            ["rta=safe"],
            r"rta: docking2d has no preset 'safe'; choose from none, .*, FILE\.yaml",
        ),
        ("continuous", ["rta=none.yaml"], r"none\.yaml"),
    ],
)
def test_an_environment_that_does_not_fit_is_refused(
    actions: Any, words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    other_order = {"observation": ["velocity", "position", "speed", "velocity_limit"]}
    (tmp_path / "mine.yaml").write_text(dump(jaxsafe.make("docking2d", other_order)))
    words = [word.replace("FILE", str(tmp_path / "mine.yaml")) for word in words]
    with pytest.raises(ConfigError, match=message) as raised:
        chosen(*words).change(jaxsafe.make("docking2d", actions=actions), "docking2d")
    assert "\n" not in str(raised.value)


def test_a_discrete_policy_is_evaluated_where_actions_are_discrete() -> None:
    own = jaxsafe.make("docking2d", actions="discrete")
    env = chosen("env=docking2d", "actions=discrete", "rta=explicit_simplex").change(
        own, "docking2d"
    )
    assert env.num_action_points == (11, 11)
    assert env.rta is not None


def test_what_is_defined_otherwise_than_in_training_is_told() -> None:
    own = jaxsafe.make("docking2d")
    assert (
        differences(own, chosen("env.deputy.mass=24", "rta=default").change(own, "docking2d")) == ""
    )
    words = ["env.observation.position.scale=10", "env.deputy.controller.actuators.thrust_y.high=2"]
    told = differences(own, chosen(*words).change(own, "docking2d"))
    assert told == "defined otherwise than in training: observation position, actuator thrust_y"


@pytest.mark.thorough
def test_another_environment_is_the_change_that_makes_it(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        dump(jaxsafe.make("docking2d", {"terminal.timeout.limit": 30.0, "deputy.mass": 24.0}))
    )
    words = [f"run={whole / 'policy' / 'seed_1.npz'}", "episodes=3", "deterministic=true"]
    assert main([*words, f"env={file}", f"out={tmp_path / 'a'}"]) == 0
    assert (
        main(
            [*words, "env.deputy.mass=24", "env.terminal.timeout.limit=30", f"out={tmp_path / 'b'}"]
        )
        == 0
    )
    a, b = (json.loads((tmp_path / name / "results.json").read_text()) for name in "ab")
    assert a["evaluation"] == b["evaluation"]
    assert a["changes"] == {"env": str(file)}


def test_every_episode_is_counted_once_however_short() -> None:
    # A biased evaluation would run the same number of steps in each environment of the batch. So it
    # would see more of the short episodes.
    env = jaxsafe.make(
        "docking2d", {"terminal.timeout.limit": 200.0, "terminal.distance.limit": 130.0}
    )
    episodes = run_episodes(env, zero, jax.random.key(0), 500)
    outcomes = np.asarray(episodes.outcome)
    start = jax.vmap(lambda key: env.reset(key)[0].sim.status["docking_distance"])(
        jax.random.split(jax.random.split(jax.random.key(0))[0], 500)
    )
    assert (outcomes > 0).all()
    beyond = np.asarray(start) > 131.0
    assert (outcomes[beyond] == env.outcomes.index("distance")).mean() > 0.9
    assert (np.asarray(episodes.length) <= 201).all()
