"""The parts and the plan of the studies in `examples/studies`."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import image

import jaxsafe
from jaxsafe.storage.files import read_json

STUDIES = Path(__file__).parents[2] / "examples" / "studies"
PUBLISHED = STUDIES / "published_docking"

FAST = {"deputy": {"position": [100.0, 0.0], "velocity": [-0.38, 0.1]}}
"""A start at 0.393 m/s. The limit there is 0.405 m/s."""


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> None:
    for directory in (STUDIES, PUBLISHED):
        monkeypatch.syspath_prepend(str(directory))


def published(filter_type: str) -> Any:
    overrides = {} if filter_type == "none" else {"rta": {"type": filter_type}}
    return jaxsafe.make(str(PUBLISHED / "published_docking.yaml"), overrides)


def test_there_are_eighteen_ways_of_training(modules: None) -> None:
    import training_with_rta  # pyright: ignore[reportMissingImports]

    assert len({way.name for way in training_with_rta.WAYS}) == 18


def test_each_task_is_a_stratum_of_the_mean_over_tasks(modules: None) -> None:
    import training_with_rta  # pyright: ignore[reportMissingImports]

    def row(task: str, rate: float) -> dict[str, Any]:
        metrics = {name: {"per_seed": [rate] * 6} for name in training_with_rta.OVER_TASKS}
        tests = {"with": metrics, "without": metrics}
        return {"task": task, "filter": "none", "treatment": "baseline", "tests": tests}

    (way,) = training_with_rta.over_tasks([row("docking2d", 0.0), row("docking3d", 1.0)])
    # Each resample has six seeds of each task. So all have the same mean.
    expected = {"iqm": 0.5, "ci95": [0.5, 0.5]}
    assert way["tests"]["with"]["success_rate"] == expected
    assert way["tests"]["without"]["episode_safety_violation_rate"] == expected


def test_dots_at_both_ends_of_a_panel_are_whole(
    modules: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    import dot_chart  # pyright: ignore[reportMissingImports]

    drawn = []
    monkeypatch.setattr(dot_chart, "save", lambda figure, path: drawn.append(figure))
    dots = {str(value): [dot_chart.Dot(value, value, value)] for value in (3.3, 4.2)}
    dot_chart.dot_chart(Path("chart.png"), ["a way"], {"length [s]": dots}, {"3.3": {}, "4.2": {}})
    low, high = drawn[0].axes[0].get_xlim()
    assert low < 0.0
    assert high - 4.2 > 0.03 * (high - low)


def test_what_is_trained_without_a_filter_is_tested_with_one(modules: None) -> None:
    import study  # pyright: ignore[reportMissingImports]

    for name in ("no filter", "no filter and a higher penalty"):
        tests = study.tests_of(name)
        assert jaxsafe.override(published("none"), tests["with"]).rta is not None
        assert jaxsafe.override(published("none"), tests["without"]).rta is None
    assert study.tests_of("certified asif") == {"without": {"rta": None}, "with": {}}


def test_the_plant_is_that_of_the_study(modules: None) -> None:
    env = published("none")
    state, _ = jaxsafe.reset_to(env, FAST)
    _, timestep = jaxsafe.step(env, state, jnp.array([0.5, -1.0]))
    n = 0.001027
    acceleration = np.array([2 * n * 0.1 + 3 * n**2 * 100.0 + 0.5 / 12, -2 * n * -0.38 - 1 / 12])
    velocity = np.array([-0.38, 0.1]) + acceleration
    expected = [*(np.array([100.0, 0.0]) + velocity), *velocity]
    np.testing.assert_allclose(timestep.observation, expected, rtol=1e-6)


@pytest.mark.parametrize(
    "filter_type",
    [
        "published_explicit_simplex",
        "published_implicit_simplex",
        "published_explicit_asif",
        "published_implicit_asif",
    ],
)
def test_a_published_filter_acts_before_the_limit_alone(modules: None, filter_type: str) -> None:
    env = published(filter_type)
    step = jax.jit(jaxsafe.step)
    state, _ = jaxsafe.reset_to(env, FAST)
    _, timestep = step(env, state, jnp.array([-1.0, 0.0]))
    assert timestep.info.intervening
    assert float(timestep.info.control_actual[0]) > -1.0
    assert float(timestep.info.margins["velocity_limit"]) > -1e-4
    # Slowly and against the motion nothing is changed.
    state, _ = jaxsafe.reset_to(env, {"deputy": {**FAST["deputy"], "velocity": [-0.05, 0.0]}})
    _, timestep = step(env, state, jnp.array([0.1, 0.0]))
    assert not timestep.info.intervening


def test_explicit_switching_scales_the_velocity_onto_the_limit(modules: None) -> None:
    env = published("published_explicit_simplex")
    rta = env.rta
    own = (jnp.array([100.0, 0.0]), jnp.array([-0.38, 0.1]))
    control, _ = rta.act(env, *own, jnp.array([-1.0, 0.0]))
    position, velocity = rta.after(env, *own, control)
    assert abs(float(rta.h(position, velocity))) < 1e-6
    _, desired_velocity = rta.after(env, *own, jnp.array([-1.0, 0.0]))
    across = velocity[0] * desired_velocity[1] - velocity[1] * desired_velocity[0]
    assert abs(float(across)) < 1e-6


def test_the_reward_of_a_step_is_that_of_the_study(modules: None) -> None:
    env = published("none")
    state, _ = jaxsafe.reset_to(
        env, {"deputy": {"position": [1000.0, 0.0], "velocity": [0.1, 0.0]}}
    )
    _, timestep = jaxsafe.step(env, state, jnp.zeros(2))
    distance, speed = (float(timestep.info.status[name]) for name in ("distance", "speed"))
    progress = (-1.0 + 1000.0 - distance) / 2000.0
    too_slow = -0.0075 * abs(speed - (0.5 * 0.001027 * distance - 0.2))
    expected = progress + too_slow - 0.0025
    assert float(timestep.reward) == pytest.approx(expected, rel=1e-3)


def run_study(script: Path, *words: str) -> None:
    done = subprocess.run(
        [sys.executable, script, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def assert_drawn(figure: Path) -> None:
    """Require a picture with many coloured pixels."""
    pixels = image.imread(figure)[..., :3]
    coloured = pixels.max(axis=-1) - pixels.min(axis=-1) > 0.2
    assert coloured.sum() > 500


@pytest.mark.slow
def test_the_study_of_filters_in_training_runs(tmp_path: Path) -> None:
    smallest = (
        "tasks=docking2d",
        "filters=implicit_simplex",
        "seeds=2",
        "steps=3000",
        "episodes=4",
    )
    places = (f"runs={tmp_path / 'runs'}", f"out={tmp_path}")
    run_study(STUDIES / "training_with_rta.py", *smallest, *places)
    results = read_json(tmp_path / "training_with_rta.json")
    treatments = ["no punishment", "punishment", "corrected action", "both"]
    assert [row["treatment"] for row in results["rows"]] == treatments
    assert [way["treatment"] for way in results["over_tasks"]] == treatments
    for row in results["rows"]:
        for tested in ("with", "without"):
            per_seed = row["tests"][tested]["success_rate"]["per_seed"]
            assert len(per_seed) == 2
            assert all(4 * rate in range(5) for rate in per_seed)
        assert row["tests"]["with"]["episode_safety_violation_rate"]["per_seed"] == [0.0, 0.0]
        assert row["tests"]["without"]["intervention_rate"]["mean"] is None
    assert_drawn(tmp_path / "training_with_rta.png")


@pytest.mark.slow
def test_the_published_study_runs(tmp_path: Path) -> None:
    smallest = (
        "configurations=no filter,explicit switching",
        "seeds=2",
        "steps=3000",
        "episodes=4",
    )
    places = (f"runs={tmp_path / 'runs'}", f"out={tmp_path}")
    run_study(PUBLISHED / "study.py", *smallest, *places)
    rows = read_json(tmp_path / "published_docking.json")["rows"]
    assert [row["configuration"] for row in rows] == ["no filter", "explicit switching"]
    for row in rows:
        assert row["tested_with"] == "explicit switching"
        for tested in ("with", "without"):
            interventions = row["tests"][tested]["intervention_rate"]["mean"]
            assert (interventions is None) == (tested == "without")
            assert np.shape(row["each_point"][tested]["success"]) == (2, 10)
            assert len(row["test_points"][tested]["success_rate"]["per_seed"]) == 2
    assert_drawn(tmp_path / "published_docking.png")


@pytest.mark.slow
def test_a_policy_that_breaks_the_limit_is_retrained_until_it_is_proved(tmp_path: Path) -> None:
    script = STUDIES / "prove_and_retrain.py"
    box = ["position=70,106", "velocity=-0.28,0.28"]
    words = [sys.executable, script, *box, "first_steps=200000", "seed=0", f"out={tmp_path}"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    first, *_, last = read_json(tmp_path / "results.json")["rows"]
    assert first["result"] == "refuted"
    assert first["refuted"] > 0.01
    assert last["result"] == "proved"
    assert last["proved"] == pytest.approx(1.0)


@pytest.mark.thorough
def test_the_benchmark_for_verifiers_has_the_form_of_the_competition(
    modules: None, tmp_path: Path
) -> None:
    import verifier_benchmark  # pyright: ignore[reportMissingImports]

    assert verifier_benchmark.main(["tasks=docking2d", "horizons=1,2", f"out={tmp_path}"]) == 0
    lines = (tmp_path / "instances.csv").read_text().splitlines()
    assert lines == [f"onnx/docking2d_{n}.onnx,vnnlib/docking2d_{n}.vnnlib,1000" for n in (1, 2)]
    expected = {word for line in lines for word in line.split(",")[:2]}
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.glob("*/*")}
    assert written == expected
    words = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert "| docking2d, N = 2 | position in [70, 106] m, velocity in [-0.28, 0.28] m/s |" in words


def test_starts_of_the_benchmark_keep_the_speed_limit(modules: None) -> None:
    import verifier_benchmark  # pyright: ignore[reportMissingImports]

    for task, box in verifier_benchmark.BOXES.items():
        axes = jaxsafe.make(task).agent_platform.dimension
        nearest, fastest = box["position"][0] * axes**0.5, box["velocity"][1] * axes**0.5
        assert fastest < 0.2 + 2 * 0.001027 * nearest
