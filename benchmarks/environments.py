"""Measure how many steps a second the five tasks take on one core, beside other libraries.

Actions are random and continuous, resets are automatic, and everything is inside one compiled scan.
Compile time is measured apart. Numbers are medians of some repeats. Each row is a process of its
own, pinned to one core. Peers run in Python environments that this script builds in
`benchmarks/peers`.

- `docking3d:usual_way` is the same task with what most JAX environments do: a key for every
  environment at every step, and a start drawn whether it is needed or not.
- Rows that end in `:one_action` draw actions once and take them at every step, so that the
  environment is alone in the loop.
- `docking3d:no_reset` also draws actions once. Where an episode ends, it goes on without a reset.
- Peers are other and mostly smaller tasks: gymnax's CartPole and Pendulum, Brax's inverted pendulum
  (spring), and CartPole of Gymnasium (NumPy) and EnvPool (one thread). The last two get the same
  actions at every step.

Results are written to `benchmarks/results/environments.json`, and the table of docs/performance.md
is printed:

    python benchmarks/environments.py [envs=1,1024,4096,16384] [names=docking3d,…]
        [repeats=5]
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
import numpy as np
from isolated import interpreter, probe, several, versions, words

import jaxsafe
from jaxsafe.envs import TASKS
from jaxsafe.rollout import reset_batch, step_or_reset, step_or_reset_batch

OUT = Path(__file__).parent / "results" / "environments.json"
RELEASED = (1800.0, 3000.0)
"""Steps a second of the released SafeRL code in one process, for its slowest and fastest task.

This script does not measure them.
"""

NUM_STEPS = 1000
"""Steps of each environment in one measurement, so that resets have their share.

A single environment takes 200 times as many.
"""

SLOW_STEPS = 2_000_000
"""Steps of all environments together in one measurement of a step that is called from Python."""


def main() -> None:
    """Measure, write the results and print the table."""
    options = words(envs="1,1024,4096,16384", names=",".join(RUNS), repeats="5")
    sizes = [int(number) for number in options["envs"].split(",")]
    names = several("names", options["names"], RUNS)
    repeats = int(options["repeats"])
    if "probe" in options:
        print(json.dumps(RUNS[options["probe"]](sizes[0], repeats)))
        return
    import tables
    from machine import about

    here = about(__file__)
    python = {
        library: interpreter(library) for library in {name.partition(":")[0] for name in names}
    }
    results = []
    for num in sizes:
        for name in names:
            request = [f"probe={name}", f"envs={num}", f"repeats={repeats}"]
            rate = probe(__file__, request, 1, python[name.partition(":")[0]])
            results.append({"task": name, "num_envs": num, **rate})
            print(f"{name} × {num:,}: {rate['steps_per_s']:,.0f}", file=sys.stderr)
    content = {
        **here,
        "peers": versions(python),
        "pinned_to": 1,
        "released_steps_per_s": RELEASED,
        "runs": results,
    }
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print(tables.environments(content))


def task(
    name: str, num_envs: int, repeats: int, one_action: bool = False, reset: bool = True
) -> dict[str, Any]:
    """Measure one of the five tasks."""
    run = functools.partial(episode_steps, jaxsafe.make(name), one_action=one_action, reset=reset)
    return compiled(run, num_envs, repeats)


def episode_steps(
    env: jaxsafe.Environment,
    key: jax.Array,
    num_envs: int,
    num_steps: int,
    one_action: bool = False,
    reset: bool = True,
) -> jax.Array:
    """Take steps with random actions. Return the sum of rewards, costs and observations.

    The compiler leaves out nothing, because the sum depends on everything.
    """
    state, timestep = reset_batch(env, key, num_envs, axis=-1)
    draw = lambda key: jax.random.uniform(key, (env.action_size, num_envs), minval=-1.0)  # noqa: E731
    first = draw(key)

    def one_step(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        key_action, key_reset = jax.random.split(key)
        action = first if one_action else draw(key_action)
        if reset:
            carry, timestep = step_or_reset_batch(env, carry[0], action, key_reset, axis=-1)
        else:
            state, timestep = jax.vmap(jaxsafe.step, in_axes=(None, -1, -1), out_axes=-1)(
                env, carry[0], action
            )
            carry = (state, timestep.observation)
        return carry, jnp.sum(timestep.reward) + jnp.sum(timestep.cost) + jnp.sum(carry[1])

    return jnp.sum(
        jax.lax.scan(one_step, (state, timestep.observation), jax.random.split(key, num_steps))[1]
    )


def usual_way(num_envs: int, repeats: int) -> dict[str, Any]:
    """Measure docking3d as most JAX environments are written: a `vmap` of a single environment."""
    env = jaxsafe.make("docking3d")

    def run(key: jax.Array, num_envs: int, num_steps: int) -> jax.Array:
        def one_step(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            key_action, key_step = jax.random.split(key)
            action = jax.random.uniform(key_action, (num_envs, env.action_size), minval=-1.0)
            keys = jax.random.split(key_step, num_envs)
            (state, observation), timestep = jax.vmap(step_or_reset, in_axes=(None, 0, 0, 0))(
                env, carry, action, keys
            )
            return state, jnp.sum(timestep.reward) + jnp.sum(timestep.cost) + jnp.sum(observation)

        state, _ = jax.vmap(jaxsafe.reset, in_axes=(None, 0))(env, jax.random.split(key, num_envs))
        return jnp.sum(jax.lax.scan(one_step, state, jax.random.split(key, num_steps))[1])

    return compiled(run, num_envs, repeats)


def gymnax(name: str, num_envs: int, repeats: int, one_action: bool = False) -> dict[str, Any]:
    """Measure an environment of gymnax, which resets by itself."""
    return compiled(gymnax_steps(name, one_action), num_envs, repeats)


def gymnax_steps(name: str, one_action: bool = False) -> Callable[[jax.Array, int, int], jax.Array]:
    """Return a function that steps an environment of gymnax as `episode_steps` steps ours.

    It takes a key, the number of environments, and the number of steps.
    """
    env, params = importlib.import_module("gymnax").make(name)
    space = env.action_space(params)

    def draw(key: jax.Array, num_envs: int) -> jax.Array:
        if hasattr(space, "n"):
            return jax.random.randint(key, (num_envs,), 0, space.n)
        return jax.random.uniform(
            key, (num_envs, *space.shape), minval=space.low, maxval=space.high
        )

    def run(key: jax.Array, num_envs: int, num_steps: int) -> jax.Array:
        first = draw(key, num_envs)

        def one_step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            key_action, key_step = jax.random.split(key)
            action = first if one_action else draw(key_action, num_envs)
            keys = jax.random.split(key_step, num_envs)
            observation, state, reward, *_ = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
                keys, state, action, params
            )
            return state, jnp.sum(reward) + jnp.sum(observation)

        _, state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key, num_envs), params)
        return jnp.sum(jax.lax.scan(one_step, state, jax.random.split(key, num_steps))[1])

    return run


def brax(num_envs: int, repeats: int) -> dict[str, Any]:
    """Measure Brax's inverted pendulum by its spring method, in its own wrappers."""
    env = importlib.import_module("brax.envs").create(
        "inverted_pendulum", backend="spring", batch_size=num_envs
    )

    def run(key: jax.Array, num_envs: int, num_steps: int) -> jax.Array:
        def one_step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            state = env.step(
                state, jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0)
            )
            return state, jnp.sum(state.reward) + jnp.sum(state.obs)

        return jnp.sum(jax.lax.scan(one_step, env.reset(key), jax.random.split(key, num_steps))[1])

    return compiled(run, num_envs, repeats, NUM_STEPS // 10)  # far slower than the tasks


def gymnasium(num_envs: int, repeats: int) -> dict[str, Any]:
    """Measure CartPole of Gymnasium, written for NumPy."""
    env = importlib.import_module("gymnasium").make_vec("CartPole-v1", num_envs=num_envs)
    env.reset(seed=0)
    action = env.action_space.sample()
    return called(lambda: env.step(action), num_envs, repeats)


def envpool(num_envs: int, repeats: int) -> dict[str, Any]:
    """Measure CartPole of EnvPool, in C++."""
    env = importlib.import_module("envpool").make(
        "CartPole-v1", env_type="gymnasium", num_envs=num_envs, num_threads=1
    )
    env.reset()
    action = np.ones(num_envs, np.int32)
    return called(lambda: env.step(action), num_envs, repeats)


def compiled(
    run: Callable, num_envs: int, repeats: int, num_steps: int = NUM_STEPS
) -> dict[str, Any]:
    """Compile once, then measure. Each environment makes `num_steps` steps.

    A single environment makes 200 times as many.
    """
    num_steps *= 200 if num_envs == 1 else 1
    begin = time.perf_counter()
    program = (
        jax.jit(run, static_argnums=(1, 2)).lower(jax.random.key(0), num_envs, num_steps).compile()
    )
    compile_s = time.perf_counter() - begin
    seconds = []
    for seed in range(repeats + 1):
        key = jax.random.key(seed)
        begin = time.perf_counter()
        program(key).block_until_ready()
        seconds.append(time.perf_counter() - begin)
    return rates(num_envs * num_steps, seconds, compile_s)


def called(step: Callable[[], Any], num_envs: int, repeats: int) -> dict[str, Any]:
    """Measure a step of all environments that is called from Python."""
    num_steps = max(10, min(SLOW_STEPS // num_envs, 20_000))
    seconds = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        for _ in range(num_steps):
            step()
        seconds.append(time.perf_counter() - begin)
    return rates(num_envs * num_steps, seconds, 0.0)


def rates(steps: int, seconds: list[float], compile_s: float) -> dict[str, Any]:
    """Return the median, the slowest and the fastest rate.

    The first time warms caches and is left out.
    """
    per_second = sorted(steps / spent for spent in seconds[1:])
    return {
        "steps_per_s": statistics.median(per_second),
        "slowest": per_second[0],
        "fastest": per_second[-1],
        "compile_s": round(compile_s, 2),
    }


RUNS: dict[str, Callable[[int, int], dict[str, Any]]] = {
    **{name: functools.partial(task, name) for name in TASKS},
    "docking3d:one_action": functools.partial(task, "docking3d", one_action=True),
    "docking3d:no_reset": functools.partial(task, "docking3d", one_action=True, reset=False),
    "docking3d:usual_way": usual_way,
    **{
        f"gymnax:{name}": functools.partial(gymnax, name) for name in ("Pendulum-v1", "CartPole-v1")
    },
    "gymnax:Pendulum-v1:one_action": functools.partial(gymnax, "Pendulum-v1", one_action=True),
    "brax:inverted_pendulum": brax,
    "gymnasium:CartPole-v1": gymnasium,
    "envpool:CartPole-v1": envpool,
}

if __name__ == "__main__":
    main()
