"""Numbers of the environment are drawn anew for each episode.

The tests say where they are drawn, kept and used, and which are refused.
"""

import re
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.config import dump, load
from jaxsafe.rollout import step_or_reset, step_or_reset_batch
from jaxsafe.types import State, TimeStep

START = {"deputy": {"position": [100.0, 50.0], "velocity": [0.1, -0.2]}}
TRACED: list[str] = []


@jax.jit
def reset(env: Environment, key: jax.Array) -> tuple[State, TimeStep]:
    TRACED.append("reset")
    return jaxsafe.reset(env, key)


@jax.jit
def step(env: Environment, state: State, action: jax.Array) -> tuple[State, TimeStep]:
    TRACED.append("step")
    return jaxsafe.step(env, state, action)


reset_many = jax.jit(jax.vmap(jaxsafe.reset, in_axes=(None, 0)))
step_many = jax.jit(jax.vmap(jaxsafe.step, in_axes=(None, 0, 0)))


@pytest.fixture(scope="module")
def env() -> Environment:
    return jaxsafe.make(
        "docking2d", randomize={"deputy.mass": [10, 14], "reward.delta_v.scale": [-0.5, -0.1]}
    )


def keys(num: int = 64) -> jax.Array:
    return jax.random.split(jax.random.key(5), num)


def test_numbers_lie_in_their_intervals_and_fill_them(env: Environment) -> None:
    drawn = reset_many(env, keys(256))[0].parameters
    assert set(drawn) == {"deputy.mass", "reward.delta_v.scale"}
    for path, low, high in (("deputy.mass", 10.0, 14.0), ("reward.delta_v.scale", -0.5, -0.1)):
        share = (np.asarray(drawn[path]) - low) / (high - low)
        assert share.min() >= -1e-6
        assert share.max() <= 1.0 + 1e-6
        # The tolerance is Kolmogorov and Smirnov's distance.
        np.testing.assert_allclose(np.sort(share), np.linspace(0, 1, 256), atol=0.12)


def test_numbers_differ_by_environment_by_reset_and_by_path(env: Environment) -> None:
    masses, scales = (np.asarray(value) for value in reset_many(env, keys())[0].parameters.values())
    assert len(np.unique(masses)) == len(np.unique(scales)) == 64
    assert abs(np.corrcoef(masses, scales)[0, 1]) < 0.4
    again = reset_many(env, jax.random.split(jax.random.key(6), 64))[0].parameters["deputy.mass"]
    assert not np.intersect1d(masses, again).size
    chex.assert_trees_all_equal(reset_many(env, keys())[0].parameters["deputy.mass"], masses)


def test_numbers_are_independent_of_the_start(env: Environment) -> None:
    state, _ = reset_many(env, keys(256))
    masses = state.parameters["deputy.mass"]
    position = state.sim.platforms["deputy"].position
    for drawn in (np.hypot(*position.T), np.arctan2(*position.T)):
        assert abs(np.corrcoef(masses, drawn)[0, 1]) < 0.2


def test_a_step_uses_the_drawn_number_and_the_state_keeps_it(env: Environment) -> None:
    state, _ = reset_many(env, keys())
    start = state.parameters
    actions = jnp.broadcast_to(jnp.asarray([0.6, 0.8]), (64, 2))
    for _ in range(3):
        state, timestep = step_many(env, state, actions)
        chex.assert_trees_all_equal(state.parameters, start)
        delta_v = 1.0 / np.asarray(start["deputy.mass"])
        np.testing.assert_allclose(timestep.info.status["delta_v"], delta_v, rtol=1e-5)
        cost = np.asarray(start["reward.delta_v.scale"]) * delta_v
        np.testing.assert_allclose(timestep.info.reward_terms["delta_v"], cost, rtol=1e-5)


def test_a_start_uses_the_drawn_number() -> None:
    env = jaxsafe.make(
        "docking2d",
        randomize={
            "status.velocity_limit.floor": [0.3, 0.9],
            "regions.docking_region.radius": [1, 5],
        },
    )
    state, timestep = reset_many(env, keys())
    limit = (
        np.asarray(state.parameters["status.velocity_limit.floor"])
        + 0.002054 * timestep.info.status["docking_distance"]
    )
    np.testing.assert_allclose(timestep.info.status["velocity_limit"], limit, rtol=1e-5)
    np.testing.assert_allclose(timestep.observation[:, -1], limit, rtol=1e-5)
    start = {"deputy": {"position": [3.0, 0.0], "velocity": [0.0, 0.0]}}
    for radius, inside in ((2.0, False), (4.0, True)):
        chosen = {"status.velocity_limit.floor": 0.5, "regions.docking_region.radius": radius}
        assert bool(jaxsafe.reset_to(env, start, chosen)[1].info.status["in_docking"]) == inside


def test_a_randomized_episode_is_the_episode_with_the_numbers_written_in(env: Environment) -> None:
    state, _ = reset(env, keys()[0])
    plain = jaxsafe.make("docking2d", dict(state.parameters))
    other = state.replace(parameters={})
    for action in jax.random.uniform(jax.random.key(0), (5, 2), minval=-1.0):
        (state, timestep) = step(env, state, action)
        (other, expected) = step(plain, other, action)
        chex.assert_trees_all_close(timestep, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "task",
    one_of_each_kind(
        ["docking2d", "docking3d", "docking2d_oriented", "rejoin2d", "rejoin3d"], ["docking2d"]
    ),
)
def test_starts_are_bitwise_those_without_random_numbers(task: str) -> None:
    plain = jaxsafe.make(task)
    random = jaxsafe.make(task, randomize={"dt": [0.5, 2.0], "terminal.timeout.limit": [9, 99]})
    (before, first), (after, second) = (reset_many(env, keys(8)) for env in (plain, random))
    chex.assert_trees_all_equal(before.sim.platforms, after.sim.platforms)
    chex.assert_trees_all_equal(first.observation, second.observation)


def test_other_intervals_do_not_compile_again(env: Environment) -> None:
    step(env, reset(env, keys()[0])[0], jnp.zeros(2))
    num_traces = len(TRACED)
    for mass in ([1, 2], [3.5, 3.5], jnp.asarray([7.0, 8.0]), np.asarray([7, 9])):
        changed = jaxsafe.make(
            "docking2d", randomize={"deputy.mass": mass, "reward.delta_v.scale": [0, 1]}
        )
        state, _ = step(changed, reset(changed, keys()[1])[0], jnp.zeros(2))
        assert float(mass[0]) <= float(state.parameters["deputy.mass"]) <= float(mass[1])
    state, _ = jaxsafe.reset_to(
        env, START, {"deputy.mass": 9, "reward.delta_v.scale": np.float64(1.0)}
    )
    step(env, state, jnp.zeros(2))
    assert len(TRACED) == num_traces > 0


def test_an_interval_of_one_number_is_that_number() -> None:
    env = jaxsafe.make("docking2d", randomize={"deputy.mass": [11, 11]})
    assert (reset_many(env, keys())[0].parameters["deputy.mass"] == 11.0).all()


def test_reset_to_takes_the_numbers_that_are_random(env: Environment) -> None:
    chosen = {"deputy.mass": 20.0, "reward.delta_v.scale": -3.0}
    state, _ = jaxsafe.reset_to(env, START, chosen)
    assert {path: float(value) for path, value in state.parameters.items()} == chosen
    _, timestep = step(env, state, jnp.asarray([1.0, 0.0]))
    assert float(timestep.info.reward_terms["delta_v"]) == pytest.approx(-3.0 / 20.0)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (
            None,
            r"^reset_to: parameter 'deputy\.mass' is missing: it is random at reset, so give it$",
        ),
        ({"deputy.mass": 3}, r"^reset_to: parameter 'reward\.delta_v\.scale' is missing"),
        (
            {"deputy.mas": 3},
            r"^reset_to: parameter 'deputy\.mas' is not random\. Did you mean 'deputy\.mass'\?",
        ),
        (
            {"dt": 1.0},
            (
                r"^reset_to: parameter 'dt' is not random; choose from deputy\.mass,"
                r" reward\.delta_v\.scale"
            ),
        ),
    ],
)
def test_reset_to_refuses_unknown_and_missing_numbers(
    env: Environment, parameters: Any, message: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        jaxsafe.reset_to(env, START, parameters)
    assert re.search(message, str(caught.value))
    assert "\n" not in str(caught.value)


def test_reset_to_refuses_numbers_where_nothing_is_random() -> None:
    with pytest.raises(
        ConfigError, match=r"^reset_to: parameter 'deputy\.mass' is not random; choose from none$"
    ):
        jaxsafe.reset_to(jaxsafe.make("docking2d"), START, {"deputy.mass": 3.0})


@pytest.mark.parametrize("value", [[1.0, 2.0], "heavy", None, float("nan")])
def test_reset_to_refuses_what_is_not_one_number(env: Environment, value: Any) -> None:
    with pytest.raises(ConfigError, match=r"^reset_to: [^\n]*deputy\.mass[^\n]*$"):
        jaxsafe.reset_to(env, START, {"deputy.mass": value, "reward.delta_v.scale": 1.0})


@pytest.mark.parametrize(
    ("randomize", "message"),
    [
        ({"deputy.mas": [1, 2]}, r"deputy\.mas: unknown field 'mas'.* Did you mean 'mass'\?"),
        ({"deputi.mass": [1, 2]}, r"deputi: unknown field 'deputi'.* Did you mean 'deputy'\?"),
        (
            {"reward.delta.scale": [1, 2]},
            r"reward\.delta: unknown name 'delta'.* Did you mean 'delta_v'\?",
        ),
        ({"reward.delta_v": [1, 2]}, r"reward\.delta_v: name one of its fields"),
        ({"deputy": [1, 2]}, r"deputy: name one of its fields"),
        ({"": [1, 2]}, r"unknown field ''"),
        ({"deputy.mass.x": [1, 2]}, r"deputy\.mass\.x: deputy\.mass has no fields"),
        (
            {"regions.docking_region.offset.angle": [1, 2]},
            r"offset has no fields because it is not set",
        ),
        ({"agent": [1, 2]}, r"agent: expected the path of one number"),
        ({"deputy.dimension": [2, 3]}, r"deputy\.dimension: expected the path of one number"),
        (
            {"status.delta_v.norm": [1, 2]},
            r"status\.delta_v\.norm: expected the path of one number",
        ),
        (
            {"terminal.success.apart": [0, 1]},
            r"terminal\.success\.apart: expected the path of one number",
        ),
        ({"terminal": [1, 2]}, r"terminal: expected the path of one number"),
        (
            {"deputy.start.position.distance": [1, 2]},
            r"distance: expected the path of one number, found that of a list",
        ),
        ({"reward.failure.values": [1, 2]}, r"reward\.failure\.values: expected"),
        (
            {"reward.failure.values.crsh": [1, 2]},
            r"reward\.failure\.values: unknown name 'crsh'.* Did you mean 'crash'\?",
        ),
        ({"deputy.mass": [0, 1]}, r"deputy\.mass: expected a number in kg > 0, found 0"),
        (
            {"regions.docking_region.radius": [-1, 1]},
            r"regions\.docking_region\.radius: expected .* ≥ 0, found -1",
        ),
        ({"deputy.mass": [14, 10]}, r"deputy\.mass: expected low ≤ high"),
        ({"deputy.mass": 12}, r"deputy\.mass: expected a list \[low, high\]"),
        ({"deputy.mass": [1, 2, 3]}, r"deputy\.mass: expected a list \[low, high\]"),
        ({"deputy.mass": [1, "two"]}, r"deputy\.mass: expected a list \[low, high\]"),
        ({"deputy.mass": [1, float("nan")]}, r"deputy\.mass: expected a list \[low, high\]"),
        ({"deputy.mass": [1, float("inf")]}, r"deputy\.mass"),
        ({"terminal.distance.limit": [1, float("inf")]}, r"terminal\.distance\.limit"),
        ({"randomize.dt": [1, 2]}, r"randomize\.dt: expected the path of a number outside"),
        ({3: [1, 2]}, r"3: unknown field '3'"),
    ],
)
def test_a_path_that_leads_to_no_number_in_range_is_refused(randomize: Any, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        jaxsafe.make("docking2d", randomize=randomize)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("randomize")
    assert re.search(message, str(caught.value)), str(caught.value)


@pytest.mark.parametrize(
    ("path", "named"),
    [
        ("lead.start.position.low", r"lead\.start\.position"),
        (
            "lead.controller.commands.heading_rate.values",
            r"lead\.controller\.commands\.heading_rate\.values",
        ),
        ("observation.lead_position.scale", r"observation\.lead_position\.scale"),
        ("observation.lead_position.clip", r"observation\.lead_position\.clip"),
    ],
)
def test_a_path_of_a_vector_is_refused(path: str, named: str) -> None:
    schedule = {"type": "schedule", "name": "heading_rate", "times": [0, 9], "values": [0.1, 0.2]}
    script = {"lead.controller": {"type": "scripted", "commands": [schedule]}}
    with pytest.raises(ConfigError, match=rf"^randomize[^\n]*{named}[^\n]*$"):
        jaxsafe.make("rejoin2d", script, randomize={path: [0.5, 1.0]})


@pytest.mark.thorough
@pytest.mark.parametrize("num_envs", [None, 3])
def test_a_rollout_draws_anew_at_every_automatic_reset(num_envs: int | None) -> None:
    env = jaxsafe.make(
        "docking2d", {"terminal.timeout.limit": 2.0}, randomize={"deputy.mass": [5, 50]}
    )

    def policy(key: jax.Array, observation: jax.Array) -> jax.Array:
        return jnp.ones((*observation.shape[:-1], 2))

    run = jax.jit(lambda key: jaxsafe.rollout(env, policy, key, 12, num_envs=num_envs))
    timesteps = run(jax.random.key(0))
    mass = np.sqrt(2.0) / np.asarray(timesteps.info.status["delta_v"]).reshape(12, -1)
    assert np.asarray(timesteps.done).reshape(12, -1)[2::3].all()
    episodes = mass.reshape(4, 3, -1)
    np.testing.assert_allclose(
        episodes, np.broadcast_to(episodes[:, :1], episodes.shape), rtol=1e-5
    )
    assert len(np.unique(episodes[:, 0].round(3))) == 4 * (num_envs or 1)


@pytest.mark.thorough
def test_only_the_environments_that_end_draw_anew() -> None:
    env = jaxsafe.make(
        "docking2d", {"terminal.distance.limit": 125.0}, randomize={"deputy.mass": [5, 50]}
    )
    state, _ = reset_many(env, keys(16))
    (after, _), timestep = step_or_reset_batch(env, state, jnp.zeros((16, 2)), jax.random.key(1))
    changed = after.parameters["deputy.mass"] != state.parameters["deputy.mass"]
    assert 0 < timestep.done.sum() < 16
    np.testing.assert_array_equal(changed, timestep.done)
    (alone, _), _ = step_or_reset(
        env, jax.tree.map(lambda leaf: leaf[0], state), jnp.zeros(2), jax.random.key(2)
    )
    assert bool(alone.parameters["deputy.mass"] != state.parameters["deputy.mass"][0]) == bool(
        timestep.done[0]
    )


def test_yaml_reads_and_writes_random_numbers() -> None:
    env = jaxsafe.make("docking2d", randomize={"deputy.mass": [10, 14]})
    text = dump(env)
    assert "randomize: {deputy.mass: [10.0, 14.0]}" in text.replace(
        "\n  deputy", " {deputy"
    ).replace("]\n", "]}\n")
    assert load(text) == env
    written = dump(jaxsafe.make("docking2d")).replace(
        "randomize: {}", "randomize: {deputy.mass: [10, 14]}"
    )
    assert load(written) == env != jaxsafe.make("docking2d")
    with pytest.raises(ConfigError, match=r"^randomize: deputy\.mas: unknown field 'mas'[^\n]*$"):
        load(written.replace("deputy.mass: [", "deputy.mas: ["))


def test_numbers_may_be_overridden_by_traced_values(env: Environment) -> None:
    def first_cost(scale: jax.Array) -> jax.Array:
        changed = jaxsafe.override(env, {"reward.distance_change.scale": scale})
        state, _ = jaxsafe.reset(changed, jax.random.key(0))
        return jaxsafe.step(changed, state, jnp.ones(2))[1].info.reward_terms["distance_change"]

    computed = jax.jit(jax.vmap(first_cost))(jnp.asarray([1.0, 2.0]))
    assert float(computed[0]) != 0.0
    np.testing.assert_allclose(computed[1], 2.0 * computed[0], rtol=1e-4)


@pytest.mark.thorough
def test_leads_turn_differently() -> None:
    path = "lead.controller.commands.heading_rate.at"
    env = jaxsafe.make("rejoin2d", randomize={path: [-0.02, 0.02]})
    state, _ = begun = reset_many(env, keys(32))
    after, _ = step_many(env, begun[0], jnp.zeros((32, 2)))
    turned = after.sim.platforms["lead"].heading - state.sim.platforms["lead"].heading
    np.testing.assert_allclose(turned, state.parameters[path], atol=1e-6)
    assert turned.min() < -0.005
    assert turned.max() > 0.005
    assert len(np.unique(turned)) > 28


def test_equal_environments_start_alike_whatever_order_their_numbers_were_written_in() -> None:
    intervals = {"deputy.mean_motion": [0.001, 0.002], "deputy.mass": [10, 14], "dt": [0.5, 2.0]}
    backwards = dict(reversed(intervals.items()))
    first, second = (
        jaxsafe.make("docking2d", randomize=randomize) for randomize in (intervals, backwards)
    )
    assert first == second
    assert dump(first) == dump(second)
    # No check has seen this order of the intervals.
    bare = first.replace(randomize=dict(reversed(first.randomize.items())))
    expected = reset(first, keys()[0])[0].parameters
    for env in (first, second, bare):
        chex.assert_trees_all_equal(jaxsafe.reset(env, keys()[0])[0].parameters, expected)
        chex.assert_trees_all_equal(reset(env, keys()[0])[0].parameters, expected)


@pytest.mark.thorough
def test_a_number_of_the_filter_may_be_random() -> None:
    env = jaxsafe.make(
        "docking2d", rta="default", randomize={"rta.margin": [2e-4, 1e-3], "deputy.mass": [10, 14]}
    )
    margins = np.asarray(reset_many(env, keys())[0].parameters["rta.margin"])
    assert len(np.unique(margins)) == 64
    assert margins.min() >= 2e-4
    assert margins.max() <= 1e-3
    assert load(dump(env)) == env
    with pytest.raises(
        ConfigError, match=r"^randomize: rta\.margin: rta has no fields because it is not set$"
    ):
        jaxsafe.make("docking2d", randomize={"rta.margin": [2e-4, 1e-3]})


def test_two_paths_of_one_number_are_refused() -> None:
    with pytest.raises(
        ConfigError,
        match=r"^randomize: platforms\.deputy\.mass and deputy\.mass are the same number",
    ):
        jaxsafe.make(
            "docking2d", randomize={"deputy.mass": [1, 2], "platforms.deputy.mass": [3, 4]}
        )
