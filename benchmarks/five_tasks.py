"""How long does it take until ten seeds of all five tasks are learnt, nothing compiled before?

`python -m jaxsafe.train env=all preset=quick` in a process of its own with an empty cache of compiled programs, and the
same five trainings as five commands, one after another. Learnt is when 95 % of the last 100 training episodes succeeded,
on the average over seeds, as Table 2 of the paper counts 80 %. Writes `benchmarks/results/five_tasks.json` and prints a
table of medians:

    python benchmarks/five_tasks.py [seeds=10] [seed=0] [preset=quick] [repeats=3]
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from baselines.measures import failed_seeds, wall_to
from isolated import CACHE, words

from jaxsafe.envs import TASKS
from jaxsafe.storage.files import read_json, read_rows

OUT = Path(__file__).parent / "results" / "five_tasks.json"
LEVEL = 0.95
POLL = 0.1
"""Seconds between looks at the logs."""


def main() -> None:
    """Run, write, print."""
    options = words(seeds="10", seed="0", preset="quick", repeats="3")
    import tables
    from machine import about

    here = about()
    asked = [f"{name}={options[name]}" for name in ("preset", "seeds", "seed")]
    runs = []
    for _ in range(int(options["repeats"])):
        runs.append({"one command": together(asked), "five commands": apart(asked)})
        print(json.dumps(runs[-1]), file=sys.stderr)
    content = {**here, "words": asked, "level": LEVEL, "unit": "s", "runs": runs}
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print(tables.five_tasks(content))


def together(asked: Sequence[str]) -> dict[str, Any]:
    """All five by one command: when the last of them is learnt."""
    with tempfile.TemporaryDirectory() as place:
        runs = {task: Path(place, "all", task) for task in TASKS}
        whole, sizes = watched(
            ["env=all", *asked, f"out={place}/all"], runs.values(), Path(place, "cache")
        )
        at = [when(run, sizes) for run in runs.values()]
        return {
            "learnt": max(numbers) if (numbers := all_known(at)) else None,
            "each": at,
            "whole": whole,
            **found(runs),
        }


def apart(asked: Sequence[str]) -> dict[str, Any]:
    """Each by a command of its own: the seconds until it is learnt, added up."""
    with tempfile.TemporaryDirectory() as place:
        runs = {task: Path(place, task) for task in TASKS}
        cache = Path(place, "cache")
        whole = sum(
            watched([f"env={task}", *asked, f"out={run}"], [run], cache)[0]
            for task, run in runs.items()
        )
        at = [wall_to(LEVEL, read_rows(run / "progress.jsonl")) for run in runs.values()]
        return {
            "learnt": sum(numbers) if (numbers := all_known(at)) else None,
            "each": at,
            "whole": whole,
            **found(runs),
        }


def watched(
    asked: Sequence[str], runs: Iterable[Path], cache: Path
) -> tuple[float, list[tuple[float, dict[Path, int]]]]:
    """The seconds that a training command takes, and on the way how long the progress logs of its runs are, in bytes."""
    environment = {key: value for key, value in os.environ.items() if key not in CACHE} | {
        "XDG_CACHE_HOME": str(cache)
    }
    logs = [run / "progress.jsonl" for run in runs]
    began = time.monotonic()
    sizes = []
    process = subprocess.Popen(
        [sys.executable, "-m", "jaxsafe.train", *asked], env=environment, stdout=subprocess.DEVNULL
    )
    while process.poll() is None:
        sizes.append(
            (time.monotonic() - began, {log: log.stat().st_size for log in logs if log.exists()})
        )
        time.sleep(POLL)
    if process.returncode:
        sys.exit(f"{' '.join(asked)}: the training did not end")
    return time.monotonic() - began, sizes


def when(run: Path, sizes: Sequence[tuple[float, dict[Path, int]]]) -> float | None:
    """Seconds from the start of the command until the log of a run had the row with which it was learnt."""
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


def found(runs: dict[str, Path]) -> dict[str, Any]:
    """Of the evaluation after training: success with sampled actions, the mean over seeds, and which seeds failed."""
    results = {task: read_json(run / "results.json") for task, run in runs.items()}
    success = {
        task: one["evaluation"]["stochastic"]["success_rate"]["mean"]
        for task, one in results.items()
    }
    return {
        "success": success,
        "failed": {task: failed_seeds(one) for task, one in results.items()},
    }


def all_known(values: Sequence[float | None]) -> list[float]:
    """The values, or nothing if one of them was never reached."""
    known = [value for value in values if value is not None]
    return known if len(known) == len(values) else []


if __name__ == "__main__":
    main()
