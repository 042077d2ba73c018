"""Predicted ways of backup controllers, and the one of them that is in reserve."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.rta.certificate import BackupController
from jaxsafe.transition import Others
from jaxsafe.types import Record, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


class Paths(Record):
    """Predicted ways from one state, one for each backup controller."""

    margins: Float[Array, "backups c"]  # smallest h of each constraint on the way
    least: Float[Array, " backups"]  # the smallest of these, to be compared with the margin
    # Whether the way ends in the terminal set and the proof holds. The margin is not looked at.
    certified: Bool[Array, " backups"]
    memories_ahead: tuple[Any, ...]  # what each backup controller remembers at its end
    # Platforms, `Sim.actuators` and `Sim.remembered` at the end, [backups, ...]; empty without a
    # horizon.
    ahead: Mapping[str, Any]
    actuators_ahead: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    remembered_ahead: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def values(self) -> Float[Array, " backups"]:
        """Smallest h on each way, −∞ where the way proves nothing whatever its h."""
        return jnp.where(self.certified, self.least, -jnp.inf)


class Way(Record):
    """The predicted way of one backup controller, with what `Paths` says of it."""

    index: Int[Array, ""]  # of the backup controller
    margins: Float[Array, " c"]
    value: Float[Array, ""]
    memories_ahead: tuple[Any, ...]  # of all backup controllers, and only that of this one counts
    ahead: Mapping[str, Any]
    actuators_ahead: Mapping[str, Any]
    remembered_ahead: Mapping[str, Any]


class Reserve:
    """One of several backup controllers, whose index may differ between members of a batch.

    Its memory is the memories of all.
    """

    def __init__(self, backups: Sequence[BackupController], index: Int[Array, ""]) -> None:
        self.backups = backups
        self.index = index
        self.merged = backups[0].merged(backups, index) if len(backups) > 1 else None
        self.within_limits = all(backup.within_limits for backup in backups)

    def act(
        self, env: Environment, sim: Sim, later: Others, memories: tuple[Any, ...]
    ) -> tuple[Float[Array, " m"], tuple[Any, ...]]:
        """Return the control of the chosen one, and the memories as if all had acted."""
        if self.merged is not None:
            return self.merged.control(env, sim, later), memories
        pairs = zip(self.backups, memories, strict=True)
        acts = [backup.act(env, sim, later, own) for backup, own in pairs]
        controls = jnp.stack([control for control, _ in acts])
        control = controls[self.index] if len(acts) > 1 else controls[0]
        return control, tuple(moved for _, moved in acts)
