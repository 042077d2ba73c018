"""Several changes by dotted path, also of the type of a part, such as `deputy.type`."""

from __future__ import annotations

import typing
from collections.abc import Mapping, Sequence
from typing import Any

from jaxsafe.schema.component import Component, Kind, choices, fields, normalise
from jaxsafe.schema.convert import bare, choose_class, is_component, to_component, to_value
from jaxsafe.schema.dotted_paths import as_list, has_names, index_of, join, set_path

TYPE = "type"
"""Last name of a path that leads to the type of a part."""


def set_paths(component: Kind, changes: Mapping[str, Any], place: str = "") -> Kind:
    """Return the component with the values at some dotted paths replaced.

    A path that ends in `.type` changes the type of a part. Changes may stand in any order: a
    whole part is set before its type, and the type before the part's other fields.

    Args:
        component: the component.
        changes: new values by dotted path, which are checked and converted.
        place: what stands before the paths in error messages.

    Raises:
        ConfigError: a path leads nowhere, a value is wrong, or a part cannot have a type.
    """
    parents = [path.removesuffix(TYPE) for path in changes if path.endswith(f".{TYPE}")]
    whole_parts = [
        path for path in changes if any(parent.startswith(f"{path}.") for parent in parents)
    ]
    for path in whole_parts:
        component = set_path(component, path, changes[path], to_value, place)
    remaining = {path: value for path, value in changes.items() if path not in whole_parts}
    component, remaining = _change_types(component, remaining, place)
    for path, value in remaining.items():
        component = set_path(component, path, value, to_value, place)
    return component


def _change_types(
    component: Kind, changes: Mapping[str, Any], place: str
) -> tuple[Kind, dict[str, Any]]:
    """Apply the changes of types. Return the component, and the changes that remain.

    A part with a new type keeps the fields that both types have. The changes must give the other
    fields that the new type requires. Their order does not matter.

    Args:
        component: the component.
        changes: new values by dotted path. Paths to types end in `.type`.
        place: what stands before the paths in error messages.
    """
    remaining = dict(changes)
    typed = [path for path in changes if path.endswith(f".{TYPE}")]
    for path in sorted(typed, key=lambda path: path.count(".")):
        names = _names(component, path)[:-1]
        part_and_base = _part_and_base(component, names)
        if part_and_base is None:
            continue
        part, base = part_and_base
        kind = remaining.pop(path)
        part_place = join(place, path.removesuffix(f".{TYPE}"))
        new_fields = fields(choose_class({TYPE: kind}, base, part_place)[0])
        old_fields = {} if part is None else fields(type(part))
        entries = {name: getattr(part, name) for name in old_fields if name in new_fields}
        for other in [other for other in remaining if _names(component, other)[:-1] == names]:
            name = other.rpartition(".")[2]
            field = new_fields.get(name)
            if field is None or has_names(entries.get(name), remaining[other]):
                continue
            if field.required or name in entries:
                value = as_list(remaining.pop(other), entries.get(name), field, join(place, other))
                entries[name] = value
        changed = normalise(to_component({TYPE: kind, **entries}, base, part_place))
        component = _put(component, names, changed)
    return component, remaining


def _names(component: Component, path: str) -> list[str]:
    """Return the names of a path, with the component's `shorthand` field where it is left out."""
    names = path.split(".")
    shorthand = component.shorthand
    if shorthand and names[0] not in fields(type(component)):
        return [shorthand, *names]
    return names


def _part_and_base(
    component: Component, names: Sequence[str]
) -> tuple[Component | None, type[Component]] | None:
    """Return the part at a path, and the base class of the parts that may stand there.

    None is returned if the path leads nowhere, or if the parts there have no types.
    """
    value: Any = component
    base: Any = None
    for name in names:
        if isinstance(value, tuple):
            if name not in [getattr(item, "name", str(i)) for i, item in enumerate(value)]:
                return None
            value = value[index_of(value, name, name)]
            continue
        if not isinstance(value, Component) or name not in fields(type(value)):
            return None
        base = bare(fields(type(value))[name].hint)
        if typing.get_origin(base) is tuple:
            base = bare(typing.get_args(base)[0])
        value = getattr(value, name)
    typed = is_component(base) and choices(base)
    return (value, base) if typed and (value is None or isinstance(value, Component)) else None


def _put(component: Any, names: Sequence[str], part: Component) -> Any:
    """Return the component, or the list of parts, with the part at a path replaced."""
    if not names:
        return part
    name, *rest = names
    if isinstance(component, tuple):
        index = index_of(component, name, name)
        return (*component[:index], _put(component[index], rest, part), *component[index + 1 :])
    return component.replace(**{name: _put(getattr(component, name), rest, part)})
