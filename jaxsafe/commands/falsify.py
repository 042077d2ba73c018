"""The command `python -m jaxsafe.rta.falsify env=docking2d rta=default` tries to break a filter.

It counts what happened. Every adversary acts on whole episodes from the task's own starts. The last
one searches for sequences of controls that defeat the filter. Violations are counted at the samples
and inside the steps, see `jaxsafe.evaluate.run_adversaries.attack`.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxsafe.commands import cli
from jaxsafe.config.arguments import Arguments
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.storage import provenance

MOST_STEPS = 1_000_000
"""Largest number of steps of each adversary where `steps` is not given.

Episodes that are longer than this allows are cut.
"""

OPTIONS = ("env", "rta", "steps", "lanes", "seed", "policies", "actions", "variant", "out")


def report(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table of what the adversaries achieved.

    Args:
        rows: the result of `attack` for each adversary.
    """
    lines = [
        f"{'policy':12} {'steps':>10} {'violating':>10} {'inside':>8} "
        f"{'worst h':>10} {'inside':>10} {'altered':>8} {'‖Δu‖':>8}"
    ]
    lines += [
        f"{row['policy']:12} {row['steps']:>10,} {row['violating_steps']:>10,} "
        f"{row['violating_steps_inside']:>8,} {_number(row['worst_margin']):>10} "
        f"{_number(row['worst_margin_inside']):>10} {row['intervention_rate']:>8.2%} "
        f"{row['mean_correction']:>8.3g}"
        for row in rows
    ]
    bounded = [row for row in rows if row["violation_bound"] is not None]
    if bounded:
        share = max(row["violation_bound"] for row in bounded)
        cut = "" if all(row["whole_episodes"] for row in bounded) else ", which were cut off,"
        clean = sum(not violated(row) for row in rows)
        lines.append(
            f"{clean} of {len(rows)} without a violation: "
            f"against each random one less than a share of {share:.1g} "
            f"of the episodes{cut} has one, with 95 % confidence"
        )
    return "\n".join(lines)


def violated(row: dict[str, Any]) -> bool:
    """Return whether a constraint was violated, at a sample or inside a step."""
    return bool(row["violating_steps"] or row["violating_steps_inside"])


def _number(value: float | None) -> str:
    return "no number" if value is None else f"{value:.3g}"


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code, which is 1 if there was a violation."""
    enable_compilation_cache()
    import jax

    from jaxsafe.envs import default_filter, make
    from jaxsafe.evaluate.adversaries import ADVERSARIES
    from jaxsafe.evaluate.run_adversaries import SEARCH, attack, longest_episode
    from jaxsafe.schema.errors import ConfigError, nearest
    from jaxsafe.storage.files import write_text

    arguments = Arguments.parse(argv)
    task, out = arguments.pop_text("env"), arguments.pop_text("out")
    options: dict[str, Any] = {
        name: arguments.pop_text(name) for name in ("rta", "variant", "actions")
    }
    changes = arguments.pop_overrides()
    steps = arguments.pop_count("steps", MOST_STEPS) if "steps" in arguments.options else None
    lanes = arguments.pop_count("lanes", 64)
    known = (*ADVERSARIES, SEARCH)
    seed, policies = arguments.pop_seed(), arguments.pop("policies", list(known))
    arguments.refuse_rest([*OPTIONS, "env.…"])
    if task is None:
        raise ConfigError("env: missing; for instance env=docking3d")
    for name in policies if isinstance(policies, list) else [policies]:
        if name not in known:
            raise ConfigError(
                f"policies: unknown policy {name!r}; choose from {nearest(name, known)}"
            )
    options["rta"] = options["rta"] or default_filter(task)
    env = make(task, changes, **options)
    if not env.constraints:
        raise ConfigError(f"env: {task} has no safety constraint")
    facts: dict[str, Any] = {
        "command": f"python -m jaxsafe.rta.falsify {shlex.join(argv)}",
        "commit": provenance.commit(),
    }
    facts |= {"versions": provenance.versions(), "env": task, **options, "seed": seed}
    length = (
        min(longest_episode(env), max(1, MOST_STEPS // lanes))
        if steps is None
        else -(-steps // lanes)
    )
    rows = []
    for name in policies if isinstance(policies, list) else [policies]:
        rows.append(attack(env, name, length, lanes, jax.random.key(seed)))
        print(
            report(rows[-1:]).splitlines()[1]
            if len(rows) > 1
            else "\n".join(report(rows).splitlines()[:2]),
            flush=True,
        )
        # The file is written after each adversary, so that nothing is lost if the run is stopped.
        if out:
            write_text(
                Path(out),
                json.dumps({**facts, "policies": rows}, indent=1, ensure_ascii=False) + "\n",
            )
    if report(rows).splitlines()[-1].endswith("confidence"):
        print(report(rows).splitlines()[-1])
    if out:
        print(f"written to {out}")
    return int(any(map(violated, rows)))


def usage() -> str:
    """Return the help text."""
    return (
        "usage: python -m jaxsafe.rta.falsify env=TASK [key=value …]\n\n"
        "  rta=default            the filter to attack (that of a file: its own); "
        "none attacks the bare task\n"
        "  lanes=N                episodes at once (default 64)\n"
        "  steps=N                steps of each adversary over all of them "
        "(default: whole episodes, up to a million)\n"
        "  policies=[a,b]         some adversaries only\n"
        "  seed=N                 (default 0)\n"
        "  env.PATH=VALUE         change the environment\n"
        "  out=FILE.json          write the numbers"
    )


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, usage)
