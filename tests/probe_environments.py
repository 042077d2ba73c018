"""Environments so small that the right value and the right action are known.

Each finds one kind of bug in PPO.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.config import build
from jaxsafe.environment import Environment
from jaxsafe.processors.constraint import SpeedLimit
from jaxsafe.processors.observation import Observation, Observe
from jaxsafe.processors.reward import Reward
from jaxsafe.processors.status import Status
from jaxsafe.processors.terminal import Timeout
from jaxsafe.simulation.controllers import Actuator, Continuous, Controls, Discrete
from jaxsafe.simulation.initializers import Initializer
from jaxsafe.simulation.platform import Platform
from jaxsafe.types import Dimensionless, Key, Record, Sim


class PointState(Record):
    position: Float[Array, " d"]
    push: Float[Array, ""]


class Point(Platform):
    """A platform that stays where it starts and remembers the last push."""

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("push",)

    def rest(self) -> PointState:
        return PointState(jnp.zeros(self.dimension), jnp.zeros(()))

    def step(self, state: PointState, controls: Controls, dt: Any) -> PointState:
        return state.replace(push=controls["push"])


class Sign(Initializer):
    """An initializer that draws ±1 with equal probability."""

    def draw(self, key: Key, drawn: Any, sim: Sim) -> Array:
        return jax.random.rademacher(key, (1,), jnp.float32)


class Glimpse(Observation):
    """The position at the start of an episode, and 0 after it."""

    def measure(self, memory: Any, sim: Sim) -> Array:
        return jnp.where(sim.time == 0.0, sim.platforms["point"].position, 0.0)


class Constant(Reward):
    value: Dimensionless = 1.0

    def process(self, memory: Any, sim: Sim) -> Array:
        return self.value * jnp.ones(())


class Position(Reward):
    def process(self, memory: Any, sim: Sim) -> Array:
        return sim.platforms["point"].position[0]


class Match(Reward):
    """A reward of 1 − (push − position)², so the best action is the observation."""

    def process(self, memory: Any, sim: Sim) -> Array:
        point = sim.platforms["point"]
        return 1.0 - (point.push - 0.5 * point.position[0]) ** 2


class Hard(Status):
    """A status: how hard the last push was."""

    def process(self, memory: Any, sim: Sim) -> Array:
        return jnp.abs(sim.platforms["point"].push)


class Allowed(Status):
    most: Dimensionless

    def process(self, memory: Any, sim: Sim) -> Array:
        return self.most * jnp.ones(())


def probe(
    reward: Reward,
    steps: int = 1,
    ends: str = "terminated",
    discrete: bool = False,
    most: float | None = None,
    observation: Observation | None = None,
) -> Environment:
    """Return an environment whose episodes have `steps` steps at a random sign.

    A push harder than `most` costs.
    """
    actuators = (Actuator(name="push", low=-1.0, high=1.0, points=5),)
    controller = Discrete(actuators=actuators) if discrete else Continuous(actuators=actuators)
    return build(
        Environment(
            agent="point",
            platforms=(
                Point(
                    name="point", dimension=1, start=(Sign(name="position"),), controller=controller
                ),
            ),
            terminal=(Timeout(name="timeout", limit=steps - 0.5, ends=ends),),  # type: ignore[arg-type]
            status=() if most is None else (Hard(name="hard"), Allowed(name="allowed", most=most)),
            constraints=()
            if most is None
            else (SpeedLimit(name="push", speed="hard", velocity_limit="allowed"),),
            reward=(reward,),
            observation=(observation or Observe(name="position", of="point", what="position"),),
        )
    )


def recall(steps: int) -> Environment:
    """Return an environment that shows its sign at the start and rewards it on every step."""
    return probe(Match(name="match"), steps=steps, observation=Glimpse(name="glimpse"))
