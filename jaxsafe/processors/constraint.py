"""Safety constraints h ≥ 0, evaluated at every step for `cost`, `margins` and the safety metrics of Section 5."""

from __future__ import annotations

from typing import Annotated, ClassVar

from jaxtyping import Array, Float

from jaxsafe.schema.component import Component
from jaxsafe.types import Extent, Length, Sim, StatusName


class Constraint(Component):
    """A signed margin h, safe where h ≥ 0, and the limit of which a violation is a share."""

    name: str
    between: ClassVar[bool] = False
    """Whether h can fall far below 0 between two safe instants; then filters bound it on the way, `Status.on_the_way`."""

    def margin(self, sim: Sim) -> Float[Array, ""]:
        """Return h, in the units of the limit."""
        raise NotImplementedError

    def limit(self, sim: Sim) -> Float[Array, ""]:
        """Return the limit at this step, positive."""
        raise NotImplementedError


class SpeedLimit(Constraint, type="speed_limit"):
    """h = v_limit − ‖v‖ [m/s], Eqs. (14), (17)."""

    speed: StatusName
    velocity_limit: StatusName

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.velocity_limit] - sim.status[self.speed]

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.velocity_limit]


class Separation(Constraint, type="separation"):
    """h = distance − minimum, Eqs. (8), (11)."""

    between: ClassVar[bool] = True
    distance: StatusName
    minimum: Annotated[Length, Extent]

    def margin(self, sim: Sim) -> Float[Array, ""]:
        return sim.status[self.distance] - self.minimum

    def limit(self, sim: Sim) -> Float[Array, ""]:
        return self.minimum
