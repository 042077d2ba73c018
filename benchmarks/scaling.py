"""Measure what more cores and more seeds gain, and project what a thousand devices would gain.

Each measurement is a process of its own, pinned to one core or to a power of two of them. All take
turns. Compiling is measured apart. Numbers are medians of some repeats:

- environment steps, 4,096 environments on each core, as in `environments.py`,
- one seed of the PPO of `ppo.py` for each core,
- one seed, whose environments and minibatches the cores share.

The projection is for devices such as these cores. A seed on a device of its own takes as long as it
takes here beside other busy cores, and nothing goes between devices. Devices that share a seed
divide that time among them. Sharing also adds time: here it was measured against a perfect split,
and the projection adds it once for each doubling of the devices.

The projection contains no network between machines. It also assumes that small parts of a batch are
as efficient as large ones, which they are not. So for many devices per seed it is the best that can
be hoped for. Results are written to `benchmarks/results/scaling.json`, and two tables are printed:

    python benchmarks/scaling.py [task=docking3d] [repeats=3]
"""

from __future__ import annotations

import json
import math
import os
import statistics
import sys
import time
from pathlib import Path

import ppo
from isolated import probe, words

OUT = Path(__file__).parent / "results" / "scaling.json"
NUM_ENVS = 4096
NUM_STEPS = 1000
SHARED = (1, 8, 64)
"""Numbers of devices that share a seed, in the projection."""

DEVICES = 1000
"""Number of devices of the projection."""


def main() -> None:
    """Measure, write the results and print the tables."""
    options = words(task="docking3d", repeats="3")
    task = options["task"]
    repeats = int(options["repeats"])
    if "probe" in options:
        print(PROBES[options["probe"]](task))
        return
    import tables
    from machine import about

    from jaxsafe.devices.seed_mapper import usable_cores

    here = about(__file__)
    cores = 1 << (usable_cores().bit_length() - 1)
    if cores == 1:
        sys.exit("scaling.py: expected two cores or more, found one")
    measured: dict[tuple[str, int], list[float]] = {
        (name, count): [] for name in PROBES for count in (1, cores)
    }
    for _ in range(repeats):
        for name, count in measured:
            measured[name, count].append(probe(__file__, [f"probe={name}", f"task={task}"], count))
    rows = [
        {"what": name, "cores": count, "per_s": rates} for (name, count), rates in measured.items()
    ]
    rates = {key: statistics.median(values) for key, values in measured.items()}
    projected = projection(rates, cores)
    content = {**here, "task": task, "repeats": repeats, "runs": rows, "projection": projected}
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print(f"{tables.scaling(content)}\n\n{tables.projection(content)}")


def projection(rates: dict[tuple[str, int], float], cores: int) -> list[dict[str, float]]:
    """Project the samples a second of `DEVICES` such cores, some of them for each seed."""
    alone = rates[ONE_EACH, 1]
    busy = rates[ONE_EACH, cores] / cores
    shared = rates[SHARING, cores]
    update = ppo.BATCH / alone  # seconds of one seed on one core
    exchange = max(0.0, ppo.BATCH / shared - ppo.BATCH / busy / cores) / math.log2(cores)
    rows = []
    for count in SHARED:
        seeds = DEVICES // count
        seconds = ppo.BATCH / busy / count + exchange * math.log2(count)
        rate = seeds * ppo.BATCH / seconds
        rows.append(
            {
                "shared": count,
                "seeds": seeds,
                "samples_per_s": rate,
                "efficiency": rate * update / ppo.BATCH / DEVICES,
            }
        )
    return rows


def steps(task: str) -> float:
    """Measure environment steps a second of all cores."""
    from jaxsafe.devices.seed_mapper import claim_cores

    claim_cores()
    import environments
    import jax
    import numpy as np
    from jax.sharding import Mesh, PartitionSpec

    import jaxsafe

    env = jaxsafe.make(task)
    mesh = Mesh(np.array(jax.devices()), ("envs",))
    run = jax.jit(
        jax.shard_map(
            lambda key: environments.episode_steps(env, key[0], NUM_ENVS, NUM_STEPS)[None],
            mesh=mesh,
            in_specs=PartitionSpec("envs"),
            out_specs=PartitionSpec("envs"),
            check_vma=False,
        )
    )
    keys = jax.random.split(jax.random.key(0), mesh.size)
    run(keys).block_until_ready()
    start = time.perf_counter()
    run(keys).block_until_ready()
    return mesh.size * NUM_ENVS * NUM_STEPS / (time.perf_counter() - start)


def one_each(task: str) -> float:
    """Measure samples a second of as many seeds as there are cores."""
    return ppo.ours(task, seeds=len(os.sched_getaffinity(0)))


STEPS = "environment steps, 4,096 a core"
ONE_EACH = "samples, a seed for each core"
SHARING = "samples, one seed"
PROBES = {STEPS: steps, ONE_EACH: one_each, SHARING: ppo.ours}

if __name__ == "__main__":
    main()
