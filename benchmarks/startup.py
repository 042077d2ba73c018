"""Measure how long it takes until something runs.

The parts are import, make, trace and compile, and the first result.

Every measurement is a process of its own, and numbers are medians of some repeats. Three tables are
printed:

- The first is without a compilation cache. Its first program is a step with automatic reset in 64
  environments, of the tasks and of gymnax's Pendulum-v1. The training is ten seeds of the task's
  recipe, its fresh state and its updates together.
- The second is the time from the first import to the first result. One result is a batched reset
  and step, docking3d beside Pendulum-v1 of gymnax. The other is an update of PPO on docking2d with
  the settings of `ppo.py`, beside rejax. rejax has the same task through `jaxsafe.adapters.gymnax`,
  so it also pays for importing and making ours. An update of `jaxsafe train` is there when its row
  is in the progress log, and the time counts from the start of its process. Cold is with an empty
  cache of compiled programs. Warm is with what the process before left there. Peers run in Python
  environments that this script builds in `benchmarks/peers`.
- The third is what that time goes into, according to JAX's own events and its profiler.

Results are written to `benchmarks/results/startup.json`:

    python benchmarks/startup.py [tasks=rejoin2d,…] [rta=none,default] [repeats=3]
"""

from __future__ import annotations

import importlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

from isolated import interpreter, several, variables, versions, words
from isolated import probe as apart
from profiler import profiled

OUT = Path(__file__).parent / "results" / "startup.json"
NUM_ENVS = 64
COLUMNS = ("import", "make", "trace", "compile", "training: trace", "compile")


def main() -> None:
    """Measure, write the results and print the tables."""
    options = words(tasks="", rta="none,default", repeats="3")
    if "probe" in options:
        word = options["probe"]
        traced = word.removeprefix("profile ")
        measure = seconds_to if traced == word else profile
        print(json.dumps(measure(FIRST[traced]) if traced in FIRST else probe(*word.split(","))))
        return
    from machine import about
    from tables import startup_first, startup_parts, startup_profile

    from jaxsafe.envs import TASKS

    tasks = several("tasks", options["tasks"] or ",".join(TASKS), TASKS)
    chosen = [(task, rta) for rta in options["rta"].split(",") for task in tasks]
    here = about(__file__)
    repeats = int(options["repeats"])
    rows = [measured(name, rta, repeats) for name, rta in chosen]
    rows.append(measured("Pendulum-v1", "gymnax", repeats, interpreter("gymnax")))
    first = [first_result(name, name, repeats) for name in (*FIRST, COMMAND)]
    profiles = [
        first_result(name, f"profile {name}", repeats)
        for name in FIRST
        if name.startswith("jaxsafe")
    ]
    content = {
        **here,
        "peers": versions(["gymnax", "rejax"]),
        "unit": "s",
        "repeats": repeats,
        "columns": COLUMNS,
        "rows": rows,
        "first": first,
        "profiles": profiles,
    }
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print("\n\n".join(make(content) for make in (startup_parts, startup_first, startup_profile)))


def first_result(name: str, word: str, repeats: int) -> dict[str, Any]:
    """Return what a probe measures with an empty cache (cold), and with a full one (warm)."""
    result: dict[str, Any] = {"name": name, "cold": [], "warm": []}
    python = interpreter(name.split()[0])
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as cache:
            for kind in ("cold", "warm"):
                result[kind].append(
                    first_row(Path(cache))
                    if name == COMMAND
                    else apart(__file__, [f"probe={word}"], None, python, Path(cache))
                )
    return result


def first_row(cache: Path) -> float:
    """Return the seconds from the start of `jaxsafe train` until its first update is logged."""
    from ppo import options_of

    options = [f"{name}={value}" for name, value in options_of("docking2d").items()]
    call = [sys.executable, "-m", "jaxsafe.train", *options, "seeds=1", "out=run"]
    with tempfile.TemporaryDirectory() as place:
        log = Path(place) / "run" / "progress.jsonl"
        start = time.perf_counter()
        with subprocess.Popen(
            call, cwd=place, env=variables(cache), stdout=subprocess.DEVNULL
        ) as process:
            while process.poll() is None and not (log.exists() and log.stat().st_size):
                time.sleep(0.005)
            seconds = time.perf_counter() - start
        # The command goes on to its end, since it keeps its programs while it trains.
        if process.returncode:
            sys.exit(f"{' '.join(call)}: exit code {process.returncode}")
    return seconds


def measured(name: str, rta: str, repeats: int, python: str = sys.executable) -> dict[str, Any]:
    """Return a row of the first table, with medians over fresh processes."""
    times = [apart(__file__, [f"probe={name},{rta}"], python=python) for _ in range(repeats)]
    return {
        "name": name,
        "rta": rta,
        "seconds": [round(statistics.median(column), 3) for column in zip(*times, strict=True)],
    }


def probe(name: str, rta: str) -> list[float]:
    """Return the seconds of each column, in this process."""
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
    from jaxsafe.devices.seed_mapper import SeedMapper, claim_cores
    from jaxsafe.rollout import reset_batch, step_or_reset_batch
    from jaxsafe.train.host.options import resolve
    from jaxsafe.train.train import programs

    claim_cores()
    tick()
    env = jaxsafe.make(task, rta=rta)
    tick()
    key = jax.random.key(0)
    state = jax.eval_shape(lambda env: reset_batch(env, key, NUM_ENVS)[0], env)
    step = jax.jit(step_or_reset_batch).lower(
        env, state, jnp.zeros((NUM_ENVS, env.action_size)), key
    )
    tick()
    step.compile()
    tick()
    config, env, _ = resolve({"env": task, "rta": rta, "seeds": 10})
    mapper = SeedMapper(config.seeds, config.shares)
    shared = mapper.replicate((env, config.agent, config.ppo))
    fresh, advance = programs(mapper, 10, config.num_updates)
    fresh = fresh.lower(shared, mapper.keys(0))
    updates = advance.lower(
        shared, jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), fresh.out_info)
    )
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
    keys = jax.random.split(jax.random.key(0), NUM_ENVS)
    _, state = jax.eval_shape(jax.vmap(env.reset, in_axes=(0, None)), keys, params)
    action = jax.ShapeDtypeStruct((NUM_ENVS, 1), "float32")
    step = jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None))).lower(keys, state, action, params)
    tick()
    step.compile()
    tick()


def seconds_to(result: Callable[[], Any]) -> float:
    """Return the seconds from before the first import until the result is there."""
    start = time.perf_counter()
    result()
    return time.perf_counter() - start


EVENTS = {
    "trace": "/jax/core/compile/jaxpr_trace_duration",
    "lower": "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "compile": "/jax/core/compile/backend_compile_duration",
}
"""Events by which JAX reports its stages, in their order.

A later stage may run inside an earlier one. Its time then counts for the later stage alone. Reading
the cache counts as compiling.
"""

REGIONS = {
    "XLA's passes": ("HLO passes through layout assignment", "HLO passes after layout assignment"),
    "emitters": ("FusionCompiler::Compile",),
    "LLVM": ("TaskDispatcher::dispatch",),
}
"""Names that XLA's profiler gives to the parts of compiling for a CPU.

Their times are summed over the threads that do them side by side.
"""


def profile(result: Callable[[], Any]) -> dict[str, float]:
    """Return the seconds of each of `tables.PARTS` until the result is there."""
    start = time.perf_counter()
    import jax

    imported = time.perf_counter()
    spans: list[tuple[str, float, float]] = []

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        spans.append((event, (now := time.perf_counter()) - duration_secs, now))

    jax.monitoring.register_event_duration_secs_listener(listen)
    if result is our_update:
        from jaxsafe.devices.seed_mapper import claim_cores

        claim_cores()  # here too, because XLA reads its flags when the profiler starts
    with profiled() as threads:
        began = time.perf_counter()
        result()
        ended = time.perf_counter()
    stages = [*EVENTS.values()]
    spent = [
        _covered([span for span in spans if span[0] in stages[i:]]) for i in range(len(stages))
    ]
    parts = {name: spent[i] - sum(spent[i + 1 : i + 2]) for i, name in enumerate(EVENTS)}
    parts |= {"import of JAX": imported - start, "the rest": ended - began - spent[0]}
    parts["whole"] = sum(parts.values())
    parts |= {
        part: sum(
            event.duration_ns for events in threads for event in events if event.name in regions
        )
        / 1e9
        for part, regions in REGIONS.items()
    }
    return {name: round(value, 3) for name, value in parts.items()}


def _covered(spans: list[tuple[str, float, float]]) -> float:
    """Return the seconds in which at least one of the spans was under way."""
    total = 0.0
    until = 0.0
    for _, begin, end in sorted(spans, key=lambda span: span[1]):
        total += max(0.0, end - max(begin, until))
        until = max(until, end)
    return total


def our_step() -> None:
    """Reset and step a batch of docking3d."""
    import jax
    import jax.numpy as jnp

    import jaxsafe
    from jaxsafe.rollout import reset_batch, step_or_reset_batch

    env = jaxsafe.make("docking3d")
    key = jax.random.key(0)
    state, _ = jax.jit(reset_batch, static_argnums=2)(env, key, NUM_ENVS)
    jax.block_until_ready(jax.jit(step_or_reset_batch)(env, state, jnp.zeros((NUM_ENVS, 3)), key))


def gymnax_step() -> None:
    """Reset and step a batch of Pendulum-v1."""
    import jax
    import jax.numpy as jnp

    env, params = importlib.import_module("gymnax").make("Pendulum-v1")
    keys = jax.random.split(jax.random.key(0), NUM_ENVS)
    _, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    action = jnp.zeros((NUM_ENVS, 1))
    jax.block_until_ready(
        jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None)))(keys, state, action, params)
    )


def our_update() -> None:
    """Make one update of our PPO."""
    from jaxsafe.devices.seed_mapper import claim_cores

    claim_cores()
    import jax
    import ppo

    fresh, advance, keys, shared = ppo.our_programs("docking2d", 1, 1)
    jax.block_until_ready(advance(shared, fresh(shared, keys)))


def rejax_update() -> None:
    """Make one update of the PPO of rejax."""
    import jax
    import ppo

    jax.block_until_ready(ppo.rejax_trainer("docking2d", 1)(jax.random.PRNGKey(0)))


FIRST: dict[str, Callable[[], None]] = {
    "jaxsafe step": our_step,
    "gymnax step": gymnax_step,
    "jaxsafe update": our_update,
    "rejax update": rejax_update,
}
"""Results whose time is measured. The first word is the library."""

COMMAND = "jaxsafe train"
"""The name of the row whose time is that of the command."""

if __name__ == "__main__":
    main()
