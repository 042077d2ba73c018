"""Write the starts that come with each task, `configs/cases/TASK.csv`.

    python docs/make_cases.py

They are the first starts of `jax.random.key(0)`, and then a grid of at most `MAX_GRID` starts. The
grid begins with the corners: every number that a start draws has its least or its greatest value,
or one of the quarter turns for an angle that may be anything. If there are more corners than
`MAX_GRID`, some are chosen such that all combinations of the extremes of any two numbers are there
equally often. If there is room, starts with numbers in the middle of their intervals follow. A
start that is there already is left out: without speed, for instance, all directions of the velocity
are the same start.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Callable, Sequence
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

ENDS = (0.0, 0.999)
"""Shares of an interval. The last one stands for its end, where rounding may violate."""

MIDDLE = 0.5
"""Share of an interval that is no extreme."""

QUARTERS = (0.0, 0.25, 0.5, 0.75)
"""Shares of a full turn. All of them are extremes."""

SAME = 0.005
"""Starts are the same if they differ by less in each column, as a share of the column's spread."""


def random_starts(env: Environment) -> State:
    """Return the states of the random starts."""
    return reset_batch(env, jax.random.key(0), RANDOM)[0]


def grid(env: Environment) -> State:
    """Return the states of the grid: the corners, and starts in the middle if there is room."""
    start, extremes = starts_by_share(env)
    shares = corners(extremes)
    if len(shares) == math.prod(map(len, extremes)):
        shares = np.concatenate([shares, in_the_middle(extremes)])
    states = start(shares)
    spread = np.ptp(_table(env, random_starts(env)), axis=0)
    chosen: list[int] = []
    rows = _table(env, states) / spread
    for index, row in enumerate(rows):
        known = np.any(np.all(np.abs(rows[chosen] - row) < SAME, axis=-1))
        if not known and len(chosen) < MAX_GRID:
            chosen.append(index)
    return jax.tree.map(lambda values: values[np.array(chosen)], states)


def _table(env: Environment, states: State) -> np.ndarray:
    """Return the columns of a file of cases as one array [starts, columns]."""
    return np.stack([*columns_of(env, states).values()], axis=-1)


def starts_by_share(
    env: Environment,
) -> tuple[Callable[[np.ndarray], State], list[tuple[float, ...]]]:
    """Return a function of shares [starts, numbers], and the extreme shares of each number.

    The function returns the states of starts whose numbers have these shares of their intervals.
    """
    sizes: list[int] = []

    def count(key: Any, shape: tuple[int, ...] = (), *rest: Any) -> jax.Array:
        sizes.append(math.prod(shape))
        return jnp.zeros(shape)

    _reset_with(env, count)

    def start(shares: jax.Array) -> State:
        left = iter(jnp.split(shares, np.cumsum(sizes)[:-1]))
        return _reset_with(env, lambda key, shape=(), *rest: next(left).reshape(shape))

    def starts(shares: np.ndarray) -> State:
        return jax.vmap(start)(jnp.asarray(shares, jnp.float32))

    turns = [_is_turn(env, starts, number, sum(sizes)) for number in range(sum(sizes))]
    return starts, [QUARTERS if turn else ENDS for turn in turns]


def corners(extremes: Sequence[tuple[float, ...]]) -> np.ndarray:
    """Return shares [starts, numbers]: all combinations of extremes, or `MAX_GRID` of them.

    Args:
        extremes: the extreme shares of each number, two or four.
    """
    if math.prod(map(len, extremes)) <= MAX_GRID:
        return np.array([*itertools.product(*extremes)])
    # A regular fractional factorial design. Each bit of a choice is the parity of some bits of the
    # row's number, those in its mask. A choice among four extremes has two bits. Any four masks are
    # linearly independent, so all values of any four bits are there equally often.
    masks = [1 << bit for bit in range(MAX_GRID.bit_length() - 1)]
    for mask in range(MAX_GRID):
        sums = {a ^ b ^ c for a in (0, *masks) for b in (0, *masks) for c in (0, *masks)}
        if mask not in sums:
            masks.append(mask)
    left = iter(masks)
    rows = range(MAX_GRID)
    columns = []
    for shares in extremes:
        own = [next(left) for _ in range(len(shares).bit_length() - 1)]
        choices = [
            sum(((row & mask).bit_count() % 2) << bit for bit, mask in enumerate(own))
            for row in rows
        ]
        columns.append(np.array(shares)[choices])
    return np.stack(columns, axis=-1)


def in_the_middle(extremes: Sequence[tuple[float, ...]]) -> np.ndarray:
    """Return all shares [starts, numbers] with numbers in the middle, in a random order."""
    levels = [shares if shares == QUARTERS else (*shares, MIDDLE) for shares in extremes]
    combinations = np.array([*itertools.product(*levels)])
    is_corner = [
        all(share in own for share, own in zip(row, extremes, strict=True))
        for row in combinations.tolist()
    ]
    return np.random.default_rng(0).permutation(combinations[~np.array(is_corner)])


def _is_turn(
    env: Environment, starts: Callable[[np.ndarray], State], number: int, count: int
) -> bool:
    """Return whether both ends of a number's interval are the same start, as of a full turn."""
    ends = np.full((2, count), 0.4)
    ends[:, number] = (0.0, 1.0)
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
