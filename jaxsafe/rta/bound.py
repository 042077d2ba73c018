"""A bound on how far the true world may be from the one that a filter predicts with.

Proposition 11 of docs/safety/proofs.md says which margin of a speed limit makes up for it. For
aircraft, `jaxsafe.rta.tube` has tubes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.rta.speed_limit import SpeedLimitFacts
from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.types import Number, Record


class Errors(Record):
    """How far the true state may be from a measured or predicted one."""

    position: Float[Array, ""]  # ρ [m]
    velocity: Float[Array, ""]  # ν [m/s]


class UncertaintyBound(Component):
    """Limits of what the filter does not know. Whatever it certifies is safe within them."""

    process: Annotated[Number, Unit("m/s² or ft/s²"), Range(0.0, largest=1e6)] = 0.0
    """The largest acceleration ‖a‖ that disturbs the agent. It is held over a step."""
    mass: Annotated[Number, Unit("1"), Range(0.0, 1.0, open_high=True)] = 0.0
    """The share by which the true mass may differ from the mass that the filter knows."""
    misalignment: Annotated[Number, Unit("rad"), Range(0.0, 3.15)] = 0.0
    """The largest angle between the true thrust and the thrust that was asked for."""
    position: Annotated[Number, Unit("m or ft"), Range(0.0, largest=1e6)] = 0.0
    """The largest error of the agent's measured position."""
    velocity: Annotated[Number, Unit("m/s or ft/s"), Range(0.0, largest=1e6)] = 0.0
    """The largest error of the agent's measured velocity."""
    delay: Annotated[int, Range(0, largest=100)] = 0
    """The number of steps after which a control begins to act, which is known exactly."""

    @property
    def measured(self) -> Errors:
        """The errors of the measured state."""
        return Errors(position=jnp.asarray(self.position), velocity=jnp.asarray(self.velocity))

    def after_delay(self, errors: Errors) -> Self:
        """Return the bound for the state in which a control begins to act.

        Args:
            errors: the errors of that state.
        """
        return self.replace(position=errors.position, velocity=errors.velocity, delay=0)

    def errors(self, facts: SpeedLimitFacts) -> Errors:
        """Return the errors of the state in which the next control begins to act.

        That is the measured state, and with a delay the one that is predicted from it. Until then
        controls may be as strong as can be.
        """
        errors = self.measured
        for _ in range(self.delay):
            errors = self.errors_after(facts, errors, facts.strongest)
        return errors

    def errors_after(self, facts: SpeedLimitFacts, errors: Errors, acceleration: Number) -> Errors:
        """Return the errors one step later.

        Args:
            facts: numbers of the spacecraft.
            errors: the errors before the step.
            acceleration: that of the thrust on the step, as the filter knows it [m/s²].
        """
        dt = facts.dt
        n = facts.mean_motion
        wrong_thrust = self.mass / (1.0 - self.mass) + 2.0 * jnp.sin(self.misalignment / 2.0)
        wrong = wrong_thrust * acceleration + self.process
        orbit = (
            1.0 + 2.0 * (n * dt) ** 2
        )  # what the norms of the exact map have beyond their limits
        return Errors(
            position=orbit * (errors.position + dt * errors.velocity + 0.5 * dt**2 * wrong),
            velocity=orbit * (errors.velocity + 3.0 * n**2 * dt * errors.position + dt * wrong),
        )

    def lost(
        self, speed_limits: Sequence[SpeedLimitFacts], acceleration: Number | None = None
    ) -> Float[Array, ""]:
        """Return how far the true h may be below that of a measured or predicted state [m/s].

        Args:
            speed_limits: the facts of the limits. The largest answer counts.
            acceleration: that of the thrust on a step to the state [m/s²], as the filter knows it.
                None stands for the state before the step.
        """
        facts = speed_limits[0]
        errors = self.errors(facts)
        if acceleration is not None:
            errors = self.errors_after(facts, errors, acceleration)
        slopes = jnp.stack([jnp.abs(limit.slope) for limit in speed_limits])
        return errors.velocity + jnp.max(slopes) * errors.position

    def reduced(self, facts: SpeedLimitFacts) -> SpeedLimitFacts:
        """Return the facts with less thrust, as far as the bound takes its effect away.

        A measured speed may be above the limit by what is lost there, so the limit is higher.
        """
        before = self.lost([facts])
        after = self.lost([facts], facts.strongest)
        return facts.replace(
            floor=facts.floor + before, weakest=facts.weakest - (before + after) / facts.dt
        )
