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
    """What a command says of a policy from elsewhere."""

    path: Path
    choice: EnvironmentChoice
    activation: str

    @property
    def task(self) -> str:
        """The name of the environment in which it shall act."""
        return short_name(self.choice.task or "")

    def read(self) -> ForeignPolicy:
        """Read it; raises a ConfigError if there is no such environment, or as `read_foreign` does."""
        return read_foreign(self.path, self.choice.make(), self.activation)


def pop_source(arguments: Arguments, run: str, choice: EnvironmentChoice) -> Source | None:
    """Take `activation` of a command; None if `run` is a policy of our own.

    Raises:
        ConfigError: the options do not fit each other.
    """
    names = _names(run) if run.endswith(".npz") else set()
    graph = run.endswith(".onnx")
    if choice.task is None and (graph or "kernel_0.npy" in names):
        raise ConfigError(
            f"env: missing; the task in which {run} shall act, for instance env=docking2d"
        )
    layers = (
        choice.task is not None and run.endswith(".npz") and "header.npy" not in names
    )  # which policies of ours have
    arguments.refuse_beside(
        [] if layers else ["activation"], "but for the layers in an .npz with env=TASK"
    )
    activation = arguments.pop_text("activation") or "tanh"
    return Source(Path(run), choice, activation) if graph or layers else None


def _names(path: str) -> set[str]:
    """Return what an archive holds, without reading any of it; nothing if there is none."""
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist())
    except Exception:  # whatever it is, reading it tells more
        return set()
