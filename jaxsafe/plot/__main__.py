"""`python -m jaxsafe.plot run=runs/x [x=steps|wall]`: the paper's figures from the run's own log files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxsafe import cli
from jaxsafe.errors import ConfigError, nearest


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    from jaxsafe.plot.figures import AXES, draw_all
    from jaxsafe.train import directory

    arguments = cli.Arguments.parse(argv)
    run, x = arguments.pop_text("run"), arguments.pop_text("x") or "steps"
    arguments.refuse_rest(["run", "x"])
    if run is None:
        raise ConfigError("run: missing; for instance run=runs/docking3d")
    if x not in AXES:
        raise ConfigError(f"x: unknown axis {x!r}; choose from {nearest(x, AXES)}")
    directory.read(Path(run), "run")
    for path in draw_all(Path(run), x):  # type: ignore[arg-type]
        print(path)
    return 0


def usage() -> str:
    """The help text."""
    return "usage: python -m jaxsafe.plot run=RUN [x=steps|wall]\n\n  draws into RUN/figures from RUN's log files"


if __name__ == "__main__":
    cli.run(main, usage)
