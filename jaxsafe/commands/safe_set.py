"""Draw at which states a filter of run time assurance certifies.

For docking the axes are distance and speed. For rejoin they are positions relative to the lead.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from jaxsafe.commands import cli
from jaxsafe.commands.environment_options import TaskOptions
from jaxsafe.commands.options import File, Option
from jaxsafe.config.arguments import MAX_COUNT
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.envs import short_name
from jaxsafe.plot.safe_set import Ends, draw
from jaxsafe.plot.style import save
from jaxsafe.schema.component import Range

Axis = Annotated[Ends, Option(takes="the ends of the axis, for instance 0,150")]


class Options(TaskOptions):
    """The options of `jaxsafe safe_set`."""

    env: Annotated[str, Option(first=True, examples=("env=rejoin2d",))]
    """The task, or the file of an environment."""
    rta: str | None = None
    """The filter, which must certify states.

    By default it is the recommended filter of the task, or the one that the file has.
    """
    x: Axis | None = None
    """The first axis: distance [m], or how far ahead of the lead [ft]."""
    y: Axis | None = None
    """The second axis: speed [m/s], or how far to the left of the lead [ft]."""
    points: Annotated[int, Range(2, largest=MAX_COUNT)] = 161
    """Number of states along each axis."""
    out: File | None = None
    """File of the figure. By default it is safe_set_TASK.png."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    enable_compilation_cache()
    options = Options.parse(argv)
    task = short_name(options.env)
    rta = options.filter_or_default()
    env = options.replace(rta=rta).make(options.env)
    title = f"{task}, rta={rta or 'of the file'}"
    figure = draw(env, title, options.x, options.y, options.points)
    print(save(figure, Path(options.out or f"safe_set_{task}.png")))
    return 0


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
