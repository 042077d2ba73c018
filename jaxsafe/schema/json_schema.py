"""JSON schemas of components, draft 2020-12, from the annotations of their fields."""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
import typing
from typing import Any, Literal

from jaxsafe.schema.component import ANY, Component, Field, Range, choices, field, fields
from jaxsafe.schema.convert import (
    bare,
    expects,
    is_component,
    is_mapping,
    is_optional,
    is_union,
    members,
    to_data,
)
from jaxsafe.schema.field_docs import field_docs, summary

DRAFT = "https://json-schema.org/draft/2020-12/schema"

USER_TYPE = {"type": "string", "pattern": r"^[\w.]+:\w+$"}
"""`MODULE:CLASS`, a type of a user's module."""

Schema = dict[str, Any]


def json_schema(cls: type[Component]) -> Schema:
    """Return the schema of the plain data from which `to_component` builds a component.

    Args:
        cls: the class of the component, which has no types to choose from.
    """
    definitions: dict[str, Schema] = {}
    schema = _object(cls, definitions)
    return {"$schema": DRAFT, "title": cls.__name__, **schema, "$defs": definitions}


def options_schema(cls: type[Component]) -> Schema:
    """Return the schema of options: some fields of a component, nested or by dotted path.

    A part that is chosen by its type is not checked.
    """
    docs = field_docs(cls)
    properties = {}
    for name, entry in fields(cls).items():
        core = bare(entry.hint)
        if not is_component(core):
            schema = _value(entry.hint, entry, {})
        else:
            schema = {} if choices(core) else options_schema(core)
        properties[name] = schema | _description(entry, docs.get(name, ""))
    return {
        "type": "object",
        "properties": properties,
        "patternProperties": {r"\.": {}},
        "additionalProperties": False,
    }


def _object(cls: type[Component], definitions: dict[str, Schema]) -> Schema:
    """Return the schema of a mapping with the fields of a class."""
    docs = field_docs(cls)
    properties: dict[str, Schema] = {}
    if cls.type_name:
        properties["type"] = {"const": cls.type_name}
    for name, entry in fields(cls).items():
        schema = _value(entry.hint, entry, definitions)
        properties[name] = schema | _description(entry, docs.get(name, ""))
    return {
        "type": "object",
        "description": inspect.cleandoc(cls.__doc__ or ""),
        "properties": properties,
        "required": [name for name, entry in fields(cls).items() if entry.required],
        "additionalProperties": False,
    }


def _description(entry: Field, text: str) -> Schema:
    takes = f"a name of {entry.refers.where}" if entry.refers else expects(entry)
    described: Schema = {"description": " ".join(f"{text} {takes[0].upper()}{takes[1:]}.".split())}
    default = to_data(entry.default)
    if default is not dataclasses.MISSING and _is_json(default):
        described["default"] = default
    return described


def _value(hint: Any, entry: Field, definitions: dict[str, Schema]) -> Schema:
    """Return the schema of the value of a field, or of an item of it.

    Args:
        hint: the annotation of the value.
        entry: the field.
        definitions: the schemas of components so far, by name. New ones are added to it.
    """
    core = bare(hint)
    if entry.unit:
        schema = _numbers(entry.unit.length, entry.range or Range())
    elif is_component(core):
        schema = _reference(core, definitions)
    elif is_union(core):
        each = [_value(item, field("", item), definitions) for item in members(core)]
        schema = {"anyOf": each}
    elif typing.get_origin(core) is tuple:
        item = typing.get_args(core)[0]
        schema = {"type": "array", "items": _value(item, field("", item), definitions)}
    elif is_mapping(core):
        item = typing.get_args(core)[1]
        item_schema = _value(item, field("", item), definitions)
        schema = {"type": "object", "additionalProperties": item_schema}
    elif typing.get_origin(core) is Literal:
        schema = {"enum": list(typing.get_args(core))}
    elif core is bool:
        schema = {"type": "boolean"}
    elif core in (int, float):
        kind = "integer" if core is int else "number"
        schema = {"type": kind} | _limits(entry.range or Range())
    else:
        schema = {"type": "string"}
    return {"anyOf": [schema, {"type": "null"}]} if is_optional(hint) else schema


def _numbers(length: int | None, limits: Range) -> Schema:
    """Return the schema of what a field with a unit takes."""
    number = {"type": "number"} | _limits(limits)
    several = {"type": "array", "items": number}
    if length == ANY:
        return {"anyOf": [number, several]}
    if length is None:
        return number
    return several | ({"minItems": length, "maxItems": length} if length else {})


def _limits(limits: Range) -> Schema:
    schema: Schema = {}
    if math.isfinite(limits.low):
        schema["exclusiveMinimum" if limits.open_low else "minimum"] = limits.low
    if math.isfinite(limits.high):
        schema["exclusiveMaximum" if limits.open_high else "maximum"] = limits.high
    if limits.nonzero:
        schema["not"] = {"const": 0}
    return schema


def _reference(base: type[Component], definitions: dict[str, Schema]) -> Schema:
    """Return a reference to the schema of a class, or of the types that may stand in its place."""
    options = choices(base)
    if not options:
        return _defined(base, definitions)
    name = f"{_name(base)}_types"
    if name not in definitions:
        definitions[name] = {}  # a type may have parts of the same kind
        name_suffices = [
            kind
            for kind, option in options.items()
            if not any(entry.required for entry in fields(option).values())
        ]
        definitions[name] = {
            "type": ["object", "string"],
            "required": ["type"],
            "properties": {"type": {"anyOf": [*map(_constant, options.values()), USER_TYPE]}},
            "if": {"type": "string"},
            "then": {
                "anyOf": [{"enum": name_suffices}, USER_TYPE] if name_suffices else [USER_TYPE]
            },
            "allOf": [
                {
                    "if": {
                        "type": "object",
                        "required": ["type"],
                        "properties": {"type": {"const": kind}},
                    },
                    "then": _defined(option, definitions),
                }
                for kind, option in options.items()
            ],
        }
    return {"$ref": f"#/$defs/{name}"}


def _constant(cls: type[Component]) -> Schema:
    """Return the schema of the name of a type, described by the type's first paragraph."""
    return {"const": cls.type_name, "description": summary(cls)}


def _defined(cls: type[Component], definitions: dict[str, Schema]) -> Schema:
    """Return a reference to the schema of a class, which is added if it is not there."""
    name = _name(cls)
    if name not in definitions:
        definitions[name] = {}  # a component may have parts of its own class
        definitions[name] = _object(cls, definitions)
    return {"$ref": f"#/$defs/{name}"}


def _name(cls: type[Component]) -> str:
    return re.sub(r"\W+", "_", f"{cls.__module__}.{cls.__qualname__}")


def _is_json(value: Any) -> bool:
    """Return whether JSON can express a value. It has no word for infinity and NaN."""
    if isinstance(value, dict):
        return all(map(_is_json, value.values()))
    if isinstance(value, list):
        return all(map(_is_json, value))
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or isinstance(value, (str, int))
