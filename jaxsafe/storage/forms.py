"""What data in a file must look like, so that a damaged or edited file is told in one line before it is used.

A form is a `Kind` (of one value), a list `[form]`, or a mapping from names to forms. Such a mapping lists the keys that
must be there; `OTHERS: form` is the form of all further keys, which are not looked at without it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxsafe.schema.errors import ConfigError, show

OTHERS = ...
"""Stands in a mapping for every key that the mapping does not name."""

MAX_DEPTH = 24
"""Lists and mappings inside each other that a file may have: ours have less than half as many."""

LARGEST = 2**63
"""Whole numbers in a file are smaller: a larger one fits into no array."""


class Kind(NamedTuple):
    """A form of one value."""

    words: str  # what is expected, for the message
    fits: Callable[[Any], bool]

    def __or__(self, other: Kind) -> Kind:
        return Kind(f"{self.words} or {other.words}", lambda value: self.fits(value) or other.fits(value))


def _is_number(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < LARGEST


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < LARGEST


ANYTHING = Kind("anything", lambda value: True)
NULL = Kind("null", lambda value: value is None)
TEXT = Kind("text", lambda value: isinstance(value, str))
FLAG = Kind("true or false", lambda value: isinstance(value, bool))
COUNT = Kind("a whole number ≥ 0", _is_whole)
NUMBER = Kind("a number", _is_number)
AMOUNT = Kind("a number ≥ 0", lambda value: _is_number(value) and value >= 0)
SHARE = Kind("a number from 0 to 1", lambda value: _is_number(value) and 0 <= value <= 1 + 1e-9)  # of averages, rounded
MAYBE = NUMBER | NULL
"""A quantity: null where it is not known or was not finite."""


def numbers(count: int, kind: Kind = MAYBE) -> Kind:
    """Return the form of a list of so many values of a kind."""
    return Kind(
        f"a list of length {count}, each {kind.words}",
        lambda value: isinstance(value, list) and len(value) == count and all(map(kind.fits, value)),
    )


def check(value: Any, form: Any, place: str) -> None:
    """Raise a ConfigError, which names the place, what was found and what is expected, unless the value has the form."""
    found = _problem(value, form)
    if found is not None:
        path, wanted, wrong = found
        shown = "nothing" if wrong is _ABSENT else show(wrong)
        raise ConfigError(f"{place}: {'.'.join(path)}{': ' if path else ''}expected {wanted}, found {shown}")


_ABSENT = object()


def _problem(value: Any, form: Any) -> tuple[list[str], str, Any] | None:
    """Where a value departs from its form, what is expected there and what was found; None if it does not."""
    if isinstance(form, Kind):
        return None if form.fits(value) else ([], form.words, value)
    if isinstance(form, list):
        if not isinstance(value, list):
            return [], "a list", value
        entries = {f"[{index}]": (item, form[0]) for index, item in enumerate(value)}
    else:
        if not isinstance(value, Mapping):
            return [], "a mapping", value
        entries = {name: (value.get(name, _ABSENT), part) for name, part in form.items() if name is not OTHERS}
        if OTHERS in form:
            entries |= {str(name): (item, form[OTHERS]) for name, item in value.items() if name not in form}
    for name, (item, part) in entries.items():
        found = _problem(item, part)
        if found is not None:
            return [name, *found[0]], *found[1:]
    return None


def is_deep(value: Any, depth: int = MAX_DEPTH) -> bool:
    """Whether lists and mappings stand inside each other more than `depth` times."""
    if not isinstance(value, (list, Mapping)):
        return False
    items = value.values() if isinstance(value, Mapping) else value
    return depth == 0 or any(is_deep(item, depth - 1) for item in items)
