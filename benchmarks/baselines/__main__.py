"""`python benchmarks/baselines`: train and evaluate the baselines and write their page."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxsafe.commands import cli
from jaxsafe.config.arguments import Arguments
from jaxsafe.schema.errors import ConfigError

# The package of this file is imported by its name.
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

SEEDS = 10
"""Seeds of every training, unless the user says otherwise."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return the exit code."""
    from baselines.page import DIRECTORY, Report
    from baselines.plan import BEST, KINDS, plan
    from baselines.record import keep, kept
    from baselines.run import evaluate, train
    from jaxsafe.envs import TASKS
    from jaxsafe.storage.files import write_bytes
    from jaxsafe.train.host.options import resolve

    arguments = Arguments.parse(argv)
    out = Path(arguments.pop_text("out") or "report")
    runs = Path(arguments.pop_text("runs") or "runs/report")
    tasks, kinds = (
        _names(name, arguments.pop(name), [*known])
        for name, known in (("tasks", TASKS), ("kinds", KINDS))
    )
    policies = arguments.pop_text("policies")
    film = arguments.pop_flag("film") is not False
    rest = [word for word in argv if word.partition("=")[0] in arguments.options]
    rest = rest if "seeds" in arguments.options else [f"seeds={SEEDS}", *rest]
    items = plan(tasks, kinds, rest)
    # Mistakes in options are found before anything is done.
    episodes = [resolve(Arguments.parse(item.words).options)[0].episodes for item in items]
    command = f"python benchmarks/baselines {shlex.join(argv)}".rstrip()
    try:
        for item, count in zip(items, episodes, strict=True):
            run = train(item, runs)
            evaluate(item, run, count, film and item.kind == "features")
            keep(item, run, out / DIRECTORY, command)
            if policies and item.kind == "features":
                write_bytes(Path(policies) / f"{item.task}.npz", (run / BEST).read_bytes())
    except KeyboardInterrupt:
        print(f"stopped; the same command goes on with what is in {runs}")
        return cli.INTERRUPTED
    records, old = kept(plan([*TASKS], [*KINDS], rest), out / DIRECTORY)
    page = Report(records).write(out)
    print("\n".join(["", *old, str(page)]))
    return 0


def _names(option: str, value: Any, known: Sequence[str]) -> list[str]:
    if value is None:
        return list(known)
    names = value if isinstance(value, list) else [value]
    if not names:
        raise ConfigError(f"{option}: expected at least one of {', '.join(known)}, found none")
    return [str(name) for name in names]


def usage() -> str:
    """Return the help text."""
    from baselines.plan import KINDS

    return (
        "usage: python benchmarks/baselines [key=value …]\n\n"
        "  Trains every task in every way with ten seeds, evaluates, and writes OUT/baselines.md.\n"
        "  It takes hours and may be done in parts: the page also has what was reported into OUT\n"
        "  before, with the same options.\n\n"
        "  tasks=[docking2d,…]    some tasks only\n"
        f"  kinds=[features,…]     some of {', '.join(KINDS)}\n"
        "  runs=DIR               where the runs are (default runs/report); what is complete\n"
        "                         there is not done again\n"
        "  out=DIR                where to write the page (default report)\n"
        "  policies=DIR           copy the best policy of each task there, as TASK.npz\n"
        "  film=false             no animations\n"
        "  seeds, steps, …        any option of jaxsafe.train, the same for all"
    )


if __name__ == "__main__":
    cli.run(main, usage, cli.at_once)
