"""Measure whether what makes this PPO fast changes what it learns.

Each variant trains ten seeds by the task's recipe in a process of its own:

- as it is,
- with its shuffle replaced by the sort of `jax.random.permutation`,
- with the gradient of a minibatch at once instead of in chunks,
- with every seed shared by two devices, which are two cores of a CPU.

All variants draw the same starts and noise. Rounding or order differ, so each ends with other
policies. Their quality must not differ beyond noise. Results are written to
`benchmarks/results/learning.json`, and a table is printed:

    python benchmarks/learning.py [tasks=docking2d,rejoin2d] [seeds=10] [seed=0]
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from isolated import probe, several, words

OUT = Path(__file__).parent / "results" / "learning.json"
VARIANTS = ("as it is", "sorting shuffle", "whole gradients", "two devices a seed")


def main() -> None:
    """Train, write the results and print the table."""
    options = words(tasks="docking2d,rejoin2d", seeds="10", seed="0")
    seeds = [f"{name}={options[name]}" for name in ("seeds", "seed")]
    if "probe" in options:
        print(json.dumps(trained(options["probe"], [f"env={options['tasks']}", *seeds])))
        return
    import tables
    from machine import about

    from jaxsafe.envs import TASKS

    here = about(__file__)
    tasks = several("tasks", options["tasks"], TASKS)
    rows = [
        {
            "task": task,
            "variant": name,
            **probe(__file__, [f"probe={name}", f"tasks={task}", *seeds]),
        }
        for task in tasks
        for name in VARIANTS
    ]
    content = {**here, "words": seeds, "runs": rows}
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print(tables.learning(content))


def trained(variant: str, arguments: list[str]) -> dict[str, Any]:
    """Train a variant.

    Return the steps to 80 % success, and the success and length of the episodes after training.
    """
    from jaxsafe.commands import train
    from jaxsafe.devices.seed_mapper import claim_cores
    from jaxsafe.train import ppo

    claim_cores()
    import jax

    if variant == "sorting shuffle":
        ppo.shuffle = jax.random.permutation
    if variant == "whole gradients":
        ppo.CHUNK = 1 << 30
    if variant == "two devices a seed":
        arguments = [*arguments, "devices_per_seed=2"]
    with tempfile.TemporaryDirectory() as place:
        if train.main([*arguments, f"out={place}/run"]):
            sys.exit("the training did not end")
        results = json.loads((Path(place) / "run" / "results.json").read_text(encoding="utf-8"))
    keep = ("success_rate", "episode_length")
    return {
        "steps_to_80": results["interaction_efficiency"]["timesteps"],
        "evaluation": {
            kind: {name: metrics[name] for name in keep}
            for kind, metrics in results["evaluation"].items()
        },
    }


if __name__ == "__main__":
    main()
