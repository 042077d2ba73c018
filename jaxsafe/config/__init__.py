"""Environments as YAML: `load`, `dump`, and dotted-path overrides. The tasks themselves are Python, in `jaxsafe.envs`."""

from __future__ import annotations

import os
from typing import Any

from jaxsafe.config.check import check
from jaxsafe.config.override import override
from jaxsafe.config.tied import warn_of_ties
from jaxsafe.environment import Environment
from jaxsafe.rta.filter import RTA
from jaxsafe.schema.component import normalise
from jaxsafe.schema.convert import to_component, to_data
from jaxsafe.schema.errors import ConfigError
from jaxsafe.schema.user_modules import import_modules, modules

__all__ = ["build", "describe", "dump", "from_data", "load", "load_filter", "override"]


def build(env: Environment) -> Environment:
    """Make a declared environment ready for use: numbers become arrays, and its parts are checked."""
    return check(normalise(env))


def load(source: str | os.PathLike) -> Environment:
    """Read an environment from a YAML file, or from the YAML text that `dump` returns.

    Modules under `imports` are imported first, so that the components which they define can be named.

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    from jaxsafe.schema import yaml12

    text = isinstance(source, str) and "\n" in source
    data = yaml12.parse(str(source), "environment") if text else yaml12.read(source)
    env = from_data(data, "")
    warn_of_ties(env.replace(randomize={}), env)
    return env


def load_filter(path: str | os.PathLike) -> RTA:
    """Read a run time assurance filter from a YAML file: what stands under `rta` in an environment, or an environment.

    Of an environment its filter is taken. A filter alone may begin with `imports`, as an environment may.

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    from jaxsafe.schema import yaml12

    data = yaml12.read(path)
    if isinstance(data, dict) and "imports" in data:
        data = dict(data)
        import_modules(data.pop("imports"), f"{path}: rta")
    if not isinstance(data, dict) or "platforms" not in data:
        return to_component(data, RTA, f"{path}: rta")
    found = build(to_component(data, Environment, f"{path}: environment")).rta
    if found is None:
        raise ConfigError(f"rta: {path} is an environment without a filter; rta=none is for none")
    return found


def dump(env: Environment) -> str:
    """The complete environment as YAML text, so that `load(dump(env)) == env`."""
    from jaxsafe.schema import yaml12

    return yaml12.write(describe(env))


def describe(env: Environment) -> dict[str, Any]:
    """The complete environment as plain data, beginning with the modules outside jaxsafe that define parts of it."""
    needed = modules(env)
    return ({"imports": needed} if needed else {}) | to_data(env)


def from_data(data: Any, place: str) -> Environment:
    """Read what `describe` returns; `place` begins the messages of errors.

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    if isinstance(data, dict) and "imports" in data:
        data = dict(data)
        import_modules(data.pop("imports"), place)
    return build(to_component(data, Environment, place))
