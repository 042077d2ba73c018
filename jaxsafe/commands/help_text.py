"""The help text of a command, made from the class of its options."""

from __future__ import annotations

import inspect
import json
import sys
import textwrap
import typing
from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatch
from typing import Any, NamedTuple

from jaxsafe.commands.options import CommandOptions, names_of, option, options_of, shown_name
from jaxsafe.config.arguments import TEXT
from jaxsafe.schema.component import Component, Field, choices, fields
from jaxsafe.schema.convert import bare, expects, to_data
from jaxsafe.schema.field_docs import field_docs

WIDTH = 100
"""Number of characters of a line."""

REST = "Options of every command."
"""Title of the options that are in no group."""


class Row(NamedTuple):
    """The description of an option, or of a field of a part."""

    name: str
    takes: str
    """What it takes, in words."""
    default: str
    """The default, as a user would write it. It is empty if there is none."""
    text: str
    """What it means."""


def help_text(cls: type[CommandOptions], given: Mapping[str, Any]) -> str:
    """Return the usage of a command, what it does, and a description of every option.

    Args:
        cls: the options of the command.
        given: options that may decide the defaults of others.

    Raises:
        ConfigError: one of the given options is wrong.
    """
    defaults, origin = cls.defaults(given)
    program = cls.program or f"jaxsafe {cls.__module__.rpartition('.')[2]}"
    about = [sys.modules[cls.__module__].__doc__ or "", origin]
    lines = [" ".join(["usage:", program, *_words(cls), "[option=value …]"])]
    for text in filter(None, about):
        lines += ["", *wrapped(text, indent=0)]
    options = [*entries(cls)]
    width = max(len(entry.name) for entry in options)
    for title, members in grouped(cls, options).items():
        lines += ["", *([title] if title else [])]
        for row in members:
            if row.name in defaults:
                row = row._replace(default=shown(defaults[row.name]))
            lines += row_lines(row, width, indent=2)
    return "\n".join(lines)


def row_lines(row: Row, width: int, indent: int) -> Iterator[str]:
    """Yield the lines about an option or a field.

    Args:
        row: the description of the option or field.
        width: number of characters for the name.
        indent: number of spaces before the name.
    """
    takes = f"{row.takes} (default {row.default})" if row.default else row.takes
    first, *rest = wrapped(takes, indent=indent + width + 2)
    yield f"{' ' * indent}{row.name:{width}}  {first.strip()}"
    yield from rest
    yield from wrapped(row.text, indent=indent + width + 2)


def grouped(cls: type[CommandOptions], options: Iterable[Row]) -> dict[str, list[Row]]:
    """Return the options of a command by the title of their group, those without a group last."""
    left = {entry.name: entry for entry in options}
    groups: dict[str, list[Row]] = {}
    for title, patterns in cls.groups.items():
        names = [name for pattern in patterns for name in left if fnmatch(name, pattern)]
        groups[title] = [left.pop(name) for name in names]
    return groups | {REST if groups else "": [*left.values()]}


def entries(cls: type[Component], start: str = "") -> Iterator[Row]:
    """Yield the description of each option.

    Args:
        cls: the options of a command, or a component whose fields are all options.
        start: the prefix of the names of the fields.
    """
    docs = field_docs(cls)
    table = options_of(cls) if issubclass(cls, CommandOptions) else fields(cls)
    for name, field in table.items():
        mark = option(field)
        text = docs.get(name, "")
        if mark.component:
            yield from entries(mark.component)
        elif isinstance(field.default, Component):
            if kinds := choices(bare(field.hint)):
                takes = f"one of {', '.join(kinds)}, or a mapping with such a type"
                default = field.default.type_name or ""
                yield Row(f"{start}{name}", takes=takes, default=default, text=text)
            yield from entries(type(field.default), f"{start}{name}.")
        else:
            default = "" if field.required or field.default is None else shown(field.default)
            yield Row(f"{start}{shown_name(field)}", _takes(field), default, text)


def wrapped(text: str, indent: int) -> list[str]:
    """Return a text as lines. Its paragraphs become one, because they are short."""
    space = " " * indent
    joined = " ".join(inspect.cleandoc(text).split())
    return textwrap.wrap(
        joined,
        WIDTH,
        initial_indent=space,
        subsequent_indent=space,
        break_on_hyphens=False,
    )


def shown(value: Any) -> str:
    """Return a value as a user would write it on a command line."""
    value = to_data(value)
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return ",".join(map(shown, value))
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}: {shown(item)}" for name, item in value.items()) + "}"
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    return f"{value:_}" if isinstance(value, int) else f"{value:g}"


def _words(cls: type[CommandOptions]) -> Iterator[str]:
    """Yield the words of the usage line: one example of each option that has examples."""
    for field in options_of(cls).values():
        for word in option(field).examples[:1]:
            yield word.partition("=")[2] if option(field).first else word


def _takes(field: Field) -> str:
    """Return in words what an option takes."""
    mark = option(field)
    hint = bare(field.hint)
    if mark.takes:
        return mark.takes
    if names := names_of(field):
        return f"{'some' if typing.get_origin(hint) is tuple else 'one'} of {', '.join(names)}"
    if hint is str:
        return TEXT
    if hint is int and field.range and field.range.high < float("inf"):
        return f"a whole number from {field.range.low:,} to {field.range.high:,}"
    if hint == tuple[int, ...]:
        return f"a list of whole numbers {field.range or ''}".rstrip()
    return expects(field)
