"""What a sweep tries: grids and random draws of options, each a complete command line of `jaxsafe.train`."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.config.arguments import Arguments
from jaxsafe.environment import Environment
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.train.host.options import TrainConfig, resolve

PREFIX = "sweep."
COMMON = ("env", "seeds", "seed", "episodes", "out", "preset")
"""Options that all settings of a sweep share."""

MAX_SETTINGS = 10_000
"""The largest sweep. Each setting is a training, and checking as many takes half a minute before the first begins."""

MANY_SETTINGS = 500
"""From so many on the user is told that they are being checked."""

_RANGE = re.compile(r"(log|uniform)\(\s*([^,\s]+)\s*,\s*([^,\s]+)\s*\)")


class Span(NamedTuple):
    """An interval from which values are drawn, uniformly or uniformly in the logarithm."""

    low: float
    high: float
    log: bool

    def draw(self, generator: np.random.Generator) -> float:
        """One value, rounded to four digits, so that the table says what was tried."""
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        value = generator.uniform(low, high)
        return float(f"{math.exp(value) if self.log else value:.4g}")


class Setting(NamedTuple):
    """One point of a sweep: what it changes, and the training that this gives."""

    changes: dict[str, Any]
    config: TrainConfig
    env: Environment


def pop_sweep(arguments: Arguments) -> dict[str, list[Any] | Span]:
    """Take the `sweep.<option>=…` options out, without their prefix: lists of values, or ranges.

    Raises:
        ConfigError: there is none, or one is neither a list nor a range.
    """
    names = [key for key in arguments.options if key.startswith(PREFIX)]
    if not names:
        raise ConfigError("sweep: nothing to sweep; for instance sweep.ppo.gamma=[0.95,0.97,0.99]")
    return {key.removeprefix(PREFIX): _choices(key, arguments.options.pop(key)) for key in names}


def settings(
    arguments: Arguments, sweep: Mapping[str, list[Any] | Span], samples: int | None, draw: int
) -> list[Setting]:
    """Every setting of a grid, or `samples` random ones.

    Args:
        arguments: the options that all settings share, as for `jaxsafe.train`.
        sweep: what `pop_sweep` returns.
        samples: how many settings to draw; None tries all combinations of the lists.
        draw: seed of the draws.

    Raises:
        ConfigError: a value is refused as it would be on the command line, a range needs `samples`, or an option cannot
            differ within a sweep.
    """
    for name in sweep:
        if name in COMMON:
            raise ConfigError(
                f"{PREFIX}{name}: must be the same in all settings; give {name}=… instead"
            )
        if name in arguments.options:
            raise ConfigError(f"{PREFIX}{name}: {name} is given as well; leave one out")
    if samples is None:
        for name, values in sweep.items():
            if isinstance(values, Span):
                raise ConfigError(
                    f"{PREFIX}{name}: a range needs samples=N, the number of settings to draw"
                )
        count = math.prod(map(len, sweep.values()))
        if count > MAX_SETTINGS:
            raise ConfigError(
                f"sweep: expected at most {MAX_SETTINGS:,} settings, found {count:,}; samples=N draws some"
            )
        points = list(itertools.product(*sweep.values()))
    else:
        generator = np.random.default_rng(draw)
        points = [[_draw(values, generator) for values in sweep.values()] for _ in range(samples)]
    if len(points) >= MANY_SETTINGS:
        print(f"checking {len(points):,} settings", flush=True)
    found = []
    for point in points:
        changes = dict(zip(sweep, point, strict=True))
        config, env, _ = resolve({**arguments.options, **changes})
        found.append(Setting(changes, config, env))
    return found


def alike(found: Sequence[Setting], chosen: Sequence[int]) -> list[list[int]]:
    """The chosen indices in groups that one compiled training serves: settings that differ in numbers only."""
    groups: dict[Any, list[int]] = {}
    for index in chosen:
        leaves, structure = jax.tree.flatten(lane(found[index]))
        shapes = tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        groups.setdefault((structure, shapes, found[index].config.num_updates), []).append(index)
    return list(groups.values())


def lane(setting: Setting) -> tuple[Any, Any, Any]:
    """Environment, agent and hyperparameters: all that a training is made from, but for its seed."""
    return setting.env, setting.config.agent, setting.config.ppo


def _choices(key: str, value: Any) -> list[Any] | Span:
    if isinstance(value, list) and value:
        return value
    match = _RANGE.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        raise ConfigError(
            f"{key}: expected a list [a,b,…], uniform(low,high) or log(low,high), found {show(value)}"
        )
    try:
        low, high = float(match[2]), float(match[3])
    except ValueError:
        raise ConfigError(
            f"{key}: expected two numbers in the brackets, found {show(value)}"
        ) from None
    if not low < high or (match[1] == "log" and low <= 0.0) or not math.isfinite(high - low):
        raise ConfigError(f"{key}: expected low < high, for log above 0, found {show(value)}")
    return Span(low, high, match[1] == "log")


def _draw(values: list[Any] | Span, generator: np.random.Generator) -> Any:
    return (
        values.draw(generator)
        if isinstance(values, Span)
        else values[generator.integers(len(values))]
    )
