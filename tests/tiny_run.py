"""A training run that takes seconds and still does everything.

A function checks that two such runs are equal.
"""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxsafe.train.host import run_directory
from jaxsafe.train.host.checkpoint import Checkpoints
from jaxsafe.train.host.restore import restore

TINY = [
    "env=docking2d",
    "seeds=3",
    "steps=1280",
    "episodes=6",
    "eval_episodes=4",
    "log_every=4",
    "env.terminal.timeout.limit=40",
    "ppo.num_envs=4",
    "ppo.num_steps=16",
    "ppo.num_epochs=2",
    "agent.actor.hidden=[8]",
    "checkpoint_every=320",
    "eval_every=320",
]
"""Options of the training run."""


def logs(run: Path) -> dict[str, list[dict[str, Any]]]:
    """Return all rows of the logs without the clock."""
    values = {}
    for name in ("progress.jsonl", "eval.jsonl", "episodes.jsonl"):
        values[name] = [json.loads(line) for line in (run / name).read_text().splitlines()]
        for row in values[name]:
            row.pop("wall_s", None)
    return values


def final_state(run: Path) -> Any:
    """Return what the last checkpoint holds."""
    config, env, _ = run_directory.read(run, "run")
    checkpoints = Checkpoints(run)
    content, facts = restore(checkpoints, checkpoints.steps[-1], env, config)
    state = content["state"].replace(key=jax.random.key_data(content["state"].key))
    return {"state": state, "best": content["best"], "updates": facts["updates"]}


def assert_same_end(run: Path, whole: Path) -> None:
    """Check that logs, last checkpoint and policies are equal bit for bit."""
    assert logs(run) == logs(whole)
    jax.tree.map(np.testing.assert_array_equal, final_state(run), final_state(whole))
    for policy in sorted((whole / "policy").iterdir()):
        arrays = np.load(policy)
        other = np.load(run / "policy" / policy.name)
        assert {name: arrays[name].tobytes() for name in arrays.files} == {
            name: other[name].tobytes() for name in other.files
        }
