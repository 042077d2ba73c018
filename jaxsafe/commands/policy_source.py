"""Policies that were trained elsewhere, as a command names them."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import NamedTuple

from jaxsafe.agents.imported_policy import ForeignPolicy, read_foreign
from jaxsafe.commands.environment_choice import EnvironmentChoice
from jaxsafe.config.arguments import Arguments
from jaxsafe.envs import short_name
from jaxsafe.schema.errors import ConfigError


class Source(NamedTuple):
    """A policy that was trained elsewhere, as a command line describes it."""

    path: Path
    """File of the policy."""

    choice: EnvironmentChoice
    """Environment in which the policy shall act."""

    activation: str
    """Name of the function between the layers in an .npz."""

    @property
    def task(self) -> str:
        """Name of the environment in which the policy shall act."""
        return short_name(self.choice.task or "")

    def read(self) -> ForeignPolicy:
        """Return the policy.

        Raises:
            ConfigError: there is no such environment, or `read_foreign` refuses the policy.
        """
        return read_foreign(self.path, self.choice.make(), self.activation)


def pop_source(arguments: Arguments, run: str, choice: EnvironmentChoice) -> Source | None:
    """Take the description of a policy from elsewhere out of a command line.

    Args:
        arguments: the command line, out of which `activation` is taken.
        run: the policy file.
        choice: the environment in which the policy shall act.

    Returns:
        The policy from elsewhere, or None if `run` is a policy of our own.

    Raises:
        ConfigError: the options do not fit each other.
    """
    names = _names(run) if run.endswith(".npz") else set()
    graph = run.endswith(".onnx")
    if choice.task is None and (graph or "kernel_0.npy" in names):
        raise ConfigError(
            f"env: missing; the task in which {run} shall act, for instance env=docking2d"
        )
    # Policies of our own have a header.
    layers = choice.task is not None and run.endswith(".npz") and "header.npy" not in names
    arguments.refuse_beside(
        [] if layers else ["activation"], "but for the layers in an .npz with env=TASK"
    )
    activation = arguments.pop_text("activation") or "tanh"
    return Source(Path(run), choice, activation) if graph or layers else None


def _names(path: str) -> set[str]:
    """Return the names of the entries of an archive. There are none if there is no archive.

    The entries are not read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist())
    # Whatever is wrong with the file, reading it later tells more.
    except Exception:
        return set()
