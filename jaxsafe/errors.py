"""Errors that a user's input can cause: one line that names the place, what was found and what is allowed."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class ConfigError(ValueError):
    """A value from outside is wrong: a misspelt name, a wrong type, a number out of range, a broken file."""


def nearest(found: object, allowed: Iterable[object]) -> str:
    """The allowed names as a list in words, with the nearest match to what was found: `a, b, c. Did you mean 'b'?`."""
    names = [str(name) for name in allowed]
    close = difflib.get_close_matches(str(found), names, n=1, cutoff=0.5)
    return ", ".join(names) + (f". Did you mean {close[0]!r}?" if close else "")


@contextmanager
def part(*path: str) -> Iterator[None]:
    """Notes on an error which part of an environment it comes from; runs while tracing only."""
    try:
        yield
    except Exception as error:
        error.add_note("in " + ".".join(path))
        raise


class MissingError(ConfigError, ImportError):
    """A package of an extra is not installed."""


def missing(error: ImportError, package: str, extra: str) -> ImportError:
    """What to raise where a package of an extra fails to import; if it is installed but broken, its own error."""
    if (error.name or "").partition(".")[0] != package:
        return error
    return MissingError(f"{package} is not installed; pip install 'jaxsafe[{extra}]'")
