"""`variant="released"` reproduces everything recorded from the released implementation.

`golden/README.md` says what was recorded. In x64, statuses, observations, rewards and ends from the
recorded states agree within 1e-9, over whole episodes with their memories. Motion over one step
from every recorded state agrees within 1e-10 m (docking), 1e-8 m (oriented), 1e-6 ft (rejoin2d) and
1e-3 ft (rejoin3d). Steps on which the recorded integrator met a limit are left out.

In float32, in which training runs, docking episodes of up to 2001 steps stay within 5 mm of the
recordings. Rejoin steps stay within 0.1 ft, 3e5 ft from the origin.
"""

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind, thorough
from scipy import stats

import jaxsafe
from jaxsafe import Environment
from jaxsafe.envs import TASKS
from jaxsafe.simulation.platform import Platform
from jaxsafe.transition import bounds
from jaxsafe.types import State, TimeStep

GOLDEN = Path(__file__).parents[1] / "golden"
RECORDINGS = [
    *TASKS,
    "rejoin2d_rta",
    "rejoin2d_discrete",
    "rejoin3d_discrete",
    "docking2d_discrete",
    "docking2d_oriented_discrete",
]
SCATTERED = [f"{task}_transitions" for task in TASKS]

COLUMNS: dict[str, dict[str, Any]] = {
    "rejoin2d": {"position": slice(0, 2), "heading": 2, "speed": 3},
    "rejoin3d": {
        "position": slice(0, 3),
        "heading": 3,
        "flight_path_angle": 4,
        "roll": 5,
        "speed": 6,
    },
    "docking2d": {"position": slice(0, 2), "velocity": slice(2, 4)},
    "docking3d": {"position": slice(0, 3), "velocity": slice(3, 6)},
    "docking2d_oriented": {
        "position": slice(0, 2),
        "attitude": 2,
        "velocity": slice(3, 5),
        "attitude_rate": 5,
    },
}
# The chief rests at the origin and is not recorded.
PLATFORMS = {"rejoin": ("lead", "wingman"), "docking": ("deputy",)}
REWARDS = {
    "rejoin": ("in_rejoin", "in_rejoin_first_time", "distance_change", "failure", "success"),
    "docking": ("distance_change", "delta_v", "velocity_constraint", "failure", "success"),
}
FAILURES = {
    "rejoin": ("running", "crash", "timeout", "distance"),
    "docking": ("running", "crash", "timeout", "distance", "velocity"),
}
STATUSES = {
    "rejoin": {name: name for name in ("in_rejoin", "rejoin_time", "lead_distance")},
    "docking": {
        "in_docking": "in_docking",
        "docking_distance": "docking_distance",
        "delta_v": "delta_v",
        "max_vel_limit": "velocity_limit",
    },
}
# One step agrees within these tolerances, by state field. Positions are in m or ft.
MOTION = {
    "rejoin2d": {"position": 1e-6, "heading": 1e-12, "speed": 1e-12},
    "rejoin3d": {
        "position": 1e-3,
        "heading": 1e-6,
        "flight_path_angle": 1e-12,
        "roll": 1e-12,
        "speed": 1e-12,
    },
    "docking2d": {"position": 1e-10, "velocity": 1e-10},
    "docking3d": {"position": 1e-10, "velocity": 1e-10},
    "docking2d_oriented": {
        "position": 1e-8,
        "velocity": 1e-8,
        "attitude": 1e-9,
        "attitude_rate": 1e-12,
    },
}
pytestmark = pytest.mark.usefixtures("x64")

Fields = dict[str, dict[str, Any]]
"""State fields by platform."""


class Replayed(Platform, type="replayed_of_test"):
    """A platform that moves as another one does and is then put where it was recorded."""

    inner: Platform
    recorded: Mapping[str, Any]

    def rest(self) -> Any:
        return self.inner.rest()

    def step(self, state: Any, controls: Any, dt: Any) -> Any:
        return self.inner.step(state, controls, dt).replace(**self.recorded)


def task_of(recording: str) -> str:
    return "_".join(
        part for part in recording.split("_") if part not in ("discrete", "rta", "transitions")
    )


def kind_of(recording: str) -> str:
    return recording[: recording.index("2d" if "2d" in recording else "3d")]


def released(recording: str) -> Environment:
    actions = "discrete" if recording.endswith("_discrete") else "continuous"
    rta = "released" if recording.endswith("_rta") else None
    return jaxsafe.make(task_of(recording), actions=actions, variant="released", rta=rta)


def state_fields(recording: str, data: Mapping[str, np.ndarray], suffix: str = "") -> Fields:
    columns = COLUMNS[task_of(recording)]
    return {
        name: {field: data[f"{name}_state{suffix}"][..., where] for field, where in columns.items()}
        for name in PLATFORMS[kind_of(recording)]
    }


@functools.cache
def episodes(recording: str) -> dict[str, np.ndarray]:
    """Return the recorded episodes, padded to the longest.

    Steps are [episodes, steps] and states [episodes, steps + 1]. `taken` marks the steps that are
    real.
    """
    data = np.load(GOLDEN / f"{recording}.npz")
    begins = data["ep_start"]
    lengths = np.diff(data["ep_start"])

    def pad(name: str) -> np.ndarray:
        array = data[name]
        extra = len(array) - begins[-1]  # states have one more row per episode
        out = np.zeros((len(lengths), lengths.max() + bool(extra), *array.shape[1:]), array.dtype)
        for i, length in enumerate(lengths):
            rows = array[begins[i] + i * bool(extra) :][: length + bool(extra)]
            # Padding repeats the last row, so every number stays ordinary.
            out[i] = rows[-1]
            out[i, : len(rows)] = rows
        return out

    padded = {name: pad(name) for name in data.files if not name.startswith("ep_")}
    return padded | {"names": data["ep_name"], "taken": np.arange(lengths.max()) < lengths[:, None]}


@functools.cache
def transitions(recording: str) -> dict[str, np.ndarray]:
    """Return every recorded step as one transition: `_t0` is before it, `_t1` after it."""
    if recording in SCATTERED:
        return dict(np.load(GOLDEN / f"{recording}.npz"))
    data = episodes(recording)
    taken = data["taken"]
    flat = {}
    for name, array in data.items():
        if name in ("names", "taken"):
            continue
        if array.shape[1] == taken.shape[1]:
            flat[name] = array[taken]
        else:
            flat[name + "_t0"] = array[:, :-1][taken]
            flat[name + "_t1"] = array[:, 1:][taken]
    return flat


@jax.jit
def start(env: Environment, fields: Fields) -> tuple[State, TimeStep]:
    return jax.vmap(lambda state: jaxsafe.reset_to(env, state))(fields)


@jax.jit
def single_steps(env: Environment, fields: Fields, actions: jax.Array) -> tuple[Any, TimeStep]:
    """Make one step from each state. Return the platforms and the time step after it."""

    def single_step(fields: Fields, action: jax.Array) -> tuple[Any, TimeStep]:
        state, timestep = jaxsafe.step(env, jaxsafe.reset_to(env, fields)[0], action)
        return state.sim.platforms, timestep

    return jax.vmap(single_step)(fields, actions)


@jax.jit
def replay(env: Environment, fields: Fields, actions: jax.Array) -> tuple[TimeStep, Any]:
    """Replay whole episodes through the recorded states.

    Return time steps and simulations after each step, [episodes, steps].
    """

    def episode(fields: Fields, actions: jax.Array) -> tuple[TimeStep, Any]:
        first = jaxsafe.reset_to(env, jax.tree.map(lambda leaf: leaf[0], fields))[0]

        def advance(
            state: State, inputs: tuple[Fields, jax.Array]
        ) -> tuple[State, tuple[TimeStep, Any]]:
            after, action = inputs
            platforms = [
                Replayed(
                    name=platform.name,
                    dimension=platform.dimension,
                    controller=platform.controller,
                    inner=platform,
                    recorded=after[platform.name],
                )
                if platform.name in after
                else platform
                for platform in env.platforms
            ]
            state, timestep = jaxsafe.step(env.replace(platforms=tuple(platforms)), state, action)
            return state, (timestep, state.sim.replace(platforms={}))

        return jax.lax.scan(advance, first, (jax.tree.map(lambda leaf: leaf[1:], fields), actions))[
            1
        ]

    return jax.vmap(episode)(fields, actions)


def assert_same(computed: Any, expected: Any, message: str, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(computed, expected, rtol=0, atol=tolerance, err_msg=message)


def assert_as_recorded(
    recording: str,
    data: Mapping[str, Any],
    timestep: TimeStep,
    sim: Any,
    rows: np.ndarray,
    suffix: str,
) -> None:
    """Compare statuses, observation, every reward term, ends and outcome on the chosen rows."""
    kind = kind_of(recording)
    info = timestep.info
    for theirs, ours in STATUSES[kind].items():
        assert_same(info.status[ours][rows], data[f"status_{theirs}{suffix}"][rows], ours)
    assert_same(timestep.observation[rows], data[f"obs{suffix}"][rows], "observation")
    for column, name in enumerate(REWARDS[kind]):
        assert_same(info.reward_terms[name][rows], data["reward_components"][rows][:, column], name)
    assert_same(timestep.reward[rows], data["reward"][rows], "reward")
    success = data[f"status_success{suffix}"][rows]
    failure = data[f"status_failure{suffix}"][rows]
    np.testing.assert_array_equal(info.ended["success"][rows], success)
    for code, name in enumerate(FAILURES[kind][1:], start=1):
        np.testing.assert_array_equal(info.ended[name][rows], failure == code, err_msg=name)
    np.testing.assert_array_equal(timestep.terminated[rows], data["done"][rows])
    outcomes = [
        "success" if won else FAILURES[kind][code]
        for won, code in zip(success.tolist(), failure.tolist(), strict=True)
    ]
    env = released(recording)
    assert [env.outcomes[index] for index in np.asarray(info.outcome)[rows]] == outcomes
    if kind == "rejoin":
        assert_same(sim.time[rows], data[f"status_time_elapsed{suffix}"][rows], "time")
        centre = sim.regions["rejoin_region"].position[rows]
        assert_same(centre, data[f"region_pos{suffix}"][rows][:, : centre.shape[1]], "region")
    else:
        safe = data[f"status_max_vel_constraint{suffix}"][rows]
        np.testing.assert_array_equal(info.margins["velocity_limit"][rows] >= 0.0, safe)
        assert_same(
            -info.margins["velocity_limit"][rows],
            data[f"status_max_vel_violation{suffix}"][rows],
            "violation",
        )


def test_the_recordings_are_complete() -> None:
    count = {
        recording: len(transitions(recording)["action"]) for recording in (*RECORDINGS, *SCATTERED)
    }
    assert {name: count[name] for name in TASKS} == {
        "rejoin2d": 2839,
        "rejoin3d": 4806,
        "docking2d": 5564,
        "docking3d": 5601,
        "docking2d_oriented": 6713,
    }
    assert all(count[recording] == 600 for recording in SCATTERED)


@pytest.mark.parametrize("recording", one_of_each_kind(RECORDINGS))
def test_whole_episodes_are_judged_as_recorded(recording: str) -> None:
    data = episodes(recording)
    timestep, sim = replay(released(recording), state_fields(recording, data), data["action"])
    rows = data["taken"]
    after = {
        name: array[:, 1:] if array.shape[1:2] > rows.shape[1:2] else array
        for name, array in data.items()
    }
    assert_as_recorded(recording, after, timestep, sim, rows, "")
    if kind_of(recording) == "docking":
        total = np.cumsum(timestep.info.status["delta_v"], axis=1)
        assert_same(total[rows], after["status_delta_v_total"][rows], "sum of Δv", 1e-8)


def test_the_released_filter_decides_as_recorded() -> None:
    """The decision to intervene and the control that acts agree at every step of every episode.

    The filter has hysteresis, so its memory takes part.
    """
    data = episodes("rejoin2d_rta")
    timestep, _ = replay(
        released("rejoin2d_rta"), state_fields("rejoin2d_rta", data), data["action"]
    )
    rows = data["taken"]
    info = timestep.info
    np.testing.assert_array_equal(info.intervening[rows], data["rta_intervening"][rows])
    assert_same(info.control_desired[rows], data["rta_control_desired"][rows], "desired", 1e-15)
    assert_same(info.control_actual[rows], data["control"][rows], "actual", 1e-15)
    assert 50 < info.intervening[rows].sum() < rows.sum() - 50
    assert not info.rta.certified.any()


@pytest.mark.parametrize(
    "recording", one_of_each_kind([*RECORDINGS, *SCATTERED], ["docking2d_discrete", *SCATTERED])
)
def test_one_step_from_every_recorded_state_is_the_recorded_step(recording: str) -> None:
    data = transitions(recording)
    env = released(recording)
    actions = data["action"]
    # Single steps do not know what the filter remembers. So they take the control that acted.
    if recording.endswith("_rta"):
        actions = data["control"] / bounds(env)[1]
        env = jaxsafe.override(env, {"rta": None})
    platforms, timestep = single_steps(env, state_fields(recording, data, "_t0"), actions)
    assert_same(timestep.info.control_desired, data["control"], "control", 1e-14)
    rows = ~data["limit_crossing"]
    assert rows.mean() > 0.5
    for name, fields in state_fields(recording, data, "_t1").items():
        for field, expected in fields.items():
            difference = np.asarray(getattr(platforms[name], field)) - expected
            if field == "attitude":
                difference = (difference + np.pi) % (2 * np.pi) - np.pi
            tolerance = MOTION[task_of(recording)][field]
            assert np.abs(difference[rows]).max() <= tolerance, (name, field)


@pytest.mark.parametrize(
    "recording", one_of_each_kind(SCATTERED, ["docking3d_transitions", "rejoin2d_transitions"])
)
def test_scattered_steps_are_judged_as_recorded(recording: str) -> None:
    data = transitions(recording)
    before, after = (state_fields(recording, data, suffix) for suffix in ("_t0", "_t1"))
    fields = jax.tree.map(lambda a, b: np.stack([a, b], axis=1), before, after)
    timestep, sim = replay(released(recording), fields, data["action"][:, None])
    timestep, sim = jax.tree.map(lambda leaf: leaf[:, 0], (timestep, sim))
    assert_as_recorded(recording, data, timestep, sim, np.ones(600, bool), "_t1")
    _, first = start(released(recording), before)
    assert_same(first.observation, data["obs_t0"], "first observation")


@pytest.mark.parametrize("recording", [name for name in RECORDINGS if name.endswith("_discrete")])
def test_every_discrete_index_means_what_it_meant(recording: str) -> None:
    table = json.loads((GOLDEN / f"{recording}.json").read_text())["index_to_control"]
    env = released(recording)
    controller: Any = env.agent_platform.controller
    assert env.num_action_points == tuple(map(len, table))
    for actuator, expected in zip(controller.actuators, table, strict=True):
        assert_same(
            jax.vmap(actuator.from_discrete)(jnp.arange(len(expected))),
            expected,
            actuator.name,
            1e-15,
        )


@pytest.mark.thorough
def test_every_state_on_a_boundary_is_judged_as_recorded() -> None:
    edges = json.loads((GOLDEN / "edges.json").read_text())
    judged = []
    for edge in edges:
        task = edge["task"]
        status = edge["status_at_reset"]
        data = {f"{name}_state": np.array(values) for name, values in edge["states"].items()}
        _, timestep = jaxsafe.reset_to(released(task), state_fields(task, data))
        ended = {name: bool(flag) for name, flag in timestep.info.ended.items()}
        failure = status["failure"] or None
        assert ended == {
            name: name == failure or (name == "success" and status["success"]) for name in ended
        }, edge["note"]
        for theirs, ours in STATUSES[kind_of(task)].items():
            assert_same(
                timestep.info.status[ours], status[theirs], f"{edge['note']}: {ours}", 1e-12
            )
        if None not in edge["obs"]:
            assert_same(timestep.observation, edge["obs"], edge["note"], 1e-12)
        judged.append(
            (task, failure, status["success"], status.get("in_rejoin", status.get("in_docking")))
        )
    assert len(judged) == 49
    assert len(set(judged)) > 15


def measures(recording: str, data: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the independent numbers that a start is drawn from."""
    computed: dict[str, np.ndarray] = {}
    fields = state_fields(recording, data)
    for name, state in fields.items():
        for field, values in state.items():
            for axis, column in zip("xyz", np.atleast_2d(values.T), strict=False):
                computed[f"{name}.{field}.{axis}"] = column
    other = fields["lead"]["position"] if "lead" in fields else 0.0
    apart = (fields["wingman"] if "lead" in fields else fields["deputy"])["position"] - other
    planar = np.hypot(apart[:, 0], apart[:, 1])
    computed |= {"distance": planar, "azimuth": np.arctan2(apart[:, 1], apart[:, 0])}
    if "deputy" in fields:
        velocity = fields["deputy"]["velocity"]
        distance = np.linalg.norm(apart, axis=1)
        share = np.linalg.norm(velocity, axis=1) / (0.2 + 2 * 0.001027 * distance)
        computed |= {
            "range": distance,
            "share": share,
            "course": np.arctan2(velocity[:, 1], velocity[:, 0]),
        }
    return computed


@pytest.mark.parametrize("task", one_of_each_kind(TASKS))
def test_starts_are_drawn_from_the_recorded_distribution(task: str) -> None:
    """Kolmogorov-Smirnov's test compares every number of 1 000 recorded and 20 000 drawn starts.

    The level is 1e-4 for a task.
    """
    data = np.load(GOLDEN / f"{task}_init.npz")
    env = released(task)
    states, _ = jax.jit(jax.vmap(jaxsafe.reset, in_axes=(None, 0)))(
        env, jax.random.split(jax.random.key(3), 20_000)
    )
    ours = {}
    for name in PLATFORMS[kind_of(task)]:
        record = states.sim.platforms[name]
        columns = COLUMNS[task]
        width = 1 + max(
            where.stop - 1 if isinstance(where, slice) else where for where in columns.values()
        )
        ours[f"{name}_state"] = np.zeros((20_000, width))
        for field, where in columns.items():
            ours[f"{name}_state"][:, where] = np.asarray(getattr(record, field))
    expected = measures(task, data)
    computed = measures(task, ours)
    drawn = {name: values for name, values in expected.items() if np.ptp(values) > 1e-9}
    for name, values in expected.items():
        if name not in drawn:
            assert_same(computed[name], values[0], name)
    level = 1e-4 / len(drawn)
    for name, values in drawn.items():
        assert stats.ks_2samp(computed[name], values).pvalue > level, name
    pairs = np.abs(correlations(computed, drawn) - correlations(expected, drawn))
    assert pairs.max() < 0.2  # 6 standard deviations for 1 000 samples


def correlations(computed: Mapping[str, np.ndarray], names: Mapping[str, Any]) -> np.ndarray:
    return np.corrcoef([computed[name] for name in names])


@pytest.mark.parametrize("task", [thorough("docking2d"), "docking3d"])
def test_whole_docking_episodes_run_freely_as_recorded(task: str) -> None:
    data = episodes(task)
    computed, timestep = free_run(released(task), state_fields(task, data), data["action"])
    rows = data["taken"]
    for field, values in state_fields(task, data)["deputy"].items():
        assert_same(getattr(computed["deputy"], field)[rows], values[:, 1:][rows], field)
    assert_same(timestep.reward[rows], data["reward"][rows], "reward")
    np.testing.assert_array_equal(timestep.terminated[rows], data["done"][rows])


@jax.jit
def free_run(env: Environment, fields: Fields, actions: jax.Array) -> tuple[Any, TimeStep]:
    """Fly whole episodes freely from their starts.

    Return platforms and time steps after each step, [episodes, steps].
    """

    def advance(state: State, action: jax.Array) -> tuple[State, tuple[Any, TimeStep]]:
        state, timestep = jaxsafe.step(env, state, action)
        return state, (state.sim.platforms, timestep)

    first, _ = start(env, jax.tree.map(lambda leaf: leaf[:, 0], fields))
    return jax.vmap(lambda start, taken: jax.lax.scan(advance, start, taken)[1])(first, actions)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("task", "tolerance"),
    [
        ("rejoin2d", 0.4),
        ("rejoin3d", 0.4),
        ("docking2d", 5e-3),
        ("docking3d", 5e-3),
        ("docking2d_oriented", 3e-2),
    ],
)
def test_float32_stays_close_over_whole_episodes(task: str, tolerance: float) -> None:
    """Positions relative to the lead [ft] or chief [m] stay close.

    Episodes have up to 2001 or 3001 steps and go 5e5 ft or 4e4 m away from the origin.
    """
    data = episodes(task)
    fields = state_fields(task, data)
    rows = data["taken"]
    precise, expected = free_run(released(task), fields, data["action"])
    with jax.enable_x64(False):
        single = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), (fields, data["action"]))
        platforms, timestep = free_run(released(task), *single)
    assert timestep.reward.dtype == jnp.float32
    other, agent = PLATFORMS["rejoin"] if "rejoin" in task else ("chief", "deputy")
    apart = [
        np.asarray(states[agent].position, float) - states[other].position
        for states in (platforms, precise)
    ]
    assert np.abs(apart[0] - apart[1])[rows].max() < tolerance
    np.testing.assert_array_equal(timestep.info.outcome[rows], expected.info.outcome[rows])
    np.testing.assert_allclose(timestep.reward[rows], expected.reward[rows], rtol=0, atol=2e-4)
