"""Measure policies from far away: docking from 100 m to 10 km, rejoin from up to 100,000 ft.

Each docking task is trained by its recipe `wide`, and each rejoin task by its usual one, with ten
seeds. Then the policies of all seeds fly the task from several distances, with sampled actions and
with the most probable ones. They are scored by the reward of the task, and not by that of the
recipe. A classical controller flies the same starts.

Results are written to `benchmarks/results/far_starts.json`, and the table of docs/far_starts.md is
printed:

    python benchmarks/far_starts.py [tasks=docking2d,…] [seeds=10] [episodes=200] [out=DIRECTORY]

With `out` the runs are kept, and what is there already is not trained or tested again.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from isolated import command, several, words

from jaxsafe.storage.files import read_json, write_json

OUT = Path(__file__).parent / "results" / "far_starts.json"


class Start(NamedTuple):
    """Starts at a distance.

    Attributes:
        name: the distance with its unit, as the table has it.
        interval: least and greatest distance, in the unit of the task.
        changes: overrides that the flight from there needs.
    """

    name: str
    interval: tuple[float, float]
    changes: tuple[str, ...] = ()


class Study(NamedTuple):
    """What is trained and where it starts.

    Attributes:
        recipe: the recipe that trains the policies.
        controller: the classical controller that flies the same starts.
        body: the body that starts at the distance.
        starts: the starts of the tests.
    """

    recipe: str
    controller: str
    body: str
    starts: tuple[Start, ...]


DOCKING = Study(
    "wide",
    "pd",
    "deputy",
    (
        Start("100 to 150 m", (100.0, 150.0)),
        Start("1 km", (1000.0, 1000.0)),
        # The flight at the speed limit takes 2,257 s.
        Start("10 km", (10000.0, 10000.0), ("env.terminal.timeout.limit=6000",)),
    ),
)
FAR_WINGMAN = ("env.terminal.timeout.limit=4000", "env.terminal.distance.limit=200000")
REJOIN = Study(
    "engineered_features",
    "pursuit",
    "wingman",
    (
        Start("5,000 to 10,000 ft", (5000.0, 10000.0)),
        Start("25,000 to 50,000 ft", (25000.0, 50000.0), FAR_WINGMAN),
        Start("50,000 to 100,000 ft", (50000.0, 100000.0), FAR_WINGMAN),
    ),
)
STUDIES = {
    "docking2d": DOCKING,
    "docking3d": DOCKING,
    "docking2d_oriented": DOCKING._replace(controller="align"),
    "rejoin2d": REJOIN,
    "rejoin3d": REJOIN,
}
"""The study of each task."""

KEPT = (
    "success_rate",
    "average_return",
    "return_gap",
    "episode_length",
    "control_usage_l1",
    "safety_violation_rate",
    "episode_safety_violation_rate",
)


def measure(task: str, place: Path, seeds: int, episodes: int) -> list[dict[str, Any]]:
    """Train a task by its recipe, and return a row for each start and policy.

    Args:
        task: the task.
        place: the directory of the runs.
        seeds: number of seeds.
        episodes: episodes of each test of each seed.
    """
    study = STUDIES[task]
    run = place / task
    if not (run / "results.json").exists():
        rest = ("eval_every=100000000", "episodes=1", f"out={run}")
        command("train", f"env={task}", f"preset={study.recipe}", f"seeds={seeds}", *rest)
    training = read_json(run / "results.json")
    rows = []
    for start in study.starts:
        low, high = start.interval
        changes = (
            f"env={task}",
            f"env.{study.body}.start.position.distance=[{low},{high}]",
            *start.changes,
        )
        for policy, flown in (("ppo", run), (study.controller, f"controller/{study.controller}")):
            tested = place / f"{task}_{policy}_from_{high:.0f}"
            if not (tested / "results.json").exists():
                given = (f"run={flown}", *changes, f"episodes={episodes}", f"out={tested}")
                command("evaluate", *given, "bounds=true")
            learnt = {name: training[name] for name in ("steps", "wall_s")}
            rows.append(
                {
                    "task": task,
                    "policy": policy,
                    "start": start.name,
                    "changes": changes,
                    **(learnt if policy == "ppo" else {}),
                    "evaluation": {
                        kind: {name: metrics[name] for name in KEPT}
                        for kind, metrics in read_json(tested / "results.json")[
                            "evaluation"
                        ].items()
                    },
                }
            )
    return rows


def main() -> None:
    """Run the command."""
    options = words(tasks=",".join(STUDIES), seeds="10", episodes="200", out="")
    tasks = several("tasks", options["tasks"], STUDIES)
    counts = {name: int(options[name]) for name in ("seeds", "episodes")}
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(options["out"] or temporary).resolve()
        place.mkdir(parents=True, exist_ok=True)
        rows = [row for task in tasks for row in measure(task, place, **counts)]
    import tables
    from machine import about

    given = " ".join(f"{name}={options[name]}" for name in ("tasks", "seeds", "episodes"))
    results = {
        "command": f"python benchmarks/far_starts.py {given}",
        **counts,
        **about(__file__),
        "rows": rows,
    }
    write_json(OUT, results)
    print(tables.far_starts(results))


if __name__ == "__main__":
    main()
