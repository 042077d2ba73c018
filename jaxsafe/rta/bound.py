"""A bound on how far the true world may be from the one that a filter predicts with.

Proposition 11 of docs/safety/proofs.md says which margin of a speed limit makes up for it. For
aircraft, `jaxsafe.rta.tube` has tubes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Self

import jax
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

        That is the measured state. With a delay it is the state that is predicted from it, and the
        controls that act until then are taken to be as strong as they can be.
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
            acceleration: the acceleration by the thrust on the step, as the filter knows it [m/s²].
        """
        dt = facts.dt
        n = facts.mean_motion
        wrong_thrust = self.mass / (1.0 - self.mass) + 2.0 * jnp.sin(self.misalignment / 2.0)
        wrong = wrong_thrust * acceleration + self.process
        # The norms of the exact map are at most by this factor above 1, dt and 3 n² dt.
        orbit = 1.0 + 2.0 * (n * dt) ** 2
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
            acceleration: the acceleration by the thrust on the step to that state [m/s²], as the
                filter knows it. None stands for the state before the step.
        """
        facts = speed_limits[0]
        errors = self.errors(facts)
        if acceleration is not None:
            errors = self.errors_after(facts, errors, acceleration)
        slopes = jnp.stack([jnp.abs(limit.slope) for limit in speed_limits])
        return errors.velocity + jnp.max(slopes) * errors.position

    def lost_by_drifting(
        self, speed_limits: Sequence[SpeedLimitFacts], num_steps: int
    ) -> Float[Array, ""]:
        """Return how far the true h may be below the predicted one after some steps [m/s].

        The true and the predicted way have the same controls, so only the process and the errors of
        the measured state let them drift apart.

        Args:
            speed_limits: the facts of the limits. The largest answer counts.
            num_steps: the number of steps.
        """
        facts = speed_limits[0]

        def one_step(_: Any, errors: Errors) -> Errors:
            return self.errors_after(facts, errors, jnp.zeros_like(facts.dt))

        start = jax.tree.map(lambda error: error + jnp.zeros_like(facts.dt), self.measured)
        errors = jax.lax.fori_loop(0, num_steps, one_step, start)
        slopes = jnp.stack([jnp.abs(limit.slope) for limit in speed_limits])
        return errors.velocity + jnp.max(slopes) * errors.position

    def reduced(self, facts: SpeedLimitFacts) -> SpeedLimitFacts:
        """Return the facts for which Proposition 11 asks the brake to hold the limit.

        The thrust is weaker by the h that the bound may cost before and after a step, divided by
        the length of a step. The limit is higher by what the bound costs before the step, because
        the measured speed may be above the true one by so much.
        """
        before = self.lost([facts])
        after = self.lost([facts], facts.strongest)
        return facts.replace(
            floor=facts.floor + before, weakest=facts.weakest - (before + after) / facts.dt
        )
