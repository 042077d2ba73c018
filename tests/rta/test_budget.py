"""Constraints that rest on what a status remembers, such as a budget of Δv, in predictions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.processors import Accumulator, UpperLimit
from jaxsafe.rta import Slow
from jaxsafe.transition import with_memory
from jaxsafe.types import Sim

BUDGET = 0.5


class Quiet(Slow, type="of_tests_quiet"):
    """A terminal set of the tests, which a brake may keep whatever the constraints."""

    def faults(self, env: Any, sim: Sim, rta: Any) -> dict:
        return {}


def budgeted(**rta: Any) -> Environment:
    """Return docking2d with a budget of Δv that a filter keeps."""
    bare = jaxsafe.make("docking2d")
    return jaxsafe.make(
        "docking2d",
        {
            "status": [*bare.status, Accumulator(name="used", status="delta_v")],
            "constraints": [UpperLimit(name="budget", status="used", maximum=BUDGET)],
            "rta": {
                "type": "simplex",
                "constraints": ["budget"],
                "margin": 0.01,
                "backups": [{"type": "coast", "name": "coast"}],
            }
            | rta,
        },
    )


@pytest.mark.thorough
def test_a_filter_keeps_a_budget_to_its_end() -> None:
    row = attack(budgeted(), "accelerate", 40, 4, jax.random.key(0))
    assert row["violating_steps"] == row["violating_steps_inside"] == 0
    assert row["uncertified_steps"] == 0
    assert 0.01 <= row["worst_margin"] < 0.01 + np.sqrt(2.0) / 12.0
    assert row["intervention_rate"] > 0.5


BRAKE = {
    "backups": [{"type": "brake", "name": "brake"}],
    "terminal": {"type": "of_tests_quiet", "speed": 0.1},
    "horizon": 4,
}


def test_a_prediction_goes_on_from_what_a_status_remembers() -> None:
    """The least h on the predicted way of a backup is what the backup flies, from any step on."""
    env = budgeted(**BRAKE)
    rta = env.rta
    assert rta is not None
    start = {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, 0.3]}}
    state, _ = jaxsafe.reset_to(env.replace(rta=None), start)
    bare_step = jax.jit(jaxsafe.step)
    for _ in range(3):
        state, timestep = bare_step(env.replace(rta=None), state, jnp.array([0.0, -0.2]))
    sim = with_memory(env, state.sim, state.memory.status)
    predicted = jax.jit(lambda env, sim: env.rta.follow(env, sim, sim).margins)(env, sim)[0, 0]
    for _ in range(4):
        control = rta.backups[0].control(env, state.sim, {})
        state, timestep = bare_step(env.replace(rta=None), state, jnp.clip(control, -1.0, 1.0))
    np.testing.assert_allclose(predicted, timestep.info.margins["budget"], rtol=1e-5)
    assert predicted < BUDGET - 0.25


def test_the_state_of_an_environment_without_a_budget_gains_nothing() -> None:
    env = jaxsafe.make("rejoin2d", rta="default")
    state = jax.eval_shape(jaxsafe.reset, env, jax.random.key(0))[0]
    assert state.sim.remembered == {}
    assert state.memory.rta.remembered_ahead == {}
    assert with_memory(env, state.sim, state.memory.status).remembered == {}
    state = jax.eval_shape(jaxsafe.reset, budgeted(**BRAKE), jax.random.key(0))[0]
    assert state.sim.remembered == {}
    assert list(state.memory.rta.remembered_ahead) == ["used"]


def test_a_set_that_stays_safe_only_without_memory_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^rta: at_rest .* without memory, and 'used' has one"):
        budgeted(**BRAKE | {"terminal": {"type": "at_rest"}})
