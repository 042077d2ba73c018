"""The command `python -m jaxsafe.plot run=runs/x` draws the paper's figures.

It draws them from the run's own log files. Several runs are drawn in one figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxsafe.commands import cli
from jaxsafe.config.arguments import Arguments
from jaxsafe.schema.errors import ConfigError, nearest


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    from jaxsafe.commands.run_figures import draw_all
    from jaxsafe.plot.figures import AXES
    from jaxsafe.train.host import run_directory

    arguments = Arguments.parse(argv)
    several = isinstance(arguments.options.get("run"), list)
    arguments.refuse_beside(
        [] if several else ["out"], "but for several runs, which run=[A,B] draws in one figure"
    )
    run, x = (
        arguments.pop("run") if several else arguments.pop_text("run"),
        arguments.pop_text("x") or "steps",
    )
    out = Path(arguments.pop_text("out") or "comparison.png")
    arguments.refuse_rest(["run", "x", "out"])
    if run is None:
        raise ConfigError("run: missing; for instance run=runs/docking3d or run=[runs/a,runs/b]")
    if x not in AXES:
        raise ConfigError(f"x: unknown axis {x!r}; choose from {nearest(x, AXES)}")
    if several:
        _compare(run, x, out)
        return 0
    run_directory.read(Path(run), "run")
    for path in draw_all(Path(run), x):  # type: ignore[arg-type]
        print(path)
    return 0


def _compare(runs: Sequence[Any], x: str, out: Path) -> None:
    """Draw several runs in one figure and print a table of their results.

    Each run appears under the name of its directory.

    Args:
        runs: the run directories.
        x: the horizontal axis, one of `jaxsafe.plot.figures.AXES`.
        out: the path of the figure.

    Raises:
        ConfigError: the runs cannot be compared, or one of them is not finished.
    """
    from jaxsafe.commands.run_figures import progress
    from jaxsafe.plot.compare import compare_curves
    from jaxsafe.plot.style import save
    from jaxsafe.train.host import run_directory
    from jaxsafe.train.host.results import summary

    paths = {Path(str(run)).name: Path(str(run)) for run in runs}
    if len(paths) < len(runs) or len(runs) < 2:
        raise ConfigError(
            "run: expected several directories of different names, "
            f"found {', '.join(map(str, runs))}"
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


def usage() -> str:
    """Return the help text."""
    return (
        "usage: python -m jaxsafe.plot run=RUN [x=steps|wall]\n"
        "       python -m jaxsafe.plot 'run=[RUN,RUN,…]' [x=steps|wall] [out=comparison.png]\n\n"
        "  draws into RUN/figures from RUN's log files; "
        "or the curves of several runs of one task, with a table of results"
    )


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, usage)
