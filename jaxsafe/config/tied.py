"""Numbers of an environment that follow other numbers of it: `Environment.tied`.

When a number is changed or drawn at random, the numbers that follow it change too. A tied number
that is itself changed or drawn at random follows no longer.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxsafe.environment import Environment
from jaxsafe.schema.component import ANY, Field
from jaxsafe.schema.convert import expects, to_value
from jaxsafe.schema.describe import brief
from jaxsafe.schema.dotted_paths import get_path, set_path
from jaxsafe.schema.errors import ConfigError, ConfigWarning
from jaxsafe.schema.ties import follow_one, in_order, plain_paths, target


def settle(env: Environment) -> Environment:
    """Return an environment in which every tied number is what it follows.

    A file may give another number. It is replaced, and a warning says so.

    Raises:
        ConfigError: numbers follow one another in a circle, or one would be out of its range.
    """
    for path in in_order(env.tied):
        tie = env.tied[path]
        number = _number(env, path)
        source = _number(env, tie.to)
        # A path that leads nowhere is reported by `check_ties`.
        if number is None or source is None or _equal(number, target(env, tie)):
            continue
        env = follow_one(env, path, tie, to_value)
        warnings.warn(
            f"{path}: {brief(number)} becomes {brief(get_path(env, path))}, because it follows "
            f"{tie.rule}; take it out of `tied` to set it apart",
            ConfigWarning,
            stacklevel=3,
        )
    return env


def carry(before: Environment, after: Environment, changed: Iterable[str]) -> Environment:
    """Return a changed environment in which tied numbers have followed the changes.

    A tied number that was itself changed, or that is random now, is tied no longer, and a warning
    says so. If either number of a tie is gone, the tie is removed without a warning.

    Args:
        before: the environment before the changes.
        after: the environment with the changes.
        changed: the paths that were changed.

    Raises:
        ConfigError: numbers follow one another in a circle, or one would be out of its range.
    """
    given = set(plain_paths(after, changed))
    random = set(plain_paths(after, after.randomize))
    ties = dict(after.tied)
    for path in in_order(after.tied):
        tie = after.tied[path]
        number = _number(after, path)
        source = _number(after, tie.to)
        if before.tied.get(path) == tie and (number is None or source is None):
            del ties[path]
        elif path in random or path in given or _differs(before, after, path):
            del ties[path]
            reason = "random" if path in random else "set apart"
            warnings.warn(
                f"{path} is {reason}: it followed {tie.rule}, and does so no longer",
                ConfigWarning,
                stacklevel=3,
            )
        elif number is None or source is None:
            continue  # `check_ties` reports that the path leads nowhere
        elif before.tied.get(path) != tie or _differs(before, after, tie.to):
            after = follow_one(after, path, tie, to_value)
    return after if len(ties) == len(after.tied) else after.replace(tied=ties)


def check_ties(env: Environment) -> None:
    """Check that every tie is between two numbers of the environment.

    The number that follows must not be random itself.

    Raises:
        ConfigError: a tie is not allowed. The message names it.
    """
    random = plain_paths(env, env.randomize)
    for path, tie in env.tied.items():
        for end in (path, tie.to):
            if end.split(".")[0] in ("platforms", "randomize", "tied"):
                raise ConfigError(
                    f"tied.{path}: expected paths of numbers that begin with a section or the name "
                    f"of a platform, such as deputy.mass, found {end}"
                )
            try:
                set_path(env, end, np.zeros(()), one_number)
            except ConfigError as error:
                raise ConfigError(f"tied: {error}") from None
            if _number(env, end) is None:
                raise ConfigError(f"tied: {end}: expected the path of one number that is set")
        if path in random:
            raise ConfigError(
                f"randomize: {path}: it follows {tie.rule}; draw that, or take {path} out of `tied`"
            )


def one_number(value: Any, field: Field, place: str) -> Any:
    """Return the value unchanged if the field holds one number or a mapping to numbers.

    Raises:
        ConfigError: the field holds something else.
    """
    holds_one = field.unit.length in (None, ANY) if field.unit else isinstance(value, dict)
    if not holds_one:
        raise ConfigError(
            f"{place}: expected the path of one number, found that of {expects(field)}"
        )
    return value


def _number(env: Environment, path: str) -> Any:
    """Return the number at a path, or None if there is none."""
    try:
        value = get_path(env, path)
    except (AttributeError, ConfigError, KeyError, TypeError):
        return None
    numeric = hasattr(value, "dtype") and jnp.issubdtype(value.dtype, jnp.floating)
    return value if numeric and jnp.ndim(value) == 0 else None


def _differs(before: Environment, after: Environment, path: str) -> bool:
    """Return whether the number at a path has changed."""
    old = _number(before, path)
    new = _number(after, path)
    if old is new:
        return False
    return old is None or new is None or not _equal(old, new)


def _equal(number: Any, other: Any) -> bool:
    """Return whether two numbers are equal but for rounding. Traced numbers never are."""
    if isinstance(number, Tracer) or isinstance(other, Tracer):
        return False
    first = float(np.asarray(number))
    second = float(np.asarray(other))
    return first == second or abs(first - second) <= 1e-6 * abs(second)
