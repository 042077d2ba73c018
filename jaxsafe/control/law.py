"""The base of control laws, and a law as a policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.control.observed import Needs, observed_sim, require_observed
from jaxsafe.environment import Environment, action_text
from jaxsafe.schema.component import Component, fields, normalise
from jaxsafe.schema.describe import Described, Rows, brief
from jaxsafe.schema.errors import ConfigError
from jaxsafe.transition import bounds
from jaxsafe.types import Key, Sim, State


class ControlLaw(Component):
    """Base of control laws.

    A subclass writes `control`. If a law computes something once for an environment, such as its
    gains, the subclass also writes `design`, which returns it.
    """

    def needs(self, env: Environment) -> Needs:
        """Return what the law must see: pairs of a platform or region and a quantity of it.

        Raises:
            ConfigError: the law cannot fly the agent of this environment.
        """
        return ()

    def design(self, env: Environment) -> Any:
        """Return a tree of arrays that `control` needs. The numbers of `env` must not be traced."""
        return ()

    def control(self, env: Environment, design: Any, sim: Sim) -> Float[Array, " m"]:
        """Return the control in physical units and action order, which may be beyond its bounds.

        Args:
            env: the environment.
            design: what `design` returned.
            sim: the simulation before the step. Only its platforms and regions are asked for.
        """
        raise NotImplementedError

    @property
    def designs(self) -> bool:
        """Whether it computes something for an environment, whose numbers must then be known."""
        return type(self).design is not ControlLaw.design

    def policy(self, env: Environment) -> LawPolicy:
        """Return the law as a policy for an environment.

        Raises:
            ConfigError: the law cannot fly the agent of this environment.
        """
        return LawPolicy(env, normalise(self))


class LawPolicy(Described):
    """A control law as a policy: `policy(key, observation)` returns an action.

    Observations may have leading batch axes, and the actions then have them too. A law draws
    nothing, so the key is not used. From the whole state, whatever is observed,
    `policy.control(sim)` returns the control in physical units and `policy.action(state)` the
    action.
    """

    def __init__(self, env: Environment, law: ControlLaw) -> None:
        self.env = env
        self.law = law
        self.needs = law.needs(env)
        self.design = law.design(env)

    def __call__(self, key: Key, observation: Float[Array, "*batch o"]) -> Array:
        """Return `observed_action(observation)`."""
        return self.observed_action(observation)

    def observed_action(self, observation: Float[Array, "*batch o"]) -> Array:
        """Return an action for each observation.

        Raises:
            ConfigError: the observation lacks what the law needs, or has another size.
        """
        require_observed(self.env, self.needs, self.law.type_name or type(self.law).__name__)
        size = self.env.observation_size
        shape = jnp.shape(observation)
        if not shape or shape[-1] != size:
            raise ConfigError(
                f"observation: expected {size} numbers on the last axis, found shape {shape}"
            )

        def act(single: Float[Array, " o"]) -> Array:
            return action_of(self.env, self.control(observed_sim(self.env, single)))

        return jnp.vectorize(act, signature="(o)->(a)")(jnp.asarray(observation))

    def control(self, sim: Sim) -> Float[Array, " m"]:
        """Return the control in physical units, within its bounds, for a simulation."""
        low, high = bounds(self.env)
        return jnp.clip(self.law.control(self.env, self.design, sim), low, high)

    def action(self, state: State) -> Array:
        """Return the action for a state, as `reset` and `step` return it."""
        return action_of(self.env, self.control(state.sim))

    def _heading(self) -> str:
        return f"Control law {self.law.type_name or type(self.law).__name__}"

    def _rows(self) -> Rows:
        yield "action", action_text(self.env)
        for name in fields(type(self.law)):
            yield name, brief(getattr(self.law, name))


def wrong_controls(env: Environment, law: ControlLaw, given: Sequence[str]) -> ConfigError:
    """Return the error for an agent that takes other controls than the law gives."""
    return ConfigError(
        f"controller: {law.type_name} gives {', '.join(given)}; "
        f"{env.agent} takes {', '.join(env.action_names)}"
    )


def action_of(env: Environment, control: Float[Array, " m"]) -> Array:
    """Return the action that gives a control. A discrete action is the choice nearest to it.

    Args:
        env: the environment.
        control: the control in physical units and action order, within its bounds, shape (m,).
    """
    points = env.num_action_points or (0,) * env.action_size
    elements = []
    for value, actuator, count in zip(control, env.actuators, points, strict=True):
        if count:
            width = actuator.high - actuator.low
            share = (value - actuator.low) / jnp.where(width > 0.0, width, 1.0)
            elements.append(jnp.round(share * (count - 1)))
        else:
            elements.append(actuator.to_continuous(value))
    action = jnp.stack(elements)
    return action.astype(jnp.int32) if env.action_kind == "discrete" else action
