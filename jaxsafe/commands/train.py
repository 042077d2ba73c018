"""Train all seeds of a task, evaluate them, draw figures and print a table.

Everything is kept in a run directory, and a training that was stopped goes on with resume=RUN.
Steps and episodes are counted for each seed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

from jaxsafe.commands import cli
from jaxsafe.commands.environment_options import Overrides
from jaxsafe.commands.options import CommandOptions, Directory, Option
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.devices.seed_mapper import claim_cores
from jaxsafe.garbage_collection import without_collection
from jaxsafe.train.host.options import TrainConfig, recipe, recipe_options, resolve_all

BEGAN = time.monotonic()
"""Time [s] at which the command began. The clock of the first run starts then."""


class Options(CommandOptions):
    """The options of `jaxsafe train`."""

    groups: ClassVar = {
        "The environment in which the policies act.": (
            "env",
            "env.PATH",
            "actions",
            "variant",
            "rta",
        ),
        "The training. Its steps are those of each seed.": (
            "recipe",
            "preset",
            "like",
            "steps",
            "stop_at_success",
            "seeds",
            "seed",
            "algorithm",
            "cost_limit",
            "rta_training",
            "start_from",
            "starts",
            "resume",
        ),
        "Evaluations, checkpoints and where everything is kept.": (
            "eval_every",
            "eval_episodes",
            "episodes",
            "checkpoint_every",
            "log_every",
            "out",
            "tensorboard",
            "wandb",
            "mlflow",
        ),
        "The agent: what it sees, its networks and its noise.": ("agent.*",),
        "The numbers of PPO.": ("ppo.*",),
        "Several devices or processes.": ("devices_per_seed", "distributed"),
    }

    env: Annotated[str, Option(first=True, examples=("env=docking3d",))] | None = None
    """A task, the file of an environment, or all for the five tasks one after another.

    It is left out only with resume, or with like for the environment of that run.
    """
    overrides: Overrides
    """Change one field of the environment, for instance env.reward.delta_v.scale=-0.02."""
    resume: Directory | None = None
    """The run to go on with.

    Only distributed may be given with it, and steps to train the run for longer.
    """
    distributed: bool = False
    """Whether this is one of several processes that srun or mpirun started."""
    training: Annotated[Mapping[str, Any], Option(prefix="", component=TrainConfig)]
    """The options of the training."""

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> tuple[Mapping[str, Any], str]:
        task = given.get("env")
        if task in (None, "all"):
            return dict.fromkeys(recipe_options(), "from the recipe"), (
                "A default from the recipe is that of the task, and `jaxsafe train TASK help` "
                "shows it."
            )
        settings = recipe(task, given.get("preset"), given.get("recipe"))
        return settings, f"The defaults are those of {task} with preset={settings['preset']}."


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    claim_cores()
    enable_compilation_cache()
    import jax

    from jaxsafe.devices import processes
    from jaxsafe.runs.training import is_complete, refuse_run, train_all
    from jaxsafe.schema.errors import ConfigError
    from jaxsafe.storage.files import read_json
    from jaxsafe.train.host import run_directory
    from jaxsafe.train.host.results import summary

    options = Options.parse(argv)
    if options.distributed:
        processes.join()
    resume = options.resume
    if resume is None:
        refuse_run(options.env)
        with without_collection():
            resolved = resolve_all(options.without("resume", "distributed"))
        path = Path(processes.from_leader(lambda: str(run_directory.create_all(resolved))))
    else:
        options.refuse_others("resume", "distributed", "steps")
        path = Path(resume)
    runs = run_directory.runs(path)
    if resume is not None and "steps" in options.given:
        processes.from_leader(lambda: run_directory.extend(runs, options.given["steps"]) or "")
    if "steps" in options.given and processes.leads():
        for config, _, name in (run_directory.read(run, "resume") for run in runs):
            if config.rounding:
                print(f"{name}: {config.rounding}" if len(runs) > 1 else config.rounding)
    try:
        with processes.reporting_lost_process(
            f"go on with: jaxsafe train distributed=true resume={path}"
        ):
            try:
                unfinished = [run for run in runs if not is_complete(run)]
                finished = train_all(unfinished, path, BEGAN)
            except Exception as error:
                # With several processes, the error may be the loss of another process. The run can
                # be resumed after that, so it is kept.
                alone = jax.process_count() == 1
                if (
                    resume is None
                    and processes.leads()
                    and (alone or isinstance(error, ConfigError))
                ):
                    run_directory.discard_unused(path)
                raise
    except KeyboardInterrupt:
        print(f"go on with: jaxsafe train resume={path}")
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


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options, cli.at_once)
