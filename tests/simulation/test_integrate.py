"""Ratios of sines, ramps that rest at a limit, and Gauss-Legendre quadrature.

They are compared with scipy and with exact fractions.
"""

import math
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsafe.simulation.integrate import (
    NODES,
    PARTIAL_WEIGHTS,
    WEIGHTS,
    ramp,
    runge_kutta,
    sine_ratios,
    through_pieces,
    time_to_limit,
)

LIMITS = np.array([200.0, 400.0])
EDGES = [
    0.0,
    1e-300,
    1e-12,
    1e-6,
    1e-3,
    0.1,
    0.5,
    1.0 - 1e-12,
    1.0,
    1.0 + 1e-12,
    1.5,
    2.0,
    2.0 + 1e-12,
    3.0,
    10.0,
    100.0,
]


def series(tau: float, first: int) -> float:
    """Return Σ (−1)ᵏ τ²ᵏ/(2k + first)! in exact fractions.

    For first = 1, 2, 3 it is sin τ/τ, (1 − cos τ)/τ² and (τ − sin τ)/τ³.
    """
    term = Fraction(1, math.factorial(first))
    total = term
    square = Fraction(tau) ** 2
    for k in range(1, 400):
        term *= -square / ((2 * k + first - 1) * (2 * k + first))
        total += term
        if abs(term) < Fraction(1, 10**30):
            return float(total)
    raise AssertionError("the series has not converged")


@pytest.mark.parametrize("tau", [tau for tau in EDGES if tau <= 10.0])
@pytest.mark.usefixtures("x64")
def test_the_ratios_of_sines_are_their_series(tau: float) -> None:
    for sign in (1.0, -1.0):
        for computed, first in zip(sine_ratios(jnp.float64(sign * tau)), (1, 2, 3), strict=True):
            np.testing.assert_allclose(computed, series(tau, first), rtol=1e-14, atol=1e-16)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_the_derivatives_of_the_ratios_satisfy_their_recurrence() -> None:
    """Each ratio c_k obeys τ c_k′ = c_(k−1) − k c_k, with c₀ = cos τ."""
    taus = jnp.asarray([*EDGES, *(-edge for edge in EDGES)])
    values = jax.vmap(sine_ratios)(taus)
    first, second = (
        jax.jit(jax.vmap(rate))(taus)
        for rate in (jax.jacfwd(sine_ratios), jax.hessian(sine_ratios))
    )
    for k, before in enumerate([jnp.cos(taus), *values[:2]]):
        np.testing.assert_allclose(
            taus * first[k], before - (k + 1) * values[k], rtol=0.0, atol=1e-14
        )
        assert np.isfinite(second[k]).all()


def test_in_float32_the_ratios_keep_six_digits_near_zero_and_beyond() -> None:
    for tau in (0.0, 1e-20, 1e-6, 1e-3, 0.03, 0.99, 1.01, 3.0):
        for computed, first in zip(sine_ratios(jnp.float32(tau)), (1, 2, 3), strict=True):
            assert computed.dtype == jnp.float32
            np.testing.assert_allclose(
                computed, series(float(np.float32(tau)), first), rtol=1e-6, atol=1e-7
            )


def test_a_ramp_moves_until_it_rests_on_a_limit() -> None:
    times = jnp.linspace(0.0, 4.0, 9)
    np.testing.assert_allclose(
        ramp(300.0, 50.0, LIMITS, times), [300, 325, 350, 375, 400, 400, 400, 400, 400]
    )
    np.testing.assert_allclose(
        ramp(300.0, -50.0, LIMITS, times), [300, 275, 250, 225, 200, 200, 200, 200, 200]
    )
    np.testing.assert_allclose(ramp(300.0, 0.0, LIMITS, times), np.full(9, 300.0))


@pytest.mark.parametrize(
    ("x", "rate", "time"),
    [
        (300.0, 50.0, 2.0),
        (300.0, -50.0, 2.0),
        (300.0, 0.0, 4.0),
        (300.0, 1e-30, 4.0),
        (300.0, 25.0, 4.0),
        (300.0, 24.9, 4.0),
        (400.0, 1.0, 0.0),
        (400.0, -100.0, 2.0),
        (200.0, -1.0, 0.0),
        (400.0, 0.0, 4.0),
        (200.0, 0.0, 4.0),
    ],
)
def test_the_time_to_a_limit_is_that_of_the_state_s_rest(
    x: float, rate: float, time: float
) -> None:
    assert float(time_to_limit(x, rate, LIMITS, 4.0)) == time


@settings(deadline=None, max_examples=200)
@given(
    x=st.floats(200.0, 400.0, width=32),
    rate=st.floats(-1000.0, 1000.0, width=32),
    dt=st.sampled_from([0.01, 1.0, 30.0]),
)
def test_the_time_to_a_limit_is_within_the_step_and_the_ramp_is_straight_until_then(
    x: float, rate: float, dt: float
) -> None:
    time = float(time_to_limit(x, rate, LIMITS, dt))
    assert 0.0 <= time <= np.float32(dt)
    end = float(ramp(x, rate, LIMITS, dt))
    assert 200.0 <= end <= 400.0
    assert x + rate * time == pytest.approx(end, rel=1e-5)


def test_a_time_to_a_limit_has_no_derivative() -> None:
    for x, rate in ((300.0, 50.0), (300.0, 0.0), (400.0, 0.0), (400.0, 1.0), (200.0, -1e-38)):
        gradients = jax.grad(time_to_limit, argnums=(0, 1, 3))(x, rate, LIMITS, 4.0)
        assert [float(gradient) for gradient in gradients] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("stops", "dt", "expected"),
    [
        ([0.75, 0.25, 1.0], 1.0, [(0.0, 0.25), (0.25, 0.5), (0.75, 0.25), (1.0, 0.0)]),
        ([2.0, 0.0], 2.0, [(0.0, 0.0), (0.0, 2.0), (2.0, 0.0)]),
        ([], 0.5, [(0.0, 0.5)]),
    ],
)
def test_pieces_partition_the_step_in_order(
    stops: list[float], dt: float, expected: list[tuple[float, float]]
) -> None:
    def fly(before: tuple[Any, Any], begin: Any, length: Any) -> tuple[Any, Any]:
        count, flown = before
        return count + 1, flown.at[count].set(jnp.stack([begin, length]))

    start = (0, jnp.zeros((len(expected), 2)))
    count, flown = through_pieces(fly, start, [jnp.float32(t) for t in stops], jnp.float32(dt))
    assert count == len(expected)
    np.testing.assert_array_equal(flown, expected)


@pytest.mark.parametrize("degree", range(6))
def test_three_nodes_integrate_polynomials_of_degree_five(degree: int) -> None:
    assert np.dot(WEIGHTS, np.array(NODES) ** degree) == pytest.approx(
        1.0 / (degree + 1), abs=1e-15
    )
    assert np.dot(WEIGHTS, np.array(NODES) ** 6) != pytest.approx(1.0 / 7.0, abs=1e-6)


@pytest.mark.parametrize("degree", range(3))
def test_partial_weights_integrate_quadratics_up_to_each_node(degree: int) -> None:
    nodes = np.array(NODES)
    np.testing.assert_allclose(
        np.array(PARTIAL_WEIGHTS) @ nodes**degree, nodes ** (degree + 1) / (degree + 1), atol=1e-15
    )


@pytest.mark.parametrize("substeps", [1, 8])
def test_runge_kutta_steps_of_any_tree_are_of_order_four(substeps: int) -> None:
    def derivative(state: dict[str, jax.Array]) -> dict[str, jax.Array]:
        return {"place": state["speed"], "speed": -state["place"]}

    start = {"place": jnp.array([1.0, 0.0]), "speed": jnp.array([0.0, 1.0])}
    moved = runge_kutta(derivative, start, 0.8, substeps)
    error = 0.8**5 / 120 / substeps**4 + 1e-6
    cosine, sine = math.cos(0.8), math.sin(0.8)
    np.testing.assert_allclose(moved["place"], [cosine, sine], atol=error)
    np.testing.assert_allclose(moved["speed"], [-sine, cosine], atol=error)
