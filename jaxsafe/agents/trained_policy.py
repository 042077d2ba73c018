"""Trained policies as functions that know what they are for.

They print what they observe and do, refuse observations of another size in one line, and return
actions within the bounds of the actuators.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.networks import Memory, Params
from jaxsafe.environment import Environment, action_bounds, action_text
from jaxsafe.rollout import RecurrentPolicy
from jaxsafe.schema.component import fields
from jaxsafe.schema.describe import Described, Rows
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.controllers import Continuous
from jaxsafe.types import Key


class _Trained(Described):
    """What both kinds of trained policies know."""

    env: Environment
    """The environment that the policy was trained in."""
    agent: Agent
    deterministic: bool
    about: dict[str, Any]
    _act: Callable[[Key, Array, Memory], tuple[Array, Memory]]

    def __init__(
        self,
        env: Environment,
        agent: Agent,
        params: Params,
        deterministic: bool,
        about: dict[str, Any],
    ) -> None:
        # A recurrent policy is a frozen dataclass, which refuses ordinary assignments.
        values = {"env": env, "agent": agent, "deterministic": deterministic, "about": about}
        for name, value in values.items():
            object.__setattr__(self, name, value)

        def act(key: Key, observation: Array, memory: Memory) -> tuple[Array, Memory]:
            action, memory = agent.act(env, params, key, observation, deterministic, memory)
            return _within_bounds(env, action), memory

        # Without compilation each call would work out again how the networks' inputs are computed.
        object.__setattr__(self, "_act", jax.jit(act))

    @property
    def task(self) -> str:
        """Name of the environment that the policy was trained in."""
        return str(self.about.get("env", ""))

    @property
    def observation_names(self) -> tuple[str, ...]:
        """A name for each element of the observation."""
        return self.env.observation_names

    @property
    def action_names(self) -> tuple[str, ...]:
        """The names of the actuators in the order of the action."""
        return self.env.action_names

    def _checked(self, observation: Array) -> Array:
        wanted = self.env.observation_size
        found = jnp.shape(observation)
        if not found or found[-1] != wanted:
            raise ConfigError(
                f"observation: expected {wanted} numbers on the last axis, "
                f"as {self.task} observes, found shape {found}"
            )
        return jnp.asarray(observation)

    def _heading(self) -> str:
        how = "most probable action" if self.deterministic else "sampled actions"
        return f"Policy of {self.task}, {how}"

    def _rows(self) -> Rows:
        names = self.observation_names
        yield "observation", f"{len(names)} numbers: {', '.join(names)}"
        yield "action", action_text(self.env)
        actor = self.agent.actor
        sizes = [f"{name} {getattr(actor, name)}" for name in fields(type(actor))]
        yield "network", ", ".join([actor.type_name or type(actor).__name__, *sizes])
        yield "features", str(self.agent.features.type_name or type(self.agent.features).__name__)
        origin = [f"{name} {self.about[name]}" for name in ("preset", "seed") if name in self.about]
        steps = [f"{self.about['step']:,} steps"] if "step" in self.about else []
        yield "trained", ", ".join([*origin, *steps])


class TrainedPolicy(_Trained):
    """A trained policy: `policy(key, observation)` returns an action.

    Observations may have leading batch axes, and the actions then have them too. Actions are within
    the bounds of the actuators, which are −1 and 1 unless an actuator takes physical units.
    `policy.task`, `policy.observation_names` and `policy.action_names` say what it is for.
    """

    def __call__(self, key: Key, observation: Float[Array, "*batch o"]) -> Array:
        """Return an action for each observation.

        Args:
            key: a typed PRNG key. It means nothing if the policy is deterministic.
            observation: observations `[*batch, o]`.

        Raises:
            ConfigError: the last axis of the observations has another size.
        """
        return self._act(key, self._checked(observation), ())[0]


class TrainedRecurrentPolicy(_Trained, RecurrentPolicy):
    """A trained policy that remembers.

    `policy.act(key, observation, memory)` returns an action and the memory after it, and
    `policy.memory` is the memory at the start of an episode.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)

        def act(key: Key, observation: Array, memory: Memory) -> tuple[Array, Memory]:
            return self._act(key, self._checked(observation), memory)

        RecurrentPolicy.__init__(self, act, self.agent.actor.memory())


def trained_policy(
    env: Environment,
    agent: Agent,
    params: Params,
    about: dict[str, Any],
    deterministic: bool,
) -> TrainedPolicy | TrainedRecurrentPolicy:
    """Return a policy as a function.

    Args:
        env: the environment that it was trained in.
        agent: the agent.
        params: its parameters.
        about: `env` (its name), `preset`, `seed` and `step`, as far as they are known.
        deterministic: whether to act by the mode of the distribution over actions.
    """
    kind = TrainedRecurrentPolicy if agent.actor.recurrent else TrainedPolicy
    return kind(env=env, agent=agent, params=params, deterministic=deterministic, about=about)


def _within_bounds(env: Environment, action: Array) -> Array:
    """Return continuous actions clipped as the controller clips them, and others unchanged."""
    if not isinstance(env.agent_platform.controller, Continuous):
        return action
    low, high = (jnp.asarray(bound, action.dtype) for bound in action_bounds(env))
    return jnp.clip(action, low, high)
