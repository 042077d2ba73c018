"""Training runs one after another: each trains, is evaluated, and gets its figures."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import zip_longest
from pathlib import Path

from jaxsafe.devices import processes
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.results import finish, table
from jaxsafe.train.host.session import Clock, Training


def is_complete(run: Path) -> bool:
    """Return whether a run is complete. If only its figures are missing, draw them."""
    if not (run / "results.json").exists():
        return False
    print(f"{run} is complete; nothing is left to do")
    # The command may have been killed between the results and the figures.
    if not (run / "figures").exists() and processes.leads():
        from jaxsafe.runs.figures import draw_all

        draw_all(run)
    return True


def train_all(runs: Sequence[Path], path: Path, began: float) -> bool:
    """Train runs one after another, then evaluate all of them.

    The programs of a run are compiled while the run before it trains, because compiling alone
    leaves cores idle.

    Args:
        runs: the directories of the runs.
        path: the directory from which the user can resume all of them.
        began: the time [s] of `time.monotonic` at which the clock of the first run starts.

    Returns:
        False if the user asked to stop, else True.
    """
    trained, upcoming = [], None
    with ExitStack() as files:
        for run, following in zip_longest(runs, runs[1:]):
            training = upcoming or _open(run, files, began)
            config = training.config
            print(
                f"{training.name}: {config.seeds} seeds × {training.num_steps:,} steps, "
                f"preset {config.preset}, in {run}"
            )
            training.prepare()
            upcoming = following and _open(following, files, time.monotonic())
            if upcoming:
                upcoming.prepare()
            if not training.train():
                print(
                    f"stopped at step {training.step:,}; "
                    f"go on with: python -m jaxsafe.train resume={path}"
                )
                return False
            trained.append((run, training))
        for _, training in trained:
            training.prepare_evaluation()
        # This import takes a while, so it waits until the figures are needed.
        from jaxsafe.runs.figures import draw_all

        for run, training in trained:
            print(table(finish(training), run / "results.json"))
            print("figures: " + ", ".join(str(figure) for figure in draw_all(training.run)))
    return True


def _open(run: Path, files: ExitStack, began: float) -> Training:
    """Return what is left of a run to train.

    Args:
        run: the run directory.
        files: the stack that closes the logs of the run.
        began: the time [s] of `time.monotonic` since which the clock of the run has run.
    """
    own = files.enter_context(processes.own_files(run))
    config, env, name = run_directory.read(run, "resume")
    return Training(config, env, name, own, Clock(time.monotonic() - began), run)
