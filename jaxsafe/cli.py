"""What the commands share: `key=value` arguments, one-line errors with exit code 2, and the compilation cache."""

from __future__ import annotations

import dataclasses
import gc
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from jaxsafe.address_space import is_shortage
from jaxsafe.config import imports, yaml
from jaxsafe.errors import ConfigError, ConfigWarning, nearest, show
from jaxsafe.streams import lasting_streams

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect."""

DIVERGED = 3
"""Exit code of a training or an evaluation in which the networks of a seed are not finite: there is no result for it."""

PATHS = ("env", "out", "run", "runs", "resume", "policies")
"""Options that are paths, and taken as typed: `out=2024.10` is no number, and `out="my run #3"` has no comment."""

MAX_COUNT = 2**31 - 1
"""The largest whole number, unless an option says otherwise: the programs count in 32 bits."""

MAX_SEED = 2**32 - 1
"""The largest seed: keys of random numbers are made of its lowest 32 bits."""


IMPORTS = "  imports=false          refuse files that name modules to import: that runs the code of whoever wrote them"
"""The help of an option that every command has."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """A command line `key=value …` as typed, values read as YAML scalars but for paths."""

    options: dict[str, Any]

    @classmethod
    def parse(cls, argv: Sequence[str]) -> Arguments:
        """Read the words of a command line.

        Raises:
            ConfigError: a word is not `key=value`, or a key stands twice.
        """
        options: dict[str, Any] = {}
        for word in argv:
            key, equals, text = word.partition("=")
            if not equals or not key:
                raise ConfigError(f"argument {show(word)}: expected key=value, for instance seeds=10")
            if key in options:
                raise ConfigError(f"{key}: given twice")
            options[key] = _path(text, key) if key in PATHS else yaml.parse(text, key)
        return cls(options)

    def pop(self, key: str, default: Any = None) -> Any:
        """Take one option out."""
        return self.options.pop(key, default)

    def pop_text(self, key: str) -> str | None:
        """Take out an option that is a name or a path; `runs/7` and `7` are both text.

        Raises:
            ConfigError: it was given without a value.
        """
        if key not in self.options:
            return None
        value = self.options.pop(key)
        if value is None or isinstance(value, (list, dict, bool)):
            raise ConfigError(f"{key}: expected a name or a path, found {show(value)}")
        return str(value)

    def pop_count(self, key: str, default: int, least: int = 1, most: int = MAX_COUNT) -> int:
        """Take out a whole number.

        Raises:
            ConfigError: it is something else, too small or too large.
        """
        given = self.options.pop(key, default)
        value = int(given) if isinstance(given, float) and given.is_integer() else given
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise ConfigError(f"{key}: expected a whole number ≥ {least}, found {show(given)}")
        if value > most:
            raise ConfigError(f"{key}: expected a whole number from {least} to {most:,}, found {show(given)}")
        return value

    def pop_seed(self, key: str = "seed") -> int:
        """Take out the seed of random numbers, 0 if it was not given.

        Raises:
            ConfigError: it is not one, or so large that it would give the numbers of a smaller one.
        """
        return self.pop_count(key, 0, least=0, most=MAX_SEED)

    def pop_flag(self, key: str) -> bool | None:
        """Take out true or false; None if it was not given.

        Raises:
            ConfigError: it is something else.
        """
        if key not in self.options:
            return None
        value = self.options.pop(key)
        if not isinstance(value, bool):
            raise ConfigError(f"{key}: expected true or false, found {show(value)}")
        return value

    def pop_overrides(self) -> dict[str, Any]:
        """Take out the `env.<path>=value` options, without their prefix."""
        paths = [key for key in self.options if key.startswith("env.")]
        return {key.removeprefix("env."): self.options.pop(key) for key in paths}

    def refuse_beside(self, keys: Iterable[str], situation: str) -> None:
        """Raise a ConfigError for an option that would change nothing in this situation."""
        for key in keys:
            if key in self.options:
                raise ConfigError(f"{key}: means nothing {situation}; leave it out")

    def refuse_rest(self, known: Sequence[str]) -> None:
        """Raise a ConfigError for an option that nobody took."""
        for key in self.options:
            raise ConfigError(f"{key}: unknown option; choose from {nearest(key, known)}")


def _path(text: str, key: str) -> Any:
    """Return a path as typed, or a list of them in brackets; None where there is none."""
    return _from_home(yaml.parse(text, key, as_text=True) if text.startswith("[") else text or None, key)


def _from_home(path: Any, key: str) -> Any:
    """Return a path, or each of a list, with the home directory for its `~`, which a shell leaves alone in `out=~/x`."""
    if isinstance(path, list):
        return [_from_home(one, key) for one in path]
    if not isinstance(path, str) or not path.startswith("~"):
        return path
    expanded = os.path.expanduser(path)
    if expanded == path:
        raise ConfigError(f"{key}: no home directory for {path!r}; write ./{path} for a name that begins with ~")
    return expanded


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table. Each column is as wide as its longest cell; the first stands to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [[f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)] for row in rows]
    return ["  ".join([f"{row[0]:{widths[0]}}", *line[1:]]).rstrip() for row, line in zip(rows, lines, strict=True)]


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
        with imports.allowed(allowed), _warnings_in_one_line():
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
        return f"JAX_PLATFORMS: no device of {chosen!r} can be used here; leave it out, or choose cpu"
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


def in_main_thread() -> bool:
    """Return whether this is the main thread, the only one that may say what a signal does."""
    return threading.current_thread() is threading.main_thread()


@contextmanager
def without_collection() -> Iterator[None]:
    """Hold garbage collection while programs are traced: none of that is garbage, and looking costs a tenth of the time."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def at_once(code: int) -> NoReturn:
    """Leave without Python's shutdown: it would wait for threads that compile, and orbax's print tracebacks into it."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def enable_compilation_cache() -> None:
    """Keep compiled programs between runs, unless the user chose a place or none; the second start is then quick."""
    import jax

    if getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        try:
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
            (base / "jaxsafe").mkdir(parents=True, exist_ok=True)
        except (OSError, RuntimeError):
            return  # a home that cannot be written, or none at all, costs time and nothing else
        jax.config.update("jax_compilation_cache_dir", str(base / "jaxsafe"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
