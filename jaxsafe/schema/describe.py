"""Short texts of values, and tables of them for `repr` and for notebooks.

What is described may be traced, or be shapes without numbers.
"""

from __future__ import annotations

import html
import math
import textwrap
from collections.abc import Iterable
from typing import Any

import numpy as np
from jax.core import Tracer

from jaxsafe.schema.errors import show

MAX_NUMBERS = 8
"""Most numbers of an array that are shown. A larger array is shown by its type and shape."""

WIDTH = 100
"""Width of the text in characters."""

NO_BREAK = "\u00a0"
"""A space at which a line is not wrapped."""

Rows = Iterable[tuple[str, str]]
"""Labels, each with a text."""


def brief(value: Any) -> str:
    """Return a short text of a value.

    It has the numbers of a small array. Of another array, and of one whose numbers are not known
    here, it has type and shape.
    """
    shape = getattr(value, "shape", None)
    dtype = getattr(value, "dtype", None)
    if isinstance(value, bool | int | float | np.generic):
        return _number(value)
    if shape is None or dtype is None:
        return show(value)
    unknown = f"{dtype}[{','.join(map(str, shape))}]"
    if isinstance(value, Tracer) or len(shape) > 1 or math.prod(shape) > MAX_NUMBERS:
        return unknown
    try:
        numbers = np.asarray(value)
    # The array may be a shape, keys, donated, or on another host.
    except (RuntimeError, TypeError, ValueError):
        return unknown
    if numbers.dtype == object:
        return unknown
    if not shape:
        return _number(numbers.item())
    return f"({', '.join(map(_number, numbers.tolist()))})"


def _number(value: Any) -> str:
    if not isinstance(value, float | np.floating):
        return str(value)
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"


def unbroken(text: str) -> str:
    """Return a text that stays on one line of a table."""
    return text.strip().replace(" ", NO_BREAK)


def text_table(heading: str, rows: Rows) -> str:
    """Return a heading and below it a line for each label. Long lines are wrapped."""
    rows = list(rows)
    width = max((len(label) for label, _ in rows), default=0)
    lines = [heading]
    for label, text in rows:
        begin = f"  {label:{width}}  "
        lines += textwrap.wrap(
            text or "none",
            WIDTH,
            initial_indent=begin,
            subsequent_indent=" " * len(begin),
            break_long_words=False,
            break_on_hyphens=False,
        )
    return "\n".join(lines).replace(NO_BREAK, " ")


def html_table(heading: str, rows: Rows) -> str:
    """Return the same as a table in HTML, which notebooks show."""
    left = 'style="text-align: left"'
    lines = []
    for label, text in rows:
        cells = f"<th {left}>{html.escape(label)}</th><td {left}>{html.escape(text or 'none')}</td>"
        lines.append(f"<tr>{cells}</tr>")
    return f"<b>{html.escape(heading)}</b><table>{''.join(lines)}</table>"


class Described:
    """Base of what prints itself as a heading and some rows."""

    def _heading(self) -> str:
        """Return the first line."""
        return type(self).__name__

    def _rows(self) -> Rows:
        """Return a label and a text for each line below it."""
        return ()

    def __repr__(self) -> str:
        return text_table(self._heading(), self._rows())

    def _repr_html_(self) -> str:
        return html_table(self._heading(), self._rows())
