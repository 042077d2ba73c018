"""Train every task by every recipe with ten seeds, evaluate the policies, and write the pages.

The first page is OUT/baselines.md, the others are in OUT/results. This takes hours, and may be done
in parts: the pages also have what was reported into OUT before, with the same options.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from jaxsafe.commands import cli
from jaxsafe.commands.options import CommandOptions, Directory, Option
from jaxsafe.config.arguments import Arguments
from jaxsafe.envs import TASKS

# The package of this file is imported by its name.
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from baselines.plan import BEST, KINDS, plan

SEEDS = 10
"""Seeds of every training, unless the user says otherwise."""


class Options(CommandOptions):
    """The options of `python benchmarks/baselines`."""

    program = "python benchmarks/baselines"

    tasks: Annotated[tuple[str, ...], Option(names=tuple(TASKS))] | None = None
    """The tasks to train, with commas between them. The default is all of them."""
    kinds: Annotated[tuple[str, ...], Option(names=tuple(KINDS))] | None = None
    """The recipes, with commas between them. The default is all of them."""
    runs: Directory = "runs/report"
    """Directory of the runs. What is complete there is not done again."""
    out: Directory = "report"
    """Where to write the pages."""
    policies: Directory | None = None
    """Where to copy the best policy of each task, as TASK.npz."""
    film: bool = True
    """Whether to draw animations."""
    train: bool = True
    """Whether to train what is not done yet. With false the pages are written from the records."""
    training: Annotated[Mapping[str, Any], Option(prefix="", placeholder="OPTION", takes="a value")]
    """Any option of `jaxsafe train`, the same for all trainings."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return the exit code."""
    from baselines.page import DIRECTORY, Report
    from baselines.record import keep, kept
    from baselines.run import evaluate, train
    from jaxsafe.storage.files import write_bytes
    from jaxsafe.train.host.options import resolve

    options = Options.parse(argv)
    out = Path(options.out)
    runs = Path(options.runs)
    rest = [word for word in argv if word.partition("=")[0] in options.training]
    rest = rest if "seeds" in options.training else [f"seeds={SEEDS}", *rest]
    items = plan(options.tasks or [*TASKS], options.kinds or [*KINDS], rest)
    # Mistakes in options are found before anything is done.
    episodes = [resolve(Arguments.parse(item.words).options)[0].episodes for item in items]
    command = f"python benchmarks/baselines {shlex.join(argv)}".rstrip()
    try:
        for item, count in zip(items, episodes, strict=True) if options.train else ():
            run = train(item, runs)
            evaluate(item, run, count, options.film and item.kind == "engineered_features")
            keep(item, run, out / DIRECTORY, command)
            if options.policies and item.kind == "engineered_features":
                write_bytes(Path(options.policies) / f"{item.task}.npz", (run / BEST).read_bytes())
    except KeyboardInterrupt:
        print(f"stopped; the same command goes on with what is in {runs}")
        return cli.INTERRUPTED
    records, old = kept(plan([*TASKS], [*KINDS], rest), out / DIRECTORY)
    page = Report(records).write(out)
    print("\n".join(["", *old, str(page)]))
    return 0


if __name__ == "__main__":
    cli.run(main, Options, cli.at_once)
