"""The base of all simulated vehicles.

A vehicle has a name, a start, a controller, and a state with position and velocity.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxsafe.schema.component import Component, Range
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.simulation.controllers import Controller, Controls, Uncontrolled
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.simulation.initializers import Initializer
from jaxsafe.types import Key, Record, Seconds, Sim


class Platform(Component):
    """A vehicle: initializers for its start, a controller, and the map over one time step."""

    name: str
    dimension: Annotated[int, Range(1, 3)]
    start: tuple[Initializer, ...] = ()
    controller: Controller = Uncontrolled()

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the controls that `step` takes. A control that is not given is 0."""
        return ()

    @property
    def random_fields(self) -> tuple[str, ...]:
        """Names of the state fields that `start` draws."""
        names = [name for initializer in self.start for name in initializer.draws]
        return tuple(dict.fromkeys(names))

    def rest(self) -> Any:
        """Return the state record before any initializer has run: at the origin, at rest."""
        raise NotImplementedError

    def shapes(self) -> Any:
        """Return the state record with shapes and types for arrays, so nothing is computed."""
        return jax.eval_shape(lambda: self.rest())

    def quantities(self) -> tuple[str, ...]:
        """Return the names of what can be observed: fields of the state and its properties."""
        state = self.shapes()
        derived = [
            name
            for base in reversed(type(state).__mro__)
            for name, value in vars(base).items()
            if isinstance(value, property)
        ]
        return tuple(name for name in (*vars(state), *derived) if name != "orientation")

    def settle(self, state: Any) -> Any:
        """Return a start as `step` would leave it, for instance with its angles wrapped."""
        return state

    def step(self, state: Any, controls: Controls, dt: Seconds) -> Any:
        """Return the state after `dt` seconds with the controls held constant.

        Args:
            state: the state record before the step.
            controls: controls in physical units, by name.
            dt: length of the step [s].
        """
        raise NotImplementedError

    def step_within_limits(self, state: Any, controls: Controls, dt: Seconds) -> Any:
        """Return the state after `dt` seconds, as `step` does, for a step that reaches no limit.

        The caller promises that nothing reaches a limit before the end of the step. So the result
        may be cheaper to compute.
        """
        return self.step(state, controls, dt)

    def held(self, state: Any, controls: Controls, dt: Seconds) -> Controls:
        """Return the controls that act in a part of a step as the given ones do in the whole step.

        Args:
            state: the state record before the step.
            controls: controls of the whole step in physical units, by name.
            dt: length of the whole step [s].
        """
        return controls

    def bend(self, before: Any, after: Any, dt: Seconds) -> Float[Array, ""]:
        """Return how far the path may leave the straight line from `before` to `after`.

        These are the states before and after a step of `dt` seconds. At a constant acceleration the
        path leaves the line by ‖Δv‖Δt/8. If the acceleration stops within the step, at a limit, the
        path leaves it by up to 32/27 of that.
        """
        return 0.15 * safe_norm(after.velocity - before.velocity) * dt  # 0.15 ≥ 1/8 · 32/27 = 0.148

    @property
    def can_be_pushed(self) -> bool:
        """Whether `pushed` is defined: the velocity is a field of the state or can be set."""
        sets_velocity = type(self).with_velocity is not Platform.with_velocity
        return sets_velocity or "velocity" in vars(self.shapes())

    def pushed(
        self,
        state: Any,
        acceleration: Float[Array, " d"],
        wind: Float[Array, " d"],
        dt: Seconds,
    ) -> Any:
        """Return the state after a step in which a disturbance acted besides the controls.

        Args:
            state: the state record after the step without the disturbance.
            acceleration: a disturbing acceleration a, which adds aΔt to the velocity and aΔt²/2 to
                the position, shape (d,).
            wind: a velocity w that adds wΔt to the position, shape (d,).
            dt: length of the step [s].
        """
        pushed = self.with_velocity(state, state.velocity + dt * acceleration)
        return pushed.replace(position=state.position + dt * (wind + 0.5 * dt * acceleration))

    def with_velocity(self, state: Any, velocity: Float[Array, " d"]) -> Any:
        """Return a state with another velocity, shape (d,), within the limits of the platform."""
        return state.replace(velocity=velocity)

    def derivative(self, state: Any, controls: Controls) -> Any:
        """Return the time derivative f(x) + g(x)u, Eq. (3), as a record of the state's class."""
        raise NotImplementedError

    def reset(self, key: Key, sim: Sim) -> Any:
        """Draw a random start, given the platforms that were placed before.

        Raises:
            ConfigError: an initializer draws a value of another shape than its field has.
        """
        drawn: dict[str, Array] = {}
        rest = self.rest()
        keys = jax.random.split(key, max(len(self.start), 1))
        for initializer, key_i in zip(self.start, keys, strict=False):
            value = initializer.draw(key_i, drawn, sim)
            values = value if isinstance(value, dict) else {initializer.name: value}
            for name, value in values.items():
                drawn[name] = value
                expected = getattr(rest, name).shape
                if value.shape != expected:
                    field = "" if name == initializer.name else f"{name}: "
                    raise ConfigError(
                        f"platforms.{self.name}.start.{initializer.name}: {field}expected shape"
                        f" {expected}, found {value.shape}"
                    )
        return self.settle(rest.replace(**drawn))

    def place(self, values: Mapping[str, Any] | Record) -> Any:
        """Return the state for a start that the user gives.

        Args:
            values: a state record, or values of its fields by name. Fields that are not given are
                as in `rest`.

        Raises:
            ConfigError: a field is unknown, a random field is missing, or a value has another shape
                or is not a finite number.
        """
        values = vars(values) if isinstance(values, Record) else values
        if not isinstance(values, Mapping):
            raise ConfigError(
                f"reset_to: {self.name}: expected fields by name, found {show(values)}"
            )
        rest = self.rest()
        for name in values:
            if name not in vars(rest):
                raise ConfigError(
                    f"reset_to: {self.name} has no field {show(name)}"
                    f"{choices_text(name, vars(rest))}"
                )
        for name in self.random_fields:
            if name not in values:
                raise ConfigError(
                    f"reset_to: {self.name}.{name} is missing: it is random at reset, so give it"
                )
        given = {
            name: placed(f"{self.name}.{name}", value, getattr(rest, name))
            for name, value in values.items()
        }
        return self.settle(rest.replace(**given))


def placed(name: str, value: Any, like: Array) -> Array:
    """Return a value that the user gives to `reset_to` as an array of the shape and type of `like`.

    Raises:
        ConfigError: the value has another shape or is not finite numbers.
    """
    try:
        # A number beyond the largest float32 becomes infinite here, and is refused below.
        with np.errstate(over="ignore"):
            array = jnp.asarray(value, like.dtype)
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(f"reset_to: {name}: expected numbers, found {show(value)}") from None
    if value is None or array.shape != like.shape:
        raise ConfigError(f"reset_to: {name}: expected shape {like.shape}, found {array.shape}")
    if not isinstance(array, Tracer) and not np.isfinite(np.asarray(array)).all():
        raise ConfigError(f"reset_to: {name}: expected finite numbers, found {show(value)}")
    return array
