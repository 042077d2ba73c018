"""Sine and cosine: accuracy, range and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.simulation.trig import arctan, cos_acute, sin_cos, sin_cos_acute, tan_acute, wrap


@pytest.mark.parametrize("span", [1.0, 10.0, 200.0, 1e4])
def test_values_are_within_two_bits_of_the_exact_ones(span: float) -> None:
    x = np.random.default_rng(0).uniform(-span, span, 200_000).astype(np.float32)
    sine, cosine = jax.jit(sin_cos)(x)
    assert sine.dtype == cosine.dtype == jnp.float32
    assert np.abs(np.asarray(sine, float) - np.sin(x.astype(float))).max() < 1.2e-7
    assert np.abs(np.asarray(cosine, float) - np.cos(x.astype(float))).max() < 1.2e-7


def test_values_at_multiples_of_a_quarter_turn_have_the_right_sign() -> None:
    x = np.arange(-20, 21, dtype=np.float32) * np.float32(np.pi / 2)
    sine, cosine = sin_cos(x)
    np.testing.assert_allclose(sine, np.sin(x.astype(float)), atol=1e-7)
    np.testing.assert_allclose(cosine, np.cos(x.astype(float)), atol=1e-7)
    zero = sin_cos(jnp.float32(0.0))
    assert (float(zero[0]), float(zero[1])) == (0.0, 1.0)


def test_values_stay_bounded_for_any_angle_and_nan_stays_nan() -> None:
    sine, cosine = sin_cos(np.array([1e5, 1e8, -1e20, 3e38], np.float32))
    assert np.abs(np.stack([sine, cosine])).max() <= 1.0 + 1e-6
    assert np.isnan(np.stack(sin_cos(jnp.float32(np.nan)))).all()


@pytest.mark.usefixtures("x64")
def test_double_precision_is_jax_s_own() -> None:
    x = np.linspace(-100.0, 100.0, 1001)
    np.testing.assert_array_equal(sin_cos(x)[0], jnp.sin(x))
    np.testing.assert_array_equal(sin_cos(x)[1], jnp.cos(x))


def test_derivatives_are_cosine_and_minus_sine() -> None:
    x = jnp.linspace(-9.0, 9.0, 401)
    np.testing.assert_allclose(jax.vmap(jax.grad(lambda t: sin_cos(t)[0]))(x), np.cos(x), atol=2e-7)
    np.testing.assert_allclose(
        jax.vmap(jax.grad(lambda t: sin_cos(t)[1]))(x), -np.sin(x), atol=2e-7
    )
    second = jax.vmap(jax.grad(jax.grad(lambda t: sin_cos(t)[0])))(x)
    np.testing.assert_allclose(second, -np.sin(x), atol=2e-7)


def test_acute_angles_need_no_reduction() -> None:
    x = np.linspace(-np.pi / 2, np.pi / 2, 200_001, dtype=np.float32)
    sine, cosine = jax.jit(sin_cos_acute)(x)
    assert sine.dtype == cosine.dtype == jnp.float32
    assert np.abs(np.asarray(sine, float) - np.sin(x.astype(float))).max() < 1.2e-7
    assert np.abs(np.asarray(cosine, float) - np.cos(x.astype(float))).max() < 1.2e-7
    np.testing.assert_array_equal(cos_acute(x), cosine)
    exact = np.tan(x.astype(float))
    inside = np.abs(x) < 1.57
    error = np.abs(np.asarray(tan_acute(x), float) - exact)[inside]
    assert np.all(error <= 4e-7 / np.cos(x[inside].astype(float)) * np.abs(exact[inside]))
    zero = sin_cos_acute(jnp.float32(0.0))
    assert (float(zero[0]), float(zero[1])) == (0.0, 1.0)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(
            jax.vmap(derivative(lambda t: sin_cos_acute(t)[0]))(x[::500]),
            np.cos(x[::500]),
            atol=2e-7,
        )
        np.testing.assert_allclose(
            jax.vmap(derivative(lambda t: sin_cos_acute(t)[1]))(x[::500]),
            -np.sin(x[::500]),
            atol=2e-7,
        )


@pytest.mark.usefixtures("x64")
def test_acute_angles_in_double_precision_are_jax_s_own() -> None:
    x = np.linspace(-1.5, 1.5, 1001)
    np.testing.assert_array_equal(sin_cos_acute(x)[0], jnp.sin(x))
    np.testing.assert_array_equal(sin_cos_acute(x)[1], jnp.cos(x))


def test_the_tangent_is_sine_over_cosine() -> None:
    x = np.linspace(-1.05, 1.05, 2001, dtype=np.float32)
    sine, cosine = sin_cos_acute(x)
    np.testing.assert_allclose(sine / cosine, np.tan(x.astype(float)), rtol=3e-7)


@pytest.mark.thorough
def test_the_arctangent_is_within_two_bits_everywhere() -> None:
    spread = [
        np.linspace(-3.0, 3.0, 100_001),
        np.geomspace(1e-8, 1e8, 10_001),
        [0.0, np.inf, -np.inf],
    ]
    x = np.concatenate(spread).astype(np.float32)
    np.testing.assert_allclose(jax.jit(arctan)(x), np.arctan(x.astype(float)), atol=2e-7, rtol=3e-7)
    assert np.isnan(arctan(jnp.float32(np.nan)))
    slopes = jax.vmap(jax.grad(arctan))(x)
    np.testing.assert_allclose(slopes, 1.0 / (1.0 + x.astype(float) ** 2), atol=2e-7)


@pytest.mark.parametrize(
    ("low", "period"), [(-np.pi, 2 * np.pi), (-np.pi / 2, np.pi), (-0.2, 2 * np.pi)]
)
def test_a_wrapped_angle_is_in_its_range_and_differs_by_whole_periods(
    low: float, period: float
) -> None:
    x = np.random.default_rng(0).uniform(-50.0, 50.0, 10_000).astype(np.float32)
    computed = np.asarray(wrap(x, low, period), float)
    assert (computed >= low - 1e-5).all()
    assert (computed < low + period + 1e-5).all()
    turns = (x - computed) / period
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)
    inside = x[(x > low + 0.01) & (x < low + period - 0.01)]
    np.testing.assert_array_equal(wrap(inside, low, period), inside)
