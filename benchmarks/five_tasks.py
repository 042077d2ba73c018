"""Measure how long it takes until ten seeds of all five tasks are learnt.

Nothing is compiled before. One way is `jaxsafe train env=all preset=shortest_time` in a
process of its own with an empty cache of compiled programs. In another way it has
`stop_at_success=0.95` as well, so that a task makes room for the next when each of its seeds has
learnt it. The last way is the five trainings as five commands, one after another. A task is learnt
when 95 % of the last 100 training episodes succeeded, on average over seeds. Table 2 of the paper
counts 80 % in the same way. Results are written to `benchmarks/results/five_tasks.json`, and a
table of medians is printed:

    python benchmarks/five_tasks.py [seeds=10] [seed=0] [preset=shortest_time] [repeats=3]
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from baselines.measures import failed_seeds, wall_to
from isolated import variables, words

from jaxsafe.envs import TASKS
from jaxsafe.storage.files import read_json, read_rows

OUT = Path(__file__).parent / "results" / "five_tasks.json"
LEVEL = 0.95
"""The success rate at which a task is learnt."""

POLL = 0.1
"""Seconds between looks at the logs."""


def main() -> None:
    """Measure, write the results and print the table."""
    options = words(seeds="10", seed="0", preset="shortest_time", repeats="3")
    import tables
    from machine import about

    here = about(__file__)
    arguments = [f"{name}={options[name]}" for name in ("preset", "seeds", "seed")]
    runs = []
    for _ in range(int(options["repeats"])):
        runs.append(
            {
                "one command": together(arguments),
                "stopped": together([*arguments, f"stop_at_success={LEVEL}"]),
                "five commands": apart(arguments),
            }
        )
        print(json.dumps(runs[-1]), file=sys.stderr)
    content = {**here, "words": arguments, "level": LEVEL, "unit": "s", "runs": runs}
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print(tables.five_tasks(content))


def together(arguments: Sequence[str]) -> dict[str, Any]:
    """Train all five tasks by one command.

    Return the seconds until the last of them is learnt, with the rest of the row.
    """
    with tempfile.TemporaryDirectory() as place:
        runs = {task: Path(place, "all", task) for task in TASKS}
        whole, sizes = watched(
            ["env=all", *arguments, f"out={place}/all"], runs.values(), Path(place, "cache")
        )
        at = [when(run, sizes) for run in runs.values()]
        return {
            "learnt": max(numbers) if (numbers := all_known(at)) else None,
            "each": at,
            "whole": whole,
            **evaluated(runs),
        }


def apart(arguments: Sequence[str]) -> dict[str, Any]:
    """Train each task by a command of its own.

    Return the sum of the seconds until each is learnt, with the rest of the row.
    """
    with tempfile.TemporaryDirectory() as place:
        runs = {task: Path(place, task) for task in TASKS}
        cache = Path(place, "cache")
        whole = sum(
            watched([f"env={task}", *arguments, f"out={run}"], [run], cache)[0]
            for task, run in runs.items()
        )
        at = [wall_to(LEVEL, read_rows(run / "progress.jsonl")) for run in runs.values()]
        return {
            "learnt": sum(numbers) if (numbers := all_known(at)) else None,
            "each": at,
            "whole": whole,
            **evaluated(runs),
        }


def watched(
    arguments: Sequence[str], runs: Iterable[Path], cache: Path
) -> tuple[float, list[tuple[float, dict[Path, int]]]]:
    """Run a training command. Return the seconds that it takes and how its progress logs grew.

    Their growth is a list of times in s, each with the bytes of every log.
    """
    environment = variables() | {"XDG_CACHE_HOME": str(cache)}
    logs = [run / "progress.jsonl" for run in runs]
    began = time.monotonic()
    sizes = []
    process = subprocess.Popen(
        [sys.executable, "-m", "jaxsafe.train", *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
    )
    while process.poll() is None:
        sizes.append(
            (time.monotonic() - began, {log: log.stat().st_size for log in logs if log.exists()})
        )
        time.sleep(POLL)
    if process.returncode:
        sys.exit(f"{' '.join(arguments)}: the training did not end")
    return time.monotonic() - began, sizes


def when(run: Path, sizes: Sequence[tuple[float, dict[Path, int]]]) -> float | None:
    """Return the seconds from the start of the command until a task was learnt.

    That is when the log of the run had the row with which the task was learnt.

    Args:
        run: the run directory of the task.
        sizes: how the logs grew, as `watched` returns it.
    """
    log = run / "progress.jsonl"
    rows = read_rows(log)
    reached = wall_to(LEVEL, rows)
    if reached is None:
        return None
    lines = log.read_bytes().splitlines(keepends=True)
    needed = sum(
        len(line) for line, row in zip(lines, rows, strict=True) if row["wall_s"] <= reached
    )
    return next(at for at, size in sizes if size.get(log, 0) >= needed)


def evaluated(runs: dict[str, Path]) -> dict[str, Any]:
    """Return the mean success over seeds with sampled actions, and the failed seeds.

    Both are from the evaluation after training.
    """
    results = {task: read_json(run / "results.json") for task, run in runs.items()}
    success = {
        task: result["evaluation"]["stochastic"]["success_rate"]["mean"]
        for task, result in results.items()
    }
    return {
        "success": success,
        "failed": {task: failed_seeds(result) for task, result in results.items()},
    }


def all_known(values: Sequence[float | None]) -> list[float]:
    """Return the values, or an empty list if one of them is None."""
    known = [value for value in values if value is not None]
    return known if len(known) == len(values) else []


if __name__ == "__main__":
    main()
