"""The commands, one file each. Nothing else imports them."""

from __future__ import annotations

import importlib
import sys

COMMANDS = {
    "train": "train all seeds of a task, evaluate them, draw figures",
    "evaluate": "evaluate trained policies, in their own environment or another",
    "plot": "draw a run from its log files, or several runs in one figure",
    "tune": "train many settings as one program and rank them",
    "export": "write a policy as ONNX, StableHLO or VNN-LIB",
    "dataset": "write steps of policies as data for offline learning",
    "config": "print an environment as YAML",
    "verify": "prove that a policy is safe from every start in a box",
    "falsify": "let adversaries try to break a filter",
    "check": "check that results have what the protocol of the benchmark asks for",
    "safe_set": "draw where a filter certifies",
}
"""What each command does, in the order of the list that `jaxsafe` prints."""

SUBCOMMANDS = {
    "config types": "list the types of parts, or explain some",
    "config schema": "write a JSON schema, from which editors complete files",
}
"""What the commands of two words do. The module of `config types` is `config_types.py`."""

HELP = ("help", "-h", "--help")
"""Words that ask for the help text."""


def main() -> None:
    """Run `jaxsafe COMMAND [key=value …]`, a shorter form of `python -m jaxsafe.COMMAND`."""
    name, *words = sys.argv[1:] or ["help"]
    if name in HELP and words:
        name, *words = *words, HELP[0]
    if name in COMMANDS and words == ["--version"]:
        name = words.pop()
    if name in (*HELP, "--version"):
        from jaxsafe.commands.streams import lasting_streams
        from jaxsafe.storage.provenance import version

        with lasting_streams():
            print(_list() if name in HELP else f"jaxsafe {version()}")
        return
    if name not in COMMANDS:
        from jaxsafe.schema.errors import choices_text, show

        hint = choices_text(name, COMMANDS)
        print(f"error: unknown command {show(name)}{hint}", file=sys.stderr)
        sys.exit(2)
    sys.argv = [f"jaxsafe {name}", *words]
    importlib.import_module(f"jaxsafe.commands.{name}").command()


def _list() -> str:
    """Return the commands and how to call them."""
    listed = COMMANDS | SUBCOMMANDS
    width = max(map(len, listed))
    commands = [f"  {command:{width}}  {about}" for command, about in listed.items()]
    return "\n".join(
        [
            "usage: jaxsafe COMMAND [option=value …]",
            "",
            *commands,
            "",
            "jaxsafe train docking3d       trains a task; it is short for env=docking3d",
            "jaxsafe train docking3d help  explains the options of a command",
            "jaxsafe --version             says which version this is",
        ]
    )
