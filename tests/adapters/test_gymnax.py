from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_modes import CHECKED_WHILE_RUNNING, CHECKED_WHILE_TRACING

import jaxsafe
from jaxsafe import ConfigError

pytestmark = [pytest.mark.peer, pytest.mark.filterwarnings("default")]


@pytest.fixture
def make() -> Any:
    from jaxsafe.adapters.gymnax import GymnaxEnv

    return GymnaxEnv


def test_a_step_is_ours_and_resets_by_itself(make: Any) -> None:
    env = make("docking2d", {"terminal.timeout.limit": 3.0})
    core = jaxsafe.make("docking2d", {"terminal.timeout.limit": 3.0})
    params = env.default_params
    observation, state = env.reset(jax.random.key(0), params)
    expected, timestep = core.reset(jax.random.key(0))
    np.testing.assert_allclose(observation, timestep.observation, rtol=1e-6)
    action = jnp.array([0.5, -0.5])
    for index in range(4):
        key = jax.random.key(index)
        observation, state, reward, terminated, truncated, info = env.step(
            key, state, action, params
        )
        expected, timestep = core.step(expected, action)
        np.testing.assert_allclose(reward, timestep.reward, rtol=1e-5)
        np.testing.assert_allclose(info["final_observation"], timestep.observation, rtol=1e-5)
        assert (bool(terminated), bool(truncated)) == (index == 3, False)
    np.testing.assert_allclose(observation, core.reset(key)[1].observation, rtol=1e-6)
    assert int(state.num_steps) == 0


def test_an_action_that_is_no_number_is_a_failure_that_costs(make: Any) -> None:
    env = make("docking2d")
    _, state = env.reset(jax.random.key(0))
    observation, _, _, terminated, truncated, info = env.step(
        jax.random.key(1), state, jnp.array([jnp.nan, 0.0])
    )
    assert (bool(terminated), bool(truncated), float(info["cost"]), bool(info["is_success"])) == (
        True,
        False,
        1.0,
        False,
    )
    assert np.isfinite(observation).all()


def test_instances_share_compiled_programs(make: Any) -> None:
    from jaxsafe.adapters import gymnax

    sizes = []
    for mass in (12.0, 12.0, 13.0):
        env = make("docking2d", {"deputy.mass": mass})
        _, state = env.reset(jax.random.key(0))
        result = env.step(jax.random.key(1), state, jnp.ones(2))
        assert len(result) == 6
        sizes.append((gymnax._reset._cache_size(), gymnax._step._cache_size()))
    assert sizes[0] == sizes[1] == sizes[2]
    expected = jaxsafe.step(env.env, state, jnp.ones(2))[1].observation
    np.testing.assert_allclose(result[5]["final_observation"], expected, rtol=1e-5)


def test_older_libraries_get_five_values(make: Any) -> None:
    env = make("docking2d", legacy=True)
    _, state = env.reset(jax.random.key(0))
    assert len(env.step(jax.random.key(1), state, jnp.zeros(2))) == 5


def test_parameters_are_a_pytree_to_map_over(make: Any) -> None:
    env = make("docking2d")
    masses = jnp.array([10.0, 14.0])
    params = jax.vmap(
        lambda mass: env.default_params.replace(
            env=jaxsafe.override(env.env, {"deputy.mass": mass})
        )
    )(masses)
    _, state = env.reset(jax.random.key(0))
    observation, *_ = jax.vmap(env.step, in_axes=(None, None, None, 0))(
        jax.random.key(1), state, jnp.ones(2), params
    )
    assert observation[0, 2] > observation[1, 2]  # the lighter spacecraft is faster


def test_a_limit_of_its_own_truncates(make: Any) -> None:
    env = make("docking2d")
    params = env.default_params.replace(max_steps_in_episode=1)
    _, state = env.reset(jax.random.key(0), params)
    *_, terminated, truncated, _ = env.step(jax.random.key(1), state, jnp.zeros(2), params)
    assert (bool(terminated), bool(truncated)) == (False, True)


def test_a_limit_that_no_program_can_count_to_is_refused(make: Any) -> None:
    env = make("docking2d")
    with pytest.raises(
        ConfigError,
        match="max_steps_in_episode: expected a whole number from 1 to 2,147,483,647, found 1000",
    ):
        env.default_params.replace(max_steps_in_episode=10**10)
    # Axes to map over are allowed as parameters.
    assert jax.tree.map(lambda _: 0, env.default_params).max_steps_in_episode == 0


def test_discrete_actions_are_one_choice(make: Any) -> None:
    env = make("docking2d", actions="discrete")
    core = jaxsafe.make("docking2d", actions="discrete")
    assert env.action_space().n == env.num_actions == 121
    _, state = env.reset(jax.random.key(0))
    expected, _ = core.reset(jax.random.key(0))
    result = env.step(jax.random.key(1), state, jnp.int32(3 * 11 + 7))
    np.testing.assert_allclose(
        result[2], core.step(expected, jnp.array([3, 7]))[1].reward, rtol=1e-5
    )


def test_spaces_are_those_of_gymnax(make: Any) -> None:
    env = make("rejoin2d")
    observation, _ = env.reset(jax.random.key(0))
    assert env.observation_space(env.default_params).contains(observation)
    assert env.action_space(env.default_params).sample(jax.random.key(0)).shape == (2,)


def test_the_action_space_is_the_actuators(make: Any) -> None:
    thrust = "deputy.controller.actuators.thrust_x"
    env = make(
        "docking2d", {f"{thrust}.rescale": False, f"{thrust}.low": -3.0, f"{thrust}.high": 0.5}
    )
    space = env.action_space(env.default_params)
    assert (space.low.tolist(), space.high.tolist()) == ([-3.0, -1.0], [0.5, 1.0])
    wide = env.default_params.replace(env=jaxsafe.override(env.env, {f"{thrust}.high": 2.0}))
    assert env.action_space(wide).high.tolist() == [2.0, 1.0]


def test_a_mixed_action_is_a_dict_by_actuator_or_one_vector(make: Any) -> None:
    env = make(
        "docking2d", {"deputy.controller.actuators.thrust_y.discrete": True}, actions="mixed"
    )
    action = env.action_space(env.default_params).sample(jax.random.key(0))
    assert action["thrust_x"].shape == action["thrust_y"].shape == ()
    assert env.num_actions == 2
    _, state = env.reset(jax.random.key(0))
    step = jax.vmap(env.step, in_axes=(None, None, 0))
    by_name = {"thrust_x": jnp.array([0.5, -0.5]), "thrust_y": jnp.array([0, 10])}
    vector = jnp.array([[0.5, 0.0], [-0.5, 10.0]])
    for action in (by_name, vector):
        _, after, *_ = step(jax.random.key(0), state, action)
        np.testing.assert_allclose(
            after.sim.platforms["deputy"].delta_v * 12.0, [[0.5, -1.0], [-0.5, 1.0]], rtol=1e-5
        )


MODES = CHECKED_WHILE_TRACING | CHECKED_WHILE_RUNNING | {"disable_jit": jax.disable_jit}


@pytest.mark.parametrize("mode", MODES)
def test_it_works_in_every_mode_of_jax(make: Any, mode: str) -> None:
    with MODES[mode]():
        env = make("docking2d")
        chosen = make("docking2d", actions="discrete", legacy=True)
        params = env.default_params.replace(max_steps_in_episode=1)
        starts, steps, first = jax.random.split(jax.random.key(0), 3)
        starts = jax.random.split(starts, 4)
        steps = jax.random.split(steps, 5)
        _, state = jax.vmap(env.reset, (0, None))(starts, params)
        zero = np.zeros((4, 2), np.float32)
        observation, *_, truncated, _ = jax.vmap(env.step, (0, 0, 0, None))(
            steps[:4], state, zero, params
        )
        assert np.isfinite(observation).all()
        assert truncated.all()
        _, state = chosen.reset(first)
        assert np.isfinite(chosen.step(steps[4], state, np.int32(3))[0]).all()


@pytest.mark.slow
def test_rejax_trains_unmodified(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rejax")
    monkeypatch.syspath_prepend("examples")
    import rejax_docking2d

    _, returns = rejax_docking2d.train(400_000)
    assert float(returns[:, -1].mean(axis=-1).max()) > float(returns[:, 0].mean()) + 3.0
