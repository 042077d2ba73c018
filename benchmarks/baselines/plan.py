"""What the report trains and evaluates: each item is a command line that anyone can repeat."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxsafe.envs import TASKS
from jaxsafe.schema.errors import ConfigError, nearest


class Kind(NamedTuple):
    """A way to train each task."""

    options: tuple[str, ...]  # of `jaxsafe.train`
    about: str  # on the page


KINDS: Mapping[str, Kind] = {
    "features": Kind(
        (),
        "the recipe of the task: continuous actions, features computed from the observation by the agent; in rejoin the"
        " critic also sees the totals of the reward terms so far, and training episodes end after 300 steps",
    ),
    "plain": Kind(
        ("preset=plain",),
        (
            "the paper's observation straight into the networks; in rejoin3d training episodes end"
            " after 300 steps"
        ),
    ),
    "lanes": Kind(
        ("preset=lanes",),
        "4,096 environments side by side, for accelerators; all begin together, so in oriented docking those that have not"
        " docked all time out at 12.3 million steps, a dip in the curves of every seed",
    ),
    "quick": Kind(
        ("preset=quick",),
        "fewer epochs and steps, for a result soon; evaluated in 100 episodes a seed",
    ),
    "discrete": Kind(
        ("actions=discrete",), "the recipe of `features` with the paper's discrete actions"
    ),
    "plain_discrete": Kind(("preset=plain", "actions=discrete"), "the recipe of `plain` with them"),
    "rta": Kind(
        ("rta=default",),
        "the recipe with run time assurance during training, where each intervention costs a little; oriented docking"
        " starts at up to 99 % of the speed limit, since some faster starts nothing can keep safe",
    ),
    "unpunished": Kind(
        ("rta=default", "rta_training=unpunished"),
        "the same, and interventions cost nothing (`rta_training=unpunished`)",
    ),
}
"""By the name that the page uses."""

CERTIFIED_STARTS = {"docking2d_oriented": ("env.deputy.start.velocity.share=[0,0.99]",)}
"""What leaves out the starts of a task from which no filter can promise safety."""

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
"""In a run of the `features` kind: its best policy, see `best_seed`."""

SHIPPED = "shipped"
"""The evaluation of the best policy alone, from other starts than those that it was chosen by."""


FILM = ("episodes=10", "deterministic=true", "render=gif")
"""What follows `python -m jaxsafe.evaluate run=…` for the film of the best policy."""


class Item(NamedTuple):
    """One training of all seeds, and the evaluations of its policies beyond the run's own."""

    task: str
    kind: str
    words: tuple[str, ...]  # what follows `python -m jaxsafe.train`

    @property
    def name(self) -> str:
        """Of its directory and its files."""
        return f"{self.task}-{self.kind}"

    @property
    def evaluations(self) -> dict[str, list[str]]:
        """By name, what follows `python -m jaxsafe.evaluate run=…`."""
        if self.kind == "features":
            return {**STARTS[self.task], WITH_RTA: ["rta=default"], SHIPPED: ["seed=1"]}
        return {WITHOUT_RTA: ["rta=none"]} if self.kind in ("rta", "unpunished") else {}

    def subject(self, run: Path, name: str) -> Path:
        """What an evaluation is of: every policy of a run, or the best one."""
        return run / BEST if name == SHIPPED else run

    def evaluation_directory(self, run: Path, name: str) -> Path:
        """Where an evaluation of a run is written."""
        return run / "evaluations" / name.replace(" ", "_").replace(",", "")


def best_seed(results: Mapping[str, Any]) -> int:
    """The seed whose deterministic episodes succeeded most often, then violated least, then had the highest return.

    Args:
        results: of a run, with its own evaluation after training.
    """
    found = results["evaluation"]["deterministic"]
    columns = [
        found[name]["per_seed"]
        for name in ("success_rate", "episode_safety_violation_rate", "average_return")
    ]
    rank = [  # what is not known is null
        (
            -1.0 if success is None else success,
            -(violating or 0.0),
            -math.inf if value is None else value,
        )
        for success, violating, value in zip(*columns, strict=True)
    ]
    return results["seed"] + rank.index(max(rank))


def _options(task: str, kind: str) -> tuple[str, ...]:
    """What makes a training one of its kind."""
    own = KINDS[kind].options
    return (*own, *CERTIFIED_STARTS.get(task, ())) if "rta=default" in own else own


def plan(tasks: Sequence[str], kinds: Sequence[str], words: Sequence[str]) -> list[Item]:
    """Every kind of training of every task, the same further options for all.

    Raises:
        ConfigError: there is no such task or kind.
    """
    for name, chosen, known in (("tasks", tasks, TASKS), ("kinds", kinds, KINDS)):
        for one in chosen:
            if one not in known:
                raise ConfigError(f"{name}: found {one!r}; choose from {nearest(str(one), known)}")
    return [
        Item(task, kind, (f"env={task}", *_options(task, kind), *words))
        for kind in kinds
        for task in tasks
    ]
