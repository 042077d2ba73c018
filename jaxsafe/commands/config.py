"""Print a complete environment as YAML on standard output.

A file with this text can be changed, and given to any command as env=FILE.yaml. With recipes=true
`jaxsafe train FILE.yaml` trains like the task.
"""

from __future__ import annotations

import codecs
import sys
from collections.abc import Sequence

from jaxsafe.commands import cli
from jaxsafe.commands.environment_options import TaskOptions


class Options(TaskOptions):
    """The options of `jaxsafe config`."""

    recipes: bool = False
    """Whether the recipes of the task are printed too, which decide how the file is trained."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    from jaxsafe.config import describe
    from jaxsafe.schema import yaml12

    options = Options.parse(argv)
    data = describe(options.make(options.env))
    if options.recipes:
        from jaxsafe.train.host.options import recipes

        data["recipes"] = recipes(options.env)
    # Whoever reads the file takes it to be UTF-8, so output in another encoding is only ASCII.
    utf8 = codecs.lookup(sys.stdout.encoding).name == "utf-8"
    print(yaml12.write(data, ascii_only=not utf8), end="")
    return 0


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
