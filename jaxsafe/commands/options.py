"""The options of a command: one class that the parser and the help text are made from.

A new option is one line of such a class, with the text that explains it below. The annotation says
what the option takes. For instance:

    episodes: Annotated[int, Range(1, largest=MAX_COUNT)] = 1000
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import re
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from jaxsafe.config import arguments
from jaxsafe.schema.component import Component, Field, Range, fields, marks
from jaxsafe.schema.convert import bare
from jaxsafe.schema.errors import ConfigError, choices_text, meant_environment, show

Count = Annotated[int, Range(1, largest=arguments.MAX_COUNT)]
"""A number of episodes, steps or environments."""

Seed = Annotated[int, Range(0, largest=arguments.MAX_SEED)]
"""A seed of random numbers. Larger seeds would give the same numbers as smaller ones."""


@dataclasses.dataclass(frozen=True)
class Option:
    """A mark of an option, which says what the type of the option leaves open."""

    first: bool = False
    """Whether the first word of a command line may be the value alone, as `docking3d` for `env`.

    If the option takes a list, the first words may be its items.
    """

    examples: tuple[str, ...] = ()
    """Words to show if the option is missing. The usage line shows the first one."""

    names: tuple[str, ...] = ()
    """The names to choose from."""

    kind: str = ""
    """What the names stand for, for the error about an unknown name."""

    takes: str = ""
    """What the option takes in words, where its type does not say it."""

    alias: str | None = None
    """An older name, which is accepted too."""

    prefix: str | None = None
    """The beginning that the names of several options share.

    The field gets all these options, by the rest of their names. The empty prefix fits all names,
    so a field with it stands last and gets the options that no other field takes.
    """

    placeholder: str = ""
    """What the help text shows after the prefix."""

    lists: bool = False
    """Whether each option with the prefix takes a list."""

    component: type[Component] | None = None
    """The component whose fields are the options of the empty prefix."""


Directory = Annotated[str, Option(takes="a directory")]

File = Annotated[str, Option(takes="a file")]


class CommandOptions(Component):
    """The options of every command, and the base of the options of a single one."""

    program: ClassVar[str | None] = None
    """How the user calls the command. None stands for `jaxsafe` and the name of the module."""

    groups: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """The options in the order of the help text, by a sentence that says what each group is about.

    `agent.*` stands for all options whose names begin with `agent.`.
    """

    given: Mapping[str, Any]
    """The options that the user gave, as the command line reads them."""
    imports: bool = True
    """Whether files may name modules to import. Importing runs the code of whoever wrote them."""

    @classmethod
    def parse(cls, argv: Sequence[str]) -> Self:
        """Read the words of a command line.

        Raises:
            ConfigError: as `read`; or a word is not `key=value`, or a key stands twice.
        """
        return cls.read(cls.arguments(argv))

    @classmethod
    def arguments(cls, argv: Sequence[str]) -> dict[str, Any]:
        """Return the values on a command line by name. Only their form is checked.

        Raises:
            ConfigError: a word is not `key=value`, or a key stands twice.
        """
        words = list(argv)
        table = options_of(cls).values()
        lists = {
            option(field).prefix or field.name
            for field in table
            if option(field).lists or typing.get_origin(bare(field.hint)) is tuple
        }
        named = next((field.name for field in table if option(field).first), None)
        begin = next((i for i, word in enumerate(words) if not word.startswith("imports=")), 0)
        alone = itertools.takewhile(re.compile(r"[^-=][^=]*").fullmatch, words[begin:])
        # A shell makes several words of `runs/*`.
        if named and (values := list(alone)[: None if named in lists else 1]):
            words[begin : begin + len(values)] = [f"{named}={','.join(values)}"]
        return arguments.Arguments.parse(words, lists).options

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> Self:
        """Check and convert options.

        Args:
            given: the values by name, as `Arguments.parse` reads them.

        Raises:
            ConfigError: an option is unknown or missing, or does not take its value.
        """
        table = options_of(cls)
        rest = dict(given)
        values: dict[str, Any] = {}
        for name, field in table.items():
            mark = option(field)
            for key in (name, mark.alias) if mark.prefix is None else ():
                if key in rest:
                    if name in values:
                        raise ConfigError(f"{key}: is another name of {name}; leave one out")
                    values[name] = _convert(rest.pop(key), field, key)
        for name, field in table.items():
            if (prefix := option(field).prefix) is not None:
                keys = [key for key in rest if key.startswith(prefix)]
                values[name] = {key.removeprefix(prefix): rest.pop(key) for key in keys}
        _refuse(rest, map(shown_name, table.values()))
        for name, field in table.items():
            if field.required and name not in values:
                examples = " or ".join(option(field).examples)
                raise ConfigError(f"{name}: missing; for instance {examples}")
        return cls(given=given, **values)

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
        """Return the defaults that depend on other options, for the help text.

        Args:
            given: the options that were given together with the word that asks for help.

        Returns:
            The defaults by the name of the option, and a sentence about where they come from.

        Raises:
            ConfigError: one of the other options is wrong.
        """
        return {}, ""

    def refuse_beside(self, names: Iterable[str], situation: str) -> None:
        """Refuse options that would change nothing.

        Args:
            names: the options.
            situation: why they would change nothing, as the end of the message.

        Raises:
            ConfigError: one of the options was given.
        """
        for name in names:
            if name in self.given:
                raise ConfigError(f"{name}: means nothing {situation}; leave it out")

    def refuse_others(self, *names: str) -> None:
        """Refuse all options except these and the options of every command.

        Args:
            names: the options. The first one is the reason why there may be no others.

        Raises:
            ConfigError: another option was given.
        """
        for name in self.without(*names):
            raise ConfigError(f"{name}: no option beside {names[0]}{choices_text(name, names)}")

    def without(self, *names: str) -> dict[str, Any]:
        """Return the options that were given, except these and the options of every command."""
        left_out = (*names, *fields(CommandOptions))
        return {name: value for name, value in self.given.items() if name not in left_out}


def option(field: Field) -> Option:
    """Return the mark of an option, or an empty mark if it has none."""
    return next((mark for mark in marks(field.hint) if isinstance(mark, Option)), Option())


def options_of(cls: type[CommandOptions]) -> dict[str, Field]:
    """Return the fields that are options, by name.

    Required options come first, then the others of the command, then those of its base classes.
    """
    table = fields(cls)
    names = [name for base in cls.__mro__ for name in inspect.get_annotations(base)]
    ordered = [table[name] for name in dict.fromkeys(names) if name in table and name != "given"]
    ordered.sort(key=lambda field: not field.required or option(field).prefix is not None)
    return {field.name: field for field in ordered}


def shown_name(field: Field) -> str:
    """Return the name of an option, or the prefix and the placeholder of several options."""
    mark = option(field)
    return field.name if mark.prefix is None else f"{mark.prefix}{mark.placeholder}"


def names_of(field: Field) -> Sequence[str]:
    """Return the names that an option can choose from, or none if it takes something else."""
    hint = bare(field.hint)
    return typing.get_args(hint) if typing.get_origin(hint) is Literal else option(field).names


def _convert(value: Any, field: Field, key: str) -> Any:
    """Return the value of an option as its annotation says.

    Args:
        value: the value as the command line reads it.
        field: the field of the option.
        key: the name by which it was given, for error messages.

    Raises:
        ConfigError: the option does not take this value.
    """
    hint = bare(field.hint)
    if hint is bool:
        return arguments.flag(value, key)
    if hint is int:
        limits = field.range or Range()
        return arguments.count(value, key, least=limits.low, most=limits.largest)
    if hint is float:
        return _number(value, field, key)
    if hint == tuple[float, float]:
        return _interval(value, field, key)
    if hint == tuple[float, ...]:
        return _numbers(value, field, key)
    if hint == tuple[str, ...]:
        items = value if isinstance(value, list) else [value]
        if not items:
            takes = ", ".join(names_of(field)) or option(field).takes
            raise ConfigError(f"{key}: expected at least one of {takes}, found none")
        return tuple(_name(item, field, key) for item in items)
    return _name(value, field, key)


def _name(value: Any, field: Field, key: str) -> str:
    name = arguments.text(value, key)
    names = names_of(field)
    if names and name not in names:
        kind = option(field).kind
        unknown = f"unknown {kind}" if kind else "found"
        raise ConfigError(f"{key}: {unknown} {show(name)}{choices_text(name, names)}")
    return name


def _number(value: Any, field: Field, key: str) -> float:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or value not in (field.range or Range()):
        raise ConfigError(f"{key}: expected {option(field).takes}, found {show(value)}")
    return float(value)


def _interval(value: Any, field: Field, key: str) -> tuple[float, float]:
    numbers = isinstance(value, list) and all(isinstance(item, (int, float)) for item in value)
    if not numbers or len(value) != 2 or not value[0] < value[1]:
        raise ConfigError(f"{key}: expected {option(field).takes}, found {show(value)}")
    return float(value[0]), float(value[1])


def _numbers(value: Any, field: Field, key: str) -> tuple[float, ...]:
    items = value if isinstance(value, list) else [value]
    numbers = all(isinstance(item, int | float) and not isinstance(item, bool) for item in items)
    limits = field.range or Range()
    if not items or not numbers or not all(item in limits for item in items):
        raise ConfigError(f"{key}: expected {option(field).takes}, found {show(value)}")
    return tuple(map(float, items))


def _refuse(given: Iterable[str], known: Iterable[str]) -> None:
    known = list(known)
    for name in given:
        if "env.PATH" in known and (hint := meant_environment(name, ("env", "sweep"))):
            raise ConfigError(hint)
        raise ConfigError(f"{name}: unknown option{choices_text(name, known)}")
