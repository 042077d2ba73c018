"""Measure reference scores of offline learning: random actions, and the packaged policies.

    python benchmarks/datasets.py [tasks=docking2d,rejoin2d] [episodes=1000]

Results are written to `benchmarks/results/datasets.json`, for the table of docs/dataset.md.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from isolated import several, words
from machine import about

from jaxsafe.dataset import load_dataset
from jaxsafe.envs import TASKS
from jaxsafe.storage.files import write_json

OUT = Path(__file__).parent / "results" / "datasets.json"
KEPT = ("steps", "episodes", "mean_return", "mean_length", "mean_costs", "success_rate")
KINDS = ("random", "expert", "filtered")


def measure(task: str, kind: str, episodes: int) -> dict[str, Any]:
    """Return the averages over the episodes of a dataset, which is not kept."""
    source = f"env={task}" if kind == "random" else f"run=pretrained/{task}"
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "data.npz"
        options = [source, f"kind={kind}", f"episodes={episodes}", f"out={out}"]
        subprocess.run([sys.executable, "-m", "jaxsafe.dataset", *options], check=True)
        header = load_dataset(out)[1]
    return {"task": task, "kind": kind, **{name: header[name] for name in KEPT}}


def main() -> None:
    """Measure and write."""
    options = words(tasks=",".join(TASKS), episodes="1000")
    tasks = several("tasks", options["tasks"], TASKS)
    episodes = int(options["episodes"])
    write_json(
        OUT,
        {
            "command": f"python benchmarks/datasets.py tasks={','.join(tasks)} episodes={episodes}",
            **about(__file__),
            "rows": [measure(task, kind, episodes) for task in tasks for kind in KINDS],
        },
    )


if __name__ == "__main__":
    main()
