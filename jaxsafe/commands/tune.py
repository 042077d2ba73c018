"""Train many settings of the options of a training as one program, and rank them.

If several options are swept, all combinations are trained, or samples=N draws some of them. A sweep
that was stopped goes on with resume=DIR, without any other option.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from jaxsafe.commands import cli
from jaxsafe.commands.options import CommandOptions, Count, Directory, Option, Seed
from jaxsafe.config.arguments import Arguments
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.devices.seed_mapper import claim_cores
from jaxsafe.schema.component import Range
from jaxsafe.tune.settings import MAX_SETTINGS, PREFIX, alike, pop_sweep, settings

OWN = ("resume", "rank", "samples", "draw", "out")
"""Options of the sweep, which are not those of its trainings."""


class Options(CommandOptions):
    """The options of `jaxsafe tune`."""

    groups: ClassVar = {
        "What is trained.": ("env", "sweep.OPTION", "samples", "draw", "OPTION"),
        "How the settings are ranked, and where everything is kept.": (
            "rank",
            "episodes",
            "out",
            "resume",
        ),
    }

    env: Annotated[str, Option(first=True, examples=("env=docking2d",))] | None = None
    """The task, or the file of an environment. It is left out only with resume or with like."""
    sweep: Annotated[
        Mapping[str, Any],
        Option(
            examples=("sweep.ppo.gamma=0.95,0.97",),
            prefix=PREFIX,
            placeholder="OPTION",
            lists=True,
            takes="values a,b,…, or in quotes 'uniform(low,high)' or 'log(low,high)'",
        ),
    ]
    """Values of an option of `jaxsafe train`, or of env.PATH.

    Values are drawn from an interval of numbers, which needs samples=N.
    """
    samples: Annotated[int, Range(1, largest=MAX_SETTINGS)] | None = None
    """Number of settings to draw. By default all combinations are trained."""
    draw: Seed = 0
    """Seed of the draws. Another one chooses other settings."""
    rank: Annotated[Literal["steps", "success", "deterministic"], Option(kind="order")] = "steps"
    """Order of the table: by steps to 80 % success in training, or by success at the end.

    The success at the end is that of the stochastic or of the deterministic policies.
    """
    episodes: Count = 200
    """Number of episodes in the evaluation of each seed."""
    resume: Directory | None = None
    """The directory of the sweep to go on with."""
    out: Directory | None = None
    """Where to write. By default it is a new directory in runs/."""
    training: Annotated[Mapping[str, Any], Option(prefix="", placeholder="OPTION", takes="a value")]
    """Any option of `jaxsafe train`, such as seeds=4, the same for all settings."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    claim_cores()
    enable_compilation_cache()
    from tqdm import tqdm

    from jaxsafe.train.host import run_directory
    from jaxsafe.tune import results
    from jaxsafe.tune.batched_training import train_all

    options = Options.parse(argv)
    path = None
    resume = options.resume
    if resume is not None:
        options.refuse_others("resume")
        path = Path(resume)
        options = Options.read(results.read_request(path).options)
    arguments = Arguments({"episodes": options.episodes, **options.without(*OWN)})
    sweep = pop_sweep(arguments)
    points = settings(arguments, sweep, options.samples, options.draw)
    if path is None:
        path = results.create(options.out, options.without(), points[0])
    else:
        results.refuse_other(path, points[0])
    rows = results.read(path, points)
    left = [i for i in range(len(points)) if i not in rows]
    print(
        f"{len(points)} settings × {points[0].config.seeds} seeds, "
        f"{len(alike(points, left))} to compile, in {path}",
        flush=True,
    )
    total = sum(points[i].config.num_updates for i in left)
    try:
        # `disable=None` draws no bar where there is no terminal.
        with tqdm(total=total, unit=" updates", disable=None) as bar:
            for done in train_all(points, left, bar.update):
                results.add(path, done)
                rows |= done
                tqdm.write("\n".join(results.line(i, row, list(sweep)) for i, row in done.items()))
    except Exception:
        if resume is None:
            run_directory.discard_unused(path)
        raise
    except KeyboardInterrupt:
        print(
            f"stopped with {len(rows)} of {len(points)} settings; "
            f"go on with: jaxsafe tune resume={path}"
        )
        return cli.INTERRUPTED
    print(results.finish(path, rows, list(sweep), options.rank))
    return 0


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options, cli.at_once)
