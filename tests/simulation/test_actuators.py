"""Actuators with a first-order lag and a rate limit: exact, part of the state, and predicted."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough
from scipy.integrate import solve_ivp

import jaxsafe
from jaxsafe.environment import Environment
from jaxsafe.rta.certificate import BackupController, TerminalSet
from jaxsafe.rta.simplex import Simplex
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.controllers import Actuator
from jaxsafe.transition import advance
from jaxsafe.types import Sim

LAG = {"deputy.controller.actuators.thrust_x.time_constant": 2.0}
RATE = {"deputy.controller.actuators.thrust_x.rate_limit": 0.1}


@pytest.mark.parametrize("time_constant", [None, 0.3, 5.0])
@pytest.mark.parametrize("rate_limit", [None, 0.4, 50.0])
@pytest.mark.parametrize(("value", "control"), [(-1.0, 0.8), (0.5, -0.2), (0.3, 0.3)])
@pytest.mark.usefixtures("x64")
def test_mean_and_end_of_a_step_are_those_of_the_equation(
    time_constant: float | None, rate_limit: float | None, value: float, control: float
) -> None:
    if time_constant is None and rate_limit is None:
        return
    actuator = normalise(
        Actuator(name="own", low=-1.0, high=1.0, time_constant=time_constant, rate_limit=rate_limit)
    )
    mean, end = actuator.follow(jnp.asarray(value), jnp.asarray(control), jnp.asarray(1.5))
    most = rate_limit or np.inf

    def slope(_: float, y: np.ndarray) -> list[float]:
        gap = control - y[0]
        # Without a lag the value is drawn to the control as fast as the rate allows.
        return [np.clip(gap / (time_constant or 1e-4), -most, most), y[0]]

    method = {"rtol": 1e-10, "atol": 1e-12, "method": "LSODA", "max_step": 0.01}
    expected = solve_ivp(slope, (0.0, 1.5), [value, 0.0], **method).y[:, -1]
    atol = 1e-7 if time_constant else 2e-4
    np.testing.assert_allclose(end, expected[0], atol=atol)
    np.testing.assert_allclose(mean, expected[1] / 1.5, atol=atol)


def test_tasks_have_no_state_for_actuators_that_act_at_once() -> None:
    state, _ = jax.eval_shape(jaxsafe.make("docking2d").reset, jax.random.key(0))
    assert state.sim.actuators == {}


def test_the_plant_receives_the_mean_of_what_the_actuator_gives() -> None:
    env = jaxsafe.make("docking1d", LAG)
    start = {"deputy": {"position": [100.0], "velocity": [0.0]}}
    state, _ = jaxsafe.reset_to(env, start)
    assert state.sim.actuators["thrust_x"] == 0.0
    state, timestep = jaxsafe.step(env, state, jnp.array([1.0]))
    decay = np.exp(-0.5)
    np.testing.assert_allclose(state.sim.actuators["thrust_x"], 1.0 - decay, rtol=1e-6)
    mean = 1.0 - 2.0 * (1.0 - decay)
    np.testing.assert_allclose(state.sim.platforms["deputy"].delta_v, [mean / 12.0], rtol=1e-6)
    assert timestep.info.control_actual == 1.0


def test_a_ramp_needs_its_time_and_starts_within_the_limits() -> None:
    path = "deputy.controller.actuators.thrust_x.low"
    env = jaxsafe.make("docking1d", {**RATE, path: 0.2})
    state, _ = env.reset(jax.random.key(0))
    assert state.sim.actuators["thrust_x"] == np.float32(0.2)
    step = jax.jit(jaxsafe.step)
    for _ in range(5):
        state, _ = step(env, state, jnp.array([1.0]))
    np.testing.assert_allclose(state.sim.actuators["thrust_x"], 0.7, rtol=1e-6)


@pytest.mark.thorough
def test_states_of_actuators_are_batched_and_differentiable() -> None:
    env = jaxsafe.make("docking1d", {**LAG, **RATE})

    def after(control: jax.Array) -> jax.Array:
        state, _ = jaxsafe.reset_to(env, {"deputy": {"position": [100.0], "velocity": [0.0]}})
        state, _ = jaxsafe.step(env, state, control[None])
        state, _ = jaxsafe.step(env, state, control[None])
        return state.sim.platforms["deputy"].velocity[0]

    slopes = jax.vmap(jax.grad(after))(jnp.array([0.0, 0.05, 1.0]))
    assert bool(jnp.isfinite(slopes).all())
    assert slopes[1] > 0.0
    assert slopes[2] == 0.0  # the rate limit alone decides


@pytest.mark.parametrize(
    ("task", "rta", "path", "part"),
    [
        ("docking1d", "default", "thrust_x.time_constant", "brake"),
        ("docking2d", "default", "thrust_y.rate_limit", "brake"),
        ("docking2d", "explicit_asif", "thrust_x.time_constant", "a barrier row"),
        thorough("docking2d_oriented", "default", "thrust.rate_limit", "align_and_brake"),
        ("rejoin2d", "default", "acceleration.time_constant", "velocity_matched"),
    ],
)
def test_a_filter_whose_proof_needs_immediate_actuators_says_so(
    task: str, rta: str, path: str, part: str
) -> None:
    agent = "wingman" if task.startswith("rejoin") else "deputy"
    name = path.partition(".")[0]
    message = (
        f"rta: .*{part} is proved for actuators that act at once, and {name} has a time_constant"
        " or a rate_limit$"
    )
    with pytest.raises(ConfigError, match=message):
        jaxsafe.make(task, {f"{agent}.controller.actuators.{path}": 0.5}, rta=rta)


class FullBrake(BackupController, type="full_brake_of_this_test"):
    """Thrust against the velocity, softly near rest."""

    def control(self, env: Environment, sim: Sim, later: Any) -> jax.Array:
        return -20.0 * sim.platforms[env.agent].velocity


class Creeping(TerminalSet, type="creeping_in_this_test"):
    """Speeds of 0.15 m/s at most."""

    def contains(self, env: Environment, sim: Sim) -> jax.Array:
        return jnp.abs(sim.platforms[env.agent].velocity[0]) <= 0.15


@pytest.mark.thorough
def test_a_prediction_moves_the_actuators_too() -> None:
    """The filter predicts what the environment then does, also many steps ahead."""
    rta = Simplex(
        constraints=("velocity_limit",),
        backups=(FullBrake(name="brake"),),
        horizon=12,
        terminal=Creeping(),
    )
    env = jaxsafe.make("docking1d", {**LAG, **RATE}, rta=rta)
    start = {"deputy": {"position": [100.0], "velocity": [0.3]}}
    state, _ = jaxsafe.reset_to(env, start)
    step = jax.jit(jaxsafe.step)
    intervened = False
    for _ in range(60):
        state, timestep = step(env, state, jnp.array([1.0]))
        intervened |= bool(timestep.info.intervening)
        assert timestep.info.margins["velocity_limit"] >= 0.0
        assert timestep.info.rta is not None
        np.testing.assert_allclose(
            timestep.info.rta.predicted_margin, timestep.info.margins["velocity_limit"], atol=1e-6
        )
    assert intervened
    # The end of the horizon is where the backup leads, with its actuators.
    ahead = state.memory.rta
    sim = state.sim
    assert env.rta is not None
    for _ in range(rta.horizon):
        control = jnp.clip(rta.backups[0].control(env, sim, {}), -1.0, 1.0)
        sim = advance(env, sim, control)
    velocities = [one.velocity for one in (ahead.ahead["deputy"], sim.platforms["deputy"])]
    np.testing.assert_allclose(*velocities, atol=1e-6)
    values = [one["thrust_x"] for one in (ahead.actuators_ahead, sim.actuators)]
    np.testing.assert_allclose(*values, atol=1e-6)


def test_a_lag_must_be_positive() -> None:
    with pytest.raises(ConfigError, match=re.escape("time_constant: expected a number in s > 0")):
        jaxsafe.make("docking1d", {"deputy.controller.actuators.thrust_x.time_constant": 0.0})
