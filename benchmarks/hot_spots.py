"""Measure which functions of jaxsafe the time of a step goes into, on one core.

The program is that of `benchmarks/environments.py`: random actions and automatic resets. XLA makes
kernels of it, and its profiler measures each of them, which takes time as well. So read the shares.
A kernel counts for the innermost function of jaxsafe that its result was traced in, although parts
of others may be fused into it. Small loops are compiled as the commands compile them.

Results are written to `benchmarks/results/hot_spots.json`, and the table of
docs/performance_limits.md is printed:

    python benchmarks/hot_spots.py [names=rejoin3d,…] [envs=4096] [repeats=3]
"""

from __future__ import annotations

import functools
import json
import re
import statistics
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from isolated import probe, several, words
from profiler import profiled

import jaxsafe
from jaxsafe.devices.seed_mapper import claim_cores
from jaxsafe.envs import TASKS
from jaxsafe.storage.files import write_json

OUT = Path(__file__).parent / "results" / "hot_spots.json"
NUM_STEPS = 200
"""Steps of each environment in one measurement."""

ELSEWHERE = "elsewhere"
"""The name of what jaxsafe did not trace: random actions, copies, and what is between kernels."""

PACKAGE = Path(jaxsafe.__file__).parent


def main() -> None:
    """Measure each task in a process of its own, write the results and print the table."""
    options = words(names="rejoin3d", envs="4096", repeats="3", probe="")
    if options["probe"]:
        claim_cores()
        print(
            json.dumps(hot_spots(options["probe"], int(options["envs"]), int(options["repeats"])))
        )
        return
    import tables
    from machine import about

    sizes = [f"{name}={options[name]}" for name in ("envs", "repeats")]
    names = several("names", options["names"], TASKS)
    results = {
        "command": f"python benchmarks/hot_spots.py names={options['names']} {' '.join(sizes)}",
        **about(__file__),
        "rows": [probe(__file__, [f"probe={name}", *sizes], cores=1) for name in names],
    }
    write_json(OUT, results)
    print(tables.hot_spots(results))


def hot_spots(task: str, num_envs: int, repeats: int) -> dict[str, Any]:
    """Return the microseconds of one step of all environments, by function of jaxsafe.

    `step_us` is without the profiler, and `profiled_us` is the sum over the functions.

    Args:
        task: the task.
        num_envs: how many environments step side by side.
        repeats: number of measurements.
    """
    from environments import episode_steps

    run = functools.partial(episode_steps, jaxsafe.make(task))
    key = jax.random.key(0)
    program = jax.jit(run, static_argnums=(1, 2)).lower(key, num_envs, NUM_STEPS).compile()
    text = program.as_text() or ""
    owner = owners(text)
    known = set(re.findall(r"^ +(?:ROOT )?%(\S+) = ", text, re.M))
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        program(key).block_until_ready()
        seconds.append(time.perf_counter() - began)
    spent: Counter[str] = Counter()
    for _ in range(repeats):
        for name, nanoseconds in kernels(lambda: program(key).block_until_ready()).items():
            if name in known:  # and not what the profiler calls the runtime itself
                spent[owner.get(name, ELSEWHERE)] += nanoseconds // repeats
    scale = 1e3 * NUM_STEPS
    return {
        "task": task,
        "num_envs": num_envs,
        "step_us": round(1e6 * statistics.median(seconds[1:]) / NUM_STEPS, 2),
        "profiled_us": round(sum(spent.values()) / scale, 2),
        "spent_us": {name: round(value / scale, 2) for name, value in spent.most_common()},
    }


def kernels(run: Callable[[], Any]) -> Counter[str]:
    """Return the nanoseconds that each instruction of a program takes by itself.

    An instruction that runs others, such as a loop, has only the time between them.

    Args:
        run: runs the program until its result is there.
    """
    with profiled() as threads:
        run()
    spent: Counter[str] = Counter()
    for events in threads:
        around: list[tuple[float, str]] = []
        # Of two events that begin together the longer one is around the other.
        for start, duration, name in sorted(events, key=lambda event: (event[0], -event[1])):
            while around and around[-1][0] <= start:
                around.pop()
            spent[name] += round(duration)
            if around:
                spent[around[-1][1]] -= round(duration)
            around.append((start + duration, name))
    return spent


def owners(program: str) -> dict[str, str]:
    """Return the innermost function of jaxsafe in which each instruction was traced.

    Instructions that no function of jaxsafe has traced are left out.

    Args:
        program: the text of a compiled program, with XLA's tables of the places in the source.
    """
    names = {
        table: dict(re.findall(r'^(\d+) "(.*)"$', _table(program, table), re.M))
        for table in ("FileNames", "FunctionNames")
    }
    places = {
        number: (names["FileNames"][file], names["FunctionNames"][function])
        for number, file, function in re.findall(
            r"^(\d+) \{file_name_id=(\d+) function_name_id=(\d+)",
            _table(program, "FileLocations"),
            re.M,
        )
    }
    frames = {
        number: (places[place], parent)
        for number, place, parent in re.findall(
            r"^(\d+) \{file_location_id=(\d+) parent_frame_id=(\d+)",
            _table(program, "StackFrames"),
            re.M,
        )
    }

    def owner(frame: str) -> str | None:
        while True:
            (file, function), parent = frames[frame]
            if (path := Path(file)).is_relative_to(PACKAGE):
                module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
                return f"{module}.{function.split('.<locals>')[0]}"
            if parent == frame:
                return None
            frame = parent

    traced = re.findall(r"^ +(?:ROOT )?%(\S+) = .*stack_frame_id=(\d+)", program, re.M)
    return {name: found for name, frame in traced if (found := owner(frame))}


def _table(program: str, name: str) -> str:
    """Return the rows of one of XLA's tables. Each begins with its number."""
    return program.partition(f"\n{name}\n")[2].partition("\n\n")[0]


if __name__ == "__main__":
    main()
