"""Print a complete environment as YAML on standard output.

A file with this text can be changed, and given to any command as env=FILE.yaml. It names the recipe
of the task, so `jaxsafe train FILE.yaml` trains as the task is trained.
"""

from __future__ import annotations

import codecs
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from jaxsafe.commands import cli
from jaxsafe.commands.environment_options import TaskOptions


class Options(TaskOptions):
    """The options of `jaxsafe config`."""

    recipes: bool = False
    """Whether the recipes of the task are printed in full, to be changed too."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    from jaxsafe.config import describe
    from jaxsafe.schema import yaml12

    options = Options.parse(argv)
    data = describe(options.make(options.env))
    name, presets = _recipes(options)
    data = {
        **({"recipe": name} if name else {}),
        **data,
        **({"recipes": presets} if presets else {}),
    }
    # Whoever reads the file takes it to be UTF-8, so output in another encoding is only ASCII.
    utf8 = codecs.lookup(sys.stdout.encoding).name == "utf-8"
    print(yaml12.write(data, ascii_only=not utf8), end="")
    return 0


def _recipes(options: Options) -> tuple[str | None, Mapping[str, Any]]:
    """Return the task or file that a printed environment names for its recipes, and its own ones."""
    from jaxsafe.config import load_recipe_name, load_recipes
    from jaxsafe.envs import find_task, is_file

    task = options.env
    if options.recipes:
        from jaxsafe.train.host.options import recipes

        return None, recipes(task)
    if not is_file(task):
        return task if find_task(task).recipe else None, {}
    name = load_recipe_name(task)
    return name, {} if name else load_recipes(task)


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
