"""Norms, directions, rotations and regions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsafe.schema.component import normalise
from jaxsafe.simulation.cwh import SpacecraftState
from jaxsafe.simulation.dubins import Dubins2DState, Dubins3DState
from jaxsafe.simulation.geometry import direction, mag_norm, rotation, safe_norm, to_body
from jaxsafe.simulation.regions import Aspect, Circle, Cylinder, Displacement, Sphere

ANGLES = st.floats(-10.0, 10.0)


def at(*position: float) -> SpacecraftState:
    """A spacecraft at rest at a position."""
    zero = jnp.zeros(len(position))
    return SpacecraftState(jnp.asarray(position), zero, zero)


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=3, max_size=3))
def test_the_safe_norm_is_the_euclidean_norm(vector: list[float]) -> None:
    expected = np.linalg.norm(np.asarray(vector))
    np.testing.assert_allclose(safe_norm(jnp.asarray(vector)), expected, rtol=1e-6, atol=1e-18)


def test_the_safe_norm_is_taken_along_the_last_axis() -> None:
    vectors = jnp.asarray([[3.0, 4.0], [0.0, 0.0], [-5.0, 12.0]])
    assert safe_norm(vectors).tolist() == [5.0, 0.0, 13.0]


@pytest.mark.thorough
def test_the_gradient_of_the_safe_norm_is_the_direction_and_zero_at_zero() -> None:
    gradient = jax.grad(safe_norm)
    np.testing.assert_allclose(gradient(jnp.asarray([3.0, 4.0])), [0.6, 0.8], rtol=1e-6)
    np.testing.assert_array_equal(gradient(jnp.zeros(2)), [0.0, 0.0])
    np.testing.assert_array_equal(jax.jacfwd(safe_norm)(jnp.zeros(3)), np.zeros(3))
    assert np.isfinite(jax.hessian(safe_norm)(jnp.zeros(2))).all()


@settings(deadline=None, max_examples=30)
@given(azimuth=ANGLES, polar=ANGLES)
def test_directions_are_unit_vectors(azimuth: float, polar: float) -> None:
    assert float(safe_norm(direction(jnp.asarray(azimuth)))) == pytest.approx(1.0, abs=1e-6)
    assert float(safe_norm(direction(jnp.asarray(azimuth), jnp.asarray(polar)))) == pytest.approx(
        1.0, abs=1e-6
    )


def test_azimuth_is_measured_from_x_and_polar_angle_from_z() -> None:
    quarter = jnp.pi / 2
    np.testing.assert_allclose(direction(jnp.asarray(0.0)), [1, 0], atol=1e-6)
    np.testing.assert_allclose(direction(jnp.asarray(quarter)), [0, 1], atol=1e-6)
    np.testing.assert_allclose(direction(jnp.asarray(0.3), jnp.asarray(0.0)), [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(
        direction(jnp.asarray(0.3), jnp.asarray(jnp.pi)), [0, 0, -1], atol=1e-6
    )
    np.testing.assert_allclose(
        direction(jnp.asarray(0.0), jnp.asarray(quarter)), [1, 0, 0], atol=1e-6
    )
    np.testing.assert_allclose(
        direction(jnp.asarray(quarter), jnp.asarray(quarter)), [0, 1, 0], atol=1e-6
    )


@pytest.mark.parametrize("kind", [Circle, Sphere])
def test_a_region_contains_its_boundary(kind: type[Sphere]) -> None:
    region = normalise(kind(name="region", on="chief", radius=0.5))
    assert region.contains(jnp.asarray([0.0, 0.0]))
    assert region.contains(jnp.asarray([0.5, 0.0]))
    assert region.contains(jnp.asarray([0.0, -0.5]))
    assert not region.contains(jnp.asarray([0.5000001, 0.0]))
    assert not region.contains(jnp.asarray([0.4, 0.4]))


def test_a_sphere_is_round_in_space() -> None:
    region = normalise(Sphere(name="region", on="chief", radius=1.0))
    assert region.contains(jnp.asarray([0.5, 0.5, 0.5]))
    assert not region.contains(jnp.asarray([0.6, 0.6, 0.6]))


def test_a_region_moves_with_its_platform_and_lists_the_others() -> None:
    region = normalise(Circle(name="region", on="chief", radius=1.0))
    placed = region.place({"chief": at(10.0, 5.0), "deputy": at(10.5, 5.5), "third": at(0.0, 0.0)})
    np.testing.assert_array_equal(placed.position, [10.0, 5.0])
    assert {name: bool(inside) for name, inside in placed.inside.items()} == {
        "deputy": True,
        "third": False,
    }


# Magnitude and direction


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-1e6, 1e6, width=32), min_size=2, max_size=3))
def test_mag_norm_is_the_magnitude_and_a_unit_vector_that_give_the_vector_back(
    vector: list[float],
) -> None:
    computed = mag_norm(jnp.asarray(vector))
    assert computed.shape == (len(vector) + 1,)
    assert float(computed[0]) == pytest.approx(np.linalg.norm(vector), rel=1e-6, abs=1e-18)
    np.testing.assert_allclose(computed[0] * computed[1:], vector, rtol=1e-5, atol=1e-18)
    assert float(safe_norm(computed[1:])) == pytest.approx(
        1.0 if float(computed[0]) > 0.0 else 0.0, abs=1e-6
    )


def test_mag_norm_is_all_zeros_at_zero_with_finite_derivatives() -> None:
    for size in (2, 3):
        np.testing.assert_array_equal(mag_norm(jnp.zeros(size)), np.zeros(size + 1))
        for jacobian in (jax.jit(jax.jacfwd(mag_norm)), jax.jit(jax.jacrev(mag_norm))):
            assert np.isfinite(jacobian(jnp.zeros(size))).all()
            np.testing.assert_array_equal(jacobian(jnp.zeros(size))[0], np.zeros(size))


@pytest.mark.usefixtures("x64")
def test_the_derivative_of_mag_norm_is_the_projection_across_the_vector() -> None:
    vector = np.array([3.0, -4.0, 12.0])
    along = vector / 13.0
    jacobian = jax.jacrev(mag_norm)(jnp.asarray(vector))
    np.testing.assert_allclose(jacobian[0], along, rtol=1e-14)
    np.testing.assert_allclose(
        jacobian[1:], (np.eye(3) - np.outer(along, along)) / 13.0, atol=1e-15
    )


# Rotations


@settings(deadline=None, max_examples=30)
@given(yaw=ANGLES, pitch=ANGLES, roll=ANGLES)
def test_rotations_are_orthogonal_and_keep_handedness(
    yaw: float, pitch: float, roll: float
) -> None:
    for matrix in (rotation(jnp.float32(yaw)), rotation(*map(jnp.float32, (yaw, pitch, roll)))):
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(len(matrix)), atol=2e-6)
        assert float(jnp.linalg.det(matrix)) == pytest.approx(1.0, abs=2e-6)


@settings(deadline=None, max_examples=30)
@given(yaw=ANGLES, pitch=ANGLES, roll=ANGLES)
def test_a_spatial_rotation_is_yaw_times_pitch_times_roll(
    yaw: float, pitch: float, roll: float
) -> None:
    def turn(angle: float, first: int, second: int) -> np.ndarray:
        matrix = np.eye(3)
        matrix[[first, second], [first, second]] = np.cos(angle)
        matrix[second, first] = np.sin(angle)
        matrix[first, second] = -np.sin(angle)
        return matrix

    expected = turn(yaw, 0, 1) @ turn(pitch, 2, 0) @ turn(roll, 1, 2)
    np.testing.assert_allclose(rotation(*map(jnp.float32, (yaw, pitch, roll))), expected, atol=2e-6)
    forward = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)]
    np.testing.assert_allclose(expected[:, 0], forward, atol=1e-12)


def test_a_planar_rotation_turns_x_into_the_heading_and_is_the_spatial_one_from_above() -> None:
    matrix = rotation(jnp.float32(0.3))
    np.testing.assert_allclose(
        matrix @ jnp.asarray([1.0, 0.0]), direction(jnp.float32(0.3)), atol=1e-7
    )
    np.testing.assert_allclose(rotation(jnp.float32(0.3), 0.0, 0.0)[:2, :2], matrix, atol=1e-7)


@settings(deadline=None, max_examples=30)
@given(yaw=ANGLES, pitch=ANGLES, roll=ANGLES)
def test_what_is_seen_from_a_body_turned_back_is_the_vector(
    yaw: float, pitch: float, roll: float
) -> None:
    matrix = rotation(*map(jnp.float32, (yaw, pitch, roll)))
    vector = jnp.asarray([3.0, -4.0, 12.0])
    seen = to_body(matrix, vector)
    np.testing.assert_allclose(seen, matrix.T @ vector, atol=1e-4)
    np.testing.assert_allclose(matrix @ seen, vector, atol=1e-4)


def test_what_lies_ahead_is_on_the_body_s_x_axis_and_what_lies_left_on_y() -> None:
    matrix = rotation(jnp.float32(jnp.pi / 2))
    np.testing.assert_allclose(to_body(matrix, jnp.asarray([0.0, 2.0])), [2.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(to_body(matrix, jnp.asarray([-2.0, 0.0])), [0.0, 2.0], atol=1e-6)


# Offsets and cylinders


def flying(x: float, y: float, heading: float) -> Dubins2DState:
    return Dubins2DState(jnp.asarray([x, y]), jnp.asarray(heading), jnp.asarray(300.0))


@pytest.mark.parametrize("heading", [0.0, 0.7, -3.0, 50.0])
def test_the_rejoin_point_is_behind_the_lead_at_its_aspect_angle_and_turns_with_it(
    heading: float,
) -> None:
    offset = normalise(Aspect(distance=500.0, angle=jnp.pi / 3)).vector(flying(1.0, 2.0, heading))
    bearing = heading + np.pi + np.pi / 3
    np.testing.assert_allclose(offset, [500 * np.cos(bearing), 500 * np.sin(bearing)], atol=0.01)
    seen = to_body(rotation(jnp.float32(heading)), offset)
    np.testing.assert_allclose(seen, [-250.0, -500 * np.sin(np.pi / 3)], atol=0.01)


def test_in_space_the_rejoin_point_stays_at_the_altitude_of_the_lead_however_it_climbs() -> None:
    lead = Dubins3DState(jnp.asarray([1.0, 2.0, 3.0]), *map(jnp.asarray, (0.7, 300.0, 0.3, -0.5)))
    aspect = normalise(Aspect(distance=500.0, angle=jnp.pi / 3))
    offset = aspect.vector(lead)
    np.testing.assert_allclose(offset[:2], aspect.vector(flying(0.0, 0.0, 0.7)), rtol=1e-6)
    assert offset.shape == (3,)
    assert offset[2] == 0.0


def test_a_displacement_is_the_same_whichever_way_the_platform_points() -> None:
    by = normalise(Displacement(by=(3.0, -4.0)))
    for heading in (0.0, 1.0):
        assert by.vector(flying(1.0, 2.0, heading)).tolist() == [3.0, -4.0]


def test_a_spacecraft_is_its_own_hill_frame_for_offsets() -> None:
    offset = normalise(Aspect(distance=2.0, angle=0.0)).vector(at(1.0, 1.0))
    np.testing.assert_allclose(offset, [-2.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(at(1.0, 1.0, 1.0).orientation, np.eye(3))


@pytest.mark.parametrize(
    ("offset", "centre"),
    [
        (None, [10.0, 20.0]),
        (Displacement(by=(3.0, -4.0)), [13.0, 16.0]),
        (Aspect(distance=5.0, angle=0.0), [10.0, 15.0]),
    ],
)
def test_a_region_is_placed_at_its_offset_from_its_platform(
    offset: Any, centre: list[float]
) -> None:
    region = normalise(Circle(name="region", on="lead", offset=offset, radius=1.0))
    platforms = {
        "lead": flying(10.0, 20.0, np.pi / 2),
        "there": flying(*centre, 0.0),
        "off": flying(*centre, 0.0),
    }
    platforms["off"] = platforms["off"].replace(
        position=platforms["off"].position + jnp.asarray([0.0, 1.01])
    )
    placed = region.place(platforms)
    np.testing.assert_allclose(placed.position, centre, atol=1e-5)
    assert {name: bool(inside) for name, inside in placed.inside.items()} == {
        "there": True,
        "off": False,
    }


@pytest.mark.parametrize(
    ("offset", "inside"),
    [
        ((0.0, 0.0, 0.0), True),
        ((100.0, 0.0, 0.0), True),
        ((100.01, 0.0, 0.0), False),
        ((0.0, -100.0, 150.0), True),
        ((0.0, 0.0, 150.01), False),
        ((0.0, 0.0, -150.0), True),
        ((0.0, 0.0, -150.01), False),
        ((60.0, 80.0, 100.0), True),
        ((80.0, 80.0, 0.0), False),
    ],
)
def test_a_cylinder_contains_its_boundary_and_half_its_height_to_each_side(
    offset: tuple, inside: bool
) -> None:
    cylinder = normalise(Cylinder(name="region", on="lead", radius=100.0, height=300.0))
    assert bool(cylinder.contains(jnp.asarray(offset))) == inside
