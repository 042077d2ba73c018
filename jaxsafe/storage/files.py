"""Files that a kill cannot spoil.

A whole file appears at once. A log grows by whole lines and can be cut back to the rows of a step.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import io
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.forms import ANYTHING, check, is_deep

ANYBODY = 0o666
"""The mode of a file that anybody may read and write, as far as the system's mask lets them."""

OWNER = 0o600
"""The mode of a file that only its owner may read and write."""


def write_text(path: Path, text: str, mode: int = ANYBODY) -> None:
    """Replace a file by a complete new one, or leave it as it was."""
    write_bytes(path, text.encode(), mode)


def write_bytes(path: Path, content: bytes, mode: int = ANYBODY) -> None:
    """Replace a file by a complete new one of these bytes, or leave it as it was.

    Args:
        path: the file.
        content: what to write.
        mode: who may read and write the new file. The system's mask takes rights away.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    opener = functools.partial(os.open, mode=mode)
    with _naming_file(path), open(part, "wb", opener=opener) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def write_json(path: Path, value: Any, mode: int = ANYBODY) -> None:
    """Write an indented JSON file. NaN and infinity become null."""
    write_text(path, json.dumps(finite(value), indent=2, allow_nan=False) + "\n", mode)


@contextlib.contextmanager
def _naming_file(path: Path) -> Iterator[None]:
    """Add the name of the file to an error that is raised while it is written."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def parse_json(text: str | bytes, infinite: bool = False) -> Any:
    """Return the value of a JSON text.

    Args:
        text: the text to read.
        infinite: whether to read `NaN` and `Infinity` as numbers. JSON itself has neither.

    Raises:
        ValueError: the text is not JSON, or holds too many lists and mappings inside each other.
    """
    try:
        value = json.loads(text, parse_constant=None if infinite else _refuse)
    except RecursionError:
        raise ValueError("too deep") from None
    if is_deep(value):
        raise ValueError("too deep")
    return value


def read_json(path: Path, form: Any = ANYTHING) -> Any:
    """Read a JSON file of a form.

    Raises:
        ConfigError: the file is missing, broken, or of another form.
    """
    try:
        value = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError:
        raise ConfigError(f"{path}: not a JSON file") from None
    check(value, form, str(path))
    return value


def append_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Add a line of JSON for each row to a log."""
    with _naming_file(path), open(path, "a", encoding="utf-8") as file:
        file.writelines(map(_to_line, rows))


def write_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Replace a log by these rows, or leave it as it was."""
    write_text(path, "".join(map(_to_line, rows)))


def read_rows(path: Path, form: Any = ANYTHING) -> list[dict[str, Any]]:
    """Return the rows of a log, or none if there is no file.

    A last line that a kill cut short is not a row.

    Raises:
        ConfigError: another line is broken, or a row does not have this form.
    """
    if not path.exists():
        return []
    lines = path.read_bytes().split(b"\n")
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        place = f"{path}, line {number}"
        try:
            row = parse_json(line)
        except ValueError:  # the line is not JSON or not UTF-8
            if number < len(lines):
                raise ConfigError(f"{place}: not a line of JSON") from None
            continue
        for required in ({}, form):  # any row is a mapping
            check(row, required, f"{place}: not a row of this log")
        rows.append(row)
    return rows


def keep_rows(
    path: Path, keep: Callable[[dict[str, Any]], bool], form: Any = ANYTHING
) -> list[dict[str, Any]]:
    """Cut a log back to the rows to keep, and return them.

    Args:
        path: the log.
        keep: whether to keep a row.
        form: the form of a row.

    Raises:
        ConfigError: a line is broken, or a row does not have this form; see `read_rows`.
    """
    rows = [row for row in read_rows(path, form) if keep(row)]
    if path.exists():
        write_rows(path, rows)
    return rows


def sync(path: Path) -> None:
    """Wait until everything that was written to a file is on the disk."""
    with open(path, "ab") as file:
        os.fsync(file.fileno())


def append_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Add rows to a CSV file. A new file begins with a header."""
    new = not path.exists()
    with _naming_file(path), open(path, "a", encoding="utf-8", newline="") as file:
        file.write(_to_csv(rows, header=new))


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a whole CSV file of at least one row."""
    write_text(path, _to_csv(rows, header=True))


def read_csv(path: Path, form: Any = ANYTHING) -> list[dict[str, Any]]:
    """Read the rows of a CSV file.

    A text that is a number becomes a number, and an empty one becomes None.

    Raises:
        ConfigError: the file cannot be read, or a row does not have this form.
    """
    try:
        text = path.read_text(encoding="utf-8")
        text_rows = list(csv.DictReader(io.StringIO(text, newline=""), restkey="more"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, csv.Error):
        raise ConfigError(f"{path}: not a CSV file") from None
    rows = [{name: _from_text(value) for name, value in row.items()} for row in text_rows]
    for number, row in enumerate(rows, start=1):
        check(row, form, f"{path}, row {number}")
    return rows


def finite(value: Any) -> Any:
    """Return the same data with None in place of every NaN and infinity."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    return [finite(item) for item in value] if isinstance(value, (list, tuple)) else value


def _from_text(text: Any) -> Any:
    """Return the number that a text stands for, None for an empty text, and else the text."""
    for kind in (int, float):
        with contextlib.suppress(TypeError, ValueError):
            return kind(text)
    return text or None


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


def _to_line(row: Mapping[str, Any]) -> str:
    return json.dumps(finite(row), allow_nan=False) + "\n"


def _to_csv(rows: Sequence[Mapping[str, Any]], header: bool) -> str:
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=list(rows[0]), lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()
