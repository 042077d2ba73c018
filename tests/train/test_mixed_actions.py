"""PPO learns numbers and choices at once."""

from typing import Any

import jax
import jax.numpy as jnp
import pytest
from jaxtyping import Array, Float
from probe_environments import Sign

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.networks import MLP
from jaxsafe.config import build
from jaxsafe.environment import Environment
from jaxsafe.processors.observation import Observe
from jaxsafe.processors.reward import Reward
from jaxsafe.processors.terminal import Timeout
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.controllers import Actuator, Controls, Mixed
from jaxsafe.simulation.platform import Platform
from jaxsafe.train.host.options import resolve
from jaxsafe.train.hyperparameters import PPO
from jaxsafe.train.train import train
from jaxsafe.types import Record, Sim


class PairState(Record):
    position: Float[Array, " d"]
    push: Float[Array, ""]
    choice: Float[Array, ""]


class Pair(Platform):
    """A platform that stays where it starts and remembers its two controls."""

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("push", "choice")

    def rest(self) -> PairState:
        return PairState(jnp.zeros(self.dimension), jnp.zeros(()), jnp.zeros(()))

    def step(self, state: PairState, controls: Controls, dt: Any) -> PairState:
        return state.replace(**controls)


class MatchBoth(Reward):
    """A reward that is highest if the push is half the position, and the choice minus that."""

    def process(self, memory: Any, sim: Sim) -> Array:
        pair = sim.platforms["pair"]
        half = 0.5 * pair.position[0]
        return 1.0 - (pair.push - half) ** 2 - (pair.choice + half) ** 2


def pair() -> Environment:
    actuators = (
        Actuator(name="choice", low=-1.0, high=1.0, points=5, discrete=True),
        Actuator(name="push", low=-1.0, high=1.0),
    )
    platform = Pair(
        name="pair",
        dimension=1,
        start=(Sign(name="position"),),
        controller=Mixed(actuators=actuators),
    )
    return build(
        Environment(
            agent="pair",
            platforms=(platform,),
            terminal=(Timeout(name="timeout", limit=0.5),),
            reward=(MatchBoth(name="match"),),
            observation=(Observe(name="position", of="pair", what="position"),),
        )
    )


@pytest.mark.thorough
def test_ppo_learns_a_number_and_a_choice_at_once() -> None:
    env = pair()
    agent = normalise(Agent(actor=MLP(hidden=(16,))))
    ppo = normalise(PPO(num_envs=8, num_steps=16, num_epochs=8, final_learning_rate=3e-3))
    state, curves = train(env, agent, ppo, jax.random.key(0), 100)
    for position in (-1.0, 1.0):
        policy = agent.distribution(env, state.params, jnp.array([position]))
        choice, push = policy.mode().tolist()
        assert choice == (1.0 if position > 0 else 3.0)  # of −1, −0.5, 0, 0.5, 1
        assert push == pytest.approx(0.5 * position, abs=0.1)
    assert curves["entropy"][-1] < curves["entropy"][0]


@pytest.mark.thorough
def test_a_control_that_acted_is_no_choice_to_learn_from() -> None:
    options = {
        "env": "docking2d",
        "actions": "mixed",
        "env.deputy.controller.actuators.thrust_y.discrete": True,
        "rta": "default",
        "rta_training": "corrected_action",
    }
    with pytest.raises(ConfigError, match=r"^ppo.learns_from: the actual control is no choice of"):
        resolve(options)
