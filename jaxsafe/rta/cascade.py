"""A filter that consists of several filters in sequence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.filter import NO_CONSTRAINT, RTA, admissible, altered, repeated
from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.types import Number, Record, RTAInfo, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


class Stage(Component):
    """A filter with a name."""

    name: str
    rta: RTA


class CascadeMemory(Record):
    """Memory of a cascade."""

    intervening: Bool[Array, ""]  # whether the stages together changed the control of the last step
    stages: tuple[Any, ...]  # the memory of each stage


class Cascade(RTA, type="cascade"):
    """Filters in sequence: the control that one passes is the desired control of the next.

    The last filter has the last word. A certificate of one stage is void where a later stage
    intervenes. Constraints that must hold together belong into one filter, which predicts them
    together. A cascade is for different methods in order of importance.
    """

    stages: tuple[Stage, ...]
    tolerance: Annotated[Number, Unit("1"), Range(0.0)] = 0.0

    @property
    def constraints(self) -> tuple[str, ...]:
        """The constraints of all stages, one stage after another.

        `info.rta.constraint` is an index into them.
        """
        return tuple(name for stage in self.stages for name in _constraints(stage.rta))

    def problem(self) -> str | None:
        if not self.stages:
            return "expected at least one stage"
        for stage in self.stages[:-1]:
            bound = getattr(stage.rta, "bound", None)
            if bound is not None and bound.delay:
                return f"stage {stage.name!r} has a bound.delay, which only the last stage may have"
        return repeated(self.stages)

    @property
    def _first_indices(self) -> list[int]:
        """The index of each stage's first constraint among those of all stages."""
        counts = [len(_constraints(stage.rta)) for stage in self.stages]
        return [sum(counts[:index]) for index in range(len(counts))]

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        return {
            f"{stage.name}: {fault}": applies
            for stage in self.stages
            for fault, applies in stage.rta.unsuited(env, sim).items()
        }

    def begin(self, env: Environment, sim: Sim) -> tuple[CascadeMemory, RTAInfo]:
        memories, infos = zip(*(stage.rta.begin(env, sim) for stage in self.stages), strict=True)
        memory = CascadeMemory(intervening=jnp.zeros((), bool), stages=memories)
        return memory, _combined(infos, jnp.ones_like(infos[-1].certified), self._first_indices)

    def filter(
        self, env: Environment, sim: Sim, memory: CascadeMemory, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], CascadeMemory, RTAInfo]:
        control = desired
        memories = []
        infos = []
        valid = jnp.ones((), bool)
        for stage, stage_memory in zip(self.stages, memory.stages, strict=True):
            control, stage_memory, info = stage.rta.filter(env, sim, stage_memory, control)
            valid = (valid & ~stage_memory.intervening) | (len(memories) == 0)
            memories.append(stage_memory)
            infos.append(info)
        wanted, finite = admissible(env, desired)
        correction = control - wanted
        intervening = altered(env, correction, self.tolerance) | ~finite
        info = _combined(infos, valid, self._first_indices)
        info = info.replace(
            correction=safe_norm(correction),
            constraint=jnp.where(intervening, info.constraint, NO_CONSTRAINT()),
        )
        return control, CascadeMemory(intervening=intervening, stages=tuple(memories)), info


def _constraints(rta: RTA) -> tuple[str, ...]:
    return getattr(rta, "constraints", ())


def _combined(infos: Any, valid: Bool[Array, ""], first_indices: Sequence[int]) -> RTAInfo:
    """Return the facts about all stages together. The last stage that changed the control says why.

    Args:
        infos: the facts about each stage, in order.
        valid: whether the certificates of earlier stages still count.
        first_indices: the index of each stage's first constraint among those of all stages.
    """
    cause = NO_CONSTRAINT()
    for info, first in zip(infos, first_indices, strict=True):
        cause = jnp.where(info.constraint >= 0, info.constraint + first, cause)
    last = infos[-1]
    all_certified = jnp.all(jnp.stack([info.certified for info in infos]))
    return last.replace(
        feasible=jnp.all(jnp.stack([info.feasible for info in infos])),
        certified=all_certified & valid,
        predicted_margin=jnp.min(jnp.stack([info.predicted_margin for info in infos])),
        constraint=cause,
    )
