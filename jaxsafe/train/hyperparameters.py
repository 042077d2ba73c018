"""Hyperparameters of PPO: what they may be, and how they change during a training.

Hyperparameters that are numbers are leaves of the pytree, and sizes are part of its structure.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array

from jaxsafe.agents.agent import Agent
from jaxsafe.config import override
from jaxsafe.environment import Environment, drawn, longest_episode
from jaxsafe.schema.component import ANY, Component, Range, Unit
from jaxsafe.schema.dotted_paths import get_path
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.types import Dimensionless, Number, Positive

Share = Range(0.0, 1.0)
"""Range of a number from 0 to 1."""

CostLimit = Annotated[Dimensionless, Range(0.0)]
"""The cost that an episode may have.

It is a number of violating steps, or the sum of their severity if the environment says so.
"""

Gain = Annotated[Dimensionless, Range(0.0, largest=10.0)]
"""Gain of a multiplier's logarithm on the excess of the cost as a share of its limit."""

MULTIPLIERS = (1e-4, 1e2)
"""Smallest and largest multiplier of a cost."""

Multiplier = Annotated[Dimensionless, Range(*MULTIPLIERS)]
"""What a cost of 1 takes off the reward."""

MAX_COUNT = 2**31 - 1
"""The largest number of environments, steps or minibatches. Programs count in 32 bits."""


class PPO(Component):
    """Hyperparameters of PPO. Their names are those of the literature."""

    field_word: ClassVar[str] = "option"
    synonyms: ClassVar[Mapping[str, str]] = {
        "anneal_lr": "learning_rate_decay",
        "batch_size": "num_minibatches",
        "discount": "gamma",
        "lam": "gae_lambda",
        "lr_schedule": "learning_rate_decay",
    }

    num_envs: Annotated[int, Range(1, largest=MAX_COUNT)] = 16
    """Number of environments, whose episodes run side by side."""
    num_steps: Annotated[int, Range(1, largest=MAX_COUNT)] = 128
    """Number of steps of each environment between two updates."""
    max_episode_steps: Annotated[Dimensionless, Range(1.0)] = 1e6
    """Number of steps after which episodes of training are truncated."""
    complete_episodes: bool = False
    """Whether to learn from whole episodes only, as in the paper's docking training.

    Every update then starts all environments afresh. An episode counts if even the longest one,
    begun at the same step, would have ended within `num_steps`. So `num_steps` must be at least the
    length of the longest episode. The steps after the last episode that counts are not learnt from.
    """
    num_epochs: Annotated[int, Range(1, largest=10_000)] = 10
    """Number of times that an update goes through its samples."""
    num_minibatches: Annotated[int, Range(1, largest=MAX_COUNT)] = 2
    """Number of parts of the samples of an update, one for each step of the optimiser."""
    learning_rate: Annotated[Dimensionless, Positive] = 3e-3
    """Learning rate at the beginning of the training."""
    final_learning_rate: Annotated[Dimensionless, Range(0.0)] = 3e-4
    """Learning rate at the end of the training."""
    learning_rate_decay: Literal["linear", "exponential"] = "linear"
    """How the learning rate changes from `learning_rate` to `final_learning_rate`."""
    gamma: Annotated[Dimensionless, Share] = 0.97
    """Discount factor γ."""
    horizon_growth: Annotated[Dimensionless, Positive] = 1.0
    """Factor by which the horizon 1/(1 − γ) has grown at the end. It grows exponentially."""
    gae_lambda: Annotated[Dimensionless, Share] = 1.0
    """Decay λ of generalised advantage estimation."""
    clip: Annotated[Dimensionless, Positive] = 0.2
    """Largest distance from 1 up to which the ratio of new to old probabilities counts."""
    noise_decay: Annotated[Dimensionless, Range(0.0, largest=20.0)] = 0.0
    """How far log_std falls until the end of the training, in addition to what is learnt."""
    value_coefficient: Annotated[Dimensionless, Range(0.0)] = 0.5
    """Weight of the critic's loss."""
    entropy_coefficient: Annotated[Dimensionless, Range(0.0)] = 0.0
    """Weight of the entropy of the policy, which is maximised."""
    max_grad_norm: Annotated[Dimensionless, Positive] = 0.5
    """Largest norm of a gradient. A longer gradient is scaled down to it."""
    averaging: Annotated[Dimensionless, Share] = 0.0
    """Share of the training over which networks are averaged. The average is evaluated and kept."""
    learns_from: Literal["desired", "actual"] = "desired"
    """The control to learn from where run time assurance changed it.

    `desired` is the control that the agent chose, and `actual` is the one that acted.
    """
    cost_limit: CostLimit | Mapping[str, CostLimit] = 25.0
    """The cost that an episode may have, with PPO-Lagrangian. By default it is in violating steps.

    A mapping has a number for each constraint that is limited, by its name. `jaxsafe train` sets it
    by the option `cost_limit`.
    """
    multiplier: Multiplier | Mapping[str, Multiplier] = 0.01
    """Multiplier of the cost at the start, in reward per violating step, with PPO-Lagrangian.

    A mapping has a multiplier for each constraint, by its name. If `cost_limit` has names too, they
    are the same ones.
    """
    multiplier_rate: Annotated[Dimensionless, Range(0.0)] = 0.03
    """Largest change of the multiplier's logarithm in an update, with PPO-Lagrangian.

    With 0 the multiplier is fixed, and needs no `cost_limit`.
    """
    multiplier_proportional: Gain = 0.0
    """Rise of the multiplier's logarithm while the cost is twice its limit, with PPO-Lagrangian.

    It is the proportional gain of PID-Lagrangian, and `multiplier_rate` is the integral one.
    """
    multiplier_derivative: Gain = 0.0
    """Rise of the multiplier's logarithm while the cost grows by its limit from update to update.

    It is the derivative gain of PID-Lagrangian. A cost that falls does not count.
    """
    curriculum: Mapping[str, Annotated[Number, Unit("physical", length=ANY)]] = dataclasses.field(
        default_factory=dict
    )
    """Numbers of the environment with which the training begins, by dotted path.

    Each moves to its own value in the environment, by the same factor in every update if both are
    above 0, and else by the same difference. Evaluations have the environment as it is. For
    instance '{deputy.start.position.distance: [100, 150]}' lets starts move farther away.
    """
    curriculum_share: Annotated[Dimensionless, Range(0.0, 1.0, open_low=True)] = 0.5
    """Share of the training after which the numbers of the `curriculum` have their own values."""

    @property
    def cost_names(self) -> tuple[str, ...]:
        """The constraints that `cost_limit` or `multiplier` names, in the order of the alphabet."""
        named = [each for each in (self.cost_limit, self.multiplier) if isinstance(each, Mapping)]
        return tuple(sorted(named[0])) if named else ()

    @property
    def batch_size(self) -> int:
        """Number of environment steps in one update."""
        return self.num_envs * self.num_steps

    def rows(self, agent: Agent) -> int:
        """Return how many samples are shuffled into minibatches.

        If a network remembers, a sample is all the steps of an environment between two updates.
        """
        return self.num_envs if agent.recurrent else self.batch_size

    def shares(self, agent: Agent) -> list[int]:
        """Return the numbers of devices that can share a seed.

        Each device has the same number of environments and of samples of a minibatch.
        """
        largest = math.gcd(self.num_envs, self.rows(agent) // self.num_minibatches)
        small = [count for count in range(1, math.isqrt(largest) + 1) if largest % count == 0]
        return sorted({*small, *(largest // count for count in small)})


def learning_rate(ppo: PPO, progress: Array | float) -> Array:
    """Return the learning rate after the share `progress` of the training."""
    first = jnp.asarray(ppo.learning_rate)
    last = jnp.asarray(ppo.final_learning_rate)
    if ppo.learning_rate_decay == "exponential":
        return first * (last / first) ** progress
    return first + (last - first) * progress


def discount(ppo: PPO, progress: Array | float) -> Array:
    """Return the discount factor γ after the share `progress` of the training.

    Its horizon 1/(1 − γ) grows exponentially by `horizon_growth`. With a short horizon the policy
    soon finds a way to succeed. With a long one it then finds a quick way.
    """
    return 1.0 - (1.0 - jnp.asarray(ppo.gamma)) / jnp.asarray(ppo.horizon_growth) ** progress


def on_the_way(env: Environment, ppo: PPO, progress: Array | float) -> Environment:
    """Return the environment after the share `progress` of the training, see `PPO.curriculum`."""
    if not ppo.curriculum:
        return env
    share = jnp.minimum(progress / ppo.curriculum_share, 1.0)
    values = {}
    for path, first in ppo.curriculum.items():
        last = get_path(env, path)
        positive = (first > 0.0) & (last > 0.0)
        factor = jnp.where(positive, last, 1.0) / jnp.where(positive, first, 1.0)
        line = first + (last - first) * share
        values[path] = jnp.where(positive, first * factor**share, line)
    return drawn(env, values)


def longest_training_episode(env: Environment, ppo: PPO) -> Array:
    """Return the number of steps after which every episode of the training has ended."""
    time_limit = longest_episode(env)
    truncation = jnp.asarray(ppo.max_episode_steps)
    return truncation if time_limit is None else jnp.minimum(time_limit, truncation)


def check_complete_episodes(env: Environment, ppo: PPO) -> None:
    """Check that `num_steps` are enough for a whole episode, if only whole episodes are used.

    Raises:
        ConfigError: they are not enough, or the length of an episode has no limit.
    """
    if not ppo.complete_episodes:
        return
    longest = longest_training_episode(env, ppo)
    # Inside `jax.jit` the number is not known.
    if isinstance(longest, Tracer) or longest <= ppo.num_steps:
        return
    if longest_episode(env) is None and longest == PPO.max_episode_steps:
        raise ConfigError(
            "ppo.complete_episodes: the task has no time limit, so an episode may never end;"
            " give ppo.max_episode_steps"
        )
    raise ConfigError(
        f"ppo.num_steps: expected at least {int(longest):,}, the longest episode, with"
        f" ppo.complete_episodes, found {ppo.num_steps:,}"
    )


def check_cost_limit(env: Environment, agent: Agent, ppo: PPO) -> None:
    """Check that limits and multipliers are for constraints of the environment, as the critic is.

    Raises:
        ConfigError: one is for something else, or the critic has other outputs.
    """
    if not agent.cost_critic:
        return
    constraints = [constraint.name for constraint in env.constraints]
    names = ppo.cost_names
    for place, numbers in (("cost_limit", ppo.cost_limit), ("ppo.multiplier", ppo.multiplier)):
        if not isinstance(numbers, Mapping):
            continue
        unknown = [name for name in numbers if name not in constraints]
        if unknown or not numbers:
            found = f"unknown constraint {show(unknown[0])}" if unknown else "expected a constraint"
            choices = choices_text(unknown[0] if unknown else "", constraints)
            raise ConfigError(f"{place}: {found}{choices}")
        if tuple(sorted(numbers)) != names:
            raise ConfigError(
                f"{place}: expected a number for each of {', '.join(names)}, as cost_limit has,"
                f" found {', '.join(sorted(numbers))}"
            )
    if agent.cost_names != names:
        raise ConfigError(
            "agent.cost_names: expected the names in ppo.cost_limit or ppo.multiplier,"
            f" {show(list(names))}, found {show(list(agent.cost_names))}"
        )


def check_curriculum(env: Environment, ppo: PPO) -> None:
    """Check that the curriculum has numbers of the environment, as the environment takes them.

    Raises:
        ConfigError: a path leads to no number, or the number has another size or does not fit.
    """
    for path, value in ppo.curriculum.items():
        override(env, {path: value}, "ppo.curriculum")
        own = get_path(env, path)
        if not isinstance(own, jax.Array) or own.shape != jnp.shape(value):
            shape = own.size if isinstance(own, jax.Array) else None
            expected = "a path to a number" if shape is None else f"{shape} numbers"
            raise ConfigError(f"ppo.curriculum: {path}: expected {expected}, found {show(value)}")
