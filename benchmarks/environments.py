"""How many steps a second do the five tasks take, at 1, 1024, 4096 and 16384 lanes?

Random continuous actions, automatic reset, everything inside one compiled scan; compile time apart; the median of some
repeats. Where gymnax is installed its Pendulum-v1 runs in the same way in between. Writes
`benchmarks/results/environments.json` and prints the README's table:

    python benchmarks/environments.py [lanes=1,1024,4096,16384] [tasks=rejoin2d,…] [repeats=5]
"""

from __future__ import annotations

import functools
import importlib
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from machine import about

import jaxsafe
from jaxsafe.envs import TASKS
from jaxsafe.rollout import reset_batch, step_or_reset_batch

OUT = Path(__file__).parent / "results" / "environments.json"
RELEASED = (1800.0, 3000.0)
"""Steps a second of the released SafeRL code in one process, slowest and fastest task: a figure from elsewhere."""

NUM_STEPS = 1000
"""Steps of each lane in one measurement, many episodes long, so that resets have their share; 200 times as many for one."""


def main() -> None:
    """Run, write, print."""
    options = {key: value for key, _, value in (word.partition("=") for word in sys.argv[1:])}
    lanes = [int(number) for number in options.get("lanes", "1,1024,4096,16384").split(",")]
    tasks = options.get("tasks", ",".join(TASKS)).split(",")
    repeats = int(options.get("repeats", "5"))
    runs = {task: functools.partial(episode_steps, jaxsafe.make(task)) for task in tasks}
    runs |= gymnax_pendulum()
    results = [measure(name, run, num, repeats) for num in lanes for name, run in runs.items()]
    OUT.parent.mkdir(exist_ok=True)
    OUT.write_text(json.dumps({**about(), "released_steps_per_s": RELEASED, "runs": results}, indent=1) + "\n")
    print(table(results, lanes))


def episode_steps(env: jaxsafe.Environment, key: jax.Array, num_envs: int, num_steps: int) -> jax.Array:
    """Steps with random actions; the sum of rewards, so that nothing can be left out."""
    state, timestep = reset_batch(env, key, num_envs, axis=-1)

    def one(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        key_action, key_reset = jax.random.split(key)
        action = jax.random.uniform(key_action, (env.action_size, num_envs), minval=-1.0)
        carry, timestep = step_or_reset_batch(env, carry[0], action, key_reset, axis=-1)
        return carry, jnp.sum(timestep.reward) + jnp.sum(timestep.observation)

    return jnp.sum(jax.lax.scan(one, (state, timestep.observation), jax.random.split(key, num_steps))[1])


def gymnax_pendulum() -> dict[str, Callable]:
    """Pendulum-v1 of gymnax, which resets by itself."""
    try:
        gymnax = importlib.import_module("gymnax")
    except ImportError:
        return {}
    env, params = gymnax.make("Pendulum-v1")

    def run(key: jax.Array, num_envs: int, num_steps: int) -> jax.Array:
        def one(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            key_action, key_step = jax.random.split(key)
            action = jax.random.uniform(key_action, (num_envs, 1), minval=-2.0, maxval=2.0)
            keys = jax.random.split(key_step, num_envs)
            observation, state, reward, *_ = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, state, action, params)
            return state, jnp.sum(reward) + jnp.sum(observation)

        _, state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key, num_envs), params)
        return jnp.sum(jax.lax.scan(one, state, jax.random.split(key, num_steps))[1])

    return {"gymnax Pendulum-v1": run}


def measure(name: str, run: Callable, num_envs: int, repeats: int) -> dict[str, Any]:
    """Compile once, then time."""
    num_steps = NUM_STEPS * (200 if num_envs == 1 else 1)
    begin = time.perf_counter()
    compiled = jax.jit(run, static_argnums=(1, 2)).lower(jax.random.key(0), num_envs, num_steps).compile()
    compile_s = time.perf_counter() - begin
    rates = []
    for seed in range(repeats + 1):
        key = jax.random.key(seed)
        begin = time.perf_counter()
        compiled(key).block_until_ready()
        rates.append(num_envs * num_steps / (time.perf_counter() - begin))
    rates = rates[1:]  # the first warms caches
    return {
        "task": name,
        "lanes": num_envs,
        "steps_per_s": statistics.median(rates),
        "slowest": min(rates),
        "fastest": max(rates),
        "compile_s": round(compile_s, 2),
    }


def table(results: list[dict[str, Any]], lanes: list[int]) -> str:
    """Markdown: million steps a second."""
    lines = ["| million steps/s | " + " | ".join(f"{num:,}" for num in lanes) + " |", "|---|" + "---|" * len(lanes)]
    for name in dict.fromkeys(run["task"] for run in results):
        cells = [f"{run['steps_per_s'] / 1e6:.3g}" for run in results if run["task"] == name]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
