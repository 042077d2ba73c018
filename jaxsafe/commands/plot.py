"""Draw the paper's figures of a run from its log files, into RUN/figures.

With several runs of one task, draw their curves in one figure and print a table of their results.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from jaxsafe.commands import cli
from jaxsafe.commands.options import CommandOptions, File, Option
from jaxsafe.schema.errors import ConfigError


class Options(CommandOptions):
    """The options of `jaxsafe plot`."""

    run: Annotated[
        tuple[str, ...],
        Option(
            first=True,
            examples=("run=runs/docking3d", "run=runs/a,runs/b"),
            takes="a directory, or several with commas between them",
        ),
    ]
    """The run directories."""
    x: Annotated[Literal["steps", "wall"], Option(kind="axis")] = "steps"
    """The horizontal axis: environment steps of a seed, or wall time."""
    out: File = "comparison.png"
    """File of the figure of several runs. The figures of a single run are in its directory."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    from jaxsafe.runs.figures import draw_all
    from jaxsafe.train.host import run_directory

    options = Options.parse(argv)
    if isinstance(options.given["run"], list):
        _compare(options.run, options.x, Path(options.out))
        return 0
    options.refuse_beside(["out"], "but for several runs, which run=A,B draws in one figure")
    [run] = map(Path, options.run)
    run_directory.read(run, "run")
    for path in draw_all(run, options.x):
        print(path)
    return 0


def _compare(runs: Sequence[str], x: str, out: Path) -> None:
    """Draw several runs in one figure and print a table of their results.

    Each run appears under the name of its directory.

    Args:
        runs: the run directories.
        x: the horizontal axis, one of `jaxsafe.plot.figures.AXES`.
        out: the path of the figure.

    Raises:
        ConfigError: the runs cannot be compared, or one of them is not finished.
    """
    from jaxsafe.plot.compare import compare_curves
    from jaxsafe.plot.style import save
    from jaxsafe.runs.figures import progress
    from jaxsafe.train.host import run_directory
    from jaxsafe.train.host.results import summary

    paths = {Path(run).name: Path(run) for run in runs}
    if len(paths) < len(runs) or len(runs) < 2:
        raise ConfigError(
            f"run: expected several directories of different names, found {', '.join(runs)}"
        )
    tasks = {run_directory.read(path, "run")[2] for path in paths.values()}
    if len(tasks) > 1:
        raise ConfigError(f"run: expected runs of one task, found {', '.join(sorted(tasks))}")
    for path in paths.values():
        if not (path / "results.json").exists():
            raise ConfigError(
                f"run: {path} has no results.json; "
                f"finish it with python -m jaxsafe.train resume={path}"
            )
    figure = compare_curves({name: progress(path) for name, path in paths.items()}, tasks.pop(), x)
    print(summary(paths))
    print(save(figure, out))


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
