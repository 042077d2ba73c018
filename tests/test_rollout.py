"""Episodes back to back: fresh starts and true last observations.

A batch is many single environments.
"""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.rollout import RecurrentPolicy, reset_batch, step_or_reset, step_or_reset_batch
from jaxsafe.simulation.cwh import cwh_flow
from jaxsafe.types import State, TimeStep

NUM_STEPS = 30
NUM_ENVS = 6
LENGTH = 4
TRACED: list[tuple[int, ...]] = []

step = jax.jit(jaxsafe.step)
rollout = jax.jit(jaxsafe.rollout, static_argnames=("policy", "num_steps", "num_envs"))
recorded: Any = jax.jit(
    jaxsafe.rollout, static_argnames=("policy", "num_steps", "num_envs", "record")
)


def policy(key: jax.Array | None, observation: jax.Array) -> jax.Array:
    """Return an action that is a deterministic function of the observation.

    It works for one environment and for many.
    """
    TRACED.append(observation.shape)
    return jnp.sin(7.0 * observation[..., :2])


@pytest.fixture(scope="module")
def env() -> Environment:
    """Return an environment in which every episode times out after four steps."""
    return jaxsafe.make("docking2d", {"terminal.timeout.limit": LENGTH - 1})


@pytest.fixture(scope="module")
def single(env: Environment) -> TimeStep:
    return rollout(env, policy, jax.random.key(0), NUM_STEPS)


@pytest.fixture(scope="module")
def batch(env: Environment) -> TimeStep:
    return rollout(env, policy, jax.random.key(0), NUM_STEPS, num_envs=NUM_ENVS)


def state_at(env: Environment, observation: jax.Array) -> State:
    """Return the state whose docking observation is given."""
    position = 100.0 * observation[:2]
    velocity = 0.5 * observation[2:4]
    return jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": velocity}})[0]


def is_start(observation: jax.Array) -> bool:
    """Return whether a start may have this observation: 100-150 m away within the speed limit."""
    return (
        99.99 <= 100 * np.hypot(*observation[:2]) <= 150.01
        and observation[4] <= observation[5] + 1e-6
    )


def before(env: Environment, observation: jax.Array, action: jax.Array) -> np.ndarray:
    """Return the observation from which a step with this action led here.

    The flow is linear, so it can be run backwards.
    """
    with jax.enable_x64(True):
        there = np.asarray(observation[:4], float) * [100, 100, 0.5, 0.5]
        back = cwh_flow(there[:2], there[2:], np.asarray(action, float) / 12.0, 0.001027, -1.0)
        position, velocity = (np.asarray(part) for part in back)
    speed = np.linalg.norm(velocity)
    limit = 0.2 + 2 * 0.001027 * np.linalg.norm(position)
    return np.concatenate([position / 100, velocity / 0.5, [speed, limit]])


def assert_is_a_run(env: Environment, timesteps: TimeStep) -> None:
    """Check that each observation inside an episode follows from the last.

    After an end the next observation comes from a random start.
    """
    starts = []
    for t in range(1, NUM_STEPS):
        last = timesteps.observation[t - 1]
        following = timesteps.observation[t]
        if timesteps.terminated[t - 1]:
            start = before(env, following, timesteps.info.control_actual[t])
            assert is_start(start)
            np.testing.assert_allclose(
                policy(None, jnp.float32(start)), timesteps.info.control_actual[t], atol=1e-4
            )
            starts.append(start)
        else:
            action = policy(None, last)
            np.testing.assert_allclose(timesteps.info.control_actual[t], action, atol=1e-6)
            np.testing.assert_allclose(
                following, step(env, state_at(env, last), action)[1].observation, atol=1e-5
            )
    assert len(starts) == NUM_STEPS // LENGTH
    assert len(np.unique(np.round(np.asarray(starts)[:, 0], 4))) == len(starts)


def test_a_rollout_stacks_time_steps(single: TimeStep, env: Environment) -> None:
    assert all(leaf.shape[0] == NUM_STEPS for leaf in jax.tree.leaves(single))
    assert single.observation.shape == (NUM_STEPS, env.observation_size)
    assert single.reward.shape == (NUM_STEPS,)


def test_episodes_follow_each_other_from_fresh_random_starts(
    env: Environment, single: TimeStep
) -> None:
    assert_is_a_run(env, single)


def test_the_step_that_ends_an_episode_keeps_its_facts(single: TimeStep, env: Environment) -> None:
    ends = np.arange(NUM_STEPS) % LENGTH == LENGTH - 1
    np.testing.assert_array_equal(single.terminated, ends)
    np.testing.assert_array_equal(
        single.info.outcome, np.where(ends, env.outcomes.index("timeout"), 0)
    )
    np.testing.assert_array_equal(single.info.reward_terms["failure"], np.where(ends, -1.0, 0.0))
    for t in np.flatnonzero(ends):
        last = step(
            env, state_at(env, single.observation[t - 1]), policy(None, single.observation[t - 1])
        )[1]
        np.testing.assert_allclose(single.observation[t], last.observation, atol=1e-5)


def test_totals_begin_anew_with_every_episode(single: TimeStep) -> None:
    for name, terms in single.info.reward_terms.items():
        whole = np.asarray(terms)[: NUM_STEPS // LENGTH * LENGTH].reshape(-1, LENGTH)
        totals = np.asarray(single.info.reward_totals[name])[: whole.size].reshape(-1, LENGTH)
        np.testing.assert_allclose(totals, np.cumsum(whole, axis=1), atol=1e-6)


def test_each_environment_of_a_batch_is_a_run_of_its_own(env: Environment, batch: TimeStep) -> None:
    assert batch.observation.shape == (NUM_STEPS, NUM_ENVS, env.observation_size)
    for i in range(NUM_ENVS):
        assert_is_a_run(env, jax.tree.map(lambda leaf, i=i: leaf[:, i], batch))


def test_the_environments_of_a_batch_differ(batch: TimeStep) -> None:
    assert len(np.unique(batch.observation[..., 0])) == NUM_STEPS * NUM_ENVS


def test_in_a_batch_only_the_finished_environments_start_anew(env: Environment) -> None:
    state, _ = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(1), 4)
    state = state.replace(num_steps=jnp.asarray([0, LENGTH - 1, 1, LENGTH - 1]))
    action = jax.random.uniform(jax.random.key(3), (4, 2), minval=-1.0)
    (after, observation), timestep = jax.jit(step_or_reset_batch)(
        env, state, action, jax.random.key(2)
    )
    assert timestep.done.tolist() == [False, True, False, True]
    assert after.num_steps.tolist() == [1, 0, 2, 0]
    for i in range(4):
        _, alone = step(env, jax.tree.map(lambda leaf, i=i: leaf[i], state), action[i])
        np.testing.assert_allclose(timestep.observation[i], alone.observation, atol=1e-6)
        assert np.array_equal(observation[i], timestep.observation[i]) == (not timestep.done[i])
        if timestep.done[i]:
            assert is_start(np.asarray(observation[i]))
    assert not np.allclose(observation[1], observation[3])


@pytest.mark.parametrize("ends", ["terminated", "truncated"])
def test_every_kind_of_end_is_followed_by_a_start(ends: str) -> None:
    env = jaxsafe.make(
        "docking2d", {"terminal.timeout.limit": LENGTH - 1, "terminal.timeout.ends": ends}
    )
    state, _ = jaxsafe.reset(env, jax.random.key(0))
    for num_steps, expected in ((LENGTH - 2, LENGTH - 1), (LENGTH - 1, 0)):
        before = state.replace(num_steps=jnp.asarray(num_steps))
        (after, observation), timestep = step_or_reset(env, before, jnp.zeros(2), jax.random.key(1))
        assert int(after.num_steps) == expected
        assert bool(getattr(timestep, ends)) == (expected == 0)
        assert np.array_equal(observation, timestep.observation) == (expected != 0)


@pytest.mark.thorough
def test_environments_may_be_the_last_axis(env: Environment) -> None:
    begin = jax.jit(reset_batch, static_argnames=("num_envs", "axis"))
    advance = jax.jit(step_or_reset_batch, static_argnames="axis")
    action = jax.random.uniform(jax.random.key(3), (300, 2), minval=-1.0)
    computed = []
    for axis in (0, -1):
        state, _ = begin(env, jax.random.key(1), num_envs=300, axis=axis)
        state = state.replace(num_steps=jnp.arange(300) % LENGTH)
        computed.append(
            advance(env, state, action if axis == 0 else action.T, jax.random.key(2), axis=axis)
        )
    assert 0 < computed[0][1].done.sum() < 300
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, jnp.moveaxis(b, -1, 0), rtol=1e-5, atol=1e-5),
        *computed,
    )


@pytest.mark.thorough
def test_the_starts_of_a_large_batch_are_those_of_its_environments() -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": LENGTH - 1})
    state, _ = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(1), 256)
    state = state.replace(num_steps=state.num_steps.at[jnp.array([3, 200])].set(LENGTH - 1))
    key = jax.random.key(2)
    (after, _), timestep = jax.jit(step_or_reset_batch)(env, state, jnp.zeros((256, 2)), key)
    assert np.flatnonzero(timestep.done).tolist() == [3, 200]
    fresh, _ = jax.jit(reset_batch, static_argnums=2)(env, key, 256)
    for index in (3, 200):
        jax.tree.map(
            lambda a, b, i=index: np.testing.assert_allclose(a[i], b[i], rtol=1e-6), after, fresh
        )


def test_a_limit_truncates_what_still_runs(env: Environment) -> None:
    state, _ = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(1), 4)
    # The last episode has reached its own limit.
    state = state.replace(num_steps=jnp.asarray([0, 1, 2, LENGTH - 1]))
    (after, _), timestep = jax.jit(step_or_reset_batch)(
        env, state, jnp.zeros((4, 2)), jax.random.key(2), 2
    )
    assert timestep.truncated.tolist() == [False, True, True, False]
    assert timestep.terminated.tolist() == [False, False, False, True]
    assert [env.outcomes[i] for i in timestep.info.outcome] == [
        "running",
        "running",
        "running",
        "timeout",
    ]
    assert after.num_steps.tolist() == [1, 0, 0, 0]


def test_a_rollout_under_jit_is_the_same_and_compiles_once(
    env: Environment, single: TimeStep
) -> None:
    plain = jaxsafe.rollout(env, policy, jax.random.key(0), NUM_STEPS)
    chex.assert_trees_all_close(single, plain, atol=1e-5)
    num_traces = len(TRACED)
    other = rollout(
        jaxsafe.override(env, {"deputy.mass": 20}), policy, jax.random.key(0), NUM_STEPS
    )
    assert len(TRACED) == num_traces > 0
    assert not np.allclose(other.observation, plain.observation)


def test_the_key_decides_everything(env: Environment, single: TimeStep) -> None:
    chex.assert_trees_all_equal(single, rollout(env, policy, jax.random.key(0), NUM_STEPS))
    other = rollout(env, policy, jax.random.key(1), NUM_STEPS)
    assert not np.isin(other.observation[:, 0], single.observation[:, 0]).any()


@pytest.mark.thorough
def test_a_number_in_place_of_a_key_is_refused(env: Environment) -> None:
    for call in (
        lambda: jaxsafe.rollout(env, policy, 3, num_steps=2),  # type: ignore
        lambda: jaxsafe.evaluate(env, policy, key=3, episodes=2),  # type: ignore
        lambda: env.reset(3),  # type: ignore
    ):
        with pytest.raises(ConfigError, match=r"key: expected a key, such as jax.random.key\(3\)"):
            call()


def test_discrete_actions_roll_out_with_a_new_key_at_every_step() -> None:
    env = jaxsafe.make("docking3d", {"terminal.timeout.limit": LENGTH - 1}, actions="discrete")

    def choose(key: jax.Array, observation: jax.Array) -> jax.Array:
        return jax.random.randint(key, (*observation.shape[:-1], env.action_size), 0, 11)

    timesteps = rollout(env, choose, jax.random.key(0), NUM_STEPS, num_envs=3)
    fifths = np.asarray(timesteps.info.control_actual) * 5.0
    np.testing.assert_allclose(fifths, np.round(fifths), atol=1e-5)
    assert set(np.round(fifths).ravel()) == set(range(-5, 6))
    assert len(np.unique(np.round(fifths).reshape(NUM_STEPS, -1), axis=0)) == NUM_STEPS
    assert timesteps.terminated.sum() == 3 * (NUM_STEPS // LENGTH)


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        ({"num_steps": -1}, "num_steps: expected a whole number ≥ 0, found -1"),
        ({"num_steps": 2.5}, "num_steps: expected a whole number ≥ 0, found 2.5"),
        ({"num_steps": None}, "num_steps: expected a whole number ≥ 0, found None"),
        ({"num_steps": 3, "num_envs": -3}, "num_envs: expected a whole number ≥ 1, found -3"),
        ({"num_steps": 3, "num_envs": 0}, "num_envs: expected a whole number ≥ 1, found 0"),
    ],
)
def test_a_rollout_of_no_number_of_steps_or_environments_is_refused(
    counts: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match=f"^rollout: {message}$"):
        jaxsafe.rollout(
            jaxsafe.make("docking2d"),
            lambda key, observation: jnp.zeros(2),
            jax.random.key(0),
            **counts,
        )


def assert_alike(one: jax.Array, other: jax.Array) -> None:
    """Check that arrays of two programs agree up to rounding."""
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


@pytest.mark.thorough
def test_transitions_are_the_same_rollout(env: Environment, batch: TimeStep) -> None:
    arguments = (env, policy, jax.random.key(0), NUM_STEPS, NUM_ENVS)
    position, steps = recorded(*arguments, record="transitions")
    for name in ("reward", "cost", "terminated", "truncated", "done"):
        assert_alike(getattr(steps, name), getattr(batch, name))
    assert_alike(steps.next_observation, batch.observation)
    jax.tree.map(assert_alike, steps.info, batch.info)
    np.testing.assert_allclose(steps.action, policy(None, steps.observation), rtol=1e-5)
    goes_on = ~np.asarray(steps.done)[:-1]
    np.testing.assert_array_equal(
        np.asarray(steps.observation)[1:][goes_on],
        np.asarray(steps.next_observation)[:-1][goes_on],
    )
    assert all(is_start(o) for o in np.asarray(steps.observation)[1:][~goes_on])
    assert steps.state is None
    assert position.observation.shape == (NUM_ENVS, env.observation_size)
    assert position.state.num_steps.shape == (NUM_ENVS,)


@pytest.mark.thorough
def test_states_are_those_before_each_step(env: Environment) -> None:
    _, steps = recorded(env, policy, jax.random.key(0), NUM_STEPS, NUM_ENVS, record="states")
    for t, i in ((0, 0), (NUM_STEPS - 1, 2)):
        state = jax.tree.map(lambda x, t=t, i=i: x[t, i], steps.state)
        after, timestep = step(env, state, steps.action[t, i])
        np.testing.assert_allclose(timestep.observation, steps.next_observation[t, i], rtol=1e-5)
        assert int(after.num_steps) == int(state.num_steps) + 1


@pytest.mark.thorough
@pytest.mark.parametrize("num_envs", [pytest.param(None, marks=pytest.mark.thorough), 3])
def test_a_rollout_goes_on_where_another_stopped(env: Environment, num_envs: int | None) -> None:
    """Episodes of four steps are cut after six, so the second half begins within one."""
    arguments = (env, policy, jax.random.key(0), 6)
    position, first = recorded(*arguments, num_envs, record="transitions")
    end, second = recorded(*arguments, record="transitions", start=position)
    np.testing.assert_array_equal(second.observation[0], position.observation)
    np.testing.assert_array_equal(first.next_observation[-1], second.observation[0])
    ended = np.asarray(second.done).reshape(6, -1).any(axis=1)
    assert ended.tolist() == [False, True, False, False, False, True]
    assert end.observation.shape == position.observation.shape


@pytest.mark.thorough
def test_transitions_hold_what_a_policy_remembered(env: Environment) -> None:
    def count(key: jax.Array, observation: jax.Array, memory: Any) -> tuple[jax.Array, Any]:
        return jnp.zeros((*observation.shape[:-1], 2)), memory + 1

    counter = RecurrentPolicy(count, jnp.zeros((), jnp.int32))
    _, steps = recorded(env, counter, jax.random.key(0), 9, 3, record="transitions")
    assert steps.memory.tolist() == [[t % LENGTH] * 3 for t in range(9)]


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (
            lambda env, policy: jaxsafe.rollout(env, policy, jax.random.key(0), 2, num_envs=5),
            "expected actions of shape (5, 2), one (thrust_x, thrust_y) for each of 5",
        ),
        (lambda env, policy: jaxsafe.evaluate(env, policy, episodes=4), "shape (4, 2)"),
    ],
)
def test_a_policy_that_forgets_the_batch_is_told_so(
    run: Any, message: str, env: Environment
) -> None:
    with pytest.raises(ConfigError) as caught:
        run(env, lambda key, observation: jnp.zeros(2))
    assert message in str(caught.value)
    advice = "found (2,); for a policy of one observation, write jax.vmap around it"
    assert str(caught.value).splitlines()[0].endswith(advice)
    with pytest.raises(ConfigError, match=r"found \(7, 2\)"):
        run(env, lambda key, observation: jnp.zeros((7, 2)))


def test_an_error_on_a_batch_says_that_there_is_one(env: Environment) -> None:
    with pytest.raises(TypeError) as caught:
        jaxsafe.evaluate(env, lambda key, observation: jnp.ones((2, 6)) @ observation, episodes=4)
    hint = "<lambda>: it gets a batch, observations of shape (4, 6); for a policy of one obs"
    assert any(
        note.startswith("in the policy test_rollout:") and hint in note
        for note in caught.value.__notes__
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"record": "transition"},
            "rollout: record: unknown record 'transition'. Did you mean 'transitions'",
        ),
        ({"start": 3}, "rollout: start: expected the RolloutState that an earlier rollout"),
        ({"policy": 3}, "policy: expected a function of a key and an observation, found 3$"),
    ],
)
def test_a_wrong_policy_record_or_start_is_refused(
    arguments: dict[str, Any], message: str, env: Environment
) -> None:
    with pytest.raises(ConfigError, match=message):
        jaxsafe.rollout(env, key=jax.random.key(0), num_steps=2, **{"policy": policy, **arguments})
