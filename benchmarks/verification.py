"""Prove policies from a box of starts, and check the certificates.

    python benchmarks/verification.py [published=FILE] [rows=docking2d,docking2d_80] [out=FILE]

`published` is the network of the verification community's docking benchmark, which does not come
with this package. Without it, its rows are left out. One batch of boxes is bounded before the time
is taken, so that compiling the bounds is not counted.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from isolated import several, words
from machine import about

import jaxsafe
from jaxsafe.agents.imported_policy import read_foreign
from jaxsafe.agents.policy_file import find_policy, read_policy
from jaxsafe.envs.docking import DOCKING_RADIUS, DOCKING_SPEED, LIMIT_SLOPE, START_DISTANCES
from jaxsafe.storage.files import read_json, write_json
from jaxsafe.verify import check
from jaxsafe.verify.certificate import save_certificate
from jaxsafe.verify.loop import closed_loop
from jaxsafe.verify.tube import tube
from jaxsafe.verify.verify import Verification, verify

BOX = {"position": [70.0, 106.0], "velocity": [-0.28, 0.28]}
"""The starts of the community's docking benchmark [m, m/s]."""

RAW = {
    "observation": ["position", "velocity"],
    "observation.position.scale": 1.0,
    "observation.velocity.scale": 1.0,
}
"""What the published network sees: position and velocity as they are."""

SPACE = {"position": [88.0, 97.0], "velocity": [-0.05, 0.05]}
"""Starts in space, of which there are six numbers."""

NEAR = {"position": [3.0, 5.5], "velocity": [-0.02, 0.02]}
"""Starts near the chief, almost at rest."""

WINGMAN = {
    "position": [[-1610.0, -1590.0], [140.0, 160.0]],
    "heading": [-0.19, -0.17],
    "speed": [396.0, 400.0],
    "lead.position": [0.0, 0.0],
    "lead.heading": [0.0, 0.0],
    "lead.speed": [300.0, 300.0],
}
"""Starts of a wingman behind the lead, on the way to the rejoin point [ft, rad, ft/s]."""

ORIENTED = {
    "position": [[87.0, 89.0], [69.0, 71.0]],
    "velocity": [[-0.11, -0.09], [-0.09, -0.07]],
    "attitude": [0.48, 0.52],
    "attitude_rate": [-0.002, 0.002],
}
"""Starts of a craft that turns, 112 m from the chief [m, m/s, rad, rad/s]."""

MAX_SECONDS = 240.0
"""How long a search may take."""

CASES: dict[str, dict[str, Any]] = {
    "published": {"policy": "published network"},
    "published_real": {"policy": "published network", "arithmetic": "real"},
    "published_80": {"policy": "published network", "steps": 80},
    "docking2d": {"policy": "pretrained/docking2d"},
    "docking2d_heavy": {"policy": "pretrained/docking2d", "mass": 300.0},
    "docking2d_80": {"policy": "pretrained/docking2d", "steps": 80},
    "docking2d_docks": {
        "policy": "pretrained/docking2d",
        "property": "docks",
        "steps": 60,
        "box": NEAR,
    },
    "docking3d": {"policy": "pretrained/docking3d", "steps": 20, "box": SPACE},
    "rejoin2d": {"policy": "pretrained/rejoin2d", "mass": None, "steps": 10, "box": WINGMAN},
    "oriented": {"policy": "pretrained/docking2d_oriented", "steps": 12, "box": ORIENTED},
}
"""What is proved, by row: the policy, the mass [kg] of a spacecraft, and options of the proof."""

TUBES: dict[str, dict[str, Any]] = {
    "far": {"centre": [100.0, 20.0, -0.1, 0.05], "widths": [[9.0, 0.05]], "steps": 120},
    "near": {
        "centre": [9.0, 7.0, -0.12, -0.09],
        "widths": [[1.0, 0.02], [0.25, 0.005], [0.0625, 0.00125]],
        "steps": 90,
    },
}
"""Boxes of starts of `pretrained/docking2d` that are bounded in one piece over many steps.

They have a centre (x, y, ẋ, ẏ) and widths of the position [m] and of the velocity [m/s].
"""


STARTS: dict[str, dict[str, Any]] = {
    "starts2d": {"policy": "pretrained/docking2d", "widths": [4.5, 0.025], "steps": 320},
    "starts3d": {"policy": "pretrained/docking3d", "widths": [4.5, 0.025], "steps": 160},
    "starts3d_wide": {"policy": "pretrained/docking3d", "widths": [9.0, 0.05], "steps": 80},
}
"""Boxes around random starts of a task that are bounded in one piece over many steps."""

NUM_STARTS = 64
"""Number of random starts."""

HORIZONS = (40, 80, 160, 240, 320)
"""Numbers of steps for which the share of the boxes that keep the limit is told."""


def spread(case: Mapping[str, Any]) -> dict[str, Any]:
    """Return for how many boxes around random starts a tube proves the limit, by horizon."""
    env, policy = controller(case["policy"], 12.0, "")
    states, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), NUM_STARTS))
    own = states.sim.platforms[env.agent]
    centre = np.concatenate([own.position, own.velocity], axis=1).astype(np.float64)
    dimension = env.agent_platform.dimension
    widths = np.repeat(case["widths"], dimension)
    began = time.monotonic()
    with jax.enable_x64(True):
        loop = closed_loop(env, policy)
        ends = (jnp.asarray(centre - 0.5 * widths), jnp.asarray(centre + 0.5 * widths))
        margin = np.asarray(tube(loop, case["steps"], *ends).margin)
    holds = np.logical_and.accumulate(margin >= 0.0, axis=1)
    within = int(holds[:, 0].sum())
    return {
        **case,
        "boxes": within,
        "safe": {
            str(horizon): float(holds[:, horizon].sum() / within)
            for horizon in HORIZONS
            if horizon <= case["steps"]
        },
        "boxes_to_fill": start_volume(dimension) / float(np.prod(widths)),
        "seconds": time.monotonic() - began,
        **about(__file__),
    }


def start_volume(dimension: int) -> float:
    """Return the volume of all starts of docking: a shell of positions, a ball of velocities."""
    distance = np.linspace(*START_DISTANCES, 5001)
    limit = DOCKING_SPEED + LIMIT_SLOPE * distance
    shell = 2.0 * np.pi * distance if dimension == 2 else 4.0 * np.pi * distance**2
    ball = np.pi * limit**2 if dimension == 2 else 4.0 / 3.0 * np.pi * limit**3
    return float(np.trapezoid(shell * ball, distance))


def follow(case: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return for each width how long a tube proves the limit, and when all states have docked."""
    env, policy = controller("pretrained/docking2d", 12.0, "")
    centre = np.array(case["centre"])
    half = 0.5 * np.repeat(np.array(case["widths"]), 2, axis=1)
    with jax.enable_x64(True):
        loop = closed_loop(env, policy)
        ends = (jnp.asarray(centre - half), jnp.asarray(centre + half))
        tubes = jax.device_get(tube(loop, case["steps"], *ends))
    rows = []
    for widths, margin, low, high in zip(
        case["widths"], tubes.margin, tubes.low, tubes.high, strict=True
    ):
        farthest = np.linalg.norm(np.maximum(np.abs(low), np.abs(high))[:, :2], axis=1)
        safe = int(np.argmax(np.append(~(margin >= 0.0), True))) - 1
        docked = np.flatnonzero(farthest[: safe + 1] <= DOCKING_RADIUS)
        rows.append(
            {
                "centre": case["centre"],
                "widths": widths,
                "steps": case["steps"],
                "safe_steps": safe,
                "docked_after": int(docked[0]) if len(docked) else None,
            }
        )
    return rows


def controller(policy: str, mass: float | None, published: str) -> tuple[Any, Any]:
    """Return the environment and the policy of a row."""
    if policy == "published network":
        env = jaxsafe.make("docking2d", overrides=RAW)
        foreign = read_foreign(Path(published), env)
        return env, foreign.agent.policy(env, foreign.params, True)
    saved = read_policy(find_policy(policy))
    env = saved.env if mass is None else jaxsafe.override(saved.env, {"deputy.mass": mass})
    return env, saved.agent.policy(env, saved.params, True)


def measure(case: Mapping[str, Any], published: str) -> dict[str, Any]:
    """Return what a row tells."""
    given = {
        "mass": 12.0,
        "property": "safe",
        "steps": 40,
        "arithmetic": "float32",
        "box": BOX,
        **case,
    }
    env, policy = controller(given["policy"], given["mass"], published)

    def prove(**limits: Any) -> Verification:
        options = {name: given[name] for name in ("property", "steps", "arithmetic")}
        return verify(env, policy, given["box"], **options, **limits)

    prove(max_boxes=1)
    proof = prove(seconds=MAX_SECONDS)
    return {
        **given,
        "result": proof.result,
        "proved": proof.shares()["proved"],
        "seconds": proof.seconds,
        "bounded": proof.bounded,
        "boxes": len(proof.proved.low),
        "last": int(proof.last.max(initial=0)),
        "margin": proof.margin if len(proof.proved.low) else None,
        "violation": proof.counterexample and proof.counterexample._asdict(),
        "check_seconds": _checked(proof) if proof.result == "proved" else None,
        **about(__file__),
    }


def main() -> None:
    """Prove, check and write. Rows that are not asked for stay as they are in the file."""
    options = words(published="", rows="", out="benchmarks/results/verification.json")
    names = several("rows", options["rows"], [*CASES, *TUBES, *STARTS]) or [
        name
        for name in (*CASES, *TUBES, *STARTS)
        if options["published"] or not name.startswith("published")
    ]
    out = Path(options["out"])
    content = read_json(out) if out.exists() else {}
    rows, tubes, starts = (content.get(name, {}) for name in ("rows", "tubes", "starts"))
    for name in names:
        if name in TUBES:
            tubes[name] = follow(TUBES[name])
        elif name in STARTS:
            starts[name] = spread(STARTS[name])
        else:
            rows[name] = measure(CASES[name], options["published"])
        print(json.dumps({**rows, **tubes, **starts}[name]), flush=True)
        content = {
            **about(__file__),
            "rows": {name: rows[name] for name in CASES if name in rows},
            "tubes": {name: tubes[name] for name in TUBES if name in tubes},
            "starts": {name: starts[name] for name in STARTS if name in starts},
        }
        write_json(out, content)


def _checked(proof: Any) -> float:
    """Return how many seconds the check of a proof's certificate takes.

    Raises:
        CalledProcessError: the certificate is refused.
    """
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "proof.npz"
        save_certificate(path, proof, {})
        began = time.monotonic()
        subprocess.run([sys.executable, check.__file__, path], check=True, stdout=sys.stderr)
        return time.monotonic() - began


if __name__ == "__main__":
    main()
