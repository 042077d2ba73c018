"""Write the starts that come with each task, `configs/cases/TASK.csv`.

    python docs/make_cases.py

They are the first starts of `jax.random.key(0)`, and then a grid: the least, the middle and the
greatest value of each number that a start draws, with quarter turns for an angle that may be
anything. If the grid has more than `MAX_GRID` starts, some are chosen at random.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import jaxsafe
from jaxsafe.environment import Environment
from jaxsafe.evaluate.cases import columns_of
from jaxsafe.rollout import reset_batch
from jaxsafe.storage.files import write_text
from jaxsafe.types import State

OUT = Path(__file__).parent.parent / "configs" / "cases"
RANDOM = 1000
"""Number of random starts."""

MAX_GRID = 256
"""Most starts of the grid of a task."""

LEVELS = (0.0, 0.5, 0.999)
"""Shares of an interval. The last one stands for its end, where rounding may violate."""

QUARTERS = (0.0, 0.25, 0.5, 0.75)
"""Shares of a full turn."""


def random_starts(env: Environment) -> State:
    """Return the states of the random starts."""
    return reset_batch(env, jax.random.key(0), RANDOM)[0]


def grid(env: Environment) -> State:
    """Return the states of the grid."""
    sizes: list[int] = []

    def count(key: Any, shape: tuple[int, ...] = (), *rest: Any) -> jax.Array:
        sizes.append(math.prod(shape))
        return jnp.zeros(shape)

    _reset_with(env, count)

    def start(shares: jax.Array) -> State:
        left = iter(jnp.split(shares, np.cumsum(sizes)[:-1]))
        return _reset_with(env, lambda key, shape=(), *rest: next(left).reshape(shape))

    starts = jax.vmap(start)
    turns = [_is_turn(env, starts, number, sum(sizes)) for number in range(sum(sizes))]
    levels = [QUARTERS if turn else LEVELS for turn in turns]
    total = math.prod(map(len, levels))
    chosen = np.arange(total)
    if total > MAX_GRID:
        chosen = np.sort(np.random.default_rng(0).choice(total, MAX_GRID, replace=False))
    places = np.unravel_index(chosen, [*map(len, levels)])
    shares = [np.asarray(own)[place] for own, place in zip(levels, places, strict=True)]
    return starts(jnp.asarray(np.stack(shares, axis=-1), jnp.float32))


def _is_turn(
    env: Environment, starts: Callable[[jax.Array], State], number: int, count: int
) -> bool:
    """Return whether both ends of a number's interval are the same start, as of a full turn."""
    ends = jnp.full((2, count), 0.4).at[:, number].set(jnp.array([0.0, 1.0]))
    gaps = [abs(float(low - high)) for low, high in columns_of(env, starts(ends)).values()]
    return all(min(gap, abs(gap - 2.0 * math.pi)) < 1e-2 for gap in gaps)


def _reset_with(env: Environment, uniform: Callable[..., jax.Array]) -> State:
    with mock.patch("jax.random.uniform", uniform):
        return env.reset(jax.random.key(0))[0]


def text(env: Environment) -> str:
    """Return the content of the file of a task."""
    parts = [columns_of(env, states) for states in (random_starts(env), grid(env))]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(map(str, values) for values in columns.values()), strict=True))
    return buffer.getvalue()


def main() -> None:
    """Write all files."""
    OUT.mkdir(exist_ok=True)
    for task in jaxsafe.TASKS:
        write_text(OUT / f"{task}.csv", text(jaxsafe.make(task)))


if __name__ == "__main__":
    main()
