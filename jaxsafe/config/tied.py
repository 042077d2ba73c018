"""Warnings about a number that is changed without another one that belongs to it.

The tasks derive such numbers from one another, but an environment has them as two numbers.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer

from jaxsafe.environment import Environment
from jaxsafe.processors.constraint import Separation
from jaxsafe.processors.reward import Success
from jaxsafe.processors.status import VelocityLimit
from jaxsafe.processors.terminal import Timeout, TooClose
from jaxsafe.schema.errors import ConfigWarning
from jaxsafe.simulation.initializers import BelowSpeedLimit

_OFTEN = {1.0: "equal to", 2.0: "twice"}
"""Words for factors that are common."""


class Tie(NamedTuple):
    """Two numbers that may belong together."""

    paths: tuple[str, str]
    """Dotted paths of the two numbers."""

    numbers: tuple[Any, Any]
    """The two numbers."""

    factor: float = 1.0
    """Quotient of the second number and the first where they belong together."""

    @property
    def traced(self) -> bool:
        """Whether a number is traced, so that nothing can be said about the two."""
        return any(isinstance(number, Tracer) for number in self.numbers)

    @property
    def holds(self) -> bool:
        """Whether the numbers belong together with their present values."""
        first, second = map(np.asarray, self.numbers)
        return bool(abs(self.factor * first - second) <= 1e-6 * abs(second))


def warn_of_ties(before: Environment, after: Environment) -> None:
    """Warn of each number that was tied to others and was changed or made random without them.

    Each warning is one line.

    Args:
        before: the environment as it was.
        after: the environment with the changes of a user. Numbers that are traced are not judged.
    """
    held = {tie.paths: tie for tie in _ties(before) if not tie.traced and tie.holds}
    newly_random = {
        path.removeprefix("platforms.") for path in after.randomize if path not in before.randomize
    }
    alone: dict[tuple[str, str, float], list[str]] = {}
    for tie in _ties(after):
        if tie.paths not in held or tie.traced:
            continue
        random = [path in newly_random for path in tie.paths]
        changed = [
            not np.array_equal(*pair)
            for pair in zip(tie.numbers, held[tie.paths].numbers, strict=True)
        ]
        if not any(random) and (tie.holds or all(changed)):
            continue
        index = random.index(True) if any(random) else changed.index(True)
        factor = tie.factor if index == 0 else 1.0 / tie.factor
        verb = "is random" if any(random) else "changes"
        alone.setdefault((tie.paths[index], verb, factor), []).append(tie.paths[1 - index])
    for (path, verb, factor), others in alone.items():
        was = (
            f"{'was' if len(others) == 1 else 'were'} {_OFTEN.get(factor, f'{factor:g} times')} it"
        )
        kept = "keeps its value" if len(others) == 1 else "keep their values"
        warnings.warn(
            f"{path} {verb} alone: {' and '.join(others)}, which {was}, {kept}",
            ConfigWarning,
            stacklevel=3,
        )


def _ties(env: Environment) -> Iterator[Tie]:
    """Yield the pairs of numbers of an environment that the tasks derive from one another."""
    limits = [one for one in env.status if isinstance(one, VelocityLimit)]
    for timeout in (one for one in env.terminal if isinstance(one, Timeout)):
        for reward in (one for one in env.reward if isinstance(one, Success)):
            paths = f"terminal.{timeout.name}.limit", f"reward.{reward.name}.time_scale"
            yield Tie(paths, (timeout.limit, reward.time_scale))
    for crash in (one for one in env.terminal if isinstance(one, TooClose)):
        for constraint in (one for one in env.constraints if isinstance(one, Separation)):
            if constraint.distance == crash.distance:
                paths = f"terminal.{crash.name}.limit", f"constraints.{constraint.name}.minimum"
                yield Tie(paths, (crash.limit, constraint.minimum))
    for platform in env.platforms:
        starts = [one for one in platform.start if isinstance(one, BelowSpeedLimit)]
        sloped = {f"status.{one.name}": one for one in limits} | {
            f"{platform.name}.start.{one.name}": one for one in starts
        }
        motion = getattr(platform, "mean_motion", None)
        for place, one in sloped.items() if motion is not None else ():
            yield Tie((f"{platform.name}.mean_motion", f"{place}.slope"), (motion, one.slope), 2.0)
        for limit in limits:
            for start in starts:
                for name in ("floor", "slope"):
                    paths = (
                        f"status.{limit.name}.{name}",
                        f"{platform.name}.start.{start.name}.{name}",
                    )
                    yield Tie(paths, (getattr(limit, name), getattr(start, name)))
