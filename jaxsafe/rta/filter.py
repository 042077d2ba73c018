"""The base of filters between desired and actual control."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.rta.projection import within
from jaxsafe.schema.component import Component, Unit
from jaxsafe.transition import bounds
from jaxsafe.types import Number, ParameterPath, Record, RTAInfo, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

NO_CONSTRAINT = functools.partial(jnp.full, (), -1, jnp.int32)
"""A function that returns the index −1 as an array. It stands for "no constraint"."""


class RTA(Component):
    """A filter between desired and actual control (Section 2, Fig. 2).

    It is pure. What it remembers is part of the environment's state.

    It predicts with the numbers of the environment. `model` replaces some of them by dotted path.
    So a filter with `{deputy.mass: 12}` predicts with a mass of 12 kg, whatever the true mass is.
    """

    model: Mapping[ParameterPath, Annotated[Number, Unit("physical")]] = dataclasses.field(
        default_factory=dict
    )

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        """Return reasons why the filter would be useless, each with whether it applies at a state.

        They are asked for once, when the environment is built.
        """
        return {}

    def begin(self, env: Environment, sim: Sim) -> tuple[Any, RTAInfo]:
        """Return the memory at the start of an episode and the facts about the start.

        The memory is a record that has a field `intervening`.
        """
        raise NotImplementedError

    def filter(
        self, env: Environment, sim: Sim, memory: Any, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Any, RTAInfo]:
        """Return the control that acts, the memory after it, and what happened.

        Args:
            env: the environment, with the numbers of this episode.
            sim: the simulation before the step.
            memory: the memory after the last step.
            desired: the agent's control in physical units and action order. Elements that are not
                finite are never passed on.
        """
        raise NotImplementedError


class UnderWay(Record):
    """Controls that have been chosen but do not act yet. The first one acts next."""

    controls: Float[Array, "delay m"]
    certified: Bool[Array, " delay"]  # whether the state after each is known to be safe


class RTAMemory(Record):
    """Memory of a filter."""

    intervening: Bool[Array, ""]  # whether it changed the control of the last step
    backup_index: Int[Array, ""]  # the backup controller that the last certificate is about
    certified: Bool[Array, ""]  # whether following that backup controller is known to be safe
    ahead: Mapping[str, Any]  # platforms at the end of the certificate's horizon; empty without one
    # `Sim.actuators` and `Sim.remembered` at the end of the horizon.
    actuators_ahead: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    remembered_ahead: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    backups: tuple[Any, ...] = ()  # what each backup controller remembers
    backups_ahead: tuple[Any, ...] = ()  # the same at the end of the horizon
    under_way: UnderWay | tuple[()] = ()  # empty without a delay


def admissible(
    env: Environment, control: Float[Array, " m"]
) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
    """Return the control within its bounds and whether all elements are finite.

    Elements that are not finite become 0 before they are brought within the bounds.
    """
    low, high = bounds(env)
    finite = jnp.isfinite(control)
    return within(jnp.where(finite, control, 0.0), low, high), jnp.all(finite)


def altered(env: Environment, correction: Float[Array, " m"], tolerance: Number) -> Bool[Array, ""]:
    """Return whether a correction counts as an intervention.

    Args:
        env: the environment.
        correction: the change of each control, in physical units and action order.
        tolerance: the largest share of a control's range that does not count.
    """
    low, high = bounds(env)
    return jnp.any(jnp.abs(correction) > tolerance * (high - low))


def repeated(parts: Sequence[Any]) -> str | None:
    """Return what is wrong if two parts have the same name, else None."""
    names = [part.name for part in parts]
    twice = next((name for name in names if names.count(name) > 1), None)
    return f"the name {twice!r} is there twice" if twice else None
