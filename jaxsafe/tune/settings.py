"""The settings of a sweep, from grids or random draws of options.

Each setting is a complete command line of `jaxsafe train`.
"""

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
"""Prefix of the name of an option that is swept, on the command line."""

COMMON = ("env", "seeds", "seed", "episodes", "out", "preset", "recipe", "like")
"""Options that all settings of a sweep share."""

MAX_SETTINGS = 10_000
"""The largest number of settings of a sweep.

Each setting is a training. Checking this many takes half a minute before the first training begins.
"""

MANY_SETTINGS = 500
"""Number of settings from which a line says that they are being checked."""

_RANGE = re.compile(r"(log|uniform)\(\s*([^,\s]+)\s*,\s*([^,\s]+)\s*\)")


class Span(NamedTuple):
    """An interval from which values are drawn."""

    low: float
    high: float
    log: bool
    """Whether the logarithm of a value is drawn uniformly, and not the value."""

    def draw(self, generator: np.random.Generator) -> float:
        """Draw a value. It is rounded to four digits, so that the table says what was tried."""
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        value = generator.uniform(low, high)
        return float(f"{math.exp(value) if self.log else value:.4g}")


class Setting(NamedTuple):
    """One point of a sweep."""

    changes: dict[str, Any]
    """The values of the options that the sweep varies, by name of the option."""

    config: TrainConfig
    """The configuration of the training, with these options."""

    env: Environment
    """The environment, with these options."""


def pop_sweep(arguments: Arguments) -> dict[str, list[Any] | Span]:
    """Take the options `sweep.<option>=…` out of the arguments.

    Args:
        arguments: the arguments. These options are removed from them.

    Returns:
        The list of values or the range of each option, by its name without the prefix.

    Raises:
        ConfigError: there is no such option, or one is neither a list nor a range.
    """
    names = [key for key in arguments.options if key.startswith(PREFIX)]
    if not names:
        raise ConfigError("sweep: nothing to sweep; for instance sweep.ppo.gamma=0.95,0.97,0.99")
    return {key.removeprefix(PREFIX): _choices(key, arguments.options.pop(key)) for key in names}


def settings(
    arguments: Arguments, sweep: Mapping[str, list[Any] | Span], samples: int | None, draw: int
) -> list[Setting]:
    """Return every setting of a grid, or some random settings.

    Args:
        arguments: the options that all settings share, as for `jaxsafe train`.
        sweep: what `pop_sweep` returns.
        samples: how many settings to draw at random. None takes all combinations of the lists.
        draw: seed of the draws.

    Raises:
        ConfigError: a value is refused as it would be on the command line; an option cannot differ
            within a sweep, or is also given outside it; there is a range but no `samples`; or there
            are too many combinations.
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
                f"sweep: expected at most {MAX_SETTINGS:,} settings, found {count:,};"
                " samples=N draws some"
            )
        points = list(itertools.product(*sweep.values()))
    else:
        generator = np.random.default_rng(draw)
        points = [[_draw(values, generator) for values in sweep.values()] for _ in range(samples)]
    if len(points) >= MANY_SETTINGS:
        print(f"checking {len(points):,} settings", flush=True)
    result = []
    for point in points:
        changes = dict(zip(sweep, point, strict=True))
        config, env, _ = resolve({**arguments.options, **changes})
        if config.stop_at_success is not None:
            raise ConfigError(
                "stop_at_success: all trainings of a sweep have the same steps; leave it out"
            )
        result.append(Setting(changes, config, env))
    return result


def alike(every: Sequence[Setting], chosen: Sequence[int]) -> list[list[int]]:
    """Return the chosen indices in groups. A group is compiled once.

    The settings of a group differ in numbers only.

    Args:
        every: all settings of the sweep.
        chosen: indices of settings.
    """
    groups: dict[Any, list[int]] = {}
    for index in chosen:
        setting = every[index]
        leaves, structure = jax.tree.flatten(parameters(setting))
        shapes = tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        groups.setdefault((structure, shapes, setting.config.num_updates), []).append(index)
    return list(groups.values())


def parameters(setting: Setting) -> tuple[Any, Any, Any]:
    """Return environment, agent and hyperparameters of a setting.

    A training is made from these and its seed.
    """
    return setting.env, setting.config.agent, setting.config.ppo


def _choices(key: str, value: Any) -> list[Any] | Span:
    """Return the values of a swept option, or the range that they are drawn from.

    Args:
        key: the name of the option with its prefix, for error messages.
        value: the value on the command line.

    Raises:
        ConfigError: the value is neither a list nor a range.
    """
    if isinstance(value, list) and value:
        return value
    match = _RANGE.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        raise ConfigError(
            f"{key}: expected values a,b,…, uniform(low,high) or log(low,high), found {show(value)}"
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
