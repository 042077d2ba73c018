"""Let adversaries try to break a filter of run time assurance, and count what happens.

Every adversary acts on whole episodes from the task's own starts. The last one searches for
sequences of controls that defeat the filter. Violations are counted at the samples and inside the
steps, see `jaxsafe.evaluate.run_adversaries.attack`. The exit code is 1 if there was a violation.

A filter with a bound on the uncertainty is attacked in worlds that are as bad as the bound, or
worse: `levels=0.5,1,2` are multiples of it. Violations beyond level 1 break no promise.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

from jaxsafe.commands import cli
from jaxsafe.commands.environment_options import TaskOptions
from jaxsafe.commands.options import Count, File, Option, Seed
from jaxsafe.config.arguments import MAX_COUNT
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.evaluate.adversaries import ADVERSARIES
from jaxsafe.evaluate.bounded_worlds import world_at
from jaxsafe.evaluate.edge_starts import STARTS
from jaxsafe.evaluate.run_adversaries import SEARCH, attack, longest_episode
from jaxsafe.schema.component import Range
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage import provenance
from jaxsafe.storage.files import write_text

MOST_STEPS = 1_000_000
"""Largest number of steps of each adversary if `steps` is not given.

Episodes that would need more steps are cut.
"""

POLICIES = (*ADVERSARIES, SEARCH)
"""Names of all adversaries."""


class Options(TaskOptions):
    """The options of `jaxsafe falsify`."""

    groups: ClassVar = {
        "The filter and its environment.": ("env", "env.PATH", "actions", "variant", "rta"),
        "The attack.": ("policies", "starts", "levels", "num_envs", "steps", "seed", "out"),
    }

    env: Annotated[str, Option(first=True, examples=("env=docking3d",))]
    """The task to attack, or the file of an environment."""
    rta: str | None = None
    """The filter to attack. With none the environment is attacked without a filter.

    By default it is the recommended filter of the task, or the one that the file has.
    """
    num_envs: Annotated[int, Range(1, largest=MAX_COUNT), Option(alias="lanes")] = 64
    """Number of episodes that run side by side."""
    steps: Count | None = None
    """Number of steps of each adversary in all episodes together.

    By default the episodes are whole, up to a million steps.
    """
    policies: Annotated[tuple[str, ...], Option(kind="policy", names=POLICIES)] | None = None
    """The adversaries, with commas between them. By default all of them act in turn."""
    starts: Annotated[str, Option(names=tuple(STARTS))] = "task"
    """Where episodes begin. `task` are the starts of the task.

    `edges` are starts at the edge of what the filter certifies: as close to the other platform, as
    far away, as slow or as fast as it allows.
    """
    levels: (
        Annotated[tuple[float, ...], Range(0.0, high=1e6), Option(takes="numbers from 0 to 1e6")]
        | None
    ) = None
    """Multiples of the filter's bound, with commas between them. Each gives a world to attack in.

    The disturbance has the worst direction in every step, and so have the errors of navigation. The
    search chooses the disturbance together with the controls.
    """
    seed: Seed = 0
    """Seed of the starts and of the adversaries."""
    out: File | None = None
    """A .json file to write the numbers to."""


HEADING = (
    f"{'policy':12} {'steps':>10} {'violating':>10} {'inside':>8} "
    f"{'worst h':>10} {'inside':>10} {'altered':>8} {'‖Δu‖':>8}"
)
"""The first line of the table of what the adversaries achieved."""


def line(row: dict[str, Any]) -> str:
    """Return the line of the table for one adversary, given the result of `attack`."""
    return (
        f"{row['policy']:12} {row['steps']:>10,} {row['violating_steps']:>10,} "
        f"{row['violating_steps_inside']:>8,} {_number(row['worst_margin']):>10} "
        f"{_number(row['worst_margin_inside']):>10} {row['intervention_rate']:>8.2%} "
        f"{row['mean_correction']:>8.3g}"
    )


def confidence(rows: Sequence[dict[str, Any]]) -> str:
    """Return a bound on the share of episodes with a violation, as text. It is empty without one.

    Args:
        rows: the result of `attack` for each adversary.
    """
    bounded = [row for row in rows if row["violation_bound"] is not None]
    if not bounded:
        return ""
    share = max(row["violation_bound"] for row in bounded)
    cut = "" if all(row["whole_episodes"] for row in bounded) else ", which were cut off,"
    clean = sum(not violated(row) for row in rows)
    return (
        f"{clean} of {len(rows)} without a violation: "
        f"against each random one less than a share of {share:.1g} "
        f"of the episodes{cut} has one, with 95 % confidence"
    )


def violated(row: dict[str, Any]) -> bool:
    """Return whether a constraint was violated, at a sample or inside a step."""
    return bool(row["violating_steps"] or row["violating_steps_inside"])


def _number(value: float | None) -> str:
    return "no number" if value is None else f"{value:.3g}"


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code, which is 1 if there was a violation."""
    enable_compilation_cache()
    import jax

    options = Options.parse(argv)
    rta = options.filter_or_default()
    env = options.replace(rta=rta).make(options.env)
    if not env.constraints:
        raise ConfigError(f"env: {options.env} has no safety constraint")
    facts: dict[str, Any] = {
        "command": f"jaxsafe falsify {shlex.join(argv)}",
        "commit": provenance.commit(),
        "versions": provenance.versions(),
        "env": options.env,
        "rta": rta,
        "variant": options.variant,
        "actions": options.actions,
        "seed": options.seed,
        "starts": options.starts,
    }
    length = (
        min(longest_episode(env), max(1, MOST_STEPS // options.num_envs))
        if options.steps is None
        else -(-options.steps // options.num_envs)
    )
    rows: list[dict[str, Any]] = []
    for level in options.levels or (None,):
        of_level: list[dict[str, Any]] = []
        names = tuple(options.policies or POLICIES)
        for name in names:
            world = env if level is None else world_at(env, level, searched=name == SEARCH)
            row = attack(
                world,
                name,
                length,
                options.num_envs,
                jax.random.key(options.seed),
                starts=options.starts,
                among=names,
            )
            of_level.append(row if level is None else {"level": level, **row})
            if len(of_level) == 1:
                print(HEADING if level is None else f"{level:g} times the bound\n{HEADING}")
            print(line(row), flush=True)
            # The file is written after each adversary, so that nothing is lost if the run is
            # stopped.
            if options.out:
                content = {**facts, "policies": [*rows, *of_level]}
                text = json.dumps(content, indent=1, ensure_ascii=False)
                write_text(Path(options.out), f"{text}\n")
        if bound := confidence(of_level):
            print(bound)
        rows += of_level
    if options.out:
        print(f"written to {options.out}")
    return int(any(violated(row) for row in rows if row.get("level", 0.0) <= 1.0))


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
