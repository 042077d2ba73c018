"""Draw the paper's figures of a run from its log files, into RUN/figures.

With several runs of one task, draw their curves in one figure and their performance profiles in
another, and print a table of their results. The table is also written as CSV and LaTeX, with 95 %
intervals.
"""

from __future__ import annotations

import glob
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from jaxsafe.commands import cli
from jaxsafe.commands.options import CommandOptions, File, Option
from jaxsafe.schema.errors import ConfigError

PANELS = (
    "success_rate",
    "return",
    "length",
    "delta_v",
    "control_effort",
    "violating_share",
    "episode_cost",
    "intervention_share",
)
"""The columns of the progress log that have a panel. `jaxsafe.plot.curves` has their labels."""

MIN_WIDTH = 2.0
"""Smallest width of a figure in inches."""

MAX_WIDTH = 40.0
"""Largest width of a figure in inches. A page is about 7 inches wide."""


class Options(CommandOptions):
    """The options of `jaxsafe plot`."""

    run: Annotated[
        tuple[str, ...],
        Option(
            first=True,
            examples=("run=runs/docking3d", "run=runs/a,runs/b"),
            takes="a directory, several with commas between them, or a pattern such as 'runs/*'",
        ),
    ]
    """The run directories. A pattern such as 'runs/*' stands for all runs that fit it."""
    x: Annotated[Literal["steps", "wall"], Option(kind="axis")] = "steps"
    """The horizontal axis: environment steps of a seed, or wall time."""
    panels: Annotated[tuple[str, ...], Option(names=PANELS, kind="panel")] = ()
    """The panels of the training curves. By default they are all that the runs have values for."""
    labels: Annotated[tuple[str, ...], Option(takes="a name for each run")] = ()
    """Names of several runs in legends and tables. By default they are those of the directories."""
    width: Annotated[str, Option(takes="a number of inches")] | None = None
    """The width of each figure in inches. A column of a paper is about 3.5 wide, a page 7."""
    format: Annotated[Literal["png", "pdf", "svg"], Option(kind="format")] = "png"
    """The format of the figures."""
    out: File | None = None
    """The file of the figure of several runs, by default comparison.png. Its suffix is its format.

    The figures of a single run are in its directory.
    """


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    from jaxsafe.runs.figures import draw_all
    from jaxsafe.train.host import run_directory

    options = Options.parse(argv)
    width = _width(options.width)
    runs, several = _expand(options)
    if several:
        for path in _compare(runs, options, width):
            print(path)
        return 0
    options.refuse_beside(
        ["out", "labels"], "but for several runs, which run=A,B draws in one figure"
    )
    [run] = runs
    run_directory.read(run, "run")
    for path in draw_all(run, options.x, form=options.format, panels=options.panels, width=width):
        print(path)
    return 0


def _expand(options: Options) -> tuple[list[Path], bool]:
    """Return the run directories, and whether the user asks for a figure of several runs.

    A pattern that only one run fits stands for that run.

    Raises:
        ConfigError: no run fits a pattern.
    """
    listed = isinstance(options.given["run"], list)
    paths: list[Path] = []
    for typed in options.run:
        if Path(typed).exists() or not glob.has_magic(typed):
            paths.append(Path(typed))
            continue
        matches = [Path(name) for name in sorted(glob.glob(typed))]
        matches = [path for path in matches if (path / "config.yaml").exists()]
        if not matches:
            raise ConfigError(f"run: no run fits {typed!r}")
        paths += matches
    return paths, listed or len(paths) > 1


def _width(typed: str | None) -> float | None:
    """Return the width of the figures in inches, or None if it is left open.

    Raises:
        ConfigError: it is no number, or too small or too large.
    """
    if typed is None:
        return None
    try:
        width = float(typed)
    except ValueError:
        width = float("nan")
    if not MIN_WIDTH <= width <= MAX_WIDTH:
        limits = f"{MIN_WIDTH:g} to {MAX_WIDTH:g}"
        raise ConfigError(f"width: expected a number of inches from {limits}, found {typed}")
    return width


def _compare(runs: Sequence[Path], options: Options, width: float | None) -> list[Path]:
    """Draw several runs in one figure, print a table of their results and write it to files.

    Args:
        runs: the run directories.
        options: the options of the command.
        width: the width of the figures in inches.

    Returns:
        The paths of the files.

    Raises:
        ConfigError: the runs cannot be compared, or one of them is not finished.
    """
    from jaxsafe.plot.compare import compare_curves
    from jaxsafe.plot.profiles import performance_profiles
    from jaxsafe.plot.style import save
    from jaxsafe.runs.figures import evaluations, progress
    from jaxsafe.storage.files import write_csv, write_text
    from jaxsafe.train.host import run_directory
    from jaxsafe.train.host.comparison import csv_rows, latex
    from jaxsafe.train.host.log import headline
    from jaxsafe.train.host.results import read_results, summary

    paths = _labelled(runs, options.labels)
    tasks = {run_directory.read(path, "run")[2] for path in paths.values()}
    if len(tasks) > 1:
        raise ConfigError(f"run: expected runs of one task, found {', '.join(sorted(tasks))}")
    for path in paths.values():
        if not (path / "results.json").exists():
            raise ConfigError(
                f"run: {path} has no results.json; finish it with jaxsafe train resume={path}"
            )
    out = _out(options)
    results = {name: read_results(path / "results.json") for name, path in paths.items()}
    rows = {name: progress(path) for name, path in paths.items()}
    title = headline(*results.values())
    figure = compare_curves(
        rows,
        title,
        options.x,
        evaluations={name: evaluations(path, rows[name]) for name, path in paths.items()},
        panels=options.panels,
        width=width,
    )
    scores = {
        "success rate τ [%]": _scores(results, "success_rate", 100.0),
        "return τ": _scores(results, "average_return", 1.0),
    }
    written = [save(figure, out)]
    scores = {quantity: values for quantity, values in scores.items() if values}
    if scores:
        profiles = performance_profiles(scores, title, width)
        written.append(save(profiles, out.with_name(f"{out.stem}_profiles{out.suffix}")))
    write_csv(out.with_suffix(".csv"), csv_rows(results))
    write_text(out.with_suffix(".tex"), latex(results))
    print(summary(paths))
    return [*written, out.with_suffix(".csv"), out.with_suffix(".tex")]


def _labelled(runs: Sequence[Path], labels: Sequence[str]) -> dict[str, Path]:
    """Return the run directories by their labels, which are their names unless others are given.

    Raises:
        ConfigError: there is only one run, or two runs have the same label.
    """
    shown = ", ".join(map(str, runs))
    if labels and len(labels) != len(runs):
        raise ConfigError(
            f"labels: expected one for each of {len(runs)} runs ({shown}), found {len(labels)}"
        )
    paths = dict(zip(labels or [run.resolve().name for run in runs], runs, strict=True))
    if labels and len(paths) < len(labels):
        raise ConfigError(f"labels: expected different ones, found {', '.join(labels)}")
    if len(paths) < len(runs) or len(runs) < 2:
        raise ConfigError(f"run: expected several directories of different names, found {shown}")
    return paths


def _out(options: Options) -> Path:
    """Return the path of the figure of several runs.

    Raises:
        ConfigError: its suffix and `format` contradict each other.
    """
    out = Path(options.out or f"comparison.{options.format}")
    if "format" in options.given and out.suffix not in ("", f".{options.format}"):
        raise ConfigError(
            f"format: found {options.format}, but out={options.out} says {out.suffix[1:]}; "
            "leave one out"
        )
    return out if out.suffix else out.with_suffix(f".{options.format}")


def _scores(
    results: Mapping[str, Mapping[str, Any]], metric: str, factor: float
) -> dict[str, list[float]]:
    """Return a metric of the stochastic evaluation of each seed, by the label of the run.

    Runs in which no seed has a value are left out.
    """
    scores: dict[str, list[float]] = {}
    for name, run in results.items():
        per_seed = run["evaluation"]["stochastic"][metric]["per_seed"]
        scores[name] = [factor * value for value in per_seed if value is not None]
    return {name: values for name, values in scores.items() if values}


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
