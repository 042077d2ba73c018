"""Starts drawn from boxes of states, such as those from which a proof of a policy is open."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsafe.schema.component import ANY, Range, Unit
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.initializers import Initializer
from jaxsafe.types import Key, Number, Place, Sim

Corners = Mapping[str, Annotated[Number, Unit("physical", length=ANY), Place]]


class SometimesInBoxes(Initializer, type="sometimes_in_boxes"):
    """A start from one of some boxes with the probability `share`, else the one drawn before.

    Each box is as likely as the others, and within it the start is uniform. `low` and `high` have a
    list for each number of a box. Its name is the field and an axis, such as `position.x`, or the
    field alone. All lists have the same length, the number of boxes.
    """

    redraws: ClassVar[bool] = True
    share: Annotated[Number, Unit("1"), Range(0.0, 1.0)] = 0.5
    low: Corners
    high: Corners

    @property
    def draws(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(column.partition(".")[0] for column in self.low))

    def problem(self) -> str | None:
        if not self.low or self.low.keys() != self.high.keys():
            found = f"{', '.join(self.low) or 'none'} and {', '.join(self.high) or 'none'}"
            return f"expected the same numbers in low and high, found {found}"
        corners = [*self.low.values(), *self.high.values()]
        lengths = {jnp.size(values) for values in corners}
        if len(lengths) > 1 or 0 in lengths:
            return f"expected lists of one length, found {sorted(lengths)}"
        for column, low in self.low.items():
            if not np.all(np.asarray(low) <= np.asarray(self.high[column])):
                return f"expected low ≤ high, which {column} is not"
            if column.partition(".")[2] not in ("", *"xyz"):
                return f"expected a field, or a field and x, y or z, found {column}"
        return None

    def draw(self, key: Key, drawn: Mapping[str, Array], sim: Sim) -> dict[str, Array]:
        key_box, key_share, key_place = jax.random.split(key, 3)
        box = jax.random.randint(key_box, (), 0, next(iter(self.low.values())).size)
        inside = jax.random.uniform(key_share) < self.share
        places = jax.random.uniform(key_place, (len(self.low),))
        start = {field: drawn[field] for field in self.draws}
        for place, (column, lows) in zip(places, self.low.items(), strict=True):
            field, _, axis = column.partition(".")
            low = lows[box]
            value = low + place * (self.high[column][box] - low)
            if axis:
                if "xyz".index(axis) >= start[field].size:
                    found = f"{column}, and {field} has {start[field].size} axes"
                    raise ConfigError(f"start.{self.name}: no such axis: {found}")
                value = start[field].at["xyz".index(axis)].set(value)
            start[field] = jnp.where(inside, value, start[field])
        return start
