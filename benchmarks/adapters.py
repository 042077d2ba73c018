"""Measure how fast the tasks are through Gymnasium, and what each adapter costs.

These are measured at some numbers of environments, in steps a second with actions chosen
beforehand:

- `GymVectorEnv`,
- Gymnasium's SyncVectorEnv of the same task,
- Gymnasium's NumPy-vectorised CartPole,
- EnvPool's CartPole, where it is installed,
- the pure step with automatic reset, called from Python in the same way,
- `SafetyEnv`,
- the adapters for gymnax, Brax and Stable-Baselines3, where those are installed.

Compile time is measured apart. Numbers are medians of some repeats, in which all take turns.
Results are written to `benchmarks/results/adapters.json`, and a table is printed:

    python benchmarks/adapters.py [task=docking2d] [envs=1,64,1024,4096] [repeats=5]
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import tables
from gymnasium.vector import SyncVectorEnv
from isolated import words
from machine import about

import jaxsafe
from jaxsafe.adapters.gymnasium import GymEnv, GymVectorEnv
from jaxsafe.adapters.safety_gymnasium import SafetyEnv
from jaxsafe.rollout import reset_batch, step_or_reset_batch

OUT = Path(__file__).parent / "results" / "adapters.json"
SECONDS = 1.0
"""About how long one measurement takes."""

Step = Callable[[], Any]
"""A function that takes one step of all environments."""


def main() -> None:
    """Measure, write the results and print the table."""
    options = words(task="docking2d", repeats="5", envs="1,64,1024,4096")
    task = options["task"]
    repeats = int(options["repeats"])
    numbers = [int(number) for number in options["envs"].split(",")]
    here = about(__file__)
    results = [
        {"envs": number, **measure(peers(task, number), number, repeats)} for number in numbers
    ]
    content = {**here, "gymnasium": gym.__version__, "task": task, "runs": results}
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print(tables.adapters(content))


def peers(task: str, number: int) -> dict[str, Step]:
    """Return the step of each peer by its name."""
    env = jaxsafe.make(task)  # made once, not for each of thousands of single environments
    steps = {
        "pure functions, called from Python": pure(task, number),
        "GymVectorEnv": vector(GymVectorEnv(task, number, autoreset_mode="SameStep")),
        "SafetyEnv": vector(SafetyEnv(task, number)),
        "SyncVectorEnv of GymEnv": vector(SyncVectorEnv([lambda: GymEnv(env)] * number)),
        "Gymnasium CartPole, NumPy": vector(gym.make_vec("CartPole-v1", num_envs=number)),
    }
    if number == 1:
        steps["GymEnv"] = single(GymEnv(task))
    for name, package, build in (
        ("EnvPool CartPole", "envpool", envpool_cartpole),
        ("GymnaxEnv", "gymnax", gymnax_env),
        ("BraxEnv", "brax", brax_env),
        ("SB3VecEnv", "stable_baselines3", sb3_env),
    ):
        if importlib.util.find_spec(package):
            steps[name] = build(task, number)
    return steps


def pure(task: str, number: int) -> Step:
    """Return the compiled step with automatic reset."""
    env = jaxsafe.make(task)
    step = jax.jit(step_or_reset_batch)
    state, _ = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(0), number)
    action = np.random.default_rng(0).uniform(-1, 1, (number, env.action_size)).astype(np.float32)
    key = jax.random.key(1)

    def step_all() -> Any:
        nonlocal state
        (state, observation), timestep = step(env, state, action, key)
        return np.asarray(observation), np.asarray(timestep.reward), np.asarray(timestep.terminated)

    return step_all


def vector(env: Any) -> Step:
    """Return the step of a Gymnasium vector environment."""
    env.reset(seed=0)
    env.action_space.seed(0)
    action = env.action_space.sample()
    return lambda: env.step(action)


def single(env: gym.Env) -> Step:
    """Return the step of a single Gymnasium environment, which is reset when its episode ends."""
    env.reset(seed=0)
    action = env.action_space.sample()

    def step_once() -> None:
        *_, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return step_once


def envpool_cartpole(task: str, number: int) -> Step:
    """Return the step of EnvPool's CartPole-v1, in C++ threads."""
    envpool = importlib.import_module("envpool")
    env = envpool.make("CartPole-v1", env_type="gymnasium", num_envs=number, seed=0)
    env.reset()
    action = np.ones(number, np.int32)
    return lambda: env.step(action)


def gymnax_env(task: str, number: int) -> Step:
    """Return the step of the gymnax adapter, mapped over environments."""
    env = importlib.import_module("jaxsafe.adapters.gymnax").GymnaxEnv(task)
    params = env.default_params
    keys = jax.random.split(jax.random.key(0), number)
    _, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))
    action = jnp.zeros((number, env.env.action_size))

    def step_all() -> Any:
        nonlocal state
        observation, state, reward, *_ = step(keys, state, action, params)
        return np.asarray(observation), np.asarray(reward)

    return step_all


def brax_env(task: str, number: int) -> Step:
    """Return the step of the Brax adapter with fresh starts."""
    brax = importlib.import_module("jaxsafe.adapters.brax")
    env = brax.wrap(brax.BraxEnv(task), 10_000)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), number))
    step = jax.jit(env.step)
    action = jnp.zeros((number, env.action_size))

    def step_all() -> Any:
        nonlocal state
        state = step(state, action)
        return np.asarray(state.obs), np.asarray(state.reward)

    return step_all


def sb3_env(task: str, number: int) -> Step:
    """Return the step of the adapter for Stable-Baselines3."""
    env = importlib.import_module("jaxsafe.adapters.stable_baselines3").SB3VecEnv(task, number)
    env.reset()
    action = np.zeros((number, *env.action_space.shape), np.float32)
    return lambda: env.step(action)


def measure(steps: dict[str, Step], number: int, repeats: int) -> dict[str, Any]:
    """Measure steps a second of each peer.

    The peers take turns, so that a slow moment of the machine hits all of them.
    """
    counts = {}
    first = {}
    for name, step in steps.items():
        begin = time.perf_counter()
        step()
        first[name] = time.perf_counter() - begin
        begin = time.perf_counter()
        taken = 0
        while taken < 10 and time.perf_counter() - begin < SECONDS:
            step()
            taken += 1
        counts[name] = max(1, int(SECONDS / repeats * taken / (time.perf_counter() - begin)))
    rates: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(repeats):
        for name, step in steps.items():
            begin = time.perf_counter()
            for _ in range(counts[name]):
                step()
            rates[name].append(number * counts[name] / (time.perf_counter() - begin))
    return {
        "steps_per_s": {
            name: round(statistics.median(values), 1) for name, values in rates.items()
        },
        "slowest": {name: round(min(values), 1) for name, values in rates.items()},
        "fastest": {name: round(max(values), 1) for name, values in rates.items()},
        "first_step_s": {name: round(value, 2) for name, value in first.items()},
    }


if __name__ == "__main__":
    main()
