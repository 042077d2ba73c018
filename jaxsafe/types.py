"""The records that flow through one step, and the types of parameters with their units and ranges.

Shapes are those of one environment. `jax.vmap` adds leading axes. `d` is the dimension of space, 1
to 3.
"""

from __future__ import annotations

import dataclasses
import itertools
import typing
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Self, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.schema.component import Range, Refers, Unit
from jaxsafe.schema.describe import Described, Rows, brief, unbroken
from jaxsafe.schema.errors import ConfigError

Key = Array
"""A typed PRNG key, as made by `jax.random.key`."""

Number = Any
"""An array in an environment that is built. Before that, a float or a tuple of floats."""

MAX_DISTANCE = 1e12
"""The largest distance [m or ft].

The squares of such distances stay finite in single precision even when many steps sum them up.
"""

Positive = Range(0.0, open_low=True)
"""Range of a number above 0."""

Reach = Range(0.0, largest=MAX_DISTANCE)
"""Range of a distance that may be 0."""

Extent = Range(0.0, open_low=True, smallest=1e-6, largest=MAX_DISTANCE)
"""Range of a distance by which something is divided."""

Place = Range(largest=MAX_DISTANCE)
"""Range of a coordinate, or of another number of a start, which may be negative."""

Control = Range(largest=1e9)
"""Range of a control in physical units."""

Turn = Range(largest=1e4)
"""Range of an angle [rad]. Sines of larger angles lose digits in single precision."""

Dimensionless = Annotated[Number, Unit("1")]
Length = Annotated[Number, Unit("m or ft")]
"""A length in the unit of the platforms: metres for spacecraft, feet for aircraft."""
MetresPerSecond = Annotated[Number, Unit("m/s")]
PerSecond = Annotated[Number, Unit("1/s")]
Radians = Annotated[Number, Unit("rad")]
RadiansPerSecond = Annotated[Number, Unit("rad/s")]
Newtons = Annotated[Number, Unit("N")]
Kilograms = Annotated[
    Number, Unit("kg"), Range(0.0, open_low=True, smallest=1e-6, largest=MAX_DISTANCE)
]
Seconds = Annotated[Number, Unit("s"), Positive]


@dataclasses.dataclass(frozen=True)
class RefersInDetail(Refers):
    """Mark of a name that asks a region for more than its position and content.

    A region named in this way also computes how it moves, or how far away its boundary is. Other
    regions leave that out, see `RegionState`.
    """


PlatformName = Annotated[str, Refers("platforms")]
RegionName = Annotated[str, Refers("regions")]
"""Name of a region whose position and content are needed."""
ShapeName = Annotated[str, RefersInDetail("regions")]
"""Name of a region for which the distances of platforms to its boundary are needed too."""
CentreName = Annotated[str, Refers("places")]
"""Name of a platform or region whose position is needed."""
PlaceName = Annotated[str, RefersInDetail("places")]
"""Name of a platform or region whose position, velocity and orientation are needed."""
StatusName = Annotated[str, Refers("status", boolean=False)]
"""Name of a numeric status."""
FlagName = Annotated[str, Refers("status", boolean=True)]
"""Name of a status that is true or false."""
AnyStatusName = Annotated[str, Refers("status")]
ConstraintName = Annotated[str, Refers("constraints")]
OutcomeName = Annotated[str, Refers("outcomes")]
ParameterPath = Annotated[str, Refers("parameters")]


@dataclass_transform(frozen_default=True)
class Record(Described):
    """Base class of what components compute.

    A record is a frozen dataclass in which every field is a leaf or a subtree. It prints a line for
    each field, with the numbers of small arrays and the types and shapes of others. Fields of a
    record inside it share lines.
    """

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True, repr=False)(cls)
        names = list(cls.__dataclass_fields__)  # type: ignore[attr-defined]
        jax.tree_util.register_dataclass(cls, data_fields=names, meta_fields=[])

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def _rows(self) -> Rows:
        return _lines(self)


def _lines(record: Record, place: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each field of a record, without fields that have no text.

    A field that is itself a record of records or mappings yields its numbers in one line, and then
    its records and mappings one by one.

    Args:
        record: the record.
        place: the path of the record, or nothing if each of its own numbers has a line.
    """
    symbols = units(type(record))
    leaves = {
        name: (value, symbols.get(name, ""))
        for name, value in vars(record).items()
        if not _is_tree(value)
    }
    if place and (text := _named(leaves)):
        yield place, text
    for name, value in vars(record).items():
        path = f"{place}.{name}" if place else name
        if isinstance(value, Record) and any(map(_is_tree, vars(value).values())):
            yield from _lines(value, path)
            continue
        if place and name in leaves:
            continue
        parts = {path: value}
        if isinstance(value, Mapping) and any(map(_is_tree, value.values())):
            parts = {f"{path}.{key}": item for key, item in value.items()}
        texts = {part_path: _in_one_line(part) for part_path, part in parts.items()}
        yield from ((part_path, text) for part_path, text in texts.items() if text)


def _is_tree(value: Any) -> bool:
    return isinstance(value, Record | Mapping)


def _in_one_line(value: Any) -> str:
    """Return a leaf as text, or a tree with a name before each leaf. The text of `()` is empty."""
    if isinstance(value, Record):
        symbols = units(type(value))
        return _named({name: (x, symbols.get(name, "")) for name, x in vars(value).items()})
    if isinstance(value, Mapping):
        return _named({name: (x, "") for name, x in value.items()})
    if isinstance(value, tuple):
        return ", ".join(filter(None, map(_in_one_line, value)))
    return "none" if value is None else brief(value)


def _named(values: Mapping[str, tuple[Any, str]]) -> str:
    """Return values as text with their names and units, without those that have no text.

    Neighbours with the same text share it.
    """
    texts = {
        name: f"{_in_one_line(value)} {unit}".strip() for name, (value, unit) in values.items()
    }
    parts = []
    for text, group in itertools.groupby(filter(texts.get, texts), key=texts.get):
        *others, last = group
        parts += [*others, unbroken(f"{last} {text}")]
    return ", ".join(parts)


def place(sim: Sim, name: str) -> Any:
    """Return the state of a platform or of a region. A platform hides a region of its name."""
    return sim.platforms[name] if name in sim.platforms else sim.regions[name]


def is_key(x: Any) -> bool:
    """Return whether this is a typed PRNG key, an array of keys, or the shape of either.

    Such keys need care, because files and other processes receive only the words of a key.
    """
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def require_key(what: str, key: Any) -> None:
    """Reject a plain number, or several keys, where one key is needed.

    Args:
        what: the function and the argument, for the message.
        key: the key.

    Raises:
        ConfigError: it is a number, or there are several keys.
    """
    if isinstance(key, int | np.integer):
        raise ConfigError(f"{what}: expected a key, such as jax.random.key({key}), found {key}")
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    if typed and key.ndim:
        raise ConfigError(
            f"{what}: expected one key, found keys of shape {key.shape}; "
            "for one call with each, use jax.vmap"
        )


def units(record: type[Record]) -> dict[str, str]:
    """Return the units of the fields of a platform's state, by name.

    They stand in the annotations. A field without a unit is left out.
    """
    symbols = {}
    try:
        hints = typing.get_type_hints(record, include_extras=True)
    except NameError:
        # The class is defined inside a function, so Python cannot look up its annotations.
        return symbols
    for name, hint in hints.items():
        marks = [mark for mark in typing.get_args(hint)[1:] if isinstance(mark, Unit)]
        if marks:
            symbols[name] = marks[0].symbol
    return symbols


class RegionState(Record):
    """Where a region is now, and which platforms are in it."""

    position: Float[Array, " d"]  # of its centre, in the unit of the platforms
    inside: Mapping[str, Bool[Array, ""]]  # by platform name
    # The next two are () unless a part names the region as a `PlaceName`.
    velocity: Any = ()  # of its centre, shape (d,)
    orientation: Any = ()  # rotation from its axes to the global frame, shape (d, d)
    # By platform name, {} unless a part names the region as a `ShapeName`: the distance to the
    # boundary, which is negative inside, and the depth below the boundary, which is its opposite. A
    # filter predicts a step with lower bounds of both on the way, see `transition.judge`.
    distance: Mapping[str, Float[Array, ""]] = dataclasses.field(default_factory=dict)
    depth: Mapping[str, Float[Array, ""]] = dataclasses.field(default_factory=dict)


def _no_control() -> Float[Array, " 0"]:
    """Return the controls of a simulation without actuators, such as one made by hand."""
    return jnp.zeros(0, jnp.result_type(float))


class Sim(Record):
    """The simulated world at one instant, as processors and controllers see it."""

    time: Float[Array, ""]  # s since the start of the episode
    platforms: Mapping[str, Any]  # by name, each the state record of its kind of platform
    regions: Mapping[str, RegionState]  # by name
    status: Mapping[str, Array]  # by name; while statuses are computed, only the earlier ones
    # What ended the episode with this step, by outcome, see `Info.ended`. Empty in a state, because
    # a step never looks at an earlier outcome.
    ended: Mapping[str, Bool[Array, ""]]
    # Whether run time assurance changed the control of the step that led here.
    intervening: Bool[Array, ""]
    # The controls of the step that led here, in physical units and the order of `env.action_names`,
    # 0 at reset: what the agent asked for, and what its actuators were given after run time
    # assurance. In the predictions of a filter both are the control of the predicted step.
    control_desired: Float[Array, " actuators"] = dataclasses.field(default_factory=_no_control)
    control_actual: Float[Array, " actuators"] = dataclasses.field(default_factory=_no_control)
    # What each of the agent's actuators with a lag or a rate limit gives now, in physical units, by
    # name. Empty if all act at once.
    actuators: Mapping[str, Float[Array, ""]] = dataclasses.field(default_factory=dict)
    # In a filter's prediction, what those statuses remember on which safety constraints rest, by
    # name. Else it is empty.
    remembered: Mapping[str, Any] = dataclasses.field(default_factory=dict)


class Memory(Record):
    """What the processors remember from step to step, by name.

    A processor that remembers nothing has `()`.
    """

    status: Mapping[str, Any]
    reward: Mapping[str, Any]
    observation: Mapping[str, Any]
    rta: Any  # what run time assurance remembers
    # What the parts of `env.uncertainty` remember, by name.
    uncertainty: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    # Readings under way of the sensors that make errors, by the name of the observation.
    sensors: Mapping[str, Any] = dataclasses.field(default_factory=dict)


class State(Record):
    """Everything that `step` needs besides the environment's own parameters."""

    sim: Sim
    memory: Memory
    reward_totals: Mapping[str, Float[Array, ""]]  # each reward term summed over the episode so far
    num_steps: Int[Array, ""]  # steps of the world taken in this episode
    # Numbers of the environment drawn for this episode, by dotted path.
    parameters: Mapping[str, Float[Array, ""]]
    # Words of the key from which the episode's disturbances and errors of sensors are drawn,
    # uint32 of shape (2,), or () if nothing is random.
    key: Any = ()

    def _rows(self) -> Rows:
        """Yield a line for each part, one for all regions, and one with names for the memory."""
        regions, remembered = [], []
        for path, text in _lines(self):
            if path.startswith("sim.regions."):
                regions.append(f"{path.removeprefix('sim.regions.')} {text}")
            elif path.startswith("memory."):
                remembered.append(path.removeprefix("memory."))
            else:
                yield path, text
        if regions:
            yield "sim.regions", "; ".join(regions)
        if remembered:
            yield "memory", f"of {', '.join(remembered)}"


class RTAInfo(Record):
    """What run time assurance did on a step.

    With a `decision_period` the filter acts several times, and the numbers are the worst of these
    steps: the largest correction, the smallest margin, and whether all were feasible and certified.
    The backup controller is that of the last step, and the constraint that of the last change.
    """

    correction: Float[Array, ""]  # ‖u_act − u_des‖, physical units
    feasible: Bool[Array, ""]  # whether some control met the filter's constraints
    certified: Bool[Array, ""]  # whether the control that acts is known to be safe
    # Smallest h that is predicted after the step, and for separations also within the step.
    predicted_margin: Float[Array, ""]
    backup_index: Int[Array, ""]  # index of the backup controller in reserve
    # Index into `env.rta.constraints` of the constraint for which the control was changed, or −1 if
    # it was not changed.
    constraint: Int[Array, ""] = dataclasses.field(
        default_factory=lambda: jnp.full((), -1, jnp.int32)
    )


class Info(Record):
    """Facts about a step that are not part of the learning signal.

    With a `decision_period` a time step may be several steps of the world. Then the reward and its
    terms are sums over these steps. Margins are the smallest ones, severity and cost the largest.
    `control_actual` is the mean, and `intervening` says whether any control was changed. Outcome,
    totals, observation and statuses are those of the last step that was taken. A status that
    belongs to a step, such as `delta_v`, is a sum.
    """

    outcome: Int[Array, ""]  # index into `env.outcomes`, 0 while running
    # By outcome name, all but `running`. At most one is True, unless one stands apart, see
    # `Terminal.apart`. Then `outcome` is the first.
    ended: Mapping[str, Bool[Array, ""]]
    status: Mapping[str, Array]  # by name
    reward_terms: Mapping[str, Float[Array, ""]]  # of this step; their sum is the reward
    reward_totals: Mapping[str, Float[Array, ""]]  # each term summed over the episode so far
    # What the agent asked for, in physical units and the order of `env.action_names`.
    control_desired: Float[Array, " actuators"]
    # What its actuators were given, after run time assurance. The plant receives it at once, unless
    # an actuator has a lag or a rate limit.
    control_actual: Float[Array, " actuators"]
    intervening: Bool[Array, ""]  # whether run time assurance changed the control
    margins: Mapping[str, Float[Array, ""]]  # signed h(x) of each constraint, safe where ≥ 0
    # max(0, −h) as a share of the constraint's limit; 1 where h is not a number.
    severity: Mapping[str, Float[Array, ""]]
    rta: RTAInfo | None  # None without run time assurance


class TimeStep(Record):
    """What an agent receives after `reset` or `step`."""

    observation: Float[Array, " observation"]
    reward: Float[Array, ""]
    # 1 on a step that violates a safety constraint or ends with `diverged`, else 0. Where the
    # environment has `cost: severity`, it is the largest severity.
    cost: Float[Array, ""]
    terminated: Bool[Array, ""]  # the task ended: there is no value beyond this state
    truncated: Bool[Array, ""]  # cut short: the value of `observation` still counts
    info: Info
    # By the name of the constraint: 1 on a step that violates it, else 0, or the severity. The
    # largest is `cost`.
    costs: Mapping[str, Float[Array, ""]] = dataclasses.field(default_factory=dict)

    @property
    def done(self) -> Bool[Array, ""]:
        """Whether the episode is over, for either reason."""
        return self.terminated | self.truncated


class Transition(Record):
    """One step as a learner needs it: what was acted on, the action, and what came of it.

    `next_observation` is the observation after the step, also where the step ended the episode. The
    next transition of that environment then begins with the observation of a fresh start.
    """

    observation: Float[Array, " observation"]  # what the policy acted on
    action: Array  # what the policy returned
    reward: Float[Array, ""]
    cost: Float[Array, ""]  # as in `TimeStep`
    terminated: Bool[Array, ""]  # the task ended: there is no value beyond `next_observation`
    truncated: Bool[Array, ""]  # cut short: the value of `next_observation` still counts
    next_observation: Float[Array, " observation"]
    memory: Any  # what a `RecurrentPolicy` remembered when it acted, else `()`
    info: Info
    state: State | None  # the state before the step, if it was asked for
    costs: Mapping[str, Float[Array, ""]] = dataclasses.field(default_factory=dict)

    @property
    def done(self) -> Bool[Array, ""]:
        """Whether the step ended the episode, for either reason."""
        return self.terminated | self.truncated
