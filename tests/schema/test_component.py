"""Components: what is structure and what is a leaf. A change of numbers never compiles anew."""

import dataclasses
import types
from typing import Annotated, Any, Literal

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.processors.reward import Failure
from jaxsafe.schema.component import ANY, Component, Range, Unit, choices, field, fields, normalise
from jaxsafe.schema.convert import expects, to_value
from jaxsafe.schema.errors import ConfigError
from jaxsafe.schema.json_schema import json_schema
from jaxsafe.types import Length, Positive, StatusName

Size = Annotated[Any, Unit("m"), Positive]


class Part(Component):
    """A nested component."""

    name: str
    size: Length = 1.0


class SmallPart(Part, type="small"):
    pass


class LargePart(Part, type="large"):
    extra: Length = 2.0


class Twin(Part):
    """A class with the same fields as `SmallPart`."""


class Whole(Component):
    """A component with one field of every kind."""

    name: str
    count: Annotated[int, Range(1)] = 1
    flag: bool = False
    kind: Literal["a", "b"] = "a"
    words: tuple[str, ...] = ()
    refers: StatusName = "speed"
    maybe: str | None = None
    length: Size = 1.0
    optional: Size | None = None
    interval: Annotated[Any, Unit("m", length=2)] = (0.0, 1.0)
    scale: Annotated[Any, Unit("m", length=ANY), Range(nonzero=True)] = 1.0
    table: dict[str, Length]
    either: Size | dict[str, Size] | None = None
    part: Part = SmallPart(name="part")
    parts: tuple[Part, ...] = ()


@pytest.fixture
def whole() -> Whole:
    parts = (SmallPart(name="x", size=3), LargePart(name="y", size=np.float64(4.0)))
    return normalise(Whole(name="whole", table={"b": 2, "a": 1.0}, parts=parts))


def test_the_annotation_decides_what_is_structure() -> None:
    static = {name for name, field in fields(Whole).items() if field.static}
    assert static == {"name", "count", "flag", "kind", "words", "refers", "maybe"}


def test_the_annotation_carries_unit_range_and_reference() -> None:
    table = fields(Whole)
    assert table["length"].unit == Unit("m")
    assert table["length"].range == Positive
    assert table["optional"].unit == Unit("m")
    assert table["interval"].unit == Unit("m", length=2)
    assert table["refers"].refers is not None
    assert table["refers"].refers.section == "status"
    assert [name for name, field in table.items() if field.required] == ["name", "table"]


def test_ranges_know_their_open_and_closed_ends() -> None:
    assert 0.0 not in Positive
    assert 1e-9 in Positive
    closed = Range(2.0, 3.0)
    assert 2 in closed
    assert 3 in closed
    assert 3.1 not in closed
    assert 3 not in Range(2.0, 3.0, open_high=True)
    assert float("nan") not in closed
    assert str(Positive) == "> 0"
    assert str(Range(0.0)) == "≥ 0"
    assert str(Range(0.0, 1.0, open_low=True)) == "in (0, 1]"


def test_a_range_may_leave_out_zero_alone() -> None:
    nonzero = Range(nonzero=True)
    assert 0 not in nonzero
    assert -0.0 not in nonzero
    assert -1e-30 in nonzero
    assert 3 in nonzero
    assert float("nan") not in nonzero
    assert str(nonzero) == "other than 0"
    assert -2.0 not in Range(-1.0, 1.0, nonzero=True)


@pytest.mark.parametrize(
    "value", [3, -2.0, [1.0], [1, -2, 3], (4.0, 5.0), np.arange(1.0, 4.0), jnp.ones(2)]
)
def test_a_unit_of_any_length_takes_a_number_or_a_list(value: Any) -> None:
    read = to_value(value, fields(Whole)["scale"], "scale")
    assert read.dtype == jnp.float32
    np.testing.assert_array_equal(read, np.asarray(value, np.float32))


@pytest.mark.parametrize(
    "value", [0, [1.0, 0.0], [[1.0]], [True], ["a"], None, float("nan"), [1.0, None]]
)
def test_a_unit_of_any_length_refuses_zeros_tables_and_words(value: Any) -> None:
    with pytest.raises(
        ConfigError,
        match=r"^scale: expected a number or a list of numbers in m other than 0, found ",
    ):
        to_value(value, fields(Whole)["scale"], "scale")


@pytest.mark.parametrize(
    ("length", "words"),
    [
        (None, "a number"),
        (2, "a list [low, high]"),
        (0, "a list of numbers"),
        (ANY, "a number or a list of numbers"),
    ],
)
def test_a_field_says_in_words_what_it_takes(length: int | None, words: str) -> None:
    field = dataclasses.replace(fields(Whole)["scale"], unit=Unit("ft", length), range=None)
    assert expects(field) == f"{words} in ft"


def test_numbers_are_the_leaves(whole: Whole) -> None:
    leaves = {
        jax.tree_util.keystr(path): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(whole)
    }
    expected = {
        ".length": 1.0,
        ".table['a']": 1.0,
        ".table['b']": 2.0,
        ".part.size": 1.0,
        ".parts[0].size": 3.0,
    }
    expected |= {".parts[1].size": 4.0, ".parts[1].extra": 2.0, ".scale": 1.0}
    assert set(leaves) == {*expected, ".interval"}
    assert all(leaves[path] == value for path, value in expected.items())


def test_flattening_and_unflattening_gives_the_same_component(whole: Whole) -> None:
    leaves, structure = jax.tree.flatten(whole)
    again = jax.tree.unflatten(structure, leaves)
    assert type(again) is Whole
    assert again == whole
    assert (again.name, again.kind, again.parts[1].name) == ("whole", "a", "y")


def test_unflattening_checks_nothing_so_that_any_leaf_passes(whole: Whole) -> None:
    assert jax.tree.map(lambda _: None, whole).length is None
    assert jax.tree.map(lambda leaf: -leaf, whole).length == -1.0


def test_components_are_frozen_and_keyword_only(whole: Whole) -> None:
    with pytest.raises(AttributeError):
        whole.length = 2.0  # type: ignore[misc]
    with pytest.raises(TypeError):
        Part("name")  # type: ignore[misc]


def test_after_normalising_no_leaf_is_weakly_typed_or_of_another_dtype(whole: Whole) -> None:
    for leaf in jax.tree.leaves(whole):
        assert isinstance(leaf, jax.Array)
        assert leaf.dtype == jnp.float32
        assert not leaf.aval.weak_type


def test_in_x64_normalising_gives_float64() -> None:
    with jax.enable_x64(True):
        built = normalise(Whole(name="whole", table={}, length=0.1))
        assert {leaf.dtype for leaf in jax.tree.leaves(built)} == {np.dtype("float64")}
        assert float(built.length) == 0.1


def test_equality_compares_every_number_and_every_name(whole: Whole) -> None:
    assert whole == normalise(whole.replace(length=1))
    assert whole != whole.replace(length=jnp.float32(1.5))
    assert whole != whole.replace(name="other")
    assert whole != whole.replace(kind="b")
    assert whole != whole.replace(table={"a": 1.0, "c": 2.0})
    assert whole != whole.replace(parts=whole.parts[::-1])
    assert whole != whole.replace(interval=jnp.asarray([0.0, 2.0]))
    assert normalise(SmallPart(name="x")) != normalise(LargePart(name="x"))
    assert normalise(Twin(name="x")) != normalise(SmallPart(name="x"))
    assert whole != "whole"
    assert whole != None  # noqa: E711


def test_equal_components_have_equal_hashes_and_can_be_keys(whole: Whole) -> None:
    same = normalise(whole.replace(length=1))
    assert hash(same) == hash(whole)
    assert {whole: 1}[same] == 1
    assert {whole: 1, whole.replace(name="other"): 2}[whole] == 1


def test_any_numbers_compile_once() -> None:
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def area(whole: Whole) -> jax.Array:
        return whole.length * whole.count + sum(whole.table.values()) + jnp.sum(whole.interval)

    values = (1, 2.0, np.float64(3.0), np.float32(4.0), jnp.float32(5.0), jnp.asarray(6))
    built = [normalise(Whole(name="whole", length=value, table={"a": value})) for value in values]
    assert [float(area(whole)) for whole in built] == [2.0 * float(value) + 1.0 for value in values]
    assert float(area(jax.tree.map(lambda leaf: 2 * leaf, built[0]))) == 6.0


def test_a_field_may_take_a_number_or_a_number_for_each_name() -> None:
    field_either = fields(Whole)["either"]
    assert not field_either.static
    assert expects(field_either) == "a number in m > 0 or a mapping"
    assert to_value(2, field_either, "here") == jnp.array(2.0)
    assert to_value({"b": 1, "a": 2}, field_either, "here") == {"a": 2.0, "b": 1.0}
    assert to_value(None, field_either, "here") is None
    for wrong, message in (
        (0, "here: expected a number in m > 0, found 0"),
        ({"a": 0}, "here.a: expected a number in m > 0, found 0"),
        (["a"], "here: expected a number in m > 0, found .'a'."),
    ):
        with pytest.raises(ConfigError, match=message):
            to_value(wrong, field_either, "here")
    for value in (0.1, {"b": 0.1, "a": 1}):
        leaves = jax.tree.leaves(normalise(Whole(name="whole", table={}, either=value)).either)
        assert all(isinstance(leaf, jax.Array) and not leaf.weak_type for leaf in leaves)
    schema = json_schema(Whole)["properties"]["either"]
    number = {"type": "number", "exclusiveMinimum": 0.0}
    assert schema["anyOf"][0]["anyOf"] == [
        number,
        {"type": "object", "additionalProperties": number},
    ]


def test_a_change_of_structure_compiles_anew() -> None:
    traces = []

    @jax.jit
    def times(whole: Whole) -> jax.Array:
        traces.append(whole.count)
        return whole.length * whole.count

    built = normalise(Whole(name="whole", length=2.0, table={}))
    assert times(built) == 2.0
    assert times(built.replace(count=3)) == 6.0
    assert times(built) == 2.0
    assert traces == [1, 3]


def test_two_classes_with_the_same_fields_are_different_structures() -> None:
    small = normalise(SmallPart(name="x"))
    twin = normalise(Twin(name="x"))
    assert jax.tree.structure(small) != jax.tree.structure(twin)
    assert jax.tree.structure((small, small)) != jax.tree.structure((small, twin))


def test_a_class_never_runs_the_program_compiled_for_another() -> None:
    def make_class(index: int) -> type[Component]:
        def value(self: Any) -> jax.Array:
            return self.size + index

        return type(f"Numbered{index}", (Part,), {"value": value})

    value = jax.jit(lambda part: part.value())
    assert [
        float(value(normalise(make_class(index)(name="x", size=0.0)))) for index in range(30)
    ] == list(range(30))


def test_vmap_over_a_leaf_gives_a_batch_of_components() -> None:
    lengths = jnp.asarray([1.0, 2.0, 3.0])
    batch = jax.vmap(lambda length: normalise(Part(name="x")).replace(size=length))(lengths)
    assert batch.name == "x"
    chex.assert_trees_all_equal(jax.vmap(lambda part: 2 * part.size)(batch), 2 * lengths)


def test_types_are_chosen_by_name_among_all_subclasses() -> None:
    assert choices(Part) == {"small": SmallPart, "large": LargePart}
    assert choices(SmallPart) == {"small": SmallPart}
    assert choices(Whole) == {}


def test_a_component_has_no_problem_unless_it_says_so(whole: Whole) -> None:
    class Ordered(Part):
        def problem(self) -> str | None:
            return "too small" if self.size < 1.0 else None

    assert whole.problem() is None
    assert Ordered(name="x", size=0.5).problem() == "too small"
    assert Ordered(name="x", size=2.0).problem() is None


def define(
    base: type[Component], name: str, type_name: str, module: str = __name__
) -> type[Component]:
    """Define a subclass in the way a module of that name would."""
    return types.new_class(
        name, (base,), {"type": type_name}, lambda body: body.update(__module__=module)
    )


@pytest.fixture
def kind() -> type[Component]:
    """Return a base class with one named class.

    What a test defines below it is seen by no other test.
    """
    base = types.new_class("Kind", (Component,))
    define(base, "Taken", "taken")
    return base


def test_a_taken_type_name_is_refused_and_both_classes_are_named(kind: type[Component]) -> None:
    with pytest.raises(
        ConfigError,
        match=r"^type 'taken' of elsewhere\.Mine: taken by .*\.Taken; choose another name$",
    ):
        define(kind, "Mine", "taken", module="elsewhere")
    with pytest.raises(ConfigError, match="taken by"):
        define(kind, "Other", "taken")
    with pytest.raises(ConfigError, match="taken by"):
        define(kind, "Taken", "taken", module="elsewhere")


def test_a_taken_type_name_is_refused_below_another_class_of_the_kind(
    kind: type[Component],
) -> None:
    named = define(kind, "Named", "named")
    before = choices(kind)
    with pytest.raises(ConfigError, match="taken by") as caught:
        define(named, "Mine", "taken")
    # The traceback keeps the refused class alive, and it is still not a choice.
    assert choices(kind) == before
    del caught


def test_a_taken_type_name_is_refused_below_an_unnamed_class_of_the_kind(
    kind: type[Component],
) -> None:
    middle = types.new_class("Middle", (kind,))
    with pytest.raises(ConfigError, match="taken by"):
        define(middle, "Mine", "taken")


def test_the_same_class_may_be_defined_again_and_replaces_the_first(kind: type[Component]) -> None:
    first = choices(kind)["taken"]
    again = define(kind, "Taken", "taken")
    assert again is not first
    assert choices(kind)["taken"] is again


def test_different_kinds_may_share_a_type_name(kind: type[Component]) -> None:
    twin = types.new_class("OtherKind", (Component,))
    assert choices(twin) == {}
    taken = define(twin, "Mine", "taken")
    assert choices(twin) == {"taken": taken}
    assert choices(kind)["taken"] is not taken


def test_a_type_name_is_not_inherited(kind: type[Component]) -> None:
    class Below(choices(kind)["taken"]):  # type: ignore[misc]
        """A subclass that asks for no name."""

    assert Below.type_name is None
    assert choices(kind) == {"taken": Below.__mro__[1]}


def test_mappings_are_sorted_by_name_when_a_component_is_built() -> None:
    failure = Failure(name="failure", values={"timeout": -1.0, "crash": -2.0, "distance": -3.0})
    assert list(normalise(failure).values) == ["crash", "distance", "timeout"]


def test_a_range_says_which_magnitudes_single_precision_can_compute_with() -> None:
    mass = Range(0.0, open_low=True, smallest=1e-3, largest=1e6)
    assert [mass.carries(value) for value in (0.0, 1e-4, 1e-3, -1e6, 2e6)] == [
        True,
        False,
        True,
        True,
        False,
    ]
    assert mass.magnitudes == "of a magnitude from 0.001 to 1e+06"
    assert Range(largest=10_000).magnitudes == "of a magnitude up to 10,000"
    assert Range(smallest=0.5).magnitudes == "of a magnitude from 0.5 on"
    assert Range().magnitudes == "that is finite"
    assert str(Range(largest=5.0)) == ""


@pytest.mark.parametrize(
    ("annotation", "value", "message"),
    [
        (
            Annotated[Any, Unit("m")],
            float("inf"),
            "^x: expected a number in m that is finite, found inf$",
        ),
        (
            Annotated[Any, Unit("m")],
            1e39,
            "^x: expected a number in m that is finite, found 1e[+]39$",
        ),
        (Annotated[Any, Unit("m", length=0)], [1.0, -1e39], "that is finite"),
        (
            Annotated[Any, Unit("m"), Range(largest=5.0)],
            -6,
            "^x: expected a number in m of a magnitude up to 5, found -6$",
        ),
        (
            Annotated[Any, Unit("m"), Range(0.0, smallest=2.0)],
            1,
            "in m ≥ 0 of a magnitude from 2 on, found 1$",
        ),
        (Annotated[Any, Unit("m"), Range(infinite=True)], 1e39, "that is finite, found 1e[+]39$"),
        (
            Annotated[Any, Unit("m", length=2), Range(infinite=True)],
            [np.inf, np.inf],
            "low < high where a bound is infinite",
        ),
        (
            Annotated[int, Range(1, largest=9)],
            10,
            "^x: expected a whole number ≥ 1 of a magnitude up to 9, found 10$",
        ),
        (Annotated[int, Range(1, largest=9)], 1e300, "found 1e[+]300$"),
        (Annotated[int, Range(1, largest=9)], 10**4000, "found a number of thousands of digits$"),
    ],
)
def test_a_number_that_single_precision_cannot_hold_is_refused(
    annotation: Any, value: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        to_value(value, field("x", annotation), "x")


def test_a_limit_may_be_infinite_where_its_range_says_so() -> None:
    clip = field("x", Annotated[Any, Unit("1", length=2), Range(largest=9.0, infinite=True)])
    assert to_value([-np.inf, 1], clip, "x").tolist() == [-np.inf, 1.0]
    with pytest.raises(ConfigError, match="of a magnitude up to 9"):
        to_value([-np.inf, 10], clip, "x")
