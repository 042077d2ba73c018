"""Conversion of plain data to components and back, by the annotations of their fields.

Every fault is reported in one line that names its place.
"""

from __future__ import annotations

import contextlib
import math
import sys
import types
import typing
from collections.abc import Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxsafe.schema.component import (
    ANY,
    Component,
    Field,
    Kind,
    Range,
    choices,
    fields,
    normalise,
    unwrap_optional,
)
from jaxsafe.schema.component import field as field_of
from jaxsafe.schema.dotted_paths import join
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.schema.user_modules import import_modules

DIRECTORY: ContextVar[Path] = ContextVar("DIRECTORY", default=Path())
"""The directory that relative paths in a configuration start from.

While a file is read, this is the directory of the file.
"""

_SHAPES = {
    None: "a number",
    2: "a list [low, high]",
    0: "a list of numbers",
    ANY: "a number or a list of numbers",
}
"""What a field with a unit takes, by the length of the unit."""

_UNITS_WITHOUT_SYMBOL = ("1", "physical", "as observed")
"""Symbols that name no particular unit. Messages leave them out."""


def to_component(data: Any, base: type[Kind], place: str) -> Kind:
    """Build a component from a mapping, whose `type` chooses among the subclasses of `base`.

    The name of a type alone stands for that type with the defaults of its fields. `MODULE:CLASS`
    names a class of a user's module, which is imported.

    Raises:
        ConfigError: a value is wrong. The message names the place, what was found and what is
            allowed.
    """
    if isinstance(data, base):
        return normalise(data)
    options = choices(base)
    if isinstance(data, str) and options and (":" in data or data in options):
        data = {"type": data}
    if not isinstance(data, Mapping):
        raise _no_mapping(data, base, place)
    cls, entries = choose_class(dict(data), base, place)
    table = fields(cls)
    label = f"{place} ({cls.type_name})" if cls.type_name else place or "environment"
    entries = cls.prepared(entries, label)
    for name in entries:
        if name not in table:
            raise ConfigError(
                f"{label}: unknown {cls.field_word} {show(name)}"
                f"{choices_text(name, table, cls.synonyms.get(name))}"
            )
    for name, field in table.items():
        if field.required and name not in entries:
            raise ConfigError(f"{label}: field {name!r} is missing; it takes {expects(field)}")
    values = {
        name: to_value(value, table[name], join(place, name)) for name, value in entries.items()
    }
    return normalise(cls(**values))  # defaults are still Python numbers


def to_value(value: Any, field: Field, place: str) -> Any:
    """Check and convert the value of one field.

    Raises:
        ConfigError: the field does not take this value.
    """
    if field.unit:
        if value is None and is_optional(field.hint):
            return None
        return _to_array(value, field, place)
    return _to_structure(value, field.hint, field, place)


def to_data(value: Any) -> Any:
    """Return a component as plain data. It is complete: `to_component(to_data(c), …) == c`."""
    if isinstance(value, Component):
        entries = {name: to_data(getattr(value, name)) for name in fields(type(value))}
        return ({"type": value.type_name} if value.type_name else {}) | entries
    if isinstance(value, tuple):
        return [to_data(item) for item in value]
    if isinstance(value, Mapping):
        return {key: to_data(item) for key, item in value.items()}
    if isinstance(value, (jax.Array, np.ndarray, np.generic)):
        return _shortest(np.asarray(value))
    return value


def expects(field: Field) -> str:
    """Describe in words what a field takes."""
    if field.unit:
        symbol = field.unit.symbol
        unit = "" if symbol in _UNITS_WITHOUT_SYMBOL else f" in {symbol}"
        return f"{_SHAPES[field.unit.length]}{unit} {field.range or ''}".rstrip()
    core = bare(field.hint)
    if is_union(core):
        return " or ".join(expects(field_of("", member)) for member in members(core))
    if typing.get_origin(core) is Literal:
        return "one of " + ", ".join(map(str, typing.get_args(core)))
    by_type = {str: "a name", int: "a whole number", bool: "true or false", float: "a number"}
    mapping = is_component(core) or is_mapping(core)
    expected = by_type.get(core, "a mapping" if mapping else "a list")
    return f"{expected} {field.range}" if field.range else expected


def choose_class(entries: dict, base: type[Kind], place: str) -> tuple[type[Kind], dict]:
    """Return the class that `type` names and the other entries, or `base` if it has no types."""
    options = choices(base)
    if not options:
        return base, entries
    if "type" not in entries:
        raise ConfigError(f"{place}: field 'type' is missing{choices_text('', sorted(options))}")
    kind = entries.pop("type")
    if isinstance(kind, str) and ":" in kind:
        return _import_class(kind, base, place), entries
    if not isinstance(kind, str) or kind not in options:
        raise ConfigError(
            f"{place}: unknown type {show(kind)}{choices_text(kind, sorted(options))}"
        )
    return options[kind], entries


def _no_mapping(data: Any, base: type[Component], place: str) -> ConfigError:
    """Return the error of a part that is no mapping.

    If the name of a type alone would do, because all fields of all types have defaults, the error
    lists the names.
    """
    options = choices(base)
    name_suffices = options and not any(
        field.required for option in options.values() for field in fields(option).values()
    )
    if isinstance(data, str) and name_suffices:
        return ConfigError(f"{place}: found {show(data)}{choices_text(data, options)}")
    return ConfigError(
        f"{place or 'environment'}: expected a mapping of fields, found {_show(data)}"
    )


def _import_class(name: str, base: type[Kind], place: str) -> type[Kind]:
    """Return the class that `MODULE:CLASS` names.

    Raises:
        ConfigError: the module cannot be imported, or has no such class.
    """
    module, _, class_name = name.partition(":")
    import_modules([module], place)
    cls = getattr(sys.modules[module], class_name, None)
    if not (isinstance(cls, type) and issubclass(cls, base) and cls.type_name):
        raise ConfigError(
            f"{place}: {module} has no {base.__name__} with a type called {show(class_name)}"
        )
    return cls


def _to_structure(value: Any, hint: Any, field: Field, place: str) -> Any:
    """Convert a value that has no unit.

    Args:
        value: the value.
        hint: the annotation of the value. It is that of the field, or that of an item if the field
            is a list.
        field: the field, for error messages.
        place: where the value stands.
    """
    optional = is_optional(hint)
    hint = bare(hint)
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if value is None and optional:
        return None
    if is_component(hint):
        return to_component(value, hint, place)
    if is_union(hint):
        return to_value(value, _member(value, hint), place)
    if origin is tuple:
        return _to_tuple(value, arguments[0], field, place)
    if is_mapping(hint):
        return _to_mapping(value, arguments[1], place)
    if origin is Literal:
        if value not in arguments:
            raise ConfigError(f"{place}: found {_show(value)}{choices_text(value, arguments)}")
        return value
    given = value
    if hint is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):  # a number too large for a float is refused below
            value = float(value)
    if not isinstance(value, hint) or (hint in (int, float) and isinstance(value, bool)):
        raise ConfigError(f"{place}: expected {expects(field)}, found {_show(value)}")
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        limits = field.range or Range()
        if value not in limits or (hint is float and not math.isfinite(value)):
            raise ConfigError(f"{place}: expected {expects(field)}, found {show(value)}")
        if not limits.carries(value):
            raise ConfigError(
                f"{place}: expected {expects(field)} {limits.magnitudes}, found {show(given)}"
            )
    return value


def _to_tuple(value: Any, item_hint: Any, field: Field, place: str) -> tuple:
    """Convert a list. The place of an item is its name, or its index if it has none."""
    if not isinstance(value, (list, tuple)):
        raise ConfigError(f"{place}: expected a list, found {_show(value)}")
    items = []
    for index, item in enumerate(value):
        name = item.get("name") if isinstance(item, Mapping) else getattr(item, "name", None)
        item_place = join(place, name if isinstance(name, str) else f"[{index}]")
        items.append(_to_structure(item, item_hint, field, item_place))
    return tuple(items)


def _member(value: Any, hint: Any) -> Field:
    """Return a field that takes the value alone, for an annotation `number | Mapping[…]`."""
    fits = isinstance(value, Mapping)
    return next(field_of("", member) for member in members(hint) if is_mapping(member) == fits)


def _to_mapping(value: Any, item_hint: Any, place: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{place}: expected a mapping of names to values, found {_show(value)}")
    item_field = field_of("", item_hint)
    converted = {
        str(key): to_value(item, item_field, join(place, str(key))) for key, item in value.items()
    }
    return {key: converted[key] for key in sorted(converted)}  # sorted as in `normalise`


def _to_array(value: Any, field: Field, place: str) -> jax.Array:
    """Return a number or a list of numbers as an array of the default float.

    A traced value is checked for its shape only.
    """
    length = field.unit.length if field.unit else None
    wrong = ConfigError(f"{place}: expected {expects(field)}, found {_show(value)}")
    items = value if isinstance(value, (list, tuple)) else [value]
    if any(item is None or isinstance(item, (bool, str, Mapping, list, tuple)) for item in items):
        raise wrong
    try:
        array = value if isinstance(value, jax.Array) else np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        raise wrong from None
    dimensions = {None: (0,), ANY: (0, 1)}.get(length, (1,))
    if array.ndim not in dimensions or (length == 2 and array.shape != (2,)):
        if isinstance(value, jax.Array | np.ndarray) and array.ndim - 1 in dimensions:
            raise ConfigError(
                f"{place}: expected {expects(field)}, found an array of shape {array.shape}; "
                "for an environment with each value, use jax.vmap"
            )
        raise wrong
    if not isinstance(array, Tracer):
        with np.errstate(over="ignore"):  # a number beyond the largest float32 becomes infinite
            numbers = np.asarray(array, jnp.result_type(float))
        limits = field.range or Range()
        if np.isnan(numbers).any() or not all(
            number in limits for number in np.atleast_1d(numbers)
        ):
            raise wrong
        finite = np.isfinite(numbers) | (limits.infinite & np.isinf(np.asarray(array, float)))
        carried = all(limits.carries(number) for number in numbers[np.isfinite(numbers)].tolist())
        if not finite.all() or not carried:
            raise ConfigError(
                f"{place}: expected {expects(field)} {limits.magnitudes}, found {_show(value)}"
            )
        if length == 2 and numbers[0] > numbers[1]:
            raise ConfigError(f"{place}: expected low ≤ high, found {_show(value)}")
        if length == 2 and np.isinf(numbers[0]) and numbers[0] == numbers[1]:
            raise ConfigError(
                f"{place}: expected low < high where a bound is infinite, found {_show(value)}"
            )
        array = numbers
    return jnp.asarray(array, jnp.result_type(float))


def bare(hint: Any) -> Any:
    """Return an annotation without its marks and without `| None`."""
    if typing.get_origin(hint) is Annotated:
        return bare(typing.get_args(hint)[0])
    inner, optional = unwrap_optional(hint)
    return bare(inner) if optional else hint


def is_union(hint: Any) -> bool:
    """Return whether an annotation is `X | Y`."""
    return typing.get_origin(hint) in (typing.Union, types.UnionType)


def members(hint: Any) -> list[Any]:
    """Return X and Y of an annotation `X | Y` or `X | Y | None`."""
    return [member for member in typing.get_args(hint) if member is not type(None)]


def is_optional(hint: Any) -> bool:
    """Return whether an annotation allows None."""
    return is_union(hint) and type(None) in typing.get_args(hint)


def is_component(hint: Any) -> bool:
    """Return whether an annotation is a class of components."""
    return isinstance(hint, type) and issubclass(hint, Component)


def is_mapping(hint: Any) -> bool:
    """Return whether an annotation is `Mapping[…]` or one of its subclasses."""
    origin = typing.get_origin(hint)
    return isinstance(origin, type) and issubclass(origin, Mapping)


def _shortest(array: np.ndarray) -> Any:
    """Return the shortest decimals that read back as the same floats of this precision."""
    if array.ndim:
        return [_shortest(item) for item in array]
    return float(str(array)) if np.issubdtype(array.dtype, np.floating) else array.item()


def _show(value: Any) -> str:
    if isinstance(value, Tracer):
        return f"an array of shape {value.shape}"
    is_number = isinstance(value, (np.ndarray, np.generic, jax.Array))
    return show(to_data(value) if is_number else value)
