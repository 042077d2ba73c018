"""Print the types that an environment, a filter and an agent are made of.

The first word is a section, such as reward, or a type, such as distance_change. The fields of these
types are printed. Without a word all sections are listed with their types.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, ClassVar

from jaxsafe.commands import cli
from jaxsafe.commands.catalogue import SECTIONS, Entry, describe, find, title, types_of
from jaxsafe.commands.help_text import WIDTH, row_lines, wrapped
from jaxsafe.commands.options import CommandOptions, Option
from jaxsafe.schema.field_docs import summary
from jaxsafe.schema.user_modules import import_modules

Modules = Annotated[tuple[str, ...], Option(takes="names of modules")]
"""Modules that a user has written."""


class Options(CommandOptions):
    """The options of `jaxsafe config types`."""

    program: ClassVar = "jaxsafe config types"

    name: Annotated[str, Option(first=True, takes="a section or a type")] | None = None
    """What to explain, for instance reward or distance_change."""
    modules: Modules = ()
    """Modules of your own to import first, so that their types are listed too."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    options = Options.parse(argv)
    import_modules(list(options.modules), "")
    if options.name is None:
        print("\n".join(_overview()))
    else:
        entries = [describe(cls, with_users=True) for cls in find(options.name)]
        print("\n\n".join("\n".join(_explained(entry)) for entry in entries))
    return 0


def _overview() -> Iterator[str]:
    """Yield a line for each section and each of its types."""
    for name, section in SECTIONS.items():
        yield name
        types = types_of(section, with_users=True)
        width = max(len(title(cls)) for cls in types)
        for cls in types:
            line = f"  {title(cls):{width}}  {summary(cls)}"
            yield line if len(line) <= WIDTH else f"{line[: WIDTH - 1].rpartition(' ')[0]} …"


def _explained(entry: Entry) -> Iterator[str]:
    """Yield the lines about a type: its name, what it is, and its fields."""
    yield entry.name
    for paragraph in entry.paragraphs:
        yield from wrapped(paragraph, indent=2)
    width = max((len(row.name) for row in entry.rows), default=0)
    for row in entry.rows:
        plain = row._replace(takes=row.takes.replace("`", ""), default=row.default.replace("`", ""))
        yield from row_lines(plain, width, indent=4)


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options, alone=True)
