"""Component: a frozen keyword-only dataclass that is a pytree; numbers are leaves, names and counts are structure.

The annotation of a field decides: `str`, `int`, `bool`, `Literal` and tuples of them are structure (changing one compiles
anew), everything else is a leaf or a subtree (changing a number never does). The annotation also carries the unit, the
allowed range and what a name refers to, so that configuration files are checked from the same line.
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.schema.errors import ConfigError

ANY = -1
"""Length of a unit that takes one number or a list of them."""


@dataclasses.dataclass(frozen=True)
class Unit:
    """Marks a leaf field: its unit and shape.

    `length` None is a scalar, 2 an interval, 0 a vector of any length, `ANY` a scalar or such a vector.
    """

    symbol: str
    length: int | None = None


@dataclasses.dataclass(frozen=True)
class Range:
    """The closed or half-open interval in which a number must lie, with or without 0, and how small or large it may be.

    The interval says what has a meaning. `smallest` and `largest` say which magnitudes, 0 apart, single precision can
    compute with. A number must be finite unless it is a limit that may be `infinite`, where it then means none.
    """

    low: float = -float("inf")
    high: float = float("inf")
    open_low: bool = False
    open_high: bool = False
    nonzero: bool = False
    smallest: float = 0.0
    largest: float = float("inf")
    infinite: bool = False

    def __contains__(self, value: float) -> bool:
        above = value > self.low if self.open_low else value >= self.low
        below = value < self.high if self.open_high else value <= self.high
        return above and below and not (self.nonzero and value == 0)

    def __str__(self) -> str:
        if self.nonzero:
            return "other than 0"
        if self.high == -self.low == float("inf"):
            return ""
        if self.high == float("inf"):
            return f"{'>' if self.open_low else '≥'} {self.low:g}"
        return f"in {'(' if self.open_low else '['}{self.low:g}, {self.high:g}{')' if self.open_high else ']'}"

    def carries(self, value: float) -> bool:
        """Whether single precision can compute with a number of this magnitude."""
        return value == 0 or self.smallest <= abs(value) <= self.largest

    @property
    def magnitudes(self) -> str:
        """Return in words what `carries` allows."""
        if self.largest == float("inf"):
            return f"of a magnitude from {self.smallest:g} on" if self.smallest else "that is finite"
        most = f"{self.largest:,}" if isinstance(self.largest, int) else f"{self.largest:g}"
        return f"of a magnitude from {self.smallest:g} to {most}" if self.smallest else f"of a magnitude up to {most}"


@dataclasses.dataclass(frozen=True)
class Refers:
    """Marks a string field that names another part of the environment, for instance an earlier status.

    `boolean` says which kind of status it must be; None takes either.
    """

    section: str
    boolean: bool | None = None


@dataclasses.dataclass(frozen=True)
class Field:
    """What one annotation says about one field of a component."""

    name: str
    hint: Any
    static: bool
    default: Any
    unit: Unit | None = None
    range: Range | None = None
    refers: Refers | None = None

    @property
    def required(self) -> bool:
        return self.default is dataclasses.MISSING


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(dataclasses.field,))
class Component:
    """Base of everything that an environment is composed of.

    A subclass lists its fields with annotations. `type="name"` makes it available in YAML under that name wherever its
    nearest base (Status, Reward, …) is expected.
    """

    type_name: ClassVar[str | None] = None
    many_kinds: ClassVar[bool] = True
    """Set in the body of a class that is a base of several kinds: only within a kind are type names unique."""
    shorthand: ClassVar[str | None] = None
    """A field that holds a tuple of named parts which dotted paths may begin with."""

    def __init_subclass__(cls, *, type: str | None = None) -> None:
        dataclasses.dataclass(frozen=True, kw_only=True, eq=False)(cls)
        cls.type_name = None
        if type:
            _refuse_taken(type, cls)
        cls.type_name = type
        _register(cls)

    def problem(self) -> str | None:
        """Return what is wrong with the fields taken together, None if nothing is; called when a user's values enter."""
        return None

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed; nothing is checked (see `jaxsafe.override` for that)."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def __eq__(self, other: object) -> bool:
        left, left_structure = jax.tree.flatten(self)
        right, right_structure = jax.tree.flatten(other)
        return left_structure == right_structure and all(map(np.array_equal, left, right))

    def __hash__(self) -> int:
        return hash(type(self))


Kind = TypeVar("Kind", bound=Component)


@functools.cache
def fields(cls: type[Component]) -> dict[str, Field]:
    """The fields of a component class by name, in order of definition."""
    hints = typing.get_type_hints(cls, include_extras=True)
    return {item.name: field(item.name, hints[item.name], _default(item)) for item in dataclasses.fields(cls)}  # type: ignore[arg-type]


def choices(base: type[Kind]) -> dict[str, type[Kind]]:
    """Every class that may stand where `base` is expected, by its type name."""
    found = {base.type_name: base} if base.type_name else {}
    for subclass in base.__subclasses__():
        found |= choices(subclass)
    return found


def normalise(value: Any) -> Any:
    """Make every number in a component a strongly typed array, so that Python floats and arrays compile alike.

    Intervals and vectors written as tuples become arrays; the dtype is the default float (float32, or float64 in x64).
    Mappings are sorted by name, as every JAX transformation leaves them: what a component computes from one must not
    depend on the order in which a user wrote it, or it would be another number under jit.
    """
    if isinstance(value, Component):
        table = fields(type(value)).items()
        return value.replace(
            **{
                name: _leaf(getattr(value, name)) if field.unit else normalise(getattr(value, name))
                for name, field in table
            }
        )
    if isinstance(value, tuple):
        return tuple(map(normalise, value))
    return {key: _leaf(value[key]) for key in sorted(value)} if isinstance(value, dict) else value


def _leaf(value: Any) -> Any:
    return None if value is None else jnp.asarray(value, jnp.result_type(float))


def _refuse_taken(type_name: str, cls: type[Component]) -> None:
    """Two classes of one kind cannot share a name; the same class defined again (a notebook's cell) replaces the first."""
    kinds = [base for base in cls.__mro__[1:] if issubclass(base, Component) and not vars(base).get("many_kinds")]
    others = [choices(kind).get(type_name) for kind in kinds if kind.type_name is None]
    other = next((one for one in others if one), None)
    if other and (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
        raise ConfigError(
            f"type {type_name!r} of {cls.__module__}.{cls.__qualname__}: taken by {other.__module__}.{other.__qualname__};"
            " choose another name"
        )


def _register(cls: type[Component]) -> None:
    """Make a class a pytree node.

    Not with `jax.tree_util.register_dataclass`: it leaves the class out when structures are compared, so two classes with
    the same field values are the same key of a jit cache, and now and then one runs the other's compiled program.
    """
    leaves = tuple(one.name for one in fields(cls).values() if not one.static)
    structure = tuple(one.name for one in fields(cls).values() if one.static)
    keys = tuple(map(jax.tree_util.GetAttrKey, leaves))

    def flatten(component: Component) -> tuple[tuple, tuple]:
        return tuple(getattr(component, name) for name in leaves), tuple(getattr(component, name) for name in structure)

    def flatten_with_keys(component: Component) -> tuple[tuple, tuple]:
        children, static = flatten(component)
        return tuple(zip(keys, children, strict=True)), static

    def unflatten(static: tuple, children: Iterable[Any]) -> Component:
        return cls(**dict(zip(structure, static, strict=True)), **dict(zip(leaves, children, strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def unwrap_optional(hint: Any) -> tuple[Any, bool]:
    """`X | None` as (X, True); any other annotation as (annotation, False)."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        options = [option for option in typing.get_args(hint) if option is not type(None)]
        if len(options) == 1:
            return options[0], True
    return hint, False


def field(name: str, hint: Any, default: Any = dataclasses.MISSING) -> Field:
    """What an annotation says."""
    core, _ = unwrap_optional(hint)
    marks = typing.get_args(core)[1:] if typing.get_origin(core) is Annotated else ()
    marks += typing.get_args(hint)[1:] if typing.get_origin(hint) is Annotated else ()

    def first(kind: type) -> Any:
        return next((mark for mark in marks if isinstance(mark, kind)), None)

    return Field(name, hint, _is_static(hint), default, first(Unit), first(Range), first(Refers))


def _is_static(hint: Any) -> bool:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return _is_static(arguments[0])
    if origin is Literal:
        return True
    if origin in (typing.Union, types.UnionType, tuple):
        return all(_is_static(argument) for argument in arguments if argument not in (type(None), Ellipsis))
    return hint in (str, int, bool)


def _default(item: dataclasses.Field) -> Any:
    return item.default if item.default_factory is dataclasses.MISSING else item.default_factory()
