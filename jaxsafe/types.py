"""The map of the house: the records that flow through one step, and the units that annotate parameters.

Shapes are those of one environment; `jax.vmap` adds leading axes. `d` is 2 or 3, the dimension of space.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Annotated, Any, Self, dataclass_transform

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.schema.component import Range, Refers, Unit

Key = Array
"""A typed PRNG key, as made by `jax.random.key`."""

Number = Any
"""An array; until the environment is built a float, or a tuple of floats."""
Positive = Range(0.0, open_low=True)

FAR = 1e12
"""The largest distance [m or ft]: the squares of distances that sum up over many steps are finite in single precision."""

Reach = Range(0.0, largest=FAR)
"""A distance, which may be 0."""

Extent = Range(0.0, open_low=True, smallest=1e-6, largest=FAR)
"""A distance that something is divided by."""

Place = Range(largest=FAR)
"""A coordinate, or another number of a start, on either side of 0."""

Control = Range(largest=1e9)
"""A control in physical units."""
Dimensionless = Annotated[Number, Unit("1")]
Length = Annotated[Number, Unit("m or ft")]
"""In the unit of the platforms: metres for spacecraft, feet for aircraft."""
MetresPerSecond = Annotated[Number, Unit("m/s")]
PerSecond = Annotated[Number, Unit("1/s")]
Radians = Annotated[Number, Unit("rad")]
Turn = Range(largest=1e4)
"""An angle [rad]: sines of larger ones lose digits in single precision."""
RadiansPerSecond = Annotated[Number, Unit("rad/s")]
Newtons = Annotated[Number, Unit("N")]
Kilograms = Annotated[Number, Unit("kg"), Range(0.0, open_low=True, smallest=1e-6, largest=FAR)]
Seconds = Annotated[Number, Unit("s"), Positive]

PlatformName = Annotated[str, Refers("platforms")]
RegionName = Annotated[str, Refers("regions")]
StatusName = Annotated[str, Refers("status", boolean=False)]
"""Of a status that is a number."""
FlagName = Annotated[str, Refers("status", boolean=True)]
"""Of a status that is true or false."""
AnyStatusName = Annotated[str, Refers("status")]
ConstraintName = Annotated[str, Refers("constraints")]
OutcomeName = Annotated[str, Refers("outcomes")]
ParameterPath = Annotated[str, Refers("parameters")]


@dataclass_transform(frozen_default=True)
class Record:
    """A frozen dataclass in which every field is a leaf or a subtree: what components compute, not what they are."""

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True)(cls)
        jax.tree_util.register_dataclass(cls, list(cls.__dataclass_fields__), [])  # type: ignore[attr-defined]

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


def is_key(x: Any) -> bool:
    """Whether this is a typed PRNG key, an array of them, or the shape of one; files and hosts hold their words."""
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def units(record: type[Record]) -> dict[str, str]:
    """The unit of each field of a platform's state, from its annotations."""
    hints = typing.get_type_hints(record, include_extras=True)
    marks = {
        name: next((mark for mark in typing.get_args(hint)[1:] if isinstance(mark, Unit)), None)
        for name, hint in hints.items()
    }
    return {name: mark.symbol for name, mark in marks.items() if mark}


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
    ended: Mapping[str, Bool[Array, ""]]  # by outcome name but `running`; at most one is True, see `Terminal.apart`
    intervening: Bool[Array, ""]  # whether run time assurance changed the control of the step that led here


class Memory(Record):
    """What the processors remember from step to step, by name; `()` for those that remember nothing."""

    status: Mapping[str, Any]
    reward: Mapping[str, Any]
    observation: Mapping[str, Any]
    rta: Any  # of run time assurance


class State(Record):
    """Everything that `step` needs besides the environment's own parameters."""

    sim: Sim
    memory: Memory
    reward_totals: Mapping[str, Float[Array, ""]]  # sum of each reward term since the start of the episode
    num_steps: Int[Array, ""]  # steps taken in this episode
    parameters: Mapping[str, Float[Array, ""]]  # numbers of the environment drawn for this episode, by dotted path


class RTAInfo(Record):
    """What run time assurance did on a step."""

    correction: Float[Array, ""]  # ‖u_act − u_des‖, physical units
    feasible: Bool[Array, ""]  # whether some control met the filter's constraints
    certified: Bool[Array, ""]  # whether the control that acts is known to be safe
    predicted_margin: Float[Array, ""]  # smallest h after the step, for separations also on the way, as predicted
    backup_index: Int[Array, ""]  # the backup controller in reserve


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
    severity: Mapping[str, Float[Array, ""]]  # max(0, −h) as a share of the constraint's limit; 1 where h is not a number
    rta: RTAInfo | None  # None without run time assurance


class TimeStep(Record):
    """What an agent receives after `reset` or `step`."""

    observation: Float[Array, " observation"]
    reward: Float[Array, ""]
    cost: Float[Array, ""]  # 1 on a step that violates a safety constraint or ends with `diverged`, else 0
    terminated: Bool[Array, ""]  # the task ended: no value beyond this state
    truncated: Bool[Array, ""]  # cut short: the value of `observation` still counts
    info: Info

    @property
    def done(self) -> Bool[Array, ""]:
        """Whether the episode is over, for either reason."""
        return self.terminated | self.truncated
