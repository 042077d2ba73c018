"""Aircraft with a lag, or with lift and drag, against solutions of their equations by DOP853.

The equations are written here anew, in NumPy. They are Eqs. (5) and (9) with τu̇ = command − u, and
those of Vinh: Flight Mechanics of High-Performance Aircraft, 1993. At a limit a state rests until
its rate leads back.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxsafe.schema.component import normalise
from jaxsafe.simulation import LaggedDubins2D, LaggedDubins3D, PointMassAircraft

G = 32.17
LIMITS = {
    "speed": (200.0, 400.0),
    "flight_path_angle": (-np.pi / 9, np.pi / 9),
    "roll": (-np.pi / 3, np.pi / 3),
}
NUM = 24
LONGEST = 0.02
"""Longest step of the oracle [s]. Within it no state reaches a limit and leaves it again."""

Slope = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""The rate of change of a state under some controls, both as vectors."""


def flow(
    slope: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    limits: Mapping[int, tuple[float, float]],
    time: float,
) -> np.ndarray:
    """Return the state after some time.

    The integration stops where a state reaches a limit, or leaves one, and goes on from there.

    Args:
        slope: the rate of change of a state where no limit is reached.
        start: the state at time 0.
        limits: the lowest and the highest value of some elements of the state, by index.
        time: the time.
    """
    state = start.copy()
    now = 0.0
    while now < time:
        rates = slope(state)
        side = {
            i: np.sign(rates[i])
            for i, (low, high) in limits.items()
            if (state[i] >= high and rates[i] > 1e-12) or (state[i] <= low and rates[i] < -1e-12)
        }

        def moving(_: float, y: np.ndarray, side: Mapping[int, float] = side) -> np.ndarray:
            rates = slope(y)
            rates[[*side]] = 0.0
            return rates

        def event(function: Any, direction: float) -> Any:
            function.terminal = True
            function.direction = direction
            return function

        events, reached = [], []
        for i, (low, high) in limits.items():
            if i in side:
                events.append(event(lambda _, y, i=i: slope(y)[i], -side[i]))
                reached.append((i, state[i]))
                continue
            for bound, direction in ((low, -1.0), (high, 1.0)):
                events.append(event(lambda _, y, i=i, bound=bound: y[i] - bound, direction))
                reached.append((i, bound))
        solved = solve_ivp(
            moving,
            (now, time),
            state,
            method="DOP853",
            events=events,
            max_step=LONGEST,
            rtol=1e-13,
            atol=1e-11,
        )
        state = solved.y[:, -1].copy()
        now = solved.t[-1]
        for (i, bound), times in zip(reached, solved.t_events, strict=True):
            if times.size:
                state[i] = bound
    return state


def lagged_2d(state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Eq. (5) for [x, y, ψ, v, ψ̇, v̇] under [heading rate, acceleration]."""
    _, _, psi, v, turn, push = state
    lag = [(command[0] - turn) / 0.5, (command[1] - push) / 1.0]
    return np.array([v * np.cos(psi), v * np.sin(psi), turn, push, *lag])


def lagged_3d(state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Eq. (9) for [x, y, z, ψ, v, γ, φ, φ̇, γ̇, v̇] under [roll rate, rate of γ, acceleration]."""
    _, _, _, psi, v, gamma, phi, rolling, climbing, push = state
    ahead = v * np.cos(gamma)
    way = [ahead * np.cos(psi), ahead * np.sin(psi), -v * np.sin(gamma)]
    lag = (command - np.array([rolling, climbing, push])) / np.array([0.3, 0.5, 1.0])
    return np.array([*way, G / v * np.tan(phi), push, climbing, rolling, *lag])


def point_mass(state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Vinh's equations for [x, y, z, ψ, v, γ, φ] under [thrust, load factor, roll rate].

    κ is the flight path angle that is positive in a climb.
    """
    _, _, _, psi, v, gamma, phi = state
    thrust, load, rolling = command
    kappa = -gamma
    weight = 6600.0
    pressure_area = 0.5 * 0.001756 * v**2 * 184.0
    largest = 1.4 * pressure_area / weight
    n = np.clip(load, max(-2.5, -largest), min(6.0, largest))
    lift_coefficient = n * weight / pressure_area
    drag = pressure_area * (0.02 + 0.064 * lift_coefficient**2)
    thrust = np.clip(thrust, 0.0, 2050.0)
    ahead = v * np.cos(kappa)
    return np.array(
        [
            ahead * np.cos(psi),
            ahead * np.sin(psi),
            v * np.sin(kappa),
            G * n * np.sin(phi) / (v * np.cos(kappa)),
            G * (thrust - drag) / weight - G * np.sin(kappa),
            -G / v * (n * np.cos(phi) - np.cos(kappa)),
            rolling,
        ]
    )


NAMES_2D = ("heading", "speed", "heading_rate", "acceleration")
NAMES_3D = ("heading", "speed", "flight_path_angle", "roll")
NAMES_LAGGED_3D = (*NAMES_3D, "roll_rate", "flight_path_angle_rate", "acceleration")
SIZES = {
    "heading_rate": 0.17,
    "roll_rate": 0.17,
    "flight_path_angle_rate": 0.09,
    "acceleration": 60.0,
}
COMMANDS = {
    "heading_rate": (-0.17, 0.17),
    "roll_rate": (-0.17, 0.17),
    "flight_path_angle_rate": (-0.09, 0.09),
    "acceleration": (-96.5, 96.5),
    "thrust": (-200.0, 2300.0),
    "load_factor": (-2.0, 4.0),
}


def samples(
    names: tuple[str, ...], inputs: tuple[str, ...], near_limits: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Draw states [n, d] and commands [n, m].

    No state reaches a limit within a second, unless `near_limits` is true.
    """
    rng = np.random.default_rng(11)
    dimension = 2 if "roll" not in names else 3
    state = [*rng.uniform(-1e3, 1e3, (dimension, NUM))]
    for name in names:
        if name in LIMITS:
            low, high = LIMITS[name]
            inside = rng.uniform(0.8 * low + 0.2 * high, 0.2 * low + 0.8 * high, NUM)
            edge = rng.choice([low, high], NUM) * np.where(rng.random(NUM) < 0.5, 1.0, 0.995)
            state.append(np.clip(edge, low, high) if near_limits else inside)
        elif name == "heading":
            state.append(rng.uniform(-4.0, 4.0, NUM))
        else:
            size = SIZES[name] * (1.0 if near_limits else 0.5)
            state.append(rng.uniform(-size, size, NUM))
    commands = np.stack([rng.uniform(*COMMANDS[name], NUM) for name in inputs])
    if not near_limits:
        commands *= 0.5
    return np.stack(state).T, commands.T


def steps(
    aircraft: Any,
    names: tuple[str, ...],
    inputs: tuple[str, ...],
    states: np.ndarray,
    commands: np.ndarray,
    dt: float = 1.0,
) -> np.ndarray:
    """Return the states [n, d] after a step of the model."""
    platform = normalise(aircraft)
    rest = platform.rest()
    size = rest.position.size

    @jax.jit
    @jax.vmap
    def moved(state: jax.Array, command: jax.Array) -> jax.Array:
        fields = dict(zip(names, state[size:], strict=True))
        before = rest.replace(position=state[:size], **fields)
        after = platform.step(before, dict(zip(inputs, command, strict=True)), jnp.asarray(dt))
        return jnp.concatenate([after.position, jnp.stack([getattr(after, n) for n in names])])

    return np.asarray(moved(jnp.asarray(states), jnp.asarray(commands)))


def expected(
    slope: Slope, names: tuple[str, ...], states: np.ndarray, commands: np.ndarray
) -> np.ndarray:
    """Return the states [n, d] after a second by DOP853."""
    first = states.shape[1] - len(names)
    limits = {first + i: LIMITS[name] for i, name in enumerate(names) if name in LIMITS}
    return np.stack(
        [
            flow(lambda y, u=command: slope(y, u), state, limits, 1.0)
            for state, command in zip(states, commands, strict=True)
        ]
    )


LAGGED = {
    "plane": (LaggedDubins2D, lagged_2d, NAMES_2D, ("heading_rate", "acceleration")),
    "space": (
        LaggedDubins3D,
        lagged_3d,
        NAMES_LAGGED_3D,
        ("roll_rate", "flight_path_angle_rate", "acceleration"),
    ),
}
STEERED = ("thrust", "load_factor", "roll_rate")

BOUNDS = {(False, 2): (5e-5, 1e-3), (True, 2): (0.1, 5.0), (True, 64): (2e-4, 0.01)}
"""Bounds of the error of the position [ft]: with lag, and of the point mass.

They are by whether a limit is reached, and by `substeps`. docs/dynamics.md has the same.
"""


def test_the_page_has_these_bounds() -> None:
    page = (Path(__file__).parents[2] / "docs" / "dynamics.md").read_text(encoding="utf-8")
    row = r"where (no|a) limit is reached, (\d+) `substeps` \| ([\d.]+) ft \| ([\d.]+) ft"
    rows = {(a == "a", int(n)): (float(x), float(y)) for a, n, x, y in re.findall(row, page)}
    assert rows == BOUNDS


def test_the_flow_of_a_number_with_limits_is_known() -> None:
    """ÿ = −1 from y = 0.9 and ẏ = 0.5 reaches 1, rests until ẏ = 0, and falls by t²/2."""
    end = flow(lambda y: np.array([y[1], -1.0]), np.array([0.9, 0.5]), {0: (-1.0, 1.0)}, 2.0)
    np.testing.assert_allclose(end, [1.0 - 1.5**2 / 2.0, -1.5], atol=1e-10)


def errors(
    aircraft: Any, slope: Slope, names: tuple[str, ...], inputs: tuple[str, ...], near_limits: bool
) -> tuple[float, dict[str, float]]:
    """Return the largest error of the position, and that of each other field after a second."""
    states, commands = samples(names, inputs, near_limits)
    found = steps(aircraft, names, inputs, states, commands)
    size = states.shape[1] - len(names)
    largest = np.abs(found - expected(slope, names, states, commands)).max(axis=0)
    return largest[:size].max(), dict(zip(names, largest[size:], strict=True))


@pytest.mark.parametrize("kind", LAGGED)
@pytest.mark.usefixtures("x64")
def test_an_aircraft_with_lag_flies_as_its_equations_say(kind: str) -> None:
    model, slope, names, inputs = LAGGED[kind]
    quadratures = {"heading"} if kind == "space" else set()
    # Quadratures have order 6 where no limit is reached, and order 2 in a piece with a limit.
    for (near_limits, substeps), heading in zip(BOUNDS, (1e-7, 3e-4, 1e-6), strict=True):
        position, _ = BOUNDS[near_limits, substeps]
        aircraft = model(name="own", substeps=substeps)
        way, others = errors(aircraft, slope, names, inputs, near_limits)
        assert way < position
        assert all(others[name] < heading for name in quadratures)
        assert all(error < 1e-11 for name, error in others.items() if name not in quadratures)


@pytest.mark.usefixtures("x64")
def test_a_point_mass_flies_as_its_equations_say() -> None:
    fields = (NAMES_3D, STEERED)
    coarse, middle, fine = (
        errors(PointMassAircraft(name="own", substeps=substeps), point_mass, *fields, False)
        for substeps in (2, 4, 8)
    )
    assert coarse[0] < BOUNDS[False, 2][1]
    assert coarse[1]["speed"] < 3e-5
    assert max(coarse[1]["heading"], coarse[1]["flight_path_angle"]) < 1e-6
    assert coarse[0] / middle[0] == pytest.approx(2.0**4, rel=0.1)  # the order is 4
    assert middle[0] / fine[0] == pytest.approx(2.0**4, rel=0.1)
    for substeps, speed in ((2, 0.8), (64, 3e-4)):
        _, position = BOUNDS[True, substeps]
        aircraft = PointMassAircraft(name="own", substeps=substeps)
        way, others = errors(aircraft, point_mass, *fields, True)
        assert way < position
        assert others["speed"] < speed
        assert max(others["heading"], others["flight_path_angle"]) < position / 1000.0
