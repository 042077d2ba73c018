"""The processor state machine of Fig. 11: memory that `increment` moves once a step and `process` only reads."""

from __future__ import annotations

from typing import Any, ClassVar

from jaxsafe.schema.component import Component
from jaxsafe.types import Number, Sim


class Processor(Component):
    """Base of statuses, rewards and observations. Stateless ones write `process` only."""

    many_kinds: ClassVar[bool] = True
    name: str

    def init(self, sim: Sim) -> Any:
        """Return the memory at the start of an episode."""
        return ()

    def increment(self, memory: Any, sim: Sim, dt: Number) -> Any:
        """Return the memory after a step that led to `sim`; called exactly once a step, never at reset."""
        return memory

    def process(self, memory: Any, sim: Sim) -> Any:
        """Return the output; changes nothing."""
        raise NotImplementedError
