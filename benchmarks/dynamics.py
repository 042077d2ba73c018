"""Measure how many steps a second a task takes with each dynamics model, on one core.

Each model flies in the task of its domain and dimension, with random actions and automatic reset,
as in `environments.py`. The first model of a task is the task's own. Each row is a process of its
own, pinned to one core.

Results are written to `benchmarks/results/dynamics.json`, and the table of docs/dynamics.md is
printed:

    python benchmarks/dynamics.py [envs=4096] [names="two_body 3D",…] [repeats=5] [steps=1000]
"""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from environments import NUM_STEPS, compiled, episode_steps
from isolated import probe, several, words

import jaxsafe

OUT = Path(__file__).parent / "results" / "dynamics.json"


def _actuator(name: str, low: float, high: float) -> dict[str, Any]:
    return {"name": name, "low": low, "high": high}


WHEEL = {
    "deputy.type": "reaction_wheel_spacecraft",
    "deputy.controller.actuators": [
        _actuator("thrust", -1.0, 2.0),
        _actuator("wheel_acceleration", -24.4, 24.4),
    ],
}
POINT_MASS = {
    "wingman.type": "point_mass_aircraft",
    "wingman.controller.actuators": [
        _actuator("thrust", 0.0, 2050.0),
        _actuator("load_factor", -1.0, 3.0),
        _actuator("roll_rate", -0.17, 0.17),
    ],
}
ACTUATORS = {
    f"deputy.controller.actuators.thrust_{axis}.{field}": value
    for axis in "xyz"
    for field, value in (("time_constant", 2.0), ("rate_limit", 0.5))
}

MODELS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "double_integrator 1D": ("docking1d", {}),
    "spacecraft 2D": ("docking2d", {}),
    "double_integrator 2D": ("docking2d", {"deputy.type": "double_integrator"}),
    "two_body 2D": ("docking2d", {"deputy.type": "two_body"}),
    "spacecraft 3D": ("docking3d", {}),
    "double_integrator 3D": ("docking3d", {"deputy.type": "double_integrator"}),
    "two_body 3D": ("docking3d", {"deputy.type": "two_body"}),
    "two_body_j2": ("docking3d", {"deputy.type": "two_body_j2"}),
    "spacecraft 3D with lag and rate limit": ("docking3d", ACTUATORS),
    "oriented_spacecraft": ("docking2d_oriented", {}),
    "reaction_wheel_spacecraft": ("docking2d_oriented", WHEEL),
    "dubins2d": ("rejoin2d", {}),
    "dubins2d_lag": ("rejoin2d", {"wingman.type": "dubins2d_lag"}),
    "dubins3d": ("rejoin3d", {}),
    "dubins3d_lag": ("rejoin3d", {"wingman.type": "dubins3d_lag"}),
    "point_mass_aircraft": ("rejoin3d", POINT_MASS),
}
"""The task of each model, and what makes it fly there."""


def main() -> None:
    """Measure, write the results and print the table."""
    options = words(envs="4096", names=",".join(MODELS), repeats="5", steps=str(NUM_STEPS))
    names = several("names", options["names"], MODELS)
    sizes = {name: int(options[name]) for name in ("envs", "repeats", "steps")}
    if "probe" in options:
        print(json.dumps(measure(options["probe"], **sizes)))
        return
    import tables
    from machine import about

    here = about(__file__)
    request = [f"{name}={size}" for name, size in sizes.items()]
    runs = []
    for name in names:
        rate = probe(__file__, [f"probe={name}", *request], 1)
        runs.append({"model": name, "task": MODELS[name][0], **rate})
        print(f"{name}: {rate['steps_per_s']:,.0f}", file=sys.stderr)
    content = {**here, "pinned_to": 1, "num_envs": sizes["envs"], "runs": runs}
    OUT.write_text(json.dumps(content, indent=1) + "\n")
    print(tables.dynamics(content))


def measure(name: str, envs: int, repeats: int, steps: int) -> dict[str, Any]:
    """Measure one model with some environments, in repeats of some steps."""
    task, changes = MODELS[name]
    run = functools.partial(episode_steps, jaxsafe.make(task, changes))
    return compiled(run, envs, repeats, steps)


if __name__ == "__main__":
    main()
