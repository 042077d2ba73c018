"""Strengthening functions α of barrier constraints, Eqs. (3), (4)."""

from __future__ import annotations

from typing import Annotated

from jaxtyping import Array, Float

from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.types import Number


class Strengthening(Component):
    """A strengthening function α of class κ, Eq. (4)."""

    def of(self, h: Float[Array, ""]) -> Float[Array, ""]:
        """Return α(h), which increases with h and is 0 at h = 0."""
        raise NotImplementedError


class Polynomial(Strengthening, type="polynomial"):
    """The strengthening function α(h) = linear·h + cubic·h³."""

    linear: Annotated[Number, Unit("1"), Range(0.0)] = 1.0
    cubic: Annotated[Number, Unit("1"), Range(0.0)] = 0.0

    def of(self, h: Float[Array, ""]) -> Float[Array, ""]:
        return self.linear * h + self.cubic * h**3
