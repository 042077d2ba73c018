"""Checks of a composed environment: every name refers to something that exists, and, where order matters, earlier."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import jax
import numpy as np
from jax.core import Tracer

from jaxsafe.component import Component, Refers, fields
from jaxsafe.config.convert import join
from jaxsafe.environment import Environment
from jaxsafe.errors import ConfigError, nearest
from jaxsafe.processors.observation import Observe
from jaxsafe.simulation.controllers import Actuator, Uncontrolled
from jaxsafe.simulation.platform import Platform

_SECTIONS = ("platforms", "regions", "status", "constraints", "terminal", "reward", "observation")


def check(env: Environment) -> Environment:
    """Return the environment unchanged if its parts fit together.

    Raises:
        ConfigError: naming the part that does not fit and what it may refer to.
    """
    names = {section: [part.name for part in getattr(env, section)] for section in _SECTIONS}
    for section, found in names.items():
        _once(section, found)
    _once("outcomes", env.outcomes)
    names["outcomes"] = list(env.outcomes[1:])
    _reference("agent", env.agent, names["platforms"])
    for section in _SECTIONS:
        for index, part in enumerate(getattr(env, section)):
            for place, refers, name in _references(part, f"{section}.{part.name}"):
                ordered = refers.section == section and section in ("platforms", "status")  # later ones are not there yet
                known = names[refers.section][: index if ordered else None]
                _reference(place, name, known, " listed before it" if ordered else "")
    for platform in env.platforms:
        _check_platform(platform, is_agent=platform.name == env.agent)
    _check_space(env)
    for required in ("terminal", "reward", "observation"):
        if not names[required]:
            raise ConfigError(f"{required}: an environment needs at least one")
    return env


def _references(component: Component, place: str) -> Iterator[tuple[str, Refers, str]]:
    for name, field in fields(type(component)).items():
        value, here = getattr(component, name), join(place, name)
        if field.refers and isinstance(value, str):
            yield here, field.refers, value
        if isinstance(value, Mapping):
            yield from ((here, Refers("outcomes"), key) for key in value)
        for inner in value if isinstance(value, tuple) else (value,):
            if isinstance(inner, Component):
                yield from _references(inner, join(here, getattr(inner, "name", "")))


def _reference(place: str, name: str, known: Iterable[str], which: str = "") -> None:
    known = list(known)
    if name not in known:
        raise ConfigError(f"{place}: nothing{which} is called {name!r}; choose from {nearest(name, known) or 'none'}")


def _once(place: str, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{place}: the name {name!r} stands twice")


def _check_space(env: Environment) -> None:
    dimensions = {platform.name: platform.dimension for platform in env.platforms}
    if len(set(dimensions.values())) > 1:
        found = ", ".join(f"{name} {dimension}" for name, dimension in dimensions.items())
        raise ConfigError(f"platforms: expected the same dimension for all, found {found}")
    states = {platform.name: vars(platform.rest()) for platform in env.platforms}
    for item in env.observation:
        if isinstance(item, Observe) and item.what not in states[item.of]:
            raise ConfigError(
                f"observation.{item.name}.what: {item.of} has no state field {item.what!r};"
                f" choose from {nearest(item.what, states[item.of])}"
            )


def _check_actuator(actuator: Actuator, place: str) -> None:
    if any(isinstance(bound, Tracer) for bound in (actuator.low, actuator.high)):
        return
    if np.any(np.asarray(actuator.low) > np.asarray(actuator.high)):
        raise ConfigError(f"{place}: expected low ≤ high, found {actuator.low:g} and {actuator.high:g}")


def _check_platform(platform: Platform, is_agent: bool) -> None:
    place = f"platforms.{platform.name}"
    if sorted(platform.inputs) != sorted(platform.controller.names):
        raise ConfigError(
            f"{place}.controller.actuators: expected {', '.join(platform.inputs) or 'none'},"
            f" found {', '.join(platform.controller.names) or 'none'}"
        )
    if isinstance(platform.controller, Uncontrolled) and platform.controller.actuators:
        raise ConfigError(f"{place}.controller (uncontrolled): takes no actuators")
    if is_agent and not platform.inputs:
        raise ConfigError(f"agent: {platform.name!r} cannot be the agent: it takes no control")
    for actuator in platform.controller.actuators:
        _check_actuator(actuator, f"{place}.controller.actuators.{actuator.name}")
    _once(f"{place}.start", platform.random_fields)
    rest = platform.rest()
    for initializer in platform.start:
        if initializer.name not in vars(rest):
            known = nearest(initializer.name, vars(rest))
            raise ConfigError(f"{place}.start.{initializer.name}: no such state field; choose from {known}")
        if getattr(initializer, "direction", None) is not None:
            drawn = jax.eval_shape(initializer.direction.draw, jax.random.key(0)).shape  # type: ignore[attr-defined]
            if drawn != getattr(rest, initializer.name).shape:
                raise ConfigError(
                    f"{place}.start.{initializer.name}.direction: draws {drawn[0]} numbers, the platform has"
                    f" {platform.dimension} dimensions; give a polar range in space, none in the plane"
                )
