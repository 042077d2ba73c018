"""Transitions and episodes recorded from the released implementation; `golden/README.md` says what they are.

In x64 the recordings are met to rounding. In float32, in which training runs, whole episodes of up to 2001 steps and
up to 40 km stay within 5 mm and 0.05 mm/s of them.
"""

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe import Environment
from jaxsafe.types import State, TimeStep

GOLDEN = Path(__file__).parent / "golden"
TASKS = ("docking2d", "docking3d")
N = 0.001027
FAILURES = ("running", "crash", "timeout", "distance", "velocity")  # by code
REWARDS = ("distance_change", "delta_v", "velocity_constraint", "failure", "success")  # by column


def start(env: Environment, deputy: Any) -> tuple[State, TimeStep]:
    position, velocity = jnp.split(jnp.asarray(deputy), 2)
    return jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": velocity}})


def deputy_state(state: State) -> jax.Array:
    deputy = state.sim.platforms["deputy"]
    return jnp.concatenate([deputy.position, deputy.velocity])


@jax.jit
def single_steps(env: Environment, deputies: jax.Array, actions: jax.Array) -> tuple[jax.Array, TimeStep, TimeStep]:
    """One step from each recorded state: the next state and the time steps before and after."""

    def one(deputy: jax.Array, action: jax.Array) -> tuple[jax.Array, TimeStep, TimeStep]:
        state, before = start(env, deputy)
        state, after = jaxsafe.step(env, state, action)
        return deputy_state(state), before, after

    return jax.vmap(one)(deputies, actions)


@jax.jit
def free_run(env: Environment, deputies: jax.Array, actions: jax.Array) -> tuple[jax.Array, TimeStep]:
    """Whole episodes from their starts, [episodes, steps]."""

    def one_step(state: State, action: jax.Array) -> tuple[State, tuple[jax.Array, TimeStep]]:
        state, timestep = jaxsafe.step(env, state, action)
        return state, (deputy_state(state), timestep)

    return jax.vmap(lambda deputy, taken: jax.lax.scan(one_step, start(env, deputy)[0], taken)[1])(deputies, actions)


@functools.cache
def transitions(task: str) -> dict[str, np.ndarray]:
    """Every recorded transition: the scattered ones and each step of each episode."""
    scattered, episodes = (np.load(GOLDEN / f"{task}{suffix}.npz") for suffix in ("_transitions", ""))
    starts = episodes["ep_start"]
    after = np.arange(starts[-1]) + np.repeat(np.arange(1, len(starts)), np.diff(starts))
    whole = {"action": episodes["action"], "control": episodes["control"], "rewards": episodes["reward_components"]}
    apart = {"action": scattered["action"], "control": scattered["control"], "rewards": scattered["reward_components"]}
    for name in ("deputy_state", "obs"):
        for suffix, rows in (("_t0", after - 1), ("_t1", after)):
            whole[name + suffix], apart[name + suffix] = episodes[name][rows], scattered[name + suffix]
    return {name: np.concatenate([apart[name], whole[name]]) for name in whole}


@functools.cache
def episodes(task: str) -> dict[str, Any]:
    """The recorded episodes, padded to the longest: [episodes, steps]; `taken` marks the steps that were recorded."""
    recorded = np.load(GOLDEN / f"{task}.npz")
    starts, lengths = recorded["ep_start"], np.diff(recorded["ep_start"])

    def pad(array: np.ndarray, first: int) -> np.ndarray:
        """Steps, or, with `first` 1, the states after each step."""
        out = np.zeros((len(lengths), lengths.max(), *array.shape[1:]), array.dtype)
        for i, length in enumerate(lengths):
            begin = starts[i] + (i + first if first else 0)
            out[i, :length] = array[begin : begin + length]
        return out

    padded = {name: pad(recorded[name], 0) for name in ("action", "reward", "reward_components", "done")}
    padded |= {name: pad(recorded[name], 1) for name in ("deputy_state", "status_failure", "status_docking_distance")}
    first = recorded["deputy_state"][starts[:-1] + np.arange(len(lengths))]
    taken = np.arange(lengths.max()) < lengths[:, None]
    return {"names": list(recorded["ep_name"]), "start": first, "lengths": lengths, "taken": taken, **padded}


@pytest.mark.parametrize("task", TASKS)
def test_the_recordings_are_complete(task: str) -> None:
    assert len(transitions(task)["action"]) > 6000
    assert len(episodes(task)["names"]) == 14
    assert episodes(task)["lengths"].max() == 2001


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.usefixtures("x64")
def test_one_step_from_every_recorded_state_is_the_recorded_step(task: str) -> None:
    recorded = transitions(task)
    deputies, before, after = single_steps(jaxsafe.make(task), recorded["deputy_state_t0"], recorded["action"])
    np.testing.assert_allclose(deputies, recorded["deputy_state_t1"], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(after.info.control_desired, recorded["control"])
    np.testing.assert_array_equal(after.info.control_actual, recorded["control"])
    same = slice(0, -1)  # all but the speed limit
    np.testing.assert_allclose(before.observation[:, same], recorded["obs_t0"][:, same], rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.observation[:, same], recorded["obs_t1"][:, same], rtol=0, atol=1e-10)
    change = after.info.reward_terms["distance_change"]
    np.testing.assert_allclose(change, recorded["rewards"][:, 0], rtol=0, atol=1e-12)
    assert np.abs(recorded["control"]).max() == 1.0 < np.abs(recorded["action"]).max()


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.usefixtures("x64")
def test_whole_episodes_run_freely_as_recorded(task: str) -> None:
    recorded = episodes(task)
    deputies, timesteps = free_run(jaxsafe.make(task), recorded["start"], recorded["action"])
    taken = recorded["taken"]
    np.testing.assert_allclose(deputies[taken], recorded["deputy_state"][taken], rtol=0, atol=1e-9)
    change = np.asarray(timesteps.info.reward_terms["distance_change"])
    np.testing.assert_allclose(change[taken], recorded["reward_components"][taken][:, 0], rtol=0, atol=1e-11)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.usefixtures("x64")
def test_with_the_released_speed_limit_all_rewards_and_ends_outside_the_region_are_as_recorded(task: str) -> None:
    env = jaxsafe.make(task, {"status.velocity_limit.floor": 0.2 - 0.5 * 2 * N, "status.delta_v.norm": "l1"})
    recorded = episodes(task)
    _, timesteps = free_run(env, recorded["start"], recorded["action"])
    outside = recorded["taken"] & (recorded["status_docking_distance"] > 0.5)
    assert 0 < (recorded["taken"] & ~outside).sum() < 14  # the last step of the episodes that dock or crash
    for column, name in enumerate(REWARDS):
        found, expected = timesteps.info.reward_terms[name], recorded["reward_components"][..., column]
        np.testing.assert_allclose(found[outside], expected[outside], rtol=0, atol=1e-10, err_msg=name)
    np.testing.assert_allclose(timesteps.reward[outside], recorded["reward"][outside], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(timesteps.terminated[outside], recorded["done"][outside])
    codes = np.asarray([env.outcomes.index(name) for name in FAILURES])
    outcomes = np.asarray(timesteps.info.outcome)[outside]
    np.testing.assert_array_equal(outcomes, codes[recorded["status_failure"][outside]])
    assert {env.outcomes[outcome] for outcome in outcomes} == {"running", "timeout", "distance", "velocity"}


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.usefixtures("x64")
def test_episodes_end_inside_the_region_or_in_time_as_recorded(task: str) -> None:
    """The ends that the paper and the released program share; the others depend on the speed limit."""
    env, recorded = jaxsafe.make(task), episodes(task)
    _, timesteps = free_run(env, recorded["start"], recorded["action"])
    shared = {"timeout_station": "timeout", "distance_override": "distance", "crash_1mps": "crash"}
    shared |= {name: "success" for name in recorded["names"] if name.startswith("success")}
    assert len(shared) >= 6
    for name, end in shared.items():
        i = recorded["names"].index(name)
        outcomes = [env.outcomes[k] for k in timesteps.info.outcome[i, : recorded["lengths"][i]]]
        assert outcomes == ["running"] * (len(outcomes) - 1) + [end], name


@pytest.mark.parametrize("task", TASKS)
def test_in_float32_whole_episodes_stay_within_five_millimetres(task: str) -> None:
    recorded = episodes(task)
    taken = recorded["taken"]
    deputies, timesteps = free_run(jaxsafe.make(task), jnp.float32(recorded["start"]), jnp.float32(recorded["action"]))
    assert deputies.dtype == jnp.float32
    error = np.abs(np.asarray(deputies, float) - recorded["deputy_state"])[taken]
    position, velocity = np.split(error, 2, axis=-1)
    assert position.max() < 5e-3
    assert velocity.max() < 5e-5
    change = np.asarray(timesteps.info.reward_terms["distance_change"], float)
    np.testing.assert_allclose(change[taken], recorded["reward_components"][taken][:, 0], rtol=0, atol=1e-5)
