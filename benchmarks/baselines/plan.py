"""What the report trains and evaluates. Each item is a command line that anyone can repeat."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxsafe.envs import TASKS


class Kind(NamedTuple):
    """A recipe to train each task by."""

    options: tuple[str, ...]  # options of `jaxsafe.train`
    about: str  # what the page says about it


KINDS: Mapping[str, Kind] = {
    "engineered_features": Kind(
        (),
        (
            "the recipe of the task, with continuous actions. The agent computes features from the"
            " observation. In rejoin the critic also sees the totals of the reward terms so far,"
            " and training episodes end after 300 steps."
        ),
    ),
    "observation_only": Kind(
        ("preset=observation_only",),
        (
            "the paper's observation straight into the networks. In rejoin3d training episodes end"
            " after 300 steps."
        ),
    ),
    "many_envs": Kind(
        ("preset=many_envs",),
        (
            "4,096 environments side by side, for accelerators. All begin together. So in oriented"
            " docking those that have not docked all time out at 12.3 million steps, which is a dip"
            " in the curves of every seed."
        ),
    ),
    "shortest_time": Kind(
        ("preset=shortest_time",),
        "fewer epochs and steps, for a result soon. An evaluation has 100 episodes per seed.",
    ),
    "discrete": Kind(
        ("actions=discrete",),
        "the recipe of `engineered_features` with the paper's discrete actions.",
    ),
    "observation_only_discrete": Kind(
        ("preset=observation_only", "actions=discrete"),
        "the recipe of `observation_only` with discrete actions.",
    ),
    "rta": Kind(
        ("rta=default",),
        (
            "the recipe of `engineered_features` with run time assurance during training. Each"
            " intervention costs a little. Oriented docking starts at up to 99 % of the speed"
            " limit, because nothing can keep some faster starts safe."
        ),
    ),
    "rta_no_punishment": Kind(
        ("rta=default", "rta_training=no_punishment"),
        "the recipe of `rta`, but interventions cost nothing (`rta_training=no_punishment`).",
    ),
}
"""The recipes, by the name that the page uses."""

CERTIFIED_STARTS = {"docking2d_oriented": ("env.deputy.start.velocity.share=[0,0.99]",)}
"""Options that leave out the starts of a task from which no filter can promise safety."""

_DOCKING_STARTS = {
    "from 1 km": ["env.deputy.start.position.distance=[1000,1000]"],
    "from 10 km": [
        "env.deputy.start.position.distance=[10000,10000]",
        "env.terminal.timeout.limit=6000",
        "env.reward.success.time_scale=6000",
    ],
}
_REJOIN_STARTS = {
    "from 15,000 ft": ["env.wingman.start.position.distance=[15000,15000]"],
    "from 30,000 ft": ["env.wingman.start.position.distance=[30000,30000]"],
}
STARTS = {task: _REJOIN_STARTS if task.startswith("rejoin") else _DOCKING_STARTS for task in TASKS}
"""Starts outside those of training, by task and name."""

WITH_RTA = "filtered"
WITHOUT_RTA = "unfiltered"

BEST = "best.npz"
"""The best policy of a run of the `engineered_features` kind, see `best_seed`."""

SHIPPED = "shipped"
"""The evaluation of the best policy alone.

Its starts differ from those by which the policy was chosen.
"""

FILM = ("episodes=10", "deterministic=true", "render=gif")
"""The words after `jaxsafe evaluate run=…` for the film of the best policy."""


class Item(NamedTuple):
    """One training of all seeds, and further evaluations of its policies."""

    task: str
    kind: str
    words: tuple[str, ...]  # the words after `jaxsafe train`

    @property
    def name(self) -> str:
        """The name of the item's directory and files."""
        return f"{self.task}-{self.kind}"

    @property
    def evaluations(self) -> dict[str, list[str]]:
        """The words after `jaxsafe evaluate run=…`, by the name of the evaluation."""
        if self.kind == "engineered_features":
            return {**STARTS[self.task], WITH_RTA: ["rta=default"], SHIPPED: ["seed=1"]}
        return {WITHOUT_RTA: ["rta=none"]} if self.kind in ("rta", "rta_no_punishment") else {}

    def subject(self, run: Path, name: str) -> Path:
        """Return what an evaluation evaluates: every policy of a run, or the best one."""
        return run / BEST if name == SHIPPED else run

    def evaluation_directory(self, run: Path, name: str) -> Path:
        """Return where an evaluation of a run is written."""
        return run / "evaluations" / name.replace(" ", "_").replace(",", "")


def best_seed(results: Mapping[str, Any]) -> int:
    """Return the seed of the best policy.

    Its deterministic episodes succeeded most often, then violated least, then had the highest
    return.

    Args:
        results: results of a run, with its own evaluation after training.
    """
    metrics = results["evaluation"]["deterministic"]
    columns = [
        metrics[name]["per_seed"]
        for name in ("success_rate", "episode_safety_violation_rate", "average_return")
    ]
    rank = [  # unknown numbers are null in the results
        (
            -1.0 if success is None else success,
            -(violating or 0.0),
            -math.inf if value is None else value,
        )
        for success, violating, value in zip(*columns, strict=True)
    ]
    return results["seed"] + rank.index(max(rank))


def _options(task: str, kind: str) -> tuple[str, ...]:
    """Return the options that make a training one of its kind."""
    own = KINDS[kind].options
    return (*own, *CERTIFIED_STARTS.get(task, ())) if "rta=default" in own else own


def plan(tasks: Sequence[str], kinds: Sequence[str], words: Sequence[str]) -> list[Item]:
    """Return an item for every kind of training of every task. All get the same further words."""
    return [
        Item(task, kind, (f"env={task}", *_options(task, kind), *words))
        for kind in kinds
        for task in tasks
    ]
