"""Clohessy-Wiltshire motion: the closed form and the laws of the orbit.

The closed form is compared with the matrix exponential.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, expm_frechet

from jaxsafe.schema.component import normalise
from jaxsafe.simulation.controllers import Actuator, Continuous
from jaxsafe.simulation.cwh import (
    MEAN_MOTION,
    Anchor,
    Spacecraft,
    SpacecraftState,
    cwh_acceleration,
    cwh_flow,
)

PERIOD = 2.0 * math.pi / MEAN_MOTION

flow = jax.jit(cwh_flow)
jacobians = jax.jit(jax.jacrev(cwh_flow, argnums=(0, 1, 2, 3, 4)))
acceleration = jax.jit(cwh_acceleration)


def random_vectors(seed: int, dimension: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw a position [m], a velocity [m/s] and a thrust acceleration [m/s²] as in docking."""
    rng = np.random.default_rng(seed)
    return tuple(rng.uniform(-size, size, dimension) for size in (150.0, 0.5, 1.0 / 12.0))


def system(n: float) -> np.ndarray:
    """Return M of d/dt [r, v, a] = M [r, v, a] in space, from Eqs. (12) and (16).

    The thrust acceleration a is constant.
    """
    M = np.zeros((9, 9))
    M[:3, 3:6] = np.eye(3)
    M[3:6, 6:] = np.eye(3)
    M[3, 0] = 3.0 * n**2
    M[3, 4] = 2.0 * n
    M[4, 3] = -2.0 * n
    M[5, 2] = -(n**2)
    return M


def exact_flow(r: np.ndarray, v: np.ndarray, a: np.ndarray, n: float, t: float) -> np.ndarray:
    """Return position and velocity after a time t, [2, 3], by the matrix exponential."""
    return (expm(system(n) * t) @ np.concatenate([r, v, a]))[:6].reshape(2, 3)


def exact_flow_by_mean_motion(
    r: np.ndarray, v: np.ndarray, a: np.ndarray, n: float, t: float
) -> np.ndarray:
    """Return the derivative of `exact_flow` by n.

    It is the Fréchet derivative of the matrix exponential along dM/dn.
    """
    along = system(n + 0.5) - system(n - 0.5)  # M is quadratic in n, so this is dM/dn exactly
    derivative = expm_frechet(system(n) * t, along * t, compute_expm=False)
    return (derivative @ np.concatenate([r, v, a]))[:6].reshape(2, 3)


def assert_close(computed: jax.Array, expected: np.ndarray, tolerance: float) -> None:
    """Compare two arrays relative to the largest element."""
    scale = max(1.0, float(np.max(np.abs(expected))))
    np.testing.assert_allclose(computed, expected, rtol=0.0, atol=tolerance * scale)


@pytest.mark.parametrize("n", [0.0, 1e-9, 1e-5, MEAN_MOTION, 0.01])
@pytest.mark.parametrize("t", [1e-3, 0.1, 1.0, 10.0, 100.0, 1000.0, PERIOD])
@pytest.mark.usefixtures("x64")
def test_the_closed_form_is_the_matrix_exponential(n: float, t: float) -> None:
    r, v, a = random_vectors(seed=1)
    for computed, expected in zip(flow(r, v, a, n, t), exact_flow(r, v, a, n, t), strict=True):
        assert_close(computed, expected, 1e-11)


@pytest.mark.parametrize("tau", [0.9, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 1.1, -1.0, 3.0, 50.0])
@pytest.mark.usefixtures("x64")
def test_the_closed_form_is_smooth_where_the_series_ends(tau: float) -> None:
    r, v, a = random_vectors(seed=2)
    t = tau / MEAN_MOTION
    for computed, expected in zip(
        flow(r, v, a, MEAN_MOTION, t), exact_flow(r, v, a, MEAN_MOTION, t), strict=True
    ):
        assert_close(computed, expected, 1e-11)


@pytest.mark.parametrize("t", [1.0, 10.0, 100.0, 1000.0])
def test_in_float32_the_error_is_at_most_five_parts_in_ten_million(t: float) -> None:
    for seed in range(20):
        r, v, a = random_vectors(seed)
        for computed, expected in zip(
            flow(r, v, a, MEAN_MOTION, t), exact_flow(r, v, a, MEAN_MOTION, t), strict=True
        ):
            assert computed.dtype == jnp.float32
            assert_close(computed, expected, 5e-7)


@pytest.mark.usefixtures("x64")
def test_without_an_orbit_it_is_the_double_integrator() -> None:
    r, v, a = random_vectors(seed=3)
    for t in (0.0, 1.0, 7.0, 1000.0):
        position, velocity = flow(r, v, a, 0.0, t)
        np.testing.assert_allclose(position, r + v * t + a * t**2 / 2.0, rtol=1e-14)
        np.testing.assert_allclose(velocity, v + a * t, rtol=1e-14)
    np.testing.assert_array_equal(acceleration(r, v, a, 0.0), a)


@pytest.mark.usefixtures("x64")
def test_an_orbit_without_drift_closes_after_one_period() -> None:
    r, v, _ = random_vectors(seed=4)
    v[1] = -2.0 * MEAN_MOTION * r[0]
    half, whole = (flow(r, v, np.zeros(3), MEAN_MOTION, share * PERIOD) for share in (0.5, 1.0))
    assert np.linalg.norm(half[0] - r) > 10.0
    np.testing.assert_allclose(whole[0], r, atol=1e-9)
    np.testing.assert_allclose(whole[1], v, atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_an_orbit_with_drift_moves_along_the_track_by_its_secular_term() -> None:
    r, v, _ = random_vectors(seed=4)
    position, velocity = flow(r, v, np.zeros(3), MEAN_MOTION, PERIOD)
    drift = -(6.0 * MEAN_MOTION * r[0] + 3.0 * v[1]) * PERIOD
    np.testing.assert_allclose(position - r, [0.0, drift, 0.0], atol=1e-8)
    np.testing.assert_allclose(velocity, v, atol=1e-11)


def test_the_origin_is_an_equilibrium() -> None:
    zero = jnp.zeros(3)
    np.testing.assert_array_equal(flow(zero, zero, zero, MEAN_MOTION, 1000.0), np.zeros((2, 3)))


@pytest.mark.parametrize("t", [1.0, 1500.0])
@pytest.mark.usefixtures("x64")
def test_planar_motion_is_spatial_motion_with_z_zero(t: float) -> None:
    vectors = [np.append(vector, 0.0) for vector in random_vectors(seed=5, dimension=2)]
    planar = flow(*(vector[:2] for vector in vectors), MEAN_MOTION, t)
    spatial = flow(*vectors, MEAN_MOTION, t)
    for two, three in zip(planar, spatial, strict=True):
        np.testing.assert_allclose(two, three[:2], rtol=1e-14)
        assert three[2] == 0.0
    plane = acceleration(*(vector[:2] for vector in vectors), MEAN_MOTION)
    space = acceleration(*vectors, MEAN_MOTION)
    np.testing.assert_allclose(plane, space[:2], rtol=1e-14)
    assert space[2] == 0.0


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    first=st.floats(0.0, 2000.0),
    second=st.floats(0.0, 2000.0),
    n=st.sampled_from([0.0, 1e-6, MEAN_MOTION, 0.01]),
)
def test_two_flows_in_a_row_are_one(seed: int, first: float, second: float, n: float) -> None:
    with jax.enable_x64(True):
        r, v, a = random_vectors(seed)
        in_two = flow(*flow(r, v, a, n, first), a, n, second)
        at_once = flow(r, v, a, n, first + second)
        for computed, expected in zip(in_two, at_once, strict=True):
            assert_close(computed, np.asarray(expected), 1e-10)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    t=st.floats(0.0, 2000.0),
    n=st.sampled_from([0.0, MEAN_MOTION, 0.01]),
)
def test_the_rate_of_the_flow_is_velocity_and_acceleration(seed: int, t: float, n: float) -> None:
    with jax.enable_x64(True):
        r, v, a = random_vectors(seed)
        (position, velocity), rates = jax.jvp(lambda t: flow(r, v, a, n, t), (t,), (1.0,))
        assert_close(rates[0], np.asarray(velocity), 1e-9)
        assert_close(rates[1], np.asarray(acceleration(position, velocity, a, n)), 1e-9)


@pytest.mark.usefixtures("x64")
def test_the_flow_is_linear_in_state_and_thrust() -> None:
    first = random_vectors(seed=6)
    second = random_vectors(seed=7)
    both = [2.0 * x - 3.0 * y for x, y in zip(first, second, strict=True)]
    expected = 2.0 * np.stack(flow(*first, MEAN_MOTION, 50.0)) - 3.0 * np.stack(
        flow(*second, MEAN_MOTION, 50.0)
    )
    np.testing.assert_allclose(np.stack(flow(*both, MEAN_MOTION, 50.0)), expected, atol=1e-11)


@pytest.mark.parametrize("n", [0.0, 1e-30, MEAN_MOTION, 1.0, 1.5])
@pytest.mark.parametrize("size", [0.0, 1.0])
def test_all_derivatives_are_finite(n: float, size: float) -> None:
    r, v, a = (size * vector for vector in random_vectors(seed=8))
    for t in (0.0, 1.0):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jacobians(r, v, a, n, t)))


@pytest.mark.parametrize(
    ("n", "t"), [(0.0, 1.0), (1e-6, 1.0), (MEAN_MOTION, 1.0), (MEAN_MOTION, 1000.0), (0.1, 30.0)]
)
@pytest.mark.usefixtures("x64")
def test_the_derivative_by_mean_motion_is_that_of_the_matrix_exponential(
    n: float, t: float
) -> None:
    vectors = random_vectors(seed=9)
    computed = np.stack([jacobian[3] for jacobian in jacobians(*vectors, n, t)])
    assert_close(computed, exact_flow_by_mean_motion(*vectors, n, t), 1e-9)


@pytest.mark.parametrize("t", [1.0, 1000.0])
def test_in_float32_the_derivative_by_mean_motion_has_six_digits(t: float) -> None:
    vectors = random_vectors(seed=9)
    computed = np.stack([jacobian[3] for jacobian in jacobians(*vectors, MEAN_MOTION, t)])
    assert_close(computed, exact_flow_by_mean_motion(*vectors, MEAN_MOTION, t), 1e-6)


def test_a_spacecraft_feels_thrust_over_mass_and_remembers_its_delta_v() -> None:
    actuators = tuple(Actuator(name=f"thrust_{axis}", low=-1.0, high=1.0) for axis in "xyz")
    craft = normalise(
        Spacecraft(
            name="deputy",
            dimension=3,
            controller=Continuous(actuators=actuators),
            mass=2.0,
            mean_motion=0.0,
        )
    )
    assert craft.inputs == ("thrust_x", "thrust_y", "thrust_z")
    controls = {
        "thrust_z": jnp.float32(6.0),
        "thrust_x": jnp.float32(2.0),
        "thrust_y": jnp.float32(4.0),
    }
    state = craft.step(craft.rest(), controls, 0.5)
    np.testing.assert_allclose(state.velocity, [0.5, 1.0, 1.5])
    np.testing.assert_allclose(state.position, [0.125, 0.25, 0.375])
    np.testing.assert_allclose(state.delta_v, [0.5, 1.0, 1.5])


def test_an_anchor_stays_where_it_is() -> None:
    chief = normalise(Anchor(name="chief", dimension=2))
    assert chief.inputs == ()
    state = SpacecraftState(jnp.ones(2), jnp.zeros(2), jnp.zeros(2))
    assert chief.step(state, {}, 1.0) is state
    assert all(leaf.tolist() == [0.0, 0.0] for leaf in jax.tree.leaves(chief.rest()))
