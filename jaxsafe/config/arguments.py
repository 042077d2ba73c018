"""The `key=value` words of a command line.

Values are read as YAML scalars. `text`, `count` and `flag` check them.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Collection, Sequence
from itertools import zip_longest
from typing import Any

from jaxsafe.schema import yaml12
from jaxsafe.schema.errors import ConfigError, show

PATHS = ("env", "out", "run", "runs", "resume", "policies", "recipe", "like")
"""Options that are paths.

They are taken as typed, so that `out=2024.10` is no number and `out="my run #3"` has no comment.
"""

TEXT = "a name or a path"
"""What an option takes whose value is text, as error messages write it."""

MAX_COUNT = 2**31 - 1
"""Largest whole number, unless an option says otherwise. The programs count in 32 bits."""

MAX_SEED = 2**32 - 1
"""Largest seed. PRNG keys are made of the lowest 32 bits of a seed."""

_GROUPED = re.compile(r"[-+]?[0-9]{1,3}(?:_[0-9]{3})+")
"""A whole number whose digits are in groups, such as 100_000."""

_DASHED = re.compile(r"--?([A-Za-z][^=]*)(?:=(.*))?", re.DOTALL)
"""An option as other programs take it, such as `--seeds=10` or `--seeds`."""

_OPENINGS = ("[", "log(", "uniform(")
"""How values begin that get no brackets: lists that have their own, and intervals to draw from."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """The options of a command line `key=value …`."""

    options: dict[str, Any]
    """Values by key. Paths are as typed, other values are read as YAML scalars."""

    @classmethod
    def parse(cls, argv: Sequence[str], lists: Collection[str] = ()) -> Arguments:
        """Read the words of a command line.

        Args:
            argv: the words.
            lists: the options that take a list. `PREFIX.` stands for all options whose names begin
                with it. The brackets of a list may be left out, as in `run=a,b`.

        Raises:
            ConfigError: a word is not `key=value`, or a key stands twice.
        """
        options: dict[str, Any] = {}
        for word, following in zip_longest(argv, argv[1:], fillvalue=""):
            key, equals, typed = word.partition("=")
            if dashed := _DASHED.fullmatch(word):
                name = dashed[1].replace("-", "_")
                value = following if dashed[2] is None and "=" not in following else dashed[2]
                raise ConfigError(
                    f"argument {show(word)}: options have no dashes; write {name}={value or '…'}"
                )
            if not equals or not key:
                raise ConfigError(
                    f"argument {show(word)}: expected key=value; the word help lists the options"
                )
            if key in options:
                raise ConfigError(f"{key}: given twice")
            is_list = key in lists or f"{key.partition('.')[0]}." in lists
            if is_list and "," in typed and not typed.startswith(_OPENINGS):
                typed = f"[{typed}]"
            options[key] = _path(typed, key) if key in PATHS else _value(typed, key)
        return cls(options)

    def pop(self, key: str, default: Any = None) -> Any:
        """Take out an option. Return its value, or `default` if it was not given."""
        return self.options.pop(key, default)

    def pop_text(self, key: str) -> str | None:
        """Take out an option that is a name or a path. Return None if it was not given.

        Raises:
            ConfigError: the value is not text; see `text`.
        """
        return text(self.options.pop(key), key) if key in self.options else None

    def pop_overrides(self) -> dict[str, Any]:
        """Take out the `env.<path>=value` options. Return their values by path, without `env.`."""
        paths = [key for key in self.options if key.startswith("env.")]
        return {key.removeprefix("env."): self.options.pop(key) for key in paths}


def text(value: Any, key: str) -> str:
    """Return the value of an option that is a name or a path.

    Both `runs/7` and `7` are text.

    Raises:
        ConfigError: the option has no value, or it is a list, a mapping or a truth value.
    """
    if value is None or isinstance(value, (list, dict, bool)):
        raise ConfigError(f"{key}: expected {TEXT}, found {show(value)}")
    return str(value)


def count(value: Any, key: str, least: float, most: float) -> int:
    """Return the value of an option that is a whole number.

    Args:
        value: the value, which may be a float such as 1e6.
        key: the option.
        least: the smallest number that is allowed.
        most: the largest number that is allowed.

    Raises:
        ConfigError: the value is no whole number, or it is too small or too large.
    """
    number = int(value) if isinstance(value, float) and value.is_integer() else value
    if not isinstance(number, int) or isinstance(number, bool) or number < least:
        raise ConfigError(f"{key}: expected a whole number ≥ {least}, found {show(value)}")
    if number > most:
        raise ConfigError(
            f"{key}: expected a whole number from {least} to {most:,}, found {show(value)}"
        )
    return number


def flag(value: Any, key: str) -> bool:
    """Return the value of an option that is true or false.

    Raises:
        ConfigError: the value is neither true nor false.
    """
    if not isinstance(value, bool):
        raise ConfigError(f"{key}: expected true or false, found {show(value)}")
    return value


def _value(typed: str, key: str) -> Any:
    """Return a value that is no path. Unlike in YAML, 100_000 is a number and not text."""
    return _ungrouped(yaml12.parse(typed, key), key)


def _ungrouped(value: Any, key: str) -> Any:
    if isinstance(value, list):
        return [_ungrouped(item, key) for item in value]
    grouped = isinstance(value, str) and _GROUPED.fullmatch(value)
    return yaml12.parse(value.replace("_", ""), key) if grouped else value


def _path(typed: str, key: str) -> Any:
    """Return a path as typed, or a list of paths if it is in brackets. Return None for no text."""
    return _from_home(
        yaml12.parse(typed, key, as_text=True) if typed.startswith("[") else typed or None, key
    )


def _from_home(path: Any, key: str) -> Any:
    """Return a path, or each path of a list, with the home directory in place of its `~`.

    Not every shell replaces the `~` of `out=~/x`, because the word does not begin with it.
    """
    if isinstance(path, list):
        return [_from_home(item, key) for item in path]
    if not isinstance(path, str) or not path.startswith("~"):
        return path
    expanded = os.path.expanduser(path)
    if expanded == path:
        raise ConfigError(
            f"{key}: no home directory for {path!r}; write ./{path} for a name that begins with ~"
        )
    return expanded
