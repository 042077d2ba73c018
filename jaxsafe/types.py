"""The map of the house: the records that flow through one step, and the units that annotate parameters.

Shapes are those of one environment; `jax.vmap` adds leading axes. `d` is 2 or 3, the dimension of space.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Self, dataclass_transform

import jax
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.component import Range, Refers, Unit

Key = Array
"""A typed PRNG key, as made by `jax.random.key`."""

Number = Any
"""An array; until the environment is built a float, or a tuple of floats."""
Positive = Range(0.0, open_low=True)
Dimensionless = Annotated[Number, Unit("1")]
Metres = Annotated[Number, Unit("m")]
MetresPerSecond = Annotated[Number, Unit("m/s")]
PerSecond = Annotated[Number, Unit("1/s")]
RadiansPerSecond = Annotated[Number, Unit("rad/s")]
Newtons = Annotated[Number, Unit("N")]
Kilograms = Annotated[Number, Unit("kg"), Positive]
Seconds = Annotated[Number, Unit("s"), Positive]

PlatformName = Annotated[str, Refers("platforms")]
RegionName = Annotated[str, Refers("regions")]
StatusName = Annotated[str, Refers("status")]
OutcomeName = Annotated[str, Refers("outcomes")]


@dataclass_transform(frozen_default=True)
class Record:
    """A frozen dataclass in which every field is a leaf or a subtree: what components compute, not what they are."""

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True)(cls)
        jax.tree_util.register_dataclass(cls, list(cls.__dataclass_fields__), [])  # type: ignore[attr-defined]

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


class RegionState(Record):
    """Where a region is now and which platforms are in it."""

    position: Float[Array, " d"]  # of its centre, in the units of its task
    inside: Mapping[str, Bool[Array, ""]]  # by platform name


class Sim(Record):
    """The simulated world at one instant, as processors and controllers see it."""

    time: Float[Array, ""]  # s since the start of the episode
    platforms: Mapping[str, Any]  # by name, each the state record of its kind of platform
    regions: Mapping[str, RegionState]  # by name
    status: Mapping[str, Array]  # by name; while statuses are computed it holds only the earlier ones
    ended: Mapping[str, Bool[Array, ""]]  # by outcome name but `running`; at most one is True


class Memory(Record):
    """What the processors remember from step to step, by name; `()` for those that remember nothing."""

    status: Mapping[str, Any]
    reward: Mapping[str, Any]
    observation: Mapping[str, Any]


class State(Record):
    """Everything that `step` needs besides the environment's own parameters."""

    sim: Sim
    memory: Memory
    reward_totals: Mapping[str, Float[Array, ""]]  # sum of each reward term since the start of the episode
    num_steps: Int[Array, ""]  # steps taken in this episode


class Info(Record):
    """Facts about a step that are not part of the learning signal."""

    outcome: Int[Array, ""]  # index into `env.outcomes`, 0 while running
    status: Mapping[str, Array]
    reward_terms: Mapping[str, Float[Array, ""]]  # of this step; they sum to the reward
    reward_totals: Mapping[str, Float[Array, ""]]  # of this episode so far
    control_desired: Float[Array, " actuators"]  # what the agent asked for, physical units, order of `env.action_names`
    control_actual: Float[Array, " actuators"]  # what the plant received, after run time assurance
    intervening: Bool[Array, ""]  # whether run time assurance changed the control
    margins: Mapping[str, Float[Array, ""]]  # signed h(x) of every safety constraint, safe where ≥ 0
    severity: Mapping[str, Float[Array, ""]]  # max(0, −h) as a share of the constraint's limit at this step


class TimeStep(Record):
    """What an agent receives after `reset` or `step`."""

    observation: Float[Array, " observation"]
    reward: Float[Array, ""]
    cost: Float[Array, ""]  # 1 on a step that violates a safety constraint, else 0
    terminated: Bool[Array, ""]  # the task ended: no value beyond this state
    truncated: Bool[Array, ""]  # cut short: the value of `observation` still counts
    info: Info

    @property
    def done(self) -> Bool[Array, ""]:
        """Whether the episode is over, for either reason."""
        return self.terminated | self.truncated
