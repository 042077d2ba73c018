"""The processor state machine of Fig. 11.

A processor has a memory. `increment` moves it once a step, and `process` only reads it.
"""

from __future__ import annotations

from typing import Any, ClassVar

from jaxsafe.schema.component import Component
from jaxsafe.types import Number, Sim


class Processor(Component):
    """Base of statuses, rewards and observations. A part without memory writes `process` only."""

    many_kinds: ClassVar[bool] = True
    name: str

    def init(self, sim: Sim) -> Any:
        """Return the memory at the start of an episode."""
        return ()

    def increment(self, memory: Any, sim: Sim, dt: Number) -> Any:
        """Return the memory after a step that led to `sim`.

        It is called exactly once a step and never at reset.

        Args:
            memory: the memory before the step.
            sim: the simulation after the step.
            dt: length of the step [s].
        """
        return memory

    def process(self, memory: Any, sim: Sim) -> Any:
        """Return the output and change nothing."""
        raise NotImplementedError
