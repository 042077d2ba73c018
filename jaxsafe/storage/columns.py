"""Rows of a log as columns, for reading them in Python."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

AXES = "xyz"
"""Names of the elements of a position and of other vectors in space."""


def table(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Return rows as a pandas `DataFrame`, or as NumPy arrays by name where pandas is missing.

    Names of nested values are joined by dots: `platforms.deputy.position.x`.
    """
    columns = as_columns([dict(flat(row)) for row in rows])
    try:
        pandas = importlib.import_module("pandas")
    except ImportError:
        return columns
    return pandas.DataFrame(columns)


def as_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Return flat rows as arrays by name. Numbers that are None or missing are NaN."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: _array([row.get(name) for row in rows]) for name in names}


def flat(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of every leaf of nested mappings and lists."""
    if isinstance(value, Mapping):
        items = value.items()
    elif isinstance(value, list | tuple):
        axes = AXES if len(value) <= len(AXES) else range(len(value))
        items = zip(axes, value, strict=False)
    else:
        yield place, value
        return
    for name, inner in items:
        yield from flat(inner, f"{place}.{name}" if place else str(name))


def _array(values: list[Any]) -> np.ndarray:
    if any(isinstance(value, str) for value in values):
        return np.array(values, object)
    if None in values:
        return np.array([np.nan if value is None else value for value in values], float)
    return np.array(values)
