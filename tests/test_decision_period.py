"""An agent that acts on every k-th step of the world."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe.environment import Environment, longest_episode
from jaxsafe.metrics import accumulate, begin
from jaxsafe.types import State, TimeStep

PERIOD = 4
step = jax.jit(jaxsafe.step)
FAST = {"deputy": {"position": [100.0, 0.0], "velocity": [-0.38, 0.0]}}
"""A start close below the speed limit. Full thrust towards the chief breaks it."""


@cache
def make(period: int, **options: Any) -> Environment:
    overrides = {"decision_period": period, "terminal.timeout.limit": 8.0}
    return jaxsafe.make("docking2d", overrides, **options)


def one_by_one(
    env: Environment, state: State, action: jax.Array, count: int
) -> tuple[State, list[TimeStep]]:
    """Take an action for some steps of the world, at most until the episode ends."""
    timesteps: list[TimeStep] = []
    while len(timesteps) < count and not (timesteps and timesteps[-1].done):
        state, timestep = step(env, state, action)
        timesteps.append(timestep)
    return state, timesteps


@pytest.mark.parametrize("rta", ["none", thorough("default")])
def test_a_decision_is_its_steps_of_the_world(rta: str) -> None:
    env, world = make(PERIOD, rta=rta), make(1, rta=rta)
    action = jnp.array([-1.0, 0.3])
    state, _ = jaxsafe.reset_to(env, FAST)
    expected = state
    # The last decision ends after one step, because the time limit is passed then.
    for count in (PERIOD, PERIOD, 1):
        state, timestep = step(env, state, action)
        expected, taken = one_by_one(world, expected, action, PERIOD)
        assert len(taken) == count
        # An h and a reward are differences of larger numbers, and the programs round differently.
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=3e-7), state, expected
        )
        stacked: Any = jax.tree.map(lambda *x: np.stack(x), *taken)
        check_sums(timestep, stacked)
    assert timestep.terminated
    assert env.outcomes[int(timestep.info.outcome)] == "timeout"
    assert (int(state.num_steps), float(state.sim.time)) == (9, 9.0)


def check_sums(timestep: TimeStep, taken: Any) -> None:
    """Compare a decision with its steps of the world, stacked."""
    info, of_steps = timestep.info, taken.info
    last = jax.tree.map(lambda x: x[-1], taken)
    expected = {
        "reward": (timestep.reward, taken.reward.sum()),
        "cost": (timestep.cost, taken.cost.max()),
        "costs": (timestep.costs, {name: x.max() for name, x in taken.costs.items()}),
        "observation": (timestep.observation, last.observation),
        "done": (timestep.done, last.done),
        "outcome": (info.outcome, last.info.outcome),
        "status": (
            info.status,
            last.info.status
            | {name: of_steps.status[name].sum() for name in ("delta_v", "delta_v_l1")},
        ),
        "terms": (info.reward_terms, {name: x.sum() for name, x in of_steps.reward_terms.items()}),
        "totals": (info.reward_totals, last.info.reward_totals),
        "desired": (info.control_desired, last.info.control_desired),
        "actual": (info.control_actual, of_steps.control_actual.mean(axis=0)),
        "intervening": (info.intervening, of_steps.intervening.any()),
        "margins": (info.margins, {name: x.min() for name, x in of_steps.margins.items()}),
        "severity": (info.severity, {name: x.max() for name, x in of_steps.severity.items()}),
    }
    if info.rta is not None:
        rta = of_steps.rta
        expected |= {
            "correction": (info.rta.correction, rta.correction.max()),
            "feasible": (info.rta.feasible, rta.feasible.all()),
            "certified": (info.rta.certified, rta.certified.all()),
            "predicted": (info.rta.predicted_margin, rta.predicted_margin.min()),
            "constraint": (info.rta.constraint, [-1, *rta.constraint[rta.constraint >= 0]][-1]),
        }
    for name, (found, wanted) in expected.items():
        jax.tree.map(
            lambda a, b, name=name: np.testing.assert_allclose(
                a, b, rtol=1e-5, atol=1e-6, err_msg=name
            ),
            found,
            wanted,
        )


@pytest.mark.thorough
def test_the_filter_acts_within_a_decision() -> None:
    action = jnp.array([-1.0, 0.0])
    for rta, cost in (("none", 1.0), ("explicit_simplex", 0.0)):
        env = make(PERIOD, rta=rta)
        state, _ = jaxsafe.reset_to(env, FAST)
        _, timestep = step(env, state, action)
        assert float(timestep.cost) == cost
        assert bool(timestep.info.intervening) == (rta != "none")


def test_an_agent_that_acts_on_every_step_needs_no_loop() -> None:
    env = make(1)
    state, _ = jaxsafe.reset(env, jax.random.key(0))
    assert "scan" not in str(jax.make_jaxpr(jaxsafe.step)(env, state, jnp.zeros(2)))
    env = make(PERIOD)
    assert "scan" in str(jax.make_jaxpr(jaxsafe.step)(env, state, jnp.zeros(2)))


def test_the_fuel_of_an_episode_is_that_of_all_steps() -> None:
    env = make(PERIOD)
    state, timestep = jaxsafe.reset_to(env, FAST)
    episode = begin(timestep)
    for _ in range(2):
        state, timestep = step(env, state, jnp.array([1.0, 0.0]))
        episode = accumulate(episode, timestep)
    assert int(episode.length) == 2
    np.testing.assert_allclose(episode.delta_v, 8 / 12, rtol=1e-5)  # 8 s of 1 N at 12 kg


def test_the_longest_episode_is_counted_in_actions() -> None:
    assert longest_episode(make(1)) == 10
    assert longest_episode(make(PERIOD)) == 3


def test_an_environment_says_for_how_many_steps_an_action_is_held() -> None:
    assert "1 s a step, an action for 4 steps" in repr(make(PERIOD))
    with pytest.raises(jaxsafe.ConfigError, match="decision_period: expected a whole number ≥ 1"):
        make(0)


def test_a_decision_has_derivatives() -> None:
    env = make(PERIOD)
    state, _ = jaxsafe.reset_to(env, FAST)

    def speed(action: jax.Array) -> jax.Array:
        return jaxsafe.step(env, state, action)[0].sim.status["speed"]

    gradient = jax.jit(jax.grad(speed))(jnp.array([0.5, 0.5]))
    assert jnp.isfinite(gradient).all()
    assert jnp.abs(gradient).max() > 0.0
