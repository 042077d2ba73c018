"""The progress of a run while it goes on.

Rows of numbers go to files and to the sinks that the user asks for. The terminal shows a progress
bar or plain lines.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsafe.environment import Environment
from jaxsafe.metrics import measures
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import append_csv, append_rows, read_rows, write_csv, write_rows
from jaxsafe.storage.forms import COUNT, FLAG, NUMBER, NUMBER_OR_NULL, OTHERS
from jaxsafe.storage.text_table import or_dash
from jaxsafe.train.host.sinks import Sink, reason
from jaxsafe.train.ppo import DIAGNOSTICS

NEEDS = {
    **dict.fromkeys(("seed", "step", "episodes", "cost"), COUNT),
    "wall_s": NUMBER,
    **dict.fromkeys(("success_rate", "return", "length"), NUMBER_OR_NULL),
    OTHERS: NUMBER_OR_NULL | FLAG,
}
"""The form of every row of the progress log.

It says which columns all logs have, and what the other columns hold.
"""


def read_progress(run: Path) -> list[dict[str, Any]]:
    """Return the rows of a run's progress log. There are none if it has not begun.

    Raises:
        ConfigError: a row is broken, has other columns than the first row, or stands in the wrong
            place.
    """
    rows = read_rows(run / "progress.jsonl", NEEDS)
    check_order(rows, run / "progress.jsonl")
    return rows


def check_order(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Check the rows of a progress log.

    All must have the same columns. They must come update by update, and within an update seed by
    seed.

    Args:
        rows: the rows.
        path: the file, for the message.

    Raises:
        ConfigError: a row has other columns or stands in the wrong place.
    """
    seeds = [row["seed"] for row in rows if row["step"] == rows[0]["step"]]
    for index, row in enumerate(rows):
        place = f"{path}, row {index + 1}"
        if row.keys() != rows[0].keys():
            different = ", ".join(sorted(row.keys() ^ rows[0].keys()))
            raise ConfigError(
                f"{place}: expected the columns of the first row, they differ in {different}"
            )
        first = rows[index - index % len(seeds)]  # the first row of the same update
        if row["seed"] != seeds[index % len(seeds)] or row["step"] != first["step"]:
            wanted = f"seed {seeds[index % len(seeds)]} at step {first['step']}"
            raise ConfigError(
                f"{place}: expected {wanted}, found seed {row['seed']} at step {row['step']}"
            )
        if first is row and index and row["step"] <= rows[index - 1]["step"]:
            raise ConfigError(
                f"{place}: expected a step after {rows[index - 1]['step']}, found {row['step']}"
            )


def headline(*runs: Mapping[str, Any]) -> str:
    """Return a short description of a run, for the title of a table or a figure.

    Args:
        *runs: the facts about the run that its results hold. If there are several runs, the
            description has only what they have in common.
    """
    descriptions = [
        [
            str(facts["env"]),
            f"preset {facts['preset']}",
            # Results of older versions have neither of the next two.
            str(facts.get("algorithm", "")),
            f"rta {facts['rta']}" if "rta" in facts else "",
            f"{facts['seeds']} seed{'s' * (facts['seeds'] != 1)}",
        ]
        for facts in runs
    ]
    return ", ".join(
        parts[0] for parts in zip(*descriptions, strict=True) if parts[0] and len({*parts}) == 1
    )


class ProgressLog:
    """`progress.jsonl` and `progress.csv`, with a row for every update of every seed."""

    def __init__(self, run: Path, resume_step: int, expected: int) -> None:
        """Open the logs, and remove the rows after the step from which the run goes on.

        Args:
            run: the run directory.
            resume_step: environment steps of each seed from which the run goes on.
            expected: number of rows up to that step.

        Raises:
            ConfigError: rows are missing or broken.
        """
        self._jsonl, self._csv = run / "progress.jsonl", run / "progress.csv"
        self.rows = [row for row in read_progress(run) if row["step"] <= resume_step]
        if len(self.rows) != expected:
            raise ConfigError(
                f"{self._jsonl}: expected {expected} rows up to step {resume_step}, "
                f"found {len(self.rows)}"
            )
        if self._jsonl.exists():
            write_rows(self._jsonl, self.rows)
        if self.rows:
            write_csv(self._csv, self.rows)
        else:
            self._csv.unlink(missing_ok=True)
        self.sinks: dict[str, Sink] = {}
        """The sinks that get the rows in addition to the files, by name."""

    def write(self, rows: list[dict[str, Any]]) -> None:
        """Add rows to all logs, and give them to the sinks.

        Raises:
            ConfigError: the log was begun with other columns.
        """
        different = rows[0].keys() ^ self.rows[0].keys() if self.rows else ()
        if different:
            names = ", ".join(sorted(different))
            raise ConfigError(
                f"{self._jsonl}: another version of jaxsafe began it; "
                f"columns differ in {names}; begin a new run"
            )
        self.rows += rows
        append_rows(self._jsonl, rows)
        append_csv(self._csv, rows)

        def send(sink: Sink) -> None:
            for row in rows:
                sink.write(row["step"], row["seed"], _numbers(row))

        self._for_each_sink(send)

    def close(self) -> None:
        """Let the sinks deliver what is left."""
        self._for_each_sink(lambda sink: sink.close())
        self.sinks = {}

    def _for_each_sink(self, action: Callable[[Sink], None]) -> None:
        """Do something with each sink. One that fails is left out, and the training goes on."""
        for name, sink in [*self.sinks.items()]:
            try:
                action(sink)
            except Exception as error:
                print(f"{name}: {reason(error)}; the training goes on without it", flush=True)
                del self.sinks[name]

    def curve(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return steps [updates] and one column [updates, seeds]. Unknown values are NaN."""
        steps = np.unique([row["step"] for row in self.rows])
        values = np.array([np.nan if row[name] is None else row[name] for row in self.rows], float)
        return steps, values.reshape(len(steps), -1)


def _numbers(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the known numbers of a row, by column."""
    others = ("seed", "step", "diverged")
    return {name: value for name, value in row.items() if name not in others and value is not None}


def progress_rows(
    env: Environment, curves: dict[str, np.ndarray], seed: int, batch_size: int, wall_s: float
) -> list[dict]:
    """Return the rows of the progress log for a chunk of updates, update by update.

    The measured columns are None before the first episode of a seed has ended. They and the
    diagnostics are None once the seed has diverged.

    Args:
        env: the environment.
        curves: the arrays [seeds, updates] that the chunk returns.
        seed: the first seed.
        batch_size: environment steps of each seed in an update.
        wall_s: seconds spent on the run so far.
    """
    num_seeds, num_updates = curves["count"].shape
    sound = ~curves["diverged"]
    known = (curves["count"] > 0) & sound
    measured = columns(env)
    measured += [name for name in curves if name.startswith(("episode_cost/", "multiplier"))]
    diagnostics = [name for name in DIAGNOSTICS if name in curves]
    return [
        {
            "seed": seed + i,
            "step": int(curves["update"][i, j]) * batch_size,
            "wall_s": round(wall_s, 3),
            "episodes": int(curves["count"][i, j]),
            "cost": int(curves["cost"][i, j]),
            **{name: _rounded(curves[name][i, j], known[i, j]) for name in measured},
            **{name: _rounded(curves[name][i, j], sound[i, j]) for name in diagnostics},
            "diverged": bool(curves["diverged"][i, j]),
        }
        for j in range(num_updates)
        for i in range(num_seeds)
    ]


def _rounded(value: np.ndarray, known: np.ndarray) -> float | None:
    """Return a number with six digits, or None if it is not known or not finite."""
    return float(f"{value:.6g}") if known and np.isfinite(value) else None


def columns(env: Environment) -> list[str]:
    """Return the measured columns of the progress log, in order.

    They are averages over the window. What an environment does not measure has no column.
    """
    measured = measures(env)
    first = [
        "success_rate",
        "return",
        "length",
        *(["delta_v"] if measured["has_delta_v"] else []),
        *(["control_effort"] if measured["has_controls"] else []),
        *(["violating_share", "episode_cost"] if measured["has_constraints"] else []),
        *(["episode_severity"] if env.cost == "severity" else []),
        *(["intervention_share"] if measured["has_rta"] else []),
    ]
    return [
        *first,
        *(f"outcome/{name}" for name in env.outcomes[1:]),
        *(f"reward/{term.name}" for term in env.reward),
        *(f"measured/{name}" for name in env.measure),
    ]


class Display:
    """A progress bar on a terminal or in a notebook, elsewhere a plain line at every tenth."""

    def __init__(self, steps: int, done: int, shown: bool = True) -> None:
        """Show progress towards `steps` environment steps of each seed.

        Args:
            steps: number of steps.
            done: number of steps that are done already.
            shown: whether to show anything.
        """
        self._steps, self._done, self._shown = steps, done, shown
        self._bar = None
        notebook = "ipykernel" in sys.modules
        if shown and (notebook or sys.stderr.isatty()):
            from tqdm import tqdm

            self._bar = tqdm(
                total=steps,
                initial=done,
                unit=" steps",
                unit_scale=True,
                # A notebook has no width, and shows standard error as a fault.
                ncols=100 if notebook else None,
                dynamic_ncols=not notebook,
                file=sys.stdout if notebook else None,
            )
            self._bar.set_postfix_str("compiling")

    def start(self) -> None:
        """Begin to count time. The time before does not count for the rate of training."""
        self._begin = self._done, time.monotonic()
        if self._bar is not None:
            self._bar.unpause()

    def show(self, step: int, rows: list[dict[str, Any]]) -> None:
        """Show the state after `step` steps, given the latest row of each seed."""
        means = {name: _mean([row[name] for row in rows]) for name in ("success_rate", "return")}
        success = or_dash(means["success_rate"], ".1%")
        summary = f"success {success}, return {or_dash(means['return'], '.2f')}"
        if diverged := sum(row["diverged"] for row in rows):
            summary += f", {diverged} of {len(rows)} seeds diverged and left out"
        if self._bar is not None:
            self._bar.set_postfix_str(summary, refresh=False)
            self._bar.update(step - self._done)
        elif self._shown and step * 10 // self._steps > self._done * 10 // self._steps:
            first, begin = self._begin
            left = (time.monotonic() - begin) * (self._steps - step) / max(step - first, 1)
            print(f"{step:>10,} of {self._steps:,} steps, {summary}, {left:.0f} s left", flush=True)
        self._done = step

    def tell(self, text: str) -> None:
        """Print a line, above the bar if there is one."""
        if self._bar is not None:
            self._bar.write(text)
        elif self._shown:
            print(text, flush=True)

    def close(self) -> None:
        """Leave the bar as it stands."""
        if self._bar is not None:
            self._bar.close()


def _mean(values: list[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return sum(numbers) / len(numbers) if numbers else None
