"""Plain data to components and back, led by the annotations of their fields; every fault is one line with its place."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
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
from jaxsafe.schema.errors import ConfigError, nearest, show


def to_component(data: Any, base: type[Kind], place: str) -> Kind:
    """Build a component from a mapping; `type` chooses among the subclasses of `base`.

    Raises:
        ConfigError: naming the place, what was found and what is allowed.
    """
    if isinstance(data, base):
        return normalise(data)
    if not isinstance(data, Mapping):
        raise ConfigError(f"{place or 'environment'}: expected a mapping of fields, found {_show(data)}")
    cls, entries = _choose(dict(data), base, place)
    table = fields(cls)
    label = f"{place} ({cls.type_name})" if cls.type_name else place or "environment"
    for name in entries:
        if name not in table:
            raise ConfigError(f"{label}: unknown field {show(name)}; choose from {nearest(name, table)}")
    for name, field in table.items():
        if field.required and name not in entries:
            raise ConfigError(f"{label}: field {name!r} is missing; it takes {expects(field)}")
    return cls(**{name: to_value(value, table[name], join(place, name)) for name, value in entries.items()})


def to_value(value: Any, field: Field, place: str) -> Any:
    """Check and convert the value of one field."""
    if field.unit:
        return None if value is None and _optional(field.hint) else _number(value, field, place)
    return _structure(value, field.hint, field, place)


def to_data(value: Any) -> Any:
    """A component as plain data, complete: `to_component(to_data(c), …) == c`."""
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
    """What a field takes, in words."""
    if field.unit:
        shape = {None: "a number", 2: "a list [low, high]", 0: "a list of numbers", ANY: "a number or a list of numbers"}[
            field.unit.length
        ]
        unit = "" if field.unit.symbol in ("1", "physical", "as observed") else f" in {field.unit.symbol}"
        return f"{shape}{unit} {field.range or ''}".rstrip()
    core = _bare(field.hint)
    if typing.get_origin(core) is Literal:
        return "one of " + ", ".join(map(str, typing.get_args(core)))
    words = {str: "a name", int: "a whole number", bool: "true or false"}
    return words.get(core, "a mapping" if _is_component(core) else "a list") + (f" {field.range}" if field.range else "")


def _choose(entries: dict, base: type[Kind], place: str) -> tuple[type[Kind], dict]:
    options = choices(base)
    if not options:
        return base, entries
    if "type" not in entries:
        raise ConfigError(f"{place}: field 'type' is missing; choose from {nearest('', sorted(options))}")
    kind = entries.pop("type")
    if not isinstance(kind, str) or kind not in options:
        raise ConfigError(f"{place}: unknown type {show(kind)}; choose from {nearest(kind, sorted(options))}")
    return options[kind], entries


def _structure(value: Any, hint: Any, field: Field, place: str) -> Any:
    hint, optional = _bare(hint), _optional(hint)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if value is None and optional:
        return None
    if _is_component(hint):
        return to_component(value, hint, place)
    if origin is tuple:
        return _sequence(value, arguments[0], field, place)
    if origin is not None and isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping(value, arguments[1], field, place)
    if origin is Literal:
        if value not in arguments:
            raise ConfigError(f"{place}: found {_show(value)}; choose from {nearest(value, arguments)}")
        return value
    given = value
    if hint is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ConfigError(f"{place}: expected {expects(field)}, found {_show(value)}")
    if field.range and isinstance(value, int) and value not in field.range:
        raise ConfigError(f"{place}: expected {expects(field)}, found {show(value)}")
    if field.range and isinstance(value, int) and not field.range.carries(value):
        raise ConfigError(f"{place}: expected {expects(field)} {field.range.magnitudes}, found {show(given)}")
    return value


def _sequence(value: Any, item: Any, field: Field, place: str) -> tuple:
    if not isinstance(value, (list, tuple)):
        raise ConfigError(f"{place}: expected a list, found {_show(value)}")
    names = [entry.get("name") if isinstance(entry, Mapping) else getattr(entry, "name", None) for entry in value]
    return tuple(
        _structure(entry, item, field, join(place, name if isinstance(name, str) else f"[{index}]"))
        for index, (entry, name) in enumerate(zip(value, names, strict=True))
    )


def _mapping(value: Any, item: Any, field: Field, place: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{place}: expected a mapping of names to values, found {_show(value)}")
    entry = field_of("", item)
    found = {str(key): to_value(content, entry, join(place, str(key))) for key, content in value.items()}
    return {key: found[key] for key in sorted(found)}  # see `normalise`


def _number(value: Any, field: Field, place: str) -> jax.Array:
    """A leaf as an array of the default float. Traced values pass with their shape checked only."""
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
        raise wrong
    if not isinstance(array, Tracer):
        with np.errstate(over="ignore"):  # beyond the largest float32 is infinite
            numbers = np.asarray(array, jnp.result_type(float))
        limits = field.range or Range()
        if np.isnan(numbers).any() or not all(number in limits for number in np.atleast_1d(numbers)):
            raise wrong
        finite = np.isfinite(numbers) | (limits.infinite & np.isinf(np.asarray(array, float)))
        if not finite.all() or not all(limits.carries(number) for number in numbers[np.isfinite(numbers)].tolist()):
            raise ConfigError(f"{place}: expected {expects(field)} {limits.magnitudes}, found {_show(value)}")
        if length == 2 and numbers[0] > numbers[1]:
            raise ConfigError(f"{place}: expected low ≤ high, found {_show(value)}")
        if length == 2 and np.isinf(numbers[0]) and numbers[0] == numbers[1]:
            raise ConfigError(f"{place}: expected low < high where a bound is infinite, found {_show(value)}")
        array = numbers
    return jnp.asarray(array, jnp.result_type(float))


def _bare(hint: Any) -> Any:
    if typing.get_origin(hint) is Annotated:
        return _bare(typing.get_args(hint)[0])
    inner, optional = unwrap_optional(hint)
    return _bare(inner) if optional else hint


def _optional(hint: Any) -> bool:
    return typing.get_origin(hint) in (typing.Union, types.UnionType) and type(None) in typing.get_args(hint)


def _is_component(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, Component)


def _shortest(array: np.ndarray) -> Any:
    """The shortest decimals that read back as the same floats of this precision."""
    if array.ndim:
        return [_shortest(item) for item in array]
    return float(str(array)) if np.issubdtype(array.dtype, np.floating) else array.item()


def _show(value: Any) -> str:
    if isinstance(value, Tracer):
        return f"an array of shape {value.shape}"
    return show(to_data(value) if isinstance(value, (np.ndarray, jax.Array)) else value)
