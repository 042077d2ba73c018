"""Each step of the ladder of models leads to the one below it in a limit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from platform_models import MODELS, random_controls, random_state

from jaxsafe.schema.component import normalise
from jaxsafe.simulation import (
    DoubleIntegrator,
    Dubins2D,
    Dubins3D,
    LaggedDubins2D,
    LaggedDubins3D,
    OrientedSpacecraft,
    PointMassAircraft,
    ReactionWheelSpacecraft,
    Spacecraft,
)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.usefixtures("x64")
def test_a_spacecraft_without_an_orbit_is_a_double_integrator(dimension: int) -> None:
    model = MODELS[f"double_integrator {dimension}D"]
    rng = np.random.default_rng(1)
    state, controls = random_state(model, rng), random_controls(model, rng)
    drifting = normalise(Spacecraft(name="own", dimension=dimension, mean_motion=0.0))
    plain = normalise(DoubleIntegrator(name="own", dimension=dimension))
    moved = [platform.step(state, controls, jnp.asarray(3.0)) for platform in (drifting, plain)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), *moved)


@pytest.mark.parametrize(
    ("kind", "lagged"),
    [
        (
            Dubins2D(name="own"),
            LaggedDubins2D(name="own", heading_rate_lag=1e-3, acceleration_lag=1e-3),
        ),
        (
            Dubins3D(name="own"),
            LaggedDubins3D(
                name="own",
                roll_rate_lag=1e-3,
                flight_path_angle_rate_lag=1e-3,
                acceleration_lag=1e-3,
            ),
        ),
    ],
    ids=["plane", "space"],
)
@pytest.mark.parametrize("speed", [300.0, 395.0])
@pytest.mark.usefixtures("x64")
def test_without_lag_it_is_dubins_model(kind: Dubins2D, lagged: Dubins2D, speed: float) -> None:
    model = MODELS["dubins2d" if type(kind) is Dubins2D else "dubins3d"]
    rng = np.random.default_rng(2)
    state, controls = random_state(model, rng), random_controls(model, rng)
    controls["acceleration"] = jnp.asarray(9.0)
    state = state.replace(speed=jnp.asarray(speed))
    expected = normalise(kind).step(state, controls, jnp.asarray(1.0))
    aircraft = normalise(lagged)
    still = aircraft.rest().replace(**vars(state))
    found = aircraft.step(still, controls, jnp.asarray(1.0))
    for name, value in vars(expected).items():
        atol = 0.1 if name == "position" else 1e-2 if name == "speed" else 5e-4
        np.testing.assert_allclose(getattr(found, name), value, atol=atol, err_msg=name)


@pytest.mark.usefixtures("x64")
def test_a_rate_that_turns_round_leaves_a_limit_at_once() -> None:
    aircraft = normalise(LaggedDubins2D(name="own", acceleration_lag=0.5))
    state = aircraft.rest().replace(speed=jnp.asarray(399.0), acceleration=jnp.asarray(10.0))
    controls = {"acceleration": jnp.asarray(-10.0)}

    speed = 399.0
    acceleration = 10.0
    count = 200_000
    for _ in range(count):  # Euler's method with the limit
        speed = min(400.0, speed + acceleration / count)
        acceleration += (-10.0 - acceleration) / 0.5 / count
    found = aircraft.step(state, controls, jnp.asarray(1.0))
    assert 390.0 < speed < 400.0
    np.testing.assert_allclose(found.speed, speed, atol=1e-3)
    np.testing.assert_allclose(found.acceleration, acceleration, atol=1e-3)


@pytest.mark.usefixtures("x64")
def test_an_aircraft_that_holds_speed_and_climb_is_dubins_model() -> None:
    model = MODELS["dubins3d"]
    rng = np.random.default_rng(3)
    state = random_state(model, rng)
    controls = {"roll_rate": jnp.asarray(0.1)}
    powerful = normalise(
        PointMassAircraft(name="own", thrust_limits=(-1e5, 1e5), largest_lift=100.0, substeps=8)
    )
    found = powerful.step(state, controls, jnp.asarray(1.0))
    expected = normalise(Dubins3D(name="own")).step(state, controls, jnp.asarray(1.0))
    for name, value in vars(expected).items():
        np.testing.assert_allclose(getattr(found, name), value, rtol=1e-6, atol=1e-6, err_msg=name)


@pytest.mark.usefixtures("x64")
def test_an_aircraft_follows_the_controls_of_dubins_model() -> None:
    state = random_state(MODELS["dubins3d"], np.random.default_rng(4))
    state = state.replace(flight_path_angle=jnp.asarray(0.1), speed=jnp.asarray(300.0))
    controls = {
        "roll_rate": jnp.asarray(-0.1),
        "flight_path_angle_rate": jnp.asarray(0.05),
        "acceleration": jnp.asarray(-20.0),
    }
    powerful = normalise(
        PointMassAircraft(name="own", thrust_limits=(-1e5, 1e5), largest_lift=100.0, substeps=8)
    )
    found = powerful.step(state, controls, jnp.asarray(1.0))
    expected = normalise(Dubins3D(name="own")).step(state, controls, jnp.asarray(1.0))
    for name in ("speed", "flight_path_angle", "roll"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-9)


def test_thrust_lift_and_drag_have_their_limits() -> None:
    aircraft = normalise(PointMassAircraft(name="own"))
    level = aircraft.rest().replace(speed=jnp.asarray(300.0))
    rates = lambda **controls: aircraft.derivative(level, controls)  # noqa: E731
    full = rates(thrust=jnp.asarray(1e6))
    assert full.speed == rates(thrust=jnp.asarray(2050.0)).speed
    idle = rates(thrust=jnp.asarray(0.0))
    assert idle.speed < 0.0 < full.speed
    lifting = 0.5 * 0.001756 * 300.0**2 * 184.0
    most = lifting * 1.4 / 6600.0
    pulled = rates(load_factor=jnp.asarray(9.0))
    np.testing.assert_allclose(pulled.flight_path_angle, -32.17 / 300.0 * (most - 1.0), rtol=1e-5)
    drag = lifting * (0.02 + 0.064 * (6600.0 / lifting) ** 2)
    np.testing.assert_allclose(idle.speed, -32.17 * drag / 6600.0, rtol=1e-5)


@pytest.mark.usefixtures("x64")
def test_the_wheel_turns_the_body_as_its_acceleration_does() -> None:
    wheeled = normalise(ReactionWheelSpacecraft(name="own"))
    oriented = normalise(OrientedSpacecraft(name="own"))
    ratio = 0.0573 / 4.1e-5
    dt = jnp.asarray(1.0)
    moved = wheeled.rest()
    expected = oriented.rest()
    for wheel in (10.0, -24.0, 24.0, 24.0, 24.0, 24.0):  # the last ones reach the rate's limit
        thrust = {"thrust": jnp.asarray(0.5)}
        moved = wheeled.step(moved, {**thrust, "wheel_acceleration": jnp.asarray(wheel)}, dt)
        turn = {**thrust, "attitude_acceleration": jnp.asarray(-wheel / ratio)}
        expected = oriented.step(expected, turn, dt)
    for name, value in vars(expected).items():
        np.testing.assert_allclose(getattr(moved, name), value, rtol=1e-12, err_msg=name)
    assert moved.attitude_rate == -jnp.pi / 90.0
    by_turn = wheeled.rest()
    for wheel in (10.0, -24.0, 24.0, 24.0, 24.0, 24.0):
        turn = {"thrust": jnp.asarray(0.5), "attitude_acceleration": jnp.asarray(-wheel / ratio)}
        by_turn = wheeled.step(by_turn, turn, dt)
    np.testing.assert_allclose(by_turn.wheel_speed, moved.wheel_speed, rtol=1e-12)
    momentum = 0.0573 * moved.attitude_rate + 4.1e-5 * moved.wheel_speed
    np.testing.assert_allclose(momentum, 0.0, atol=1e-15)


def test_a_saturated_wheel_turns_the_body_no_further() -> None:
    wheeled = normalise(ReactionWheelSpacecraft(name="own", wheel_speed_limits=(-30.0, 30.0)))
    step = jax.jit(wheeled.step)
    state = wheeled.rest()
    for _ in range(4):
        state = step(state, {"wheel_acceleration": jnp.asarray(20.0)}, jnp.float32(1.0))
    assert state.wheel_speed == 30.0
    np.testing.assert_allclose(state.attitude_rate, -30.0 * 4.1e-5 / 0.0573, rtol=1e-6)
    back = step(state, {"wheel_acceleration": jnp.asarray(-20.0)}, jnp.float32(1.0))
    np.testing.assert_allclose(back.wheel_speed, 10.0, rtol=1e-5)
