"""Filters one after another."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.filter import RTA, admissible, repeated
from jaxsafe.schema.component import Component
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.types import Record, RTAInfo, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


class Stage(Component):
    """A filter with a name."""

    name: str
    rta: RTA


class CascadeMemory(Record):
    """What the stages remember."""

    intervening: Bool[Array, ""]
    stages: tuple[Any, ...]


class Cascade(RTA, type="cascade"):
    """Filters one after another: what one lets pass the next takes for desired, and the last has the last word.

    A certificate of one stage is void where a later one intervenes. Constraints that must hold together belong into one
    filter, which predicts them together; a cascade is for different methods in order of importance.
    """

    stages: tuple[Stage, ...]

    def problem(self) -> str | None:
        return repeated(self.stages) if self.stages else "expected at least one stage"

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        return {
            f"{stage.name}: {fault}": found
            for stage in self.stages
            for fault, found in stage.rta.unsuited(env, sim).items()
        }

    def begin(self, env: Environment, sim: Sim) -> tuple[CascadeMemory, RTAInfo]:
        memories, infos = zip(*(stage.rta.begin(env, sim) for stage in self.stages), strict=True)
        return CascadeMemory(jnp.zeros((), bool), memories), _together(infos, jnp.ones_like(infos[-1].certified))

    def filter(
        self, env: Environment, sim: Sim, memory: CascadeMemory, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], CascadeMemory, RTAInfo]:
        control, memories, infos = desired, [], []
        valid = jnp.ones((), bool)
        for stage, own in zip(self.stages, memory.stages, strict=True):
            control, own, info = stage.rta.filter(env, sim, own, control)
            valid = (valid & ~own.intervening) | (len(memories) == 0)
            memories.append(own)
            infos.append(info)
        wanted, finite = admissible(env, desired)
        correction = safe_norm(control - wanted)
        info = _together(infos, valid).replace(correction=correction)
        return control, CascadeMemory((correction > 0.0) | ~finite, tuple(memories)), info


def _together(infos: Any, valid: Bool[Array, ""]) -> RTAInfo:
    """What all stages say; `valid` tells whether the earlier certificates still count."""
    last = infos[-1]
    every = jnp.all(jnp.stack([info.certified for info in infos]))
    return last.replace(
        feasible=jnp.all(jnp.stack([info.feasible for info in infos])),
        certified=every & valid,
        predicted_margin=jnp.min(jnp.stack([info.predicted_margin for info in infos])),
    )
