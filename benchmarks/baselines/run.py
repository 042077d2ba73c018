"""Carry out a plan. Every training and evaluation is a process of its own.

What is complete is not done again.
"""

from __future__ import annotations

import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from baselines.plan import BEST, FILM, Item, best_seed
from jaxsafe.commands.cli import INTERRUPTED
from jaxsafe.commands.evaluate import Options
from jaxsafe.config.arguments import Arguments
from jaxsafe.devices.processes import in_main_thread
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import read_json, write_bytes
from jaxsafe.train.host.options import resolve
from jaxsafe.train.host.results import read_results
from jaxsafe.train.host.run_config import read_content
from jaxsafe.train.host.run_directory import described, from_described

FILM_FILE = "episode_deterministic.gif"


def train(item: Item, runs: Path) -> Path:
    """Train an item and return its run directory.

    A training that was interrupted goes on, and one that is complete is left alone.

    Raises:
        ConfigError: the directory holds a run with other options, or the training failed.
        KeyboardInterrupt: the user stopped it.
    """
    run = runs / item.name
    if (run / "config.yaml").exists():
        _refuse_other(item, run)
        # Figures come last.
        if not (run / "results.json").exists() or not (run / "figures").exists():
            _call("jaxsafe.train", [f"resume={run}"])
    else:
        _call("jaxsafe.train", [*item.words, f"out={run}"])
    return run


def evaluate(item: Item, run: Path, episodes: int, render: bool) -> None:
    """Do the evaluations of a run that are still to do, and film its best policy.

    Raises:
        ConfigError: an evaluation failed.
        KeyboardInterrupt: the user stopped it.
    """
    if item.kind == "engineered_features" and not (run / BEST).exists():
        best = best_seed(read_results(run / "results.json"))
        write_bytes(run / BEST, (run / "policy" / f"seed_{best}.npz").read_bytes())
    for name, options in item.evaluations.items():
        out = item.evaluation_directory(run, name)
        if not (out / "results.json").exists() or not answers(
            options, read_json(out / "results.json", {})
        ):
            # The directory is of an evaluation that was interrupted or had other options.
            shutil.rmtree(out, ignore_errors=True)
            _call(
                "jaxsafe.evaluate",
                [f"run={item.subject(run, name)}", f"episodes={episodes}", *options, f"out={out}"],
            )
    film = run / "film"
    if render and not (film / FILM_FILE).exists():
        shutil.rmtree(film, ignore_errors=True)
        _call("jaxsafe.evaluate", [f"run={run / BEST}", *FILM, f"out={film}"])


def answers(options: Sequence[str], results: Mapping[str, Any]) -> bool:
    """Return whether an evaluation had these options, according to its results.

    The options follow `jaxsafe evaluate run=…`.
    """
    asked = Options.parse(["run=RUN", *options])
    return results.get("changes") == asked.changes and (
        results.get("evaluation_seed") == asked.seed
    )


def options_of(item: Item) -> dict[str, Any]:
    """Return every option of an item's training and environment, as `config.yaml` has them.

    The options in `PLACES` are left out.
    """
    config, env, _ = resolve(Arguments.parse(item.words).options)
    return _without(described(config, env), training=PLACES)


def same_options(item: Item, content: Mapping[str, Any], place: str) -> bool:
    """Return whether a training, maybe by an older version, had the options that an item has today.

    An option that is newer than the training has its default. Options that change no number are
    left out: where the run went, whose recipe it was, and which numbers would follow others.

    Args:
        item: what would be trained today.
        content: the content of a `config.yaml`, or what `options_of` once returned.
        place: what stands before places in error messages.

    Raises:
        ConfigError: the content cannot be read.
    """
    left_out = {"training": (*PLACES, "recipe", "like"), "environment": ("tied",)}
    trained = described(*from_described(content, place))
    return _without(trained, **left_out) == _without(options_of(item), **left_out)


PLACES = ("out", "wandb", "mlflow")
"""Options that say where a run and its progress go."""


def _without(content: Mapping[str, Any], **left_out: Sequence[str]) -> dict[str, Any]:
    """Return the content of a `config.yaml` without some keys of its parts."""
    return {
        part: {key: value for key, value in values.items() if key not in left_out.get(part, ())}
        for part, values in content.items()
    }


def _refuse_other(item: Item, run: Path) -> None:
    """Refuse a run with other options, whose numbers must not pass as those of a new recipe.

    Raises:
        ConfigError: the run has other options.
    """
    if not same_options(item, read_content(run), f"{run / 'config.yaml'}: "):
        raise ConfigError(
            f"runs: {run} was trained with other options; remove it, or give another directory"
        )


def _call(module: str, words: Sequence[str]) -> None:
    """Run a command of jaxsafe.

    Raises:
        ConfigError: the command failed.
        KeyboardInterrupt: the user stopped it.
    """
    print(f"\n$ python -m {module} {shlex.join(words)}", flush=True)
    code = _wait(subprocess.Popen([sys.executable, "-m", module, *words]))
    if code in (INTERRUPTED, -signal.SIGTERM):
        raise KeyboardInterrupt
    if code:
        raise ConfigError(f"python -m {module} {shlex.join(words)}: ended with code {code}")


def _wait(process: subprocess.Popen) -> int:
    """Wait for a process and return its exit code.

    A termination of this process is passed on. Ctrl-C reaches both processes. Then the other one
    has the time to save what it has.
    """
    if not in_main_thread():
        return process.wait()
    previous = signal.signal(signal.SIGTERM, lambda *_: process.terminate())
    try:
        try:
            return process.wait()
        except KeyboardInterrupt:
            process.wait()
            raise
    finally:
        signal.signal(signal.SIGTERM, previous)
