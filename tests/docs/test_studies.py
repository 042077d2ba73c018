"""The parts and the plan of the studies in `examples/studies`."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe

STUDIES = Path(__file__).parents[2] / "examples" / "studies"
PUBLISHED = STUDIES / "published_docking"

FAST = {"deputy": {"position": [100.0, 0.0], "velocity": [-0.38, 0.1]}}
"""A start at 0.393 m/s. The limit there is 0.405 m/s."""


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> None:
    for directory in (STUDIES, PUBLISHED):
        monkeypatch.syspath_prepend(str(directory))


def published(filter_type: str) -> Any:
    overrides = {} if filter_type == "none" else {"rta": {"type": filter_type}}
    return jaxsafe.make(str(PUBLISHED / "published_docking.yaml"), overrides)


def test_there_are_eighteen_ways_of_training(modules: None) -> None:
    import training_with_rta  # pyright: ignore[reportMissingImports]

    assert len({way.name for way in training_with_rta.WAYS}) == 18


def test_the_plant_is_that_of_the_study(modules: None) -> None:
    env = published("none")
    state, _ = jaxsafe.reset_to(env, FAST)
    _, timestep = jaxsafe.step(env, state, jnp.array([0.5, -1.0]))
    n = 0.001027
    acceleration = np.array([2 * n * 0.1 + 3 * n**2 * 100.0 + 0.5 / 12, -2 * n * -0.38 - 1 / 12])
    velocity = np.array([-0.38, 0.1]) + acceleration
    expected = [*(np.array([100.0, 0.0]) + velocity), *velocity]
    np.testing.assert_allclose(timestep.observation, expected, rtol=1e-6)


@pytest.mark.parametrize(
    "filter_type",
    [
        "published_explicit_simplex",
        "published_implicit_simplex",
        "published_explicit_asif",
        "published_implicit_asif",
    ],
)
def test_a_published_filter_acts_before_the_limit_alone(modules: None, filter_type: str) -> None:
    env = published(filter_type)
    step = jax.jit(jaxsafe.step)
    state, _ = jaxsafe.reset_to(env, FAST)
    _, timestep = step(env, state, jnp.array([-1.0, 0.0]))
    assert timestep.info.intervening
    assert float(timestep.info.control_actual[0]) > -1.0
    assert float(timestep.info.margins["velocity_limit"]) > -1e-4
    # Slowly and against the motion nothing is changed.
    state, _ = jaxsafe.reset_to(env, {"deputy": {**FAST["deputy"], "velocity": [-0.05, 0.0]}})
    _, timestep = step(env, state, jnp.array([0.1, 0.0]))
    assert not timestep.info.intervening


def test_explicit_switching_scales_the_velocity_onto_the_limit(modules: None) -> None:
    env = published("published_explicit_simplex")
    rta = env.rta
    own = (jnp.array([100.0, 0.0]), jnp.array([-0.38, 0.1]))
    control, _ = rta.act(env, *own, jnp.array([-1.0, 0.0]))
    position, velocity = rta.after(env, *own, control)
    assert abs(float(rta.h(position, velocity))) < 1e-6
    _, desired_velocity = rta.after(env, *own, jnp.array([-1.0, 0.0]))
    across = velocity[0] * desired_velocity[1] - velocity[1] * desired_velocity[0]
    assert abs(float(across)) < 1e-6


def test_the_reward_of_a_step_is_that_of_the_study(modules: None) -> None:
    env = published("none")
    state, _ = jaxsafe.reset_to(
        env, {"deputy": {"position": [1000.0, 0.0], "velocity": [0.1, 0.0]}}
    )
    _, timestep = jaxsafe.step(env, state, jnp.zeros(2))
    distance, speed = (float(timestep.info.status[name]) for name in ("distance", "speed"))
    progress = (-1.0 + 1000.0 - distance) / 2000.0
    too_slow = -0.0075 * abs(speed - (0.5 * 0.001027 * distance - 0.2))
    expected = progress + too_slow - 0.0025
    assert float(timestep.reward) == pytest.approx(expected, rel=1e-3)
