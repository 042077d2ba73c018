"""Options that say which policies act, and in which environment.

A policy acts in the environment in which it was trained, in that environment changed by options, or
in another environment that fits it.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Annotated, Any

from jaxsafe.agents.callables import is_callable, read_callable
from jaxsafe.agents.imported_policy import ACTIVATIONS, ForeignPolicy, read_foreign
from jaxsafe.commands.environment_options import EnvironmentOptions
from jaxsafe.commands.options import Option
from jaxsafe.environment import Environment
from jaxsafe.envs import TASKS, adapt, short_name
from jaxsafe.schema.convert import to_data
from jaxsafe.schema.errors import ConfigError


class PolicyOptions(EnvironmentOptions):
    """The options of a command that takes policies."""

    run: Annotated[
        str, Option(first=True, examples=("run=runs/docking3d", "run=pretrained/docking3d"))
    ]
    """A run directory, a policy file (.npz), or pretrained/TASK for one that comes with jaxsafe.

    With env=TASK it may also be controller/NAME for a classical controller of the task, or
    MODULE:NAME for a function policy(key, observation) of your own. Or it is a policy from
    elsewhere: an .onnx file, or an .npz with the layers kernel_0, bias_0, kernel_1, … Add
    actions=discrete if it returns logits.
    """
    env: str | None = None
    """Another environment with the same observation and action: a task or a file.

    By default the policy acts where it was trained.
    """
    activation: Annotated[str, Option(names=tuple(ACTIVATIONS))] = "tanh"
    """The activation function between the layers of an .npz from elsewhere."""

    @property
    def changes(self) -> dict[str, Any]:
        """Everything that the command line says about the environment, for the results."""
        return {
            **({} if self.env is None else {"env": self.env}),
            **self.choices,
            **self.overrides,
        }

    @property
    def task(self) -> str:
        """Name of the environment in which a policy from elsewhere acts."""
        return short_name(self.env or "")

    def is_foreign(self) -> bool:
        """Return whether the policy was trained elsewhere, or not at all.

        Raises:
            ConfigError: the options do not fit the policy.
        """
        if self.run in TASKS and not Path(self.run).exists():
            raise ConfigError(
                f"run: {self.run} is a task; name a run of it, "
                f"or pretrained/{self.run} for the policy that comes with jaxsafe"
            )
        named = is_callable(self.run)
        names = _names(self.run) if self.run.endswith(".npz") else set()
        graph = self.run.endswith(".onnx")
        if self.env is None and (named or graph or "kernel_0.npy" in names):
            raise ConfigError(
                f"env: missing; the task in which {self.run} shall act, for instance env=docking2d"
            )
        # Policies of our own have a header.
        layers = self.env is not None and self.run.endswith(".npz") and "header.npy" not in names
        self.refuse_beside(
            [] if layers else ["activation"], "but for the layers in an .npz with env=TASK"
        )
        return named or graph or layers

    def read_foreign(self) -> ForeignPolicy:
        """Return the policy, which was trained elsewhere or not at all.

        Raises:
            ConfigError: there is no such environment or policy, or the policy does not fit.
        """
        env = self.make(str(self.env))
        if is_callable(self.run):
            return read_callable(self.run, env)
        return read_foreign(Path(self.run), env, self.activation)

    def change(self, trained: Environment, name: str) -> Environment:
        """Return the environment in which the policies of a run act.

        Args:
            trained: the environment in which the policies were trained.
            name: the name of that environment.

        Raises:
            ConfigError: an option or an override is wrong, or the environment has another
                observation or action than the policies.
        """
        env = (
            adapt(trained, name, self.overrides, place="env", **self.choices)
            if self.env is None
            else self.make(self.env)
        )
        for what in ("observation_names", "action_names", "num_action_points"):
            found, needed = getattr(env, what), getattr(trained, what)
            if found != needed:
                kind = trained.action_kind
                advice = f"; give actions={kind}" if env.action_kind != kind else ""
                where = "the change gives" if self.env is None else f"{self.env} has"
                raise ConfigError(
                    f"env: {where} {what} {found}, the policies of {self.run} have {needed}{advice}"
                )
        return env


def differences(trained: Environment, env: Environment) -> str:
    """Return a line about observations and actuators that are defined otherwise than in training.

    Such a part has the same name in both environments. Without such a part the line is empty.

    Args:
        trained: the environment in which a policy was trained.
        env: the environment in which the policy acts.
    """
    different = []
    pairs = {
        "observation": (trained.observation, env.observation),
        "actuator": (trained.actuators, env.actuators),
    }
    for what, (before, after) in pairs.items():
        trained_as = {part.name: to_data(part) for part in before}
        for part in after:
            if to_data(part) != trained_as.get(part.name):
                different.append(f"{what} {part.name}")
    return f"defined otherwise than in training: {', '.join(different)}" if different else ""


def _names(path: str) -> set[str]:
    """Return the names of the entries of an archive, or no names if there is no archive.

    The entries are not read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist())
    # If something is wrong with the file, the error is better when the file is read later.
    except Exception:
        return set()
