"""The base of statuses, rewards and observations: the processor state machine of Fig. 11.

A processor has a memory. `increment` moves it once a step, and `process` only reads it.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from jaxtyping import Array, Bool

from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.types import Number, Sim

Limit = Annotated[Number, Unit("physical"), Range(infinite=True)]
"""A limit of a status, in the unit of the status. Infinity means no limit."""

Side = Literal["above", "below"]
"""The side of a limit."""


def beyond(value: Number, limit: Number, side: Side, inclusive: bool) -> Bool[Array, ""]:
    """Return whether a number is on one side of a limit.

    Args:
        value: the number.
        limit: the limit.
        side: the side.
        inclusive: whether the limit itself counts.
    """
    if side == "above":
        return value >= limit if inclusive else value > limit
    return value <= limit if inclusive else value < limit


class Processor(Component):
    """Base of statuses, rewards and observations. A part without memory writes `process` only."""

    many_kinds: ClassVar[bool] = True
    name: str

    @property
    def remembers(self) -> bool:
        """Whether the processor has a memory."""
        return type(self).init is not Processor.init

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
