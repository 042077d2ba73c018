"""Measure ways of training under a constraint that the reward does not know.

The task is docking2d without the penalty of its reward for speed, so that flying too fast pays.
Its recipe trains it by each way of `WAYS`. Then the policies of all seeds fly the task, with
sampled actions and with the most probable ones. An episode costs its violating steps.

Results are written to `benchmarks/results/constraints.json`, and the table of docs/constrained.md
is printed:

    python benchmarks/constraints.py [seeds=10] [steps=500000] [episodes=200] [out=DIRECTORY]

With `out` the runs are kept, and what is there already is not trained or tested again.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from isolated import command, words

OUT = Path(__file__).parent / "results" / "constraints.json"
TASK = "docking2d"
PENALTY = "reward.velocity_constraint"

LAGRANGIAN = ("algorithm=ppo_lagrangian", "cost_limit=1", "ppo.averaging=0.1")
FIXED = ("algorithm=ppo_lagrangian", "ppo.multiplier_rate=0")
PID = ("ppo.multiplier_proportional=0.5", "ppo.multiplier_derivative=0.5")
WAYS: dict[str, tuple[str, ...]] = {
    "reward": (),
    "penalty": (*FIXED, "ppo.multiplier=0.05"),
    "lagrangian": LAGRANGIAN,
    "pid_lagrangian": (*LAGRANGIAN, *PID),
    "early_termination": (),
}
"""Options of `jaxsafe train` for each way. Early termination is one of the environment."""

KEPT = ("success_rate", "episode_cost", "episode_length", "safety_violation_rate")


def write_worlds(place: Path) -> tuple[Path, Path]:
    """Write the task without the penalty, and the one that ends at the first violation as well."""
    import jaxsafe
    from jaxsafe.config import override
    from jaxsafe.processors.status import LinearCombination
    from jaxsafe.processors.terminal import Above

    free = jaxsafe.make(TASK, {f"{PENALTY}.offset": 0.0, f"{PENALTY}.scale": 0.0})
    weights = {"speed": 1.0, "velocity_limit": -1.0}
    excess = LinearCombination(name="excess_speed", weights=weights)
    end = Above(name="violation", status="excess_speed", limit=0.0)
    ended = override(free, {"status": (*free.status, excess), "terminal": (end, *free.terminal)})
    paths = place / "free.yaml", place / "ended.yaml"
    for path, env in zip(paths, (free, ended), strict=True):
        path.write_text(jaxsafe.dump(env), encoding="utf-8")
    return paths


def measure(
    way: str, worlds: tuple[Path, Path], place: Path, seeds: int, steps: int, episodes: int
) -> dict[str, Any]:
    """Train by one way, test the policies, and return the row of both.

    Args:
        way: the way, of `WAYS`.
        worlds: the files that `write_worlds` returned.
        place: the directory of the runs.
        seeds: number of seeds.
        steps: steps of the training of each seed.
        episodes: episodes of the test of each seed.
    """
    free, ended = worlds
    run = place / way
    if not (run / "results.json").exists():
        world = ended if way == "early_termination" else free
        recipe = (f"recipe={TASK}", f"seeds={seeds}", f"steps={steps}")
        rest = ("eval_every=100000000", "episodes=1", f"out={run}")
        command("train", f"env={world}", *recipe, *WAYS[way], *rest)
    tested = place / f"{way}_tested"
    if not (tested / "results.json").exists():
        command("evaluate", f"run={run}", f"env={free}", f"episodes={episodes}", f"out={tested}")
    training = json.loads((run / "results.json").read_text(encoding="utf-8"))
    evaluation = json.loads((tested / "results.json").read_text(encoding="utf-8"))["evaluation"]
    return {
        "way": way,
        "training_cost": training["training_cost"],
        "evaluation": {
            kind: {name: metrics[name] for name in KEPT} for kind, metrics in evaluation.items()
        },
    }


def main() -> None:
    """Run the command."""
    options = words(seeds="10", steps="500000", episodes="200", out="")
    counts = {name: int(options[name]) for name in ("seeds", "steps", "episodes")}
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(options["out"] or temporary).resolve()
        place.mkdir(parents=True, exist_ok=True)
        worlds = write_worlds(place)
        rows = [measure(way, worlds, place, **counts) for way in WAYS]
    import tables
    from machine import about

    from jaxsafe.storage.files import write_json

    given = " ".join(f"{name}={count}" for name, count in counts.items())
    results = {
        "command": f"python benchmarks/constraints.py {given}",
        **counts,
        **about(__file__),
        "rows": rows,
    }
    write_json(OUT, results)
    print(tables.constraints(results))


if __name__ == "__main__":
    main()
