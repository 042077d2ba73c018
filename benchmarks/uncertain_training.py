"""Measure what training in an uncertain world, and under a robust filter, is worth there.

Each task is trained by its recipe in three ways: in the perfect world of the paper, in a world that
is as bad as the bound in `BOUNDS`, and in that world under `rta=robust`. In that world the policies
of all seeds then act by their most probable action, without a filter and under `robust`.

Results are written to `benchmarks/results/uncertain_training.json`, and the table of
docs/safety/attacks.md is printed:

    python benchmarks/uncertain_training.py [tasks=docking3d,rejoin2d] [seeds=10] [episodes=1000]
        [out=DIRECTORY]

With `out` the runs are kept, and what is there already is not trained or tested again.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from isolated import command, several, words
from robustness import BOUNDS

OUT = Path(__file__).parent / "results" / "uncertain_training.json"
TASKS = ("docking3d", "rejoin2d")
"""The tasks that are trained."""

WAYS = ("perfect", "uncertain", "robust")
"""Where a policy was trained.

`uncertain` is the uncertain world without a filter, and `robust` is that world under `robust`.
"""

FILTERS = ("none", "robust")
"""The filters under which policies are tested."""

KEPT = (
    "success_rate",
    "control_effort",
    "safety_violation_rate",
    "episode_safety_violation_rate",
    "intervention_rate",
)


def write_worlds(task: str, place: Path) -> dict[str, Path]:
    """Write the environment of each way, and return the files.

    That of `robust` is the uncertain world with the filter in it.
    """
    import jaxsafe
    from jaxsafe.config import override
    from jaxsafe.evaluate.bounded_worlds import world_at

    robust = world_at(jaxsafe.make(task, {"rta.bound": BOUNDS[task]}, rta="robust"), 1.0)
    envs = {
        "perfect": jaxsafe.make(task),
        "uncertain": override(robust, {"rta": None}),
        "robust": robust,
    }
    paths = {way: place / f"{task}_{way}.yaml" for way in envs}
    for way, env in envs.items():
        paths[way].write_text(jaxsafe.dump(env), encoding="utf-8")
    return paths


def measure(task: str, place: Path, seeds: int, episodes: int) -> list[dict[str, Any]]:
    """Train a task in each way, test the policies, and return a row for each test."""
    worlds = write_worlds(task, place)
    rows = []
    for way in WAYS:
        run = place / f"{task}_{way}"
        if not (run / "results.json").exists():
            recipe = (f"recipe={task}", "preset=engineered_features")
            command("train", f"env={worlds[way]}", *recipe, f"seeds={seeds}", f"out={run}")
        for rta in FILTERS:
            tested = place / f"{task}_{way}_{rta}"
            if not (tested / "results.json").exists():
                world = worlds["robust" if rta == "robust" else "uncertain"]
                options = (f"env={world}", f"episodes={episodes}", f"out={tested}")
                command("evaluate", f"run={run}", *options, "deterministic=true")
            results = json.loads((tested / "results.json").read_text(encoding="utf-8"))
            evaluation = results["evaluation"]["deterministic"]
            metrics = {name: evaluation[name] for name in KEPT if name in evaluation}
            rows.append({"task": task, "trained": way, "rta": rta, "metrics": metrics})
    return rows


def main() -> None:
    """Run the command."""
    options = words(tasks=",".join(TASKS), seeds="10", episodes="1000", out="")
    tasks = several("tasks", options["tasks"], TASKS)
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(options["out"] or temporary).resolve()
        place.mkdir(parents=True, exist_ok=True)
        counts = (int(options["seeds"]), int(options["episodes"]))
        rows = [row for task in tasks for row in measure(task, place, *counts)]
    import tables
    from machine import about

    from jaxsafe.storage.files import write_json

    results = {
        "command": "python benchmarks/uncertain_training.py"
        f" tasks={options['tasks']} seeds={counts[0]} episodes={counts[1]}",
        "bounds": {task: BOUNDS[task] for task in tasks},
        "seeds": counts[0],
        "episodes": counts[1],
        **about(__file__),
        "rows": rows,
    }
    write_json(OUT, results)
    print(tables.uncertain_training(results))


if __name__ == "__main__":
    main()
