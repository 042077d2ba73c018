"""Reward terms (Tables 7 and 8).

The reward of a step is the sum of its terms. At reset all terms are 0.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.processors.processor import Limit, Processor, Side, beyond
from jaxsafe.processors.terminal import Ends
from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.types import (
    Extent,
    FlagName,
    Length,
    Number,
    OutcomeName,
    Record,
    Sim,
    StatusName,
)

Pay = Annotated[Number, Unit("1"), Range(largest=1e12)]
"""A part of a reward. Its range keeps squares of its sums over episodes finite in float32."""

PerMetrePerSecond = Annotated[Number, Unit("s/m"), Range(largest=1e12)]
"""A part of a reward for each metre per second."""


class Bound(Component):
    """End of the episode with `outcome` once the sum of a reward term so far is below `below`."""

    below: Pay
    outcome: str
    ends: Ends = "terminated"
    success: bool | None = None
    """Whether it counts as a success. By default it does if the outcome is called `success`."""


class Reward(Processor):
    """Base of all reward terms. Any term may carry a bound."""

    bound: Bound | None = None


class ConditionalReward(Reward):
    """Base of rewards that are paid on every step, or only while a boolean status is true."""

    condition: FlagName | None = None

    def amount(self, sim: Sim) -> Float[Array, ""]:
        """Return the reward of a step on which the condition holds."""
        raise NotImplementedError

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        amount = self.amount(sim)
        if self.condition is None:
            return amount
        return jnp.where(sim.status[self.condition], amount, 0)


class ConstantReward(ConditionalReward, type="constant"):
    """The same reward on every step, or on every step on which the condition is true."""

    value: Pay

    def amount(self, sim: Sim) -> Float[Array, ""]:
        return self.value


class Proportional(ConditionalReward, type="proportional"):
    """The term offset + scale·status for a status that is a number."""

    status: StatusName
    scale: Pay
    offset: Pay = 0.0

    def amount(self, sim: Sim) -> Float[Array, ""]:
        return self.offset + self.scale * sim.status[self.status]


class ThresholdReward(ConditionalReward, type="threshold"):
    """A reward on each step on which a status is above or below a limit.

    If `inclusive`, the limit itself counts.
    """

    status: StatusName
    limit: Limit
    side: Side
    inclusive: bool = False
    value: Pay

    def amount(self, sim: Sim) -> Float[Array, ""]:
        held = beyond(sim.status[self.status], self.limit, self.side, self.inclusive)
        return jnp.where(held, self.value, 0.0)


class Potential(Record):
    """Memory of `PotentialChange`."""

    current: Float[Array, ""]
    change: Float[Array, ""]


class PotentialChange(Reward):
    """Change of a potential of a distance over a step. A subclass has the potential."""

    distance: StatusName

    def init(self, sim: Sim) -> Potential:
        current = self._potential(sim)
        return Potential(current=current, change=jnp.zeros_like(current))

    def increment(self, memory: Potential, sim: Sim, dt: Number) -> Potential:
        current = self._potential(sim)
        return Potential(current=current, change=current - memory.current)

    def process(self, memory: Potential, sim: Sim) -> Float[Array, ""]:
        return memory.change

    @abstractmethod
    def _potential(self, sim: Sim) -> Float[Array, ""]:
        """Return the potential at the distance of now."""


class DistanceChange(PotentialChange, type="distance_change"):
    """Change of an exponential potential of a distance d over a step.

    It is scale·(e^(−a d_t) − e^(−a d_(t−1))) with a = ln 2 / half_distance.
    """

    half_distance: Annotated[Length, Extent]
    scale: Pay = 2.0

    def _potential(self, sim: Sim) -> Float[Array, ""]:
        return self.scale * jnp.exp(-jnp.log(2.0) / self.half_distance * sim.status[self.distance])


class LogDistanceChange(PotentialChange, type="log_distance_change"):
    """Change of a logarithmic potential of a distance d over a step.

    It is scale·ln((d_(t−1) + offset)/(d_t + offset)), so halving the distance pays the same from
    anywhere far away. Below a speed limit ν₀ + ν₁d, with an offset of ν₀/ν₁, a second of flight at
    the limit pays scale·ν₁ whatever the distance.
    """

    offset: Annotated[Length, Extent]
    scale: Pay = 1.0

    def _potential(self, sim: Sim) -> Float[Array, ""]:
        return -self.scale * jnp.log(sim.status[self.distance] + self.offset)


class Stay(Record):
    """Memory of `WhileIn`."""

    inside: Bool[Array, ""]  # whether the status is true
    paid: Float[Array, ""]  # sum since the status was last false
    value: Float[Array, ""]  # the reward of this step


class WhileIn(Reward, type="while_in"):
    """A reward for each step on which a boolean status is true, Table 7.

    When the status turns false, all that was paid since it turned true is taken back. So the sum
    over an episode is never negative, and coming and going pays nothing. With `both_samples` the
    status must also have been true one step before.
    """

    status: FlagName
    value: Pay = 0.1
    both_samples: bool = False

    def init(self, sim: Sim) -> Stay:
        return Stay(
            inside=sim.status[self.status],
            paid=jnp.zeros_like(self.value),
            value=jnp.zeros_like(self.value),
        )

    def increment(self, memory: Stay, sim: Sim, dt: Number) -> Stay:
        inside = sim.status[self.status]
        earned = jnp.where(memory.inside, self.value, 0.0) if self.both_samples else self.value
        value = jnp.where(inside, earned, 0.0 - memory.paid)
        return Stay(inside=inside, paid=memory.paid + value, value=value)

    def process(self, memory: Stay, sim: Sim) -> Float[Array, ""]:
        return memory.value


class Arrival(Record):
    """Memory of `FirstTime`."""

    before: Bool[Array, ""]  # whether the status has been true in this episode, this step included
    now: Bool[Array, ""]  # whether it is true for the first time on this step


class FirstTime(Reward, type="first_time"):
    """A reward on the first step of the episode on which a boolean status is true, Table 7.

    A start in which the status is true already counts as the first time, so nothing is paid later.
    Without `count_start` it does not count, and the first step is paid.
    """

    status: FlagName
    value: Pay = 0.25
    count_start: bool = True

    def init(self, sim: Sim) -> Arrival:
        held = sim.status[self.status] & self.count_start
        return Arrival(before=held, now=jnp.zeros_like(held))

    def increment(self, memory: Arrival, sim: Sim, dt: Number) -> Arrival:
        held = sim.status[self.status]
        return Arrival(before=memory.before | held, now=held & ~memory.before)

    def process(self, memory: Arrival, sim: Sim) -> Float[Array, ""]:
        return jnp.where(memory.now, self.value, 0.0)


class VelocityConstraint(Reward, type="velocity_constraint"):
    """The term offset + scale·(‖v‖ − v_limit) on a step with ‖v‖ > v_limit, else 0, Table 8."""

    speed: StatusName
    velocity_limit: StatusName
    offset: Pay = -0.01
    scale: PerMetrePerSecond = -0.01

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        excess = sim.status[self.speed] - sim.status[self.velocity_limit]
        return jnp.where(excess > 0.0, self.offset + self.scale * excess, 0.0)


class DeltaVCost(Reward, type="delta_v"):
    """The term scale·‖u/m‖Δt, Table 8.

    The control u is the one that acted, after run time assurance.
    """

    delta_v: StatusName
    scale: PerMetrePerSecond = -0.01

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return self.scale * sim.status[self.delta_v]


class Intervention(Reward, type="intervention"):
    """A constant on every step on which run time assurance changed the control.

    With a negative `scale` a policy pays for leaning on run time assurance.
    """

    scale: Pay = -0.01

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return jnp.where(sim.intervening, self.scale, 0.0)


class Success(Reward, type="success"):
    """The term value − t/t_max on the step that ends the episode with `outcome`.

    Here t_max is `time_scale`. An earlier success pays more.
    """

    outcome: OutcomeName
    time_scale: Annotated[Number, Unit("s"), Range(0.0, open_low=True, smallest=1e-6)]
    value: Pay = 2.0

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return jnp.where(sim.ended[self.outcome], self.value - sim.time / self.time_scale, 0.0)


class Failure(Reward, type="failure"):
    """A constant for each outcome that is a failure, by its name."""

    values: Mapping[OutcomeName, Pay]

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        terms = [
            jnp.where(sim.ended[outcome], value, 0.0) for outcome, value in self.values.items()
        ]
        return jnp.sum(jnp.stack(terms))
