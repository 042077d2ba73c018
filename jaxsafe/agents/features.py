"""Features: what the agent computes from an observation before its networks see it.

The environment's observation itself stays the paper's. Features are parts: a subclass of `Features`
with a `type` is chosen by `agent.features=TYPE`.
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.environment import Environment
from jaxsafe.processors.status import VelocityLimit
from jaxsafe.schema.component import Component
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.cwh import ThrustedSpacecraft
from jaxsafe.simulation.geometry import rotation, safe_root
from jaxsafe.simulation.oriented import OrientedSpacecraft
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
    num_vectors: ClassVar[int] = 0
    """Number of vectors that the inputs end with, each as long as the control."""

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
        slope = _slope_of_limit(env, name)
        full_thrust = _full_thrust(env, _point_mass(env, name))
        by_step = full_thrust * env.dt

        away = position / (_norm(position) + 1e-3)
        inwards = -jnp.sum(away * velocity, axis=-1, keepdims=True)
        missing = jnp.arcsinh((limit - inwards) / by_step)
        across = (velocity + inwards * away) / by_step
        size = _norm(across)
        held = slope * inwards * away - _drift(env, position, velocity)
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


class FarDirectionsFeatures(Features, type="far_directions"):
    """Numbers that do not change when the scene is turned, and vectors, for far starts.

    As in `far_approach`, Δ is the change by full thrust in a step, and accelerations are in units
    of that by full thrust. With p the direction away from the chief, v the velocity and w its part
    across p, the numbers are:

    - log(‖r‖ + 0.005), with the distance ‖r‖ as the environment observes it.
    - −p·v, ‖w‖ and ‖v‖ as shares of the limit.
    - (limit + p·v)/Δ, ‖w‖/Δ and (limit − ‖v‖)/Δ. Each such x is compressed to
      sign(x) ln(1 + abs(x)).
    - How fast the limit falls below the speed without thrust: ν₁ times the speed towards the chief,
      plus the relative acceleration of Eqs. (12), (16) along v. ν₁ is the slope of the limit.
    - a·p, a·w/‖w‖ and ‖a‖. Here a is the acceleration by thrust that keeps v at the limit while the
      distance falls: ν₁ times the speed towards the chief, along p, less the relative acceleration.

    The vectors are p, w/‖w‖ and a. With `agent.actor=directional` the thrust is a plus a weighted
    sum of the other two. The environment must observe position, velocity, speed and speed limit of
    a point mass, in the axes of its thrusters.
    """

    num_vectors: ClassVar[int] = 3

    def __call__(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch i"]:
        name = "far_directions"
        full_thrust = _full_thrust(env, _point_mass(env, name))
        flight = _Flight.seen(env, observation, name, full_thrust, lambda vector, _: vector)
        return jnp.concatenate([*flight.numbers, flight.away, flight.aside, flight.held], axis=-1)


class FarOrientedFeatures(Features, type="far_oriented"):
    """The features of `far_directions` for a spacecraft that thrusts along its body.

    They are the numbers of `far_directions`, where Δ is the change by full thrust ahead, the
    attitude rate, and in the body frame:

    - p · 10 m/(10 m + ‖r‖), which only shows near the chief.
    - q/‖q‖, and ‖q‖ and both parts of q compressed. Here q is the acceleration by thrust that
      brings v towards the chief at 95 % of the limit within 8 s, or at ‖r‖/10 s if that is less.
      A pilot turns the body along it.

    Far away q alone has a direction, so what is learnt in one direction holds in all.

    The environment must observe the chief's position and the velocity, both in the body frame, and
    attitude, attitude rate, speed and speed limit of an oriented spacecraft.
    """

    def __call__(
        self, env: Environment, observation: Float[Array, "*batch o"]
    ) -> Float[Array, "*batch i"]:
        name = "far_oriented"
        plant = env.agent_platform
        if not isinstance(plant, OrientedSpacecraft) or "thrust" not in env.action_names:
            raise ConfigError(
                f"agent.features: {name!r} needs an oriented_spacecraft with the control 'thrust';"
                " choose approach"
            )
        _check_frame(env, name, env.agent, f"the frame of {env.agent!r}")
        cosine, sine = (
            _scale(env, "attitude") * _elements(env, observation, f"attitude.{part}", name)
            for part in ("cos", "sin")
        )

        def turned(vector: Float[Array, "*batch 2"], sign: float) -> Float[Array, "*batch 2"]:
            x, y = vector[..., :1], vector[..., 1:]
            s = sign * sine
            return jnp.concatenate([cosine * x - s * y, s * x + cosine * y], axis=-1)

        full_thrust = bounds(env)[1][env.action_names.index("thrust")] / plant.mass
        flight = _Flight.seen(env, observation, name, full_thrust, turned)
        speed = jnp.minimum(0.95 * flight.limit, 0.1 * flight.distance)
        push = flight.held - (speed * flight.away + flight.velocity) / (8.0 * full_thrust)
        size = _norm(push)
        return jnp.concatenate(
            [
                *flight.numbers,
                _elements(env, observation, "attitude_rate", name),
                flight.away * (10.0 / (10.0 + flight.distance)),
                push / (size + 0.05),
                _compressed(4.0 * size),
                _compressed(4.0 * push),
            ],
            axis=-1,
        )


class _Flight(NamedTuple):
    """What the features for far starts compute of an observation, see `FarDirectionsFeatures`."""

    numbers: list[Float[Array, "*batch 1"]]
    """The numbers, which do not change when the scene is turned."""
    distance: Float[Array, "*batch 1"]  # [m]
    velocity: Float[Array, "*batch d"]  # [m/s], like the vectors below in the axes of the thrusters
    limit: Float[Array, "*batch 1"]  # [m/s]
    away: Float[Array, "*batch d"]  # p
    aside: Float[Array, "*batch d"]  # w/‖w‖
    held: Float[Array, "*batch d"]  # a, in units of full thrust

    @classmethod
    def seen(
        cls,
        env: Environment,
        observation: Float[Array, "*batch o"],
        name: str,
        full_thrust: Number,
        turned: Callable[[Array, float], Array],
    ) -> _Flight:
        """Return what an observation shows.

        Args:
            env: the environment.
            observation: observations `[*batch, o]`.
            name: name of the features, for messages.
            full_thrust: acceleration by full thrust [m/s²].
            turned: a function that turns a vector from the axes of the thrusters to Hill's frame,
                or back if its second argument is −1 instead of 1.

        Raises:
            ConfigError: the environment does not observe what is needed, or has no speed limit.
        """
        slope = _slope_of_limit(env, name)
        place = next((item for item in env.observation if item.name == "position"), None)
        # A position relative to the agent points to the chief.
        sign = -1.0 if getattr(place, "relative_to", None) == env.agent else 1.0
        observed = sign * _vector(env, observation, "position", name)
        position = _scale(env, "position") * observed
        velocity = _scale(env, "velocity") * _vector(env, observation, "velocity", name)
        limit = jnp.maximum(
            _scale(env, "velocity_limit") * _elements(env, observation, "velocity_limit", name),
            SMALLEST_LIMIT,
        )
        by_step = full_thrust * env.dt
        distance, speed = _norm(position), _norm(velocity)
        away = position / (distance + 1e-3)
        inwards = -_dot(away, velocity)
        across = velocity + inwards * away
        sideways = _norm(across)
        drift = _drift(env, turned(position, 1.0), turned(velocity, 1.0))
        pulled = turned(drift, -1.0) / full_thrust
        closing = slope * inwards / full_thrust
        aside = across / (sideways + 0.1 * by_step)
        held = closing * away - pulled
        return cls(
            numbers=[
                jnp.log(_norm(observed) + 0.005),
                inwards / limit,
                sideways / limit,
                speed / limit,
                _compressed((limit - inwards) / by_step),
                _compressed(sideways / by_step),
                _compressed((limit - speed) / by_step),
                closing + _dot(velocity / (speed + 1e-3), pulled),
                _dot(held, away),
                _dot(held, aside),
                _norm(held),
            ],
            distance=distance,
            velocity=velocity,
            limit=limit,
            away=away,
            aside=aside,
            held=held,
        )


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


# A program of its own, with a reduction, rounds alike whether its surroundings are compiled or not.
@jax.jit
def _norm(vector: Float[Array, "*batch d"]) -> Float[Array, "*batch 1"]:
    return safe_root(jnp.sum(vector * vector, axis=-1, keepdims=True))


def _point_mass(env: Environment, name: str) -> ThrustedSpacecraft:
    """Return the agent, which thrusts along each axis and is observed in these axes.

    Raises:
        ConfigError: it does not, or is not. The message names the features.
    """
    plant = env.agent_platform
    if not isinstance(plant, ThrustedSpacecraft) or env.action_names != plant.inputs:
        raise ConfigError(
            f"agent.features: {name!r} needs a point mass with a thruster along each axis;"
            " choose approach"
        )
    _check_frame(env, name, None, "the axes of the thrusters")
    return plant


def _check_frame(env: Environment, name: str, frame: str | None, wanted: str) -> None:
    """Check that position and velocity are observed in a frame. None is Hill's.

    Raises:
        ConfigError: one is observed in another. The message names the features, and says `wanted`.
    """
    for item in env.observation:
        own = getattr(item, "frame", None)
        if item.name in ("position", "velocity") and own != frame:
            found = "Hill's frame" if own is None else f"the frame of {own!r}"
            raise ConfigError(
                f"agent.features: {name!r} needs the observation {item.name!r} in {wanted}, found"
                f" it in {found}; choose approach"
            )


def _full_thrust(env: Environment, plant: ThrustedSpacecraft) -> Array:
    """Return the acceleration by full thrust of a point mass along its weakest axis [m/s²]."""
    low, high = bounds(env)
    return functools.reduce(jnp.minimum, jnp.maximum(-low, high)) / plant.mass


def _drift(
    env: Environment, position: Float[Array, "*batch d"], velocity: Float[Array, "*batch d"]
) -> Float[Array, "*batch d"]:
    """Return the acceleration of the agent without thrust [m/s²], in Hill's frame."""
    plant = env.agent_platform
    still = plant.rest()

    @functools.partial(jnp.vectorize, signature="(d),(d)->(d)")
    def drift(position: Float[Array, " d"], velocity: Float[Array, " d"]) -> Array:
        return plant.derivative(still.replace(position=position, velocity=velocity), {}).velocity

    return drift(position, velocity)


def _slope_of_limit(env: Environment, name: str) -> Number:
    """Return the slope of the speed limit [1/s].

    Raises:
        ConfigError: there is no speed limit. The message names the features.
    """
    limits = [status for status in env.status if isinstance(status, VelocityLimit)]
    if not limits:
        raise ConfigError(
            f"agent.features: {name!r} needs a status of type velocity_limit; choose none"
        )
    return limits[0].slope


def _compressed(x: Float[Array, "*batch 1"]) -> Float[Array, "*batch 1"]:
    """Return sign(x) ln(1 + abs(x)), in functions that other runtimes and proofs know."""
    return jnp.log(1.0 + jnp.maximum(x, 0.0)) - jnp.log(1.0 + jnp.maximum(-x, 0.0))


def _dot(a: Float[Array, "*batch d"], b: Float[Array, "*batch d"]) -> Float[Array, "*batch 1"]:
    return jnp.sum(a * b, axis=-1, keepdims=True)


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
