"""Regions: their signed distances, what carries and turns them, and regions on regions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.schema.component import normalise
from jaxsafe.simulation.cwh import SpacecraftState
from jaxsafe.simulation.dubins import Dubins3D
from jaxsafe.simulation.geometry import (
    angle_between,
    rotation,
    turn_between,
)
from jaxsafe.simulation.oriented import OrientedState
from jaxsafe.simulation.regions import (
    Aspect,
    BodyDisplacement,
    Box,
    Circle,
    Cone,
    Cylinder,
    Displacement,
    HalfSpace,
    Region,
    Sphere,
    Turned,
)

CARRIED: dict[str, Any] = {"name": "region", "on": "chief"}
SHAPES: dict[str, Region] = {
    name: normalise(shape)
    for name, shape in {
        "circle": Circle(radius=1.5, **CARRIED),
        "sphere": Sphere(radius=1.5, **CARRIED),
        "cylinder": Cylinder(radius=1.0, height=3.0, **CARRIED),
        "box2": Box(size=(2.0, 4.0), **CARRIED),
        "box3": Box(size=(2.0, 4.0, 1.0), **CARRIED),
        "half_plane": HalfSpace(towards=(1.0, 2.0), **CARRIED),
        "half_space": HalfSpace(towards=(0.0, 0.0, 5.0), **CARRIED),
        "cone2": Cone(towards=(3.0, 0.0), half_angle=0.5, **CARRIED),
        "cone3": Cone(towards=(1.0, 1.0, 0.0), half_angle=1.2, **CARRIED),
        "cone3_cut": Cone(towards=(0.0, 0.0, -2.0), half_angle=0.6, length=2.5, **CARRIED),
    }.items()
}
PLANAR = ("circle", "box2", "half_plane", "cone2")
EVERY_SHAPE = pytest.mark.parametrize("shape", SHAPES)


def points(shape: str, count: int = 400) -> jnp.ndarray:
    """Return points around a region, and its centre."""
    size = 2 if shape in PLANAR else 3
    drawn = jax.random.uniform(jax.random.key(0), (count, size), minval=-4.0, maxval=4.0)
    return jnp.concatenate([jnp.zeros((1, size)), drawn])


def distances(shape: str, offsets: jnp.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(SHAPES[shape].signed_distance)(offsets))


def craft(position: tuple[float, ...], angle: float = 0.0, rate: float = 0.0) -> OrientedState:
    """Return an oriented spacecraft that flies with (1, 0) m/s."""
    return OrientedState(
        position=jnp.asarray(position),
        velocity=jnp.asarray([1.0, 0.0]),
        delta_v=jnp.zeros(1),
        attitude=jnp.asarray(angle),
        attitude_rate=jnp.asarray(rate),
    )


def at(*position: float) -> SpacecraftState:
    zero = jnp.zeros(len(position))
    return SpacecraftState(jnp.asarray(position), zero, zero)


@EVERY_SHAPE
def test_the_sign_of_the_distance_says_what_is_inside(shape: str) -> None:
    offsets = points(shape)
    inside = np.asarray(jax.vmap(SHAPES[shape].contains)(offsets))
    np.testing.assert_array_equal(inside, distances(shape, offsets) <= 0.0)
    assert inside.any()
    assert not inside.all()


@EVERY_SHAPE
def test_the_distance_changes_by_no_more_than_the_point_moves(shape: str) -> None:
    offsets = points(shape)
    change = np.abs(np.diff(distances(shape, offsets)))
    moved = np.linalg.norm(np.diff(offsets, axis=0), axis=1)
    assert (change <= moved * (1.0 + 1e-5)).all()


@EVERY_SHAPE
def test_the_distance_and_its_gradient_are_finite_where_it_has_a_kink(shape: str) -> None:
    size = 2 if shape in PLANAR else 3
    corners = [jnp.zeros(size), jnp.ones(size), jnp.asarray([1.0, 2.0, 0.5][:size])]
    slope = jax.grad(SHAPES[shape].signed_distance)
    for offset in corners:
        gradient = np.asarray(slope(offset))
        assert np.isfinite(gradient).all()
        assert np.linalg.norm(gradient) <= 1.0 + 1e-5


@pytest.mark.parametrize(
    ("shape", "offset", "distance"),
    [
        ("circle", (0.0, 0.0), -1.5),
        ("circle", (3.0, 4.0), 3.5),
        ("cylinder", (0.0, 0.0, 0.0), -1.0),
        ("cylinder", (0.0, 0.9, 1.45), -0.05),
        ("cylinder", (4.0, 0.0, 5.5), 5.0),  # 3 beside and 4 above the edge
        ("box2", (0.0, 0.0), -1.0),
        ("box2", (4.0, 6.0), 5.0),
        ("box2", (0.0, -3.0), 1.0),
        ("box3", (0.0, 0.0, 0.4), -0.1),
        ("half_space", (7.0, -7.0, 2.0), -2.0),
        ("half_space", (7.0, -7.0, -2.0), 2.0),
        ("half_plane", (1.0, 2.0), -(5.0**0.5)),
        ("cone2", (-3.0, 0.0), 3.0),  # behind the tip
        ("cone2", (2.0, 0.0), -2.0 * np.sin(0.5)),
        ("cone2", (0.0, 2.0), 2.0 * np.cos(0.5)),
        ("cone3_cut", (0.0, 0.0, -2.4), -0.1),  # just before its end
        ("cone3_cut", (0.0, 0.0, -4.5), 2.0),
    ],
)
def test_distances_are_those_worked_out_by_hand(
    shape: str, offset: tuple[float, ...], distance: float
) -> None:
    found = float(SHAPES[shape].signed_distance(jnp.asarray(offset)))
    assert found == pytest.approx(distance, abs=1e-6)


@EVERY_SHAPE
def test_the_bounds_on_a_line_hold_at_every_point_of_it(shape: str) -> None:
    region = SHAPES[shape]
    before = points(shape, 60)
    after = before[::-1]
    shares = jnp.linspace(0.0, 1.0, 41)[:, None, None]
    way = before + shares * (after - before)
    true = np.asarray(jax.vmap(jax.vmap(region.signed_distance))(way))
    low = np.asarray(jax.vmap(region.nearest)(before, after))
    high = np.asarray(jax.vmap(region.farthest)(before, after))
    assert (low <= true.min(axis=0) + 1e-5).all()
    assert (high >= true.max(axis=0) - 1e-5).all()
    length = np.linalg.norm(after - before, axis=1)
    assert (low >= true.min(axis=0) - length / 16.0 - 1e-5).all()


def test_what_is_inside_turns_with_what_carries_the_region() -> None:
    fixed = normalise(Box(name="box", on="craft", size=(4.0, 1.0)))
    box = fixed.replace(turns=True)
    others = {"ahead": at(3.5, 2.0), "above": at(2.0, 3.5)}
    level = {"craft": craft((2.0, 2.0)), **others}
    upright = {"craft": craft((2.0, 2.0), angle=np.pi / 2), **others}
    names = {True: "ahead", False: "above"}
    for platforms, region, inside in (
        (level, box, names[True]),
        (upright, box, names[False]),
        (upright, fixed, names[True]),
    ):
        found = region.place(platforms).inside
        assert {name for name, flag in found.items() if flag} == {inside}


def test_an_offset_behind_an_aircraft_stays_level_while_it_climbs_and_banks() -> None:
    offset = normalise(Aspect(distance=500.0, angle=1.0))
    level = normalise(Dubins3D(name="lead")).rest().replace(heading=jnp.asarray(2.0))
    tilted = level.replace(flight_path_angle=jnp.asarray(0.3), roll=jnp.asarray(0.9))
    np.testing.assert_array_equal(offset.vector(tilted), offset.vector(level))
    assert float(offset.vector(level)[2]) == 0.0


@pytest.mark.parametrize("angle", [0.0, 1.0, -2.5])
def test_nothing_changes_when_the_carrier_and_all_around_it_turn(angle: float) -> None:
    offset = BodyDisplacement(by=(1.0, 0.5))
    turn = rotation(jnp.asarray(angle))
    for shape in PLANAR:
        region = SHAPES[shape].replace(offset=normalise(offset))
        region = region.replace(turns=True) if isinstance(region, Turned) else region
        state = region.place(
            {
                "chief": craft((0.0, 0.0), angle=angle),
                "deputy": at(*np.asarray(turn @ jnp.asarray([2.0, 1.5]))),
            },
            measures=True,
        )
        straight = float(region.signed_distance(jnp.asarray([1.0, 1.0])))
        assert float(state.distance["deputy"]) == pytest.approx(straight, abs=1e-5)
        assert float(state.depth["deputy"]) == -float(state.distance["deputy"])


def test_the_centre_of_a_region_moves_and_turns_with_its_carrier() -> None:
    platforms = {"craft": craft((5.0, 0.0), angle=np.pi / 2, rate=0.1)}
    carried = Circle(name="r", on="craft", radius=1.0, offset=BodyDisplacement(by=(3.0, 0.0)))
    state = normalise(carried).place(platforms, moves=True)
    np.testing.assert_allclose(state.position, [5.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(state.velocity, [1.0 - 0.3, 0.0], atol=1e-6)
    beside = carried.replace(offset=Displacement(by=(3.0, 0.0)))
    state = normalise(beside).place(platforms, moves=True)
    np.testing.assert_allclose(state.position, [8.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(state.velocity, [1.0, 0.0], atol=1e-6)


def test_the_velocity_of_a_centre_is_the_slope_of_its_path() -> None:
    carried = Circle(name="r", on="craft", radius=1.0, offset=BodyDisplacement(by=(3.0, -1.0)))
    region = normalise(carried)

    def centre(time: jax.Array) -> jax.Array:
        state = craft((0.0, 0.0), rate=0.2)
        moved = state.replace(
            position=state.position + time * state.velocity, attitude=0.4 + 0.2 * time
        )
        return region.place({"craft": moved}, moves=True).position

    state = craft((0.0, 0.0), angle=0.4, rate=0.2)
    expected = jax.jacfwd(centre)(jnp.asarray(0.0))
    found = region.place({"craft": state}, moves=True).velocity
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_a_region_may_stand_on_a_region_and_on_nothing() -> None:
    platforms = {"craft": craft((5.0, 0.0), angle=np.pi / 2), "other": at(5.0, 2.0)}
    outer = normalise(
        Box(
            name="outer",
            on="craft",
            size=(9.0, 9.0),
            offset=BodyDisplacement(by=(2.0, 0.0)),
            turns=True,
        )
    ).place(platforms, moves=True)
    inner = normalise(
        Circle(name="inner", on="outer", radius=1.0, offset=BodyDisplacement(by=(0.0, 4.0)))
    ).place(platforms, {"outer": outer}, moves=True)
    np.testing.assert_allclose(inner.position, [1.0, 2.0], atol=1e-5)
    zone = normalise(Circle(name="zone", on=None, radius=1.0, offset=Displacement(by=(5.0, 2.5))))
    state = zone.place(platforms, moves=True, measures=True)
    assert state.position.tolist() == [5.0, 2.5]
    assert state.velocity.tolist() == [0.0, 0.0]
    assert state.inside["other"]
    assert not state.inside["craft"]
    at_origin = normalise(Circle(name="zone", on=None, radius=1.0)).place(platforms)
    assert at_origin.position.tolist() == [0.0, 0.0]


def test_a_region_without_need_of_them_has_no_velocity_and_no_distances() -> None:
    state = SHAPES["circle"].place({"chief": at(0.0, 0.0), "deputy": at(1.0, 0.0)})
    assert len(jax.tree.leaves(state)) == 2
    assert state.velocity == ()
    assert state.distance == {}


def test_an_offset_that_turns_needs_a_carrier() -> None:
    class Env:
        agent_platform = type("Agent", (), {"dimension": 2})

    turned = normalise(
        Circle(name="r", on=None, radius=1.0, offset=Aspect(distance=1.0, angle=0.0))
    )
    assert "give `on`" in turned.misfits(Env)["offset"]
    assert not normalise(Circle(name="r", on=None, radius=1.0)).misfits(Env)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.7, np.pi / 2, 3.0, np.pi])
def test_angles_between_vectors_are_exact_and_have_finite_gradients(angle: float) -> None:
    first = jnp.asarray([2.0, 0.0, 0.0])
    second = 3.0 * jnp.asarray([np.cos(angle), np.sin(angle), 0.0])
    assert float(angle_between(first, second)) == pytest.approx(angle, abs=1e-6)
    assert np.isfinite(jax.grad(angle_between)(first, second)).all()
    turned = turn_between(rotation(jnp.asarray(0.3)), rotation(jnp.asarray(0.3 + angle)))
    assert float(turned) == pytest.approx(angle, abs=1e-3)


def test_a_vector_without_direction_has_the_angle_zero_and_a_finite_gradient() -> None:
    zero = jnp.zeros(2)
    other = jnp.asarray([1.0, 2.0])
    for pair in ((zero, other), (other, zero), (zero, zero)):
        assert float(angle_between(*pair)) == 0.0
        for argument in (0, 1):
            assert np.isfinite(jax.grad(angle_between, argument)(*pair)).all()
