"""Study how run time assurance in training shapes what is learnt: 18 ways of training.

Two ways have no filter: the task as it is, and the task with one more penalty on each violating
step. In the other 16 each of four filters acts while training, and interventions are treated in
four ways: not at all, by a penalty, by learning from the control that acted, and by both. All
seeds of a way are then tested without a filter and with the one that they were trained with. What
was trained without a filter is tested with `explicit_simplex`.

    python examples/studies/training_with_rta.py tasks=docking2d,docking3d seeds=10

With `seeds=3` both tasks take less than an hour of a core, and the findings are the same.
Runs are kept in `runs`, and what is complete is not done again. The results are written to
`out`/training_with_rta.json, and drawn in `out`/training_with_rta.png. They are interquartile means
with 95 % intervals, for each task and over the seeds of all tasks.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from dot_chart import dot, dot_chart

import jaxsafe
from jaxsafe.commands import cli
from jaxsafe.commands.options import CommandOptions, Count, Directory, Option
from jaxsafe.metrics import stratified_iqm
from jaxsafe.plot.style import BLUE, ORANGE
from jaxsafe.processors.reward import VelocityConstraint
from jaxsafe.storage import provenance
from jaxsafe.storage.files import read_json, write_json, write_text

TASKS = ("docking2d", "docking3d")
FILTERS = ("explicit_simplex", "implicit_simplex", "explicit_asif", "implicit_asif")
TREATMENTS = {
    "no punishment": ("rta_training=no_punishment",),
    "punishment": ("rta_training=punishment",),
    "corrected action": ("rta_training=corrected_action",),
    "both": ("rta_training=punishment", "ppo.learns_from=actual"),
}
"""How training treats an intervention, as options of `jaxsafe train`."""

KEPT = (
    "success_rate",
    "average_return",
    "episode_length",
    "control_effort",
    "safety_violation_rate",
    "episode_safety_violation_rate",
    "intervention_rate",
)
"""Metrics of the tests that are kept, each with the value of every seed."""

SHOWN = {
    "success_rate": ("success [%]", 100.0),
    "episode_safety_violation_rate": ("violating steps [%]", 100.0),
    "control_effort": ("share of full control [%]", 100.0),
    "episode_length": ("length [s]", 1.0),
}
"""The label and the unit of each metric of the figure."""

OVER_TASKS = ("success_rate", "episode_safety_violation_rate")
"""Metrics that mean the same in each task, and so are averaged over the seeds of all tasks."""


class Way(NamedTuple):
    """A way of training."""

    filter: str
    """The preset of run time assurance, or `none`."""
    treatment: str
    """How violating steps or interventions are treated."""

    @property
    def name(self) -> str:
        """The name of its directory."""
        return f"{self.filter}-{self.treatment}".replace(" ", "_")


WAYS = (
    Way("none", "baseline"),
    Way("none", "punishment"),
    *(Way(rta, treatment) for rta in FILTERS for treatment in TREATMENTS),
)


class Options(CommandOptions):
    """The options of this study."""

    program = "python examples/studies/training_with_rta.py"

    tasks: Annotated[tuple[str, ...], Option(names=TASKS)] = TASKS
    """The tasks, with commas between them."""
    filters: Annotated[tuple[str, ...], Option(names=("none", *FILTERS))] = ("none", *FILTERS)
    """The filters to train with, with commas between them."""
    seeds: Count = 10
    """Number of seeds of each training."""
    steps: Count | None = None
    """Number of environment steps of each seed. By default it is what the recipe says."""
    episodes: Count = 200
    """Number of episodes of each seed in each test."""
    runs: Directory = "runs/training_with_rta"
    """Directory of the runs."""
    out: Directory = "."
    """Directory of the results."""


def punished(task: str, place: Path) -> Path:
    """Write the task with a penalty of 0.01 for each violating step, as much as an intervention."""
    env = jaxsafe.make(task)
    penalty = VelocityConstraint(
        name="violation",
        speed="speed",
        velocity_limit="velocity_limit",
        offset=-0.01,
        scale=0.0,
    )
    path = place / f"{task}_punished.yaml"
    write_text(path, jaxsafe.dump(env.replace(reward=(*env.reward, penalty))))
    return path


def call(command: str, *words: str) -> None:
    """Run a command of jaxsafe. This program ends if it fails."""
    subprocess.run([sys.executable, "-m", f"jaxsafe.{command}", *words], check=True)


def train(task: str, way: Way, options: Options) -> Path:
    """Train all seeds of a task in one way, and return the run directory."""
    run = Path(options.runs) / task / way.name
    if (run / "results.json").exists():
        return run
    if (run / "config.yaml").exists():
        call("train", f"resume={run}")
        return run
    words = [f"seeds={options.seeds}", f"out={run}", "eval_every=100000000", "episodes=1"]
    if options.steps is not None:
        words.append(f"steps={options.steps}")
    if way.filter != "none":
        call("train", f"env={task}", f"rta={way.filter}", *TREATMENTS[way.treatment], *words)
    elif way.treatment == "punishment":
        call("train", f"env={punished(task, run.parent)}", f"recipe={task}", *words)
    else:
        call("train", f"env={task}", *words)
    return run


def test(task: str, way: Way, rta: str, options: Options) -> dict[str, Any]:
    """Test all seeds of a way with a filter or without, and return the metrics that are kept."""
    run = train(task, way, options)
    out = run / "evaluations" / f"tested_{rta}"
    if not (out / "results.json").exists():
        words = (f"episodes={options.episodes}", "deterministic=true", f"out={out}")
        # All ways are tested in the task itself, without the terms that were added for training.
        call("evaluate", f"run={run}", f"env={task}", f"rta={rta}", *words)
    metrics = read_json(out / "results.json")["evaluation"]["deterministic"]
    return {name: metrics[name] for name in KEPT if name in metrics}


def row(task: str, way: Way, options: Options) -> dict[str, Any]:
    """Return all that is known of a way of training."""
    tested = "explicit_simplex" if way.filter == "none" else way.filter
    tests = {
        "without": test(task, way, "none", options),
        "with": test(task, way, tested, options),
    }
    training = read_json(Path(options.runs) / task / way.name / "results.json")
    return {
        "task": task,
        "filter": way.filter,
        "treatment": way.treatment,
        "steps": training["steps"],
        "wall_s": training["wall_s"],
        "steps_to_80": training["interaction_efficiency"],
        "training_cost": training.get("training_cost"),
        "tests": tests,
    }


def iqm(rows: list[dict[str, Any]], tested: str, metric: str) -> dict[str, Any]:
    """Return the interquartile mean of a metric over the seeds of some rows, with its interval.

    The bootstrap of the 95 % interval has a stratum for each row.

    Args:
        rows: the rows of one way of training, one for each task.
        tested: `with` a filter or `without`.
        metric: the name of the metric.
    """
    return stratified_iqm([row["tests"][tested][metric]["per_seed"] for row in rows])


def over_tasks(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the results of each way of training over the seeds of all tasks."""
    of_way: dict[Way, list[dict[str, Any]]] = {}
    for row in rows:
        of_way.setdefault(Way(row["filter"], row["treatment"]), []).append(row)
    return [
        {
            **way._asdict(),
            "tests": {
                tested: {metric: iqm(same, tested, metric) for metric in OVER_TASKS}
                for tested in ("without", "with")
            },
        }
        for way, same in of_way.items()
    ]


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw what the policies of each way do, with and without their filter.

    A dot is an interquartile mean over the seeds.

    Args:
        rows: the rows of the results.
        path: the file of the figure.
    """
    found = {(row["task"], Way(row["filter"], row["treatment"])): row for row in rows}
    ways = [way for way in WAYS if any(way == known for _, known in found)]
    looks = {}
    panels: dict[str, dict[str, Any]] = {label: {} for label, _ in SHOWN.values()}
    for task, colour in zip(TASKS, (BLUE, ORANGE), strict=True):
        of_task = [found.get((task, way)) for way in ways]
        if not any(of_task):
            continue
        for tested, filled in (("with", colour), ("without", "white")):
            name = f"{task}, tested {tested} a filter"
            looks[name] = {"color": colour, "markerfacecolor": filled}
            for metric, (label, unit) in SHOWN.items():
                panels[label][name] = [
                    row and dot(iqm([row], tested, metric), unit) for row in of_task
                ]
    first = [line for line, way in enumerate(ways) if line and way.filter != ways[line - 1].filter]
    dot_chart(path, [f"{way.filter}: {way.treatment}" for way in ways], panels, looks, first)


def main(argv: list[str]) -> int:
    """Run the study and return the exit code."""
    options = Options.parse(argv)
    rows = [
        row(task, way, options)
        for task in options.tasks
        for way in WAYS
        if way.filter in options.filters
    ]
    out = Path(options.out)
    write_json(
        out / "training_with_rta.json",
        {
            "command": f"{Options.program} {' '.join(argv)}".rstrip(),
            "seeds": options.seeds,
            "episodes": options.episodes,
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "rows": rows,
            "over_tasks": over_tasks(rows),
        },
    )
    draw(rows, out / "training_with_rta.png")
    return 0


if __name__ == "__main__":
    cli.run(main, Options, cli.at_once)
