"""Dotted paths into components, such as `reward.delta_v.scale` or `deputy.mass`.

A path consists of the names of fields and of parts in a list, for instance
`deputy.controller.actuators.thrust_x.low`. It may also begin with the name of a part in the
component's `shorthand` field. In an environment these parts are the platforms.
"""

from __future__ import annotations

import difflib
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any

from jaxsafe.schema.component import Component, Field, Refers, fields
from jaxsafe.schema.errors import ConfigError, choices_text, show

Convert = Callable[[Any, Field, str], Any]
"""`convert(value, field, place)` returns the value that the field takes.

It raises a ConfigError that names the place if the field does not take the value.
"""


def join(place: str, name: str) -> str:
    """Return `place.name`, or one of the two alone where the other is empty."""
    return f"{place}.{name}" if place and name else place or name


def as_given(value: Any, field: Field, place: str) -> Any:
    """Return the value unchanged: the `Convert` that checks nothing."""
    return value


def get_path(component: Any, path: str) -> Any:
    """Return the value at a dotted path, which must lead somewhere.

    If the path leads to a list of named parts, their names are returned. `set_path` takes such a
    list of names.
    """
    value = component
    for name in path.split("."):
        if value is component and name not in fields(type(component)):
            value = getattr(component, component.shorthand)
        if isinstance(value, tuple):
            value = value[index_of(value, name, path)]
        else:
            value = value[name] if isinstance(value, Mapping) else getattr(value, name)
    named = isinstance(value, tuple) and all(hasattr(part, "name") for part in value)
    return [part.name for part in value] if named else value


def set_path(
    component: Any, path: str, value: Any, convert: Convert = as_given, place: str = ""
) -> Any:
    """Return the component with the value at one dotted path replaced.

    If the path leads to a list of named parts, a name in the new list stands for the part that has
    it now. A text with commas is read as a list if the field holds or takes a list.

    Args:
        component: the component.
        path: the path, which begins at the component.
        value: the new value.
        convert: the function that checks and converts the value.
        place: what stands before the path in error messages.

    Raises:
        ConfigError: the path leads nowhere, or `convert` refuses the value.
    """
    return _set(component, path.split("."), value, convert, place, component.shorthand)


def _set(
    component: Any,
    path: list[str],
    value: Any,
    convert: Convert,
    place: str,
    shorthand: str | None = None,
) -> Any:
    """Do what `set_path` does for a component that stands at `place`.

    The path may begin with a part of the field `shorthand`.
    """
    head = path[0]
    rest = path[1:]
    table = fields(type(component))
    parts = getattr(component, shorthand) if shorthand else ()
    names = [part.name for part in parts]
    if shorthand and head not in table and head in names:
        return component.replace(**{shorthand: _set_item(parts, path, value, convert, place)})
    if head not in table:
        meant = _meant(component, path, [*table, *names], shorthand)
        if meant and "." in meant:
            meant = join(place, meant)  # a path that leads into another part is shown whole
        raise ConfigError(
            f"{join(place, head)}: unknown {component.field_word} {show(head)}"
            f"{choices_text(head, [*table, *names], meant)}"
        )
    field_place = join(place, head)
    content = getattr(component, head)
    if not rest:
        value = as_list(value, content, table[head], field_place)
        if has_names(content, value):
            value = tuple(
                content[index_of(content, item, field_place)] if isinstance(item, str) else item
                for item in value
            )
            if all(any(item is part for part in content) for item in value):
                return component.replace(**{head: value})
        return component.replace(**{head: convert(value, table[head], field_place)})
    if isinstance(content, Component):
        return component.replace(**{head: _set(content, rest, value, convert, field_place)})
    if isinstance(content, tuple):
        return component.replace(**{head: _set_item(content, rest, value, convert, field_place)})
    by_path = isinstance(content, Mapping) and _by_path(table[head])
    if by_path or (isinstance(content, Mapping) and len(rest) == 1):
        key = ".".join(rest)
        if not by_path and key not in content:
            raise ConfigError(
                f"{field_place}: unknown name {show(key)}{choices_text(key, content)}"
            )
        entries = {**content, key: value}
        return component.replace(**{head: convert(entries, table[head], field_place)})
    reason = " because it is not set" if content is None else ""
    raise ConfigError(f"{join(field_place, rest[0])}: {field_place} has no fields{reason}")


def _by_path(field: Field) -> bool:
    """Return whether a field is a mapping whose keys are dotted paths, such as `randomize`."""
    return any(refers.section == "parameters" for refers in _item_references(field.hint))


def _set_item(items: tuple, path: list[str], value: Any, convert: Convert, place: str) -> tuple:
    """Return the items with one value replaced. The path begins with the name of an item."""
    index = index_of(items, path[0], place)
    item_place = join(place, path[0])
    if len(path) == 1:
        raise ConfigError(
            f"{item_place}: name one of its fields: {', '.join(fields(type(items[index])))}"
        )
    changed = _set(items[index], path[1:], value, convert, item_place)
    return (*items[:index], changed, *items[index + 1 :])


def _meant(
    component: Component, path: Sequence[str], first_names: Sequence[str], shorthand: str | None
) -> str | None:
    """Return the path that a user probably meant by one that leads nowhere, or None.

    It ends like the given path, or in a name that the given path abbreviates or misspells. The
    component's `synonyms` come first.

    Args:
        component: the component at which the path begins.
        path: the path. Its first name is no field of the component.
        first_names: names with which a path may begin.
        shorthand: the field of the component whose parts may stand at the beginning of a path.
    """
    if ".".join(path) in component.synonyms:
        return component.synonyms[".".join(path)]
    ends = {}  # the shortest path to each name
    for other in sorted(_paths(component, shorthand), key=lambda other: other.count(".")):
        if f".{other}".endswith("." + ".".join(path)):
            return other
        ends.setdefault(other.rpartition(".")[2], other)
    if len(path) > 1:
        return next(iter(difflib.get_close_matches(path[0], first_names, n=1, cutoff=0.5)), None)
    ends |= {name: name for name in first_names}
    short = [other for name, other in ends.items() if _abbreviates(path[0], name)]
    alike = [ends[name] for name in difflib.get_close_matches(path[0], ends, n=1, cutoff=0.5)]
    return next(iter([*short, *alike]), None)


def find_path(component: Component, name: str) -> str | None:
    """Return the shortest path to a field of a component that has this name, or None."""
    paths = _paths(component, component.shorthand)
    ends_so = (path for path in paths if path.rpartition(".")[2] == name)
    return min(ends_so, key=lambda path: path.count("."), default=None)


def _paths(component: Component, shorthand: str | None = None) -> Iterator[str]:
    """Yield the path of every field of a component and of the components inside it."""
    for name in fields(type(component)):
        value = getattr(component, name)
        yield name
        if isinstance(value, Component):
            yield from (join(name, path) for path in _paths(value))
        if isinstance(value, Mapping):
            # A key with a dot, as `randomize` has, cannot be one name of a path.
            yield from (join(name, str(key)) for key in value if "." not in str(key))
        for index, part in enumerate(value if isinstance(value, tuple) else ()):
            if isinstance(part, Component):
                place = "" if name == shorthand else name
                start = join(place, getattr(part, "name", str(index)))
                yield from (join(start, path) for path in _paths(part))


def _abbreviates(short: str, name: str) -> bool:
    """Return whether a text abbreviates a name, as `lr` and `learn` do `learning_rate`."""
    if len(short) > 2 and name.startswith(short):
        return True
    starts = short.split("_") if "_" in short else [*short]
    words = name.split("_")
    return len(starts) == len(words) > 1 and all(map(str.startswith, words, starts))


def as_list(value: Any, content: Any, field: Field, place: str) -> Any:
    """Return the list that a text with commas stands for, and any other value unchanged.

    Such a text stands for a list only if the field holds a list or takes one.

    Args:
        value: the value for a field.
        content: what the field holds now.
        field: the field.
        place: where the field stands.
    """
    holds_list = isinstance(content, tuple) or (field.unit and field.unit.length is not None)
    if not holds_list or not isinstance(value, str) or "," not in value:
        return value
    from jaxsafe.schema import yaml12

    return yaml12.parse(f"[{value}]", place)


def has_names(content: Any, value: Any) -> bool:
    """Return whether a field holds named parts and the value for it is a list with names."""
    named = (
        isinstance(content, tuple) and content and all(hasattr(part, "name") for part in content)
    )
    listed = isinstance(value, (list, tuple))
    return bool(named and listed and any(isinstance(item, str) for item in value))


def index_of(items: tuple, name: str, place: str) -> int:
    """Return the index of the item with a name. The name of a nameless item is its index.

    Raises:
        ConfigError: there is no such item.
    """
    names = [getattr(item, "name", str(index)) for index, item in enumerate(items)]
    if name not in names:
        raise ConfigError(
            f"{join(place, name)}: unknown name {show(name)}{choices_text(name, names)}"
        )
    return names.index(name)


def references(component: Component, place: str) -> Iterator[tuple[str, Refers, str]]:
    """Yield each name by which a component refers to another part.

    Yields:
        The place where the name stands, what it refers to, and the name.
    """
    for name, field in fields(type(component)).items():
        value = getattr(component, name)
        field_place = join(place, name)
        marked = [(field.refers, value)] if field.refers else _marked_items(field.hint, value)
        for refers, content in marked:
            if isinstance(content, str):
                yield field_place, refers, content
        if isinstance(value, Mapping):
            for refers in _item_references(field.hint):
                for key in value:
                    yield field_place, refers, key
        for inner in value if isinstance(value, tuple) else (value,):
            if isinstance(inner, Component):
                yield from references(inner, join(field_place, getattr(inner, "name", "")))


def _marked_items(hint: Any, value: Any) -> list[tuple[Refers, Any]]:
    """Return the names in a `tuple[Annotated[str, Refers(…)], …]`, each with what it refers to."""
    if not isinstance(value, tuple):
        return []
    return [(refers, item) for refers in _item_references(hint) for item in value]


def _item_references(hint: Any) -> list[Refers]:
    """Return what the items of a tuple or the keys of a mapping refer to.

    The annotation is `tuple[Annotated[str, Refers(…)], …]` or
    `Mapping[Annotated[str, Refers(…)], …]`. For any other there is nothing to return.
    """
    item = next(iter(typing.get_args(hint)), None)
    marks = typing.get_args(item)[1:] if typing.get_origin(item) is Annotated else ()
    return [mark for mark in marks if isinstance(mark, Refers)]
