"""Print a complete environment as YAML on standard output.

The text can be kept in a file, changed, and given to any command as env=FILE.yaml. It names the
recipe of the task, so `jaxsafe train FILE.yaml` trains as the task is trained.
"""

from __future__ import annotations

import codecs
import importlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from jaxsafe.commands import SUBCOMMANDS, cli
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
    name, own = _recipes(options.env, options.recipes)
    if name:
        data = {"recipe": name, **data}
    if own:
        data["recipes"] = own
    # The reader of the file assumes UTF-8, so output in another encoding has only ASCII.
    utf8 = codecs.lookup(sys.stdout.encoding).name == "utf-8"
    print(yaml12.write(data, ascii_only=not utf8), end="")
    return 0


def _recipes(env: str, in_full: bool) -> tuple[str | None, Mapping[str, Any]]:
    """Return the task or file whose recipe a printed environment names, and recipes to print.

    Args:
        env: a task or a file.
        in_full: whether to return recipes instead of the name of a task or a file.
    """
    from jaxsafe.config import load_recipe_name, load_recipes
    from jaxsafe.envs import find_task, is_file

    if in_full:
        from jaxsafe.train.host.options import recipes

        return None, recipes(env)
    if not is_file(env):
        return env if find_task(env).recipe else None, {}
    name = load_recipe_name(env)
    return name, {} if name else load_recipes(env)


def command() -> None:
    """Run the command on the words of the command line."""
    name = next(iter(sys.argv[1:]), "")
    if f"config {name}" in SUBCOMMANDS:
        sys.argv = [f"{sys.argv[0]} {name}", *sys.argv[2:]]
        importlib.import_module(f"jaxsafe.commands.config_{name}").command()
    else:
        cli.run(main, Options)
