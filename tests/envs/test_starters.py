"""docking1d: a small task to begin with, apart from the five of the paper."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind

import jaxsafe
from jaxsafe.envs import STARTERS, TASKS
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host.options import recipe_options, resolve_all


def test_starters_are_apart_from_the_tasks_of_the_paper() -> None:
    assert list(STARTERS) == ["docking1d"]
    assert not STARTERS.keys() & TASKS.keys()
    assert [name for _, _, name in resolve_all({"env": "all", "steps": 1e5})] == list(TASKS)
    assert "ppo.gamma" in recipe_options()
    with pytest.raises(ConfigError, match="a variant is for rejoin2d, rejoin3d"):
        jaxsafe.make("docking1d", variant="released")
    with pytest.raises(ConfigError, match=r"unknown task 'docking1'.*Did you mean 'docking1d'\?"):
        jaxsafe.make("docking1")


def test_docking1d_has_the_numbers_of_docking2d_on_a_line() -> None:
    line, plane = jaxsafe.make("docking1d"), jaxsafe.make("docking2d")
    assert line.outcomes == plane.outcomes
    assert line.reward == plane.reward
    assert line.status == plane.status
    assert line.terminal == plane.terminal
    assert line.constraints == plane.constraints
    assert line.observation_names == ("position", "velocity", "speed", "velocity_limit")
    assert line.agent_platform.mass == plane.agent_platform.mass
    assert line.actuators == plane.actuators[:1]


@pytest.mark.thorough
def test_a_line_has_two_directions_and_both_are_drawn() -> None:
    env = jaxsafe.make("docking1d")
    states, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 200))
    deputy = states.sim.platforms["deputy"]
    position = np.asarray(deputy.position[:, 0])
    assert (np.abs(position) >= 100.0).all()
    assert (np.abs(position) <= 150.0).all()
    assert 60 < (position > 0.0).sum() < 140
    assert 60 < (np.asarray(deputy.velocity[:, 0]) > 0.0).sum() < 140


def test_a_deputy_that_arrives_slowly_has_docked() -> None:
    env = jaxsafe.make("docking1d")
    state, _ = jaxsafe.reset_to(env, {"deputy": {"position": [0.55], "velocity": [-0.1]}})
    _, timestep = jaxsafe.step(env, state, jnp.zeros(1))
    assert env.outcomes[int(timestep.info.outcome)] == "success"
    assert timestep.terminated


@pytest.mark.thorough
@pytest.mark.parametrize("rta", one_of_each_kind(STARTERS["docking1d"].filters, ["default"]))
def test_a_filter_keeps_the_speed_limit_on_a_line(rta: str) -> None:
    env = jaxsafe.make("docking1d", rta=rta)
    worst = lambda key, observation: jnp.sign(observation[:, :1])  # noqa: E731  away from the chief
    steps = jaxsafe.rollout(env, worst, jax.random.key(0), num_steps=300, num_envs=64)
    if rta == "explicit_asif":  # as in the paper: nothing checks it
        return
    assert int(steps.cost.sum()) == 0
    assert bool(steps.info.rta.certified.all())
    assert float(steps.info.intervening.mean()) > 0.1


@pytest.mark.thorough
def test_without_a_filter_the_limit_is_exceeded() -> None:
    env = jaxsafe.make("docking1d")
    worst = lambda key, observation: jnp.sign(observation[:, :1])  # noqa: E731
    steps = jaxsafe.rollout(env, worst, jax.random.key(0), num_steps=30, num_envs=8)
    assert float(steps.cost.mean()) > 0.5


def test_gymnasium_knows_it() -> None:
    env = gymnasium.make("jaxsafe/Docking1D-v0")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (4,)
    assert env.action_space.shape == (1,)
    env.step(env.action_space.sample())


def test_a_flight_on_a_line_has_a_figure_and_a_film() -> None:
    env = jaxsafe.make("docking1d")
    flight = jaxsafe.fly(env, lambda key, observation: -jnp.sign(observation[:1]) * 0.1)
    figure = flight.plot()
    assert len(figure.axes) >= 4
    assert "docking1d" in str(flight)


def test_adversaries_and_the_picture_of_the_safe_set_know_a_line() -> None:
    from jaxsafe.evaluate.adversaries import ADVERSARIES
    from jaxsafe.plot.safe_set import planes

    env = jaxsafe.make("docking1d", rta="default")
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    for name, adversary in ADVERSARIES.items():
        act = lambda state, key, act=adversary: act(env, state.sim, key)  # noqa: E731
        assert jax.eval_shape(act, state, jax.random.key(0)).shape == (1,), name
    assert list(planes(env).panels) == ["flying towards the chief", "flying away"]
