"""Safety constraints h ≥ 0.

They are evaluated at every step for `cost`, for `margins` and for the safety metrics of Section 5.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from jaxtyping import Array, Float

from jaxsafe.schema.component import Component
from jaxsafe.types import Extent, Length, Sim, StatusName


class Constraint(Component):
    """A signed margin h, which is safe where h ≥ 0, and a limit.

    The severity of a violation is −h as a share of the limit.
    """

    name: str
    between: ClassVar[bool] = False
    """Whether h can fall far below 0 between two safe instants.

    If so, filters bound h also between the instants, with `Status.on_the_way`.
    """

    def margin(self, sim: Sim) -> Float[Array, ""]:
        """Return h in the unit of the limit."""
        raise NotImplementedError

    def limit(self, sim: Sim) -> Float[Array, ""]:
        """Return the limit at this step, which is positive."""
        raise NotImplementedError


class SpeedLimit(Constraint, type="speed_limit"):
    """The margin h = v_limit − ‖v‖ [m/s], Eqs. (14), (17)."""

    speed: StatusName
    velocity_limit: StatusName

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.velocity_limit] - sim.status[self.speed]

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.velocity_limit]


class Separation(Constraint, type="separation"):
    """The margin h = distance − minimum, Eqs. (8), (11)."""

    between: ClassVar[bool] = True
    distance: StatusName
    minimum: Annotated[Length, Extent]

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.distance] - self.minimum

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return self.minimum
