"""One-line errors, exit codes and lasting streams, which all commands share."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NoReturn

from jaxsafe.address_space import is_shortage
from jaxsafe.commands import HELP
from jaxsafe.commands.help_text import help_text
from jaxsafe.commands.options import CommandOptions
from jaxsafe.commands.streams import lasting_streams
from jaxsafe.schema import user_modules
from jaxsafe.schema.errors import ConfigError, ConfigWarning

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect."""

DIVERGED = 3
"""Exit code of a training or an evaluation with a seed whose networks are not finite.

There is no result for such a seed.
"""


def run(
    main: Callable[[Sequence[str]], int | None],
    options: type[CommandOptions],
    leave: Callable[[int], NoReturn] = sys.exit,
    alone: bool = False,
) -> None:
    """Run a command and leave with its exit code.

    Output that nobody reads any more is no error. Output that could not be written is one, which is
    reported when the work is done.

    Args:
        main: the command. It takes the words of the command line and returns its exit code, or None
            instead of 0.
        options: the options of the command, for the help text.
        leave: a function that ends the process after an error or Ctrl-C. In all other cases
            `sys.exit` ends it.
        alone: whether the command does something if it is called without any word.
    """
    argv = sys.argv[1:]
    with lasting_streams() as stdout:
        asks = not (argv or alone) or any(word in HELP for word in argv)
        code, finished = _run(partial(_explain, options) if asks else main, argv)
        leave = sys.exit if asks or finished else leave
        sys.stdout.flush()
        if stdout.error and not isinstance(stdout.error, BrokenPipeError):
            print(f"error: standard output: {stdout.error.strerror}", file=sys.stderr)
            code = code or 2
        leave(code)


def _explain(options: type[CommandOptions], argv: Sequence[str]) -> int:
    """Print the help text. It also explains a command line without any word, which is an error."""
    given = options.arguments([word for word in argv if word not in HELP])
    print(help_text(options, given), file=sys.stdout if argv else sys.stderr)
    return 0 if argv else 2


def _run(main: Callable[[Sequence[str]], int | None], argv: Sequence[str]) -> tuple[int, bool]:
    """Return the exit code of a command and whether it came to its end."""
    try:
        flags = [word for word in argv if word.startswith("imports=")]
        imports = CommandOptions.parse(flags).imports
        with user_modules.imports_allowed(imports), _warnings_in_one_line():
            return main(argv) or 0, True
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
    """Return what is wrong with the platform that the user chose for JAX, else None."""
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
    """Print warnings of this package in one line, as the commands print errors.

    Other warnings stay as they are.
    """
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
    """Leave with an exit code, but without Python's shutdown.

    The shutdown would wait for threads that compile, and threads of orbax would print tracebacks
    during it.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
