"""Filters without an environment: they do what those of an environment do."""

import runpy
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe import ConfigError
from jaxsafe.rta import Barrier, Plant, Polynomial, filter_by_asif, filter_by_simplex

EXAMPLE = Path(__file__).parents[2] / "examples" / "rta_own_simulator.py"


def states(env: jaxsafe.Environment, count: int) -> Any:
    """Return states of docking2d near the speed limit, and desired thrusts."""
    rng = np.random.default_rng(0)
    way, course = rng.normal(size=(2, count, 2))
    distance = rng.uniform(20.0, 150.0, count)
    speed = (0.2 + 0.002054 * distance) * rng.uniform(0.9, 0.999, count)

    def unit(vectors: np.ndarray) -> np.ndarray:
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    start = {
        "position": jnp.asarray(distance[:, None] * unit(way)),
        "velocity": jnp.asarray(speed[:, None] * unit(course)),
    }
    state, _ = jax.vmap(lambda fields: jaxsafe.reset_to(env, {"deputy": fields}))(start)
    return state, jnp.asarray(rng.uniform(-1.0, 1.0, (count, 2)), jnp.float32)


def speed_left(x: Any) -> jax.Array:
    return 0.2 + 0.002054 * jnp.linalg.norm(x.position) - jnp.linalg.norm(x.velocity)


@pytest.mark.parametrize("preset", [thorough("explicit_simplex"), "explicit_asif"])
def test_a_filter_by_itself_acts_as_that_of_an_environment(preset: str) -> None:
    env = jaxsafe.make("docking2d", rta=preset)
    state, desired = states(env, 50)
    plant = Plant.of(env.agent_platform, env.dt)

    def alone(state: Any, desired: jax.Array) -> Any:
        x = state.sim.platforms["deputy"]
        if preset == "explicit_asif":
            barrier = Barrier(h=speed_left, alpha=Polynomial(linear=0.05, cubic=0.1).of)
            return filter_by_asif(plant, [barrier], x, desired)

        def brake(x: Any) -> jax.Array:
            sim = state.sim.replace(platforms={**state.sim.platforms, "deputy": x})
            return env.rta.backups[0].control(env, sim, {})

        barrier = Barrier(h=speed_left, margin=env.rta.margin)
        return filter_by_simplex(plant, [barrier], x, desired, backup=brake)

    def inside(state: Any, desired: jax.Array) -> Any:
        control, _, info = env.rta.filter(env, state.sim, state.memory.rta, desired)
        return control, info

    def both(state: Any, desired: jax.Array) -> Any:
        return alone(state, desired), inside(state, desired)

    (control, info), (expected, expected_info) = jax.jit(jax.vmap(both))(state, desired)
    np.testing.assert_allclose(control, expected, atol=2e-5)
    assert 5 < (info.constraint == 0).sum() < 45
    np.testing.assert_array_equal(info.constraint, expected_info.constraint)
    np.testing.assert_allclose(info.correction, expected_info.correction, atol=2e-5)
    if preset == "explicit_simplex":
        np.testing.assert_array_equal(info.certified, expected_info.certified)


def test_the_example_avoids_its_obstacle_with_either_filter() -> None:
    example = runpy.run_path(str(EXAMPLE))
    assert example["fly"]()[0] < -1.0
    for control_filter in (example["by_asif"], example["by_simplex"]):
        nearest, fastest, altered = example["fly"](control_filter)
        assert nearest > 0.0
        assert fastest < 1.51
        assert 0.0 < altered < 1.0


def move(x: jax.Array, u: jax.Array) -> jax.Array:
    return x + u


def test_a_vector_and_a_map_are_enough() -> None:
    """The controls are those of a NumPy simulator, in double precision and not finite too."""
    plant = Plant(low=-1.0, high=1.0, step=move)
    x = np.array([0.5, 0.0])

    def room(x: jax.Array) -> jax.Array:
        return 1.0 - x[0]

    def back(x: jax.Array) -> jax.Array:
        return jnp.array([-5.0, 0.0])  # is brought to −1

    for desired, expected, cause in (
        ([0.2, 0.3], [0.2, 0.3], -1),
        ([0.9, 0.3], [-1.0, 0.0], 0),
        ([np.nan, 0.3], [-1.0, 0.0], -1),
    ):
        control, info = filter_by_simplex(plant, [room], x, np.array(desired), backup=back)
        np.testing.assert_allclose(control, expected, rtol=1e-6)
        assert info.constraint == cause
        assert info.certified


def test_what_is_missing_is_told_in_one_line() -> None:
    x = jnp.zeros(2)
    plant = Plant(low=-1.0, high=1.0, step=move)
    with pytest.raises(ConfigError, match=r"^filter_by_asif: the plant needs a `derivative`$"):
        filter_by_asif(plant, [jnp.sum], x, x)
    with pytest.raises(ConfigError, match=r"^filter_by_simplex: a horizon needs a terminal set"):
        filter_by_simplex(plant, [jnp.sum], x, x, backup=lambda x: x, horizon=3)
    with pytest.raises(ConfigError, match=r"^constraints: expected a list of functions h"):
        filter_by_simplex(plant, [], x, x, backup=lambda x: x)
    chief = jaxsafe.make("docking2d").platform("chief")
    with pytest.raises(ConfigError, match=r"^platforms\.chief\.controller: expected actuators"):
        Plant.of(chief, 1.0)
    late = jaxsafe.make("docking2d", {"deputy.controller.actuators.thrust_x.time_constant": 1.0})
    with pytest.raises(ConfigError, match=r"thrust_x: expected an actuator that acts at once"):
        Plant.of(late.platform("deputy"), 1.0)
    with pytest.raises(ConfigError, match=r"^Plant\.of: expected a platform, such as env\.agent_"):
        Plant.of(jaxsafe.make("docking2d"), 1.0)  # type: ignore[arg-type]


def slide(x: jax.Array, u: jax.Array) -> jax.Array:
    return jnp.concatenate([x[1:], u])


def height(x: jax.Array) -> jax.Array:
    return x[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"constraints": height}, "constraints: expected a list of .*, found <function height"),
        ({"constraints": [jnp.sin]}, r"constraints: 0: h: expected one real .*float32\[2\]$"),
        ({"constraints": [lambda x: x[0] > 0]}, r"constraints: 0: h: .* number, found bool\[\]$"),
        ({"constraints": [height, Barrier(h=height, degree=0)]}, "constraints: 1: degree: expec"),
        (
            {"constraints": [Barrier(h=height, alpha=Polynomial(linear=1.0))]},  # type: ignore
            r"constraints: 0: alpha: expected a function, such as Polynomial\(linear=0\.1\)\.of",
        ),
        ({"u": 1.0}, r"filter_by_asif: control: expected shape \(m,\), found \(\)$"),
        ({"u": jnp.ones((5, 1))}, r"found \(5, 1\); for a batch, write jax.vmap around it$"),
        ({"low": [-1.0, -1.0]}, r"plant: low: expected a number or shape \(1,\) .* \(2,\)$"),
        ({"low": 2.0}, "plant: low: 2.0 is above high, 1.0$"),
        (
            {"derivative": lambda x, u: u},
            r"plant: derivative: expected the form of the state, float32\[2\], found float32\[1\]$",
        ),
    ],
)
def test_a_function_or_control_of_another_form_is_refused(
    changes: dict[str, Any], message: str
) -> None:
    given = {"low": -1.0, "derivative": slide, "constraints": [height], "u": jnp.ones(1), **changes}
    plant = Plant(low=given["low"], high=1.0, derivative=given["derivative"], step=slide)
    with pytest.raises(ConfigError, match=message):
        filter_by_asif(plant, given["constraints"], jnp.ones(2), given["u"])


def test_a_backup_or_step_of_another_form_is_refused() -> None:
    plant = Plant(low=-1.0, high=1.0, step=lambda x, u: u)
    with pytest.raises(ConfigError, match=r"^plant: step: expected the form of the state"):
        filter_by_simplex(plant, [height], jnp.ones(2), jnp.ones(1), backup=lambda x: x[:1])
    plant = Plant(low=-1.0, high=1.0, step=slide)
    with pytest.raises(
        ConfigError, match=r"^filter_by_simplex: backup: expected the form of the c"
    ):
        filter_by_simplex(plant, [height], jnp.ones(2), jnp.ones(1), backup=lambda x: x)
