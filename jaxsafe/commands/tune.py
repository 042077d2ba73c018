"""The command `python -m jaxsafe.tune` trains every setting of a sweep and ranks the settings.

For example: `python -m jaxsafe.tune env=docking2d seeds=4 'sweep.ppo.gamma=[0.95,0.97]'`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxsafe.commands import cli
from jaxsafe.config.arguments import Arguments
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.devices.seed_mapper import claim_cores

RANKS = ("steps", "success", "deterministic")
"""Orders of the table of settings. The first is the default."""

EPISODES = 200
"""Number of episodes in the evaluation of each seed, unless the user says otherwise."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    claim_cores()
    enable_compilation_cache()
    from tqdm import tqdm

    from jaxsafe.schema.errors import ConfigError, nearest, show
    from jaxsafe.train.host import run_directory
    from jaxsafe.tune import results
    from jaxsafe.tune.lanes import train_all
    from jaxsafe.tune.settings import MAX_SETTINGS, alike, pop_sweep, settings

    arguments, path = Arguments.parse(argv), None
    resume = arguments.pop_text("resume")
    if resume is not None:
        arguments.refuse_rest(["resume"])
        path, arguments = Path(resume), results.read_request(Path(resume))
    request, out = dict(arguments.options), arguments.pop_text("out")
    rank = arguments.pop("rank", RANKS[0])
    if rank not in RANKS:
        raise ConfigError(f"rank: unknown order {show(rank)}; choose from {nearest(rank, RANKS)}")
    samples = (
        arguments.pop_count("samples", 1, most=MAX_SETTINGS)
        if "samples" in arguments.options
        else None
    )
    draw = arguments.pop_seed("draw")
    arguments.options.setdefault("episodes", EPISODES)
    sweep = pop_sweep(arguments)
    found = settings(arguments, sweep, samples, draw)
    if path is None:
        path = results.create(out, request, found[0])
    else:
        results.refuse_other(path, found[0])
    rows = results.read(path, found)
    left = [i for i in range(len(found)) if i not in rows]
    print(
        f"{len(found)} settings × {found[0].config.seeds} seeds, "
        f"{len(alike(found, left))} to compile, in {path}",
        flush=True,
    )
    total = sum(found[i].config.num_updates for i in left)
    try:
        # `disable=None` draws no bar where there is no terminal.
        with tqdm(total=total, unit=" updates", disable=None) as bar:
            for done in train_all(found, left, bar.update):
                results.add(path, done)
                rows |= done
                tqdm.write("\n".join(results.line(i, row, list(sweep)) for i, row in done.items()))
    except Exception:
        if resume is None:
            run_directory.discard_unused(path)
        raise
    except KeyboardInterrupt:
        print(
            f"stopped with {len(rows)} of {len(found)} settings; "
            f"go on with: python -m jaxsafe.tune resume={path}"
        )
        return cli.INTERRUPTED
    print(results.finish(path, rows, list(sweep), rank))
    return 0


def usage() -> str:
    """Return the help text."""
    return (
        "usage: python -m jaxsafe.tune env=TASK 'sweep.OPTION=[a,b,…]' [key=value …]"
        "      or      resume=DIR\n\n"
        "  sweep.OPTION=[a,b]     values of an option of jaxsafe.train, or of env.PATH; "
        "several make a grid\n"
        "  sweep.OPTION='log(1e-4,1e-2)' or 'uniform(0.9,1)'   an interval to draw from, "
        "with samples=N\n"
        "  samples=N              draw N settings instead of trying all combinations; "
        "draw=SEED chooses others\n"
        "  rank=steps|success|deterministic   order of the table "
        "(default steps to 80 % success in training)\n"
        "  seeds, steps, episodes, …   any option of jaxsafe.train, the same for all settings\n"
        "  out=DIR                where to write (default: a new directory in runs/)"
    )


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, usage, cli.at_once)
