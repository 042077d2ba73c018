"""What the commands share: one-line errors with exit codes, and streams that last."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from jaxsafe.address_space import is_shortage
from jaxsafe.commands.streams import lasting_streams
from jaxsafe.config.arguments import Arguments
from jaxsafe.schema import user_modules
from jaxsafe.schema.errors import ConfigError, ConfigWarning

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect."""

DIVERGED = 3
"""Exit code of a training or an evaluation in which the networks of a seed are not finite: there is no result for it."""


IMPORTS = "  imports=false          refuse files that name modules to import: that runs the code of whoever wrote them"
"""The help of an option that every command has."""


def run(
    main: Callable[[Sequence[str]], int | None],
    usage: Callable[[], str],
    leave: Callable[[int], NoReturn] = sys.exit,
) -> None:
    """Run a command and leave with its exit code, by `leave` after an error or Ctrl-C.

    Output that nobody reads any more is no error. Output that could not be written is one, told when the work is done.
    """
    argv = sys.argv[1:]
    with lasting_streams() as stdout:
        if not argv or argv[0] in ("-h", "--help", "help"):
            print(f"{usage()}\n{IMPORTS}", file=sys.stdout if argv else sys.stderr)
            code, leave = (0 if argv else 2), sys.exit
        else:
            code, finished = _run(main, argv)
            leave = sys.exit if finished else leave
        sys.stdout.flush()
        if stdout.error and not isinstance(stdout.error, BrokenPipeError):
            print(f"error: standard output: {stdout.error.strerror}", file=sys.stderr)
            code = code or 2
        leave(code)


def _run(main: Callable[[Sequence[str]], int | None], argv: Sequence[str]) -> tuple[int, bool]:
    """Return the exit code of a command, and whether it came to its end."""
    try:
        flags, words = [], []
        for word in argv:
            (flags if word.partition("=")[0] == "imports" else words).append(word)
        allowed = Arguments.parse(flags).pop_flag("imports") is not False
        with user_modules.imports_allowed(allowed), _warnings_in_one_line():
            return main(words) or 0, True
    except ConfigError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2, False
    except OSError as error:
        place = error.filename or "file"
        print(f"error: {place}: {error.strerror or error}", file=sys.stderr)
        return 2, False
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED, False
    except (AssertionError, ImportError, MemoryError, RuntimeError) as error:
        if is_shortage(error):
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            print(f"error: memory is short: {reason}", file=sys.stderr)
            return 2, False
        if isinstance(error, ImportError | MemoryError) or (fault := _platform_fault()) is None:
            raise
        print(f"error: {fault}", file=sys.stderr)
        return 2, False


def _platform_fault() -> str | None:
    """Return what is wrong with the platform that the user chose for JAX, None if nothing is."""
    chosen = os.environ.get("JAX_PLATFORMS")
    if not chosen:
        return None
    import jax

    try:
        jax.devices()
    except (AssertionError, RuntimeError):
        return (
            f"JAX_PLATFORMS: no device of {chosen!r} can be used here; leave it out, or choose cpu"
        )
    return None


@contextmanager
def _warnings_in_one_line() -> Iterator[None]:
    """Print what this package warns of as the commands print errors; other warnings stay as they are."""
    with warnings.catch_warnings():
        show_other = warnings.showwarning

        def show_warning(message: Any, category: type[Warning], *rest: Any, **options: Any) -> None:
            if issubclass(category, ConfigWarning):
                print(f"warning: {message}", file=sys.stderr)
            else:
                show_other(message, category, *rest, **options)

        warnings.showwarning = show_warning
        yield


def at_once(code: int) -> NoReturn:
    """Leave without Python's shutdown: it would wait for threads that compile, and orbax's print tracebacks into it."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
