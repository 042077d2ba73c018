"""Print a complete environment as YAML on standard output.

A file with this text can be changed, and given to any command as env=FILE.yaml. The first word may
also be the task alone, as in `jaxsafe config docking3d`.
"""

from __future__ import annotations

import codecs
import sys
from collections.abc import Sequence

from jaxsafe.commands import cli
from jaxsafe.commands.environment_options import TaskOptions
from jaxsafe.schema.errors import ConfigError


class Options(TaskOptions):
    """The options of `jaxsafe config`."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    from jaxsafe.config import describe
    from jaxsafe.schema import yaml12

    words = list(argv)
    first = next((word for word in words if not word.startswith("imports=")), "env=")
    if "=" not in first:
        words[words.index(first)] = f"env={first}"
    elif not first.startswith("env="):
        raise ConfigError(f"argument {first!r}: expected a task first, for instance docking3d")
    options = Options.parse(words)
    env = options.make(options.env)
    # Whoever reads the file takes it to be UTF-8, so output in another encoding is only ASCII.
    utf8 = codecs.lookup(sys.stdout.encoding).name == "utf-8"
    print(yaml12.write(describe(env), ascii_only=not utf8), end="")
    return 0


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
