"""The command `python -m jaxsafe.config docking3d` prints an environment.

It prints the complete environment as one YAML file on standard output.
"""

from __future__ import annotations

import codecs
import sys
from collections.abc import Sequence

from jaxsafe.commands import cli
from jaxsafe.config.arguments import Arguments
from jaxsafe.schema.errors import ConfigError


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    from jaxsafe.config import describe
    from jaxsafe.envs import make
    from jaxsafe.schema import yaml12

    task, *words = argv
    if "=" in task:
        raise ConfigError(f"argument {task!r}: expected a task first, for instance docking3d")
    arguments = Arguments.parse(words)
    changes = arguments.pop_overrides()
    options = {name: arguments.pop_text(name) for name in ("actions", "variant", "rta")}
    arguments.refuse_rest([*options, "env.…"])
    env = make(task, changes, **options)  # type: ignore[arg-type]
    # Whoever reads the file takes it to be UTF-8, so output in another encoding is only ASCII.
    utf8 = codecs.lookup(sys.stdout.encoding).name == "utf-8"
    print(yaml12.write(describe(env), ascii_only=not utf8), end="")
    return 0


def usage() -> str:
    """Return the help text."""
    options = (
        "[actions=continuous|discrete] [variant=paper|released] [rta=PRESET] [env.PATH=VALUE …]"
    )
    return f"usage: python -m jaxsafe.config TASK {options}"


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, usage)
