"""Norms, directions and regions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsafe.component import normalise
from jaxsafe.simulation.cwh import SpacecraftState
from jaxsafe.simulation.geometry import Circle, Sphere, direction, safe_norm

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
    assert float(safe_norm(direction(jnp.asarray(azimuth), jnp.asarray(polar)))) == pytest.approx(1.0, abs=1e-6)


def test_azimuth_is_measured_from_x_and_polar_angle_from_z() -> None:
    quarter = jnp.pi / 2
    np.testing.assert_allclose(direction(jnp.asarray(0.0)), [1, 0], atol=1e-6)
    np.testing.assert_allclose(direction(jnp.asarray(quarter)), [0, 1], atol=1e-6)
    np.testing.assert_allclose(direction(jnp.asarray(0.3), jnp.asarray(0.0)), [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(direction(jnp.asarray(0.3), jnp.asarray(jnp.pi)), [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(direction(jnp.asarray(0.0), jnp.asarray(quarter)), [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(direction(jnp.asarray(quarter), jnp.asarray(quarter)), [0, 1, 0], atol=1e-6)


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
    assert {name: bool(inside) for name, inside in placed.inside.items()} == {"deputy": True, "third": False}
