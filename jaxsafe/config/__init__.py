"""Environments as YAML: `load`, `dump`, and dotted-path overrides. The tasks themselves are Python, in `jaxsafe.envs`."""

from __future__ import annotations

import os

from jaxsafe.component import normalise
from jaxsafe.config.check import check
from jaxsafe.config.convert import to_component, to_data
from jaxsafe.config.override import override
from jaxsafe.environment import Environment

__all__ = ["build", "dump", "load", "override"]


def build(env: Environment) -> Environment:
    """Make a declared environment ready for use: numbers become arrays, names are checked."""
    return check(normalise(env))


def load(source: str | os.PathLike) -> Environment:
    """Read an environment from a YAML file, or from the YAML text that `dump` returns.

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    from jaxsafe.config import yaml

    text = isinstance(source, str) and "\n" in source
    data = yaml.parse(str(source), "environment") if text else yaml.read(source)
    return build(to_component(data, Environment, ""))


def dump(env: Environment) -> str:
    """The complete environment as YAML text, so that `load(dump(env)) == env`."""
    from jaxsafe.config import yaml

    return yaml.write(to_data(env))
