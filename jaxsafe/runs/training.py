"""The training of runs, one after another, with their evaluation and their figures.

`jaxsafe.train` calls `train`.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from itertools import zip_longest
from pathlib import Path
from typing import Any, overload

import jax
import numpy as np

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.networks import Params
from jaxsafe.devices import processes
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.devices.seed_mapper import claim_cores, usable_cores
from jaxsafe.environment import Environment
from jaxsafe.envs import TASKS, registered
from jaxsafe.envs.identity import identity
from jaxsafe.garbage_collection import without_collection
from jaxsafe.runs.run import Run
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train import train as function
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.options import NO_RECIPE, TrainConfig, resolve
from jaxsafe.train.host.results import finish, table
from jaxsafe.train.host.session import Clock, Training
from jaxsafe.train.hyperparameters import PPO
from jaxsafe.train.ppo import TrainState
from jaxsafe.train.train import Callback, Curves
from jaxsafe.types import Key


@overload
def train(env: str | os.PathLike, *, progress: bool = True, **options: Any) -> Run: ...


@overload
def train(*, like: str | os.PathLike, progress: bool = True, **options: Any) -> Run: ...


@overload
def train(
    *,
    resume: str | os.PathLike,
    steps: float | None = None,
    progress: bool = True,
) -> Run: ...


@overload
def train(
    env: Environment,
    agent: Agent,
    hyperparameters: PPO,
    key: Key,
    num_updates: int,
    callback: Callback | None = None,
    every: int | None = None,
    params: Params | None = None,
) -> tuple[TrainState, Curves]: ...


# `inspect` and `jax.jit` shall see the arguments of the pure function.
@functools.wraps(function.train)
def train(*arguments: Any, **options: Any) -> Any:
    """Train a run if a name is given, or one seed if an environment is given.

    A name and options go to `train_run`, and an environment goes to `jaxsafe.train.train.train`.
    """
    env = arguments[0] if arguments else options.get("env")
    if {"resume", "like"} & set(options) or isinstance(env, str | os.PathLike):
        return train_run(*arguments, **options)
    if isinstance(env, Environment) and len(arguments) < 2 and "agent" not in options:
        raise ConfigError(
            "train: an environment needs agent, hyperparameters, key and num_updates; a run needs "
            f"the name of a task or a file, for instance jaxsafe.train({env.task or 'docking2d'!r})"
        )
    return function.train(*arguments, **options)


def train_run(
    env: str | os.PathLike | None = None,
    *,
    resume: str | os.PathLike | None = None,
    progress: bool = True,
    **options: Any,
) -> Run:
    """Train all seeds of a task as `jaxsafe train` does, and return the run.

    The seeds share the cores if no other program of JAX has run before in this process. After
    Ctrl-C `jaxsafe.train(resume=…)` goes on with the run.

    Args:
        env: a task, the file of an environment, or `MODULE:TASK`. It may be left out with the
            option `like`.
        resume: the directory of a run to go on with. Only `steps` may be given beside it, to train
            the run for longer.
        progress: whether to show how far the training is.
        **options: the options of the command by name, such as `seeds=10`, `steps=200_000` and
            `out="runs/mine"`. Those with a dot are written `**{"ppo.gamma": 0.98}`.

    Raises:
        ConfigError: an option is wrong. The message names the option, what was found and what is
            allowed.
        KeyboardInterrupt: the user stopped the training, which is kept.
    """
    began = time.monotonic()
    claim_cores()
    enable_compilation_cache()
    if resume is None:
        task = {} if env is None else {"env": env}
        path = run_directory.create(*_resolved({**task, **options}))
    else:
        path = Path(resume)
        _extend(path, {**options, **({} if env is None else {"env": env})})
    if (path / "results.json").exists():
        return Run(path)
    if progress:
        _tell_idle_cores(path)
    try:
        finished = train_all([path], path, began, verbose=False, progress=progress)
    except Exception:
        if resume is None:
            run_directory.discard_unused(path)
        raise
    if not finished:
        raise KeyboardInterrupt
    return Run(path)


def refuse_run(env: str | None) -> None:
    """Refuse a run where a task is expected.

    Raises:
        ConfigError: it is the directory of a run.
    """
    if env and registered(env) is None and (Path(env) / "config.yaml").is_file():
        raise ConfigError(f"env: {env} is a run; resume={env} goes on with it")


def _resolved(options: Mapping[str, Any]) -> tuple[TrainConfig, Environment, str]:
    if options.get("env") == "all":
        raise ConfigError(f"env: expected one task, found 'all'; choose from {', '.join(TASKS)}")
    given = {name: _plain(value) for name, value in options.items()}
    refuse_run(given.get("env"))
    return resolve(given)


def _plain(value: Any) -> Any:
    """Return a path as text and a number of NumPy as one of Python."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.item() if isinstance(value, np.generic) else value


def _extend(path: Path, options: Mapping[str, Any]) -> None:
    """Let a run that is resumed train for more steps, if the options say so.

    Raises:
        ConfigError: there is no run, or another option is given.
    """
    run_directory.read(path, "resume")
    for name in options:
        if name != "steps":
            raise ConfigError(f"{name}: the run has its options; only steps is given with resume")
    if options.get("steps") is not None:
        run_directory.extend([path], options["steps"])


def _tell_idle_cores(path: Path) -> None:
    """Print a line if the seeds of a run cannot share the cores, because JAX was in use before."""
    cores = usable_cores()
    seeds = run_directory.read(path, "run")[0].seeds
    alone = jax.default_backend() == "cpu" and jax.local_device_count() == 1
    if alone and min(seeds, cores) > 1:
        print(
            f"training {seeds} seeds on one of {cores} cores, because JAX was in use before; "
            "in a new session call jaxsafe.train first"
        )


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


def train_all(
    runs: Sequence[Path], path: Path, began: float, *, verbose: bool = True, progress: bool = True
) -> bool:
    """Train runs one after another, then evaluate all of them.

    The programs of a run are compiled while the run before it trains, because compiling on its own
    leaves cores idle.

    Args:
        runs: the directories of the runs.
        path: the directory from which the user can resume all of them.
        began: the time [s] of `time.monotonic` at which the clock of the first run starts.
        verbose: whether to print what each run is, its results and the paths of its figures.
        progress: whether to show how far a training is.

    Returns:
        False if the user asked to stop, else True.
    """
    trained: list[tuple[Path, Training]] = []
    upcoming = None
    with ExitStack() as files:
        for run, following in zip_longest(runs, runs[1:]):
            training = upcoming or _open(run, files, began)
            config = training.config
            if verbose:
                seeds = f"{config.seeds} {'seed' if config.seeds == 1 else 'seeds'}"
                print(
                    f"{training.name}: {seeds} × {training.num_steps:,} steps, "
                    f"{recipe_text(config)}, in {run}"
                )
                if changes := identity(training.env)["changes"]:
                    print(f"the task with other {', '.join(changes)}")
            training.prepare()
            upcoming = following and _open(following, files, time.monotonic())
            if upcoming:
                upcoming.prepare()
            if not training.train(progress):
                call = (
                    f"jaxsafe train resume={path}"
                    if verbose
                    else f"jaxsafe.train(resume={str(path)!r})"
                )
                print(f"stopped at step {training.step:,}; go on with: {call}")
                return False
            trained.append((run, training))
        for _, training in trained:
            training.prepare_evaluation()
        # This import takes a while, so it waits until the figures are needed.
        from jaxsafe.runs.figures import draw_all

        for run, training in trained:
            results = finish(training)
            if verbose:
                print(table(results, run / "results.json"))
            figures = draw_all(training.run)
            if verbose:
                print("figures: " + ", ".join(map(str, figures)))
    return True


def recipe_text(config: TrainConfig) -> str:
    """Return a text that says whether a training has the options of a run or of a recipe."""
    if config.like is not None:
        return f"like {config.like}"
    preset = f"preset {config.preset}"
    return preset if config.recipe in (None, NO_RECIPE) else f"recipe {config.recipe}, {preset}"


def _open(run: Path, files: ExitStack, began: float) -> Training:
    """Return the training of a run, to be prepared and to go on from the newest checkpoint.

    Args:
        run: the run directory.
        files: the stack that closes the logs of the run.
        began: the time [s] of `time.monotonic` since which the clock of the run has run.
    """
    own = files.enter_context(processes.own_files(run))
    with without_collection():
        config, env, name = run_directory.read(run, "resume")
    return Training(config, env, name, own, Clock(time.monotonic() - began), run)
