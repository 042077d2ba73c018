"""Measure classical controllers and the policies that come with the package, from the same starts.

All of them fly every task without a filter and with `rta=default`. Results are written to
`benchmarks/results/controllers.json`, and the tables of docs/controllers.md are printed:

    python benchmarks/controllers.py [episodes=1000] [tasks=docking3d,rejoin2d]
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from isolated import several, words
from machine import about
from tables import controllers, controllers_filtered

import jaxsafe
from jaxsafe.bounds import best_possible
from jaxsafe.envs import STARTERS, TASKS, find_task
from jaxsafe.rollout import reset_batch
from jaxsafe.storage.files import write_json

OUT = Path(__file__).parent / "results" / "controllers.json"
PPO = "ppo"
"""Name of the policy that comes with the package."""

METRICS = (
    "success_rate",
    "average_return",
    "episode_length",
    "control_usage",
    "safety_violation_rate",
    "episode_safety_violation_rate",
    "episode_violation_severity_max",
    "intervention_rate",
)


def bounds(task: str, episodes: int) -> dict[str, float]:
    """Return bounds that theory gives for every policy, on average over the starts."""
    env = jaxsafe.make(task)
    key_start, _ = jax.random.split(jax.random.key(0))  # the starts of `jaxsafe.evaluate`
    starts, _ = jax.jit(reset_batch, static_argnums=2)(env, key_start, episodes)
    return {name: float(np.mean(values)) for name, values in best_possible(env, starts).items()}


def measure(task: str, name: str, rta: str, episodes: int) -> dict[str, Any]:
    """Fly whole episodes of one policy and return what they were like."""
    env = jaxsafe.make(task, rta=rta)
    policy = jaxsafe.load_policy(task if name == PPO else f"controller/{name}", env=env)
    began = time.perf_counter()
    metrics = jaxsafe.evaluate(env, policy, jax.random.key(0), episodes)
    row = {
        "task": task,
        "policy": name,
        "rta": rta,
        **{metric: metrics[metric] for metric in METRICS},
    }
    row["training_steps"] = policy.about["step"] if name == PPO else 0  # type: ignore[union-attr]
    row["wall_s"] = round(time.perf_counter() - began, 1)
    print(json.dumps(row), flush=True)
    return row


def main() -> None:
    """Run the command."""
    known = [*STARTERS, *TASKS]
    options = words(episodes="1000", tasks=",".join(known))
    episodes = int(options["episodes"])
    tasks = several("tasks", options["tasks"], known)
    rows = [
        measure(task, name, rta, episodes)
        for task in tasks
        for name in (*find_task(task).controllers, *[PPO] * (task in TASKS))
        for rta in ("none", "default")
    ]
    results = {
        "command": f"python benchmarks/controllers.py {' '.join(sys.argv[1:])}".strip(),
        "episodes": episodes,
        **about(__file__),
        "bounds": {task: bounds(task, episodes) for task in tasks},
        "rows": rows,
    }
    write_json(OUT, results)
    print(controllers(results), controllers_filtered(results), sep="\n\n")


if __name__ == "__main__":
    main()
