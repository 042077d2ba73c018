"""Oriented spacecraft, Eqs. (18)-(20): one step against scipy's integrator.

The reference is split where the turn rate reaches its limit.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from jaxsafe.schema.component import normalise
from jaxsafe.simulation.cwh import MASS, MEAN_MOTION, Spacecraft, SpacecraftState
from jaxsafe.simulation.oriented import RATE_LIMIT, OrientedSpacecraft, OrientedState

NUM = 3000
TURN = math.pi / 180.0


def step(x: Any, controls: Any, dt: Any = 1.0) -> jax.Array:
    """Return [x, y, ẋ, ẏ, θ, θ̇] one step later under the controls [thrust, θ̈]."""
    craft = normalise(OrientedSpacecraft(name="craft"))
    state = OrientedState(x[:2], x[2:4], jnp.zeros(1), x[4], x[5])
    after = craft.step(state, {"thrust": controls[0], "attitude_acceleration": controls[1]}, dt)
    return jnp.concatenate(
        [after.position, after.velocity, jnp.stack([after.attitude, after.attitude_rate])]
    )


steps = jax.jit(jax.vmap(step, in_axes=(0, 0, None)))
jacobian = jax.jit(jax.vmap(jax.jacfwd(step, argnums=(0, 1))))


def exact(x: np.ndarray, controls: np.ndarray, dt: float) -> np.ndarray:
    """Return the flow of Eq. (20) over dt by `solve_ivp`.

    The integration restarts where the turn rate reaches its limit and rests there.

    States are [6, n] and controls [2, n].
    """
    thrust, turn = controls
    to_go = np.where(turn > 0.0, RATE_LIMIT, -RATE_LIMIT) - x[5]
    stop = np.clip(np.divide(to_go, turn, out=np.full_like(turn, dt), where=turn != 0.0), 0.0, dt)
    n = MEAN_MOTION
    for length, acceleration in ((stop, turn), (dt - stop, 0.0 * turn)):

        def unit(
            _: float, y: np.ndarray, length: np.ndarray = length, turn: np.ndarray = acceleration
        ) -> np.ndarray:
            px, _, vx, vy, angle, rate = y.reshape(6, -1)
            ax = 2 * n * vy + 3 * n**2 * px + thrust / MASS * np.cos(angle)
            ay = -2 * n * vx + thrust / MASS * np.sin(angle)
            return (length * np.stack([vx, vy, ax, ay, rate, turn])).ravel()

        x = (
            solve_ivp(unit, (0.0, 1.0), x.ravel(), method="DOP853", rtol=1e-13, atol=1e-14)
            .y[:, -1]
            .reshape(6, -1)
        )
    return x


def random_craft(seed: int, num: int = NUM) -> tuple[np.ndarray, np.ndarray]:
    """Draw states [6, num] and controls [2, num].

    In a fifth of the samples the turn rate is on its limit, in a fifth just off it, and in a fifth
    a control is zero.
    """
    rng = np.random.default_rng(seed)
    rate = rng.uniform(-RATE_LIMIT, RATE_LIMIT, num)
    end = rng.choice([-RATE_LIMIT, RATE_LIMIT], num)
    kind = rng.integers(5, size=num)
    rate[kind == 0] = end[kind == 0]
    rate[kind == 1] = 0.9999 * end[kind == 1]
    planar = np.concatenate([rng.uniform(-150, 150, (2, num)), rng.uniform(-0.5, 0.5, (2, num))])
    controls = np.stack([rng.uniform(-1.0, 2.0, num), rng.uniform(-TURN, TURN, num)])
    controls[rng.integers(5, size=controls.shape) == 0] = 0.0
    return np.stack([*planar, rng.uniform(-math.pi, math.pi, num), rate]), controls


def unwrapped(difference: np.ndarray) -> np.ndarray:
    """Return the angle in [−π, π) that differs from a difference of angles by whole turns."""
    return (difference + math.pi) % (2.0 * math.pi) - math.pi


@pytest.mark.usefixtures("x64")
def test_a_step_is_within_a_hundredth_of_a_millionth_of_a_metre() -> None:
    x, controls = random_craft(seed=1)
    assert np.mean(np.abs(x[5] + controls[1]) > RATE_LIMIT) > 0.1
    expected = exact(x, controls, 1.0)
    computed = np.asarray(steps(x.T, controls.T, 1.0)).T
    np.testing.assert_allclose(computed[:4], expected[:4], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(unwrapped(computed[4] - expected[4]), 0.0, atol=1e-12)
    np.testing.assert_allclose(computed[5], expected[5], rtol=0.0, atol=1e-15)


@pytest.mark.usefixtures("x64")
def test_a_step_of_ten_seconds_reaches_the_limit_from_anywhere_and_is_still_close() -> None:
    x, controls = random_craft(seed=2)
    computed = np.asarray(steps(x.T, controls.T, 10.0)).T
    expected = exact(x, controls, 10.0)
    np.testing.assert_allclose(computed[:4], expected[:4], rtol=0.0, atol=5e-5)
    np.testing.assert_allclose(unwrapped(computed[4] - expected[4]), 0.0, atol=1e-11)


@pytest.mark.usefixtures("x64")
def test_the_error_falls_with_the_sixth_power_of_the_step() -> None:
    start = np.array([[90.0, -40.0, 0.2, 0.1, 0.3, -RATE_LIMIT]])
    controls = np.array([[2.0, RATE_LIMIT / 100.0]])
    expected = exact(start.T, controls.T, 160.0)
    errors = []
    for num_steps in (4, 8, 16):
        x = start
        for _ in range(num_steps):
            x = steps(x, controls, 160.0 / num_steps)
        errors.append(np.linalg.norm(np.asarray(x)[0, :2] - expected[:2, 0]))
    slopes = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert errors[-1] > 1e-9  # above rounding, so that the slopes mean something
    np.testing.assert_allclose(slopes[-1], 6.0, atol=0.4)


def test_in_float32_a_step_has_six_digits() -> None:
    x, controls = (array.astype(np.float32) for array in random_craft(seed=3))
    computed = np.asarray(steps(x.T, controls.T, 1.0)).T
    expected = exact(x.astype(float), controls.astype(float), 1.0)
    assert computed.dtype == np.float32
    np.testing.assert_allclose(computed[:2], expected[:2], rtol=0.0, atol=150 * 4e-7)
    np.testing.assert_allclose(computed[2:4], expected[2:4], rtol=0.0, atol=4e-7)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_without_a_turn_it_is_a_spacecraft_with_the_thrust_rotated() -> None:
    x, controls = random_craft(seed=4, num=500)
    x[5] = 0.0
    controls[1] = 0.0
    point = normalise(Spacecraft(name="point", dimension=2))

    def plain(x: jax.Array, thrust: jax.Array) -> jax.Array:
        thrusts = {"thrust_x": thrust * jnp.cos(x[4]), "thrust_y": thrust * jnp.sin(x[4])}
        after = point.step(SpacecraftState(x[:2], x[2:4], jnp.zeros(2)), thrusts, 1.0)
        return jnp.concatenate([after.position, after.velocity])

    computed = steps(x.T, controls.T, 1.0)
    np.testing.assert_allclose(
        computed[:, :4], jax.vmap(plain)(x.T, controls[0]), rtol=0.0, atol=1e-12
    )
    np.testing.assert_allclose(computed[:, 4], x[4], rtol=0.0, atol=1e-14)


@pytest.mark.usefixtures("x64")
def test_without_thrust_the_attitude_does_not_move_the_craft() -> None:
    x, controls = random_craft(seed=5, num=500)
    controls[0] = 0.0
    still = x.copy()
    still[4:] = 0.0
    np.testing.assert_array_equal(
        steps(x.T, controls.T, 1.0)[:, :4], steps(still.T, controls.T, 1.0)[:, :4]
    )


def at(attitude: float, rate: float) -> OrientedState:
    return OrientedState(
        jnp.zeros(2), jnp.zeros(2), jnp.zeros(1), jnp.asarray(attitude), jnp.asarray(rate)
    )


def test_the_turn_rate_rests_at_its_limit() -> None:
    craft = normalise(OrientedSpacecraft(name="craft"))
    state = at(0.0, 0.0)
    rates = []
    attitudes = []
    for _ in range(5):
        state = craft.step(state, {"attitude_acceleration": 0.75 * RATE_LIMIT}, 1.0)
        rates.append(float(state.attitude_rate))
        attitudes.append(float(state.attitude))
    np.testing.assert_allclose(np.array(rates) / RATE_LIMIT, [0.75, 1, 1, 1, 1], rtol=1e-6)
    # The turn rate takes a third of a second to reach its limit and stays on it afterwards.
    second = 0.75 / 3 + 0.75 / 3 / 6 + 2 / 3
    np.testing.assert_allclose(
        np.array(attitudes) / RATE_LIMIT, np.cumsum([0.375, second, 1, 1, 1]), rtol=1e-5
    )


@pytest.mark.parametrize("x64", [False, True])
def test_the_attitude_is_wrapped_to_the_half_open_interval(x64: bool) -> None:
    with jax.enable_x64(x64):
        craft = normalise(OrientedSpacecraft(name="craft"))
        turn = jax.jit(lambda attitude, rate: craft.step(at(attitude, rate), {}, 1.0).attitude)
        pi = np.asarray(np.pi, jnp.result_type(float))[()]
        ulp = np.spacing(pi)
        starts = [
            pi,
            -pi,
            *(sign * (pi + k * ulp) for sign in (1, -1) for k in (-2, -1, 1, 2, 5)),
            7.0,
            -40.0,
            0.0,
        ]
        for attitude in starts:
            for rate in (0.0, 1e-9, -1e-9, ulp, -ulp, RATE_LIMIT, -RATE_LIMIT):
                after = turn(attitude, rate)
                assert -pi <= after < pi, (attitude, rate)
                assert unwrapped(float(after) - float(attitude) - rate) == pytest.approx(
                    0.0, abs=1e-5
                )


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 10_000))
def test_attitude_and_turn_rate_stay_in_their_ranges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.float32([[0.0, 0.0, 0.0, 0.0, rng.uniform(-math.pi, math.pi), 0.0]])
    for _ in range(20):
        x = np.asarray(
            steps(
                x, np.float32(rng.uniform(-1, 1, (1, 2)) * [2.0, 3 * RATE_LIMIT]), np.float32(1.0)
            )
        )
        assert -np.float32(np.pi) <= x[0, 4] < np.float32(np.pi)
        assert abs(x[0, 5]) <= np.float32(RATE_LIMIT)


def test_the_delta_v_is_thrust_over_mass_times_the_step() -> None:
    craft = normalise(OrientedSpacecraft(name="craft", mass=4.0))
    assert craft.step(at(1.0, 0.01), {"thrust": 2.0}, 0.5).delta_v.tolist() == [0.25]
    assert craft.step(at(1.0, 0.01), {"thrust": -1.0}, 1.0).delta_v.tolist() == [-0.25]
    assert craft.step(at(1.0, 0.01), {}, 1.0).delta_v.tolist() == [0.0]


def test_a_quarter_turn_of_the_attitude_points_the_body_along_y() -> None:
    state = at(math.pi / 2, 0.0)
    np.testing.assert_allclose(state.orientation[:, 0], [0.0, 1.0], atol=1e-6)
    assert float(state.heading) == pytest.approx(math.pi / 2)
    pushed = normalise(OrientedSpacecraft(name="craft", mean_motion=0.0)).step(
        state, {"thrust": 2.0}, 1.0
    )
    np.testing.assert_allclose(pushed.velocity, [0.0, 2.0 / 12.0], atol=1e-7)
    np.testing.assert_allclose(pushed.position, [0.0, 1.0 / 12.0], atol=1e-7)


@pytest.mark.usefixtures("x64")
def test_derivatives_are_finite_differences() -> None:
    """The derivative lies between the finite differences to both sides.

    The two differ on the limit and at a zero control there.
    """
    x, controls = random_craft(seed=6, num=500)
    x[4] *= 0.99  # so that no angle wraps in between
    both = np.concatenate([x, controls]).T
    size = 1e-6
    computed = np.concatenate(jacobian(both[:, :6], both[:, 6:]), axis=-1)
    middle = np.asarray(steps(both[:, :6], both[:, 6:], 1.0))
    for k in range(8):
        sides = []
        for side in (-size, size):
            moved = both + side * (np.arange(8) == k)
            sides.append((np.asarray(steps(moved[:, :6], moved[:, 6:], 1.0)) - middle) / side)
        slack = 1e-7 + 1e-5 * np.abs(sides[0])
        assert (computed[..., k] >= np.minimum(*sides) - slack).all(), k
        assert (computed[..., k] <= np.maximum(*sides) + slack).all(), k


@pytest.mark.thorough
def test_in_float32_derivatives_are_finite_on_the_limit_and_at_zero_controls() -> None:
    for rate in (-RATE_LIMIT, 0.0, RATE_LIMIT):
        for turn in (-1e-38, 0.0, 1e-38, TURN):
            parts = jacobian(
                jnp.asarray([[100.0, 0.0, 0.0, 0.0, 0.0, rate]]), jnp.asarray([[0.0, turn]])
            )
            assert all(np.isfinite(part).all() for part in parts)
