"""`python -m jaxsafe.train env=docking3d seeds=10`: train all seeds, evaluate, draw figures, print a table."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsafe.commands import cli
from jaxsafe.config.arguments import Arguments
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.devices.seed_mapper import claim_cores

if TYPE_CHECKING:
    from jaxsafe.train.host.session import Training

BEGAN = time.monotonic()


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    claim_cores()
    enable_compilation_cache()
    import jax

    from jaxsafe.devices import processes
    from jaxsafe.schema.errors import ConfigError
    from jaxsafe.storage.files import read_json
    from jaxsafe.train.host import run_directory
    from jaxsafe.train.host.options import resolve_all
    from jaxsafe.train.host.results import summary

    arguments = Arguments.parse(argv)
    if arguments.pop_flag("distributed"):
        processes.join()
    resume = arguments.pop_text("resume")
    if resume is None:
        resolved = resolve_all(arguments.options)
        path = Path(processes.from_leader(lambda: str(run_directory.create_all(resolved))))
    else:
        arguments.refuse_rest(["resume", "distributed"])
        path = Path(resume)
    runs = run_directory.runs(path)
    try:
        with processes.reporting_lost_process(
            f"go on with: python -m jaxsafe.train distributed=true resume={path}"
        ):
            try:
                finished = _train([run for run in runs if not _complete(run)], path)
            except Exception as error:
                alone = (
                    jax.process_count() == 1
                )  # else it may be the loss of another process, after which the run goes on
                if (
                    resume is None
                    and processes.leads()
                    and (alone or isinstance(error, ConfigError))
                ):
                    run_directory.discard_unused(path)
                raise
    except KeyboardInterrupt:
        print(f"go on with: python -m jaxsafe.train resume={path}")
        raise
    if not finished:
        return cli.INTERRUPTED
    if len(runs) > 1 and processes.leads():
        print(summary({run.name: run for run in runs}))
    return (
        cli.DIVERGED
        if processes.leads() and any("diverged" in read_json(run / "results.json") for run in runs)
        else 0
    )


def _complete(run: Path) -> bool:
    """Whether all is there, with figures if only they are missing."""
    from jaxsafe.devices import processes

    if not (run / "results.json").exists():
        return False
    print(f"{run} is complete; nothing is left to do")
    if (
        not (run / "figures").exists() and processes.leads()
    ):  # killed between the results and the figures
        from jaxsafe.commands.run_figures import draw_all

        draw_all(run)
    return True


def _train(runs: Sequence[Path], path: Path) -> bool:
    """Train runs in `path` one after another, then evaluate them; False if the user asked to stop.

    The programs of a run are compiled while the one before it trains: to compile alone leaves cores idle.
    """
    from jaxsafe.train.host.results import finish, table

    trained, upcoming = [], None
    with ExitStack() as files:
        for run, following in zip_longest(runs, runs[1:]):
            training = upcoming or _open(run, files, BEGAN)
            config = training.config
            print(
                f"{training.name}: {config.seeds} seeds × {training.num_steps:,} steps, preset {config.preset}, in {run}"
            )
            training.prepare()
            upcoming = following and _open(following, files, time.monotonic())
            if upcoming:
                upcoming.prepare()
            if not training.train():
                print(
                    f"stopped at step {training.step:,}; go on with: python -m jaxsafe.train resume={path}"
                )
                return False
            trained.append((run, training))
        for _, training in trained:
            training.prepare_evaluation()
        from jaxsafe.commands.run_figures import draw_all  # only now: it takes a while

        for run, training in trained:
            print(table(finish(training), run / "results.json"))
            print("figures: " + ", ".join(str(figure) for figure in draw_all(training.run)))
    return True


def _open(run: Path, files: ExitStack, began: float) -> Training:
    """What is left of a run; its logs are closed with `files`, and its clock has run since `began`."""
    from jaxsafe.devices import processes
    from jaxsafe.train.host import run_directory
    from jaxsafe.train.host.session import Clock, Training

    own = files.enter_context(processes.own_files(run))
    config, env, name = run_directory.read(run, "resume")
    return Training(config, env, name, own, Clock(time.monotonic() - began), run)


def usage() -> str:
    """The help text."""
    from jaxsafe.train.host.options import usage

    return usage()


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, usage, cli.at_once)
