"""`python -m jaxsafe.rta.falsify env=docking2d rta=default`: tries to break a filter, and counts what happened.

Every adversary acts for a number of steps from the task's own starts; the last one searches for sequences of controls that
defeat the filter. Violations are counted at the samples and inside the steps, see `attack`.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxsafe import cli, origin

OPTIONS = ("env", "rta", "steps", "lanes", "seed", "policies", "actions", "variant", "out")


def report(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a table."""
    lines = [
        f"{'policy':12} {'steps':>10} {'violating':>10} {'inside':>8} {'worst h':>10} {'inside':>10}"
        f" {'altered':>8} {'‖Δu‖':>8}"
    ]
    lines += [
        f"{row['policy']:12} {row['steps']:>10,} {row['violating_steps']:>10,} {row['violating_steps_inside']:>8,}"
        f" {row['worst_margin']:>10.3g} {row['worst_margin_inside']:>10.3g} {row['intervention_rate']:>8.2%}"
        f" {row['mean_correction']:>8.3g}"
        for row in rows
    ]
    clean = [row for row in rows if not violated(row)]
    if clean:
        steps = sum(row["steps"] for row in clean)
        lines.append(
            f"{len(clean)} of {len(rows)} without a violation: below {3.0 / steps:.1g} a step with 95 % confidence"
        )
    return "\n".join(lines)


def violated(row: dict[str, Any]) -> bool:
    """Whether a constraint was, at a sample or inside a step."""
    return row["violation_bound"] is None


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code: 1 if there was a violation."""
    cli.enable_compilation_cache()
    import jax

    from jaxsafe.envs import make
    from jaxsafe.errors import ConfigError, nearest
    from jaxsafe.rta.adversaries import ADVERSARIES
    from jaxsafe.rta.attack import SEARCH, attack
    from jaxsafe.rta.presets import PRESETS
    from jaxsafe.train.files import write_text

    arguments = cli.Arguments.parse(argv)
    task, out = arguments.pop_text("env"), arguments.pop_text("out")
    options: dict[str, Any] = {name: arguments.pop_text(name) for name in ("rta", "variant", "actions")}
    changes = arguments.pop_overrides()
    steps, lanes = arguments.pop_count("steps", 100_000), arguments.pop_count("lanes", 256)
    known = (*ADVERSARIES, SEARCH)
    seed, policies = arguments.pop_seed(), arguments.pop("policies", list(known))
    arguments.refuse_rest([*OPTIONS, "env.…"])
    if task is None:
        raise ConfigError("env: missing; for instance env=docking3d")
    for name in policies if isinstance(policies, list) else [policies]:
        if name not in known:
            raise ConfigError(f"policies: unknown policy {name!r}; choose from {nearest(name, known)}")
    if options["rta"] is None and task in PRESETS:
        options["rta"] = "default"
    env = make(task, changes, **options)
    if not env.constraints:
        raise ConfigError(f"env: {task} has no safety constraint")
    facts: dict[str, Any] = {"command": f"python -m jaxsafe.rta.falsify {shlex.join(argv)}", "commit": origin.commit()}
    facts |= {"versions": origin.versions(), "env": task, **options, "seed": seed}
    rows = []
    for name in policies if isinstance(policies, list) else [policies]:
        rows.append(attack(env, name, -(-steps // lanes), lanes, jax.random.key(seed)))
        print(report(rows[-1:]).splitlines()[1] if len(rows) > 1 else "\n".join(report(rows).splitlines()[:2]), flush=True)
        if out:  # after each, so that nothing is lost if the run is stopped
            write_text(Path(out), json.dumps({**facts, "policies": rows}, indent=1, ensure_ascii=False) + "\n")
    if report(rows).splitlines()[-1].endswith("confidence"):
        print(report(rows).splitlines()[-1])
    if out:
        print(f"written to {out}")
    return int(any(map(violated, rows)))


def usage() -> str:
    """The help text."""
    return (
        "usage: python -m jaxsafe.rta.falsify env=TASK [key=value …]\n\n"
        "  rta=default            the filter to attack (that of a file: its own); none attacks the bare task\n"
        "  steps=N                steps of each adversary (default 100000), over lanes=N episodes at once (default 256)\n"
        "  policies=[a,b]         some adversaries only\n"
        "  seed=N                 (default 0)\n"
        "  env.PATH=VALUE         change the environment\n"
        "  out=FILE.json          write the numbers"
    )


if __name__ == "__main__":
    cli.run(main, usage)
