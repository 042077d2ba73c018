"""Relative motion about a chief on an orbit, against the inertial motion of both spacecraft."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxsafe
from jaxsafe.schema.component import normalise
from jaxsafe.simulation import Spacecraft, TwoBody, TwoBodyJ2
from jaxsafe.simulation.cwh import MEAN_MOTION
from jaxsafe.simulation.two_body import EARTH, inverse_power
from jaxsafe.simulation.two_body_j2 import EARTH_J2, EARTH_RADIUS

SEMI_MAJOR_AXIS = (EARTH / MEAN_MOTION**2) ** (1 / 3)


def gravity(r: np.ndarray, j2: float) -> np.ndarray:
    """Return the acceleration by gravity in an inertial frame whose z axis is the planet's."""
    distance = np.linalg.norm(r)
    oblate = 1.5 * j2 * EARTH * EARTH_RADIUS**2 / distance**5
    tilted = (1.0 - 5.0 * (r[2] / distance) ** 2) * r + np.array([0.0, 0.0, 2.0 * r[2]])
    return -EARTH * r / distance**3 - oblate * tilted


def hill_axes(r: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the axes of Hill's frame, one in a row."""
    normal = np.cross(r, v)
    x = r / np.linalg.norm(r)
    z = normal / np.linalg.norm(normal)
    return np.stack([x, np.cross(z, x), z])


def turn_rate(r: np.ndarray, v: np.ndarray, j2: float) -> np.ndarray:
    """Return the angular velocity of Hill's frame, in its own axes."""
    axes = hill_axes(r, v)
    momentum = np.linalg.norm(np.cross(r, v))
    distance = np.linalg.norm(r)
    across = axes[2] @ gravity(r, j2)
    return np.array([distance * across / momentum, 0.0, momentum / distance**2])


def chief_start(
    e: float, anomaly: float, perigee: float, inclination: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity of the chief, with the ascending node on the x axis."""
    parameter = SEMI_MAJOR_AXIS * (1.0 - e**2)
    distance = parameter / (1.0 + e * math.cos(anomaly))
    latitude = perigee + anomaly
    node = np.array([1.0, 0.0, 0.0])
    ahead = np.array([0.0, math.cos(inclination), math.sin(inclination)])
    x = math.cos(latitude) * node + math.sin(latitude) * ahead
    y = -math.sin(latitude) * node + math.cos(latitude) * ahead
    speed = math.sqrt(EARTH / parameter)
    v = speed * (e * math.sin(anomaly) * x + (1.0 + e * math.cos(anomaly)) * y)
    return distance * x, v


def inertial(
    chief: tuple[np.ndarray, np.ndarray],
    relative: tuple[np.ndarray, np.ndarray],
    thrust: np.ndarray,
    time: float,
    j2: float,
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return relative position and velocity after a time, and the chief's state then.

    Both spacecraft are integrated in the inertial frame.
    """
    axes = hill_axes(*chief)
    r = chief[0] + axes.T @ relative[0]
    v = chief[1] + axes.T @ (relative[1] + np.cross(turn_rate(*chief, j2), relative[0]))

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        push = hill_axes(y[:3], y[3:6]).T @ thrust
        return np.concatenate([y[3:6], gravity(y[:3], j2), y[9:12], gravity(y[6:9], j2) + push])

    start = np.concatenate([*chief, r, v])
    end = solve_ivp(slope, (0.0, time), start, method="DOP853", rtol=1e-13, atol=1e-10).y[:, -1]
    axes = hill_axes(end[:3], end[3:6])
    position = axes @ (end[6:9] - end[:3])
    turning = np.cross(turn_rate(end[:3], end[3:6], j2), position)
    return position, axes @ (end[9:12] - end[3:6]) - turning, (end[:3], end[3:6])


def fly(platform: Any, position: Any, velocity: Any, thrust: Any, steps: int, dt: float) -> Any:
    """Return the state after some steps of constant thrust [N]."""
    start = platform.rest().replace(position=jnp.asarray(position), velocity=jnp.asarray(velocity))
    controls = {f"thrust_{axis}": jnp.asarray(f) for axis, f in zip("xyz", thrust, strict=False)}

    @jax.jit
    def run(platform: Any, state: Any) -> Any:
        step = lambda state, _: (platform.step(state, controls, jnp.asarray(dt)), None)  # noqa: E731
        return jax.lax.scan(step, state, length=steps)[0]

    return run(platform, start)


START = (np.array([120.0, -80.0, 60.0]), np.array([0.1, -0.2, 0.15]))
THRUST = np.array([0.01, -0.02, 0.015])  # N


@pytest.mark.parametrize(
    ("e", "j2"),
    [
        thorough(0.0, 0.0),
        thorough(0.1, 0.0),
        (0.7, 0.0),
        thorough(0.0, EARTH_J2),
        (0.1, EARTH_J2),
        thorough(0.7, EARTH_J2),
    ],
)
@pytest.mark.usefixtures("x64")
def test_both_spacecraft_move_as_in_the_inertial_frame(e: float, j2: float) -> None:
    fields: Any = {"name": "own", "eccentricity": e, "true_anomaly": 2.5, "substeps": 2}
    orbit: Any = {"argument_of_perigee": 0.7, "inclination": 1.1}
    kind = TwoBodyJ2(**fields, **orbit) if j2 else TwoBody(dimension=3, **fields)
    moved = fly(normalise(kind), *START, THRUST, steps=3000, dt=1.0)
    chief = chief_start(e, 2.5, 0.7, 1.1)
    position, velocity, _ = inertial(chief, START, THRUST / 12.0, 3000.0, j2)
    np.testing.assert_allclose(moved.position, position, atol=2e-5)
    np.testing.assert_allclose(moved.velocity, velocity, atol=2e-8)


@pytest.mark.parametrize(("j2", "metres"), [(0.0, 0.02), (EARTH_J2, 0.05)])
def test_float32_keeps_centimetres_over_a_whole_episode(j2: float, metres: float) -> None:
    fields: Any = {"name": "own", "eccentricity": 0.1, "true_anomaly": 2.5}
    orbit: Any = {"argument_of_perigee": 0.7, "inclination": 1.1}
    kind = TwoBodyJ2(**fields, **orbit) if j2 else TwoBody(dimension=3, **fields)
    r, v = (np.float32(vector) for vector in START)
    moved = fly(normalise(kind), r, v, np.zeros(3, np.float32), steps=2000, dt=1.0)
    assert moved.position.dtype == jnp.float32
    chief = chief_start(0.1, 2.5, 0.7, 1.1)
    position, _, _ = inertial(chief, START, np.zeros(3), 2000.0, j2)
    assert np.linalg.norm(moved.position - position) < metres


@pytest.mark.usefixtures("x64")
def test_the_difference_of_two_kepler_orbits_is_the_relative_motion() -> None:
    """Kepler's equation gives both positions at once, with no integration at all."""
    e = 0.3
    time = 4000.0
    chief = chief_start(e, 0.4, 0.0, 0.0)
    axes = hill_axes(*chief)
    r = chief[0] + axes.T @ START[0]
    v = chief[1] + axes.T @ (START[1] + np.cross(turn_rate(*chief, 0.0), START[0]))
    ends = [kepler(*chief, time), kepler(r, v, time)]
    expected = hill_axes(*ends[0]) @ (ends[1][0] - ends[0][0])
    platform = normalise(
        TwoBody(name="own", dimension=3, eccentricity=e, true_anomaly=0.4, substeps=4)
    )
    moved = fly(platform, *START, np.zeros(3), steps=4000, dt=1.0)
    np.testing.assert_allclose(moved.position, expected, atol=1e-5)


def kepler(r: np.ndarray, v: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity after a time by Kepler's equation and f and g functions."""
    distance = np.linalg.norm(r)
    a = 1.0 / (2.0 / distance - v @ v / EARTH)
    n = math.sqrt(EARTH / a**3)
    e_cos = 1.0 - distance / a
    e_sin = r @ v / math.sqrt(EARTH * a)

    def equation(change: float) -> float:
        swing = e_cos * math.sin(change) - e_sin * (1.0 - math.cos(change))
        return change - swing - n * time

    change = brentq(equation, n * time - 2.0, n * time + 2.0, xtol=1e-15)
    cosine = math.cos(change)
    sine = math.sin(change)
    f = 1.0 - a / distance * (1.0 - cosine)
    g = time - (change - sine) / n
    end = f * r + g * v
    far = np.linalg.norm(end)
    f_rate = -math.sqrt(EARTH * a) / (far * distance) * sine
    return end, f_rate * r + (1.0 - a / far * (1.0 - cosine)) * v


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.usefixtures("x64")
def test_near_a_circular_orbit_it_is_clohessy_wiltshire(dimension: int) -> None:
    near = [vector[:dimension] * 1e-3 for vector in START]
    thrust = THRUST[:dimension] * 1e-3
    ends = [
        fly(normalise(kind(name="own", dimension=dimension)), *near, thrust, steps=1000, dt=1.0)
        for kind in (TwoBody, Spacecraft)
    ]
    np.testing.assert_allclose(ends[0].position, ends[1].position, atol=1e-8)


@pytest.mark.usefixtures("x64")
def test_without_j2_the_oblate_planet_is_a_point() -> None:
    orbit: Any = {"eccentricity": 0.2, "true_anomaly": 1.0, "name": "own"}
    round_planet = normalise(TwoBody(dimension=3, **orbit))
    oblate = normalise(TwoBodyJ2(**orbit, argument_of_perigee=2.0, inclination=0.5, j2=0.0))
    ends = [fly(kind, *START, THRUST, steps=500, dt=1.0) for kind in (round_planet, oblate)]
    np.testing.assert_allclose(ends[0].position, ends[1].position, atol=1e-9)
    latitude = math.remainder(2.0 + float(ends[0].true_anomaly), 2.0 * math.pi)
    np.testing.assert_allclose(ends[1].argument_of_latitude, latitude, atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_the_chiefs_osculating_orbit_is_that_of_its_inertial_motion() -> None:
    platform = normalise(
        TwoBodyJ2(name="own", eccentricity=0.1, argument_of_perigee=0.7, inclination=1.1)
    )
    moved = fly(platform, np.zeros(3), np.zeros(3), np.zeros(3), steps=3000, dt=1.0)
    still = (np.zeros(3), np.zeros(3))
    _, _, (r, v) = inertial(chief_start(0.1, 0.0, 0.7, 1.1), still, np.zeros(3), 3000.0, EARTH_J2)
    normal = np.cross(r, v)
    assert math.isclose(
        moved.inclination, math.acos(normal[2] / np.linalg.norm(normal)), abs_tol=1e-9
    )
    parameter = SEMI_MAJOR_AXIS * (1.0 - 0.1**2)
    change = np.linalg.norm(normal) / math.sqrt(EARTH * parameter) - 1.0
    assert math.isclose(moved.momentum_change, change, abs_tol=1e-10)
    assert abs(change) > 1e-5
    node = np.cross([0.0, 0.0, 1.0], normal)
    node /= np.linalg.norm(node)
    ahead = np.cross(normal / np.linalg.norm(normal), node)
    assert math.isclose(moved.argument_of_latitude, math.atan2(ahead @ r, node @ r), abs_tol=1e-8)
    e = np.cross(v, normal) / EARTH - r / np.linalg.norm(r)
    np.testing.assert_allclose(moved.eccentricity_vector, [e @ node, e @ ahead], atol=1e-8)
    np.testing.assert_allclose(moved.position, 0.0, atol=1e-9)


@pytest.mark.parametrize("power", [3, 5, 7])
def test_the_power_keeps_its_digits_near_one(power: int) -> None:
    for q in (0.0, 1e-8, -3e-5, 0.2, -0.4):
        exact = math.expm1(-0.5 * power * math.log1p(np.float32(q)))
        found = inverse_power(jnp.float32(q), power)
        assert math.isclose(found, exact, rel_tol=1e-6, abs_tol=1e-30)


@pytest.mark.thorough
def test_the_chiefs_orbit_may_be_random() -> None:
    orbit = {"deputy.eccentricity": [0.1, 0.3], "deputy.true_anomaly": [0.0, 3.0]}
    env = jaxsafe.make("docking2d", {"deputy.type": "two_body"}, randomize=orbit)
    states, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 8))
    anomaly = states.sim.platforms["deputy"].true_anomaly
    np.testing.assert_allclose(anomaly, states.parameters["deputy.true_anomaly"], rtol=1e-6)
    assert len(set(anomaly.tolist())) == 8
    later, _ = jax.vmap(jaxsafe.step, in_axes=(None, 0, None))(env, states, jnp.zeros(2))
    e = states.parameters["deputy.eccentricity"]
    rate = MEAN_MOTION * (1.0 + e * jnp.cos(anomaly)) ** 2 / (1.0 - e**2) ** 1.5
    np.testing.assert_allclose(
        later.sim.platforms["deputy"].true_anomaly - anomaly, rate, rtol=2e-3
    )
