import copy
import importlib
import multiprocessing
import pickle
import subprocess
import sys
from typing import Any

import gymnasium as gym
import jax
import numpy as np
import pytest
from default_cases import one_of_each_kind, thorough
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from test_modes import checking_leaks

import jaxsafe
from jaxsafe import ConfigError
from jaxsafe.adapters import packed_batch
from jaxsafe.adapters.gymnasium import GymEnv, GymVectorEnv
from jaxsafe.adapters.safety_gymnasium import SafetyEnv
from jaxsafe.envs import TASKS

SOON = {"terminal.distance.limit": 130.0}
"""Some episodes end with the first step and others last, because starts are 100 to 150 m away."""


def actions(env: Any, steps: int) -> list[np.ndarray]:
    env.action_space.seed(3)
    return [env.action_space.sample() for _ in range(steps)]


def same(ours: Any, theirs: Any, where: np.ndarray, name: str) -> None:
    """Compare infos, in the environments of the batch that have them."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys(), name
        for key in theirs:
            mask = theirs.get(f"_{key}", where)
            same(ours[key], theirs[key], where & mask, f"{name}.{key}")
    elif theirs.dtype == object and name.endswith("final_obs"):
        np.testing.assert_allclose(ours[where], np.stack(theirs[where]), rtol=1e-5, atol=1e-6)
    elif theirs.dtype == object or theirs.dtype == bool:
        assert (ours[where] == theirs[where]).all(), name
    else:
        np.testing.assert_allclose(ours[where], theirs[where], rtol=1e-4, atol=1e-5, err_msg=name)


@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is:UserWarning")
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param(
            name,
            kind,
            marks=[]
            if name == "jaxsafe/Docking2D-v0"
            else [pytest.mark.slow if kind == "discrete" else pytest.mark.thorough],
        )
        for name in (task.gymnasium_id for task in TASKS.values())
        for kind in ("continuous", "discrete")
    ],
)
def test_gymnasiums_own_checks_find_nothing(name: str, kind: str) -> None:
    env = gym.make(name, actions=kind, render_mode="rgb_array")
    check_env(env.unwrapped)
    assert isinstance(
        env.action_space, gym.spaces.MultiDiscrete if kind == "discrete" else gym.spaces.Box
    )


def step_by_step(ours: GymVectorEnv, theirs: SyncVectorEnv, steps: int) -> int:
    """Compare a batch with single environments. Return how many episodes ended."""
    mode = ours.metadata["autoreset_mode"]
    assert ours.single_observation_space == theirs.single_observation_space
    assert (ours.action_space, mode) == (theirs.action_space, theirs.metadata["autoreset_mode"])
    everywhere = np.ones(ours.num_envs, bool)
    ends = 0
    for (observation, infos), (expected, their_infos) in [
        (ours.reset(seed=5), theirs.reset(seed=5))
    ]:
        np.testing.assert_allclose(observation, expected, rtol=1e-6, atol=1e-7)
        same(infos, their_infos, everywhere, "reset")
    for action in actions(theirs, steps):
        (*result, infos) = ours.step(action)
        (*expected, their_infos) = theirs.step(action)
        for value, other in zip(result, expected, strict=True):
            assert value.dtype == other.dtype
            np.testing.assert_allclose(value, other, rtol=1e-5, atol=1e-6)
        same(infos, their_infos, everywhere, "step")
        done = result[2] | result[3]
        ends += int(done.sum())
        if mode is AutoresetMode.DISABLED and done.any():
            with pytest.raises(ResetNeeded, match="episodes of environments"):
                ours.step(action)
            mask = {"reset_mask": done}
            (observation, infos), (expected, their_infos) = (
                e.reset(options=dict(mask)) for e in (ours, theirs)
            )
            np.testing.assert_allclose(observation, expected, rtol=1e-5, atol=1e-6)
            same(infos, their_infos, everywhere, "reset")
    return ends


@pytest.mark.thorough
@pytest.mark.parametrize("mode", one_of_each_kind(AutoresetMode, [AutoresetMode.SAME_STEP]))
def test_a_batch_is_what_single_environments_are_step_by_step(mode: AutoresetMode) -> None:
    options: dict[str, Any] = {"overrides": SOON, "rta": "explicit_simplex", "max_episode_steps": 7}
    ours = GymVectorEnv("docking2d", 6, autoreset_mode=mode, **options)
    theirs = SyncVectorEnv([lambda: GymEnv("docking2d", **options)] * 6, autoreset_mode=mode)
    assert step_by_step(ours, theirs, 30) > 20


@pytest.mark.slow
@pytest.mark.parametrize("task", [task for task in TASKS if task != "docking2d"])
def test_a_batch_of_any_task_and_of_discrete_actions_is_too(task: str) -> None:
    options: dict[str, Any] = {"actions": "discrete", "max_episode_steps": 5}
    ours = GymVectorEnv(task, 3, autoreset_mode=AutoresetMode.SAME_STEP, **options)
    theirs = SyncVectorEnv(
        [lambda: GymEnv(task, **options)] * 3, autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert step_by_step(ours, theirs, 12) >= 6


@pytest.mark.thorough
def test_the_example_docks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend("examples")
    fly = importlib.import_module("gymnasium_docking3d").fly
    assert fly(num_envs=16)["success"] >= 0.9
    assert fly("default", num_envs=16) == {"success": 1.0, "with a violation": 0.0}


@pytest.mark.thorough
def test_final_observations_may_be_written_to_and_wrappers_count_episodes() -> None:
    env = RecordEpisodeStatistics(
        GymVectorEnv("docking2d", 4, autoreset_mode="SameStep", max_episode_steps=3)
    )
    env.reset(seed=0)
    zero = np.zeros((4, 2), np.float32)
    *_, infos = [env.step(zero) for _ in range(3)][-1]
    # The limit alone cut the episodes short.
    assert infos["final_info"]["outcome"].tolist() == ["running"] * 4
    infos["final_obs"][:] = 0.0
    assert infos["episode"]["l"].tolist() == [3] * 4


@pytest.mark.thorough
def test_seeds_are_chains_of_keys() -> None:
    env = gym.make("jaxsafe:jaxsafe/Docking2D-v0")
    first, _ = env.reset(seed=7)
    second, _ = env.reset()
    assert not np.array_equal(first, second)
    assert np.array_equal(env.reset(seed=7)[0], first)
    assert np.array_equal(env.reset()[0], second)
    _, now = jax.random.split(jax.random.key(7))
    np.testing.assert_allclose(
        jaxsafe.make("docking2d").reset(now)[1].observation, first, rtol=1e-6
    )
    other = gym.make("jaxsafe/Docking2D-v0")
    assert not np.array_equal(other.reset()[0], gym.make("jaxsafe/Docking2D-v0").reset()[0])


BIG = [0, 1, 2**32 - 1, 2**32, 2**32 + 1, 2**40, 2**64, 2**64 + 2**32, 2**70, 2**96, 2**128 - 1]


@pytest.mark.thorough
def test_every_seed_has_a_start_of_its_own_however_big_it_is() -> None:
    env = GymEnv("docking2d")
    starts = [env.reset(seed=seed)[0] for seed in BIG]
    assert len({start.tobytes() for start in starts}) == len(BIG)
    np.testing.assert_allclose(
        GymVectorEnv("docking2d", len(BIG)).reset(seed=BIG)[0], starts, rtol=1e-6
    )
    np.testing.assert_allclose(
        GymVectorEnv("docking2d", 3).reset(seed=2**32 - 1)[0], starts[2:5], rtol=1e-6
    )
    drawn = GymEnv("docking2d")
    first, _ = drawn.reset()
    assert np.array_equal(env.reset(seed=drawn.np_random_seed)[0], first)


@pytest.mark.parametrize(
    "build", [lambda: gym.make("jaxsafe/Docking2D-v0"), lambda: GymVectorEnv("docking2d", 2)]
)
def test_a_generator_of_ones_own_decides_the_starts(build: Any) -> None:
    env = build()
    starts = []
    for seed in (3, 4, 3):  # as the first seed, and in the middle of a chain
        env.np_random = np.random.default_rng(seed)
        starts.append(np.stack([env.reset()[0] for _ in range(2)]))
    assert np.array_equal(starts[0], starts[2])
    assert (
        len(np.unique(np.concatenate(starts[:2]).reshape(-1, 6), axis=0))
        == np.concatenate(starts[:2]).size // 6
    )
    with pytest.raises(ConfigError, match=r"np_random: expected a numpy.random.Generator, found 3"):
        env.np_random = 3


def test_a_generator_of_ones_own_waits_for_the_environments_that_go_on() -> None:
    env = GymVectorEnv("docking2d", 2)
    other = GymVectorEnv("docking2d", 2)
    first, _ = env.reset(seed=0)
    env.np_random = np.random.default_rng(3)
    only, _ = env.reset(options={"reset_mask": np.array([True, False])})
    assert np.array_equal(only[1], first[1])
    other.np_random = np.random.default_rng(3)
    expected, _ = other.reset()
    assert np.array_equal(only[0], expected[0])


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["rbg", thorough("unsafe_rbg")])
def test_a_batch_starts_as_single_environments_with_other_kinds_of_keys(kind: str) -> None:
    with jax.default_prng_impl(kind):
        env = GymVectorEnv("docking2d", 3)
        single = GymEnv("docking2d")
        single.reset(seed=1)
        expected = [single.reset(seed=1)[0], *(single.reset()[0] for _ in range(2))]
        starts = [env.reset(seed=0)[0]]
    mask = {"reset_mask": np.array([False, True, False])}
    starts += [env.reset(options=mask)[0] for _ in range(2)]
    np.testing.assert_allclose([start[1] for start in starts], expected, rtol=1e-6, atol=1e-6)


def test_environments_of_a_batch_are_seeded_one_by_one() -> None:
    env = gym.make_vec("jaxsafe/Docking2D-v0", num_envs=3)
    observation, _ = env.reset(seed=[4, 5, 6])
    assert np.array_equal(env.reset(seed=4)[0], observation)
    again, _ = env.reset(seed=[None, 5, None])
    assert np.array_equal(again[1], observation[1])
    assert not np.array_equal(again[0], observation[0])
    unseeded = [gym.make_vec("jaxsafe/Docking2D-v0", num_envs=2).reset()[0] for _ in range(2)]
    assert not np.array_equal(*unseeded)


@pytest.mark.parametrize(
    "copied", [thorough(copy.deepcopy), lambda env: pickle.loads(pickle.dumps(env))]
)
@pytest.mark.parametrize(
    "build",
    [
        lambda: gym.make("jaxsafe/Docking2D-v0", rta="explicit_simplex"),
        lambda: GymVectorEnv("docking2d", 2, autoreset_mode="SameStep", max_episode_steps=2),
        lambda: SafetyEnv("docking2d", 2, max_episode_steps=2),
    ],
)
def test_a_copy_goes_on_alike_and_compiles_nothing(build: Any, copied: Any) -> None:
    def fly(env: Any) -> np.ndarray:
        observations = [env.reset(seed=seed)[0] for seed in (0, 1)]
        observations += [
            env.step(np.zeros(env.action_space.shape, np.float32))[0] for _ in range(3)
        ]
        return np.stack([*observations, env.reset()[0], env.reset()[0]])

    def programs() -> list[int]:
        return [
            program._cache_size()
            for program in (packed_batch.advance, packed_batch.restart, packed_batch._raw_keys)
        ]

    env = build()
    expected = fly(env)
    before = programs()
    other = copied(env)
    assert np.array_equal(other.reset()[0], env.reset()[0])
    assert np.array_equal(fly(other), expected)
    assert programs() == before


MODES = {
    "key_reuse": lambda: jax.debug_key_reuse(True),
    "nans": lambda: jax.debug_nans(True),
    "double_precision": lambda: jax.enable_x64(True),
    "rank_promotion": lambda: jax.numpy_rank_promotion("raise"),
    "dtype_promotion": lambda: jax.numpy_dtype_promotion("strict"),
    "tracer_leaks": checking_leaks,
    "no_jit": lambda: jax.disable_jit(),
}


@pytest.mark.parametrize(
    "mode",
    one_of_each_kind(
        [
            pytest.param("no_jit", marks=pytest.mark.slow) if mode == "no_jit" else mode
            for mode in MODES
        ],
        ["dtype_promotion", "nans"],
    ),
)
def test_the_modes_of_jax_change_nothing(mode: str) -> None:
    def fly() -> list[np.ndarray]:
        options: dict[str, Any] = {"autoreset_mode": "SameStep", "max_episode_steps": 2}
        env = GymEnv("docking2d")
        batch = GymVectorEnv("docking2d", 2, **options)
        zero = np.zeros((2, 2), np.float32)
        placed = [
            env.reset(seed=3, options=FAST)[0],
            env.step(zero[0])[0],
            batch.reset(seed=3, options=FAST)[0],
            batch.step(zero)[0],
        ]
        return [*placed, batch.step(zero)[0], env.reset(seed=2**70)[0], batch.reset(seed=3)[0]]

    expected = fly()
    with MODES[mode]():
        result = fly()
    # Double precision draws other starts, so the last ones are not compared there.
    for first, other in list(zip(result, expected, strict=True))[
        : 4 if mode == "double_precision" else None
    ]:
        np.testing.assert_allclose(first, other, rtol=1e-4, atol=1e-5)
        assert first.dtype == (np.float64 if mode == "double_precision" else np.float32)


FAST = {"start": {"deputy": {"position": [30.0, 0.0], "velocity": [-0.9, 0.0]}}}


def test_info_says_what_happened() -> None:
    env = gym.make("jaxsafe/Docking2D-v0", rta="explicit_simplex")
    observation, info = env.reset(options=FAST)
    assert observation[0] == pytest.approx(0.3)
    assert (info["cost"], info["outcome"]) == (0.0, "running")
    *_, info = env.step(np.array([-1.0, 0.0], np.float32))
    assert (info["cost"], info["is_success"], info["intervening"]) == (1.0, False, True)
    assert info["margins"]["velocity_limit"] < 0.0 < info["severity"]["velocity_limit"]
    assert isinstance(info["cost"], float)
    assert info["costs"] == {"velocity_limit": 1.0}
    assert isinstance(info["rta"]["certified"], bool)
    assert not np.array_equal(info["control_desired"], info["control_actual"])
    assert sum(info["reward_terms"].values()) == pytest.approx(sum(info["reward_totals"].values()))


SHORT = {"terminal.timeout.success": True, "terminal.timeout.limit": 1.0}


def test_an_end_that_is_marked_is_a_success() -> None:
    env = GymEnv("docking2d", overrides=SHORT)
    env.reset(options=FAST)
    env.step(np.zeros(2, np.float32))
    *_, info = env.step(np.zeros(2, np.float32))
    assert (info["outcome"], info["is_success"]) == ("timeout", True)


@pytest.mark.parametrize("task", ["docking2d", thorough("rejoin2d")])
def test_an_action_that_is_no_number_ends_the_episode_as_a_failure_that_costs(task: str) -> None:
    action = np.array([np.nan, 0.0], np.float32)
    env = GymEnv(task)
    env.reset(seed=0)
    *_, terminated, truncated, info = env.step(action)
    assert (terminated, truncated, info["cost"]) == (True, False, 1.0)
    assert (info["outcome"], info["is_success"]) == ("diverged", False)
    assert np.isfinite(env.reset()[0]).all()

    batch, calm = (GymVectorEnv(task, 3, autoreset_mode="SameStep") for _ in range(2))
    batch.reset(seed=0), calm.reset(seed=0)
    zero = np.zeros((3, 2), np.float32)
    observation, _, terminated, truncated, infos = batch.step(np.stack([zero[0], action, zero[0]]))
    assert (terminated.tolist(), truncated.any()) == ([False, True, False], False)
    final = infos["final_info"]
    assert (final["cost"][1], final["outcome"][1], final["is_success"][1]) == (
        1.0,
        "diverged",
        False,
    )
    assert np.array_equal(observation[[0, 2]], calm.step(zero)[0][[0, 2]])
    assert np.isfinite(observation).all()
    assert np.isfinite(batch.step(zero)[0]).all()


@pytest.mark.thorough
def test_every_option_of_make_is_understood() -> None:
    options: dict[str, Any] = {
        "actions": "discrete",
        "variant": "released",
        "rta": "explicit_simplex",
        "randomize": {"deputy.mass": [10, 14]},
        "overrides": {"reward.delta_v.scale": -0.5},
    }
    env = gym.make("jaxsafe/Docking2D-v0", **options)
    expected = jaxsafe.make("docking2d", **options)
    assert jax.tree.all(
        jax.tree.map(lambda a, b: bool((a == b).all()), env.unwrapped.env, expected)
    )
    same_env = GymEnv(expected)
    env.reset(seed=1), same_env.reset(seed=1)
    for _ in range(3):
        assert env.step(np.array([0, 10]))[1] == same_env.step([0, 10])[1]


def test_the_whole_action_space_and_no_more_reaches_the_actuators() -> None:
    physical = {
        f"deputy.controller.actuators.thrust_x.{name}": value
        for name, value in {"rescale": False, "low": -3.0, "high": 0.5}.items()
    }
    env = GymEnv("docking2d", physical)
    batch = GymVectorEnv("docking2d", 2, physical)
    assert np.array_equal(batch.action_space.low, [[-3.0, -1.0]] * 2)
    assert (
        batch.single_action_space
        == env.action_space
        == SafetyEnv("docking2d", overrides=physical).action_space
    )
    env.reset(seed=0)
    for bound in (env.action_space.low, env.action_space.high):
        assert np.array_equal(env.step(bound)[-1]["control_actual"], bound)
    assert np.array_equal(env.step(2.0 * bound)[-1]["control_actual"], bound)


MIXED = {"deputy.controller.actuators.thrust_y.discrete": True}


def test_a_mixed_action_is_a_dict_by_actuator_or_one_vector() -> None:
    env = GymEnv("docking2d", MIXED, actions="mixed")
    box = gym.spaces.Box(-1.0, 1.0, ())
    assert env.action_space == gym.spaces.Dict(
        {"thrust_x": box, "thrust_y": gym.spaces.Discrete(11)}
    )
    assert env.action_space == SafetyEnv("docking2d", overrides=MIXED, actions="mixed").action_space
    env.action_space.seed(0)
    env.reset(seed=0)
    assert env.observation_space.contains(env.step(env.action_space.sample())[0])
    control = env.step({"thrust_y": 10, "thrust_x": np.float32(0.5)})[-1]["control_actual"]
    assert control.tolist() == [0.5, 1.0]
    assert env.step([0.5, 10.0])[-1]["control_actual"].tolist() == [0.5, 1.0]
    with pytest.raises(ConfigError, match="action: expected thrust_x, thrust_y, found thrust_x"):
        env.step({"thrust_x": 0.0})

    batch = GymVectorEnv("docking2d", 2, MIXED, actions="mixed")
    batch.reset(seed=0)
    sample = batch.action_space.sample()
    assert sample["thrust_y"].shape == (2,)
    batch.step(sample)
    actions = {"thrust_x": np.array([0.5, -0.5]), "thrust_y": np.array([0, 10])}
    controls = batch.step(actions)[-1]["control_actual"]
    assert controls.tolist() == [[0.5, -1.0], [-0.5, 1.0]]
    with pytest.raises(ConfigError, match=r"action: expected one shape of all elements"):
        batch.step({"thrust_x": np.zeros(2), "thrust_y": 3})


def test_a_limit_of_steps_counts_actions() -> None:
    env = GymEnv("docking2d", {"decision_period": 4}, max_episode_steps=2)
    env.reset(seed=0)
    assert [env.step([0.0, 0.0])[3] for _ in range(2)] == [False, True]


def test_a_window_shows_every_step_and_the_picture_that_an_array_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(
        ConfigError, match="render_mode: human needs a display, and matplotlib draws"
    ):
        GymEnv("docking2d", render_mode="human")
    # The window is drawn offscreen.
    monkeypatch.setattr("jaxsafe.adapters.gymnasium._opens_windows", lambda *_: True)
    env = GymEnv("docking2d", render_mode="human")
    other = GymEnv("docking2d", render_mode="rgb_array")
    action = np.zeros(2, np.float32)
    for one in (env, other):
        one.reset(seed=0)
        one.render()
        one.step(action)
    assert env.render() is None
    window: Any = env._window
    shown = np.asarray(window._figure.canvas.buffer_rgba())[..., :3]
    np.testing.assert_array_equal(shown, other.render())
    assert len(env._frames._scene.moments) == 2
    window._pyplot.close(window._figure)  # as the user may do
    env.step(action)
    env.close()


@pytest.mark.thorough
def test_an_episode_can_be_watched() -> None:
    env = gym.make("jaxsafe/Rejoin2D-v0", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    for _ in range(3):
        env.step(np.array([1.0, 0.0], np.float32))
    second = env.render()
    assert first.shape == second.shape
    assert first.dtype == np.uint8
    assert (first != second).any()
    env.reset()
    env.render()
    assert len(env.unwrapped._frames._scene.moments) == 1
    batch = gym.make_vec(
        "jaxsafe/Rejoin2D-v0", num_envs=2, render_mode="rgb_array", max_episode_steps=2
    )
    batch.reset(seed=0)
    for _ in range(3):
        batch.step(np.zeros((2, 2), np.float32))
    assert np.array_equal(batch.render()[0].shape, first.shape)
    assert len(batch.unwrapped._frames[0]._scene.moments) == 1
    batch = GymVectorEnv(
        "docking2d", 1, autoreset_mode="SameStep", render_mode="rgb_array", max_episode_steps=3
    )
    batch.reset(seed=0)
    for _ in range(4):  # the third step ends the episode and shows the start of the next
        batch.step(np.zeros((1, 2), np.float32))
    batch.render()
    assert len(batch._frames[0]._scene.moments) == 2


START = {**FAST, "parameters": {"deputy.mass": 13.0}}


@pytest.mark.thorough
def test_a_batch_starts_where_single_environments_do() -> None:
    options: dict[str, Any] = {
        "overrides": SOON,
        "randomize": {"deputy.mass": [10, 14]},
        "max_episode_steps": 3,
    }
    ours = GymVectorEnv("docking2d", 3, autoreset_mode="SameStep", **options)
    theirs = SyncVectorEnv([lambda: GymEnv("docking2d", **options)] * 3, autoreset_mode="SameStep")
    for seed in (5, None):
        result, expected = (env.reset(seed=seed, options=dict(START)) for env in (ours, theirs))
        np.testing.assert_allclose(result[0], expected[0], rtol=1e-6)
        same(result[1], expected[1], np.ones(3, bool), "reset")
        for action in actions(theirs, 5):  # an episode that follows starts at random
            np.testing.assert_allclose(
                ours.step(action)[0], theirs.step(action)[0], rtol=1e-5, atol=1e-6
            )
    before = ours.reset(seed=0)[0]
    after, infos = ours.reset(options={**START, "reset_mask": np.array([False, True, False])})
    assert np.array_equal(after[[0, 2]], before[[0, 2]])
    assert np.array_equal(after[1], result[0][1])
    assert infos["_cost"].tolist() == [False, True, False]
    with pytest.raises(ConfigError, match="reset_to: unknown platform 'deputi'"):
        ours.reset(options={**START, "start": {"deputi": {}}})
    with pytest.raises(ConfigError, match=r"reset: options: expected a dict, found \['start'\]"):
        ours.reset(options=["start"])  # type: ignore[arg-type]


def test_workers_that_are_forked_are_refused_where_they_would_wait_for_ever() -> None:
    with pytest.raises(
        ConfigError, match=r"^AsyncVectorEnv: forked processes .* 'spawn'.* for the compiled batch$"
    ):
        gym.make_vec(
            "jaxsafe/Docking2D-v0", 2, vectorization_mode="async", vector_kwargs={"context": "fork"}
        )
    with pytest.raises(ConfigError, match="AsyncVectorEnv"):
        gym.vector.AsyncVectorEnv([lambda: GymEnv("docking2d")], context="fork")


@pytest.mark.filterwarnings("default")  # JAX warns of the fork
def test_a_forked_process_is_told_what_works() -> None:
    env = GymEnv("docking2d")
    env.reset(seed=0)
    uses = [
        lambda: env.step([0.0, 0.0]),
        env.reset,
        lambda: env.reset(options=START),
        lambda: GymEnv("docking2d"),
    ]
    with multiprocessing.get_context("fork").Pool(
        1, initializer=_forked.extend, initargs=(uses,)
    ) as pool:
        for index in range(len(uses)):
            with pytest.raises(ConfigError, match=r"process \d+: forked processes would wait"):
                pool.apply_async(_use, (index,)).get(timeout=60)


_forked: list[Any] = []


def _use(index: int) -> None:
    _forked[index]()


@pytest.mark.slow
def test_workers_that_are_spawned_work() -> None:
    env = gym.make_vec(
        "jaxsafe/Docking2D-v0", 2, vectorization_mode="async", vector_kwargs={"context": "spawn"}
    )
    expected = GymVectorEnv("docking2d", 2).reset(seed=0)[0]
    np.testing.assert_allclose(env.reset(seed=0)[0], expected, rtol=1e-6)
    env.step(env.action_space.sample())
    env.close()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: GymEnv("doking3d"), "Did you mean 'docking3d'"),
        (
            lambda: GymEnv("docking2d", action="discrete"),
            r"action: unknown option\. Did you mean 'actions'\?",
        ),
        (
            lambda: GymEnv("docking2d", render_mode="rgb"),
            r"found 'rgb'\. Did you mean 'rgb_array'\? Choose from rgb_array, human, None$",
        ),
        (
            lambda: GymVectorEnv("docking2d", 1, render_mode="human"),
            "render_mode: found 'human'; choose from rgb_array, None",
        ),
        (
            lambda: GymEnv("docking2d", max_episode_steps=0),
            "max_episode_steps: expected a whole number ≥ 1, found 0",
        ),
        (
            lambda: GymEnv(jaxsafe.make("docking2d"), rta="default"),
            "rta: the environment is made already",
        ),
        (
            lambda: GymEnv("docking2d", max_episode_steps=10**400),
            "max_episode_steps: expected a whole number from 1 to 2",
        ),
        (lambda: GymVectorEnv("docking2d", 0), "num_envs: expected a whole number ≥ 1, found 0"),
        (
            lambda: GymVectorEnv("docking2d", 2, autoreset_mode="Same"),
            "autoreset_mode: unknown mode 'Same'",
        ),
        (
            lambda: GymEnv("docking2d").reset(options={"from": 3}),
            "reset: options: unknown 'from'; choose from start",
        ),
        (
            lambda: GymVectorEnv("docking2d", 2).reset(seed=[1, 2, 3]),
            "seed: expected 2 seeds, found 3",
        ),
        (
            lambda: GymVectorEnv("docking2d", 2).reset(seed=[1, -1]),
            "seed: expected a whole number ≥ 0, found -1",
        ),
        (
            lambda: GymVectorEnv("docking2d", 2).reset(seed=1.5),
            "seed: expected a whole number ≥ 0, or one for each environment",
        ),
        (
            lambda: GymEnv("docking2d").reset(seed=True),
            "seed: expected a whole number ≥ 0, found True",
        ),
        (
            lambda: GymEnv("docking2d").reset(seed=10**5000),
            "seed: expected at most 128 bits, found 16610",
        ),
        (
            lambda: GymVectorEnv("docking2d", 2).reset(options={"reset_mask": [True, False]}),
            "reset_mask: expected a bool",
        ),
    ],
)
def test_mistakes_are_named(build: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build()


def test_wrong_actions_and_wrong_order_are_named() -> None:
    env = GymEnv("docking2d", actions="discrete")
    batch = GymVectorEnv("docking2d", 2)
    for first in (env, batch):
        with pytest.raises(ResetNeeded, match="step: call reset first"):
            first.step(first.action_space.sample())
    with pytest.raises(ResetNeeded, match="first reset takes no reset_mask"):
        batch.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0), batch.reset(seed=0)
    with pytest.raises(ConfigError, match="whole numbers"):
        env.step(np.array([0.5, 0.5]))
    with pytest.raises(ConfigError, match=r"actions: expected shape \(2, 2\), found \(2,\)"):
        batch.step(np.zeros(2))


def test_importing_jaxsafe_is_enough() -> None:
    code = (
        "import jaxsafe, gymnasium;"
        " print(gymnasium.spec('jaxsafe/Docking2DOriented-v0').kwargs['task'])"
    )
    assert (
        subprocess.check_output([sys.executable, "-c", code], text=True).strip()
        == "docking2d_oriented"
    )


@pytest.mark.parametrize("kind", [thorough("threefry2x32"), thorough("rbg")])
def test_disturbances_differ_between_environments_that_start_alike(kind: str) -> None:
    with jax.default_prng_impl(kind):
        gusts = {
            "type": "gusts",
            "name": "gusts",
            "on": "deputy",
            "deviation": 0.01,
            "time_constant": 9,
        }
        envs = GymVectorEnv("docking2d", 2, overrides={"uncertainty": [gusts]})
        start = {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, 0.1]}}
        rows = []
        for _ in range(2):
            observations, _ = envs.reset(seed=3, options={"start": start})
            np.testing.assert_array_equal(observations[0], observations[1])
            rows.append(envs.step(np.zeros((2, 2), np.float32))[0])
        assert not np.array_equal(rows[0][0], rows[0][1])
        np.testing.assert_array_equal(rows[0], rows[1])  # equal seeds give equal episodes
