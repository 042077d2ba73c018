"""Component: a frozen keyword-only dataclass that is a pytree.

Numbers are leaves, names and counts are structure. The annotation of a field decides: `str`, `int`,
`bool`, `float`, `Literal` and tuples of them are structure, and changing one compiles again.
Everything else is a leaf or a subtree, and changing a number with a unit never compiles again. The
annotation also carries the unit, the allowed range and what a name refers to, so configuration
files are checked from the same line.
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.schema.errors import ConfigError

ANY = -1
"""Length of a unit that takes one number or a list of them."""


@dataclasses.dataclass(frozen=True)
class Unit:
    """Mark of a leaf field that gives its unit and shape.

    `length` is None for a scalar, 2 for an interval, 0 for a vector of any length, and `ANY` for a
    scalar or a vector of any length.
    """

    symbol: str
    length: int | None = None


@dataclasses.dataclass(frozen=True)
class Range:
    """The closed or half-open interval in which a number must lie, and the magnitudes it may have.

    The interval says which numbers have a meaning, and `nonzero` takes 0 out of it. `smallest` and
    `largest` say which magnitudes, apart from 0, single precision can compute with. A number must
    be finite. Only a limit may be allowed to be `infinite`, and infinity then means no limit.
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
        opening = "(" if self.open_low else "["
        closing = ")" if self.open_high else "]"
        return f"in {opening}{self.low:g}, {self.high:g}{closing}"

    def carries(self, value: float) -> bool:
        """Return whether single precision can compute with a number of this magnitude."""
        return value == 0 or self.smallest <= abs(value) <= self.largest

    @property
    def magnitudes(self) -> str:
        """Describe in words the magnitudes that `carries` allows."""
        if self.largest == float("inf"):
            return (
                f"of a magnitude from {self.smallest:g} on" if self.smallest else "that is finite"
            )
        largest = f"{self.largest:,}" if isinstance(self.largest, int) else f"{self.largest:g}"
        if self.smallest:
            return f"of a magnitude from {self.smallest:g} to {largest}"
        return f"of a magnitude up to {largest}"


@dataclasses.dataclass(frozen=True)
class Refers:
    """Mark of a string field that names another part of the environment, such as a status.

    `section` is where that part is listed. The section `places` stands for `platforms` and
    `regions` together. `boolean` says whether a status must be true or false
    (True) or a number (False); None allows both.
    """

    section: str
    boolean: bool | None = None

    @property
    def where(self) -> str:
        """The section in which the part is listed, as messages write it."""
        return "`platforms` or `regions`" if self.section == "places" else f"`{self.section}`"


@dataclasses.dataclass(frozen=True)
class Field:
    """Description of one field of a component, which follows from its annotation."""

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


@dataclass_transform(
    kw_only_default=True, frozen_default=True, field_specifiers=(dataclasses.field,)
)
class Component:
    """Base class of everything that an environment is composed of.

    A subclass lists its fields with annotations. `type="name"` makes it available in YAML under
    that name wherever its nearest base (Status, Reward, …) is expected.
    """

    type_name: ClassVar[str | None] = None
    many_kinds: ClassVar[bool] = True
    """Whether this class is a base of several kinds of component. It is set in the body of such a
    class and not inherited. Type names need to be unique only within a kind."""
    shorthand: ClassVar[str | None] = None
    """Name of a field that lists named parts. Dotted paths may begin with one of their names."""
    field_word: ClassVar[str] = "field"
    """What messages call a field of this component: an option, if a user types it as one."""
    synonyms: ClassVar[Mapping[str, str]] = {}
    """Paths of fields by the names that they have in other libraries. Only messages use them."""

    def __init_subclass__(cls, *, type: str | None = None) -> None:
        # One `__repr__` serves all, because writing one for each class takes long.
        dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)(cls)
        cls.type_name = None
        if type:
            _refuse_taken(type, cls)
        cls.type_name = type
        _register(cls)

    @classmethod
    def prepared(cls, entries: dict[str, Any], place: str) -> dict[str, Any]:
        """Return the values of fields that the entries of a user stand for.

        A subclass may, for instance, read them from a file that an entry names.

        Args:
            entries: the entries in a configuration file, by name.
            place: the place with which error messages begin.
        """
        return entries

    def problem(self) -> str | None:
        """Return what is wrong with the fields taken together, or None if nothing is.

        It is called when values come from a user.
        """
        return None

    def misfits(self, env: Any) -> dict[str, str]:
        """Return which fields do not fit the other parts of an environment.

        It is called once, when the environment is built and every name that its parts refer to is
        known to exist. It looks at names, types and shapes only, because numbers may be traced.

        Args:
            env: the environment to which the component belongs.

        Returns:
            What is wrong, in words, by the name of the field. The name `""` stands for the whole
            component.
        """
        return {}

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed. Unlike `jaxsafe.override`, check nothing."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={getattr(self, name)!r}" for name in fields(type(self)))
        return f"{type(self).__qualname__}({values})"

    def __eq__(self, other: object) -> bool:
        left, left_structure = jax.tree.flatten(self)
        right, right_structure = jax.tree.flatten(other)
        return left_structure == right_structure and all(map(np.array_equal, left, right))

    def __hash__(self) -> int:
        return hash(type(self))


Kind = TypeVar("Kind", bound=Component)


@functools.cache
def fields(cls: type[Component]) -> dict[str, Field]:
    """Return the fields of a component class by name, in order of definition."""
    hints = typing.get_type_hints(cls, include_extras=True)
    return {
        item.name: field(item.name, hints[item.name], _default(item))
        for item in dataclasses.fields(cls)  # type: ignore[arg-type]
    }


def choices(base: type[Kind]) -> dict[str, type[Kind]]:
    """Return every class that may stand where `base` is expected, by its type name."""
    classes = {base.type_name: base} if base.type_name else {}
    for subclass in base.__subclasses__():
        classes |= choices(subclass)
    return classes


def normalise(value: Any) -> Any:
    """Make every number in a component a strongly typed array.

    Python floats and arrays then compile alike. Intervals and vectors written as tuples become
    arrays too. The dtype is the default float: float32, or float64 in x64.

    Mappings are sorted by name, because every JAX transformation sorts them. If they kept the order
    in which a user wrote them, a component could compute another number under jit than without it.
    """
    if isinstance(value, Component):
        changes = {}
        for name, field in fields(type(value)).items():
            content = getattr(value, name)
            is_number = field.unit or (isinstance(content, int | float) and not field.static)
            changes[name] = _as_array(content) if is_number else normalise(content)
        return value.replace(**changes)
    if isinstance(value, tuple):
        return tuple(map(normalise, value))
    if isinstance(value, dict):
        return {key: _normalised_item(value[key]) for key in sorted(value)}
    return value


def _normalised_item(item: Any) -> Any:
    return normalise(item) if isinstance(item, Component) else _as_array(item)


def _as_array(value: Any) -> Any:
    if value is None:
        return None
    dtype = jnp.result_type(float)
    if not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
        value = np.asarray(value, dtype)  # JAX would compile the conversion of a Python number
    return jnp.asarray(value, dtype)


def _refuse_taken(type_name: str, cls: type[Component]) -> None:
    """Refuse a type name that another class of the same kind already has.

    A class that is defined again, as by a notebook's cell, replaces its first definition.
    """
    kinds = [
        base
        for base in cls.__mro__[1:]
        if issubclass(base, Component) and not vars(base).get("many_kinds")
    ]
    namesakes = [choices(kind).get(type_name) for kind in kinds if kind.type_name is None]
    other = next((namesake for namesake in namesakes if namesake), None)
    if other and (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
        raise ConfigError(
            f"type {type_name!r} of {cls.__module__}.{cls.__qualname__}: taken by "
            f"{other.__module__}.{other.__qualname__}; choose another name"
        )


def _register(cls: type[Component]) -> None:
    """Make a class a pytree node.

    `jax.tree_util.register_dataclass` is not used, because it leaves the class out when structures
    are compared. Two classes with the same field values would then be the same key of a jit cache,
    and now and then one would run the other's compiled program.
    """
    leaves = tuple(field.name for field in fields(cls).values() if not field.static)
    structure = tuple(field.name for field in fields(cls).values() if field.static)
    keys = tuple(map(jax.tree_util.GetAttrKey, leaves))

    def flatten(component: Component) -> tuple[tuple, tuple]:
        children = tuple(getattr(component, name) for name in leaves)
        static = tuple(getattr(component, name) for name in structure)
        return children, static

    def flatten_with_keys(component: Component) -> tuple[tuple, tuple]:
        children, static = flatten(component)
        return tuple(zip(keys, children, strict=True)), static

    def unflatten(static: tuple, children: Iterable[Any]) -> Component:
        return cls(
            **dict(zip(structure, static, strict=True)), **dict(zip(leaves, children, strict=True))
        )

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


def unwrap_optional(hint: Any) -> tuple[Any, bool]:
    """Return (X, True) for an annotation `X | None`, and (annotation, False) for any other."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        options = [option for option in typing.get_args(hint) if option is not type(None)]
        if len(options) == 1:
            return options[0], True
    return hint, False


def field(name: str, hint: Any, default: Any = dataclasses.MISSING) -> Field:
    """Return the description of a field that follows from its annotation `hint`."""

    def first(kind: type) -> Any:
        return next((mark for mark in marks(hint) if isinstance(mark, kind)), None)

    return Field(
        name=name,
        hint=hint,
        static=_is_static(hint),
        default=default,
        unit=first(Unit),
        range=first(Range),
        refers=first(Refers),
    )


def marks(hint: Any) -> tuple:
    """Return the marks of an annotation, also of one that is optional."""
    core, _ = unwrap_optional(hint)
    inner = typing.get_args(core)[1:] if typing.get_origin(core) is Annotated else ()
    return inner + (typing.get_args(hint)[1:] if typing.get_origin(hint) is Annotated else ())


def _is_static(hint: Any) -> bool:
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin is Annotated:
        return _is_static(arguments[0])
    if origin is Literal:
        return True
    if origin in (typing.Union, types.UnionType, tuple):
        members = [argument for argument in arguments if argument not in (type(None), Ellipsis)]
        return all(map(_is_static, members))
    return hint in (str, int, bool, float)


def _default(item: dataclasses.Field) -> Any:
    factory = item.default_factory
    return item.default if factory is dataclasses.MISSING else factory()
