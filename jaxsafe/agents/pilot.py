"""Trained policies that fly platforms other than the agent, such as the lead of a formation."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxsafe.agents.policy_file import load_policy
from jaxsafe.agents.trained_policy import TrainedPolicy, TrainedRecurrentPolicy
from jaxsafe.environment import Environment, empty_sim
from jaxsafe.schema.convert import DIRECTORY
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.controllers import Controller, Controls
from jaxsafe.transition import judge
from jaxsafe.types import PlatformName, Sim


class Pilot(Controller, type="pilot"):
    """A trained policy that flies a platform which is not the agent.

    `policy` is the name of a task, for the policy that comes with the package, or a policy file
    (.npz), whose path begins at the YAML file. `platforms` are those that take the places of the
    platforms in the policy's own environment, in the order that they have there. In rejoin2d these
    are lead and wingman. So `{type: pilot, policy: rejoin2d, platforms: [guide, lead]}` flies the
    lead after a guide.

    The policy acts by its most probable action. It observes the exact state. Whatever an
    observation remembers is as at the start of an episode. A file is read once in a process.
    """

    policy: str
    platforms: tuple[PlatformName, ...]

    @classmethod
    def prepared(cls, entries: dict[str, Any], place: str) -> dict[str, Any]:
        path = entries.get("policy")
        if not isinstance(path, str) or not path.endswith(".npz"):
            return entries
        return {**entries, "policy": str(DIRECTORY.get() / path)}

    @property
    def names(self) -> tuple[str, ...]:
        return _read(self.policy).action_names

    def problem(self) -> str | None:
        try:
            policy = _read(self.policy)
        except ConfigError as error:
            return str(error)
        places = [platform.name for platform in policy.env.platforms]
        if len(places) != len(self.platforms):
            found = ", ".join(self.platforms) or "none"
            return f"expected platforms in the places of {', '.join(places)}, found {found}"
        return None

    def misfits(self, env: Environment) -> dict[str, str]:
        own = _read(self.policy).env
        dimension = env.agent_platform.dimension
        if own.agent_platform.dimension != dimension:
            found = f"{own.agent_platform.dimension}, and the platforms have {dimension}"
            return {"policy": f"{self.policy} flies in a space of dimension {found}"}
        flown = next(platform.name for platform in env.platforms if platform.controller is self)
        pilot = self.platforms[[platform.name for platform in own.platforms].index(own.agent)]
        if pilot != flown:
            return {"platforms": f"expected {flown!r} in the place of {own.agent}, found {pilot!r}"}
        return {}

    def control(self, action: Array, sim: Sim) -> Controls:
        policy = _read(self.policy)
        env = policy.env
        platforms = {
            platform.name: sim.platforms[name]
            for platform, name in zip(env.platforms, self.platforms, strict=True)
        }
        seen = judge(env, empty_sim(env).replace(time=sim.time, platforms=platforms))
        observation = [item.process(item.init(seen), seen) for item in env.observation]
        # A deterministic policy makes no use of the key.
        chosen = policy(jax.random.key(0), jnp.concatenate(observation))
        return env.agent_platform.controller.control(chosen, seen)


def _read(policy: str) -> TrainedPolicy:
    """Return a policy. Its file is read once for each precision.

    Raises:
        ConfigError: there is no such policy, or it remembers.
    """
    return _load(policy, jnp.result_type(float))


@functools.cache
def _load(policy: str, precision: Any) -> TrainedPolicy:
    # A policy that is first met inside a trace must not keep numbers of that trace.
    with jax.ensure_compile_time_eval():
        loaded = load_policy(policy)
    if isinstance(loaded, TrainedRecurrentPolicy):
        raise ConfigError(f"policy: {policy} remembers, and a controller has no memory")
    return loaded
