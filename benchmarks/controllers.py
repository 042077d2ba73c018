"""Measure classical controllers and the policies that come with the package, from the same starts.

All of them fly every task without a filter and with `rta=default`. Results are written to
`benchmarks/results/controllers.json`, and the tables of docs/controllers.md are printed:

    python benchmarks/controllers.py [episodes=1000] [tasks=docking3d,rejoin2d]
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from isolated import several, words
from tables import controllers, controllers_filtered

import jaxsafe
from jaxsafe.control.docking import speed_limit
from jaxsafe.envs import STARTERS, TASKS, find_task
from jaxsafe.envs.rejoin import HOLD
from jaxsafe.processors.reward import DistanceChange, Success
from jaxsafe.rollout import reset_batch
from jaxsafe.simulation.dubins import SPEED_LIMITS
from jaxsafe.storage import provenance
from jaxsafe.storage.files import write_json
from jaxsafe.types import State, TimeStep

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


def docking_bounds(env: jaxsafe.Environment, first: TimeStep) -> dict[str, jax.Array]:
    """Return the least length [s] and the largest return of an episode from each start.

    −dr/dt is at most the speed. So the way at the speed limit ν₀ + ν₁r takes
    log((ν₀ + ν₁r)/(ν₀ + ν₁ · radius))/ν₁, and no policy that keeps the limit is faster. At best a
    return holds the whole potential of the distance, no Δv, and a success after that time. A step
    above the limit costs 0.01 or more. It saves less than that, namely 1/(0.2 · 2000) per m/s.
    """
    limit = speed_limit(env)
    last = limit.floor + limit.slope * env.regions[0].radius  # type: ignore[attr-defined]
    length = jnp.log(first.info.status["velocity_limit"] / last) / limit.slope
    gain = next(term for term in env.reward if isinstance(term, DistanceChange))
    success = next(term for term in env.reward if isinstance(term, Success))
    share = 0.5 ** (first.info.status[gain.distance] / gain.half_distance)
    best = gain.scale * (1.0 - share) + success.value - length / success.time_scale
    return {"length": length, "return": best}


def rejoin_bounds(state: State) -> dict[str, jax.Array]:
    """Return the least length [s] of an episode from each start.

    The rejoin region moves at the lead's constant velocity w, and is within a ball of radius R. Let
    d be the vector from the aircraft to the centre of the ball at the start. An aircraft that turns
    at once and flies at 400 ft/s reaches the ball when ‖d + w t‖ = 400 t + R. Then it stays for
    20 s.
    """
    sim = state.sim
    own = sim.platforms["wingman"]
    lead = sim.platforms["lead"]
    way = sim.regions["rejoin_region"].position - own.position
    radius = 150.0 if way.shape[-1] == 2 else math.hypot(100.0, 150.0)
    fastest = SPEED_LIMITS[1]
    a = fastest**2 - jnp.sum(lead.velocity**2, axis=-1)
    b = fastest * radius - jnp.sum(way * lead.velocity, axis=-1)
    c = jnp.sum(way**2, axis=-1) - radius**2
    return {"length": (jnp.sqrt(b**2 + a * c) - b) / a + HOLD}


def bounds(task: str, episodes: int) -> dict[str, float]:
    """Return bounds that theory gives for every policy, on average over the starts."""
    env = jaxsafe.make(task)
    key_start, _ = jax.random.split(jax.random.key(0))  # the starts of `jaxsafe.evaluate`
    state, first = jax.jit(reset_batch, static_argnums=2)(env, key_start, episodes)
    each = rejoin_bounds(state) if "lead" in state.sim.platforms else docking_bounds(env, first)
    return {name: float(jnp.mean(values)) for name, values in each.items()}


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
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "bounds": {task: bounds(task, episodes) for task in tasks},
        "rows": rows,
    }
    write_json(OUT, results)
    print(controllers(results), controllers_filtered(results), sep="\n\n")


if __name__ == "__main__":
    main()
