"""Measure how much memory a training takes, for each environment and for each seed.

- Stated: the bytes of one environment's state, and of what a seed keeps between updates besides its
  environments.
- Predicted: what the compiled update needs in all, according to XLA. A training adds what a process
  takes once: for compiling, for code and for the programs of its evaluations. Before it starts, it
  compares the sum with the memory that is free (`jaxsafe/devices/memory.py`).
- Measured: how far the resident memory of the process rises during two updates.

Each row is a process of its own, on Linux. Results are written to `benchmarks/results/memory.json`,
and the table of docs/scaling.md is printed:

    python benchmarks/memory.py [tasks=rejoin2d,…] [num_envs=1024,4096,16384]
"""

from __future__ import annotations

import json
from pathlib import Path

OUT = Path(__file__).parent / "results" / "memory.json"
NUM_STEPS = 32


def main() -> None:
    """Measure, write the results and print the table."""
    from isolated import probe as apart
    from isolated import several, words
    from machine import about
    from tables import memory

    from jaxsafe.envs import TASKS

    options = words(tasks=",".join(TASKS), num_envs="1024,4096,16384")
    if "probe" in options:
        print(json.dumps(probe(options["probe"], int(options["num_envs"]))))
        return
    here = about(__file__)
    tasks = several("tasks", options["tasks"], TASKS)
    sizes = [int(size) for size in options["num_envs"].split(",")]
    rows = []
    for task in tasks:
        for size in sizes:
            rows.append(
                {
                    "task": task,
                    "num_envs": size,
                    **apart(__file__, [f"probe={task}", f"num_envs={size}"]),
                }
            )
    content = {**here, "num_steps": NUM_STEPS, "runs": rows}
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print(memory(content))


def probe(task: str, num_envs: int) -> dict[str, int]:
    """Train two updates of one seed on one device and return their memory in bytes."""
    from jaxsafe.devices.seed_mapper import SeedMapper, claim_cores

    claim_cores()
    import jax

    from jaxsafe.devices import memory
    from jaxsafe.train.host.options import resolve
    from jaxsafe.train.train import programs

    sizes = {"ppo.num_envs": num_envs, "ppo.num_steps": NUM_STEPS, "ppo.num_epochs": 1}
    config, env, _ = resolve({"env": task, **sizes})
    mapper = SeedMapper(1)
    shared = mapper.replicate((env, config.agent, config.ppo))
    fresh, two = programs(mapper, 2, 2)
    state = fresh(shared, mapper.keys(0))
    advance = two.lower(shared, state).compile()
    batch_bytes = memory.size((state.env_state, state.observation, state.episode))
    # This resets the peak of the process, because compiling is not what is measured.
    Path("/proc/self/clear_refs").write_text("5")
    before = resident("VmRSS")
    jax.block_until_ready(advance(shared, state))
    return {
        "lane": batch_bytes // num_envs,
        "seed": memory.size(state) - batch_bytes,
        "predicted": memory.footprint(advance),
        "measured": resident("VmHWM") - before + memory.size(state),
    }


def resident(which: str) -> int:
    """Return the bytes of this process in memory, now (`VmRSS`) or at most (`VmHWM`)."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(which))


if __name__ == "__main__":
    main()
