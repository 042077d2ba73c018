"""Measure policies that learn to dock from 100 m to 10 km.

Each docking task is trained by its recipe `wide`, with ten seeds. Then the policies of all seeds
fly the task from three distances, with sampled actions and with the most probable ones. They are
scored by the reward of the task, and not by that of the recipe. The time limit is that of the task,
and from 10 km that of the recipe.

Results are written to `benchmarks/results/far_starts.json`, and the table of docs/far_starts.md is
printed:

    python benchmarks/far_starts.py [tasks=docking2d,…] [seeds=10] [episodes=200] [out=DIRECTORY]

With `out` the runs are kept, and what is there already is not trained or tested again.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from isolated import command, several, words

import jaxsafe
from jaxsafe.schema.dotted_paths import get_path
from jaxsafe.storage.files import read_json, write_json

OUT = Path(__file__).parent / "results" / "far_starts.json"
TASKS = ("docking2d", "docking3d", "docking2d_oriented")
DISTANCES: dict[str, tuple[float, float]] = {
    "100 to 150 m": (100.0, 150.0),
    "1 km": (1000.0, 1000.0),
    "10 km": (10000.0, 10000.0),
}
"""The interval of the starts [m] by its name."""

LONG = 6000
"""The time limit from 10 km [s], whose flight at the speed limit takes 2,257 s."""

KEPT = (
    "success_rate",
    "average_return",
    "episode_length",
    "control_usage_l1",
    "safety_violation_rate",
    "episode_safety_violation_rate",
)


def measure(task: str, place: Path, seeds: int, episodes: int) -> list[dict[str, Any]]:
    """Train a task by its recipe, test the policies, and return a row for each distance.

    Args:
        task: the task.
        place: the directory of the runs.
        seeds: number of seeds.
        episodes: episodes of each test of each seed.
    """
    run = place / task
    if not (run / "results.json").exists():
        rest = ("eval_every=100000000", "episodes=1", f"out={run}")
        command("train", f"env={task}", "preset=wide", f"seeds={seeds}", *rest)
    training = read_json(run / "results.json")
    own = float(get_path(jaxsafe.make(task), "terminal.timeout.limit"))
    rows = []
    for name, (low, high) in DISTANCES.items():
        tested = place / f"{task}_from_{high:.0f}_m"
        limit = LONG if low > 1000.0 else own
        if not (tested / "results.json").exists():
            changes = (
                f"env={task}",
                f"env.deputy.start.position.distance=[{low},{high}]",
                f"env.terminal.timeout.limit={limit}",
            )
            command("evaluate", f"run={run}", *changes, f"episodes={episodes}", f"out={tested}")
        evaluation = read_json(tested / "results.json")["evaluation"]
        rows.append(
            {
                "task": task,
                "start": name,
                "time_limit": limit,
                "steps": training["steps"],
                "wall_s": training["wall_s"],
                "evaluation": {
                    kind: {name: metrics[name] for name in KEPT}
                    for kind, metrics in evaluation.items()
                },
            }
        )
    return rows


def main() -> None:
    """Run the command."""
    options = words(tasks=",".join(TASKS), seeds="10", episodes="200", out="")
    tasks = several("tasks", options["tasks"], TASKS)
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
