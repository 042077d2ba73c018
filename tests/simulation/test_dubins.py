"""Aircraft: one step against scipy's integrator, and the laws of Eqs. (5) and (9).

The reference is split where a limit is reached.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind, thorough
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from jaxsafe.schema.component import normalise
from jaxsafe.simulation.dubins import GRAVITY, Dubins2D, Dubins2DState, Dubins3D, Dubins3DState

NUM = 3000
SPEEDS = (200.0, 400.0)
GAMMAS = (-math.pi / 9, math.pi / 9)
ROLLS = (-math.pi / 3, math.pi / 3)


def step2d(x: Any, controls: Any, dt: Any = 1.0) -> jax.Array:
    """Return [x, y, ψ, v] one step later under the controls [ψ̇, v̇]."""
    aircraft = normalise(Dubins2D(name="aircraft"))
    state = Dubins2DState(x[:2], x[2], x[3])
    after = aircraft.step(state, {"heading_rate": controls[0], "acceleration": controls[1]}, dt)
    return jnp.concatenate([after.position, jnp.stack([after.heading, after.speed])])


def step3d(x: Any, controls: Any, dt: Any = 1.0) -> jax.Array:
    """Return [x, y, z, ψ, v, γ, φ] one step later under the controls [φ̇, γ̇, v̇]."""
    aircraft = normalise(Dubins3D(name="aircraft"))
    state = Dubins3DState(x[:3], x[3], x[4], x[5], x[6])
    names = ("roll_rate", "flight_path_angle_rate", "acceleration")
    after = aircraft.step(state, dict(zip(names, controls, strict=True)), dt)
    return jnp.concatenate(
        [
            after.position,
            jnp.stack([after.heading, after.speed, after.flight_path_angle, after.roll]),
        ]
    )


steps2d = jax.jit(jax.vmap(step2d, in_axes=(0, 0, None)))
steps3d = jax.jit(jax.vmap(step3d, in_axes=(0, 0, None)))
jacobian2d = jax.jit(jax.vmap(jax.jacfwd(step2d, argnums=(0, 1))))
jacobian3d = jax.jit(jax.vmap(jax.jacfwd(step3d, argnums=(0, 1))))


def rate_of_change(y: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the rate of change in Eq. (9) of [x, y, z, ψ, v, γ, φ, unused heading rate].

    Eq. (5) is the case γ = φ = 0 with a heading rate.
    """
    _, _, _, psi, v, gamma, phi = y
    turn = rates[3] + GRAVITY / v * np.tan(phi)
    forward = [np.cos(psi) * np.cos(gamma), np.sin(psi) * np.cos(gamma), -np.sin(gamma)]
    return np.stack([*(v * part for part in forward), turn, rates[0], rates[1], rates[2]])


def exact(x: np.ndarray, rates: np.ndarray, dt: float) -> np.ndarray:
    """Return the flow over dt by `solve_ivp`. The integration restarts wherever a limit is reached.

    States are [7, n], and the rates (v̇, γ̇, φ̇, ψ̇) are [4, n]. All samples are integrated at
    once: each piece between two stops is mapped to the unit interval.
    """
    stops = np.full((3, x.shape[1]), dt)
    for k, (low, high) in enumerate((SPEEDS, GAMMAS, ROLLS)):
        moving = rates[k] != 0.0
        to_go = np.where(rates[k] > 0.0, high, low) - x[4 + k]
        stops[k][moving] = np.clip(to_go[moving] / rates[k][moving], 0.0, dt)
    bounds = np.concatenate(
        [np.zeros((1, x.shape[1])), np.sort(stops, axis=0), np.full((1, x.shape[1]), dt)]
    )
    for begin, end in pairwise(bounds):
        length = end - begin
        active = (
            np.concatenate([stops > (begin + end) / 2.0, np.ones((1, x.shape[1]), bool)]) * rates
        )

        def unit(
            _: float, y: np.ndarray, active: np.ndarray = active, length: np.ndarray = length
        ) -> np.ndarray:
            return (length * rate_of_change(y.reshape(7, -1), active)).ravel()

        solved = solve_ivp(unit, (0.0, 1.0), x.ravel(), method="DOP853", rtol=1e-13, atol=1e-12)
        x = solved.y[:, -1].reshape(7, -1)
    return x


def random_aircraft(seed: int, num: int = NUM) -> tuple[np.ndarray, np.ndarray]:
    """Draw states [7, num] and rates (v̇, γ̇, φ̇, ψ̇)

    [4, num]. For each limit a fifth of the samples are on it, a fifth just off it, and in a fifth
    the rate is zero.
    """
    rng = np.random.default_rng(seed)
    limits = (SPEEDS, GAMMAS, ROLLS)
    angles = [rng.uniform(low, high, num) for low, high in limits]
    for sample, (low, high) in zip(angles, limits, strict=True):
        kind = rng.integers(5, size=num)
        end = rng.choice([low, high], num)
        sample[kind == 0] = end[kind == 0]
        sample[kind == 1] = (end + 1e-4 * ((low + high) / 2 - end))[kind == 1]
    x = np.stack([*rng.uniform(-1e4, 1e4, (3, num)), rng.uniform(-10.0, 10.0, num), *angles])
    rates = np.stack([rng.uniform(-size, size, num) for size in (96.5, 0.17, 0.17, 0.17)])
    rates[rng.integers(5, size=rates.shape) == 0] = 0.0
    return x, rates


def flat(x: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the same samples at one altitude without roll, with the controls of planar flight."""
    level = x.copy()
    turning = rates.copy()
    level[[2, 5, 6]] = 0.0
    turning[[1, 2]] = 0.0
    return level, turning


def crossings(x: np.ndarray, rates: np.ndarray, dt: float) -> np.ndarray:
    """Return how many limits each sample reaches inside the step."""
    ends = zip(x[4:7], rates[:3], (SPEEDS, GAMMAS, ROLLS), strict=True)
    return sum(
        (value + dt * rate < low) | (value + dt * rate > high) for value, rate, (low, high) in ends
    )


# One step against the exact flow


@pytest.mark.parametrize("dt", one_of_each_kind([0.1, 1.0, 10.0, 30.0], [1.0, 30.0]))
@pytest.mark.usefixtures("x64")
def test_a_planar_step_of_any_length_is_within_a_millionth_of_a_foot(dt: float) -> None:
    x, rates = flat(*random_aircraft(seed=1))
    assert np.sum(crossings(x, rates, dt) > 0) > 0.01 * NUM
    expected = exact(x, rates, dt)[[0, 1, 3, 4]]
    computed = np.asarray(steps2d(x[[0, 1, 3, 4]].T, rates[[3, 0]].T, dt)).T
    np.testing.assert_allclose(computed[:2], expected[:2], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(computed[2:], expected[2:], rtol=0.0, atol=1e-8)


@pytest.mark.usefixtures("x64")
def test_a_spatial_step_is_within_1e_3_ft_and_mostly_within_1e_5_ft() -> None:
    x, rates = random_aircraft(seed=2)
    rates[3] = 0.0
    assert [np.sum(crossings(x, rates, 1.0) == count) > 10 for count in range(3)] == [
        True,
        True,
        True,
    ]
    expected = exact(x, rates, 1.0)
    computed = np.asarray(steps3d(x.T, rates[[2, 1, 0]].T, 1.0)).T
    np.testing.assert_allclose(computed[:3], expected[:3], rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(computed[3], expected[3], rtol=0.0, atol=2e-6)
    np.testing.assert_allclose(computed[4:], expected[4:], rtol=0.0, atol=1e-9)
    assert np.mean(np.abs(computed - expected)[:3].max(axis=0) < 1e-5) > 0.85


@pytest.mark.usefixtures("x64")
def test_a_spatial_step_that_reaches_all_three_limits_is_as_close() -> None:
    rng = np.random.default_rng(3)
    ends = np.stack([rng.choice(limits, NUM) for limits in (SPEEDS, GAMMAS, ROLLS)])
    rates = (
        rng.uniform(0.2, 1.0, (3, NUM))
        * [[96.5], [0.17], [0.17]]
        * np.sign(ends - [[300.0], [0.0], [0.0]])
    )
    x = np.concatenate(
        [
            np.zeros((3, NUM)),
            rng.uniform(-3, 3, (1, NUM)),
            ends - rng.uniform(0, 1, (3, NUM)) * rates,
        ]
    )
    rates = np.append(rates, np.zeros((1, NUM)), axis=0)
    assert np.mean(crossings(x, rates, 1.0) == 3) > 0.99
    computed = np.asarray(steps3d(x.T, rates[[2, 1, 0]].T, 1.0)).T
    np.testing.assert_allclose(computed[:3], exact(x, rates, 1.0)[:3], rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(computed[4:], ends, rtol=1e-12)


@pytest.mark.usefixtures("x64")
def test_the_spatial_integrator_has_order_six() -> None:
    """The global error is measured over 8 s of smooth flight that reaches no limit.

    Steps are 4, 2, 1 and 0.5 s long.
    """
    start = np.array([[0.0, 0.0, 10_000.0, 0.3, 260.0, -0.2, -0.6]])
    controls = np.array([[0.14, 0.04, 12.0]])
    expected = exact(start.T, np.array([[12.0], [0.04], [0.14], [0.0]]), 8.0)
    errors = []
    for num_steps in (2, 4, 8, 16):
        x = start
        for _ in range(num_steps):
            x = steps3d(x, controls, 8.0 / num_steps)
        errors.append(np.linalg.norm(np.asarray(x)[0, :3] - expected[:3, 0]))
    slopes = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert errors[-1] > 1e-10  # above rounding, so that the slopes mean something
    np.testing.assert_allclose(slopes[-2:], 6.0, atol=0.4)


@pytest.mark.parametrize("model", [thorough(2), 3])
def test_in_float32_a_step_far_out_errs_by_less_than_the_spacing_of_its_position(
    model: int,
) -> None:
    """Half of the spacing between floats is lost in storing the result.

    At 3e5 ft neighbouring floats are 1/32 ft apart.
    """
    x, rates = random_aircraft(seed=4)
    x[:3] += 3e5
    x = x.astype(np.float32)
    rates = rates.astype(np.float32)
    if model == 2:
        x, rates = flat(x, rates)
        computed = np.asarray(steps2d(x[[0, 1, 3, 4]].T, rates[[3, 0]].T, 1.0)).T[:2]
    else:
        rates[3] = 0.0
        computed = np.asarray(steps3d(x.T, rates[[2, 1, 0]].T, 1.0)).T[:3]
    assert computed.dtype == np.float32
    expected = exact(x.astype(float), rates.astype(float), 1.0)[: len(computed)]
    assert 0.9 * 2.0**-6 < np.max(np.abs(computed - expected)) < 1.1 * 2.0**-6


@pytest.mark.parametrize("model", [thorough(2), 3])
def test_in_float32_the_way_flown_has_six_digits(model: int) -> None:
    x, rates = random_aircraft(seed=5)
    x[:3] = 0.0
    x = x.astype(np.float32)
    rates = rates.astype(np.float32)
    if model == 2:
        x, rates = flat(x, rates)
        computed = np.asarray(steps2d(x[[0, 1, 3, 4]].T, rates[[3, 0]].T, 1.0)).T[:2]
    else:
        rates[3] = 0.0
        computed = np.asarray(steps3d(x.T, rates[[2, 1, 0]].T, 1.0)).T[:3]
    expected = exact(x.astype(float), rates.astype(float), 1.0)[: len(computed)]
    np.testing.assert_allclose(computed, expected, rtol=0.0, atol=400.0 * 2e-6)


# Laws


def fly(
    aircraft: Any, state: Any, controls: dict[str, float], num_steps: int, dt: float = 1.0
) -> list[Any]:
    """Return the states of a flight with constant controls, the start first."""
    step = jax.jit(lambda state: aircraft.step(state, controls, dt))
    states = [state]
    for _ in range(num_steps):
        states.append(step(states[-1]))
    return states


def planar(
    speed: float = 300.0, heading: float = 0.4, position: Sequence[float] = (10.0, -20.0)
) -> Dubins2DState:
    return Dubins2DState(jnp.asarray(position), jnp.asarray(heading), jnp.asarray(speed))


def spatial(
    speed: float = 300.0, heading: float = 0.4, gamma: float = 0.0, roll: float = 0.0
) -> Dubins3DState:
    return Dubins3DState(
        jnp.asarray([10.0, -20.0, 5.0]), *map(jnp.asarray, (heading, speed, gamma, roll))
    )


@pytest.mark.parametrize("rate", [0.17, -0.05])
@pytest.mark.usefixtures("x64")
def test_a_steady_turn_is_a_circle_of_radius_speed_over_turn_rate(rate: float) -> None:
    states = fly(normalise(Dubins2D(name="a")), planar(), {"heading_rate": rate}, 40)
    centre = np.array([10.0, -20.0]) + 300.0 / rate * np.array([-math.sin(0.4), math.cos(0.4)])
    radii = [np.linalg.norm(state.position - centre) for state in states]
    np.testing.assert_allclose(radii, 300.0 / abs(rate), rtol=1e-12)
    np.testing.assert_allclose(
        [state.heading for state in states], 0.4 + rate * np.arange(41), atol=1e-12
    )


@pytest.mark.usefixtures("x64")
def test_the_heading_is_not_wrapped() -> None:
    assert (
        float(fly(normalise(Dubins2D(name="a")), planar(), {"heading_rate": 0.17}, 60)[-1].heading)
        > 10.0
    )


@pytest.mark.usefixtures("x64")
def test_without_controls_flight_is_straight() -> None:
    two = fly(normalise(Dubins2D(name="a")), planar(), {}, 1, dt=7.0)[-1]
    np.testing.assert_allclose(
        two.position, [10 + 2100 * math.cos(0.4), -20 + 2100 * math.sin(0.4)], rtol=1e-13
    )
    three = fly(normalise(Dubins3D(name="a")), spatial(gamma=0.2), {}, 1, dt=7.0)[-1]
    forward = [math.cos(0.4) * math.cos(0.2), math.sin(0.4) * math.cos(0.2), -math.sin(0.2)]
    np.testing.assert_allclose(
        three.position, np.array([10, -20, 5]) + 2100 * np.array(forward), rtol=1e-13
    )
    assert (float(three.heading), float(three.speed), float(three.flight_path_angle)) == (
        0.4,
        300.0,
        0.2,
    )


@pytest.mark.parametrize("aircraft", [Dubins2D(name="a"), Dubins3D(name="a")])
@pytest.mark.parametrize(("acceleration", "rest"), [(96.5, 400.0), (-96.5, 200.0)])
def test_speed_rests_at_its_limit_and_the_way_follows(
    aircraft: Any, acceleration: float, rest: float
) -> None:
    start = planar() if isinstance(aircraft, Dubins2D) else spatial()
    aircraft = normalise(aircraft)
    states = fly(aircraft, start, {"acceleration": acceleration}, 4)
    np.testing.assert_allclose(
        [state.speed for state in states], [300, 300 + acceleration, rest, rest, rest]
    )
    ways = [np.linalg.norm(after.position - before.position) for before, after in pairwise(states)]
    stop = (rest - 300.0 - acceleration) / acceleration
    second = (300.0 + acceleration + rest) / 2.0 * stop + rest * (1.0 - stop)
    np.testing.assert_allclose(ways, [300 + acceleration / 2, second, rest, rest], rtol=1e-5)


def test_a_speed_beyond_its_limits_counts_as_on_the_limit() -> None:
    for speed, rest in ((500.0, 400.0), (100.0, 200.0)):
        for aircraft, start in (
            (Dubins2D(name="a"), planar(speed)),
            (Dubins3D(name="a"), spatial(speed)),
        ):
            after = fly(normalise(aircraft), start, {}, 1)[-1]
            assert float(after.speed) == rest
            assert float(jnp.linalg.norm(after.position - start.position)) == pytest.approx(
                rest, rel=1e-6
            )


@pytest.mark.parametrize("aircraft", [Dubins2D(name="a"), thorough(Dubins3D(name="a"))])
def test_a_control_left_out_is_one_of_zero(aircraft: Any) -> None:
    start = planar() if isinstance(aircraft, Dubins2D) else spatial(gamma=0.2, roll=0.5)
    aircraft = normalise(aircraft)
    rolling = [{"roll_rate": 0.6}] if isinstance(aircraft, Dubins3D) else []
    for controls in ({}, {"heading_rate": 0.1}, {"acceleration": 96.5}, *rolling):
        zeros = dict.fromkeys(("acceleration", "flight_path_angle_rate", "roll_rate"), 0.0)
        with_zeros = fly(aircraft, start, zeros | controls, 3)[-1]
        chex.assert_trees_all_close(fly(aircraft, start, controls, 3)[-1], with_zeros, rtol=1e-6)


def test_angles_rest_at_their_limits() -> None:
    climbing = {"flight_path_angle_rate": -0.3, "roll_rate": 0.6}
    states = fly(normalise(Dubins3D(name="a")), spatial(), climbing, 4)
    np.testing.assert_allclose(
        [state.roll for state in states], [0.0, 0.6, *3 * [math.pi / 3]], rtol=1e-6
    )
    gammas = [0.0, -0.3, *3 * [-math.pi / 9]]
    np.testing.assert_allclose([state.flight_path_angle for state in states], gammas, rtol=1e-6)


@pytest.mark.parametrize("aircraft", [thorough(Dubins2D(name="a")), Dubins3D(name="a")])
@pytest.mark.usefixtures("x64")
def test_a_step_that_reaches_no_limit_before_its_end_may_be_taken_in_one_piece(
    aircraft: Any,
) -> None:
    limits = {
        name: value for name, value in vars(normalise(aircraft)).items() if name.endswith("_limits")
    }
    rates = {
        "roll": "roll_rate",
        "flight_path_angle": "flight_path_angle_rate",
        "speed": "acceleration",
    }
    rng = np.random.default_rng(0)
    for share in (0.0, 0.5, 1.0):  # of the way to a limit, where 1 ends the step on it
        state = aircraft.rest()
        controls = {}
        for name, (low, high) in (
            (name.removesuffix("_limits"), value) for name, value in limits.items()
        ):
            x = rng.uniform(low, high)
            goal = rng.choice([low, high])
            state = state.replace(**{name: jnp.asarray(x)})
            controls = controls | {rates[name]: share * (goal - x)}
        if isinstance(aircraft, Dubins2D):
            controls["heading_rate"] = 0.17
        both = (
            aircraft.step(state, controls, 1.0),
            aircraft.step_within_limits(state, controls, jnp.ones(())),
        )
        chex.assert_trees_all_close(*both, rtol=1e-10, atol=1e-6)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 10_000))
def test_no_limit_is_ever_exceeded(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.float32([[0.0, 0.0, 0.0, 0.0, rng.uniform(200, 400), 0.0, 0.0]])
    for _ in range(10):
        x = steps3d(x, np.float32(rng.uniform(-1, 1, (1, 3)) * [1.0, 1.0, 200.0]), np.float32(1.0))
        for value, (low, high) in zip(np.asarray(x)[0, 4:], (SPEEDS, GAMMAS, ROLLS), strict=True):
            assert np.float32(low) <= value <= np.float32(high)


@pytest.mark.usefixtures("x64")
def test_planar_motion_is_level_flight_in_space_without_roll() -> None:
    x, rates = flat(*random_aircraft(seed=6))
    rates[3] = 0.0
    two = np.asarray(steps2d(x[[0, 1, 3, 4]].T, rates[[3, 0]].T, 1.0))
    three = np.asarray(steps3d(x.T, rates[[2, 1, 0]].T, 1.0))
    np.testing.assert_allclose(three[:, [0, 1, 3, 4]], two, rtol=1e-13)
    assert not three[:, [2, 5, 6]].any()


@pytest.mark.parametrize("rate", [0.05, -0.08])
@pytest.mark.usefixtures("x64")
def test_a_heading_rate_in_space_is_held_as_a_coordinated_turn(rate: float) -> None:
    states = fly(normalise(Dubins3D(name="a")), spatial(), {"heading_rate": rate}, 20)
    assert float(states[1].roll) == pytest.approx(math.atan(rate * 300.0 / GRAVITY), rel=1e-12)
    turned = np.diff([state.heading for state in states])
    np.testing.assert_allclose(turned[1:], rate, rtol=1e-12)
    assert 0.0 < turned[0] / rate < 1.0  # the aircraft banks first
    flat_turn = fly(normalise(Dubins2D(name="a")), planar(), {"heading_rate": rate}, 19)
    flown = np.linalg.norm(np.diff([state.position for state in states[1:]], axis=0), axis=1)
    chords = np.linalg.norm(np.diff([state.position for state in flat_turn], axis=0), axis=1)
    np.testing.assert_allclose(flown, chords, rtol=1e-9)
    assert all(float(state.position[2]) == 5.0 for state in states)


@pytest.mark.usefixtures("x64")
def test_a_heading_rate_beyond_the_roll_limit_gives_the_tightest_turn() -> None:
    states = fly(normalise(Dubins3D(name="a")), spatial(), {"heading_rate": 1.0}, 3)
    assert float(states[-1].roll) == pytest.approx(math.pi / 3)
    assert float(states[-1].heading - states[-2].heading) == pytest.approx(
        GRAVITY * math.tan(math.pi / 3) / 300.0
    )


@pytest.mark.usefixtures("x64")
def test_a_heading_rate_of_zero_keeps_level_flight_straight_and_takes_bank_out() -> None:
    aircraft = normalise(Dubins3D(name="a"))
    assert float(fly(aircraft, spatial(), {"heading_rate": 0.0}, 3)[-1].heading) == 0.4
    states = fly(aircraft, spatial(roll=0.5), {"heading_rate": 0.0}, 3)
    assert float(states[1].roll) == pytest.approx(0.0, abs=1e-15)
    assert float(states[3].heading - states[1].heading) == pytest.approx(0.0, abs=1e-14)


@pytest.mark.usefixtures("x64")
def test_two_steps_with_held_controls_are_one_in_the_plane() -> None:
    x, rates = flat(*random_aircraft(seed=7))
    state = x[[0, 1, 3, 4]].T
    controls = rates[[3, 0]].T
    np.testing.assert_allclose(
        steps2d(steps2d(state, controls, 0.7), controls, 1.6),
        steps2d(state, controls, 2.3),
        rtol=0.0,
        atol=1e-9,
    )


@pytest.mark.usefixtures("x64")
def test_motion_does_not_depend_on_where_it_is_and_which_way_it_points() -> None:
    x, rates = random_aircraft(seed=8)
    rates[3] = 0.0
    turned = x.copy()
    turned[:3] += np.array([[300.0], [-20.0], [7.0]])
    turned[3] += 1.1
    here, there = (
        np.asarray(steps3d(states.T, rates[[2, 1, 0]].T, 1.0)).T - states for states in (x, turned)
    )
    rotation = np.array([[math.cos(1.1), -math.sin(1.1)], [math.sin(1.1), math.cos(1.1)]])
    np.testing.assert_allclose(there[:2], rotation @ here[:2], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(there[2:], here[2:], rtol=0.0, atol=1e-9)


def test_the_state_s_velocity_and_orientation_point_along_its_path() -> None:
    for aircraft, state in (
        (Dubins2D(name="a"), planar()),
        (Dubins3D(name="a"), spatial(gamma=0.3, roll=-0.4)),
    ):
        moved = fly(normalise(aircraft), state, {}, 1, dt=1e-2)[-1]
        np.testing.assert_allclose(
            (moved.position - state.position) / 1e-2, state.velocity, atol=0.1
        )
        np.testing.assert_allclose(state.orientation[:, 0] * state.speed, state.velocity, rtol=1e-6)
        np.testing.assert_allclose(jnp.linalg.norm(state.velocity), state.speed, rtol=1e-6)


# Derivatives


def differences(step: Any, x: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return finite differences to the left and to the right, by all states and controls.

    Both are [sample, output, input].
    """
    both = np.concatenate([x, controls], axis=1)
    size = 1e-6
    middle = np.asarray(step(x, controls, 1.0))
    left = []
    right = []
    for k in range(both.shape[1]):
        for side, columns in ((-size, left), (size, right)):
            moved = both + side * (np.arange(both.shape[1]) == k)
            columns.append(
                (np.asarray(step(moved[:, : x.shape[1]], moved[:, x.shape[1] :], 1.0)) - middle)
                / side
            )
    return np.stack(left, axis=-1), np.stack(right, axis=-1)


@pytest.mark.thorough
@pytest.mark.parametrize("model", [thorough(2), 3])
@pytest.mark.usefixtures("x64")
def test_derivatives_are_finite_differences(model: int) -> None:
    """The derivative lies between the finite differences to both sides.

    The two differ on a limit and at a zero rate there.

    In space the nodes of the quadrature move with the times at which limits are reached. The
    derivatives leave that out. The error is a few hundredths of a foot per radian where a radian is
    worth hundreds of feet.
    """
    x, rates = random_aircraft(seed=9, num=1000)
    x[:3] = 0.0
    if model == 2:
        x, rates = flat(x, rates)
        step = steps2d
        jacobian = jacobian2d
        x = x[[0, 1, 3, 4]].T
        controls = rates[[3, 0]].T
        slack = np.array([1e-3, 1e-3, 1e-6, 1e-6])[None, :, None]
    else:
        rates[3] = 0.0
        step = steps3d
        jacobian = jacobian3d
        x = x.T
        controls = rates[[2, 1, 0]].T
        slack = np.array([0.04, 0.04, 0.04, 1e-4, 1e-6, 1e-6, 1e-6])[None, :, None]
    computed = np.concatenate(jacobian(x, controls), axis=-1)
    left, right = differences(step, x, controls)
    slack = slack + 1e-5 * np.maximum(np.abs(left), np.abs(right))
    assert (computed >= np.minimum(left, right) - slack).all()
    assert (computed <= np.maximum(left, right) + slack).all()
    smooth = np.abs(left - right) < slack
    assert smooth.mean() > 0.9
    assert (np.abs(computed) > 10.0 * slack)[smooth].mean() > 0.2  # the slack hides little


@pytest.mark.thorough
def test_in_float32_derivatives_are_finite_on_limits_and_at_zero_rates() -> None:
    for step, start in ((step2d, (0.0, 0.0, 0.0)), (step3d, (0.0, 0.0, 0.0, 0.0))):
        for speed in SPEEDS:
            for acceleration in (-1e-38, 0.0, 1e-38, 1e-6, 96.5):
                angles = () if step is step2d else (GAMMAS[1], ROLLS[0])
                x = jnp.asarray([*start, speed, *angles])
                controls = jnp.asarray(
                    [0.0, acceleration] if step is step2d else [0.0, 0.0, acceleration]
                )
                jacobian = jacobian2d if step is step2d else jacobian3d
                assert all(np.isfinite(part).all() for part in jacobian(x[None], controls[None]))
