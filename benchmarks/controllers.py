"""Measure classical controllers and the policies that come with the package, from the same starts.

All of them fly every task without a filter and with `rta=default`. Results are written to
`benchmarks/results/controllers.json`, where rows that are not measured again stay, and the tables
of docs/controllers.md are printed:

    python benchmarks/controllers.py [episodes=1000] [tasks=docking3d,rejoin2d] [rta=none]

`report_bounds` in the results are bounds from the starts of the report of the baselines.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from baselines.plan import CERTIFIED_STARTS
from isolated import several, words
from machine import about, with_kept
from tables import controllers, controllers_filtered

import jaxsafe
from jaxsafe.agents import Agent
from jaxsafe.bounds import best_possible
from jaxsafe.config.arguments import Arguments
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.envs import STARTERS, TASKS, find_task
from jaxsafe.evaluate.evaluator import EVALUATION_SEED, Evaluator
from jaxsafe.rollout import reset_batch
from jaxsafe.storage.files import read_json, write_json
from jaxsafe.train.host.options import resolve

OUT = Path(__file__).parent / "results" / "controllers.json"
PPO = "ppo"
"""Name of the policy that comes with the package."""

REPORTED = (100, 1000)
"""Numbers of episodes for each seed in an evaluation of the report."""

METRICS = (
    "success_rate",
    "average_return",
    "episode_length",
    "control_usage",
    "control_usage_l1",
    "safety_violation_rate",
    "episode_safety_violation_rate",
    "episode_violation_severity_mean",
    "episode_violation_severity_max",
    "intervention_rate",
)


def bounds(task: str, episodes: int) -> dict[str, float]:
    """Return bounds that theory gives for every policy, on average over the starts."""
    env = jaxsafe.make(task)
    key_start, _ = jax.random.split(jax.random.key(0))  # the starts of `jaxsafe.evaluate`
    starts, _ = jax.jit(reset_batch, static_argnums=2)(env, key_start, episodes)
    return {name: float(np.mean(values)) for name, values in best_possible(env, starts).items()}


def report_bounds(task: str) -> dict[str, dict[int, dict[str, float]]]:
    """Return such bounds on average over the starts from which the report evaluates policies.

    The keys are the words of the environment, and then the number of episodes for each seed.
    """
    rows = {}
    for options in sorted({(), CERTIFIED_STARTS.get(task, ())}):
        _, env, _ = resolve(Arguments.parse([f"env={task}", *options]).options)
        idle = Evaluator(SeedMapper(1), env, Agent())
        starts = idle.starts(max(REPORTED), EVALUATION_SEED)
        bounds = best_possible(env, starts)
        rows[" ".join([task, *options])] = {
            count: {name: float(np.mean(values[:count])) for name, values in bounds.items()}
            for count in REPORTED
        }
    return rows


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
    options = words(episodes="1000", tasks=",".join(known), rta="none,default")
    episodes = int(options["episodes"])
    tasks = several("tasks", options["tasks"], known)
    filters = several("rta", options["rta"], ["none", "default"])
    results = {
        "command": f"python benchmarks/controllers.py {' '.join(sys.argv[1:])}".strip(),
        "episodes": episodes,
        **about(__file__),
        "rows": [
            measure(task, name, rta, episodes)
            for task in tasks
            for name in (*find_task(task).controllers, *[PPO] * (task in TASKS))
            for rta in filters
        ],
    }
    earlier = read_json(OUT) if OUT.exists() else {}
    of_tasks = {task: bounds(task, episodes) for task in tasks}
    of_report = {}
    for task in tasks:
        of_report |= report_bounds(task) if task in TASKS else {}
    results = {
        **with_kept(OUT, results, same=["task", "policy", "rta"]),
        "bounds": {**earlier.get("bounds", {}), **of_tasks},
        "report_bounds": {**earlier.get("report_bounds", {}), **of_report},
    }
    write_json(OUT, results)
    print(controllers(results), controllers_filtered(results), sep="\n\n")


if __name__ == "__main__":
    main()
