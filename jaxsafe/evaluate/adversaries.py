"""Policies that try to leave the safe set: they see the whole state and command extreme controls."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.processors.terminal import TooFar, time_limit
from jaxsafe.rta.filter import CertifiedRTA
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.transition import advance, bounds, smallest_margin
from jaxsafe.types import Key, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

Adversary = Callable[[Any, Sim, Key], Float[Array, " m"]]
"""`adversary(env, sim, key)`: a control in physical units."""


def uniform(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Any control."""
    low, high = bounds(env)
    return low + (high - low) * jax.random.uniform(key, low.shape)


def bang_bang(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Every actuator at one of its bounds."""
    low, high = bounds(env)
    return jnp.where(jax.random.bernoulli(key, shape=low.shape), low, high)


def greedy(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """The control that lowers the smallest h after the step most steeply; a random one where it has no influence."""

    def h(u: Float[Array, " m"]) -> Float[Array, ""]:
        return smallest_margin(env, advance(env, sim, u))

    return _steer(env, h, -1.0, key)


def inward(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Towards the other platform: pursuit, ramming from behind."""
    return _towards(env, sim, _to_target(env, sim), key)


def outward(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Away from the other platform."""
    return _towards(env, sim, -_to_target(env, sim), key)


def sideways(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Across the velocity, which bends the path without changing the speed at first."""
    velocity = sim.platforms[env.agent].velocity
    across = jnp.stack([-velocity[1], velocity[0], *jnp.zeros(velocity.size - 2)])
    return _towards(env, sim, across, key)


def accelerate(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Along the velocity."""
    return _towards(env, sim, sim.platforms[env.agent].velocity, key)


def intercept(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Towards the point at which the other platform can be met at the present speed."""
    own, other = sim.platforms[env.agent], _target(env, sim)
    ahead = other.position - own.position
    speed = jnp.maximum(safe_norm(own.velocity), 1e-3)
    time = safe_norm(ahead) / speed
    for _ in range(4):
        time = safe_norm(ahead + other.velocity * time) / speed
    return _towards(env, sim, ahead + other.velocity * time, key)


def head_on(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Gets 2 500 ft or m ahead of the other platform first, then turns on it."""
    own, other = sim.platforms[env.agent], _target(env, sim)
    course = other.velocity / jnp.maximum(safe_norm(other.velocity), 1e-3)
    ahead = jnp.sum((own.position - other.position) * course)
    aim = jnp.where(ahead > 1500.0, 0.0, 2500.0) * course + other.position
    return _towards(env, sim, aim - own.position, key)


def there_and_back(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Away from the other platform for three quarters of the longest episode, or half of the way allowed, then back."""
    way = _to_target(env, sim)
    end = time_limit(env)
    back = jnp.zeros((), bool) if end is None else sim.time > 0.75 * end
    for limit in [one.limit for one in env.terminal if isinstance(one, TooFar)]:
        back = back | (safe_norm(way) > 0.5 * limit)
    return _towards(env, sim, jnp.where(back, way, -way), key)


def drain(env: Environment, sim: Sim, key: Key) -> Float[Array, " m"]:
    """Of the controls at the bounds and in the middle, the one that a filter certifies with the least h on the way.

    Without a filter that certifies, the one of the least h after the step.
    """
    low, high = bounds(env)
    shares = jnp.array(list(itertools.product((0.0, 0.5, 1.0), repeat=low.shape[0])))
    controls = low + shares * (high - low)

    def value(u: Float[Array, " m"]) -> Float[Array, ""]:
        later = advance(env, sim, u)
        if not isinstance(env.rta, CertifiedRTA):
            return smallest_margin(env, later)
        least = jnp.max(env.rta.certify(env, sim, later))
        return jnp.where(least >= env.rta.required_margin(env), least, jnp.inf)

    values = jax.lax.map(value, controls)
    return controls[jnp.argmin(jnp.where(jnp.isnan(values), jnp.inf, values))]


ADVERSARIES: dict[str, Adversary] = {
    each.__name__: each
    for each in (
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
"""By name."""


def _target(env: Environment, sim: Sim) -> Any:
    return sim.platforms[next(platform.name for platform in env.platforms if platform.name != env.agent)]


def _to_target(env: Environment, sim: Sim) -> Float[Array, " d"]:
    return _target(env, sim).position - sim.platforms[env.agent].position


def _towards(env: Environment, sim: Sim, aim: Float[Array, " d"], key: Key) -> Float[Array, " m"]:
    """The control that turns the velocity over the next steps most towards a direction."""
    aim = aim / jnp.maximum(safe_norm(aim), 1e-6)

    def along(u: Float[Array, " m"]) -> Float[Array, ""]:
        later = advance(env, sim, u)
        return jnp.sum(aim * advance(env, later, jnp.zeros_like(u)).platforms[env.agent].velocity)

    return _steer(env, along, 1.0, key)


def _steer(env: Environment, value: Callable[[Array], Array], sign: float, key: Key) -> Float[Array, " m"]:
    """Every actuator at the bound that its derivative favours; where there is none, at random."""
    low, high = bounds(env)
    slope = sign * jax.grad(value)((low + high) / 2.0)
    return jnp.where(slope == 0.0, bang_bang(env, None, key), jnp.where(slope > 0.0, high, low))  # type: ignore[arg-type]
