"""Errors that a user's input can cause.

Each is one line that names the place, what was found and what is allowed.
"""

from __future__ import annotations

import difflib
import os
import sysconfig
import traceback
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

CONTROL_ESCAPES = {code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0))}
"""How control characters are spelt out, as a table for `str.translate`."""

TEXT_CONTROLS = {ord(letter): letter for letter in "\n\t"}
"""Control characters that belong to a text and stay as they are, as a table for `str.translate`."""

MAX_PRINTED_BITS = 10_000
"""A longer whole number is not printed, because Python refuses to write more than 4300 digits."""


MAX_CHOICES = 10
"""Most names that are listed after a near miss, so that the end of the line does not hide it."""


class ConfigError(ValueError):
    """A value from outside is wrong.

    It may be a misspelt name, a wrong type, a number out of range or a broken file.
    """


class ConfigWarning(UserWarning):
    """What a user asked for is possible, but it is probably not all that was meant."""


def show(value: object, most: int = 60) -> str:
    """Return what `repr` returns, in one line and cut to `most` letters.

    A value may be very large, so no more of it is read than these letters need.
    """
    text = ""
    for piece in _pieces(value, most):
        text += piece
        if len(text) > most:
            return text[: most - 3] + "..."
    return text


def _pieces(value: object, most: int) -> Iterator[str]:
    """Yield the text of a value piece by piece. Each piece has at least one letter."""
    if type(value) in (list, tuple, dict):
        opening, closing = {list: "[]", tuple: "()", dict: "{}"}[type(value)]
        yield opening
        for index, item in enumerate(value):  # type: ignore[arg-type]
            if index:
                yield ", "
            yield from _pieces(item, most)
            if isinstance(value, dict):
                yield ": "
                yield from _pieces(value[item], most)
        yield "," + closing if isinstance(value, tuple) and len(value) == 1 else closing
    elif isinstance(value, str):
        yield repr(value[: most + 1])
    elif isinstance(value, int) and value.bit_length() > MAX_PRINTED_BITS:
        yield "a number of thousands of digits"
    else:
        yield " ".join(repr(value).split())


def printable(text: str) -> str:
    """Return a text with its control characters spelt out and what is not Unicode replaced."""
    return text.translate(CONTROL_ESCAPES | TEXT_CONTROLS).encode(errors="replace").decode()


def meant_environment(name: str, groups: Iterable[str]) -> str | None:
    """Return what to say of an option such as `deputy.mass`, which lacks its `env.`, or None.

    Args:
        name: the option.
        groups: the first words that options with dots may have. One near to them is misspelt.
    """
    head, dot, _ = name.partition(".")
    if not dot or difflib.get_close_matches(head, list(groups), n=1):
        return None
    return f"{name}: unknown option; a field of the environment is written env.{name}"


def choices_text(found: object, allowed: Iterable[object], meant: str | None = None) -> str:
    """Return the end of a message about a wrong name.

    It is `. Did you mean 'b'? Choose from a, b, c`, or `; choose from a, b, c` if no name is near.

    Args:
        found: the wrong name, or another value that stands in its place.
        allowed: the names that are allowed. Many of them are left out after a near one.
        meant: the name that was probably meant, if the caller knows better than which is nearest.
    """
    names = [str(name) for name in allowed]
    word = found if isinstance(found, str) else show(found)
    meant = meant or next(iter(difflib.get_close_matches(word, names, n=1, cutoff=0.5)), None)
    listed = ", ".join(names) or "none"
    if meant is None:
        return f"; choose from {listed}"
    hint = f". Did you mean {meant!r}?"
    return f"{hint} Choose from {listed}" if len(names) <= MAX_CHOICES else hint


@contextmanager
def part(*path: str) -> Iterator[None]:
    """Add a note to every error inside that names the part of an environment it comes from.

    A compiled program does not contain it, because it runs only while the program is traced.
    """
    try:
        yield
    except Exception as error:
        error.add_note("in " + ".".join(path))
        raise


def summarise_error(error: BaseException, modules: Collection[str] = ()) -> str:
    """Return type and first line of an error, and where in the user's own code it arose.

    Args:
        error: the error as it was caught.
        modules: names of the user's modules, which may be installed like a library.

    Returns:
        A text like `TypeError: … (mine.py, line 3)`. The file is left out where no code of the user
        was running, and for a SyntaxError, which names its file itself.
    """
    reason = next(iter(str(error).splitlines()), "")[:200]
    frames = traceback.walk_tb(error.__traceback__)
    own = [(frame.f_code.co_filename, line) for frame, line in frames if _is_own(frame, modules)]
    if not own or isinstance(error, SyntaxError):
        return f"{type(error).__name__}: {reason}"
    path, line = own[-1]
    relative = os.path.relpath(path)
    file = path if relative.startswith("..") else relative
    return f"{type(error).__name__}: {reason} ({file}, line {line})"


def _is_own(frame: FrameType, modules: Collection[str]) -> bool:
    """Return whether a frame runs neither jaxsafe nor another library nor Python itself."""
    roots = {name.partition(".")[0] for name in modules}
    if frame.f_globals.get("__name__", "").partition(".")[0] in roots:
        return True
    libraries = (
        os.path.dirname(os.path.dirname(__file__)),
        *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")),
    )
    path = frame.f_code.co_filename
    return not path.startswith(("<", *(os.path.join(library, "") for library in libraries)))


def install_hint(extra: str) -> str:
    """Say how to install an extra. Only a clone has extras: jaxsafe is on no package index."""
    return f"in a clone of jaxsafe: pip install '.[{extra}]'"


class MissingError(ConfigError, ImportError):
    """A package of an extra is not installed."""


def missing(error: ImportError, package: str, extra: str) -> ImportError:
    """Return the error to raise where a package of an extra fails to import.

    If the package is installed but broken, this is the error that it raised itself.
    """
    if (error.name or "").partition(".")[0] != package:
        return error
    return MissingError(f"{package} is not installed; {install_hint(extra)}")
