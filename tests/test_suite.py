"""The laws that every task keeps, with continuous and with discrete actions."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxsafe
from jaxsafe import Environment
from jaxsafe.types import State, TimeStep

VARIANTS = [(task, actions) for task in ("docking2d", "docking3d") for actions in ("continuous", "discrete")]
NUM_STEPS, NUM_ENVS = 40, 5

TRACED: list[str] = []


@jax.jit
def reset(env: Environment, key: jax.Array) -> tuple[State, TimeStep]:
    TRACED.append("reset")
    return jaxsafe.reset(env, key)


@jax.jit
def step(env: Environment, state: State, action: jax.Array) -> tuple[State, TimeStep]:
    TRACED.append("step")
    return jaxsafe.step(env, state, action)


@pytest.fixture(scope="module", params=VARIANTS, ids="-".join)
def env(request: pytest.FixtureRequest) -> Environment:
    task, actions = request.param
    return jaxsafe.make(task, actions=actions)


@pytest.fixture(scope="module")
def started(env: Environment) -> tuple[State, TimeStep]:
    """Random starts, [NUM_ENVS]."""
    return jax.jit(jax.vmap(jaxsafe.reset, in_axes=(None, 0)))(env, keys())


@pytest.fixture(scope="module")
def timesteps(env: Environment, started: tuple[State, TimeStep]) -> TimeStep:
    """Random actions from random starts, without resets, [NUM_ENVS, NUM_STEPS]."""

    def run(env: Environment, state: State, actions: jax.Array) -> TimeStep:
        return jax.lax.scan(lambda state, action: jaxsafe.step(env, state, action), state, actions)[1]

    actions = random_actions(env, NUM_ENVS, NUM_STEPS)
    return jax.jit(jax.vmap(run, in_axes=(None, 0, 0)))(env, started[0], actions)


def keys() -> jax.Array:
    return jax.random.split(jax.random.key(7), NUM_ENVS)


def random_actions(env: Environment, *shape: int) -> jax.Array:
    key, shape = jax.random.key(11), (*shape, env.action_size)
    if env.num_action_points:
        return jax.random.randint(key, shape, 0, jnp.asarray(env.num_action_points))
    return jax.random.uniform(key, shape, minval=-1.0)


def item(tree: Any, index: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def start_at(env: Environment, distance: float, speed: float) -> State:
    """On the x axis, moving along y."""
    position, velocity = np.eye(env.action_size)[:2] * [[distance], [speed]]
    return jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": velocity}})[0]


def test_with_and_without_jit_are_the_same(env: Environment) -> None:
    chex.assert_trees_all_close(jaxsafe.reset(env, keys()[0]), reset(env, keys()[0]), rtol=1e-6, atol=1e-6)
    state, action = reset(env, keys()[0])[0], random_actions(env)
    chex.assert_trees_all_close(jaxsafe.step(env, state, action), step(env, state, action), rtol=1e-6, atol=1e-6)


def test_a_batch_of_states_is_a_loop_over_states(env: Environment, started: tuple[State, TimeStep]) -> None:
    actions = random_actions(env, NUM_ENVS)
    stepped = jax.jit(jax.vmap(jaxsafe.step, in_axes=(None, 0, 0)))(env, started[0], actions)
    for i in range(NUM_ENVS):
        chex.assert_trees_all_close(item(started, i), reset(env, keys()[i]), rtol=1e-6, atol=1e-6)
        alone = step(env, item(started[0], i), actions[i])
        chex.assert_trees_all_close(item(stepped, i), alone, rtol=1e-6, atol=1e-6)


def test_a_batch_of_parameters_is_a_loop_over_overrides(env: Environment) -> None:
    masses, scales = jnp.asarray([6.0, 12.0, 24.0]), jnp.asarray([-1.0, 0.0, 0.5])
    state, action = start_at(env, 100.0, 2.0), random_actions(env)

    def step_with(mass: Any, scale: Any, limit: Any) -> tuple[State, TimeStep]:
        changes = {"deputy.mass": mass, "reward.delta_v.scale": scale, "status.velocity_limit.floor": limit}
        return jaxsafe.step(jaxsafe.override(env, changes), state, action)

    batch = jax.jit(jax.vmap(step_with))(masses, scales, jnp.asarray([0.1, 3.0, 1.0]))
    for i, (mass, scale, limit) in enumerate([(6, -1, 0.1), (12, 0, 3.0), (24, 0.5, 1.0)]):
        chex.assert_trees_all_close(item(batch, i), step_with(mass, scale, limit), rtol=1e-5, atol=1e-6)
    delta_v = batch[1].info.status["delta_v"]
    np.testing.assert_allclose(delta_v * masses, np.full(3, delta_v[0] * 6.0), rtol=1e-6)
    assert batch[1].cost.tolist() == [1.0, 0.0, 1.0]


def test_a_batch_of_environments_steps_as_each_of_them(env: Environment, started: tuple[State, TimeStep]) -> None:
    each = [jaxsafe.override(env, {"deputy.mass": mass, "dt": dt}) for mass, dt in ((6, 1), (12, 2), (24, 0.5))]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    states, actions = jax.tree.map(lambda leaf: leaf[:3], started[0]), random_actions(env, 3)
    stepped = jax.jit(jax.vmap(jaxsafe.step, in_axes=(0, 0, 0)))(batch, states, actions)
    for i in range(3):
        alone = step(each[i], item(states, i), actions[i])
        chex.assert_trees_all_close(item(stepped, i), alone, rtol=1e-6, atol=1e-6)


def test_the_same_key_and_actions_give_the_same_bits(env: Environment, started: tuple[State, TimeStep]) -> None:
    again = jax.jit(jax.vmap(jaxsafe.reset, in_axes=(None, 0)))(env, keys())
    chex.assert_trees_all_equal(again, started)
    state, action = item(started[0], 0), random_actions(env)
    chex.assert_trees_all_equal(step(env, state, action), step(env, state, action))


def test_starts_vary_in_every_element(started: tuple[State, TimeStep], env: Environment) -> None:
    observations = np.asarray(started[1].observation)
    for name, column in zip(env.observation_names, observations.T, strict=True):
        assert len(np.unique(column)) == NUM_ENVS, name


def test_no_element_of_the_observation_is_constant(timesteps: TimeStep, env: Environment) -> None:
    for name, column in zip(env.observation_names, np.moveaxis(np.asarray(timesteps.observation), -1, 0), strict=True):
        assert (column.std(axis=0) > 1e-3).all(), name
        assert (column.std(axis=1) > 1e-4).all(), name


def test_everything_stays_finite(timesteps: TimeStep) -> None:
    chex.assert_tree_all_finite(timesteps)


@pytest.mark.parametrize(("distance", "speed"), [(0.0, 0.0), (0.5, 0.0), (4e4, 100.0), (1e8, 1e4)])
def test_everything_stays_finite_at_the_edges_of_space(env: Environment, distance: float, speed: float) -> None:
    state = start_at(env, distance, speed)
    for action in random_actions(env, 3):
        state, timestep = step(env, state, action)
        chex.assert_tree_all_finite((state, timestep))


def test_normalisation_undone_returns_the_raw_vector(timesteps: TimeStep, env: Environment) -> None:
    state, timestep = reset(env, keys()[0])
    for action in random_actions(env, 5):
        state, timestep = step(env, state, action)
        deputy, status = state.sim.platforms["deputy"], timestep.info.status
        raw = jnp.concatenate([deputy.position, deputy.velocity, status["speed"][None], status["velocity_limit"][None]])
        sizes = [env.action_size, env.action_size, 1, 1]
        scale = np.concatenate([np.full(n, one.scale) for n, one in zip(sizes, env.observation, strict=True)])
        np.testing.assert_allclose(timestep.observation * scale, raw, rtol=1e-6)


def test_the_terms_sum_to_the_reward_and_the_distance_reward_telescopes(
    timesteps: TimeStep, started: tuple[State, TimeStep]
) -> None:
    info = timesteps.info
    np.testing.assert_allclose(timesteps.reward, sum(map(np.asarray, info.reward_terms.values())), atol=1e-6)
    potential = [
        2.0 * 0.5 ** (np.asarray(distance, float) / 100.0)
        for distance in (started[1].info.status["docking_distance"], info.status["docking_distance"][:, -1])
    ]
    total = np.asarray(info.reward_terms["distance_change"], float).sum(axis=1)
    np.testing.assert_allclose(total, potential[1] - potential[0], atol=1e-5)


def test_cost_is_one_exactly_where_a_margin_is_negative(timesteps: TimeStep) -> None:
    margins = np.asarray(timesteps.info.margins["velocity_limit"])
    np.testing.assert_array_equal(timesteps.cost, np.where(margins < 0.0, 1.0, 0.0))
    assert 0.0 < timesteps.cost.mean() < 1.0
    over = np.maximum(-margins, 0.0) / np.asarray(timesteps.info.status["velocity_limit"])
    np.testing.assert_allclose(timesteps.info.severity["velocity_limit"], over, rtol=1e-5)


def test_any_numbers_compile_once(env: Environment) -> None:
    numbers = (10, 11.0, np.float32(12.0), np.float64(13.0), jnp.asarray(14.0), jnp.asarray(15))
    changed = [jaxsafe.override(env, {"deputy.mass": mass, "reward.failure.values.crash": -mass}) for mass in numbers]
    step(env, reset(env, keys()[0])[0], random_actions(env))
    num_traces = len(TRACED)
    for one in (env, *changed, jax.tree.map(lambda leaf: leaf * 1.5, env)):
        state, _ = reset(one, keys()[0])
        for action in random_actions(env, 2):
            state, _ = step(one, state, action)
    state, _ = jaxsafe.reset_to(env, {"deputy": dict.fromkeys(("position", "velocity"), np.zeros(env.action_size))})
    step(env, state, np.asarray(random_actions(env)))
    assert len(TRACED) == num_traces > 0


# Derivatives


@pytest.mark.parametrize(("task", "actions"), VARIANTS[:3])
@pytest.mark.usefixtures("x64")
def test_derivatives_of_a_return_are_those_of_finite_differences(task: str, actions: str) -> None:
    env = jaxsafe.make(task, actions=actions)
    state = start_at(env, 100.0, 2.0)  # above the limit, so every term but the ends has a slope
    taken = random_actions(env, 5)

    def episode_return(inputs: tuple[dict[str, jax.Array], jax.Array]) -> jax.Array:
        changed = jaxsafe.override(env, inputs[0])
        _, timesteps = jax.lax.scan(lambda state, action: jaxsafe.step(changed, state, action), state, inputs[1])
        return jnp.sum(timesteps.reward) + jnp.sum(timesteps.observation**2)

    parameters = {"deputy.mass": 3.0, "deputy.mean_motion": 0.01, "reward.delta_v.scale": -0.5, "dt": 0.9}
    parameters |= {"status.velocity_limit.floor": 0.3, "reward.velocity_constraint.scale": -0.2}
    if actions == "continuous":
        point, unravel = ravel_pytree((parameters, taken))
    else:
        point, unravel = ravel_pytree(parameters)
        unravel = (lambda split: lambda point: (split(point), taken))(unravel)
    value = jax.jit(jax.vmap(lambda point: episode_return(unravel(point))))
    nudges = 1e-6 * jnp.eye(point.size)
    expected = (value(point + nudges) - value(point - nudges)) / 2e-6
    found = jax.jit(jax.grad(lambda point: episode_return(unravel(point))))(point)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)
    assert (np.abs(found) > 1e-6).all()


@pytest.mark.parametrize("task", ["docking2d", "docking3d"])
@pytest.mark.parametrize(("distance", "speed"), [(0.0, 0.0), (0.5, 0.0), (100.0, 0.0)])
def test_derivatives_are_finite_where_norms_have_a_kink(task: str, distance: float, speed: float) -> None:
    env = jaxsafe.make(task)
    state = start_at(env, distance, speed)

    def outputs(env: Environment, sim: Any, action: jax.Array) -> list[jax.Array]:
        after, timestep = jaxsafe.step(env, state.replace(sim=sim), action)
        info = timestep.info
        facts = (timestep.reward, timestep.observation, info.margins, info.severity)
        return jax.tree.leaves((facts, after.sim.platforms))

    arguments = (env, state.sim, jnp.zeros(env.action_size))
    values, pull_back = jax.vjp(outputs, *arguments)
    slopes = pull_back([jnp.ones_like(value) for value in values])
    slopes = [leaf for leaf in jax.tree.leaves(slopes) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert len(slopes) > 30
    chex.assert_tree_all_finite(slopes)
