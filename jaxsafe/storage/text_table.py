"""Tables of text with aligned columns."""

from __future__ import annotations

from collections.abc import Sequence


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table.

    Each column is as wide as its longest cell. The first column is aligned to the left, the others
    to the right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)]
        cells[0] = f"{row[0]:{widths[0]}}"
        lines.append("  ".join(cells).rstrip())
    return lines


def or_dash(value: float | None, form: str) -> str:
    """Return a number as text in a format such as `.1f`, or a dash if it is None."""
    return "–" if value is None else format(value, form)
