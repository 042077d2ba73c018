"""Where a policy shall act: in the environment in which it was trained, changed by options, or in another that fits it."""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxsafe.config.arguments import Arguments
from jaxsafe.environment import Environment
from jaxsafe.envs import adapt, make
from jaxsafe.schema.convert import to_data
from jaxsafe.schema.errors import ConfigError

OPTIONS = ("env", "actions", "variant", "rta", "env.…")
"""The options of a command that say where a policy acts."""


class EnvironmentChoice(NamedTuple):
    """What a command says of the environment."""

    task: str | None  # a name or a file; None is the environment in which the policy was trained
    options: dict[str, Any]  # those given of actions, variant and rta
    overrides: dict[str, Any]  # new values by dotted path

    @classmethod
    def pop(cls, arguments: Arguments) -> EnvironmentChoice:
        """Take what is said out of a command line."""
        task, overrides = arguments.pop_text("env"), arguments.pop_overrides()
        given = {name: arguments.pop_text(name) for name in ("actions", "variant", "rta")}
        return cls(
            task, {name: value for name, value in given.items() if value is not None}, overrides
        )

    @property
    def changes(self) -> dict[str, Any]:
        """All that is said, for the results."""
        return {
            **({} if self.task is None else {"env": self.task}),
            **self.options,
            **self.overrides,
        }

    def make(self) -> Environment:
        """Return the environment of a task; raises as `jaxsafe.make`."""
        return make(str(self.task), self.overrides, **self.options)

    def change(self, trained: Environment, name: str, run: str) -> Environment:
        """Return the environment for the policies of a run.

        Args:
            trained: the environment in which they were trained.
            name: of that environment.
            run: where they are from.

        Raises:
            ConfigError: what is said is wrong, or the observation or the action is not theirs.
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
    """Return a line about what a policy sees or does by the same name, but defined otherwise than where it was trained.

    Empty if there is nothing of the kind.
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
