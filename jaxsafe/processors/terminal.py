"""Ends of an episode (Tables 9 and 10): the first condition that holds, in the listed order, is the outcome."""

from __future__ import annotations

from typing import Literal

from jaxtyping import Array, Bool

from jaxsafe.component import Component
from jaxsafe.types import Metres, Seconds, Sim, StatusName

Ends = Literal["terminated", "truncated"]


class Terminal(Component):
    """A condition that ends the episode with the outcome it is named after.

    `ends` says what the end means for learning: `terminated`, nothing follows (in the paper a timeout too is a failure), or
    `truncated`, the episode is merely cut and the value of its last state still counts.
    """

    name: str
    ends: Ends = "terminated"

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        """Whether the condition holds."""
        raise NotImplementedError


class Docked(Terminal, type="docked"):
    """Inside the docking region at no more than the speed limit, Table 10."""

    in_docking: StatusName
    speed: StatusName
    velocity_limit: StatusName

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return sim.status[self.in_docking] & (sim.status[self.speed] <= sim.status[self.velocity_limit])


class Crashed(Terminal, type="crashed"):
    """Inside the docking region above the speed limit, Table 10."""

    in_docking: StatusName
    speed: StatusName
    velocity_limit: StatusName

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return sim.status[self.in_docking] & (sim.status[self.speed] > sim.status[self.velocity_limit])


class TooFar(Terminal, type="too_far"):
    """A distance above a limit."""

    distance: StatusName
    limit: Metres

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return sim.status[self.distance] > self.limit


class Timeout(Terminal, type="timeout"):
    """More than `limit` seconds since the start: t > t_max."""

    limit: Seconds

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return sim.time > self.limit
