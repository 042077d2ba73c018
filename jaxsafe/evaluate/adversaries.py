"""Policies that try to leave the safe set.

They see the whole state and command extreme controls.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.processors.terminal import TooFar, time_limit
from jaxsafe.rta.certified import CertifiedRTA
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.transition import advance, bounds, smallest_margin
from jaxsafe.types import Key, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

Adversary = Callable[[Any, Sim, Key], Float[Array, " m"]]
"""A function `adversary(env, sim, key)` that returns a control in physical units."""


def uniform(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return a control that is uniform between its bounds."""
    low, high = bounds(env)
    return low + (high - low) * jax.random.uniform(key, low.shape)


def bang_bang(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return a control with every actuator at one of its two bounds, chosen at random."""
    return _random_bounds(env, key)


def greedy(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return the control that lowers the smallest h after the step most steeply.

    Where the control has no influence it is random.
    """

    def h(u: Float[Array, " m"]) -> Float[Array, ""]:
        return smallest_margin(env, advance(env, sim, u))

    return _steer(env, h, sign=-1.0, key=key)


def inward(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return a control towards the other platform. It pursues, and rams from behind."""
    return _towards(env, sim, _to_target(env, sim), key)


def outward(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return a control away from the other platform."""
    return _towards(env, sim, -_to_target(env, sim), key)


def sideways(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return a control across the velocity. It bends the path and at first keeps the speed.

    On a line no direction is across the velocity, and the control is random.
    """
    velocity = sim.platforms[env.agent].velocity
    if velocity.size == 1:
        return _random_bounds(env, key)
    across = jnp.stack([-velocity[1], velocity[0], *jnp.zeros(velocity.size - 2)])
    return _towards(env, sim, across, key)


def accelerate(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return a control along the velocity."""
    return _towards(env, sim, sim.platforms[env.agent].velocity, key)


def intercept(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return a control towards the point where the agent can meet the other platform.

    The agent is taken to keep its speed, and the other platform its velocity.
    """
    own = sim.platforms[env.agent]
    other = other_platform(env, sim)
    ahead = other.position - own.position
    speed = jnp.maximum(safe_norm(own.velocity), 1e-3)
    time = safe_norm(ahead) / speed
    for _ in range(4):
        time = safe_norm(ahead + other.velocity * time) / speed
    return _towards(env, sim, ahead + other.velocity * time, key)


def head_on(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return a control that leads 2500 ft or m ahead of the other platform and then back onto it.

    The agent turns back once it is 1500 ft or m ahead.
    """
    own = sim.platforms[env.agent]
    other = other_platform(env, sim)
    course = other.velocity / jnp.maximum(safe_norm(other.velocity), 1e-3)
    ahead = jnp.sum((own.position - other.position) * course)
    aim = jnp.where(ahead > 1500.0, 0.0, 2500.0) * course + other.position
    return _towards(env, sim, aim - own.position, key)


def there_and_back(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return a control that leads away from the other platform and then back.

    The agent turns back after three quarters of the longest episode, or at half of the largest
    distance that is allowed.
    """
    way = _to_target(env, sim)
    end = time_limit(env)
    back = jnp.zeros((), bool) if end is None else sim.time > 0.75 * end
    for condition in env.terminal:
        if isinstance(condition, TooFar):
            back = back | (safe_norm(way) > 0.5 * condition.limit)
    return _towards(env, sim, jnp.where(back, way, -way), key)


def drain(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Return, of the controls that a filter certifies, the one with the least h on the way.

    Controls with every actuator at a bound or in the middle are compared. If no filter certifies
    controls, the one with the least h after the step is returned.
    """
    low, high = bounds(env)
    shares = jnp.array(list(itertools.product((0.0, 0.5, 1.0), repeat=low.shape[0])))
    controls = low + shares * (high - low)

    def value(u: Float[Array, " m"]) -> Float[Array, ""]:
        later = advance(env, sim, u)
        if not isinstance(env.rta, CertifiedRTA):
            return smallest_margin(env, later)
        least = jnp.max(env.rta.certify(env, sim, later))
        return jnp.where(least >= env.rta.margin_to_certify(env, u), least, jnp.inf)

    values = jax.lax.map(value, controls)
    return controls[jnp.argmin(jnp.where(jnp.isnan(values), jnp.inf, values))]


ADVERSARIES: dict[str, Adversary] = {
    adversary.__name__: adversary
    for adversary in (
        uniform,
        bang_bang,
        greedy,
        inward,
        outward,
        sideways,
        accelerate,
        intercept,
        head_on,
        there_and_back,
        drain,
    )
}
"""All adversaries by name."""


def other_platform(env: Environment, sim: Sim) -> Any:
    """Return the state of the first platform that is not the agent."""
    others = [platform.name for platform in env.platforms if platform.name != env.agent]
    return sim.platforms[others[0]]


def _random_bounds(env: Environment, key: Key) -> Float[Array, " m"]:
    low, high = bounds(env)
    return jnp.where(jax.random.bernoulli(key, shape=low.shape), low, high)


def _to_target(env: Environment, sim: Sim) -> Float[Array, " d"]:
    return other_platform(env, sim).position - sim.platforms[env.agent].position


def _towards(env: Environment, sim: Sim, aim: Float[Array, " d"], key: Key) -> Float[Array, " m"]:
    """Return the control that turns the velocity of the next steps most towards a direction."""
    aim = aim / jnp.maximum(safe_norm(aim), 1e-6)

    def along(u: Float[Array, " m"]) -> Float[Array, ""]:
        later = advance(env, sim, u)
        return jnp.sum(aim * advance(env, later, jnp.zeros_like(u)).platforms[env.agent].velocity)

    return _steer(env, along, sign=1.0, key=key)


def _steer(
    env: Environment, value: Callable[[Array], Array], sign: float, key: Key
) -> Float[Array, " m"]:
    """Return a control with every actuator at the bound that increases `sign` · `value`.

    Where an actuator has no influence its bound is random.
    """
    low, high = bounds(env)
    slope = sign * jax.grad(value)((low + high) / 2.0)
    favoured = jnp.where(slope > 0.0, high, low)
    return jnp.where(slope == 0.0, _random_bounds(env, key), favoured)
