"""A training run that takes seconds and still does everything, and what two such runs must have in common."""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxsafe.train.host import run_directory
from jaxsafe.train.host.checkpoint import Checkpoints
from jaxsafe.train.host.restore import restore

TINY = [
    "env=docking2d", "seeds=3", "steps=1280", "episodes=6", "eval_episodes=4", "log_every=4",
    "env.terminal.timeout.limit=40",
    "ppo.num_envs=4", "ppo.num_steps=16", "ppo.num_epochs=2", "agent.hidden=[8]", "checkpoint_every=320", "eval_every=320",
]  # fmt: skip
"""Options of the run."""


def logs(run: Path) -> dict[str, list[dict[str, Any]]]:
    """All rows of the logs but for the clock."""
    found = {}
    for name in ("progress.jsonl", "eval.jsonl", "episodes.jsonl"):
        found[name] = [json.loads(line) for line in (run / name).read_text().splitlines()]
        for row in found[name]:
            row.pop("wall_s", None)
    return found


def final_state(run: Path) -> Any:
    """What the last checkpoint holds."""
    config, env, _ = run_directory.read(run, "run")
    checkpoints = Checkpoints(run)
    content, facts = restore(checkpoints, checkpoints.steps[-1], env, config)
    state = content["state"].replace(key=jax.random.key_data(content["state"].key))
    return {"state": state, "best": content["best"], "updates": facts["updates"]}


def assert_same_end(run: Path, whole: Path) -> None:
    """Logs, last checkpoint and policies are equal bit for bit."""
    assert logs(run) == logs(whole)
    jax.tree.map(np.testing.assert_array_equal, final_state(run), final_state(whole))
    for policy in sorted((whole / "policy").iterdir()):
        one, other = np.load(policy), np.load(run / "policy" / policy.name)
        assert {name: one[name].tobytes() for name in one.files} == {
            name: other[name].tobytes() for name in other.files
        }
