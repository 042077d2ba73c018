"""Standard output and standard error of a command, which goes on whatever happens to them.

Characters that an encoding lacks are replaced. Control characters are spelt out, because a
stranger's file may contain them and they would act on the terminal. What is written to a closed
stream is discarded. The same holds for a stream that takes no more, because the reader of a pipe
has gone or the disk is full.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from jaxsafe.schema.errors import CONTROL_ESCAPES, TEXT_CONTROLS


class LastingStream:
    """A text stream that never raises an OSError.

    After the first OSError it keeps the error and discards what is written.
    """

    def __init__(self, stream: Any, allowed: str = "") -> None:
        """Wrap a stream. The control characters in `allowed` may be written to it too."""
        self._stream = stream
        self._controls = (
            CONTROL_ESCAPES | TEXT_CONTROLS | {ord(letter): letter for letter in allowed}
        )
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write text and return its length."""
        self._attempt(self._stream.write, text.translate(self._controls))
        return len(text)

    def flush(self) -> None:
        """Write the text that is buffered."""
        self._attempt(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _attempt(self, act: Callable[..., object], *arguments: str) -> None:
        try:
            act(*arguments)
        except OSError as error:
            self.error = error
            nowhere = os.open(os.devnull, os.O_WRONLY)
            # The buffered text, libraries and child processes still use the file descriptor.
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


@contextmanager
def lasting_streams() -> Iterator[LastingStream]:
    """Make `sys.stdout` and `sys.stderr` last for the time of a command.

    Yields:
        The lasting standard output.
    """
    before = sys.stdout, sys.stderr
    # If a file got the number of a closed stream, it would receive what libraries print there.
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    # A progress bar is drawn again with a carriage return.
    sys.stdout, sys.stderr = _lasting(before[0]), _lasting(before[1], allowed="\r")
    try:
        yield sys.stdout
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before


def _lasting(stream: Any, allowed: str = "") -> Any:
    # A stream that was closed when Python started is None.
    if stream is None:
        stream = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="replace")
    return LastingStream(stream, allowed)
