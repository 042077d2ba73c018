"""What the agent computes from an observation before its networks see it; what is observed stays the paper's."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.environment import Environment
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.geometry import rotation, safe_norm
from jaxsafe.types import Number

SMALLEST_LIMIT = 1e-6
"""A speed limit is never smaller in the features. No environment observes less, but other code may ask a policy about an
observation of zeros, which would be divided by zero."""

Features = Callable[[Environment, Float[Array, "*batch o"]], Float[Array, "*batch i"]]


def none(env: Environment, observation: Float[Array, "*batch o"]) -> Float[Array, "*batch o"]:
    """The observation and nothing else."""
    return observation


def docking(env: Environment, observation: Float[Array, "*batch o"]) -> Float[Array, "*batch i"]:
    """Append the direction p/(‖p‖ + 0.01) and log(‖p‖ + 0.005) of the observed position p.

    The target is 0.005 wide in units of p, which a plain perceptron resolves late or never.
    """
    position = _vector(env, observation, "position", "docking")
    distance = _norm(position)
    return jnp.concatenate(
        [observation, position / (distance + 0.01), jnp.log(distance + 0.005)], axis=-1
    )


def approach(env: Environment, observation: Float[Array, "*batch o"]) -> Float[Array, "*batch i"]:
    """Append to `docking` the velocity as a share of the speed limit: its parts along and across the way to the chief.

    With the direction p of the chief and v/limit, both in the frame of the observation: v/limit, p·v/limit, what is left of
    v/limit across p, and ‖v‖/limit, which is 1 at the limit.
    """
    position = _vector(env, observation, "position", "approach")
    limit = jnp.maximum(_elements(env, observation, "velocity_limit", "approach"), SMALLEST_LIMIT)
    relative_to_limit = 1.0 / limit
    velocity = (
        _scale(env, "velocity")
        * _vector(env, observation, "velocity", "approach")
        * relative_to_limit
    )
    direction = position / (_norm(position) + 1e-3)
    along = jnp.sum(direction * velocity, axis=-1, keepdims=True)
    speed = _elements(env, observation, "speed", "approach") * relative_to_limit
    return jnp.concatenate(
        [docking(env, observation), velocity, along, velocity - along * direction, speed], axis=-1
    )


def rejoin(env: Environment, observation: Float[Array, "*batch o"]) -> Float[Array, "*batch i"]:
    """Append the way to the rejoin point, the lead's relative velocity, and how far both will miss each other.

    All vectors are turned from the wingman's body into its level frame, in which left is left however it rolls. The way as
    a vector, which is small near the point where its direction turns quickly; the relative velocity w; and w + way/10 s,
    the change of velocity that would take it to the point in 10 s: a pilot who keeps that at zero arrives, and stays. The
    way and the change once more five times as long and clipped.
    With the direction p of the lead (in space appended as well): the cosine between p and w, the part of p across w, 0 on
    a collision course, and that part times the observed distance: the miss distance if neither manoeuvres, unless it is
    clipped.
    """
    distance, bearing = _magnitude_and_direction(env, observation, "lead_position")
    far, towards = _magnitude_and_direction(env, observation, "rejoin_position")
    (speed, along), (own_speed, own) = (
        _magnitude_and_direction(env, observation, f"{name}_velocity")
        for name in ("lead", "wingman")
    )
    way, relative = far * towards, speed * along - own_speed * own
    course = relative / (_norm(relative) + 0.01)
    closing = jnp.sum(bearing * course, axis=-1, keepdims=True)
    across = bearing - closing * course
    approaching = jnp.maximum(-closing, 0.0)
    sine2 = jnp.sum(across * across, axis=-1, keepdims=True)
    danger = [
        approaching * jnp.exp(-sine2 * scale) for scale in (1.0 / 0.15**2, distance**2 / 0.2**2)
    ]
    miss = 4.0 * across * distance
    per_10_s = _scale(env, "rejoin_position")[0] / (10.0 * _scale(env, "wingman_velocity")[0])
    change = relative + per_10_s * way
    near, urgent = (jnp.clip(5.0 * vector, -1.0, 1.0) for vector in (way, change))
    level = (
        () if "roll" not in env.observation_names else (bearing,)
    )  # in the plane the observation has it
    aim = (*level, way, near, relative, change, urgent)
    return jnp.concatenate([observation, *aim, closing, 4.0 * across, miss, *danger], axis=-1)


FEATURES: Mapping[str, Features] = {
    each.__name__: each for each in (none, docking, approach, rejoin)
}
"""By name, as in `agent.features`."""


@jax.jit  # one program, and so the same roundings, whether what surrounds it is compiled or not
def _norm(vector: Float[Array, "*batch d"]) -> Float[Array, "*batch 1"]:
    return safe_norm(vector)[..., None]


def _magnitude_and_direction(
    env: Environment, observation: Float[Array, "*batch o"], name: str
) -> tuple[Float[Array, "*batch 1"], Float[Array, "*batch d"]]:
    """An observed vector in the wingman's level frame, R_y(γ)·R_x(φ) times what it is in the body frame."""
    magnitude, direction = (
        _elements(env, observation, f"{name}.magnitude", "rejoin"),
        _vector(env, observation, name, "rejoin"),
    )
    if "roll" in env.observation_names:
        pitch, roll = (
            _scale(env, angle) * _elements(env, observation, angle, "rejoin")[..., 0]
            for angle in ("flight_path_angle", "roll")
        )
        turn = rotation(jnp.zeros_like(roll), pitch, roll)
        direction = jnp.sum(turn * direction[..., None, :], axis=-1)
    return magnitude, direction


def _scale(env: Environment, name: str) -> Number:
    """What an observation was divided by."""
    return next(one.scale for one in env.observation if one.name == name)


def _vector(
    env: Environment, observation: Float[Array, "*batch o"], name: str, features: str
) -> Float[Array, "*batch d"]:
    axes = [f"{name}.{axis}" for axis in "xyz" if f"{name}.{axis}" in env.observation_names]
    return jnp.concatenate(
        [_elements(env, observation, axis, features) for axis in axes or [f"{name}.x"]], axis=-1
    )


def _elements(
    env: Environment, observation: Float[Array, "*batch o"], name: str, features: str
) -> Float[Array, "*batch 1"]:
    """An element of the observation.

    Raises:
        ConfigError: the environment does not observe it.
    """
    if name not in env.observation_names:
        raise ConfigError(
            f"agent.features: {features!r} needs an observation called {name!r}; choose none"
        )
    index = env.observation_names.index(name)
    return observation[..., index : index + 1]
