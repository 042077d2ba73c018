"""Repeat a public study of run time assurance in docking, and add certified filters to it.

Six configurations are those of the study: no filter, no filter with a higher penalty, and four
filters. Beside them stand the certified Simplex and ASIF of jaxsafe. All seeds of a configuration
are trained in the task of `published_docking.yaml`, and tested with their filter and without it:
from random starts, and from the ten test points of the study. What was trained without a filter is
tested with the explicit switching of the study.

    cd examples/studies/published_docking
    python study.py seeds=5

Runs are kept in `runs`, and what is complete is not done again. The results are written to
`out`/published_docking.json, and drawn in `out`/published_docking.png.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxsafe
from jaxsafe.commands import cli
from jaxsafe.commands.options import CommandOptions, Count, Directory, Option
from jaxsafe.metrics import over_seeds
from jaxsafe.plot.style import BLUE, GREEN
from jaxsafe.runs import Run
from jaxsafe.storage import provenance
from jaxsafe.storage.files import read_json, write_json

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent))
from dot_chart import dot, dot_chart  # noqa: E402

TASK = HERE / "published_docking.yaml"

BRAKING = "constraints: [velocity_limit], margin: 0.00025, backups: [{type: brake, name: brake}]"

# The proof of the certified filters is about the exact motion over a step. So they are trained and
# tested with the plant of docking2d, whose mass and orbit are the same.
CERTIFIED = ("env.deputy.type=spacecraft",)

FILTERS: Mapping[str, tuple[str, ...]] = {
    "explicit switching": ("env.rta={type: published_explicit_simplex}",),
    "implicit switching": ("env.rta={type: published_implicit_simplex}",),
    "explicit optimisation": ("env.rta={type: published_explicit_asif}",),
    "implicit optimisation": ("env.rta={type: published_implicit_asif}",),
    "certified simplex": (*CERTIFIED, f"env.rta={{type: simplex, {BRAKING}}}"),
    "certified asif": (*CERTIFIED, f"env.rta={{type: discrete_asif, {BRAKING}}}"),
}
"""The options that put each filter into the task."""

HIGHER_PENALTY = (
    "env.reward.too_fast.scale=-0.0035",
    "env.reward.near_rest.value=-0.00375",
)
CONFIGURATIONS: Mapping[str, tuple[str, ...]] = {
    "no filter": ("env.reward.near_rest.value=0",),
    "no filter and a higher penalty": HIGHER_PENALTY,
    **FILTERS,
}
"""The options of each training. The task as written has the penalties of the filters."""

FILTER_OF_UNFILTERED = {"type": "published_explicit_simplex"}
"""The filter in the tests of what was trained without one. It needs no other plant."""

TEST_POINTS = {
    "distance": [100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0, 900.0, 1000.0],
    "angle": [1.57, 5.5, 4.71, 2.36, 3.93, 0.79, 1.18, 3.14, 4.32, 0.0],
    "velocity_x": [-0.1, -0.25, 0.25, 0.1, -0.5, 0.5, -0.75, 0.75, -1.0, 1.0],
    "velocity_y": [0.1, -0.1, -0.25, 0.25, 0.5, -0.5, -0.75, 1.0, 0.75, -1.0],
}
TEST_FUEL = 750.0
"""The fuel of a test [N·s]."""

KEPT = (
    "success_rate",
    "average_return",
    "episode_length",
    "control_usage_l1",
    "safety_violation_rate",
    "episode_safety_violation_rate",
    "episode_violation_severity_max",
    "intervention_rate",
)

SHOWN = {
    "success_rate": ("docked [%]", 100.0),
    "episode_safety_violation_rate": ("violating steps [%]", 100.0),
    "episode_length": ("length [s]", 1.0),
    "control_usage_l1": ("Δv [m/s]", 1.0),
}
"""The label and the unit of each metric that is drawn."""


class Options(CommandOptions):
    """The options of this study."""

    program = "python study.py"

    configurations: Annotated[tuple[str, ...], Option(names=tuple(CONFIGURATIONS))] = tuple(
        CONFIGURATIONS
    )
    """The configurations, with commas between them."""
    seeds: Count = 5
    """Number of seeds of each training."""
    preset: Annotated[str, Option(names=("features", "published"))] = "features"
    """The recipe of the training."""
    steps: Count | None = None
    """Number of environment steps of each seed. By default it is what the recipe says."""
    episodes: Count = 200
    """Number of episodes of each seed in each test from random starts."""
    runs: Directory = "runs/published_docking"
    """Directory of the runs."""
    out: Directory = "."
    """Directory of the results."""


def call(command: str, *words: str) -> None:
    """Run a command of jaxsafe in the directory of the parts. This program ends if it fails."""
    subprocess.run([sys.executable, "-m", f"jaxsafe.{command}", *words], check=True, cwd=HERE)


def train(name: str, options: Options) -> Path:
    """Train all seeds of a configuration, and return the run directory."""
    run = (Path(options.runs) / name.replace(" ", "_")).resolve()
    if (run / "results.json").exists():
        return run
    if (run / "config.yaml").exists():
        call("train", f"resume={run}")
        return run
    words = [f"seeds={options.seeds}", f"preset={options.preset}", f"out={run}", "episodes=1"]
    if options.steps is not None:
        words.append(f"steps={options.steps}")
    call("train", f"env={TASK}", *CONFIGURATIONS[name], *words, "eval_every=1000000000")
    return run


def tests_of(name: str) -> dict[str, dict[str, Any]]:
    """Return what each test of a configuration changes in the environment of its training."""
    own = {} if name in FILTERS else {"rta": FILTER_OF_UNFILTERED}
    return {"without": {"rta": None}, "with": own}


def test(run: Path, key: str, changes: Mapping[str, Any], options: Options) -> dict[str, Any]:
    """Test all seeds of a run from random starts, and return the metrics that are kept.

    Args:
        run: the run directory.
        key: the name of the test.
        changes: what the test changes in the environment, by path.
        options: the options of the study.
    """
    out = run / "evaluations" / key
    if not (out / "results.json").exists():
        words = (f"episodes={options.episodes}", "deterministic=true", f"out={out}")
        changed = (f"env.{path}={json.dumps(value)}" for path, value in changes.items())
        call("evaluate", f"run={run}", *words, *changed)
    metrics = read_json(out / "results.json")["evaluation"]["deterministic"]
    return {name: metrics[name] for name in KEPT if name in metrics}


def test_points(run: Run, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Fly all seeds from the ten test points, and return what happened by seed and point.

    Args:
        run: the run.
        changes: what the test changes in the environment, by path.
    """
    mass = float(run.env.agent_platform.mass)
    env = jaxsafe.override(run.env, {"terminal.fuel.limit": TEST_FUEL / mass, **changes})
    # The bounds of a test are 1.5 times its distance. They are numbers of the environment, so one
    # compiled program flies all points.
    envs = [
        jaxsafe.override(env, {"regions.arena.size": [3.0 * distance, 3.0 * distance]})
        for distance in TEST_POINTS["distance"]
    ]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *envs)
    distance, angle, velocity_x, velocity_y = map(jnp.array, TEST_POINTS.values())
    position = distance[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    velocity = jnp.stack([velocity_x, velocity_y], axis=-1)
    key = jax.random.key(0)

    def flights(policy: Any) -> dict[str, Any]:
        def flight(env: Any, position: jax.Array, velocity: jax.Array) -> dict[str, jax.Array]:
            start = {"deputy": {"position": position, "velocity": velocity}}
            state, timestep = jaxsafe.reset_to(env, start)
            nothing = {"steps": 0, "violating": 0, "delta_v": 0.0, "outcome": 0, "ended": False}

            def one_step(carry: Any, _: None) -> tuple[Any, None]:
                state, timestep, seen = carry
                state, timestep = jaxsafe.step(env, state, policy(key, timestep.observation))
                flying = ~seen["ended"]
                used = timestep.info.status["delta_v_l1"]
                seen = {
                    "steps": seen["steps"] + flying,
                    "violating": seen["violating"] + (flying & (timestep.cost > 0.0)),
                    "delta_v": seen["delta_v"] + jnp.where(flying, used, 0.0),
                    "outcome": jnp.where(flying, timestep.info.outcome, seen["outcome"]),
                    "ended": seen["ended"] | timestep.terminated | timestep.truncated,
                }
                return (state, timestep, seen), None

            limit = 4001
            seen = jax.tree.map(jnp.asarray, nothing)
            return jax.lax.scan(one_step, (state, timestep, seen), length=limit)[0][2]

        return jax.jit(jax.vmap(flight))(stacked, position, velocity)

    found = [jax.device_get(flights(run.policy(seed))) for seed in run.seeds]
    return {
        "success": [env.succeeded(one["outcome"]).tolist() for one in found],
        "violating_steps": [one["violating"].tolist() for one in found],
        "steps": [one["steps"].tolist() for one in found],
        "delta_v": [one["delta_v"].tolist() for one in found],
    }


def over_points(points: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metrics of the flights from the test points, with a value for each seed."""
    success, violating, steps, delta_v = (
        np.asarray(points[name], float)
        for name in ("success", "violating_steps", "steps", "delta_v")
    )
    per_seed = {
        "success_rate": success.mean(axis=1),
        "episode_safety_violation_rate": (violating / steps).mean(axis=1),
        "episode_length": steps.mean(axis=1),
        "control_usage_l1": delta_v.mean(axis=1),
    }
    return {name: over_seeds(values.tolist()) for name, values in per_seed.items()}


def row(name: str, options: Options) -> dict[str, Any]:
    """Return all that is known of a configuration."""
    path = train(name, options)
    run = jaxsafe.open_run(path)
    changes = tests_of(name)
    points = {key: test_points(run, changed) for key, changed in changes.items()}
    return {
        "configuration": name,
        "tested_with": name if name in FILTERS else "explicit switching",
        "steps": run.results["steps"],
        "wall_s": run.results["wall_s"],
        "steps_to_80": run.results["interaction_efficiency"],
        "training_cost": run.results["training_cost"],
        "tests": {key: test(path, key, changed, options) for key, changed in changes.items()},
        "test_points": {key: over_points(found) for key, found in points.items()},
        "each_point": points,
    }


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw what the policies of each configuration do, with a filter and without.

    Args:
        rows: the rows of the results.
        path: the file of the figure.
    """
    looks = {
        "tested with a filter": {"color": BLUE},
        "tested without a filter": {"color": BLUE, "markerfacecolor": "white"},
        "from the ten test points, with a filter": {"color": GREEN, "marker": "s"},
        "from the ten test points, without a filter": {
            "color": GREEN,
            "marker": "s",
            "markerfacecolor": "white",
        },
    }
    panels: dict[str, dict[str, Any]] = {label: {} for label, _ in SHOWN.values()}
    series = [(source, key) for source in ("tests", "test_points") for key in ("with", "without")]
    for name, (source, key) in zip(looks, series, strict=True):
        for metric, (label, unit) in SHOWN.items():
            panels[label][name] = [dot(row[source][key][metric], unit) for row in rows]
    dot_chart(path, [row["configuration"] for row in rows], panels, looks)


def main(argv: list[str]) -> int:
    """Run the study and return the exit code."""
    options = Options.parse(argv)
    sys.path.insert(0, str(HERE))  # the runs name the module of the parts
    results = {
        "command": f"{Options.program} {' '.join(argv)}".rstrip(),
        "seeds": options.seeds,
        "episodes": options.episodes,
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "rows": [row(name, options) for name in options.configurations],
    }
    write_json(Path(options.out) / "published_docking.json", results)
    draw(results["rows"], Path(options.out) / "published_docking.png")
    return 0


if __name__ == "__main__":
    cli.run(main, Options, cli.at_once)
