"""Features: what the agent computes from an observation before its networks see it.

The environment's observation itself stays the paper's. Features are parts: a subclass of `Features`
with a `type` is chosen by `agent.features=TYPE`.
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.environment import Environment
from jaxsafe.processors.status import VelocityLimit
from jaxsafe.schema.component import Component
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.cwh import ThrustedSpacecraft
from jaxsafe.simulation.geometry import rotation, safe_norm
from jaxsafe.transition import bounds
from jaxsafe.types import Number

SMALLEST_LIMIT = 1e-6
"""The smallest speed limit that the features divide by.

No environment observes a smaller one. But other code may ask a policy about an observation of
zeros, and that would divide by zero.
"""


class Features(Component):
    """Base of the functions from an environment's observations to the inputs of the networks."""

    field_word: ClassVar[str] = "option"

    @abstractmethod
    def __call__(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch i"]:
        """Return what the networks see of observations `[*batch, o]`: inputs `[*batch, i]`.

        Raises:
            ConfigError: the environment does not observe what the features need.
        """


class PlainFeatures(Features, type="none"):
    """The observation and nothing else."""

    def __call__(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch o"]:
        return observation


class DockingFeatures(Features, type="docking"):
    """The observation, the direction p/(‖p‖ + 0.01) and log(‖p‖ + 0.005) of its position p.

    The target is 0.005 wide in units of p, which a plain perceptron learns to resolve late or
    never. The environment must observe a position.
    """

    def __call__(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch i"]:
        position = _vector(env, observation, "position", "docking")
        distance = _norm(position)
        return jnp.concatenate(
            [observation, position / (distance + 0.01), jnp.log(distance + 0.005)], axis=-1
        )


class ApproachFeatures(Features, type="approach"):
    """The features of `docking`, and the velocity as a share of the speed limit.

    With p the direction of the observed position and v the velocity, both in the frame of the
    observation, these are:

    - v/limit.
    - p·v/limit, the part of v/limit along p.
    - The remaining part of v/limit, which is across p.
    - ‖v‖/limit, which is 1 at the limit.

    The environment must observe position, velocity, speed and speed limit.
    """

    with_observation: bool = True
    """Whether the observation itself comes first. Without it no feature grows with the distance
    faster than its logarithm, so networks also learn to fly from kilometres away."""

    def __call__(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch i"]:
        position = _vector(env, observation, "position", "approach")
        limit = jnp.maximum(
            _elements(env, observation, "velocity_limit", "approach"), SMALLEST_LIMIT
        )
        relative_to_limit = 1.0 / limit
        velocity = (
            _scale(env, "velocity")
            * _vector(env, observation, "velocity", "approach")
            * relative_to_limit
        )
        direction = position / (_norm(position) + 1e-3)
        along = jnp.sum(direction * velocity, axis=-1, keepdims=True)
        speed = _elements(env, observation, "speed", "approach") * relative_to_limit
        docking = DockingFeatures()(env, observation)
        return jnp.concatenate(
            [
                docking if self.with_observation else docking[..., observation.shape[-1] :],
                velocity,
                along,
                velocity - along * direction,
                speed,
            ],
            axis=-1,
        )


class FarApproachFeatures(Features, type="far_approach"):
    """The features of `approach` without the observation, and the thrust that the approach takes.

    Kilometres away a speed of 1 % of the limit is many steps of full thrust, and gravity takes up
    most of the thrust. Near the chief it is the other way round. So these features measure
    velocities by the change Δ that full thrust makes in a step, and accelerations by that of full
    thrust. With p the direction away from the chief and v the velocity they are:

    - asinh(e) and asinh(e) p, with e = (limit + p·v)/Δ, the speed towards the chief that is missing
      to the limit.
    - The part of v/Δ across p, its size compressed by asinh.
    - The acceleration by thrust that keeps v at the limit while the distance falls. It is ν₁ times
      the speed towards the chief, along p, less the relative acceleration of Eqs. (12), (16). ν₁ is
      the slope of the limit.

    The environment must observe position, velocity, speed and speed limit of a point mass, in the
    axes of its thrusters.
    """

    def __call__(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch i"]:
        name = "far_approach"
        approach = ApproachFeatures(with_observation=False)(env, observation)
        position, velocity = (
            _scale(env, what) * _vector(env, observation, what, name)
            for what in ("position", "velocity")
        )
        limit = _scale(env, "velocity_limit") * _elements(env, observation, "velocity_limit", name)
        plant, slope = self._plant_and_slope(env)
        low, high = bounds(env)
        full_thrust = jnp.min(jnp.maximum(-low, high)) / plant.mass
        by_step = full_thrust * env.dt

        away = position / (_norm(position) + 1e-3)
        inwards = -jnp.sum(away * velocity, axis=-1, keepdims=True)
        missing = jnp.arcsinh((limit - inwards) / by_step)
        across = (velocity + inwards * away) / by_step
        size = _norm(across)
        still = plant.rest()

        @functools.partial(jnp.vectorize, signature="(d),(d)->(d)")
        def drift(position: Float[Array, " d"], velocity: Float[Array, " d"]) -> Array:
            return plant.derivative(
                still.replace(position=position, velocity=velocity), {}
            ).velocity

        held = slope * inwards * away - drift(position, velocity)
        return jnp.concatenate(
            [
                approach,
                missing,
                missing * away,
                across * jnp.arcsinh(size) / (size + 1e-3),
                held / full_thrust,
            ],
            axis=-1,
        )

    def _plant_and_slope(self, env: Environment) -> tuple[ThrustedSpacecraft, Number]:
        """Return the agent and the slope of its speed limit [1/s].

        Raises:
            ConfigError: the agent has no thruster along each axis, or there is no speed limit.
        """
        plant = env.agent_platform
        limits = [status for status in env.status if isinstance(status, VelocityLimit)]
        if not isinstance(plant, ThrustedSpacecraft) or env.action_names != plant.inputs:
            raise ConfigError(
                "agent.features: 'far_approach' needs a point mass with a thruster along each axis;"
                " choose approach"
            )
        if not limits:
            raise ConfigError(
                "agent.features: 'far_approach' needs a status of type velocity_limit; choose none"
            )
        return plant, limits[0].slope


class RejoinFeatures(Features, type="rejoin"):
    """The observation, the rejoin point, the relative velocity and the miss distance.

    All vectors are turned from the wingman's body frame into its level frame, in which left is left
    however the wingman rolls. With p the direction of the lead and w its velocity relative to the
    wingman, the features are:

    - p, in space only.
    - d, the vector to the rejoin point. It is small near the point, where its direction
      turns quickly.
    - w.
    - w + d/10 s, the change of velocity that would take the wingman to the point in 10 s. A pilot
      who keeps it at zero arrives, and stays.
    - d and the change once more, five times as long and clipped to [−1, 1].
    - The cosine between p and w.
    - The part of p across w. It is 0 on a collision course.
    - That part times the observed distance. This is the miss distance if neither aircraft
      manoeuvres, unless the observed distance is clipped.
    - Two numbers that are near 1 on a collision course. One is how directly w opposes p, times a
      bell curve of the part of p across w. The other has the bell curve of the miss distance.

    The environment must observe the magnitudes and directions of the positions of lead and rejoin
    point and of both velocities, and in space also flight path angle and roll.
    """

    def __call__(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch i"]:
        distance, bearing = _magnitude_and_direction(env, observation, "lead_position")
        rejoin_distance, rejoin_direction = _magnitude_and_direction(
            env, observation, "rejoin_position"
        )
        speed, heading = _magnitude_and_direction(env, observation, "lead_velocity")
        own_speed, own_heading = _magnitude_and_direction(env, observation, "wingman_velocity")
        offset = rejoin_distance * rejoin_direction
        relative = speed * heading - own_speed * own_heading
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
        change = relative + per_10_s * offset
        near, urgent = (jnp.clip(5.0 * vector, -1.0, 1.0) for vector in (offset, change))
        # In the plane the observation already has the direction of the lead in the level frame.
        level = () if "roll" not in env.observation_names else (bearing,)
        aim = (*level, offset, near, relative, change, urgent)
        return jnp.concatenate([observation, *aim, closing, 4.0 * across, miss, *danger], axis=-1)


# A program of its own rounds alike whether its surroundings are compiled or not.
@jax.jit
def _norm(vector: Float[Array, "*batch d"]) -> Float[Array, "*batch 1"]:
    return safe_norm(vector)[..., None]


def _magnitude_and_direction(
    env: Environment, observation: Float[Array, "*batch o"], name: str
) -> tuple[Float[Array, "*batch 1"], Float[Array, "*batch d"]]:
    """Return magnitude and direction of an observed vector in the wingman's level frame.

    The direction there is R_y(γ)·R_x(φ) times the direction in the body frame, where γ is the
    flight path angle and φ the roll.
    """
    magnitude = _elements(env, observation, f"{name}.magnitude", "rejoin")
    direction = _vector(env, observation, name, "rejoin")
    if "roll" in env.observation_names:
        pitch, roll = (
            _scale(env, angle) * _elements(env, observation, angle, "rejoin")[..., 0]
            for angle in ("flight_path_angle", "roll")
        )
        turn = rotation(jnp.zeros_like(roll), pitch, roll)
        direction = jnp.sum(turn * direction[..., None, :], axis=-1)
    return magnitude, direction


def _scale(env: Environment, name: str) -> Number:
    """Return the number by which the environment divided an observation."""
    return next(item.scale for item in env.observation if item.name == name)


def _vector(
    env: Environment, observation: Float[Array, "*batch o"], name: str, features: str
) -> Float[Array, "*batch d"]:
    if name in env.observation_names:  # a vector on a line
        return _elements(env, observation, name, features)
    axes = [f"{name}.{axis}" for axis in "xyz" if f"{name}.{axis}" in env.observation_names]
    return jnp.concatenate(
        [_elements(env, observation, axis, features) for axis in axes or [f"{name}.x"]], axis=-1
    )


def _elements(
    env: Environment, observation: Float[Array, "*batch o"], name: str, features: str
) -> Float[Array, "*batch 1"]:
    """Return an element of the observation.

    Args:
        env: the environment.
        observation: observations `[*batch, o]`.
        name: name of the element.
        features: name of the features that need it, for the message.

    Raises:
        ConfigError: the environment does not observe it, or observes it with an offset.
    """
    if name not in env.observation_names:
        raise ConfigError(
            f"agent.features: {features!r} needs an observation called {name!r}; choose none"
        )
    part = name.partition(".")[0]
    if any(item.name == part and item.offset is not None for item in env.observation):
        raise ConfigError(
            f"agent.features: {features!r} needs the observation {part!r} without an offset;"
            " choose none"
        )
    index = env.observation_names.index(name)
    return observation[..., index : index + 1]
