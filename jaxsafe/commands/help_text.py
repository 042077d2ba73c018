"""The help text of a command, made from the class of its options."""

from __future__ import annotations

import inspect
import json
import shlex
import sys
import textwrap
import typing
from collections.abc import Iterator

from jaxsafe.commands.options import CommandOptions, names_of, option, options_of, shown_name
from jaxsafe.config.arguments import TEXT
from jaxsafe.schema.component import Component, Field, choices, fields
from jaxsafe.schema.convert import bare, expects, to_data
from jaxsafe.schema.field_docs import field_docs

WIDTH = 100
"""Number of letters of a line."""


def help_text(cls: type[CommandOptions]) -> str:
    """Return the usage, what the command does, and every option with all that is known of it."""
    program = cls.program or f"jaxsafe {cls.__module__.rpartition('.')[2]}"
    words = [word for field in options_of(cls).values() for word in option(field).examples[:1]]
    usage = " ".join(["usage:", program, *map(shlex.quote, words), "[option=value …]"])
    rows = [*entries(cls)]
    width = max(len(name) for name, *_ in rows)
    lines = [usage, "", *_wrapped(sys.modules[cls.__module__].__doc__ or "", indent=0), ""]
    for name, takes, text in rows:
        first, *rest = _wrapped(takes, indent=width + 4)
        lines += [f"  {name:{width}}  {first.strip()}", *rest, *_wrapped(text, indent=width + 4)]
    return "\n".join(lines)


def entries(cls: type[Component], start: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield the name of each option, what it takes, and the text that explains it.

    Args:
        cls: the options of a command, or a component of which every field is an option.
        start: what stands before the names of the fields.
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
                yield f"{start}{name}", f"a mapping with a type: {', '.join(kinds)}", text
            yield from entries(type(field.default), f"{start}{name}.")
        else:
            yield f"{start}{shown_name(field)}", f"{_takes(field)}{_default(field)}", text


def _wrapped(text: str, indent: int) -> list[str]:
    """Return a text in lines. Its paragraphs become one, as they are short."""
    space = " " * indent
    words = " ".join(inspect.cleandoc(text).split())
    return textwrap.wrap(
        words,
        WIDTH,
        initial_indent=space,
        subsequent_indent=space,
        break_on_hyphens=False,
    )


def _default(field: Field) -> str:
    if field.required or field.default is None:
        return ""
    value = to_data(field.default)
    number = isinstance(value, float)
    text = f"{value:g}" if number else value if isinstance(value, str) else json.dumps(value)
    return f" (default {text})"


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
