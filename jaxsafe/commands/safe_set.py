"""The command `python -m jaxsafe.plot.safe_set env=rejoin2d rta=default` draws a safe set.

The figure shows at which states a filter certifies.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxsafe.commands import cli
from jaxsafe.config.arguments import Arguments
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.envs import default_filter, make, short_name
from jaxsafe.plot.safe_set import Ends, draw
from jaxsafe.plot.style import save
from jaxsafe.schema.errors import ConfigError

OPTIONS = ("env", "rta", "x", "y", "points", "out")


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    enable_compilation_cache()
    arguments = Arguments.parse(argv)
    task, rta, out = (arguments.pop_text(name) for name in ("env", "rta", "out"))
    changes, points = arguments.pop_overrides(), arguments.pop_count("points", 161, least=2)
    x, y = (_ends(arguments, name) for name in "xy")
    arguments.refuse_rest([*OPTIONS, "env.…"])
    if task is None:
        raise ConfigError("env: missing; for instance env=rejoin2d")
    # A file may have a filter of its own, so it gets no default filter.
    rta = rta or default_filter(task)
    env = make(task, changes, rta=rta)
    print(
        save(
            draw(env, f"{short_name(task)}, rta={rta or 'of the file'}", x, y, points),
            Path(out or f"safe_set_{short_name(task)}.png"),
        )
    )
    return 0


def _ends(arguments: Arguments, key: str) -> Ends | None:
    value = arguments.pop(key)
    numbers = isinstance(value, list) and all(isinstance(one, (int, float)) for one in value)
    if value is not None and not (numbers and len(value) == 2 and value[0] < value[1]):
        raise ConfigError(
            f"{key}: expected the ends of the axis, for instance [0,150], found {value!r}"
        )
    return None if value is None else (float(value[0]), float(value[1]))


def usage() -> str:
    """Return the help text."""
    return (
        "usage: python -m jaxsafe.plot.safe_set env=TASK [key=value …]\n\n"
        "  rta=default            the filter, one that certifies states\n"
        "  x=[LOW,HIGH]           ends of the first axis: distance [m], "
        "or how far ahead of the lead [ft]\n"
        "  y=[LOW,HIGH]           ends of the second axis: speed [m/s], "
        "or how far to the left of the lead [ft]\n"
        "  points=N               states along each axis (default 161)\n"
        "  env.PATH=VALUE         change the environment\n"
        "  out=FILE.png           where to write (default safe_set_TASK.png)"
    )


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, usage)
