"""How well, in how many steps and in what time do ten seeds of docking2d and docking3d learn to dock?

Runs the command of the README, as a user would, with an empty compilation cache, for each task and preset, and writes
`benchmarks/results/docking.json` and the README's table. Takes minutes:

    python benchmarks/docking.py [tasks=docking2d,docking3d] [presets=features,plain] [seeds=10]
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

OUT = Path(__file__).parent / "results" / "docking.json"


def main() -> None:
    """Run, write, print."""
    options = {key: value for key, _, value in (word.partition("=") for word in sys.argv[1:])}
    tasks = options.get("tasks", "docking2d,docking3d").split(",")
    presets = options.get("presets", "features,plain").split(",")
    results = [measure(task, preset, options.get("seeds", "10")) for preset in presets for task in tasks]
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    OUT.parent.mkdir(exist_ok=True)
    OUT.write_text(json.dumps({"commit": commit, "cores": os.cpu_count(), "runs": results}) + "\n")
    print(table(results))


def measure(task: str, preset: str, seeds: str) -> dict[str, Any]:
    """One run from an empty directory; the clock includes Python's start, imports, compilation, evaluation and figures."""
    with tempfile.TemporaryDirectory() as empty:
        command = [sys.executable, "-m", "jaxsafe.train", f"env={task}", f"seeds={seeds}", f"preset={preset}"]
        begin = time.monotonic()
        subprocess.run(command, cwd=empty, env={**os.environ, "XDG_CACHE_HOME": f"{empty}/cache"}, check=True)
        process_s = time.monotonic() - begin
        run = Path(empty) / "runs" / task
        results = json.loads((run / "results.json").read_text())
        rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    return {
        **results,
        "process_s": round(process_s, 1),
        "reached_98_s": reached(rows, 0.98),
        "trained_s": rows[-1]["wall_s"],
    }


def reached(rows: list[dict[str, Any]], rate: float) -> float | None:
    """Seconds since the start at which the mean of the seeds' training success first reached a rate."""
    by_step: dict[int, list[dict[str, Any]]] = {}
    for row in rows:
        by_step.setdefault(row["step"], []).append(row)
    for group in by_step.values():
        if sum(row["success_rate"] or 0.0 for row in group) / len(group) >= rate:
            return group[0]["wall_s"]
    return None


def table(results: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| task, preset | steps per seed | success, stochastic | deterministic | worst seed | 80 % in training after |"
        " 98 % after | whole command | of it compiling |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for run in results:
        found = run["evaluation"]
        rates = [found[kind]["success_rate"] for kind in ("stochastic", "deterministic")]
        worst = min(value for rate in rates for value in rate["per_seed"])
        after = run["interaction_efficiency"]["timesteps"]
        cells = [
            f"{run['env']}, `{run['preset']}`",
            f"{run['steps']:,}",
            *(f"{rate['mean']:.2%}" for rate in rates),
            f"{worst:.1%}",
            f"{after:,} steps" if after else "never",
            f"{run['reached_98_s']:.0f} s" if run["reached_98_s"] else "never",
            f"{run['process_s']:.0f} s",
            f"{run['compile_s']:.0f} s",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
