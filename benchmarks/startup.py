"""How long does it take until something runs: import, make, trace and compile, and the first result?

Every measurement is a process of its own; the median of some. The first table is without a compilation cache. Its first
program is a step with automatic reset in 64 lanes, of the tasks and of gymnax's Pendulum-v1; the training is ten seeds of
the task's recipe, its fresh state and its updates together.

The second table is the time from the first import to the first result: a batched reset and step, docking3d beside
Pendulum-v1 of gymnax, and an update of PPO on docking2d with the settings of `ppo.py`, beside rejax, whose task it is too,
through `jaxsafe.adapters.gymnax`: so rejax also pays for importing and making ours. Cold is with an empty
cache of compiled programs, warm with what the process before left there. Peers run in Python environments that this script
builds in `benchmarks/peers`. Writes `benchmarks/results/startup.json` and prints the tables:

    python benchmarks/startup.py [tasks=rejoin2d,…] [rta=none,default] [repeats=3]
"""

from __future__ import annotations

import importlib
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

from isolated import interpreter, several, versions, words
from isolated import probe as apart

OUT = Path(__file__).parent / "results" / "startup.json"
LANES = 64
COLUMNS = ("import", "make", "trace", "compile", "training: trace", "compile")


def main() -> None:
    """Run, write, print."""
    options = words(tasks="", rta="none,default", repeats="3")
    if "probe" in options:
        word = options["probe"]
        print(json.dumps(seconds_to(FIRST[word]) if word in FIRST else probe(*word.split(","))))
        return
    from machine import about

    from jaxsafe.envs import TASKS

    tasks = several("tasks", options["tasks"] or ",".join(TASKS), TASKS)
    chosen = [(task, rta) for rta in options["rta"].split(",") for task in tasks]
    here, repeats = about(), int(options["repeats"])
    rows = [measured(name, rta, repeats) for name, rta in chosen]
    rows.append(measured("Pendulum-v1", "gymnax", repeats, interpreter("gymnax")))
    first = [first_result(name, repeats) for name in FIRST]
    content = {
        **here,
        "peers": versions(["gymnax", "rejax"]),
        "unit": "s",
        "repeats": repeats,
        "columns": COLUMNS,
        "rows": rows,
        "first": first,
    }
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print("| s | " + " | ".join(COLUMNS) + " |\n|---|" + "---|" * len(COLUMNS))
    for row in rows:
        label = row["name"] if row["rta"] == "none" else f"{row['name']}, {row['rta']}"
        print(f"| {label} | " + " | ".join(f"{value:.2g}" for value in row["seconds"]) + " |")
    print("\n| s to the first result | cold | warm |\n|---|---|---|")
    for row in first:
        print(f"| {row['name']} | " + " | ".join(f"{statistics.median(row[kind]):.2g}" for kind in ("cold", "warm")) + " |")


def first_result(name: str, repeats: int) -> dict[str, Any]:
    """Seconds to the first result with an empty cache, and with a full one."""
    found: dict[str, Any] = {"name": name, "cold": [], "warm": []}
    python = interpreter(name.split()[0])
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as cache:
            for kind in ("cold", "warm"):
                found[kind].append(apart(__file__, [f"probe={name}"], None, python, Path(cache)))
    return found


def measured(name: str, rta: str, repeats: int, python: str = sys.executable) -> dict[str, Any]:
    """Medians over fresh processes."""
    found = [apart(__file__, [f"probe={name},{rta}"], python=python) for _ in range(repeats)]
    return {"name": name, "rta": rta, "seconds": [round(statistics.median(one), 3) for one in zip(*found, strict=True)]}


def probe(name: str, rta: str) -> list[float]:
    """Seconds of each column, in this process."""
    clock = [time.perf_counter()]
    tick: Callable[[], None] = lambda: clock.append(time.perf_counter())  # noqa: E731
    if rta == "gymnax":
        _gymnax(name, tick)
    else:
        _jaxsafe(name, rta, tick)
    return [after - before for before, after in pairwise(clock)]


def _jaxsafe(task: str, rta: str, tick: Callable[[], None]) -> None:
    import jax
    import jax.numpy as jnp

    import jaxsafe
    from jaxsafe import cli
    from jaxsafe.rollout import reset_batch, step_or_reset_batch
    from jaxsafe.train.config import resolve
    from jaxsafe.train.loop import programs
    from jaxsafe.train.seeds import SeedMapper, claim_cores

    claim_cores()
    tick()
    env = jaxsafe.make(task, rta=rta)
    tick()
    key = jax.random.key(0)
    state = jax.eval_shape(lambda env: reset_batch(env, key, LANES)[0], env)
    step = jax.jit(step_or_reset_batch).lower(env, state, jnp.zeros((LANES, env.action_size)), key)
    tick()
    step.compile()
    tick()
    config, env, _ = resolve(cli.Arguments.parse([f"env={task}", f"rta={rta}", "seeds=10"]))
    mapper = SeedMapper(config.seeds, config.shares)
    shared = mapper.replicate((env, config.agent, config.ppo))
    fresh, advance = programs(mapper, 10, config.num_updates)
    fresh = fresh.lower(shared, mapper.keys(0))
    updates = advance.lower(shared, jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), fresh.out_info))
    tick()
    fresh.compile()
    updates.compile()
    tick()


def _gymnax(name: str, tick: Callable[[], None]) -> None:
    import jax

    gymnax = importlib.import_module("gymnax")
    tick()
    env, params = gymnax.make(name)
    tick()
    keys = jax.random.split(jax.random.key(0), LANES)
    _, state = jax.eval_shape(jax.vmap(env.reset, in_axes=(0, None)), keys, params)
    action = jax.ShapeDtypeStruct((LANES, 1), "float32")
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None))).lower(keys, state, action, params)
    tick()
    step.compile()
    tick()


def seconds_to(result: Callable[[], Any]) -> float:
    """From before the first import until the result is there."""
    start = time.perf_counter()
    result()
    return time.perf_counter() - start


def our_step() -> None:
    """docking3d."""
    import jax
    import jax.numpy as jnp

    import jaxsafe
    from jaxsafe.rollout import reset_batch, step_or_reset_batch

    env, key = jaxsafe.make("docking3d"), jax.random.key(0)
    state, _ = jax.jit(reset_batch, static_argnums=2)(env, key, LANES)
    jax.block_until_ready(jax.jit(step_or_reset_batch)(env, state, jnp.zeros((LANES, 3)), key))


def gymnax_step() -> None:
    """Pendulum-v1."""
    import jax
    import jax.numpy as jnp

    env, params = importlib.import_module("gymnax").make("Pendulum-v1")
    keys = jax.random.split(jax.random.key(0), LANES)
    _, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    action = jnp.zeros((LANES, 1))
    jax.block_until_ready(jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))(keys, state, action, params))


def our_update() -> None:
    """PPO."""
    from jaxsafe.train.seeds import claim_cores

    claim_cores()
    import jax
    import ppo

    fresh, advance, keys, shared = ppo.our_programs("docking2d", 1, 1)
    jax.block_until_ready(advance(shared, fresh(shared, keys)))


def rejax_update() -> None:
    """PPO of rejax."""
    import jax
    import ppo

    jax.block_until_ready(ppo.rejax_trainer("docking2d", 1)(jax.random.PRNGKey(0)))


FIRST: dict[str, Callable[[], None]] = {
    "jaxsafe step": our_step,
    "gymnax step": gymnax_step,
    "jaxsafe update": our_update,
    "rejax update": rejax_update,
}
"""What is timed to its first result; the first word is the library."""

if __name__ == "__main__":
    main()
