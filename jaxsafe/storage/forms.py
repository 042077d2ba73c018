"""What data in a file must look like.

A damaged or edited file is refused with one line before it is used.

A form is a `Kind` (the form of one value), a list `[form]`, or a mapping from names to forms. A
mapping lists the keys that must be there. `OTHERS: form` gives the form of all further keys, which
are not checked without it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxsafe.schema.errors import ConfigError, show

OTHERS = ...
"""The key that stands for every key that a mapping does not name."""

MAX_DEPTH = 24
"""How many lists and mappings may stand inside each other. jaxsafe's files need less than half."""

INTEGER_LIMIT = 2**63
"""Whole numbers in a file must be smaller, because larger ones fit into no array."""

MAX_SHARE = 1 + 1e-9
"""The largest share. It exceeds 1 a little because averages are rounded."""

_ABSENT = object()
"""Stands for the value of a key that is not there."""


class Kind(NamedTuple):
    """The form of one value."""

    words: str  # what is expected, for the error message
    fits: Callable[[Any], bool]

    def __or__(self, other: Kind) -> Kind:
        return Kind(
            words=f"{self.words} or {other.words}",
            fits=lambda value: self.fits(value) or other.fits(value),
        )


def _is_number(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < INTEGER_LIMIT


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < INTEGER_LIMIT


ANYTHING = Kind("anything", lambda value: True)
NULL = Kind("null", lambda value: value is None)
TEXT = Kind("text", lambda value: isinstance(value, str))
FLAG = Kind("true or false", lambda value: isinstance(value, bool))
COUNT = Kind("a whole number ≥ 0", _is_count)
NUMBER = Kind("a number", _is_number)
AMOUNT = Kind("a number ≥ 0", lambda value: _is_number(value) and value >= 0)
SHARE = Kind("a number from 0 to 1", lambda value: _is_number(value) and 0 <= value <= MAX_SHARE)
NUMBER_OR_NULL = NUMBER | NULL
"""A quantity. It is null where it is not known or was not finite."""


def numbers(count: int, kind: Kind = NUMBER_OR_NULL) -> Kind:
    """Return the form of a list of `count` values of a kind."""

    def fits(value: Any) -> bool:
        return isinstance(value, list) and len(value) == count and all(map(kind.fits, value))

    return Kind(words=f"a list of length {count}, each {kind.words}", fits=fits)


def check(value: Any, form: Any, place: str) -> None:
    """Check that a value has a form.

    Raises:
        ConfigError: the value does not have it. The message names the place, what was found and
            what is expected.
    """
    problem = _find_problem(value, form)
    if problem is not None:
        shown = "nothing" if problem.found is _ABSENT else show(problem.found)
        label = f"{place}: {'.'.join(problem.path)}" if problem.path else place
        raise ConfigError(f"{label}: expected {problem.expected}, found {shown}")


class _Problem(NamedTuple):
    """Where a value departs from its form, what is expected there, and what was found."""

    path: list[str]
    expected: str
    found: Any


def _find_problem(value: Any, form: Any) -> _Problem | None:
    """Return the first place where a value departs from its form, or None if there is none."""
    if isinstance(form, Kind):
        return None if form.fits(value) else _Problem(path=[], expected=form.words, found=value)
    if isinstance(form, list):
        if not isinstance(value, list):
            return _Problem(path=[], expected="a list", found=value)
        entries = {f"[{index}]": (item, form[0]) for index, item in enumerate(value)}
    else:
        if not isinstance(value, Mapping):
            return _Problem(path=[], expected="a mapping", found=value)
        entries = {
            name: (value.get(name, _ABSENT), item_form)
            for name, item_form in form.items()
            if name is not OTHERS
        }
        if OTHERS in form:
            entries |= {
                str(name): (item, form[OTHERS]) for name, item in value.items() if name not in form
            }
    for name, (item, item_form) in entries.items():
        problem = _find_problem(item, item_form)
        if problem is not None:
            return problem._replace(path=[name, *problem.path])
    return None


def is_deep(value: Any, depth: int = MAX_DEPTH) -> bool:
    """Return whether more than `depth` lists and mappings stand inside each other."""
    if not isinstance(value, (list, Mapping)):
        return False
    items = value.values() if isinstance(value, Mapping) else value
    return depth == 0 or any(is_deep(item, depth - 1) for item in items)
