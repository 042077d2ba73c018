"""Ends of an episode (Tables 9 and 10).

The first condition that holds, in the listed order, is the outcome.
"""

from __future__ import annotations

import functools
from typing import Annotated, Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxsafe.processors.processor import Limit, beyond
from jaxsafe.schema.component import Component, Range
from jaxsafe.simulation.clock import later, reached
from jaxsafe.types import FlagName, Length, Number, Reach, Seconds, Sim, StatusName

Ends = Literal["terminated", "truncated"]


class Terminal(Component):
    """A condition that ends the episode with the outcome it is named after.

    `ends` says what the end means for learning. After `terminated` nothing follows. In the paper a
    timeout is a failure of this kind too. With `truncated` the episode is merely cut, and the value
    of its last state still counts.

    A condition that stands `apart` does not hide the conditions after it, and those before it do
    not hide it. So its reward and that of another condition may fall on one step.
    """

    name: str
    ends: Ends = "terminated"
    apart: bool = False
    success: bool | None = None
    """Whether it counts as a success. By default it does if it is called `success`."""

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        """Return whether the condition holds."""
        raise NotImplementedError


class Docked(Terminal, type="docked"):
    """The agent is inside the docking region and not faster than the speed limit, Table 10."""

    in_docking: FlagName
    speed: StatusName
    velocity_limit: StatusName

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return sim.status[self.in_docking] & (
            sim.status[self.speed] <= sim.status[self.velocity_limit]
        )


class Crashed(Terminal, type="crashed"):
    """The agent is inside the docking region and faster than the speed limit, Table 10."""

    in_docking: FlagName
    speed: StatusName
    velocity_limit: StatusName

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return sim.status[self.in_docking] & (
            sim.status[self.speed] > sim.status[self.velocity_limit]
        )


class Above(Terminal, type="above"):
    """A status is above a limit. If `inclusive`, the limit itself counts."""

    status: StatusName
    limit: Limit
    inclusive: bool = False

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return beyond(sim.status[self.status], self.limit, "above", self.inclusive)


class Below(Terminal, type="below"):
    """A status is below a limit. If `inclusive`, the limit itself counts."""

    status: StatusName
    limit: Limit
    inclusive: bool = False

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return beyond(sim.status[self.status], self.limit, "below", self.inclusive)


class TooFar(Terminal, type="too_far"):
    """A distance is above a limit. If `inclusive`, the limit itself counts as too far."""

    distance: StatusName
    limit: Annotated[Length, Range(0.0, open_low=True, infinite=True)]
    inclusive: bool = False

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return beyond(sim.status[self.distance], self.limit, "above", self.inclusive)


class TooClose(Terminal, type="too_close"):
    """A distance is below a limit. If `inclusive`, the limit itself counts as too close."""

    distance: StatusName
    limit: Annotated[Length, Reach]
    inclusive: bool = True

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return beyond(sim.status[self.distance], self.limit, "below", self.inclusive)


class Held(Terminal, type="held"):
    """A time, such as the one in the rejoin region, is at least `duration`, Eqs. (7), (10).

    If not `inclusive`, it must be longer than `duration`.
    """

    time: StatusName
    duration: Seconds
    inclusive: bool = True

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        time = sim.status[self.time]
        return reached(time, self.duration) if self.inclusive else later(time, self.duration)


class Holds(Terminal, type="holds"):
    """A boolean status is true, for instance the status whether the agent is in a keep-out zone."""

    status: FlagName

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return sim.status[self.status]


class Timeout(Terminal, type="timeout"):
    """More than `limit` seconds have passed since the start: t > t_max."""

    limit: Seconds

    def reached(self, sim: Sim) -> Bool[Array, ""]:
        return later(sim.time, self.limit)


def time_limit(env: Any) -> Number | None:
    """Return the time [s] after which an environment's first timeout ends an episode.

    It is None if the environment has no timeout.
    """
    limits = [condition.limit for condition in env.terminal if isinstance(condition, Timeout)]
    return functools.reduce(jnp.minimum, limits) if limits else None
