"""What every simulated vehicle has in common: a name, a start, a controller, and a state with position and velocity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array

from jaxsafe.component import Component, Range
from jaxsafe.errors import ConfigError, nearest
from jaxsafe.simulation.controllers import Controller, Controls, Uncontrolled
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
        """The controls that `step` takes, by name."""
        return ()

    @property
    def random_fields(self) -> tuple[str, ...]:
        """The state fields that `start` draws."""
        return tuple(initializer.name for initializer in self.start)

    def rest(self) -> Any:
        """Return the state record before any initializer ran: at the origin, at rest."""
        raise NotImplementedError

    def step(self, state: Any, controls: Controls, dt: Seconds) -> Any:
        """Return the state after `dt` seconds with the controls held constant."""
        raise NotImplementedError

    def reset(self, key: Key, sim: Sim) -> Any:
        """Draw a random start, given the platforms placed so far."""
        drawn: dict[str, Array] = {}
        for initializer, key_i in zip(self.start, jax.random.split(key, max(len(self.start), 1)), strict=False):
            drawn[initializer.name] = initializer.draw(key_i, drawn, sim)
        return self.rest().replace(**drawn)

    def place(self, values: Mapping[str, Any] | Record) -> Any:
        """Return the state with chosen fields, for a start that the user gives.

        Raises:
            ConfigError: a field is unknown, a random one is missing, or a value has another shape or is not a number.
        """
        values = vars(values) if isinstance(values, Record) else values
        if not isinstance(values, Mapping):
            raise ConfigError(f"reset_to: {self.name}: expected fields by name, found {values!r}")
        rest = self.rest()
        for name in values:
            if name not in vars(rest):
                raise ConfigError(f"reset_to: {self.name} has no field {name!r}; choose from {nearest(name, vars(rest))}")
        for name in self.random_fields:
            if name not in values:
                raise ConfigError(f"reset_to: {self.name}.{name} is missing: it is random at reset, so give it")
        return rest.replace(**{name: self._field(name, value, getattr(rest, name)) for name, value in values.items()})

    def _field(self, name: str, value: Any, like: Array) -> Array:
        try:
            array = jnp.asarray(value, like.dtype)
        except (TypeError, ValueError):
            raise ConfigError(f"reset_to: {self.name}.{name}: expected numbers, found {value!r}") from None
        if array.shape != like.shape:
            raise ConfigError(f"reset_to: {self.name}.{name}: expected shape {like.shape}, found {array.shape}")
        if not isinstance(array, Tracer) and not bool(jnp.all(jnp.isfinite(array))):
            raise ConfigError(f"reset_to: {self.name}.{name}: expected finite numbers, found {value!r}")
        return array
