"""Write a JSON schema, with which editors complete and check the files of environments.

An editor with a YAML language server reads it where a file begins with the line
# yaml-language-server: $schema=jaxsafe.schema.json
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from jaxsafe.commands import cli
from jaxsafe.commands.config_types import Modules
from jaxsafe.commands.options import CommandOptions, File


class Options(CommandOptions):
    """The options of `jaxsafe config schema`."""

    program: ClassVar = "jaxsafe config schema"

    out: File | None = None
    """Where to write. By default the schema is printed."""
    modules: Modules = ()
    """Modules of your own to import first, so that their types are part of the schema."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    options = Options.parse(argv)
    from jaxsafe.schema.user_modules import import_modules
    from jaxsafe.storage.files import write_text

    import_modules(list(options.modules), "")
    text = json.dumps(environment_schema(), indent=1, ensure_ascii=options.out is None) + "\n"
    if options.out is None:
        print(text, end="")
    else:
        write_text(Path(options.out), text)
        print(f"schema: {options.out}")
    return 0


def environment_schema() -> dict[str, Any]:
    """Return the schema of a file with an environment, its imports and its recipes."""
    from jaxsafe.environment import Environment
    from jaxsafe.envs import STARTERS, TASKS
    from jaxsafe.schema.json_schema import json_schema, options_schema
    from jaxsafe.train.host.options import NO_RECIPE, TrainConfig

    schema = json_schema(Environment)
    schema["properties"] |= {
        "imports": {
            "type": "array",
            "items": {"type": "string"},
            "description": "Modules that define parts of the environment.",
        },
        "recipe": {
            "anyOf": [{"enum": [*TASKS, *STARTERS, NO_RECIPE]}, {"type": "string"}],
            "description": "The task or the file whose recipe trains the environment.",
        },
        "recipes": {
            "type": "object",
            "additionalProperties": {"anyOf": [options_schema(TrainConfig), {"type": "null"}]},
            "description": "Options of `jaxsafe train` by preset. The first one is the default.",
        },
    }
    return schema


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options, alone=True)
