"""Controllers: the way from the agent's action to named controls in physical units.

The paper describes them in Section 4 "Platforms" and in the appendix "Environment Platforms".
Between a controller and the dynamics, controls have names and no order. Actions have the order in
which the actuators are listed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.simulation.integrate import lag_within_rate
from jaxsafe.types import Control, Number, Seconds, Sim

Bound = Annotated[Number, Unit("physical"), Control]
"""A limit of a control, in the unit of that control."""

TimeConstant = Annotated[Number, Unit("s"), Range(0.0, open_low=True, smallest=1e-6, largest=1e6)]
"""Time constant of a first-order lag [s]."""

RateLimit = Annotated[
    Number, Unit("physical"), Range(0.0, open_low=True, smallest=1e-9, largest=1e9)
]
"""Largest change of a control per second, in the unit of that control."""

Controls = Mapping[str, Float[Array, ""]]
"""Controls in physical units, by name."""

MAX_TANH = 0.999
"""Largest tanh of an action that `Actuator.to_continuous` returns.

The action for a limit itself would be infinite, and no policy could learn from it.
"""


class Actuator(Component):
    """One named input of a platform and its limits, in physical units.

    Continuous actions in [−1, 1] are clipped and mapped affinely to [low, high]. With
    `post_activation: tanh` actions may be any numbers, and their hyperbolic tangent is mapped. With
    `zero_centred` the map is piecewise linear, so that 0 stays 0. Without `rescale` actions are
    physical already and are only clipped.

    Discrete actions choose one of `points` values, spaced equally from low to high, both included.
    With `discrete` the controller `mixed` takes discrete actions for this actuator.

    An actuator acts at once, unless it has a `time_constant` τ of a first-order lag or a
    `rate_limit` R. Then its value x follows the control u by ẋ = (u − x)/τ, no faster than R, and
    is 0 (or the limit nearest to 0) at the start of an episode. Over a step the plant receives the
    mean of x, and `sim.actuators` has x itself.
    """

    name: str
    low: Bound
    high: Bound
    points: Annotated[int, Range(2, largest=2**16)] = 11
    rescale: bool = True
    zero_centred: bool = False
    post_activation: Literal["clip", "tanh"] = "clip"
    discrete: bool = False
    time_constant: TimeConstant | None = None
    rate_limit: RateLimit | None = None

    @property
    def at_once(self) -> bool:
        """Whether the plant receives the control itself, without a lag or a rate limit."""
        return self.time_constant is None and self.rate_limit is None

    def follow(
        self, value: Float[Array, ""], control: Float[Array, ""], dt: Seconds
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the mean of the actuator's value over a step, and its value at the end.

        Args:
            value: the value at the beginning of the step, in physical units.
            control: the control that is held over the step, in physical units.
            dt: length of the step [s].
        """
        return lag_within_rate(value, control, self.time_constant, self.rate_limit, dt)

    def problem(self) -> str | None:
        if self.post_activation == "tanh" and not self.rescale:
            return "post_activation: tanh gives shares of the limits, so leave rescale on"
        if self.low <= self.high:
            return None
        return f"expected low ≤ high, found {self.low:g} and {self.high:g}"

    @property
    def action_range(self) -> tuple[Number, Number]:
        """The lowest and the highest continuous action. Actions beyond them make no difference."""
        if not self.rescale:
            return self.low, self.high
        return (-jnp.inf, jnp.inf) if self.post_activation == "tanh" else (-1.0, 1.0)

    def from_continuous(self, action: Float[Array, ""]) -> Float[Array, ""]:
        """Return the physical control of an action."""
        if not self.rescale:
            return jnp.clip(action, self.low, self.high)
        share = jnp.tanh(action) if self.post_activation == "tanh" else jnp.clip(action, -1.0, 1.0)
        if self.zero_centred:
            return jnp.where(share < 0.0, -self.low * share, self.high * share)
        return self.low + (share + 1.0) * (self.high - self.low) / 2.0

    def to_continuous(self, control: Float[Array, ""]) -> Float[Array, ""]:
        """Return the action that gives a physical control within the limits.

        With tanh, a control at a limit has the action of a control `MAX_TANH` of the way there.
        """
        if not self.rescale:
            return control
        share = self._share(control)
        if self.post_activation == "tanh":
            return jnp.arctanh(jnp.clip(share, -MAX_TANH, MAX_TANH))
        return share

    def _share(self, control: Float[Array, ""]) -> Float[Array, ""]:
        """Return where between the limits a control is, from −1 to 1."""
        if self.zero_centred:
            bound = jnp.where(control < 0.0, -self.low, self.high)
            return control / jnp.where(bound > 0.0, bound, 1.0)
        width = self.high - self.low
        return 2.0 * (control - self.low) / jnp.where(width > 0.0, width, 1.0) - 1.0

    def from_discrete(self, index: Array) -> Float[Array, ""]:
        """Return the physical control of an index, which is clipped to 0 … points − 1."""
        share = jnp.clip(index, 0, self.points - 1).astype(self.low.dtype) / (self.points - 1)
        return self.low + share * (self.high - self.low)


class Controller(Component):
    """Source of a platform's desired controls: an agent's actions, a script, or nothing at all."""

    takes_actions: ClassVar[bool] = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the controls that the controller gives, for an agent in the action's order."""
        return ()

    @property
    def points(self) -> tuple[int, ...]:
        """Number of choices of each actuator, 0 for one that takes continuous actions.

        It is empty if all actions are continuous.
        """
        return ()

    def control(self, action: Array, sim: Sim) -> Controls:
        """Return the desired controls by name.

        Args:
            action: the agent's action. Controllers that take no actions ignore it.
            sim: the simulation before the step.
        """
        raise NotImplementedError


class Uncontrolled(Controller, type="uncontrolled"):
    """No control: all are 0, as for the chief, or for an aircraft that flies on as it started."""

    def control(self, action: Array, sim: Sim) -> Controls:
        return {}


class AgentController(Controller):
    """Base of controllers that turn an agent's action into controls, one element per actuator."""

    takes_actions: ClassVar[bool] = True
    actuators: tuple[Actuator, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(actuator.name for actuator in self.actuators)


class Continuous(AgentController, type="continuous"):
    """Controller of an agent whose action has shape (actuators,), each a number in [−1, 1]."""

    def problem(self) -> str | None:
        discrete = [actuator.name for actuator in self.actuators if actuator.discrete]
        if not discrete:
            return None
        return (
            f"expected continuous actuators, found {discrete[0]!r} with discrete: true;"
            " choose type mixed"
        )

    def control(self, action: Float[Array, " actuators"], sim: Sim) -> Controls:
        return {
            actuator.name: actuator.from_continuous(action[i])
            for i, actuator in enumerate(self.actuators)
        }

    def action(self, control: Float[Array, " actuators"]) -> Float[Array, " actuators"]:
        """Return the action that gives a control.

        Args:
            control: controls within the limits, in physical units and action order, shape
                (actuators,).
        """
        return jnp.stack(
            [actuator.to_continuous(control[i]) for i, actuator in enumerate(self.actuators)]
        )


class Discrete(AgentController, type="discrete"):
    """Controller of an agent whose action has shape (actuators,), each an integer index."""

    @property
    def points(self) -> tuple[int, ...]:
        return tuple(actuator.points for actuator in self.actuators)

    def control(self, action: Array, sim: Sim) -> Controls:
        return {
            actuator.name: actuator.from_discrete(action[i])
            for i, actuator in enumerate(self.actuators)
        }


class Mixed(Continuous, type="mixed"):
    """Controller of an agent with continuous and discrete actions, as each actuator asks for.

    The action has shape (actuators,) and is a vector of floats. An actuator with `discrete: true`
    takes the index of a point, which is rounded to a whole number and clipped to 0 … points − 1.
    The others take numbers as they do in the controller `continuous`.
    """

    def problem(self) -> str | None:
        return None

    @property
    def points(self) -> tuple[int, ...]:
        points = tuple(actuator.points if actuator.discrete else 0 for actuator in self.actuators)
        return points if any(points) else ()

    def control(self, action: Float[Array, " actuators"], sim: Sim) -> Controls:
        return {
            actuator.name: actuator.from_discrete(jnp.round(action[i]))
            if actuator.discrete
            else actuator.from_continuous(action[i])
            for i, actuator in enumerate(self.actuators)
        }
