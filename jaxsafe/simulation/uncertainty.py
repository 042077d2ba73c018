"""How the world differs from its model: disturbances, faults, delays and errors of navigation.

The parts stand in the section `uncertainty` of an environment. No filter knows of them. A filter
predicts with the model, which is the environment without this section, and from the state that is
measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import ANY, Component, Range, Unit
from jaxsafe.schema.errors import choices_text
from jaxsafe.simulation.controllers import Bound, TimeConstant
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.types import Key, Number, PlatformName, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

Size = Annotated[Number, Unit("physical"), Range(0.0, largest=1e9)]
"""Size of a random vector, in the unit of what it is added to."""


class Uncertainty(Component):
    """Base of all ways in which the world differs from its model.

    A part has a memory, which holds what acts now. `init` makes it at the start of an episode, and
    `increment` moves it once a step, after the filter and before the world moves. The other methods
    only read it. A subclass writes the methods that it needs.
    """

    many_kinds: ClassVar[bool] = True
    draws: ClassVar[bool] = False
    """Whether the part draws random numbers."""

    name: str

    def init(self, env: Environment, sim: Sim, key: Key) -> Any:
        """Return the memory at the start of an episode."""
        return ()

    def increment(
        self, env: Environment, sim: Sim, key: Key, memory: Any, control: Float[Array, " m"]
    ) -> Any:
        """Return the memory for a step.

        Args:
            env: the environment.
            sim: the simulation before the step.
            key: a key for this part and this step.
            memory: the memory of the step before.
            control: the control of this step in physical units and action order, as changed by the
                parts before this one.
        """
        return memory

    def received(
        self, env: Environment, sim: Sim, memory: Any, control: Float[Array, " m"]
    ) -> Float[Array, " m"]:
        """Return the control that the plant receives in place of `control`."""
        return control

    def moved(
        self, env: Environment, memory: Any, platforms: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        """Return the platforms after the step, given those that the model predicts, by name."""
        return platforms

    def measured(self, env: Environment, sim: Sim, memory: Any) -> Sim:
        """Return the simulation as it is measured."""
        return sim


class Disturbance(Uncertainty):
    """Base of disturbances of a platform's motion.

    A disturbance of the kind `acceleration`, a [m/s² or ft/s²], is held over a step and adds to the
    plant's own motion: aΔt to the velocity and aΔt²/2 to the position. A disturbance of the kind
    `wind`, w [m/s or ft/s], adds wΔt to the position.
    """

    on: PlatformName
    kind: Literal["acceleration", "wind"] = "acceleration"

    def misfits(self, env: Environment) -> dict[str, str]:
        platform = env.platform(self.on)
        if not platform.can_be_pushed:
            return {"on": f"{self.on!r} is of type {platform.type_name}, which nothing pushes"}
        return {}

    def vector(self, memory: Any) -> Float[Array, " d"]:
        """Return the acceleration or the wind in this step."""
        return memory

    def moved(
        self, env: Environment, memory: Any, platforms: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        vector = self.vector(memory)
        still = jnp.zeros_like(vector)
        pair = (vector, still) if self.kind == "acceleration" else (still, vector)
        pushed = env.platform(self.on).pushed(platforms[self.on], *pair, dt=env.dt)
        return {**platforms, self.on: pushed}

    def init(self, env: Environment, sim: Sim, key: Key) -> Any:
        return jnp.zeros_like(sim.platforms[self.on].position)


class BoundedDisturbance(Disturbance, type="bounded"):
    """A disturbance that is drawn at every step, uniformly from the ball of radius `bound`."""

    draws: ClassVar[bool] = True
    bound: Size

    def increment(
        self, env: Environment, sim: Sim, key: Key, memory: Any, control: Float[Array, " m"]
    ) -> Any:
        return self.bound * in_unit_ball(key, memory)


class NormalDisturbance(Disturbance, type="normal"):
    """A disturbance of independent normal numbers, drawn at every step.

    `deviation` is the standard deviation of each component.
    """

    draws: ClassVar[bool] = True
    deviation: Size

    def increment(
        self, env: Environment, sim: Sim, key: Key, memory: Any, control: Float[Array, " m"]
    ) -> Any:
        return self.deviation * jax.random.normal(key, memory.shape, memory.dtype)


class ConstantDisturbance(Disturbance, type="constant"):
    """A disturbance that never changes, such as drag or a steady wind.

    `value` has one number for each axis of space, in the global frame.
    """

    value: Annotated[Number, Unit("physical", length=ANY), Range(largest=1e9)]

    def misfits(self, env: Environment) -> dict[str, str]:
        dimension = env.platform(self.on).dimension
        found = jnp.size(self.value)
        if found != dimension:
            return {"value": f"expected {dimension} numbers for {self.on!r}, found {found}"}
        return super().misfits(env)

    def init(self, env: Environment, sim: Sim, key: Key) -> Any:
        return ()

    def vector(self, memory: Any) -> Float[Array, " d"]:
        return jnp.reshape(self.value, -1)


class Gusts(Disturbance, type="gusts"):
    """A disturbance that wanders, a Gauss-Markov process of first order.

    Each component has the standard deviation `deviation` and forgets with the `time_constant` τ:
    x′ = x exp(−Δt/τ) + σ √(1 − exp(−2Δt/τ)) ξ with ξ normal. Gusts that are longer than `bound` are
    cut to that length.
    """

    draws: ClassVar[bool] = True
    deviation: Size
    time_constant: TimeConstant
    bound: Size | None = None

    def init(self, env: Environment, sim: Sim, key: Key) -> Any:
        like = super().init(env, sim, key)
        return self.deviation * jax.random.normal(key, like.shape, like.dtype)

    def increment(
        self, env: Environment, sim: Sim, key: Key, memory: Any, control: Float[Array, " m"]
    ) -> Any:
        kept = jnp.exp(-env.dt / self.time_constant)
        fresh = self.deviation * jax.random.normal(key, memory.shape, memory.dtype)
        return kept * memory + jnp.sqrt(1.0 - kept**2) * fresh

    def vector(self, memory: Any) -> Float[Array, " d"]:
        return memory if self.bound is None else no_longer(memory, self.bound)


class ChosenDisturbance(Disturbance, type="chosen"):
    """A disturbance that is chosen from outside, for adversaries and for scripts of one's own.

    It is the vector in its memory, `state.memory.uncertainty[name]`, cut to the length `bound`. It
    is 0 until something is written there.
    """

    bound: Size

    def vector(self, memory: Any) -> Float[Array, " d"]:
        return no_longer(memory, self.bound)


class ActuatorFault(Uncertainty):
    """Base of faults of one of the agent's actuators."""

    actuator: str

    def misfits(self, env: Environment) -> dict[str, str]:
        return _no_actuators(env, "actuator", (self.actuator,))

    def faulty(self, sim: Sim, control: Float[Array, ""]) -> Float[Array, ""]:
        """Return what the actuator receives in place of its control, in physical units."""
        raise NotImplementedError

    def received(
        self, env: Environment, sim: Sim, memory: Any, control: Float[Array, " m"]
    ) -> Float[Array, " m"]:
        index = env.action_names.index(self.actuator)
        return control.at[index].set(self.faulty(sim, control[index]))


class WeakActuator(ActuatorFault, type="weak"):
    """An actuator that gives its control times `share`, which may be less than 1 or more."""

    share: Annotated[Number, Unit("1"), Range(0.0, largest=1e3)]

    def faulty(self, sim: Sim, control: Float[Array, ""]) -> Float[Array, ""]:
        return self.share * control


class StuckActuator(ActuatorFault, type="stuck"):
    """An actuator that gives `at` from the time `since` on, whatever its control is."""

    at: Bound = 0.0
    since: Annotated[Number, Unit("s"), Range(0.0, largest=1e9)] = 0.0

    def faulty(self, sim: Sim, control: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.where(sim.time >= self.since, self.at, control)


class MisalignedThrusters(Uncertainty, type="misaligned"):
    """Two or three thrusters, one for each axis of a platform, all turned by the same `angle`.

    In the plane the thrust is turned anticlockwise. In space it is turned about `axis`.
    """

    thrusters: tuple[str, ...]
    angle: Annotated[Number, Unit("rad"), Range(largest=math.pi)]
    axis: Annotated[Number, Unit("1", length=ANY), Range(largest=1e9)] = (0.0, 0.0, 1.0)

    def problem(self) -> str | None:
        if len(set(self.thrusters)) != len(self.thrusters) or len(self.thrusters) not in (2, 3):
            return f"expected two or three thrusters, found {', '.join(self.thrusters) or 'none'}"
        fits = jnp.shape(self.axis) == (3,) and jnp.any(jnp.asarray(self.axis) != 0.0)
        return None if fits else "axis: expected three numbers that are not all 0"

    def misfits(self, env: Environment) -> dict[str, str]:
        return _no_actuators(env, "thrusters", self.thrusters)

    def received(
        self, env: Environment, sim: Sim, memory: Any, control: Float[Array, " m"]
    ) -> Float[Array, " m"]:
        indices = jnp.array([env.action_names.index(name) for name in self.thrusters])
        thrust = jnp.zeros(3, control.dtype).at[: len(self.thrusters)].set(control[indices])
        axis = jnp.asarray(self.axis if len(self.thrusters) == 3 else (0.0, 0.0, 1.0))
        axis = axis / jnp.linalg.norm(axis)
        # Rodrigues' formula
        cosine = jnp.cos(self.angle)
        along = axis * jnp.dot(axis, thrust) * (1.0 - cosine)
        turned = cosine * thrust + jnp.sin(self.angle) * jnp.cross(axis, thrust) + along
        return control.at[indices].set(turned[: len(self.thrusters)])


class ActionDelay(Uncertainty, type="delay"):
    """Controls that reach the plant `steps` steps of the world late.

    Until the first one arrives the plant receives 0, or the limit nearest to 0.
    """

    steps: Annotated[int, Range(1, largest=1000)]

    def init(self, env: Environment, sim: Sim, key: Key) -> Any:
        limits = [(actuator.low, actuator.high) for actuator in env.actuators]
        zeros = jnp.zeros(env.action_size, sim.time.dtype)
        if limits:
            low, high = (jnp.stack(bound) for bound in zip(*limits, strict=True))
            zeros = jnp.clip(zeros, low, high)
        return jnp.tile(zeros, (self.steps + 1, 1))

    def increment(
        self, env: Environment, sim: Sim, key: Key, memory: Any, control: Float[Array, " m"]
    ) -> Any:
        return jnp.concatenate([memory[1:], control[None]])

    def received(
        self, env: Environment, sim: Sim, memory: Any, control: Float[Array, " m"]
    ) -> Float[Array, " m"]:
        return memory[0]


class StateError(Uncertainty):
    """Base of errors in the state of a platform, as filters and observations see it.

    The memory is the error of the field `what` of the platform's state, or of its velocity.
    Statuses, rewards and the end of an episode follow the true state.
    """

    of: PlatformName
    what: str = "position"

    def misfits(self, env: Environment) -> dict[str, str]:
        rest = env.platform(self.of).rest()
        fields = [name for name in {**vars(rest), "velocity": None} if name != "orientation"]
        if self.what not in fields:
            hint = choices_text(self.what, fields)
            return {"what": f"{self.of} has no {self.what!r} in its state{hint}"}
        return {}

    def true(self, sim: Sim) -> Array:
        """Return the true value of what is measured."""
        return jnp.asarray(getattr(sim.platforms[self.of], self.what))

    def measured(self, env: Environment, sim: Sim, memory: Any) -> Sim:
        state = sim.platforms[self.of]
        wrong = self.true(sim) + memory
        if self.what == "velocity":  # which is not a field of the state of an aircraft
            state = env.platform(self.of).with_velocity(state, wrong)
        else:
            state = state.replace(**{self.what: wrong})
        return sim.replace(platforms={**sim.platforms, self.of: state})


class NavigationError(StateError, type="navigation"):
    """An error of navigation that is drawn at every step, with a `bias`.

    It is uniform in the ball of radius `bound`, or normal with the standard deviation `deviation`.
    """

    draws: ClassVar[bool] = True
    bound: Size | None = None
    deviation: Size | None = None
    bias: Annotated[Number, Unit("physical", length=ANY), Range(largest=1e9)] = 0.0

    def problem(self) -> str | None:
        both = self.bound is not None and self.deviation is not None
        return "expected bound or deviation, found both" if both else None

    def init(self, env: Environment, sim: Sim, key: Key) -> Any:
        like = self.true(sim)
        error = jnp.zeros_like(like)
        if self.bound is not None:
            error = self.bound * in_unit_ball(key, jnp.ravel(like)).reshape(like.shape)
        elif self.deviation is not None:
            error = self.deviation * jax.random.normal(key, like.shape, like.dtype)
        return error + self.bias

    def increment(
        self, env: Environment, sim: Sim, key: Key, memory: Any, control: Float[Array, " m"]
    ) -> Any:
        return self.init(env, sim, key)


def in_unit_ball(key: Key, like: Float[Array, " d"]) -> Float[Array, " d"]:
    """Draw a vector uniformly from the ball of radius 1."""
    direction_key, radius_key = jax.random.split(key)
    direction = jax.random.normal(direction_key, like.shape, like.dtype)
    radius = jax.random.uniform(radius_key, (), like.dtype) ** (1.0 / like.size)
    return radius * direction / jnp.maximum(safe_norm(direction), 1e-12)


def no_longer(vector: Float[Array, " d"], bound: Number) -> Float[Array, " d"]:
    """Return a vector, shortened to the length `bound` if it is longer."""
    length = safe_norm(vector)
    return vector * jnp.where(length > bound, bound / jnp.where(length > 0.0, length, 1.0), 1.0)


def _no_actuators(env: Environment, field: str, names: tuple[str, ...]) -> dict[str, str]:
    """Return what is wrong with names of actuators, if the agent lacks one of them."""
    actuators = [actuator.name for actuator in env.actuators]
    for name in names:
        if name not in actuators:
            hint = choices_text(name, actuators)
            return {field: f"{env.agent} has no actuator {name!r}{hint}"}
    return {}
