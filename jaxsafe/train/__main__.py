"""`python -m jaxsafe.train env=docking3d seeds=10`: train all seeds, evaluate, draw figures, print a table."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from jaxsafe import cli
from jaxsafe.train.seeds import claim_cores

BEGAN = time.monotonic()


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    claim_cores()
    cli.enable_compilation_cache()
    from jaxsafe.train import directory, hosts
    from jaxsafe.train.config import resolve_all
    from jaxsafe.train.results import summary

    arguments = cli.Arguments.parse(argv)
    if arguments.pop_flag("distributed"):
        hosts.join()
    resume = arguments.pop_text("resume")
    if resume is None:
        resolved = resolve_all(arguments)
        path = Path(hosts.from_leader(lambda: str(directory.create_all(resolved))))
    else:
        arguments.refuse_rest(["resume", "distributed"])
        path = Path(resume)
    runs, began = directory.runs(path), BEGAN
    for run in runs:
        with hosts.loss_told(f"go on with: python -m jaxsafe.train distributed=true resume={path}"):
            finished = _train(run, path, began)
        if not finished:
            return cli.INTERRUPTED
        began = time.monotonic()
    if len(runs) > 1 and hosts.leads():
        print(summary({run.name: run for run in runs}))
    return 0


def _train(run: Path, path: Path, began: float) -> bool:
    """Do what is left of a run, of those in `path`; False if the user asked to stop before its end."""
    from jaxsafe.plot.figures import draw_all
    from jaxsafe.train import directory, hosts
    from jaxsafe.train.loop import Training
    from jaxsafe.train.results import finish, table

    config, env, name = directory.read(run, "resume")
    if (run / "results.json").exists():
        print(f"{run} is complete; nothing is left to do")
        if not (run / "figures").exists():  # killed between the results and the figures
            draw_all(run)
        return True
    with hosts.own_files(run) as own:
        print(
            f"{name}: {config.seeds} seeds × {config.num_updates * config.ppo.batch_size:,} steps,"
            f" preset {config.preset}, in {run}"
        )
        with cli.without_collection():
            training = Training(config, env, own, began, run)
        if not training.train():
            print(f"stopped at step {training.step:,}; go on with: python -m jaxsafe.train resume={path}")
            return False
        print(table(finish(training, config, env, name), run / "results.json"))
        print("figures: " + ", ".join(str(figure) for figure in draw_all(own)))
    return True


def usage() -> str:
    """The help text."""
    from jaxsafe.train.config import usage

    return usage()


if __name__ == "__main__":
    cli.run(main, usage, cli.at_once)
