"""Measure what a bound on the uncertainty costs, and what the world does to a filter without one.

The filter `robust` has the bound of the task in `BOUNDS`. A world at some level has uncertainty of
that level times the bound (`jaxsafe.evaluate.bounded_worlds.world_at`). The policies that come with
the package fly in these worlds, and so does an adversary of `ADVERSARIES`. They fly without a
filter, with the `default` filter, which has no bound, and with `robust`.

Results are written to `benchmarks/results/robustness.json`, the figure to
`docs/figures_robust.png`, and the table of docs/safety/attacks.md is printed:

    python benchmarks/robustness.py [episodes=200] [levels=0,0.5,1] [tasks=docking3d,rejoin2d]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from isolated import several, words
from machine import about, with_kept
from matplotlib.figure import Figure
from tables import robustness

import jaxsafe
from jaxsafe.config import override
from jaxsafe.environment import Environment
from jaxsafe.evaluate.bounded_worlds import world_at
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.plot.style import BLUE, GREEN, GREY, ORANGE, save, styled
from jaxsafe.storage.files import read_json, write_json
from jaxsafe.transition import bounds

OUT = Path(__file__).parent / "results" / "robustness.json"
FIGURE = Path(__file__).parent.parent / "docs" / "figures_robust.png"
FILTERS = ("none", "default", "robust")
LOOKS: dict[str, dict[str, Any]] = {
    "none": {"color": ORANGE, "linewidth": 3.0, "alpha": 0.6},
    "default": {"color": BLUE},
    "robust": {"color": GREEN, "linestyle": "--"},
}
"""Look of the line of each filter. Lines on top of each other stay visible."""

_DOCKING = {"process": 0.01, "mass": 0.05, "misalignment": 0.05, "position": 1.0, "velocity": 0.01}
BOUNDS: dict[str, dict[str, float]] = {
    "docking2d": _DOCKING,
    "docking3d": _DOCKING,
    "docking2d_oriented": {"process": 1e-4},
    "rejoin2d": {"process": 1.0, "position": 5.0},
    "rejoin3d": {"process": 0.3},
}
"""The bound of each task.

In docking it allows for a push of 1 cm/s a step, 5 % of the mass, 3° of the thrust, and errors of
1 m and 1 cm/s. In oriented docking it allows for a push of 0.1 mm/s a step. In rejoin it allows for
pushes of 1 or 0.3 ft/s², and in the plane for errors of 5 ft.
"""

ADVERSARIES = {
    "docking2d": "inward",
    "docking3d": "inward",
    "docking2d_oriented": "greedy",
    "rejoin2d": "intercept",
    "rejoin3d": "intercept",
}
"""The adversary of each task.

It flies towards the chief, or to where it can meet the lead. In oriented docking it lowers h.
"""

ATTACK_STEPS = 400
"""Number of steps of the adversary in each episode."""

CHATTER_STEPS = 300
"""Number of steps in which the changes of controls are measured."""


def world(task: str, rta: str, level: float) -> Environment:
    """Return the world of a task at a level, with a filter or none.

    Args:
        task: the task.
        rta: the filter, one of `FILTERS`.
        level: the uncertainty, as a multiple of the bound in `BOUNDS`.
    """
    robust = world_at(jaxsafe.make(task, {"rta.bound": BOUNDS[task]}, rta="robust"), level)
    if rta == "robust":
        return robust
    if rta == "none":
        return override(robust, {"rta": None})
    numbers = {} if robust.rta is None else robust.rta.model
    model = {f"rta.model.{path}": value for path, value in numbers.items()}
    nominal = jaxsafe.make(task, rta=rta)
    return override(robust, {"rta": nominal.rta, **model})


_rollout = jax.jit(jaxsafe.rollout, static_argnums=(1, 3, 4))


def chatter(env: Environment, policy: Any, episodes: int) -> dict[str, float]:
    """Return how much the controls, and the filter, change from step to step.

    Returns:
        The mean change of a control as a share of its range, and the share of the steps at which
        the filter begins or ceases to intervene.
    """
    low, high = bounds(env)
    steps = _rollout(env, policy, jax.random.key(1), CHATTER_STEPS, episodes)
    info = steps.info
    change = jnp.abs(info.control_actual[1:] - info.control_actual[:-1]) / (high - low)
    switched = info.intervening[1:] != info.intervening[:-1]
    within = ~steps.done[:-1]  # both steps belong to one episode
    return {
        "chatter": float(jnp.mean(jnp.mean(change, axis=-1), where=within)),
        "switches": float(jnp.mean(switched, where=within)),
    }


def measure(task: str, policy: Any, rta: str, level: float, episodes: int) -> dict[str, Any]:
    """Fly whole episodes, and under attack. Return the row of the results."""
    env = world(task, rta, level)
    metrics = jaxsafe.evaluate(env, policy, jax.random.key(0), episodes)
    names = (
        "success_rate",
        "control_usage",
        "control_effort",
        "episode_length",
        "safety_violation_rate",
        "episode_safety_violation_rate",
        "episode_violation_severity_max",
        "intervention_rate",
    )
    row = {"task": task, "rta": rta, "level": level, "episodes": episodes}
    row |= {name: metrics[name] for name in names} | chatter(env, policy, episodes)
    pushed = attack(env, ADVERSARIES[task], ATTACK_STEPS, episodes, jax.random.key(2))
    row["adversary"] = pushed["policy"]
    row["attacked"] = pushed["violating_steps"] / pushed["steps"]
    row["attacked_certified"] = pushed["violating_certified_steps"] / pushed["steps"]
    row["attacked_worst_margin"] = pushed["worst_margin_inside"]
    print(json.dumps(row), flush=True)
    return row


@styled
def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw violations, success and control effort against the level, in a row per task."""
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    figure = Figure(figsize=(9.6, 2.9 * len(tasks)), layout="constrained")
    panels = np.atleast_2d(figure.subplots(len(tasks), 3))
    quantities = {
        "attacked": ("violating steps under attack [%]", 100.0),
        "success_rate": ("success rate [%]", 100.0),
        "control_effort": ("share of full control [%]", 100.0),
    }
    for task, line in zip(tasks, panels, strict=True):
        for (name, (label, unit)), panel in zip(quantities.items(), line, strict=True):
            for rta in FILTERS:
                of_filter = [row for row in rows if (row["task"], row["rta"]) == (task, rta)]
                levels = [row["level"] for row in of_filter]
                values = [unit * row[name] for row in of_filter]
                panel.plot(levels, values, marker="o", markersize=3, label=rta, **LOOKS[rta])
            if name == "success_rate":
                panel.set_ylim(-5.0, 105.0)
            if name == "control_effort":
                panel.set_ylim(0.0, 1.05 * panel.get_ylim()[1])
            panel.axvline(1.0, color=GREY, linewidth=0.8, linestyle=":")
            panel.set_xlabel("uncertainty, as a multiple of the bound")
            panel.set_ylabel(label)
            panel.set_title(task)
    panels[0][0].legend(title="filter")
    save(figure, path)


def main() -> None:
    """Run the command."""
    options = words(episodes="200", levels="0,0.5,1,1.5,2", tasks=",".join(BOUNDS))
    episodes = int(options["episodes"])
    levels = [float(level) for level in options["levels"].split(",")]
    rows = []
    for task in several("tasks", options["tasks"], BOUNDS):
        policy = jaxsafe.load_policy(task)  # once, because programs are compiled for each policy
        rows += [measure(task, policy, rta, level, episodes) for rta in FILTERS for level in levels]
        jax.clear_caches()  # a process may have only so many programs
    results = {
        "command": f"python benchmarks/robustness.py {' '.join(sys.argv[1:])}".strip(),
        "bounds": BOUNDS,
        **about(__file__),
        "rows": rows,
    }
    kept = with_kept(OUT, results, same=["task", "rta", "level"])
    write_json(OUT, kept | {"bounds": BOUNDS})
    results = read_json(OUT)
    draw(results["rows"], FIGURE)
    print(robustness(results))


if __name__ == "__main__":
    main()
