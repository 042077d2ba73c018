"""Changing an environment by dotted paths: `reward.delta_v.scale`, `deputy.mass`, `terminal.timeout.limit`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxsafe.component import Component, fields
from jaxsafe.config.check import check
from jaxsafe.config.convert import join, to_value
from jaxsafe.environment import Environment
from jaxsafe.errors import ConfigError, nearest


def override(env: Environment, changes: Mapping[str, Any]) -> Environment:
    """Return the environment with the values at dotted paths replaced.

    A path walks through field names, the names of the things in a list, and, at the start, platform names. Values may be
    traced, so a sweep is `jax.vmap(lambda w: f(override(env, {"reward.delta_v.scale": w})))(weights)` and a gradient with
    respect to a parameter is `jax.grad` of the same.

    Raises:
        ConfigError: a path leads nowhere, or a value has the wrong type, shape or range.
    """
    for path, value in changes.items():
        env = set_path(env, path, value)
    return check(env)


def set_path(component: Any, path: str, value: Any) -> Any:
    """Return the component with the value at one dotted path replaced; nothing else is checked."""
    return _set(component, path.split("."), value, "")


def _set(component: Any, path: list[str], value: Any, place: str) -> Any:
    head, rest = path[0], path[1:]
    table = fields(type(component))
    platforms = [platform.name for platform in component.platforms] if isinstance(component, Environment) else []
    if head not in table and head in platforms:
        return component.replace(platforms=_set_item(component.platforms, path, value, place))
    if head not in table:
        raise ConfigError(f"{join(place, head)}: unknown field {head!r}; choose from {nearest(head, [*table, *platforms])}")
    here, inner = join(place, head), getattr(component, head)
    if not rest:
        return component.replace(**{head: to_value(value, table[head], here)})
    if isinstance(inner, Component):
        return component.replace(**{head: _set(inner, rest, value, here)})
    if isinstance(inner, tuple):
        return component.replace(**{head: _set_item(inner, rest, value, here)})
    if isinstance(inner, Mapping) and len(rest) == 1:
        if rest[0] not in inner:
            raise ConfigError(f"{here}: unknown name {rest[0]!r}; choose from {nearest(rest[0], inner)}")
        return component.replace(**{head: to_value({**inner, rest[0]: value}, table[head], here)})
    raise ConfigError(f"{join(here, rest[0])}: {here} has no fields" + (" because it is not set" if inner is None else ""))


def _set_item(items: tuple, path: list[str], value: Any, place: str) -> tuple:
    names = [getattr(item, "name", str(index)) for index, item in enumerate(items)]
    if path[0] not in names:
        raise ConfigError(f"{join(place, path[0])}: unknown name {path[0]!r}; choose from {nearest(path[0], names)}")
    if len(path) == 1:
        raise ConfigError(
            f"{join(place, path[0])}: name one of its fields: {', '.join(fields(type(items[names.index(path[0])])))}"
        )
    index = names.index(path[0])
    return (*items[:index], _set(items[index], path[1:], value, join(place, path[0])), *items[index + 1 :])
