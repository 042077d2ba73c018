"""The run directory. It is made once, never overwritten, and complete enough to go on from."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jaxsafe.config
from jaxsafe.agents.policy_file import meant_policy, with_networks
from jaxsafe.environment import Environment
from jaxsafe.envs import TASKS, user_module
from jaxsafe.schema import yaml12
from jaxsafe.schema.component import normalise
from jaxsafe.schema.convert import to_component, to_data, to_value
from jaxsafe.schema.dotted_paths import set_path
from jaxsafe.schema.errors import ConfigError, choices_text
from jaxsafe.schema.user_modules import import_modules, modules
from jaxsafe.storage.files import write_text
from jaxsafe.storage.provenance import commit, versions
from jaxsafe.train.host.options import RENAMED, TrainConfig
from jaxsafe.train.host.run_config import read_content


def create(config: TrainConfig, env: Environment, name: str) -> Path:
    """Make a directory for a new run, and write `config.yaml`.

    Args:
        config: the configuration of the run. Without `out`, the directory gets the next free name
            in `runs/`.
        env: the environment.
        name: the name of the environment.

    Raises:
        ConfigError: `out` already holds something, or cannot be written.
    """
    path = make(config.out, Path("runs"), name)
    content = {"env": name, **described(config, env), "commit": commit(), "versions": versions()}
    environment = content["environment"]
    # When the run is read, the module of a task registers it, so its filters are known by name.
    module = user_module(name)
    imports = {*environment.get("imports", []), *modules(config), *([module] if module else [])}
    if imports:
        content["environment"] = {**environment, "imports": sorted(imports)}
    try:
        write_text(path / "config.yaml", yaml12.write(content))
    except OSError as error:
        raise ConfigError(f"out: cannot write {error.filename}: {error.strerror}") from None
    return path


def described(config: TrainConfig, env: Environment) -> dict[str, Any]:
    """Return all that decides a training, as data."""
    return {"training": to_data(config), "environment": jaxsafe.config.describe(env)}


def create_all(resolved: Sequence[tuple[TrainConfig, Environment, str]]) -> Path:
    """Make the directory of one run, or one for several runs with a directory for each in it.

    Args:
        resolved: configuration, environment and name of each run, as `create` takes them.

    Raises:
        ConfigError: `out` already holds something, or cannot be written.
    """
    if len(resolved) == 1:
        return create(*resolved[0])
    path = make(resolved[0][0].out, Path("runs"), "all")
    for config, env, name in resolved:
        create(config.replace(out=str(path / name)), env, name)
    return path


def runs(path: Path) -> list[Path]:
    """Return the runs in a directory, or the path itself if it is a run or has none.

    The tasks come first, in their order. Other runs follow by name.
    """
    inside = sorted(file.parent for file in path.glob("*/config.yaml"))
    if (path / "config.yaml").is_file() or not inside:
        return [path]
    order = [*TASKS]
    return sorted(
        inside, key=lambda run: order.index(run.name) if run.name in order else len(order)
    )


def make(out: str | None, parent: Path, name: str) -> Path:
    """Make a directory for a run.

    A file that a kill left half written does not count as something in the directory.

    Args:
        out: the directory that the user asks for. None stands for the next free one.
        parent: the directory in which to make the next free one.
        name: the name of the next free one. It gets a number if it is taken.

    Raises:
        ConfigError: `out` already holds something, or cannot be written.
    """
    if os.sep == "/" and "\\" in os.path.abspath(out or parent / name):
        raise ConfigError(
            "out: expected a path without \\, which checkpoints take for /, "
            f"found {out or parent / name}"
        )
    try:
        path = Path(out) if out else _next_free(parent, name)
        if path.exists() and (
            not path.is_dir() or any(file.suffix != ".part" for file in path.iterdir())
        ):
            advice = "choose an empty one"
            if (path / "config.yaml").exists():
                advice = f"continue it with resume={path}"
            if (path / "results.json").exists():
                advice = (
                    f"it is a finished run, which jaxsafe.open_run({str(path)!r}) opens and "
                    f"resume={path} steps=… trains for longer"
                )
            raise ConfigError(
                f"out: {path} already holds something and is never overwritten; {advice}"
            )
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"out: cannot write {error.filename}: {error.strerror}") from None
    return path


def read(path: Path, option: str) -> tuple[TrainConfig, Environment, str]:
    """Return the configuration of an existing run, its environment and the environment's name.

    Args:
        path: the run directory.
        option: the option by which the user named it, for the message.

    Raises:
        ConfigError: there is no run, or its `config.yaml` cannot be read.
    """
    if not (path / "config.yaml").is_file():
        beside = (
            [str(file.parent) for file in path.parent.glob("*/config.yaml")]
            if path.parent.is_dir()
            else []
        )
        hint = choices_text(str(path), sorted(beside)) if beside else ""
        if option == "run" and (meant := meant_policy(str(path))):
            hint = f". Did you mean {meant!r}?"
        raise ConfigError(f"{option}: no run in {str(path)!r} (a directory with config.yaml){hint}")
    content = read_content(path)
    config, env = from_described(content, f"{path / 'config.yaml'}: ")
    name = str(content["env"])
    return config, env.named(name), name


def from_described(content: Mapping[str, Any], place: str) -> tuple[TrainConfig, Environment]:
    """Return the configuration and the environment from data that `described` returned.

    An earlier version may have written the data. Options that it called otherwise are understood,
    and options that it lacked have their defaults.

    Args:
        content: the data.
        place: what stands before the places in error messages.

    Raises:
        ConfigError: the data cannot be read.
    """
    # The environment names the modules in which the parts of both are.
    import_modules(content["environment"].get("imports", []), f"{place}environment")
    training = content["training"]
    if "agent" in training:
        training = {**training, "agent": with_networks(training["agent"])}
    old_names = RENAMED["rta_training"]
    if training.get("rta_training") in old_names:
        training = {**training, "rta_training": old_names[training["rta_training"]]}
    config = normalise(to_component(training, TrainConfig, f"{place}training"))
    return config, jaxsafe.config.from_data(content["environment"], f"{place}environment")


def extend(runs: Sequence[Path], steps: Any) -> None:
    """Let runs train for more steps, even if they have ended. Schedules run over the new number.

    The results of a run that has ended are kept as `results_STEPS.json`. It trains for all of its
    steps then, also if it has ended early by `stop_at_success`.

    Args:
        runs: the run directories.
        steps: the new number of environment steps of each seed.

    Raises:
        ConfigError: the number is not larger than that of a run now, or a directory holds no run.
    """
    configs = {run: read(run, "resume")[0] for run in runs}
    longer = {run: set_path(config, "steps", steps, to_value) for run, config in configs.items()}
    for run, config in configs.items():
        if longer[run].num_updates <= config.num_updates:
            raise ConfigError(f"steps: expected more than the {config.steps:,} of {run}")
    for run, config in configs.items():
        if (run / "results.json").exists():
            (run / "results.json").rename(run / f"results_{config.steps}.json")
            longer[run] = longer[run].replace(stop_at_success=None)
        content = read_content(run)
        content["training"]["steps"] = longer[run].steps
        content["training"]["stop_at_success"] = longer[run].stop_at_success
        write_text(run / "config.yaml", yaml12.write(content))


def discard_unused(path: Path) -> None:
    """Remove the directory of a run if nothing was written to it since it was made.

    A training that failed before it began leaves no run.
    """
    if all(
        entry.is_dir() or entry.name in ("config.yaml", "sweep.yaml") for entry in path.rglob("*")
    ):
        shutil.rmtree(path, ignore_errors=True)


def _next_free(parent: Path, name: str) -> Path:
    """Make and return the next free directory.

    It is made here, so that no other process takes it too.
    """
    parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        path = parent / (name if number == 1 else f"{name}-{number}")
        with contextlib.suppress(FileExistsError):
            path.mkdir()
            return path
        number += 1
