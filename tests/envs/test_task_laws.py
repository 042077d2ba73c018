"""The laws that every task keeps, with continuous and with discrete actions.

One more environment, composed in YAML, keeps them too.
"""

import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind, thorough
from jax.flatten_util import ravel_pytree

import jaxsafe
from jaxsafe import ConfigError, Environment, metrics
from jaxsafe.config import dump, load
from jaxsafe.envs import TASKS
from jaxsafe.schema.component import Component, fields
from jaxsafe.types import State, TimeStep

CUSTOM = "custom_env"
VARIANTS = [(task, actions) for task in (*TASKS, CUSTOM) for actions in ("continuous", "discrete")][
    :-1
]
BY_DEFAULT = (
    ("docking2d", "continuous"),
    ("docking2d", "discrete"),
    ("rejoin2d", "continuous"),
)
"""Variants of which the default suite tests every law."""
REJOIN = [task for task in TASKS if task.startswith("rejoin")]
NUM_STEPS = 40
NUM_ENVS = 5

REJOIN_POINT = 500.0 * np.asarray([np.cos(4 * np.pi / 3), np.sin(4 * np.pi / 3)])
"""The rejoin point of Eq. (6) for a lead that flies along x."""

DIVISORS = {
    "rejoin2d": [1000, 1, 1, 1000, 1, 1, 400, 1, 1, 400, 1, 1],
    "rejoin3d": [1000, 1, 1, 1, 1000, 1, 1, 1, 400, 1, 1, 1, 400, 1, 1, 1, np.pi / 3, np.pi / 9],
    "docking2d": [100, 100, 0.5, 0.5, 1, 1],
    "docking3d": [100, 100, 100, 0.5, 0.5, 0.5, 1, 1],
    "docking2d_oriented": [100, 100, 0.5, 0.5, -1, -1, np.pi / 90, 1, 1],
    CUSTOM: [100, 100, 0.5, 0.5, 1, 1, 100, 1, 1, 1],
}
"""Divisors of the observations, from Tables 5 and 6."""

OWN_DIRECTION = {"wingman_velocity.x", "wingman_velocity.y", "wingman_velocity.z"}
"""Elements that are constant.

An aircraft flies forwards, so in its own frame its velocity points along x.
"""

ALIKE_AT_START = {
    "rejoin2d": {
        "lead_position.magnitude",
        "rejoin_position.magnitude",
        *sorted(OWN_DIRECTION)[:2],
    },
    "rejoin3d": {"lead_position.magnitude", "rejoin_position.magnitude", *OWN_DIRECTION}
    | {"lead_velocity.z", "roll", "flight_path_angle"},
    "docking2d_oriented": {"attitude_rate"},
}
"""Elements that do not vary among starts.

Far away distances are clipped to 1. Aircraft start in level flight with level wings. The deputy
starts without spin.
"""

TRACED: list[str] = []


@jax.jit
def reset(env: Environment, key: jax.Array) -> tuple[State, TimeStep]:
    TRACED.append("reset")
    return jaxsafe.reset(env, key)


@jax.jit
def step(env: Environment, state: State, action: jax.Array) -> tuple[State, TimeStep]:
    TRACED.append("step")
    return jaxsafe.step(env, state, action)


@jax.jit
def run(env: Environment, state: State, actions: jax.Array) -> tuple[State, TimeStep]:
    """Take one action after the other, without resets.

    Return states and time steps [envs, steps].
    """

    def advance(state: State, action: jax.Array) -> tuple[State, tuple[State, TimeStep]]:
        state, timestep = jaxsafe.step(env, state, action)
        return state, (state, timestep)

    return jax.vmap(lambda state, actions: jax.lax.scan(advance, state, actions)[1])(state, actions)


reset_many = jax.jit(jax.vmap(jaxsafe.reset, in_axes=(None, 0)))
step_many = jax.jit(jax.vmap(jaxsafe.step, in_axes=(None, 0, 0)))
place_many = jax.jit(jax.vmap(jaxsafe.reset_to, in_axes=(None, 0, None)))


def build(task: str, actions: str = "continuous", **options: Any) -> Environment:
    path = Path(__file__).parents[2] / "configs" / f"{task}.yaml"
    return jaxsafe.make(str(path) if task == CUSTOM else task, actions=actions, **options)


@pytest.fixture(
    scope="module",
    params=[variant if variant in BY_DEFAULT else thorough(variant) for variant in VARIANTS],
    ids="-".join,
)
def variant(request: pytest.FixtureRequest) -> tuple[str, str]:
    return request.param


@pytest.fixture(scope="module")
def task(variant: tuple[str, str]) -> str:
    return variant[0]


@pytest.fixture(scope="module")
def env(variant: tuple[str, str]) -> Environment:
    return build(*variant)


@pytest.fixture(scope="module")
def started(env: Environment) -> tuple[State, TimeStep]:
    """Return random starts, [NUM_ENVS]."""
    return reset_many(env, keys())


@pytest.fixture(scope="module")
def first(env: Environment, task: str, started: tuple[State, TimeStep]) -> tuple[State, TimeStep]:
    """Return the starts of the random rollouts.

    They are random for docking. For rejoin they are close to the lead, where no distance is
    clipped.
    """
    if task not in REJOIN:
        return started
    offsets = ([-20.0, 5.0], [-300.0, 40.0], REJOIN_POINT, [-200.0, 300.0], [-800.0, -300.0])
    starts = [
        rejoin_start(env, offset, angle)
        for offset, angle in zip(offsets, np.linspace(0.0, 0.4, NUM_ENVS), strict=True)
    ]
    for start, speed in zip(starts, np.linspace(250.0, 300.0, NUM_ENVS), strict=True):
        start["lead"]["speed"] = speed
    return place(env, starts)


@pytest.fixture(scope="module")
def rollouts(env: Environment, first: tuple[State, TimeStep]) -> tuple[State, TimeStep]:
    """Take random actions from these starts, without resets. Return [NUM_ENVS, NUM_STEPS]."""
    return run(env, first[0], random_actions(env, NUM_ENVS, NUM_STEPS))


@pytest.fixture(scope="module")
def timesteps(rollouts: tuple[State, TimeStep]) -> TimeStep:
    return rollouts[1]


def keys() -> jax.Array:
    return jax.random.split(jax.random.key(7), NUM_ENVS)


def random_actions(env: Environment, *shape: int) -> jax.Array:
    key = jax.random.key(11)
    shape = (*shape, env.action_size)
    if env.num_action_points:
        return jax.random.randint(key, shape, 0, jnp.asarray(env.num_action_points))
    return jax.random.uniform(key, shape, minval=-1.0)


def action(env: Environment, share: Any) -> jax.Array:
    """Return the action at these shares, in [−1, 1], of the actuators' ranges."""
    share = jnp.broadcast_to(jnp.asarray(share, float), (env.action_size,))
    points = jnp.asarray(env.num_action_points)
    return jnp.round((share + 1.0) / 2.0 * (points - 1)).astype(int) if points.size else share


def item(tree: Any, index: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def pad(env: Environment, vector: Any) -> np.ndarray:
    """Return a vector of the plane in the environment's space."""
    return np.append(vector, np.zeros(env.agent_platform.dimension - 2))


def place(env: Environment, starts: list[dict[str, Any]]) -> tuple[State, TimeStep]:
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *starts)
    return place_many(env, stacked, dict.fromkeys(env.randomize, 12.0))


def docking_start(
    env: Environment, position: Any, velocity: Any = (0.0, 0.0), **fields: float
) -> dict[str, Any]:
    fields = (
        {"attitude": 0.3, "attitude_rate": 0.0} | fields
        if "attitude" in env.agent_platform.random_fields
        else {}
    )
    return {"deputy": {"position": pad(env, position), "velocity": pad(env, velocity), **fields}}


def rejoin_start(
    env: Environment, offset: Any, heading: float = 0.0, speed: float = 300.0, **angles: float
) -> Any:
    """Return a start with the lead at the origin and the wingman at an offset from it.

    The lead flies along x at 300 ft/s.
    """
    angles = (
        {"roll": 0.0, "flight_path_angle": 0.0} | angles
        if env.agent_platform.dimension == 3
        else {}
    )
    lead = {"position": pad(env, (0.0, 0.0)), "heading": 0.0, "speed": 300.0}
    return {
        "lead": lead,
        "wingman": {"position": pad(env, offset), "heading": heading, "speed": speed, **angles},
    }


def inside(env: Environment, task: str) -> dict[str, Any]:
    """Return a start in the region from which a step without control stays in it."""
    return rejoin_start(env, REJOIN_POINT) if task in REJOIN else docking_start(env, [0.45, 0.0])


def edges(env: Environment, task: str) -> list[dict[str, Any]]:
    """Return starts at which something is 0, or on a limit, or far away."""
    if task in REJOIN:
        roll = np.pi / 3
        gamma = np.pi / 9
        return [
            rejoin_start(env, [0.0, 0.0]),
            rejoin_start(env, REJOIN_POINT),
            rejoin_start(env, [500.0, 0.0], speed=200.0, roll=roll, flight_path_angle=gamma),
            rejoin_start(env, [0.0, 500.0], speed=400.0, roll=-roll, flight_path_angle=-gamma),
            rejoin_start(env, [1e8, 1e8], heading=1e4),
        ]
    return [
        docking_start(env, [0.0, 0.0]),
        docking_start(env, [0.5, 0.0]),
        docking_start(env, [0.0, 50.0]),  # the centre of the custom environment's zone
        docking_start(env, [100.0, 0.0], [0.2, 0.0], attitude=-np.pi, attitude_rate=np.pi / 90),
        docking_start(env, [1e8, 1e8], [0.0, 1e4], attitude_rate=-np.pi / 90),
    ]


def test_with_and_without_jit_are_the_same(env: Environment) -> None:
    chex.assert_trees_all_close(
        jaxsafe.reset(env, keys()[0]), reset(env, keys()[0]), rtol=1e-5, atol=1e-5
    )
    state = reset(env, keys()[0])[0]
    taken = random_actions(env)
    chex.assert_trees_all_close(
        jaxsafe.step(env, state, taken), step(env, state, taken), rtol=1e-5, atol=1e-5
    )


def test_a_batch_of_states_is_a_loop_over_states(
    env: Environment, started: tuple[State, TimeStep]
) -> None:
    actions = random_actions(env, NUM_ENVS)
    stepped = step_many(env, started[0], actions)
    for i in range(NUM_ENVS):
        chex.assert_trees_all_close(item(started, i), reset(env, keys()[i]), rtol=1e-5, atol=1e-5)
        alone = step(env, item(started[0], i), actions[i])
        chex.assert_trees_all_close(item(stepped, i), alone, rtol=1e-5, atol=1e-5)


def test_a_batch_of_parameters_is_a_loop_over_overrides(
    env: Environment, started: tuple[State, TimeStep]
) -> None:
    state = item(started[0], 0)
    taken = action(env, 1.0)
    actuator = f"{env.agent}.controller.actuators.{env.action_names[0]}.high"

    def changed(high: Any, dt: Any, farthest: Any) -> Environment:
        return jaxsafe.override(
            env, {actuator: high, "dt": dt, "terminal.distance.limit": farthest}
        )

    numbers = [0.1, 0.2, 0.3], [0.5, 1.0, 2.0], [1.0, 1e6, 10.0]
    batch = jax.jit(jax.vmap(lambda *values: jaxsafe.step(changed(*values), state, taken)))(
        *map(jnp.asarray, numbers)
    )
    for i, values in enumerate(zip(*numbers, strict=True)):
        chex.assert_trees_all_close(
            item(batch, i), step(changed(*values), state, taken), rtol=1e-5, atol=1e-5
        )
    np.testing.assert_allclose(batch[1].info.control_desired[:, 0], numbers[0], rtol=1e-6)
    np.testing.assert_array_equal(batch[0].sim.time, numbers[1])
    assert batch[1].terminated.tolist() == [True, False, True]


def test_a_batch_of_environments_steps_as_each_of_them(
    env: Environment, started: tuple[State, TimeStep]
) -> None:
    changes = [
        {"reward.distance_change.scale": scale, "dt": dt}
        for scale, dt in ((6, 1), (12, 2), (24, 0.5))
    ]
    changed_envs = [jaxsafe.override(env, change) for change in changes]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *changed_envs)
    states = jax.tree.map(lambda leaf: leaf[:3], started[0])
    actions = random_actions(env, 3)
    stepped = jax.jit(jax.vmap(jaxsafe.step))(batch, states, actions)
    for i in range(3):
        alone = step(changed_envs[i], item(states, i), actions[i])
        chex.assert_trees_all_close(item(stepped, i), alone, rtol=1e-5, atol=1e-5)


def test_the_same_key_and_actions_give_the_same_bits(
    env: Environment, started: tuple[State, TimeStep]
) -> None:
    chex.assert_trees_all_equal(reset_many(env, keys()), started)
    state = item(started[0], 0)
    taken = random_actions(env)
    chex.assert_trees_all_equal(step(env, state, taken), step(env, state, taken))


@pytest.mark.parametrize("x64", [False, True])
def test_reset_and_step_agree_in_structure_shape_and_dtype(
    variant: tuple[str, str], x64: bool
) -> None:
    def shapes(tree: Any) -> Any:
        return jax.tree.map(
            lambda leaf: (leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)), tree
        )

    with jax.enable_x64(x64):
        agent = build(*variant).agent
        env = build(
            *variant,
            randomize={
                f"{agent}.controller.actuators.{build(*variant).action_names[0]}.high": [1, 2]
            },
        )
        started = jax.eval_shape(jaxsafe.reset, env, jax.random.key(0))
        stepped = jax.eval_shape(jaxsafe.step, env, started[0], action(env, 0.0))
        chex.assert_trees_all_equal_structs(started, stepped)
        assert shapes(started) == shapes(stepped)
        assert len(started[0].parameters) == 1
        kinds = {leaf.dtype for leaf in jax.tree.leaves(stepped)}
        assert kinds == {np.dtype(jnp.result_type(float)), np.dtype("int32"), np.dtype("bool")}


def test_any_numbers_compile_once(env: Environment, task: str) -> None:
    numbers = (10, 11.0, np.float32(12.0), np.float64(13.0), jnp.asarray(14.0), jnp.asarray(15))
    changed = [
        jaxsafe.override(env, {"dt": dt, "reward.failure.values.distance": -dt}) for dt in numbers
    ]
    step(env, reset(env, keys()[0])[0], random_actions(env))
    num_traces = len(TRACED)
    for variant in (env, *changed, jax.tree.map(lambda leaf: leaf * 1.5, env)):
        state, _ = reset(variant, keys()[0])
        for taken in random_actions(env, 2):
            state, _ = step(variant, state, taken)
    state, _ = jaxsafe.reset_to(env, inside(env, task), dict.fromkeys(env.randomize, 12))
    step(env, state, np.asarray(random_actions(env)))
    assert len(TRACED) == num_traces > 0


def test_what_is_dumped_loads_as_the_same_environment(
    env: Environment, variant: tuple[str, str]
) -> None:
    assert load(dump(env)) == env
    if variant[0] != CUSTOM:
        released = build(*variant, variant="released")
        assert load(dump(released)) == released != env


# Observations


def test_starts_vary_in_every_element(
    started: tuple[State, TimeStep], env: Environment, task: str
) -> None:
    spread = np.asarray(started[1].observation).std(axis=0)
    alike = {
        name
        for name, deviation in zip(env.observation_names, spread, strict=True)
        if deviation < 1e-5
    }
    assert alike == ALIKE_AT_START.get(task, set())


def test_no_element_of_the_observation_is_constant(timesteps: TimeStep, env: Environment) -> None:
    for name, column in zip(
        env.observation_names, np.moveaxis(np.asarray(timesteps.observation), -1, 0), strict=True
    ):
        if name in OWN_DIRECTION:
            np.testing.assert_allclose(column, float(name.endswith("x")), atol=1e-5)
        else:
            # The lead keeps its speed, so its magnitude does not vary.
            assert (column.std(axis=1) > 1e-4).all() or name == "lead_velocity.magnitude", name
            assert column.std(axis=0).max() > 1e-3, name


def test_normalisation_undone_returns_the_raw_vector(
    rollouts: tuple[State, TimeStep], task: str
) -> None:
    states, timesteps = jax.tree.map(np.asarray, rollouts)
    divisors = np.asarray(DIVISORS[task])
    for index in range(NUM_ENVS):
        for t in range(0, NUM_STEPS, 7):
            raw = raw_observation(task, item(item(states, index), t))
            seen = np.clip(raw, -np.abs(divisors), np.abs(divisors)) if task in REJOIN else raw
            np.testing.assert_allclose(
                timesteps.observation[index, t] * divisors, seen, rtol=1e-5, atol=1e-5
            )


def raw_observation(task: str, state: State) -> np.ndarray:
    """Return the observation of Tables 5 and 6 in physical units."""
    if task in REJOIN:
        lead = state.sim.platforms["lead"]
        wingman = state.sim.platforms["wingman"]
        behind = lead.heading + 4 * np.pi / 3
        offset = np.append(
            500 * np.asarray([np.cos(behind), np.sin(behind)]), np.zeros(lead.position.size - 2)
        )
        away = lead.position.astype(float) - wingman.position
        seen = [away, away + offset, flight(wingman), flight(lead)]
        angles = [wingman.roll, wingman.flight_path_angle] if task == "rejoin3d" else []
        return np.concatenate([*(mag_norm(axes(wingman).T @ vector) for vector in seen), angles])
    deputy = state.sim.platforms["deputy"]
    speed = np.linalg.norm(deputy.velocity)
    limits = [speed, 0.2 + 2 * 0.001027 * np.linalg.norm(deputy.position)]
    if task == "docking2d_oriented":
        c = np.cos(deputy.attitude)
        s = np.sin(deputy.attitude)
        turn = np.asarray([[c, s], [-s, c]])
        return np.concatenate(
            [-turn @ deputy.position, turn @ deputy.velocity, [c, s, deputy.attitude_rate], limits]
        )
    zone = [] if task != CUSTOM else mag_norm(np.asarray([0.0, 50.0]) - deputy.position)
    slow = [] if task != CUSTOM else [0.1 + 0.01 * max(zone[0] - 20.0, 0.0)]
    return np.concatenate([deputy.position, deputy.velocity, limits, zone, slow])


def flight(aircraft: Any) -> np.ndarray:
    return float(aircraft.speed) * axes(aircraft)[:, 0]


def axes(aircraft: Any) -> np.ndarray:
    """Return R_z(ψ)·R_y(γ)·R_x(φ). Its columns are the axes of the body."""
    c = np.cos(float(aircraft.heading))
    s = np.sin(float(aircraft.heading))
    if aircraft.position.size == 2:
        return np.asarray([[c, -s], [s, c]])
    cp = np.cos(float(aircraft.flight_path_angle))
    sp = np.sin(float(aircraft.flight_path_angle))
    cr = np.cos(float(aircraft.roll))
    sr = np.sin(float(aircraft.roll))
    yaw = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    pitch = [[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]
    return np.asarray(yaw) @ np.asarray(pitch) @ np.asarray([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])


def mag_norm(vector: np.ndarray) -> np.ndarray:
    return np.append(np.linalg.norm(vector), vector / np.linalg.norm(vector))


# Finite, and within limits


def test_everything_stays_finite(rollouts: tuple[State, TimeStep]) -> None:
    chex.assert_tree_all_finite(rollouts)


def test_everything_stays_finite_at_the_edges_of_space(env: Environment, task: str) -> None:
    state, timestep = place(env, edges(env, task))
    chex.assert_tree_all_finite((state, timestep))
    chex.assert_tree_all_finite(run(env, state, random_actions(env, NUM_ENVS, NUM_STEPS)))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("task", "actions"),
    one_of_each_kind(
        itertools.product([*REJOIN, "docking2d_oriented"], ["continuous", "discrete"]),
        [("rejoin2d", "continuous"), ("docking2d_oriented", "discrete")],
    ),
)
def test_limits_are_reached_and_never_exceeded(task: str, actions: str) -> None:
    env = build(task, actions)
    flown = [
        random_actions(env, 200),
        *(jnp.broadcast_to(action(env, share), (200, env.action_size)) for share in (1, -1)),
    ]
    blocks = jnp.stack([action(env, np.sign(np.sin(t / 7.0))) for t in range(1, 201)])
    flown += [blocks, 3 * flown[1] - flown[2]]
    states, _ = run(env, reset_many(env, keys())[0], jnp.stack(flown))
    agent = jax.tree.map(np.asarray, states.sim.platforms[env.agent])
    limits = (
        {"speed": (200.0, 400.0)}
        if task in REJOIN
        else {"attitude_rate": (-np.pi / 90, np.pi / 90)}
    )
    if task == "rejoin3d":
        limits |= {"flight_path_angle": (-np.pi / 9, np.pi / 9), "roll": (-np.pi / 3, np.pi / 3)}
    for name, (low, high) in limits.items():
        computed = getattr(agent, name)
        assert (computed.min(), computed.max()) == (np.float32(low), np.float32(high)), name
    if task == "docking2d_oriented":
        assert agent.attitude.min() >= -np.float32(np.pi)
        assert agent.attitude.max() < np.float32(np.pi)
        assert np.ptp(agent.attitude) > 6.0


# Rewards, costs and ends


def test_the_terms_sum_to_the_reward_and_to_the_totals(timesteps: TimeStep) -> None:
    terms = {name: np.asarray(term, float) for name, term in timesteps.info.reward_terms.items()}
    np.testing.assert_allclose(timesteps.reward, sum(terms.values()), atol=1e-5)
    for name, total in timesteps.info.reward_totals.items():
        np.testing.assert_allclose(total, terms[name].cumsum(axis=1), atol=1e-4)


def test_the_distance_reward_telescopes(
    timesteps: TimeStep, first: tuple[State, TimeStep], task: str
) -> None:
    name, half = ("lead_distance", 5000.0) if task in REJOIN else ("docking_distance", 100.0)
    before, after = (
        np.asarray(info.status[name], float) for info in (first[1].info, timesteps.info)
    )
    total = np.asarray(timesteps.info.reward_terms["distance_change"], float).cumsum(axis=1)
    np.testing.assert_allclose(
        total, 2.0 * 0.5 ** (after / half) - 2.0 * 0.5 ** (before / half)[:, None], atol=1e-5
    )
    assert np.abs(total).max() > 1e-3


def test_cost_is_one_exactly_where_a_margin_is_negative(
    timesteps: TimeStep, env: Environment
) -> None:
    info = jax.tree.map(np.asarray, timesteps.info)
    violated = np.any([margin < 0.0 for margin in info.margins.values()], axis=0)
    np.testing.assert_array_equal(timesteps.cost, np.where(violated, 1.0, 0.0))
    assert 0.0 < timesteps.cost.mean() < 1.0
    for constraint in env.constraints:
        name = constraint.name
        limit = (
            info.status[constraint.velocity_limit]
            if hasattr(constraint, "speed")
            else float(constraint.minimum)
        )
        np.testing.assert_allclose(
            info.severity[name], np.maximum(-info.margins[name], 0.0) / limit, rtol=1e-5
        )


def coinciding(env: Environment, task: str) -> Environment:
    """Return an environment in which several conditions hold on the first step from `inside`.

    They are success, distance and timeout, and near the lead the crash too.
    """
    changes = {"terminal.timeout.limit": 0.5, "terminal.distance.limit": 0.1}
    return jaxsafe.override(
        env, changes | ({"terminal.success.duration": 0.5} if task in REJOIN else {})
    )


def test_at_most_one_outcome_ends_an_episode(env: Environment, task: str) -> None:
    together = coinciding(env, task)
    if task in REJOIN:
        together = jaxsafe.override(together, {"terminal.crash.limit": 1000.0})
    state, _ = jaxsafe.reset_to(together, inside(env, task), dict.fromkeys(env.randomize, 12.0))
    names = [name for name in env.outcomes[1:] if name not in ("velocity", "diverged")]
    for expected in [name for name in names if name not in ("crash", "keep_out") or task in REJOIN]:
        _, timestep = step(together, state, action(env, 0.0))
        assert [name for name, ended in timestep.info.ended.items() if ended] == [expected]
        assert env.outcomes[int(timestep.info.outcome)] == expected
        together = without(together, expected, task)
    assert expected == "timeout"


def without(env: Environment, outcome: str, task: str) -> Environment:
    """Return the same environment, in which this outcome does not hold any more."""
    docked = {"regions.docking_region.radius": 0.0}
    success = {"terminal.success.duration": 100.0} if task in REJOIN else docked
    never = {
        "success": success,
        "crash": {"terminal.crash.limit": 0.0},
        "distance": {"terminal.distance.limit": 1e6},
    }
    return jaxsafe.override(env, never.get(outcome, {}))


@pytest.mark.parametrize("task", one_of_each_kind(TASKS))
def test_success_and_timeout_are_both_paid_in_the_released_variant(task: str) -> None:
    computed = []
    for variant in ("released", "paper"):
        env = build(task, variant=variant).replace(tied={})
        together = jaxsafe.override(coinciding(env, task), {"terminal.distance.limit": 1e4})
        state, _ = jaxsafe.reset_to(together, inside(env, task))
        _, timestep = step(together, state, action(env, 0.0))
        assert timestep.terminated
        assert env.outcomes[int(timestep.info.outcome)] == "success"
        scale = float(next(term.time_scale for term in env.reward if term.name == "success"))
        assert float(timestep.info.reward_terms["success"]) == pytest.approx(2.0 - 1.0 / scale)
        computed.append(float(timestep.info.reward_terms["failure"]))
    assert computed == [-1.0, 0.0]


def visits(
    task: str, variant: str, offset: Any, accelerations: list[float]
) -> dict[str, np.ndarray]:
    """Fly a wingman along x beside the lead.

    Return whether it was inside and its rewards, by step.
    """
    env = build(task, variant=variant)
    state, timestep = place(env, [rejoin_start(env, np.add(REJOIN_POINT, offset))])
    actions = jnp.stack(
        [action(env, [*(env.action_size - 1) * [0.0], share]) for share in accelerations]
    )
    info = jax.tree.map(np.asarray, run(env, state, actions[None])[1].info)
    facts = {"inside": info.status["in_rejoin"], "stay": info.reward_totals["in_rejoin"]}
    facts |= {"arrival": info.reward_terms["in_rejoin_first_time"]}
    return {
        "before": np.asarray(timestep.info.status["in_rejoin"]),
        **{name: fact[0] for name, fact in facts.items()},
    }


@pytest.mark.thorough
@pytest.mark.parametrize("variant", one_of_each_kind(["paper", "released"], ["released"]))
@pytest.mark.parametrize("task", one_of_each_kind(REJOIN, ["rejoin2d"]))
def test_leaving_the_region_refunds_exactly(task: str, variant: str) -> None:
    facts = visits(task, variant, [0.0, 0.0], [0.0] * 7 + [-1.0] * 6 + [1.0] * 20)
    inside = facts["inside"]
    assert np.diff(inside.astype(int)).tolist().count(1) == 1
    assert np.diff(inside.astype(int)).tolist().count(-1) == 2
    assert (facts["stay"][~inside] == 0.0).all()
    assert (facts["stay"] >= 0.0).all()
    paid = np.float32([sum([np.float32(0.1)] * n, np.float32(0.0)) for n in range(1, 30)])
    for begin in (0, 1 + int(np.flatnonzero(np.diff(inside.astype(int)) == 1)[0])):
        length = int(np.argmin(inside[begin:]))
        expected = (
            np.append(np.float32(0.0), paid)[:length]
            if variant == "released" and begin
            else paid[:length]
        )
        np.testing.assert_array_equal(facts["stay"][begin : begin + length], expected)
    assert facts["stay"].max() > 0.6


@pytest.mark.thorough
@pytest.mark.parametrize("task", one_of_each_kind(REJOIN, ["rejoin2d"]))
@pytest.mark.parametrize("variant", ["paper", "released"])
def test_the_first_time_is_paid_once_an_episode_and_to_those_who_start_inside_only_as_released(
    task: str, variant: str
) -> None:
    script = [1.0] * 12 + [-1.0] * 20
    outside = visits(task, variant, [-500.0, 0.0], script)
    begin = int(np.argmax(outside["inside"]))
    assert begin > 0
    assert np.diff(outside["inside"].astype(int)).tolist().count(1) == 2
    np.testing.assert_array_equal(outside["arrival"], 0.25 * (np.arange(len(script)) == begin))
    within = visits(task, variant, [0.0, 0.0], [0.0] * 3 + [-1.0] * 6 + [1.0] * 20)
    assert within["before"]
    paid = 0.25 * (np.arange(29) == 0) if variant == "released" else np.zeros(29)
    np.testing.assert_array_equal(within["arrival"], paid)


# Symmetry


@pytest.mark.thorough
def test_planar_docking_is_spatial_docking_with_z_zero() -> None:
    envs = [build(f"docking{dimension}d") for dimension in (2, 3)]
    actions = random_actions(envs[0], 1, 30)
    planar, spatial = (
        run(
            env,
            place(env, [docking_start(env, [100.0, -20.0], [0.1, 0.3])])[0],
            pad_actions(env, actions, 0),
        )
        for env in envs
    )
    _agree(planar, spatial, "deputy", ["delta_v", "velocity"])
    keep = [0, 1, 3, 4, 6, 7]
    np.testing.assert_allclose(planar[1].observation, spatial[1].observation[..., keep], rtol=1e-6)
    assert not spatial[1].observation[..., [2, 5]].any()


@pytest.mark.thorough
def test_planar_rejoin_is_spatial_rejoin_in_straight_level_flight() -> None:
    envs = [build("rejoin2d", overrides={"regions.rejoin_region.radius": 100.0}), build("rejoin3d")]
    actions = random_actions(envs[0], 1, 30).at[..., 0].set(0.0)
    starts = [rejoin_start(env, REJOIN_POINT - 100.0, heading=0.2) for env in envs]
    runs = [
        run(env, place(env, [start])[0], pad_actions(env, actions, 1))
        for env, start in zip(envs, starts, strict=True)
    ]
    planar, spatial = runs
    _agree(planar, spatial, "wingman", ["heading", "speed"])
    keep = np.setdiff1d(np.arange(16), [3, 7, 11, 15])
    np.testing.assert_allclose(
        planar[1].observation, spatial[1].observation[..., keep], rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(spatial[1].observation[..., [3, 7, 11, 15, 16, 17]], 0.0, atol=1e-6)


def pad_actions(env: Environment, actions: jax.Array, at: int) -> jax.Array:
    """Add zeros for the actuators that only space has.

    They are the third of docking and the second of rejoin.
    """
    if env.action_size == 2:
        return actions
    return jnp.insert(actions, 2 if at == 0 else 1, 0.0, axis=-1)


def _agree(
    planar: tuple[State, TimeStep], spatial: tuple[State, TimeStep], agent: str, names: list[str]
) -> None:
    flat, deep = (states.sim.platforms[agent] for states in (planar[0], spatial[0]))
    np.testing.assert_allclose(flat.position, deep.position[..., :2], rtol=1e-5, atol=1e-3)
    for name in names:
        here = getattr(flat, name)
        there = getattr(deep, name)
        np.testing.assert_allclose(
            here, there[..., :2] if there.ndim == 3 else there, rtol=1e-5, atol=1e-5
        )
    assert not deep.position[..., 2].any()
    chex.assert_trees_all_close(planar[1].reward, spatial[1].reward, atol=1e-5)
    chex.assert_trees_all_close(planar[1].info.status, spatial[1].info.status, rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(planar[1].cost, spatial[1].cost)


@pytest.mark.thorough
@pytest.mark.parametrize(("x64", "tolerance"), [(True, 1e-9), thorough(False, 2e-3)])
@pytest.mark.parametrize("task", one_of_each_kind(REJOIN, ["rejoin2d"]))
def test_rejoin_does_not_change_when_the_whole_world_is_moved_and_turned(
    task: str, x64: bool, tolerance: float
) -> None:
    with jax.enable_x64(x64):
        env = build(task)
        draw = np.random.default_rng(3)
        start = rejoin_start(env, [-600.0, -300.0], heading=0.3, roll=0.2, flight_path_angle=-0.1)
        motions = [(0.0, pad(env, [0.0, 0.0]))]
        motions += [
            (draw.uniform(-7, 7), draw.uniform(-1e4, 1e4, env.agent_platform.dimension))
            for _ in range(4)
        ]
        state, begun = place(env, [moved(start, *motion) for motion in motions])
        actions = jnp.broadcast_to(random_actions(env, 20), (len(motions), 20, env.action_size))
        timesteps = run(env, state, actions)[1]
        for computed in (
            begun.observation,
            timesteps.observation,
            timesteps.reward,
            timesteps.info.margins["collision"] / 100,
        ):
            np.testing.assert_allclose(
                computed,
                np.broadcast_to(computed[:1], computed.shape),
                rtol=tolerance,
                atol=tolerance,
            )


def moved(start: dict[str, Any], turn: float, shift: np.ndarray) -> dict[str, Any]:
    """Return the start after turning the world about the origin's vertical axis and shifting it."""
    matrix = np.eye(shift.size)
    matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    return {
        name: fields
        | {"position": matrix @ fields["position"] + shift, "heading": fields["heading"] + turn}
        for name, fields in start.items()
    }


# Derivatives


def slopes_at(env: Environment, task: str) -> tuple[dict[str, Any], dict[str, float]]:
    """Return a start and parameters where every term but the ends has a slope.

    Nothing is clipped there.
    """
    shared = {"dt": 0.9, "reward.distance_change.scale": 3.0}
    if task in REJOIN:
        angles = {"roll": 0.2, "flight_path_angle": 0.1}
        start = rejoin_start(env, [-300.0, 400.0], heading=0.3, **angles)
        parameters = {
            "wingman.controller.actuators.acceleration.high": 90.0,
            "reward.distance_change.half_distance": 900.0,
        }
        parameters |= {"wingman.gravity": 30.0} if task == "rejoin3d" else {}
        return start, shared | parameters | {"lead.controller.commands.heading_rate.at": 0.01}
    parameters = {"deputy.mass": 3.0, "deputy.mean_motion": 0.01, "reward.delta_v.scale": -0.5}
    parameters |= {"status.velocity_limit.floor": 0.3, "reward.velocity_constraint.scale": -0.2}
    if task == CUSTOM:  # its mass is drawn for each episode
        del parameters["deputy.mass"]
    return docking_start(env, [100.0, 30.0], [0.2, 2.0], attitude_rate=0.01), shared | parameters


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("task", "actions"),
    one_of_each_kind(
        [*((task, "continuous") for task in (*TASKS, CUSTOM)), ("docking2d", "discrete")],
        [("docking3d", "continuous"), ("rejoin2d", "continuous")],
    ),
)
@pytest.mark.usefixtures("x64")
def test_derivatives_of_a_return_are_those_of_finite_differences(task: str, actions: str) -> None:
    env = build(task, actions)
    start, parameters = slopes_at(env, task)
    state = item(place(env, [start])[0], 0)
    taken = random_actions(env, 5) * (1 if actions == "discrete" else 0.2)

    def episode_return(inputs: tuple[dict[str, jax.Array], jax.Array]) -> jax.Array:
        changed = jaxsafe.override(env, inputs[0])
        _, timesteps = jax.lax.scan(
            lambda state, action: jaxsafe.step(changed, state, action), state, inputs[1]
        )
        return jnp.sum(timesteps.reward) + jnp.sum(
            timesteps.observation**2 * jnp.arange(1, env.observation_size + 1)
        )

    if actions == "continuous":
        point, unravel = ravel_pytree((parameters, taken))
    else:
        point, unravel = ravel_pytree(parameters)
        unravel = (lambda split: lambda point: (split(point), taken))(unravel)
    value = jax.jit(jax.vmap(lambda point: episode_return(unravel(point))))
    nudges = 1e-6 * jnp.eye(point.size)
    expected = (value(point + nudges) - value(point - nudges)) / 2e-6
    computed = jax.jit(jax.grad(lambda point: episode_return(unravel(point))))(point)
    np.testing.assert_allclose(computed, expected, rtol=1e-5, atol=1e-6)
    # The last turns cannot change the return any more.
    assert (np.abs(computed) > 1e-6).sum() >= computed.size - env.action_size


@pytest.mark.parametrize("task", one_of_each_kind([*TASKS, CUSTOM], ["docking2d"]))
def test_derivatives_are_finite_at_the_edges(task: str) -> None:
    env = build(task)
    states, _ = place(env, edges(env, task))

    def slopes(state: State, share: jax.Array) -> list[jax.Array]:
        def outputs(env: Environment, sim: Any, action: jax.Array) -> list[jax.Array]:
            after, timestep = jaxsafe.step(env, state.replace(sim=sim), action)
            info = timestep.info
            return jax.tree.leaves(
                (
                    timestep.reward,
                    timestep.observation,
                    info.margins,
                    info.severity,
                    after.sim.platforms,
                )
            )

        values, pull_back = jax.vjp(
            outputs, env, state.sim, jnp.broadcast_to(share, env.action_size)
        )
        computed = jax.tree.leaves(pull_back([jnp.ones_like(value) for value in values]))
        return [leaf for leaf in computed if jnp.issubdtype(leaf.dtype, jnp.floating)]

    computed = jax.jit(jax.vmap(jax.vmap(slopes, (None, 0)), (0, None)))(
        states, jnp.asarray([0.0, 1.0, -1.0, 0.5])
    )
    assert len(computed) > 30
    assert any(leaf.any() for leaf in computed)
    chex.assert_tree_all_finite(computed)


# States that are not finite


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf], ids=str)
def test_an_episode_whose_state_is_not_finite_ends_as_a_violation_and_a_failure(
    env: Environment, task: str, value: float
) -> None:
    state, first = reset(env, jax.random.key(0))
    for place, leaf in enumerate(jax.tree.leaves(state.sim.platforms[env.agent])):
        broken = jax.tree.leaves(state.sim.platforms[env.agent])
        broken[place] = jnp.full_like(leaf, value)
        own = jax.tree.unflatten(jax.tree.structure(state.sim.platforms[env.agent]), broken)
        platforms = {**state.sim.platforms, env.agent: own}
        begun = state.replace(sim=state.sim.replace(platforms=platforms))
        after, timestep = step(env, begun, action(env, 0.0))
        numbers = [
            leaf for leaf in jax.tree.leaves(after.sim.platforms) if leaf.dtype == jnp.float32
        ]
        if all(np.isfinite(leaf).all() for leaf in numbers):
            continue  # a field that the step computes anew
        assert timestep.terminated
        outcome = env.outcomes[int(timestep.info.outcome)]
        if outcome == "distance":  # an infinite distance is too far
            assert np.isinf(value)
            continue
        assert outcome == "diverged"
        assert [name for name, ended in timestep.info.ended.items() if ended] == ["diverged"]
        assert timestep.cost == 1.0
        assert all(0.0 <= float(severity) <= 1.0 for severity in timestep.info.severity.values())
        assert not env.succeeded(timestep.info.outcome)
        sums = metrics.accumulate(metrics.begin(first), timestep)
        computed = metrics.summarise(
            jax.tree.map(lambda leaf: leaf[None], sums), env.success_indices
        )
        assert computed["success_rate"] == 0.0
        assert computed["safety_violation_rate"] == computed["episode_safety_violation_rate"] == 1.0


def test_an_action_that_is_not_a_number_ends_the_episode(env: Environment) -> None:
    if env.num_action_points:
        return
    state, _ = reset(env, jax.random.key(0))
    _, timestep = step(env, state, action(env, np.nan))
    assert env.outcomes[int(timestep.info.outcome)] == "diverged"
    assert (timestep.cost, bool(timestep.terminated)) == (1.0, True)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["docking3d", "docking2d_oriented", "rejoin2d", "rejoin3d"])
def test_a_number_at_either_end_of_what_is_allowed_gives_finite_states(task: str) -> None:
    @jax.jit
    def finite(env: Environment, keys: jax.Array) -> jax.Array:
        state, timestep = jax.vmap(jaxsafe.reset, in_axes=(None, 0))(env, keys)
        seen = [state, timestep]
        for index in range(3):
            action = jnp.full((len(keys), env.action_size), (-1.0) ** index)
            state, timestep = jax.vmap(jaxsafe.step, in_axes=(None, 0, 0))(env, state, action)
            seen += [state, timestep]
        floats = [
            leaf for leaf in jax.tree.leaves(seen) if jnp.issubdtype(leaf.dtype, jnp.floating)
        ]
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in floats]))

    env = jaxsafe.make(task)
    keys = jax.random.split(jax.random.key(0), 4)
    accepted = 0
    for path, shape in paths_of_numbers(env):
        for size in (1e12, 1e9, 1e5, 1e3, 1e-3, 1e-6, 0.0):
            for value in (size, -size):
                try:
                    changed = jaxsafe.override(env, {path: np.full(shape, value)})
                except ConfigError:
                    continue
                accepted += 1
                assert finite(changed, keys), (path, value)
    assert accepted > 200


def paths_of_numbers(
    component: Component, place: str = ""
) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Return the dotted path and the shape of every number of an environment."""
    for name, field in fields(type(component)).items():
        value = getattr(component, name)
        here = f"{place}{name}"
        if field.unit:
            yield from [] if value is None else [(here, value.shape)]
        elif isinstance(value, Component):
            yield from paths_of_numbers(value, f"{here}.")
        elif isinstance(value, tuple):
            for part in value:
                yield from (
                    paths_of_numbers(part, f"{here}.{part.name}.")
                    if isinstance(part, Component)
                    else ()
                )
        elif isinstance(value, Mapping):
            yield from ((f"{here}.{key}", ()) for key in value)
