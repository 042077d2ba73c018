"""Short texts of values, and tables of them for `repr` and for notebooks.

The values may be traced, or they may be shapes without numbers.
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

    A number or a short vector is shown by its numbers. Any other array is shown by its type and
    shape, and so is one whose numbers are not known here.
    """
    shape = getattr(value, "shape", None)
    dtype = getattr(value, "dtype", None)
    if isinstance(value, bool | int | float | np.generic):
        return _number(value)
    if shape is None or dtype is None:
        return show(value)
    type_and_shape = f"{dtype}[{','.join(map(str, shape))}]"
    if isinstance(value, Tracer) or len(shape) > 1 or math.prod(shape) > MAX_NUMBERS:
        return type_and_shape
    try:
        numbers = np.asarray(value)
    # The value may be a shape or PRNG keys, or its array may be donated or on another host.
    except (RuntimeError, TypeError, ValueError):
        return type_and_shape
    if numbers.dtype == object:
        return type_and_shape
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
    """Return a heading with a line for each label below it. Long lines are wrapped."""
    rows = list(rows)
    width = max((len(label) for label, _ in rows), default=0)
    lines = [heading]
    for label, text in rows:
        labelled = f"  {label:{width}}  "
        lines += textwrap.wrap(
            text or "none",
            WIDTH,
            initial_indent=labelled,
            subsequent_indent=" " * len(labelled),
            break_long_words=False,
            break_on_hyphens=False,
        )
    return "\n".join(lines).replace(NO_BREAK, " ")


def html_table(heading: str, rows: Rows) -> str:
    """Return a heading and a table with a row for each label, in HTML for notebooks."""
    left = 'style="text-align: left"'
    lines = []
    for label, text in rows:
        cells = f"<th {left}>{html.escape(label)}</th><td {left}>{html.escape(text or 'none')}</td>"
        lines.append(f"<tr>{cells}</tr>")
    return f"<b>{html.escape(heading)}</b><table>{''.join(lines)}</table>"


class Described:
    """Base of the classes that print themselves as a heading and rows."""

    def _heading(self) -> str:
        """Return the first line."""
        return type(self).__name__

    def _rows(self) -> Rows:
        """Return a label and a text for each line below the heading."""
        return ()

    def __repr__(self) -> str:
        return text_table(self._heading(), self._rows())

    def _repr_html_(self) -> str:
        return html_table(self._heading(), self._rows())
