"""Chosen starts of an evaluation, so that all policies fly from exactly the same ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsafe.environment import Environment, reset_to
from jaxsafe.schema import yaml12
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.simulation.initializers import read_cases
from jaxsafe.simulation.platform import Platform
from jaxsafe.types import Key, State, TimeStep


class Cases(NamedTuple):
    """The starts of some episodes, as `reset_to` takes them. Every array is [cases, …]."""

    platforms: Mapping[str, Mapping[str, Array]]
    """Fields of the states, by platform and field."""

    parameters: Mapping[str, Array]
    """The numbers that `randomize` would draw, by path."""

    @property
    def size(self) -> int:
        """Number of cases."""
        return jax.tree.leaves(self)[0].shape[0]

    def part(self, first: int, count: int) -> Cases:
        """Return `count` cases from the index `first` on. The last case stands for missing ones."""
        indices = np.minimum(np.arange(first, first + count), self.size - 1)
        return jax.tree.map(lambda values: values[indices], self)


def reset_to_cases(env: Environment, cases: Cases, key: Key) -> tuple[State, TimeStep]:
    """Return what `reset_to` returns for each case.

    Args:
        env: the environment.
        cases: the cases.
        key: a typed PRNG key, from which disturbances and errors of sensors are drawn.
    """
    keys = jax.random.split(key, cases.size)
    start = lambda case, key: reset_to(env, case.platforms, case.parameters, key)  # noqa: E731
    return jax.vmap(start)(cases, keys)


def load_cases(env: Environment, path: str) -> Cases:
    """Read cases from a file.

    A column is `PLATFORM.FIELD` or `PLATFORM.FIELD.AXIS`, such as `deputy.position.x`, or the path
    of a number that `randomize` draws, such as `deputy.mass`.

    Args:
        env: the environment.
        path: a CSV file, whose first row has the names of the columns, or a YAML file with a list
            of numbers by column.

    Raises:
        ConfigError: the file cannot be read, or its cases are no starts of the environment.
    """
    columns = _read(path)
    lengths = {len(values) for values in columns.values()}
    if len(lengths) != 1 or 0 in lengths:
        raise ConfigError(f"cases: {path}: expected columns of one length of at least 1")
    _refuse_unknown(env, path, columns)
    for name, values in columns.items():
        wrong = np.flatnonzero(~np.isfinite(values))
        if wrong.size:
            found = show(float(values[wrong[0]]))
            raise ConfigError(
                f"cases: {path}: case {wrong[0]}: {name}: expected a finite number, found {found}"
            )
    parameters = {name: columns.pop(name) for name in env.randomize if name in columns}
    found = (_states(env, path, columns), parameters)
    cases = Cases(*jax.tree.map(lambda values: jnp.asarray(values, env.dt.dtype), found))
    try:
        jax.eval_shape(lambda one: reset_to_cases(env, one, jax.random.key(0)), cases.part(0, 1))
    except ConfigError as error:
        raise ConfigError(f"cases: {path}: {error}") from None
    return cases


def _read(path: str) -> dict[str, np.ndarray]:
    """Return the columns of a file."""
    if Path(path).suffix == ".csv":
        return {name: np.asarray(values) for name, values in read_cases(path).items()}
    content = yaml12.read(path)
    try:
        return {
            str(name): np.asarray(values, np.float64).reshape(-1)
            for name, values in content.items()
        }
    except (AttributeError, TypeError, ValueError):
        raise ConfigError(f"cases: {path}: expected a list of numbers by column") from None


def _states(
    env: Environment, path: str, columns: Mapping[str, np.ndarray]
) -> dict[str, dict[str, np.ndarray]]:
    """Return the fields of the platforms' states that the columns hold."""
    states: dict[str, dict[str, np.ndarray]] = {}
    for platform in env.platforms:
        for field, names in _columns_by_field(platform).items():
            given = [columns[name] for name in names if name in columns]
            if not given:
                continue
            if len(given) < len(names):
                raise ConfigError(f"cases: {path}: expected all of {', '.join(names)}, or none")
            whole = "." not in names[0].removeprefix(f"{platform.name}.")
            states.setdefault(platform.name, {})[field] = given[0] if whole else np.stack(given, -1)
    return states


def _refuse_unknown(env: Environment, path: str, columns: Mapping[str, np.ndarray]) -> None:
    """Refuse a column that is neither a field of a platform nor a number that is drawn."""
    known = [*env.randomize]
    for platform in env.platforms:
        known += [name for names in _columns_by_field(platform).values() for name in names]
    for name in columns:
        if name not in known:
            near = choices_text(name, column_names(env))
            raise ConfigError(f"cases: {path}: unknown column {show(name)}{near}")


def _columns_by_field(platform: Platform) -> dict[str, list[str]]:
    """Return the columns of each field of a platform's state: one, or one for each axis."""
    return {
        field: [f"{platform.name}.{field}.{axis}" for axis in "xyz"[: jnp.size(value)]]
        if jnp.ndim(value)
        else [f"{platform.name}.{field}"]
        for field, value in vars(platform.rest()).items()
    }


def column_names(env: Environment) -> list[str]:
    """Return the columns that a file of cases must have: everything that is random at reset."""
    names = []
    for platform in env.platforms:
        columns = _columns_by_field(platform)
        names += [name for field in platform.random_fields for name in columns[field]]
    return [*names, *env.randomize]


def columns_of(env: Environment, states: State) -> dict[str, np.ndarray]:
    """Return the columns of a file of cases from the states of starts.

    Args:
        env: the environment.
        states: the states after `reset`. Every array is [cases, …].
    """
    columns: dict[str, Any] = dict(states.parameters)
    for platform in env.platforms:
        state = states.sim.platforms[platform.name]
        for field, names in _columns_by_field(platform).items():
            values = np.asarray(getattr(state, field)).reshape(-1, len(names))
            columns |= dict(zip(names, values.T, strict=True))
    return {name: np.asarray(columns[name]) for name in column_names(env)}
