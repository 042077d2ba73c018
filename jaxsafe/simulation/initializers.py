"""Random starts: each initializer draws a field of a platform's state, or several together.

The paper describes them in Section 4 "Initialization" and in Tables 3 and 4. Initializers run in
the order in which they are listed, platform after platform. So a later one may refer to a field
that was drawn earlier, to an earlier platform, or to a region that such platforms carry.
"""

from __future__ import annotations

import csv
import dataclasses
import os
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.schema.component import ANY, Component, Range, Unit
from jaxsafe.schema.convert import DIRECTORY
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.simulation.geometry import direction, safe_norm
from jaxsafe.types import (
    MAX_DISTANCE,
    CentreName,
    Key,
    MetresPerSecond,
    Number,
    PerSecond,
    Place,
    Reach,
    Sim,
    Turn,
    place,
)

TWO_PI = 2.0 * jnp.pi

Interval = Annotated[Number, Unit("m or ft", length=2), Place]
Distances = Annotated[Number, Unit("m or ft", length=2), Reach]
Angles = Annotated[Number, Unit("rad", length=2), Turn]
Bounds = Annotated[Number, Unit("physical", length=ANY), Range(infinite=True)]
Shares = Annotated[Number, Unit("1", length=2), Range(0.0, largest=1e3)]


class Initializer(Component):
    """Base of initializers. Each draws the state field after which it is named, or several."""

    name: str
    redraws: ClassVar[bool] = False
    """Whether it replaces fields that other initializers have drawn before it."""

    @property
    def draws(self) -> tuple[str, ...]:
        """Names of the state fields that the initializer draws."""
        return (self.name,)

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Array | dict[str, Array]:
        """Return a value of the field, or values by field if the initializer draws several.

        Args:
            key: a typed PRNG key.
            drawn: the fields of this platform that were drawn before, by name.
            sim: the simulation with the platforms that were placed before, and the regions that
                they carry or that stay in place.
        """
        raise NotImplementedError


class Direction(Component):
    """A random direction whose azimuth and, in space, polar angle are each uniform.

    In space it is therefore not uniform on the sphere. On a line there is no azimuth, and each of
    the two directions is as likely as the other.
    """

    azimuth: Angles | None = (0.0, TWO_PI)
    polar: Angles | None = None

    def problem(self) -> str | None:
        if self.azimuth is None and self.polar is not None:
            return "a polar range needs an azimuth; a direction on a line has neither"
        return None

    @property
    def dimension(self) -> int:
        """Number of elements of the direction: 1 on a line, 2 in the plane, 3 in space."""
        return 1 + (self.azimuth is not None) + (self.polar is not None)

    @property
    def intervals(self) -> tuple[Float[Array, " 2"], ...]:
        """Intervals of the numbers to draw: one on a line or in the plane, two in space."""
        if self.azimuth is None:
            return (jnp.array([-1.0, 1.0]),)
        return (self.azimuth,) if self.polar is None else (self.azimuth, self.polar)

    def vector(self, *drawn: Float[Array, ""]) -> Float[Array, " d"]:
        """Return the unit vector that the drawn numbers stand for, one number per interval."""
        if self.azimuth is None:
            return jnp.where(drawn[0] < 0.0, -1.0, 1.0)[None]
        return direction(*drawn)


class Fixed(Initializer, type="fixed"):
    """The same start in every episode."""

    value: Annotated[Number, Unit("physical", length=ANY), Place]

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Array:
        return self.value


class Uniform(Initializer, type="uniform"):
    """A value drawn uniformly between bounds, independently in each component.

    This is the paper's generic initializer.
    """

    low: Annotated[Number, Unit("physical", length=ANY), Place]
    high: Annotated[Number, Unit("physical", length=ANY), Place]

    def problem(self) -> str | None:
        if self.low.shape != self.high.shape or not np.all(
            np.asarray(self.low) <= np.asarray(self.high)
        ):
            return f"expected low ≤ high, found {self.low.tolist()} and {self.high.tolist()}"
        return None

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Array:
        return self.low + (self.high - self.low) * jax.random.uniform(
            key, self.low.shape, self.low.dtype
        )


class Normal(Initializer, type="normal"):
    """A value drawn from a normal distribution, independently in each component.

    With bounds the distribution is truncated: values outside are never drawn.
    """

    mean: Annotated[Number, Unit("physical", length=ANY), Place]
    deviation: Annotated[
        Number,
        Unit("physical", length=ANY),
        Range(0.0, open_low=True, smallest=1e-12, largest=MAX_DISTANCE),
    ]
    low: Bounds | None = None
    high: Bounds | None = None

    def problem(self) -> str | None:
        low, high = self._bounds()
        sizes = {jnp.shape(value) for value in (self.mean, self.deviation, low, high)}
        if len(sizes) > 1:
            return "expected mean, deviation and bounds of the same number of elements"
        if not np.all(np.asarray(low) < np.asarray(high)):
            return f"expected low < high, found {low.tolist()} and {high.tolist()}"
        return None

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Array:
        shape, dtype = self.mean.shape, self.mean.dtype
        if self.low is None and self.high is None:
            return self.mean + self.deviation * jax.random.normal(key, shape, dtype)
        low, high = self._bounds()
        lowest, highest = [(bound - self.mean) / self.deviation for bound in (low, high)]
        share = jax.random.truncated_normal(key, lowest, highest, shape, dtype)
        # The sum may be rounded across a bound.
        return jnp.clip(self.mean + self.deviation * share, low, high)

    def _bounds(self) -> tuple[Array, Array]:
        low = jnp.full_like(self.mean, -jnp.inf) if self.low is None else self.low
        high = jnp.full_like(self.mean, jnp.inf) if self.high is None else self.high
        return low, high


class Cases(Initializer, type="cases"):
    """A start drawn uniformly from a list of cases.

    A case gives one or several fields of the state, which are drawn together. `values` has a list
    for each number of a case. Its name is the field, such as `heading`, or the field and an axis,
    such as `position.x`. All lists have the same length, the number of cases.
    """

    values: Mapping[str, Annotated[Number, Unit("physical", length=0), Place]] = dataclasses.field(
        default_factory=dict
    )
    file: str | None = None
    """A CSV file with the values. Its first row has their names. Its path begins at the YAML file.
    It is read once, and `jaxsafe config` prints the values."""

    @classmethod
    def prepared(cls, entries: dict[str, Any], place: str) -> dict[str, Any]:
        path = entries.get("file")
        if bool(entries.get("values")) == (path is not None):
            found = "neither" if path is None else "both"
            raise ConfigError(f"{place}: expected `values` or the `file` of them, found {found}")
        if path is None:
            return entries
        return {**entries, "values": read_cases(path, place), "file": None}

    @property
    def draws(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(column.partition(".")[0] for column in self.values))

    def problem(self) -> str | None:
        if self.file is not None:
            return "a `file` is read only where the whole start is given"
        lengths = {column: jnp.size(values) for column, values in self.values.items()}
        if not lengths or 0 in lengths.values():
            return "expected at least one case"
        if len(set(lengths.values())) > 1:
            found = ", ".join(f"{column} {length}" for column, length in lengths.items())
            return f"expected lists of the same length, found {found}"
        for field in self.draws:
            columns = self._columns(field)
            axes = [f"{field}.{axis}" for axis in "xyz"[: len(columns)]]
            if columns not in ([field], axes):
                return f"expected {field!r}, or {', '.join(axes)}; found {', '.join(columns)}"
        return None

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> dict[str, Array]:
        count = min(values.size for values in self.values.values())
        index = jax.random.randint(key, (), 0, count)
        case = {column: values[index] for column, values in self.values.items()}
        return {
            field: case[field]
            if field in case
            else jnp.stack([case[column] for column in self._columns(field)])
            for field in self.draws
        }

    def _columns(self, field: str) -> list[str]:
        """Return the names of the numbers of a field, in order."""
        return sorted(column for column in self.values if column.partition(".")[0] == field)


def read_cases(path: Any, place: str = "cases") -> dict[str, list[float]]:
    """Read the `values` of `Cases` from a CSV file. Its first row has their names.

    Args:
        path: the path. It begins at the directory of the configuration file that is being read, or
            else at the working directory.
        place: what error messages begin with.

    Raises:
        ConfigError: the file cannot be read, a name stands twice in the first row, or another row
            does not have a number for each name.
    """
    if not isinstance(path, str | os.PathLike):
        raise ConfigError(f"{place}: file: expected the path of a CSV file, found {show(path)}")
    full_path = DIRECTORY.get() / path
    try:
        with full_path.open(newline="", encoding="utf-8-sig") as file:
            names, *rows = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{place}: cannot read {full_path}: {reason}") from None
    names = [name.strip() for name in names]
    if not names or len(set(names)) < len(names):
        raise ConfigError(f"{place}: {full_path}: expected different names in row 1, found {names}")
    columns: dict[str, list[float]] = {name: [] for name in names}
    for number, row in enumerate(rows, start=2):
        try:
            for name, text in zip(names, row, strict=True):
                columns[name].append(float(text))
        except ValueError:
            problem = f"row {number}: expected {len(names)} numbers, found {show(row)}"
            raise ConfigError(f"{place}: {full_path}: {problem}") from None
    return columns


class AtDistance(Initializer, type="at_distance"):
    """A position at a random distance and in a random direction from a platform or region."""

    about: CentreName
    """An earlier platform, or a region that stays in place or that earlier platforms carry."""
    distance: Distances
    direction: Direction = Direction()

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Float[Array, " d"]:
        distance, *angles = uniform(key, self.distance, *self.direction.intervals)
        return place(sim, self.about).position + distance * self.direction.vector(*angles)


class AtLogUniformDistance(AtDistance, type="at_log_uniform_distance"):
    """A position at a log-uniform distance and in a random direction from a platform or region.

    The logarithm of the distance is uniform, so each factor of the distance is as likely as any
    other: with 100 m to 10 km every second start is within 1 km.
    """

    def problem(self) -> str | None:
        low, high = np.asarray(self.distance).tolist()
        if not 0.0 < low <= high:
            return f"expected 0 < low ≤ high as the distance, found {[low, high]}"
        return None

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Float[Array, " d"]:
        logarithm, *angles = uniform(key, jnp.log(self.distance), *self.direction.intervals)
        # The exponential may be rounded across an end.
        distance = jnp.clip(jnp.exp(logarithm), *self.distance)
        return place(sim, self.about).position + distance * self.direction.vector(*angles)


class AroundAtAltitude(Initializer, type="around_at_altitude"):
    """A position at a random horizontal distance and azimuth from a platform or region.

    Its altitude z is random and does not depend on it.
    """

    about: CentreName
    """An earlier platform, or a region that stays in place or that earlier platforms carry."""
    distance: Distances
    azimuth: Angles = (0.0, TWO_PI)
    altitude: Interval

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Float[Array, " 3"]:
        distance, azimuth, altitude = uniform(key, self.distance, self.azimuth, self.altitude)
        return jnp.append(
            place(sim, self.about).position[:2] + distance * direction(azimuth), altitude
        )


class BelowSpeedLimit(Initializer, type="below_speed_limit"):
    """A velocity in a random direction, at a uniform share of the limit ν₀ + ν₁‖r‖, Eq. (14).

    The position r, relative to the platform or region `about`, is the one drawn before.
    """

    about: CentreName
    """An earlier platform, or a region that stays in place or that earlier platforms carry."""
    floor: Annotated[MetresPerSecond, Range(0.0, largest=1e9)]
    slope: Annotated[PerSecond, Range(0.0, largest=1e3)]
    share: Shares = (0.0, 1.0)
    direction: Direction = Direction()

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> Float[Array, " d"]:
        share, *angles = uniform(key, self.share, *self.direction.intervals)
        limit = self.floor + self.slope * safe_norm(
            drawn["position"] - place(sim, self.about).position
        )
        return limit * share * self.direction.vector(*angles)


def uniform(key: Key, *intervals: Float[Array, " 2"]) -> Float[Array, " n"]:
    """Return a number drawn uniformly from each interval [low, high].

    All numbers come from one draw, because every draw compiles to a loop of its own.
    """
    low, high = jnp.stack(intervals, axis=-1)
    return low + (high - low) * jax.random.uniform(key, low.shape, low.dtype)
