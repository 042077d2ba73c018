"""Dotted paths into components: what they reach, what they pick, and messages where they fail."""

from collections.abc import Mapping
from typing import Any, ClassVar

import pytest

from jaxsafe.schema.component import Component, Field
from jaxsafe.schema.dotted_paths import join, set_path
from jaxsafe.schema.errors import ConfigError
from jaxsafe.types import Length


class Wheel(Component):
    """A part with a number."""

    name: str
    radius: Length = 1.0


class Engine(Component):
    """A part with parts. None of them is a shorthand."""

    name: str = "engine"
    power: Length = 2.0
    wheels: tuple[Wheel, ...] = ()


class Car(Component):
    """A component with every kind of field that a path may walk through."""

    shorthand: ClassVar[str | None] = "wheels"

    name: str = "car"
    length: Length = 3.0
    engine: Engine = Engine()
    spare: Wheel | None = None
    wheels: tuple[Wheel, ...]
    words: tuple[str, ...] = ("a", "b")
    table: Mapping[str, Length]


@pytest.fixture
def car() -> Car:
    wheels = (Wheel(name="left"), Wheel(name="right", radius=5.0))
    return Car(engine=Engine(wheels=wheels), wheels=wheels, table={"x": 1.0, "y": 2.0})


@pytest.mark.parametrize(
    ("path", "read"),
    [
        ("length", lambda car: car.length),
        ("engine.power", lambda car: car.engine.power),
        ("wheels.right.radius", lambda car: car.wheels[1].radius),
        ("right.radius", lambda car: car.wheels[1].radius),
        ("engine.wheels.left.radius", lambda car: car.engine.wheels[0].radius),
        ("table.y", lambda car: car.table["y"]),
        ("spare", lambda car: car.spare),
    ],
)
def test_a_path_replaces_one_value_and_nothing_else(car: Car, path: str, read: Any) -> None:
    before = read(car)
    changed = set_path(car, path, 7.0)
    assert read(changed) == 7.0
    assert read(car) == before
    assert set_path(changed, path, before) == car
    assert type(changed) is Car


def test_a_field_goes_before_a_part_of_the_same_name(car: Car) -> None:
    shadowed = car.replace(wheels=(Wheel(name="engine"), *car.wheels))
    changed = set_path(shadowed, "engine.power", 7.0)
    assert changed.engine.power == 7.0
    assert changed.wheels[0] == shadowed.wheels[0]
    assert set_path(shadowed, "wheels.engine.radius", 7.0).wheels[0].radius == 7.0


def test_the_shorthand_stands_at_the_start_of_a_path_only(car: Car) -> None:
    class Garage(Component):
        car: Car

    with pytest.raises(ConfigError, match=r"^car\.left: unknown field 'left'"):
        set_path(Garage(car=car), "car.left.radius", 7.0)
    assert set_path(Garage(car=car), "car.wheels.left.radius", 7.0).car.wheels[0].radius == 7.0


@pytest.mark.parametrize("names", [["right"], ["right", "left"], ("left", "right"), ["left"]])
def test_a_list_of_names_picks_parts_in_the_new_order(car: Car, names: Any) -> None:
    picked = set_path(car, "wheels", names).wheels
    assert [wheel.name for wheel in picked] == list(names)
    assert all(wheel in car.wheels for wheel in picked)
    deep = set_path(car, "engine.wheels", names)
    assert deep.engine.wheels == picked
    assert deep.wheels == car.wheels


def test_a_list_of_words_where_no_parts_have_names_is_a_value(car: Car) -> None:
    assert set_path(car, "words", ("c",)).words == ("c",)
    assert set_path(car.replace(wheels=()), "wheels", ["left"]).wheels == ["left"]
    assert set_path(car, "wheels", []).wheels == []


def test_picked_parts_pass_no_conversion_and_other_values_do(car: Car) -> None:
    seen: list[tuple[Any, str, str]] = []

    def convert(value: Any, field: Field, place: str) -> Any:
        seen.append((value, field.name, place))
        return value

    set_path(car, "wheels", ["left"], convert)
    assert seen == []
    set_path(car, "right.radius", 7.0, convert)
    set_path(car, "table.x", 8.0, convert)
    assert seen == [(7.0, "radius", "right.radius"), ({"x": 8.0, "y": 2.0}, "table", "table")]


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (
            "lenth",
            1,
            (
                r"^lenth: unknown field 'lenth'\. Did you mean 'length'\? Choose from name, .*,"
                r" left, right$"
            ),
        ),
        ("rigt.radius", 1, r"^rigt: unknown field 'rigt'\. Did you mean 'right'\? Choose from"),
        (
            "wheels.rigt.radius",
            1,
            (
                r"^wheels\.rigt: unknown name 'rigt'\. Did you mean 'right'\? Choose from left,"
                r" right$"
            ),
        ),
        (
            "right.radus",
            1,
            (
                r"^right\.radus: unknown field 'radus'\. Did you mean 'radius'\? Choose from name,"
                r" radius$"
            ),
        ),
        ("power", 1, r"^power: unknown field 'power'\. Did you mean 'engine\.power'\? Choose from"),
        ("radius", 1, r"^radius: unknown field 'radius'\. Did you mean 'left\.radius'\? Choose "),
        ("powr", 1, r"^powr: unknown field 'powr'\. Did you mean 'engine\.power'\? Choose from"),
        ("engine.wheels.left.radus", 1, r"^engine\.wheels\.left\.radus: unknown field 'radus'"),
        ("wheels.left", 1, r"^wheels\.left: name one of its fields: name, radius$"),
        ("left", 1, r"^left: name one of its fields: name, radius$"),
        (
            "wheels",
            ["left", "rigt"],
            r"^wheels\.rigt: unknown name 'rigt'\. Did you mean 'right'\? Choose from",
        ),
        ("engine.wheels", ["x"], r"^engine\.wheels\.x: unknown name 'x'; choose from left, right$"),
        ("table.z", 1, r"^table: unknown name 'z'; choose from x, y$"),
        ("table.x.y", 1, r"^table\.x: table has no fields$"),
        ("length.x", 1, r"^length\.x: length has no fields$"),
        ("spare.radius", 1, r"^spare\.radius: spare has no fields because it is not set$"),
        ("words.c", 1, r"^words\.c: unknown name 'c'; choose from 0, 1$"),
        ("", 1, r"^: unknown field ''|^unknown field ''"),
        ("wheels.", 1, r"^wheels: unknown name ''"),
    ],
)
def test_a_path_that_leads_nowhere_is_told_in_one_line(
    car: Car, path: str, value: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        set_path(car, path, value)
    assert "\n" not in str(caught.value)


def test_the_place_of_an_error_may_begin_with_more_than_the_path(car: Car) -> None:
    with pytest.raises(ConfigError, match=r"^the\.power: .* Did you mean 'the\.engine\.power'"):
        set_path(car, "power", 1, place="the")
    with pytest.raises(ConfigError, match=r"^the\.rigt: .* Did you mean 'right'"):
        set_path(car, "rigt.radius", 1, place="the")
    assert set_path(car, "left.radius", 7.0, place="the").wheels[0].radius == 7.0


def test_a_text_with_commas_is_a_list_where_a_list_is(car: Car) -> None:
    assert set_path(car, "words", "c,d").words == ["c", "d"]
    wheels = set_path(car, "wheels", "right,left").wheels
    assert [wheel.name for wheel in wheels] == ["right", "left"]
    assert set_path(car, "length", "1,2").length == "1,2"


def test_names_are_joined_with_dots_and_without_where_one_is_empty() -> None:
    assert join("a", "b") == "a.b"
    assert join("", "b") == "b"
    assert join("a", "") == "a"
