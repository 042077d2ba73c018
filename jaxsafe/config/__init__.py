"""Environments as YAML, with `load` and `dump`, and overrides by dotted paths.

The tasks themselves are Python and stand in `jaxsafe.envs`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxsafe.config.check import check
from jaxsafe.config.override import override
from jaxsafe.config.tied import settle
from jaxsafe.environment import Environment, require_environment
from jaxsafe.rta.filter import RTA
from jaxsafe.schema.component import normalise
from jaxsafe.schema.convert import DIRECTORY, to_component, to_data
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.schema.user_modules import import_modules, modules

__all__ = [
    "build",
    "describe",
    "dump",
    "from_data",
    "load",
    "load_filter",
    "load_recipe_name",
    "load_recipes",
    "override",
]


def build(env: Environment) -> Environment:
    """Return a declared environment ready for use.

    Its numbers become arrays, and its parts are checked. A tied number is set to what it follows.

    Raises:
        ConfigError: one line that names the part that does not fit and what is allowed.
    """
    return check(settle(normalise(env)))


def load(source: str | os.PathLike) -> Environment:
    """Read an environment from a YAML file, or from the YAML text that `dump` returns.

    The modules listed under `imports` are imported first, so that the file can name the components
    that they define. The entries `recipe` and `recipes` are not read here but by `load_recipe_name`
    and `load_recipes`.

    Args:
        source: the path of a file, or a text of more than one line.

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    from jaxsafe.schema import yaml12

    text = isinstance(source, str) and "\n" in source
    data = yaml12.parse(str(source), "environment") if text else yaml12.read(source)
    directory = DIRECTORY.set(Path() if text else Path(source).parent)
    try:
        return from_data(_without_recipes(data), "")
    except ConfigError as error:
        if text:
            raise
        raise _in_file(source, error) from error
    finally:
        DIRECTORY.reset(directory)


def load_filter(path: str | os.PathLike) -> RTA:
    """Read a run time assurance filter from a YAML file.

    Args:
        path: a file with an environment, whose filter is taken, or a file with only what stands
            under `rta` in an environment. Both kinds of file may begin with `imports`.

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    from jaxsafe.schema import yaml12

    data = _imported(yaml12.read(path), f"{path}: rta")
    if not isinstance(data, dict) or "platforms" not in data:
        return to_component(data, RTA, f"{path}: rta")
    try:
        rta = build(to_component(_without_recipes(data), Environment, "")).rta
    except ConfigError as error:
        raise _in_file(path, error) from error
    if rta is None:
        raise ConfigError(f"rta: {path} is an environment without a filter; rta=none is for none")
    return rta


def _in_file(path: str | os.PathLike, error: ConfigError) -> ConfigError:
    """Return the error with the name of the file that it concerns before its message."""
    return type(error)(f"{os.fspath(path)}: {error}")


def load_recipes(path: str | os.PathLike) -> dict[str, dict[str, Any]]:
    """Read the recipes that a YAML file has for training in its environment.

    Args:
        path: a file with an environment, whose recipes stand under `recipes`, or with recipes
            alone.

    Returns:
        The options of each recipe by its name. It is empty for an environment without `recipes`.

    Raises:
        ConfigError: the file cannot be read, or its recipes are no mappings.
    """
    from jaxsafe.schema import yaml12

    data = yaml12.read(path)
    alone = isinstance(data, Mapping) and not {"platforms", "recipe", "recipes"} & set(data)
    recipes = data.get("recipes", {}) if isinstance(data, Mapping) and not alone else data
    if not isinstance(recipes, Mapping) or not all(
        options is None or isinstance(options, Mapping) for options in recipes.values()
    ):
        raise ConfigError(
            f"{path}: recipes: expected names, each with options of a training, "
            f"found {show(recipes)}"
        )
    return {str(name): dict(options or {}) for name, options in recipes.items()}


def load_recipe_name(path: str | os.PathLike) -> str | None:
    """Read the name of the task or file whose recipes a YAML file with an environment uses.

    Returns:
        The entry `recipe`, or None if there is none. A path in it begins at the directory of the
        YAML file. It is returned so that it can be opened from the current directory.

    Raises:
        ConfigError: the file cannot be read, it names no text, or it has recipes of its own too.
    """
    from jaxsafe.schema import yaml12

    data = yaml12.read(path)
    name = data.get("recipe") if isinstance(data, Mapping) else None
    if name is None:
        return None
    if not isinstance(name, str):
        raise ConfigError(f"{path}: recipe: expected a task or a file, found {show(name)}")
    if "recipes" in data:
        raise ConfigError(f"{path}: recipe: the file has recipes of its own; leave one out")
    if not name.endswith((".yaml", ".yml")):
        return name
    return os.path.normpath(os.path.join(os.path.dirname(path), name))


def _without_recipes(data: Any) -> Any:
    if not isinstance(data, Mapping):
        return data
    return {name: value for name, value in data.items() if name not in ("recipe", "recipes")}


def dump(env: Environment) -> str:
    """Return the complete environment as YAML text, so that `load(dump(env)) == env`."""
    from jaxsafe.schema import yaml12

    require_environment("dump: env", env)
    return yaml12.write(describe(env))


def describe(env: Environment) -> dict[str, Any]:
    """Return the complete environment as plain data.

    If modules outside jaxsafe define parts of it, the data begin with the names of these modules.
    """
    needed = modules(env)
    return ({"imports": needed} if needed else {}) | to_data(env)


def from_data(data: Any, place: str) -> Environment:
    """Read an environment from the plain data that `describe` returns.

    Args:
        data: the plain data.
        place: the place of the data, with which error messages begin.

    Raises:
        ConfigError: one line that names the place, what was found and what is allowed.
    """
    return build(to_component(_imported(data, place), Environment, place))


def _imported(data: Any, place: str) -> Any:
    """Import the modules that `imports` lists, and return the data without this entry."""
    if not isinstance(data, dict) or "imports" not in data:
        return data
    import_modules(data["imports"], place)
    return {name: value for name, value in data.items() if name != "imports"}
