"""Observations (Tables 5 and 6): each is divided by its constant and clipped; together they are one vector."""

from __future__ import annotations

from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.component import Unit
from jaxsafe.processors.processor import Processor
from jaxsafe.types import Number, PlatformName, Positive, Sim, StatusName

Scale = Annotated[Number, Unit("as observed"), Positive]
Limit = Annotated[Number, Unit("1", length=2)]


class Observation(Processor):
    """Base of all observations: `measure` in physical units; scale and clip are the same for all."""

    scale: Scale = 1.0
    clip: Limit | None = None

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        """Return the observed vector in physical units, shape (k,)."""
        raise NotImplementedError

    def labels(self, sim: Sim) -> tuple[str, ...]:
        """Name each of the k elements."""
        raise NotImplementedError

    def process(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        scaled = self.measure(memory, sim) / self.scale
        return scaled if self.clip is None else jnp.clip(scaled, self.clip[0], self.clip[1])


class Observe(Observation, type="observe"):
    """A vector field of a platform's state, in the global frame."""

    of: PlatformName
    what: str

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        return jnp.atleast_1d(getattr(sim.platforms[self.of], self.what))

    def labels(self, sim: Sim) -> tuple[str, ...]:
        size = self.measure((), sim).size
        return tuple(f"{self.of}.{self.what}.{axis}" for axis in "xyz"[:size]) if size > 1 else (f"{self.of}.{self.what}",)


class ObserveStatus(Observation, type="observe_status"):
    """A status, as a number."""

    status: StatusName

    def measure(self, memory: Any, sim: Sim) -> Float[Array, " k"]:
        return jnp.atleast_1d(jnp.asarray(sim.status[self.status], jnp.result_type(float)))

    def labels(self, sim: Sim) -> tuple[str, ...]:
        return (f"status.{self.status}",)
