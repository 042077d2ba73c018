"""Numbers of a component that follow other numbers of it.

`{status.velocity_limit.slope: {to: deputy.mean_motion, times: 2}}` says of two dotted paths that
the first number is twice the second one. What a number follows may itself follow another number.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import numpy as np
from jax.core import Tracer

from jaxsafe.schema.component import Component, Kind, Range
from jaxsafe.schema.dotted_paths import Convert, as_given, get_path, set_path
from jaxsafe.schema.errors import ConfigError


class Tie(Component):
    """The rule of a number that follows another: it is `times` the number at the path `to`."""

    to: str
    times: Annotated[float, Range(nonzero=True)] = 1.0

    @property
    def rule(self) -> str:
        """The rule in words, such as `2 × deputy.mean_motion`."""
        return self.to if self.times == 1.0 else f"{self.times:g} × {self.to}"


Ties = Mapping[str, Tie]
"""The rule of each number that follows another, by its dotted path."""


def in_order(ties: Ties) -> list[str]:
    """Return the paths of the numbers that follow others, each after the one that it follows.

    Raises:
        ConfigError: numbers follow one another in a circle.
    """
    ordered: list[str] = []
    remaining = list(ties)
    while remaining:
        ready = [path for path in remaining if ties[path].to not in remaining]
        if not ready:
            raise ConfigError(
                f"tied: {', '.join(remaining)}: they follow one another in a circle; take one out"
            )
        ordered += ready
        remaining = [path for path in remaining if path not in ready]
    return ordered


def follow(component: Kind, ties: Ties, moved: Iterable[str], convert: Convert = as_given) -> Kind:
    """Return the component with every number updated that follows a changed number.

    Args:
        component: the component, in which some numbers have changed.
        ties: the rules of the numbers that follow others.
        moved: the paths of the numbers that have changed.
        convert: the function that checks the new numbers.

    Raises:
        ConfigError: `convert` refuses a number.
    """
    done = set(plain_paths(component, moved))
    for path in in_order(ties):
        if ties[path].to in done and path not in done:
            component = follow_one(component, path, ties[path], convert)
            done.add(path)
    return component


def follow_one(component: Kind, path: str, tie: Tie, convert: Convert = as_given) -> Kind:
    """Return the component with one number set to what its tie asks for.

    Raises:
        ConfigError: `convert` refuses the number.
    """
    try:
        return set_path(component, path, target(component, tie), convert)
    except ConfigError as error:
        raise ConfigError(f"{error}; it follows {tie.rule}") from None


def target(component: Component, tie: Tie) -> Any:
    """Return the number that a tie asks for."""
    source = get_path(component, tie.to)
    # Inside a trace, JAX would trace a product of constants too.
    return tie.times * (source if isinstance(source, Tracer) else np.asarray(source))


def plain_paths(component: Component, paths: Iterable[str]) -> list[str]:
    """Return the paths without a leading `shorthand` field of the component."""
    return [path.removeprefix(f"{component.shorthand}.") for path in paths]
