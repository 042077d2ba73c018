"""Choice of the environment in which a policy acts.

A policy acts in the environment in which it was trained, in that environment changed by options, or
in another environment that fits it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxsafe.config.arguments import Arguments
from jaxsafe.environment import Environment
from jaxsafe.envs import adapt, make
from jaxsafe.schema.convert import to_data
from jaxsafe.schema.errors import ConfigError

OPTIONS = ("env", "actions", "variant", "rta", "env.…")
"""Options of a command that say in which environment a policy acts."""


class EnvironmentChoice(NamedTuple):
    """The environment that a command line asks for."""

    task: str | None
    """Name or file of a task. None stands for the environment in which the policy was trained."""

    options: dict[str, Any]
    """Values of `actions`, `variant` and `rta`. An option that was not given is left out."""

    overrides: dict[str, Any]
    """New values by dotted path."""

    @classmethod
    def pop(cls, arguments: Arguments) -> EnvironmentChoice:
        """Take the choice of an environment out of a command line."""
        task, overrides = arguments.pop_text("env"), arguments.pop_overrides()
        given = {name: arguments.pop_text(name) for name in ("actions", "variant", "rta")}
        return cls(
            task, {name: value for name, value in given.items() if value is not None}, overrides
        )

    @property
    def changes(self) -> dict[str, Any]:
        """Everything that the command line says about the environment, for the results."""
        return {
            **({} if self.task is None else {"env": self.task}),
            **self.options,
            **self.overrides,
        }

    def make(self) -> Environment:
        """Return the environment of the task.

        Raises:
            ConfigError: `jaxsafe.make` refuses the task, an option or an override.
        """
        return make(str(self.task), self.overrides, **self.options)

    def change(self, trained: Environment, name: str, run: str) -> Environment:
        """Return the environment in which the policies of a run act.

        Args:
            trained: the environment in which the policies were trained.
            name: the name of that environment.
            run: the run from which the policies come, for error messages.

        Raises:
            ConfigError: an option or an override is wrong, or the environment has another
                observation or action than the policies.
        """
        env = (
            adapt(trained, name, self.overrides, **self.options)
            if self.task is None
            else self.make()
        )
        for what in ("observation_names", "action_names", "num_action_points"):
            found, needed = getattr(env, what), getattr(trained, what)
            if found != needed:
                kind = "discrete" if trained.num_action_points else "continuous"
                advice = (
                    f"; give actions={kind}"
                    if bool(env.num_action_points) != bool(trained.num_action_points)
                    else ""
                )
                where = "the change gives" if self.task is None else f"{self.task} has"
                raise ConfigError(
                    f"env: {where} {what} {found}, the policies of {run} have {needed}{advice}"
                )
        return env


def differences(trained: Environment, env: Environment) -> str:
    """Return a line about observations and actuators that are defined otherwise than in training.

    Such a part has the same name in both environments. The line is empty if there is no such part.

    Args:
        trained: the environment in which a policy was trained.
        env: the environment in which the policy acts.
    """
    found = []
    pairs = {
        "observation": (trained.observation, env.observation),
        "actuator": (trained.actuators, env.actuators),
    }
    for what, (before, after) in pairs.items():
        known = {part.name: to_data(part) for part in before}
        found += [f"{what} {part.name}" for part in after if to_data(part) != known.get(part.name)]
    return f"defined otherwise than in training: {', '.join(found)}" if found else ""
