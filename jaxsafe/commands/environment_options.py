"""Options that say in which environment a command works."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from jaxsafe.commands.options import CommandOptions, Option
from jaxsafe.environment import Environment
from jaxsafe.envs import adapt, default_filter, unchanged

Actions = Annotated[Literal["continuous", "discrete", "mixed"], Option(kind="kind")]
"""Name of a kind of actions."""

Variant = Annotated[Literal["paper", "released"], Option(kind="variant")]
"""Name of a variant of a task."""

Overrides = Annotated[Mapping[str, Any], Option(prefix="env.", placeholder="PATH", takes="a value")]
"""New values of fields of the environment, by dotted path."""


class EnvironmentOptions(CommandOptions):
    """The options of a command that works in an environment."""

    actions: Actions | None = None
    """The kind of actions. By default it is what the environment says."""
    variant: Variant | None = None
    """The variant of a task: as the paper describes it, or as its code was released."""
    rta: str | None = None
    """Run time assurance: none, default, another preset of the task, or a file.

    The file holds a filter, or an environment whose filter is taken. By default it is what the
    environment says.
    """
    overrides: Overrides
    """Change one field of the environment, for instance env.deputy.mass=14."""

    @property
    def choices(self) -> dict[str, Any]:
        """Values of `actions`, `variant` and `rta`. An option that was not given is left out."""
        options = {"actions": self.actions, "variant": self.variant, "rta": self.rta}
        return {name: value for name, value in options.items() if value is not None}

    def make(self, task: str) -> Environment:
        """Return an environment.

        Args:
            task: a task or a file.

        Raises:
            ConfigError: `jaxsafe.make` refuses the task, an option or an override.
        """
        return adapt(unchanged(task), task, self.overrides, place="env", **self.choices)


class TaskOptions(EnvironmentOptions):
    """The options of a command that needs an environment and no policy."""

    env: Annotated[str, Option(first=True, examples=("env=docking3d",))]
    """A task, such as docking3d, or the file of an environment, such as mine.yaml."""

    def filter_or_default(self) -> str | None:
        """Return the option `rta`, or what `default_filter` returns if it is not given."""
        return self.rta or default_filter(self.env)
