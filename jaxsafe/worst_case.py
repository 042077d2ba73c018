"""Disturbances and errors in the direction that brings the agent nearest to a violation.

They are parts of `uncertainty` for adversaries, and for training against them. Each looks one step
ahead: at the gradient of the smallest margin h of all safety constraints.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.uncertainty import Disturbance, Size, StateError
from jaxsafe.transition import advance, smallest_margin
from jaxsafe.types import Key, Seconds, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


class WorstDisturbance(Disturbance, type="worst"):
    """A disturbance of the size `bound` that lowers the smallest h after the step most steeply.

    It knows the control of the step. It is 0 where a disturbance has no influence on h.
    """

    bound: Size

    def increment(
        self, env: Environment, sim: Sim, key: Key, memory: Any, control: Float[Array, " m"]
    ) -> Any:
        after = advance(env, sim, control)

        def h(vector: Float[Array, " d"]) -> Float[Array, ""]:
            platforms = self.moved(env, vector, after.platforms)
            return smallest_margin(env, after.replace(platforms=platforms))

        return -self.bound * steepest(h, jnp.zeros_like(memory))


class WorstNavigationError(StateError, type="worst_navigation"):
    """An error of navigation of the size `bound` that makes the smallest h look largest.

    So a filter believes that the agent is farther from a violation than it is. The h is taken after
    all platforms have flown on for a step with their velocities, because h itself need not depend
    on a velocity.
    """

    bound: Size

    def init(self, env: Environment, sim: Sim, key: Key) -> Any:
        true_value = self.true(sim)

        def h(error: Float[Array, " k"]) -> Float[Array, ""]:
            seen = self.measured(env, sim, error.reshape(true_value.shape))
            ahead = {
                platform.name: _drifted(platform, seen.platforms[platform.name], env.dt)
                for platform in env.platforms
            }
            return smallest_margin(env, seen.replace(platforms=ahead, regions={}, status={}))

        flat = jnp.zeros_like(jnp.ravel(true_value))
        return (self.bound * steepest(h, flat)).reshape(true_value.shape)

    def increment(
        self, env: Environment, sim: Sim, key: Key, memory: Any, control: Float[Array, " m"]
    ) -> Any:
        return self.init(env, advance(env, sim, control), key)


def _drifted(platform: Platform, state: Any, dt: Seconds) -> Any:
    """Return the state of a platform that has flown on for `dt` with its velocity."""
    return platform.pushed(state, jnp.zeros_like(state.velocity), state.velocity, dt)


def steepest(h: Callable[[Array], Array], at: Float[Array, " d"]) -> Float[Array, " d"]:
    """Return the direction of length 1 in which h grows most steeply, or 0 where it is flat."""
    slope = jax.grad(h)(at)
    slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
    length = safe_norm(slope)
    return slope / jnp.where(length > 0.0, length, 1.0)
