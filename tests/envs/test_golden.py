"""Everything recorded from the released implementation is reproduced by `variant="released"`; see `golden/README.md`.

In x64: statuses, observations, rewards and ends from the recorded states, over whole episodes with their memories, within
1e-9; motion over one step from every recorded state, within 1e-10 m (docking), 1e-8 m (oriented), 1e-6 ft (rejoin2d) and
1e-3 ft (rejoin3d), but on steps on which the recorded integrator met a limit. In float32, in which training runs, docking
episodes of up to 2001 steps stay within 5 mm of the recordings, and rejoin steps within 0.1 ft, 3e5 ft from the origin.
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
PLATFORMS = {"rejoin": ("lead", "wingman"), "docking": ("deputy",)}  # the chief rests at the origin
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
MOTION = {  # within which one step agrees, by state field; positions in m or ft
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
    """Moves as another platform does, then to where it was recorded."""

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
    """Recorded episodes, padded to the longest: steps [episodes, steps], states [episodes, steps + 1]; `taken` is real."""
    data = np.load(GOLDEN / f"{recording}.npz")
    begins, lengths = data["ep_start"], np.diff(data["ep_start"])

    def pad(name: str) -> np.ndarray:
        array = data[name]
        extra = len(array) - begins[-1]  # states have one row more an episode
        out = np.zeros((len(lengths), lengths.max() + bool(extra), *array.shape[1:]), array.dtype)
        for i, length in enumerate(lengths):
            rows = array[begins[i] + i * bool(extra) :][: length + bool(extra)]
            out[i] = rows[-1]  # padding repeats the last row, which keeps every number ordinary
            out[i, : len(rows)] = rows
        return out

    padded = {name: pad(name) for name in data.files if not name.startswith("ep_")}
    return padded | {"names": data["ep_name"], "taken": np.arange(lengths.max()) < lengths[:, None]}


@functools.cache
def transitions(recording: str) -> dict[str, np.ndarray]:
    """Every recorded step as one transition: `_t0` before, `_t1` after."""
    if recording in SCATTERED:
        return dict(np.load(GOLDEN / f"{recording}.npz"))
    data = episodes(recording)
    taken, flat = data["taken"], {}
    for name, array in data.items():
        if name in ("names", "taken"):
            continue
        if array.shape[1] == taken.shape[1]:
            flat[name] = array[taken]
        else:
            flat[name + "_t0"], flat[name + "_t1"] = array[:, :-1][taken], array[:, 1:][taken]
    return flat


@jax.jit
def start(env: Environment, fields: Fields) -> tuple[State, TimeStep]:
    return jax.vmap(lambda one: jaxsafe.reset_to(env, one))(fields)


@jax.jit
def single_steps(env: Environment, fields: Fields, actions: jax.Array) -> tuple[Any, TimeStep]:
    """One step from each state: the platforms and the time step after it."""

    def one(fields: Fields, action: jax.Array) -> tuple[Any, TimeStep]:
        state, timestep = jaxsafe.step(env, jaxsafe.reset_to(env, fields)[0], action)
        return state.sim.platforms, timestep

    return jax.vmap(one)(fields, actions)


@jax.jit
def replay(env: Environment, fields: Fields, actions: jax.Array) -> tuple[TimeStep, Any]:
    """Whole episodes through the recorded states: time steps and simulations after each step, [episodes, steps]."""

    def episode(fields: Fields, actions: jax.Array) -> tuple[TimeStep, Any]:
        first = jaxsafe.reset_to(env, jax.tree.map(lambda leaf: leaf[0], fields))[0]

        def advance(
            state: State, inputs: tuple[Fields, jax.Array]
        ) -> tuple[State, tuple[TimeStep, Any]]:
            after, action = inputs
            platforms = [
                Replayed(
                    name=one.name,
                    dimension=one.dimension,
                    controller=one.controller,
                    inner=one,
                    recorded=after[one.name],
                )
                if one.name in after
                else one
                for one in env.platforms
            ]
            state, timestep = jaxsafe.step(env.replace(platforms=tuple(platforms)), state, action)
            return state, (timestep, state.sim.replace(platforms={}))

        return jax.lax.scan(advance, first, (jax.tree.map(lambda leaf: leaf[1:], fields), actions))[
            1
        ]

    return jax.vmap(episode)(fields, actions)


def assert_same(found: Any, expected: Any, message: str, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance, err_msg=message)


def assert_as_recorded(
    recording: str,
    data: Mapping[str, Any],
    timestep: TimeStep,
    sim: Any,
    rows: np.ndarray,
    suffix: str,
) -> None:
    """Statuses, observation, every reward term, ends and outcome on the chosen rows."""
    kind, info = kind_of(recording), timestep.info
    for theirs, ours in STATUSES[kind].items():
        assert_same(info.status[ours][rows], data[f"status_{theirs}{suffix}"][rows], ours)
    assert_same(timestep.observation[rows], data[f"obs{suffix}"][rows], "observation")
    for column, name in enumerate(REWARDS[kind]):
        assert_same(info.reward_terms[name][rows], data["reward_components"][rows][:, column], name)
    assert_same(timestep.reward[rows], data["reward"][rows], "reward")
    success, failure = data[f"status_success{suffix}"][rows], data[f"status_failure{suffix}"][rows]
    np.testing.assert_array_equal(sim.ended["success"][rows], success)
    for code, name in enumerate(FAILURES[kind][1:], start=1):
        np.testing.assert_array_equal(sim.ended[name][rows], failure == code, err_msg=name)
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


@pytest.mark.parametrize("recording", RECORDINGS)
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
    """At every step of every episode, with its hysteresis: whether it intervenes, and the control that acts."""
    data = episodes("rejoin2d_rta")
    timestep, _ = replay(
        released("rejoin2d_rta"), state_fields("rejoin2d_rta", data), data["action"]
    )
    rows, info = data["taken"], timestep.info
    np.testing.assert_array_equal(info.intervening[rows], data["rta_intervening"][rows])
    assert_same(info.control_desired[rows], data["rta_control_desired"][rows], "desired", 1e-15)
    assert_same(info.control_actual[rows], data["control"][rows], "actual", 1e-15)
    assert 50 < info.intervening[rows].sum() < rows.sum() - 50
    assert not info.rta.certified.any()


@pytest.mark.parametrize("recording", [*RECORDINGS, *SCATTERED])
def test_one_step_from_every_recorded_state_is_the_recorded_step(recording: str) -> None:
    data = transitions(recording)
    env, actions = released(recording), data["action"]
    if recording.endswith(
        "_rta"
    ):  # the filter remembers what single steps do not know: take the control that acted
        env, actions = jaxsafe.override(env, {"rta": None}), data["control"] / bounds(env)[1]
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


@pytest.mark.parametrize("recording", SCATTERED)
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


def test_every_state_on_a_boundary_is_judged_as_recorded() -> None:
    edges = json.loads((GOLDEN / "edges.json").read_text())
    judged = []
    for edge in edges:
        task, status = edge["task"], edge["status_at_reset"]
        data = {f"{name}_state": np.array(values) for name, values in edge["states"].items()}
        state, timestep = jaxsafe.reset_to(released(task), state_fields(task, data))
        ended = {name: bool(flag) for name, flag in state.sim.ended.items()}
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
    """The independent numbers that a start is drawn from."""
    found: dict[str, np.ndarray] = {}
    fields = state_fields(recording, data)
    for name, state in fields.items():
        for field, values in state.items():
            for axis, column in zip("xyz", np.atleast_2d(values.T), strict=False):
                found[f"{name}.{field}.{axis}"] = column
    other = fields["lead"]["position"] if "lead" in fields else 0.0
    apart = (fields["wingman"] if "lead" in fields else fields["deputy"])["position"] - other
    planar = np.hypot(apart[:, 0], apart[:, 1])
    found |= {"distance": planar, "azimuth": np.arctan2(apart[:, 1], apart[:, 0])}
    if "deputy" in fields:
        velocity, distance = fields["deputy"]["velocity"], np.linalg.norm(apart, axis=1)
        share = np.linalg.norm(velocity, axis=1) / (0.2 + 2 * 0.001027 * distance)
        found |= {
            "range": distance,
            "share": share,
            "course": np.arctan2(velocity[:, 1], velocity[:, 0]),
        }
    return found


@pytest.mark.parametrize("task", TASKS)
def test_starts_are_drawn_from_the_recorded_distribution(task: str) -> None:
    """Kolmogorov-Smirnov on every number of 1 000 recorded and 20 000 of our starts, at a level of 1e-4 a task."""
    data = np.load(GOLDEN / f"{task}_init.npz")
    env = released(task)
    states, _ = jax.jit(jax.vmap(jaxsafe.reset, in_axes=(None, 0)))(
        env, jax.random.split(jax.random.key(3), 20_000)
    )
    ours = {}
    for name in PLATFORMS[kind_of(task)]:
        record, columns = states.sim.platforms[name], COLUMNS[task]
        width = 1 + max(
            where.stop - 1 if isinstance(where, slice) else where for where in columns.values()
        )
        ours[f"{name}_state"] = np.zeros((20_000, width))
        for field, where in columns.items():
            ours[f"{name}_state"][:, where] = np.asarray(getattr(record, field))
    expected, found = measures(task, data), measures(task, ours)
    drawn = {name: values for name, values in expected.items() if np.ptp(values) > 1e-9}
    for name, values in expected.items():
        if name not in drawn:
            assert_same(found[name], values[0], name)
    level = 1e-4 / len(drawn)
    for name, values in drawn.items():
        assert stats.ks_2samp(found[name], values).pvalue > level, name
    pairs = np.abs(correlations(found, drawn) - correlations(expected, drawn))
    assert pairs.max() < 0.2  # of 1 000 samples: 6 standard deviations


def correlations(found: Mapping[str, np.ndarray], names: Mapping[str, Any]) -> np.ndarray:
    return np.corrcoef([found[name] for name in names])


@pytest.mark.parametrize("task", ["docking2d", "docking3d"])
def test_whole_docking_episodes_run_freely_as_recorded(task: str) -> None:
    data = episodes(task)
    found, timestep = free_run(released(task), state_fields(task, data), data["action"])
    rows = data["taken"]
    for field, values in state_fields(task, data)["deputy"].items():
        assert_same(getattr(found["deputy"], field)[rows], values[:, 1:][rows], field)
    assert_same(timestep.reward[rows], data["reward"][rows], "reward")
    np.testing.assert_array_equal(timestep.terminated[rows], data["done"][rows])


@jax.jit
def free_run(env: Environment, fields: Fields, actions: jax.Array) -> tuple[Any, TimeStep]:
    """Whole episodes from their starts: platforms and time steps after each step, [episodes, steps]."""

    def advance(state: State, action: jax.Array) -> tuple[State, tuple[Any, TimeStep]]:
        state, timestep = jaxsafe.step(env, state, action)
        return state, (state.sim.platforms, timestep)

    first, _ = start(env, jax.tree.map(lambda leaf: leaf[:, 0], fields))
    return jax.vmap(lambda one, taken: jax.lax.scan(advance, one, taken)[1])(first, actions)


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
    """Positions relative to the lead or chief [ft, m], up to 2001 or 3001 steps, 5e5 ft or 4e4 m from the origin."""
    data = episodes(task)
    fields, rows = state_fields(task, data), data["taken"]
    precise, expected = free_run(released(task), fields, data["action"])
    with jax.enable_x64(False):
        single = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), (fields, data["action"]))
        platforms, timestep = free_run(released(task), *single)
    assert timestep.reward.dtype == jnp.float32
    other, agent = PLATFORMS["rejoin"] if "rejoin" in task else ("chief", "deputy")
    apart = [
        np.asarray(each[agent].position, float) - each[other].position
        for each in (platforms, precise)
    ]
    assert np.abs(apart[0] - apart[1])[rows].max() < tolerance
    np.testing.assert_array_equal(timestep.info.outcome[rows], expected.info.outcome[rows])
    np.testing.assert_allclose(timestep.reward[rows], expected.reward[rows], rtol=0, atol=2e-4)
