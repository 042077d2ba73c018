"""Scripts for platforms such as the lead (Section 3, Fig. 9).

A script is one command for each control that is not 0.
"""

from __future__ import annotations

from typing import Annotated

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.simulation.clock import reached
from jaxsafe.simulation.controllers import Bound, Controller, Controls
from jaxsafe.simulation.trig import sin_cos
from jaxsafe.types import Control, Number, Radians, Sim, Turn


class Command(Component):
    """Base of commands. Each gives the control that it is named after."""

    name: str

    def value(self, sim: Sim) -> Float[Array, ""]:
        """Return the control in physical units. It is held over the step that begins at `sim`."""
        raise NotImplementedError

    def extremes(self) -> tuple[Number, Number]:
        """Return the smallest and the largest control at any time. They are infinite if unknown."""
        return -jnp.inf, jnp.inf


class Scripted(Controller, type="scripted"):
    """A controller that follows its commands. Controls without a command are 0."""

    commands: tuple[Command, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(command.name for command in self.commands)

    def control(self, action: Array, sim: Sim) -> Controls:
        return {command.name: command.value(sim) for command in self.commands}


class Constant(Command, type="constant"):
    """The same value at all times. List it under `randomize` to draw it for each episode."""

    at: Bound

    def value(self, sim: Sim) -> Float[Array, ""]:
        return self.at

    def extremes(self) -> tuple[Number, Number]:
        return self.at, self.at


class Schedule(Command, type="schedule"):
    """A piecewise constant value: `values[k]` from `times[k]` until the next time.

    It is 0 before the first time.
    """

    times: Annotated[Number, Unit("s", length=0)]
    values: Annotated[Number, Unit("physical", length=0), Control]

    def problem(self) -> str | None:
        if self.times.shape != self.values.shape or not self.times.size:
            return (
                f"expected as many values as times, found {self.values.size} and {self.times.size}"
            )
        if not np.all(np.diff(self.times) > 0.0):
            return f"expected times in ascending order, found {self.times.tolist()}"
        return None

    def value(self, sim: Sim) -> Float[Array, ""]:
        steps = jnp.diff(self.values, prepend=0.0)
        return jnp.sum(jnp.where(reached(sim.time, self.times), steps, 0.0))

    def extremes(self) -> tuple[Number, Number]:
        return jnp.minimum(jnp.min(self.values), 0.0), jnp.maximum(jnp.max(self.values), 0.0)


class Sinusoid(Command, type="sinusoid"):
    """A weaving value: amplitude · sin(2π t/period + phase)."""

    amplitude: Bound
    period: Annotated[Number, Unit("s"), Range(0.0, open_low=True, smallest=1e-6)]
    phase: Annotated[Radians, Turn] = 0.0

    def value(self, sim: Sim) -> Float[Array, ""]:
        return self.amplitude * sin_cos(2.0 * jnp.pi * sim.time / self.period + self.phase)[0]

    def extremes(self) -> tuple[Number, Number]:
        size = jnp.abs(self.amplitude)
        return -size, size
