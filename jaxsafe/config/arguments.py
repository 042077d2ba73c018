"""The `key=value` words of a command line.

Values are read as YAML scalars and are checked when they are taken out.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence
from typing import Any

from jaxsafe.schema import yaml12
from jaxsafe.schema.errors import ConfigError, nearest, show

PATHS = ("env", "out", "run", "runs", "resume", "policies")
"""Options that are paths.

They are taken as typed, so `out=2024.10` is no number and `out="my run #3"` has no comment.
"""

MAX_COUNT = 2**31 - 1
"""Largest whole number, unless an option says otherwise. The programs count in 32 bits."""

MAX_SEED = 2**32 - 1
"""Largest seed. Keys of random numbers are made of its lowest 32 bits."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """The options of a command line `key=value …`."""

    options: dict[str, Any]
    """Values by key. Paths are as typed, other values are read as YAML scalars."""

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
        """Take out an option. Return its value, or `default` if it was not given."""
        return self.options.pop(key, default)

    def pop_text(self, key: str) -> str | None:
        """Take out an option that is a name or a path. Return None if it was not given.

        Both `runs/7` and `7` are text.

        Raises:
            ConfigError: the option has no value, or it is a list, a mapping or a truth value.
        """
        if key not in self.options:
            return None
        value = self.options.pop(key)
        if value is None or isinstance(value, (list, dict, bool)):
            raise ConfigError(f"{key}: expected a name or a path, found {show(value)}")
        return str(value)

    def pop_count(self, key: str, default: int, least: int = 1, most: int = MAX_COUNT) -> int:
        """Take out a whole number.

        Args:
            key: the option.
            default: the number if the option was not given.
            least: the smallest number that is allowed.
            most: the largest number that is allowed.

        Raises:
            ConfigError: the value is no whole number, or it is too small or too large.
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
        """Take out the seed of random numbers. Return 0 if it was not given.

        Raises:
            ConfigError: the value is no seed, or it is so large that it would give the same random
                numbers as a smaller seed.
        """
        return self.pop_count(key, 0, least=0, most=MAX_SEED)

    def pop_flag(self, key: str) -> bool | None:
        """Take out an option that is true or false. Return None if it was not given.

        Raises:
            ConfigError: the value is neither true nor false.
        """
        if key not in self.options:
            return None
        value = self.options.pop(key)
        if not isinstance(value, bool):
            raise ConfigError(f"{key}: expected true or false, found {show(value)}")
        return value

    def pop_overrides(self) -> dict[str, Any]:
        """Take out the `env.<path>=value` options. Return their values by path, without `env.`."""
        paths = [key for key in self.options if key.startswith("env.")]
        return {key.removeprefix("env."): self.options.pop(key) for key in paths}

    def refuse_beside(self, keys: Iterable[str], situation: str) -> None:
        """Refuse options that would change nothing.

        Args:
            keys: the options.
            situation: why they would change nothing, as the end of the message.

        Raises:
            ConfigError: one of the options was given.
        """
        for key in keys:
            if key in self.options:
                raise ConfigError(f"{key}: means nothing {situation}; leave it out")

    def refuse_rest(self, known: Sequence[str]) -> None:
        """Refuse options that have not been taken out.

        Args:
            known: the options that the command has, to suggest the nearest one.

        Raises:
            ConfigError: an option is left.
        """
        for key in self.options:
            raise ConfigError(f"{key}: unknown option; choose from {nearest(key, known)}")


def _path(text: str, key: str) -> Any:
    """Return a path as typed, or a list of paths if it is in brackets. Return None for no text."""
    return _from_home(
        yaml12.parse(text, key, as_text=True) if text.startswith("[") else text or None, key
    )


def _from_home(path: Any, key: str) -> Any:
    """Return a path, or each path of a list, with the home directory in place of its `~`.

    A shell leaves the `~` of `out=~/x` alone.
    """
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
