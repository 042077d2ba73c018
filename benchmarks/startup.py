"""How long does it take until something runs: import, make, trace and compile?

Every measurement is a process of its own without a compilation cache; the median of some. The first program is a step with
automatic reset in 64 lanes, where gymnax is installed also of its Pendulum-v1; the training is ten seeds of the task's
recipe, its fresh state and its updates together. Writes `benchmarks/results/startup.json` and prints the table:

    python benchmarks/startup.py [tasks=rejoin2d,…] [rta=none,default] [repeats=3]
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import statistics
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

from isolated import probe as apart

OUT = Path(__file__).parent / "results" / "startup.json"
LANES = 64
COLUMNS = ("import", "make", "trace", "compile", "training: trace", "compile")


def main() -> None:
    """Run, write, print."""
    options = {key: value for key, _, value in (word.partition("=") for word in sys.argv[1:])}
    if "probe" in options:
        print(json.dumps(probe(*options["probe"].split(","))))
        return
    from machine import about

    from jaxsafe.envs import TASKS

    tasks = options.get("tasks", ",".join(TASKS)).split(",")
    chosen = [(task, rta) for rta in options.get("rta", "none,default").split(",") for task in tasks]
    if importlib.util.find_spec("gymnax"):
        chosen.append(("Pendulum-v1", "gymnax"))
    repeats = int(options.get("repeats", "3"))
    rows = [measured(name, rta, repeats) for name, rta in chosen]
    OUT.parent.mkdir(exist_ok=True)
    content = {**about(), "unit": "s", "repeats": repeats, "columns": COLUMNS, "rows": rows}
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print("| s | " + " | ".join(COLUMNS) + " |\n|---|" + "---|" * len(COLUMNS))
    for row in rows:
        label = row["name"] if row["rta"] == "none" else f"{row['name']}, {row['rta']}"
        print(f"| {label} | " + " | ".join(f"{value:.2g}" for value in row["seconds"]) + " |")


def measured(name: str, rta: str, repeats: int) -> dict[str, Any]:
    """Medians over fresh processes."""
    found = [apart(__file__, [f"probe={name},{rta}"]) for _ in range(repeats)]
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

    from jaxsafe.train.seeds import claim_cores

    claim_cores()
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


if __name__ == "__main__":
    main()
