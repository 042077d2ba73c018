"""What every simulated vehicle has in common: a name, a start, a controller, and a state with position and velocity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxsafe.schema.component import Component, Range
from jaxsafe.schema.errors import ConfigError, nearest, show
from jaxsafe.simulation.controllers import Controller, Controls, Uncontrolled
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.simulation.initializers import Initializer
from jaxsafe.types import Key, Record, Seconds, Sim


class Platform(Component):
    """A vehicle: initializers for its start, a controller, and the map over one time step."""

    name: str
    dimension: Annotated[int, Range(2, 3)]
    start: tuple[Initializer, ...] = ()
    controller: Controller = Uncontrolled()

    @property
    def inputs(self) -> tuple[str, ...]:
        """The controls that `step` takes, by name; one that is not given is 0."""
        return ()

    @property
    def random_fields(self) -> tuple[str, ...]:
        """The state fields that `start` draws."""
        return tuple(initializer.name for initializer in self.start)

    def rest(self) -> Any:
        """Return the state record before any initializer ran: at the origin, at rest."""
        raise NotImplementedError

    def quantities(self) -> tuple[str, ...]:
        """What of its state can be observed: the fields, and what follows from them."""
        state = self.rest()
        derived = [name for name, value in vars(type(state)).items() if isinstance(value, property)]
        return tuple(name for name in (*vars(state), *derived) if name not in ("orientation",))

    def settle(self, state: Any) -> Any:
        """Return the start as `step` would leave it, for instance with its angles wrapped."""
        return state

    def step(self, state: Any, controls: Controls, dt: Seconds) -> Any:
        """Return the state after `dt` seconds with the controls held constant."""
        raise NotImplementedError

    def step_within_limits(self, state: Any, controls: Controls, dt: Seconds) -> Any:
        """`step` for controls under which no state reaches a limit before the end, which may be cheaper to compute."""
        return self.step(state, controls, dt)

    def held(self, state: Any, controls: Controls, dt: Seconds) -> Controls:
        """Return controls that do over a part of a step what the given ones do over all of it, `dt` seconds."""
        return controls

    def bend(self, before: Any, after: Any, dt: Seconds) -> Float[Array, ""]:
        """Return how far the path may leave the straight line between the states before and after a step.

        It is ‖Δv‖Δt/8 at a constant acceleration, and up to 32/27 of that where it stops on the way, at a limit.
        """
        return 0.15 * safe_norm(after.velocity - before.velocity) * dt

    def derivative(self, state: Any, controls: Controls) -> Any:
        """Return the time derivative of the state, a record like it: f(x) + g(x)u, Eq. (3)."""
        raise NotImplementedError

    def reset(self, key: Key, sim: Sim) -> Any:
        """Draw a random start, given the platforms placed so far."""
        drawn: dict[str, Array] = {}
        rest = self.rest()
        for initializer, key_i in zip(self.start, jax.random.split(key, max(len(self.start), 1)), strict=False):
            drawn[initializer.name] = value = initializer.draw(key_i, drawn, sim)
            expected = getattr(rest, initializer.name).shape
            if value.shape != expected:
                raise ConfigError(
                    f"platforms.{self.name}.start.{initializer.name}: expected shape {expected}, found {value.shape}"
                )
        return self.settle(rest.replace(**drawn))

    def place(self, values: Mapping[str, Any] | Record) -> Any:
        """Return the state with chosen fields, for a start that the user gives.

        Raises:
            ConfigError: a field is unknown, a random one is missing, or a value has another shape or is not a number.
        """
        values = vars(values) if isinstance(values, Record) else values
        if not isinstance(values, Mapping):
            raise ConfigError(f"reset_to: {self.name}: expected fields by name, found {show(values)}")
        rest = self.rest()
        for name in values:
            if name not in vars(rest):
                raise ConfigError(
                    f"reset_to: {self.name} has no field {show(name)}; choose from {nearest(name, vars(rest))}"
                )
        for name in self.random_fields:
            if name not in values:
                raise ConfigError(f"reset_to: {self.name}.{name} is missing: it is random at reset, so give it")
        given = {name: placed(f"{self.name}.{name}", value, getattr(rest, name)) for name, value in values.items()}
        return self.settle(rest.replace(**given))


def placed(name: str, value: Any, like: Array) -> Array:
    """A value that the user gives to `reset_to`, in the shape and type of `like`.

    Raises:
        ConfigError: it has another shape or is not finite numbers.
    """
    try:
        with np.errstate(over="ignore"):  # beyond the largest float32 is infinite, and refused below
            array = jnp.asarray(value, like.dtype)
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(f"reset_to: {name}: expected numbers, found {show(value)}") from None
    if value is None or array.shape != like.shape:
        raise ConfigError(f"reset_to: {name}: expected shape {like.shape}, found {array.shape}")
    if not isinstance(array, Tracer) and not np.isfinite(np.asarray(array)).all():
        raise ConfigError(f"reset_to: {name}: expected finite numbers, found {show(value)}")
    return array
