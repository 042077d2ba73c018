"""Standard output and standard error of a command. Whatever happens to them, the work goes on.

Letters that an encoding lacks are replaced, control characters, which may come with a stranger's file and would act on the
terminal, are spelt out. A stream that is closed leads nowhere, and so does one that can take no more: the reader of a pipe
has gone, or the disk is full.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from jaxsafe.schema.errors import CONTROL_ESCAPES, TEXT_CONTROLS


class LastingStream:
    """A text stream that never raises an OSError: after the first one it discards what is written, and keeps the error."""

    def __init__(self, stream: Any, allowed: str = "") -> None:
        """Wrap a stream, to which these control characters may be written too."""
        self._stream = stream
        self._controls = (
            CONTROL_ESCAPES | TEXT_CONTROLS | {ord(letter): letter for letter in allowed}
        )
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write text."""
        self._attempt(self._stream.write, text.translate(self._controls))
        return len(text)

    def flush(self) -> None:
        """Write what is buffered."""
        self._attempt(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _attempt(self, act: Callable[..., object], *arguments: str) -> None:
        try:
            act(*arguments)
        except OSError as error:
            self.error = error
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(
                nowhere, self._stream.fileno()
            )  # for what is in the buffer, for libraries and for child processes
            os.close(nowhere)


@contextmanager
def lasting_streams() -> Iterator[LastingStream]:
    """Make `sys.stdout` and `sys.stderr` last for the time of a command, and give the first of them."""
    before = sys.stdout, sys.stderr
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass  # a file that gets the number of a closed stream would receive what libraries print there
    os.close(number)
    sys.stdout, sys.stderr = (
        _lasting(before[0]),
        _lasting(before[1], allowed="\r"),
    )  # with which a bar is drawn anew
    try:
        yield sys.stdout
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before


def _lasting(stream: Any, allowed: str = "") -> Any:
    if stream is None:  # it was closed when Python started
        stream = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="replace")
    return LastingStream(stream, allowed)
