"""The `key=value` words of a command line, read as YAML scalars and checked as they are taken out."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence
from typing import Any

from jaxsafe.schema import yaml12
from jaxsafe.schema.errors import ConfigError, nearest, show

PATHS = ("env", "out", "run", "runs", "resume", "policies")
"""Options that are paths, and taken as typed: `out=2024.10` is no number, and `out="my run #3"` has no comment."""

MAX_COUNT = 2**31 - 1
"""The largest whole number, unless an option says otherwise: the programs count in 32 bits."""

MAX_SEED = 2**32 - 1
"""The largest seed: keys of random numbers are made of its lowest 32 bits."""


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
                raise ConfigError(
                    f"argument {show(word)}: expected key=value, for instance seeds=10"
                )
            if key in options:
                raise ConfigError(f"{key}: given twice")
            options[key] = _path(text, key) if key in PATHS else yaml12.parse(text, key)
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
            raise ConfigError(
                f"{key}: expected a whole number from {least} to {most:,}, found {show(given)}"
            )
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
    return _from_home(
        yaml12.parse(text, key, as_text=True) if text.startswith("[") else text or None, key
    )


def _from_home(path: Any, key: str) -> Any:
    """Return a path, or each of a list, with the home directory for its `~`, which a shell leaves alone in `out=~/x`."""
    if isinstance(path, list):
        return [_from_home(one, key) for one in path]
    if not isinstance(path, str) or not path.startswith("~"):
        return path
    expanded = os.path.expanduser(path)
    if expanded == path:
        raise ConfigError(
            f"{key}: no home directory for {path!r}; write ./{path} for a name that begins with ~"
        )
    return expanded
