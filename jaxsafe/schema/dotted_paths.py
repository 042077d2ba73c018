"""Dotted paths into components: `reward.delta_v.scale`, `deputy.mass`, `deputy.controller.actuators.thrust_x.low`.

A path walks through field names and the names of the parts in a list; at the start it may also name a part of the
component's `shorthand` field, a platform of an environment.
"""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any

from jaxsafe.schema.component import Component, Field, Refers, fields
from jaxsafe.schema.errors import ConfigError, nearest, show

Convert = Callable[[Any, Field, str], Any]
"""`convert(value, field, place)`: the value that the field takes, or a ConfigError that names the place."""


def join(place: str, name: str) -> str:
    """`place.name`; either alone where the other is empty."""
    return f"{place}.{name}" if place and name else place or name


def as_given(value: Any, field: Field, place: str) -> Any:
    """A `Convert` that checks nothing."""
    return value


def get_path(component: Any, path: str) -> Any:
    """Return the value at a dotted path, which must lead somewhere. Of named parts it is the names, as `set_path` takes."""
    value = component
    for name in path.split("."):
        if value is component and name not in fields(type(component)):
            value = getattr(component, component.shorthand)
        value = value[_index(value, name, path)] if isinstance(value, tuple) else getattr(value, name)
    named = isinstance(value, tuple) and all(hasattr(part, "name") for part in value)
    return [part.name for part in value] if named else value


def set_path(component: Any, path: str, value: Any, convert: Convert = as_given) -> Any:
    """Return the component with the value at one dotted path replaced.

    Where the path leads to a list of named parts, a list of names picks them, in the new order.

    Raises:
        ConfigError: the path leads nowhere, or `convert` refuses the value.
    """
    return _set(component, path.split("."), value, convert, "")


def _set(component: Any, path: list[str], value: Any, convert: Convert, place: str) -> Any:
    head, rest = path[0], path[1:]
    table = fields(type(component))
    parts = getattr(component, component.shorthand) if component.shorthand and not place else ()
    names = [part.name for part in parts]
    if head not in table and head in names:
        return component.replace(**{component.shorthand: _set_item(parts, path, value, convert, place)})
    if head not in table:
        raise ConfigError(f"{join(place, head)}: unknown field {show(head)}; choose from {nearest(head, [*table, *names])}")
    here, inner = join(place, head), getattr(component, head)
    if not rest:
        picked = _pick(inner, value, here) if _are_names(inner, value) else convert(value, table[head], here)
        return component.replace(**{head: picked})
    if isinstance(inner, Component):
        return component.replace(**{head: _set(inner, rest, value, convert, here)})
    if isinstance(inner, tuple):
        return component.replace(**{head: _set_item(inner, rest, value, convert, here)})
    if isinstance(inner, Mapping) and len(rest) == 1:
        if rest[0] not in inner:
            raise ConfigError(f"{here}: unknown name {show(rest[0])}; choose from {nearest(rest[0], inner)}")
        return component.replace(**{head: convert({**inner, rest[0]: value}, table[head], here)})
    raise ConfigError(f"{join(here, rest[0])}: {here} has no fields" + (" because it is not set" if inner is None else ""))


def _set_item(items: tuple, path: list[str], value: Any, convert: Convert, place: str) -> tuple:
    index = _index(items, path[0], place)
    if len(path) == 1:
        raise ConfigError(f"{join(place, path[0])}: name one of its fields: {', '.join(fields(type(items[index])))}")
    changed = _set(items[index], path[1:], value, convert, join(place, path[0]))
    return (*items[:index], changed, *items[index + 1 :])


def _are_names(inner: Any, value: Any) -> bool:
    named = isinstance(inner, tuple) and inner and all(hasattr(part, "name") for part in inner)
    return bool(named and value and isinstance(value, (list, tuple)) and all(isinstance(one, str) for one in value))


def _pick(items: tuple, names: Sequence[str], place: str) -> tuple:
    return tuple(items[_index(items, name, place)] for name in names)


def _index(items: tuple, name: str, place: str) -> int:
    names = [getattr(item, "name", str(index)) for index, item in enumerate(items)]
    if name not in names:
        raise ConfigError(f"{join(place, name)}: unknown name {show(name)}; choose from {nearest(name, names)}")
    return names.index(name)


def references(component: Component, place: str) -> Iterator[tuple[str, Refers, str]]:
    """Yield each name of another part that a component has: the place of the name, what it refers to, and the name."""
    for name, field in fields(type(component)).items():
        value, here = getattr(component, name), join(place, name)
        for refers, one in [(field.refers, value)] if field.refers else _listed(field.hint, value):
            if isinstance(one, str):
                yield here, refers, one
        if isinstance(value, Mapping):
            yield from ((here, refers, key) for refers in _key_refers(field.hint) for key in value)
        for inner in value if isinstance(value, tuple) else (value,):
            if isinstance(inner, Component):
                yield from references(inner, join(here, getattr(inner, "name", "")))


def _listed(hint: Any, value: Any) -> list[tuple[Refers, Any]]:
    """The names in a `tuple[Annotated[str, Refers(…)], …]`, each with what it refers to."""
    return [(refers, one) for refers in _key_refers(hint) for one in value] if isinstance(value, tuple) else []


def _key_refers(hint: Any) -> list[Refers]:
    """What the keys of `Mapping[Annotated[str, Refers(…)], …]`, or the elements of such a tuple, refer to."""
    key = next(iter(typing.get_args(hint)), None)
    marks = typing.get_args(key)[1:] if typing.get_origin(key) is Annotated else ()
    return [mark for mark in marks if isinstance(mark, Refers)]
