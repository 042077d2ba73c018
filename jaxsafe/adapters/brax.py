"""The tasks as environments of Brax, for its PPO, SAC and APG.

A trainer of Brax takes an environment together with `wrap`::

    ppo.train(BraxEnv("docking2d"), wrap_env_fn=wrap, …)
"""
# pyright: reportMissingImports=false

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxsafe.adapters import checked_count, environment
from jaxsafe.autoreset import choose
from jaxsafe.environment import Environment, action_bounds, reset, step
from jaxsafe.schema.errors import ConfigError, missing
from jaxsafe.types import Key, TimeStep

try:
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper
except ImportError as error:
    raise missing(error, "brax", "brax") from None


class BraxEnv(Env):
    """One task as an environment of Brax.

    `pipeline_state` is the `State` of the environment. `metrics` are `cost`, `success`, `cost_…`
    for each safety constraint and `reward_…` for each reward term. Brax sums them over episodes.

    `done` is 1 where the task ended. If a task truncates an episode by itself, Brax sees a
    termination. None of the five tasks does that. The limit that Brax knows of is its own
    `episode_length`.
    """

    def __init__(
        self,
        task: str | os.PathLike | Environment,
        overrides: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """Make the environment.

        Args:
            task: the name of a task, a YAML file, or an environment that `jaxsafe.make` returned.
            overrides: as `jaxsafe.make` takes them.
            options: `variant`, `randomize` and `rta` of `jaxsafe.make`.

        Raises:
            ConfigError: some action is discrete, or is not in [−1, 1]. Brax's agents know only
                continuous actions in that interval. Also raised as by `jaxsafe.make`.
        """
        self.env = environment(task, overrides, options)
        if self.env.num_action_points:
            raise ConfigError("actions: Brax's agents need continuous actions")
        for name, low, high in zip(self.env.action_names, *action_bounds(self.env), strict=True):
            if (low, high) != (-1.0, 1.0):
                raise ConfigError(
                    f"actuator {name}: Brax's agents act in [-1, 1], found [{low:g}, {high:g}];"
                    " leave rescale on and post_activation: clip"
                )

    def reset(self, rng: Key) -> State:
        """Return a random start."""
        state, timestep = reset(self.env, rng)
        return State(
            state,
            timestep.observation,
            timestep.reward,
            _number(timestep.done),
            self._metrics(timestep),
            {},
        )

    def step(self, state: State, action: Array) -> State:
        """Return the state one time step of the task later."""
        following, timestep = step(self.env, state.pipeline_state, action)
        return state.replace(
            pipeline_state=following,
            obs=timestep.observation,
            reward=timestep.reward,
            done=_number(timestep.done),
            metrics={**state.metrics, **self._metrics(timestep)},
        )

    @property
    def observation_size(self) -> int:
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return "jaxsafe"

    @property
    def dt(self) -> Array:
        """Seconds between two actions."""
        return self.env.dt * self.env.decision_period

    def _metrics(self, timestep: TimeStep) -> dict[str, Array]:
        terms = {f"reward_{name}": value for name, value in timestep.info.reward_terms.items()}
        return {
            "cost": timestep.cost,
            "success": _number(self.env.succeeded(timestep.info.outcome)),
            **{f"cost_{name}": cost for name, cost in timestep.costs.items()},
            **terms,
        }


class Repeat(Wrapper):
    """A wrapper that takes each action for several steps, at most until the episode ends.

    Rewards and metrics are sums over the steps taken. Brax's own repetition goes on after the end
    of an episode and adds the rewards that are paid there. Its metrics are those of the last step
    only.
    """

    def __init__(self, env: Env, action_repeat: int) -> None:
        super().__init__(env)
        self.action_repeat = action_repeat

    def step(self, state: State, action: Array) -> State:
        def again(taken: State, _: None) -> tuple[State, None]:
            following = self.env.step(taken, action)
            summed = following.replace(
                reward=taken.reward + following.reward,
                metrics=jax.tree.map(jnp.add, taken.metrics, following.metrics),
            )
            return choose(taken.done.astype(bool), taken, summed), None

        return jax.lax.scan(again, self.env.step(state, action), length=self.action_repeat - 1)[0]


class FreshStarts(Wrapper):
    """A wrapper that draws a new start for each episode.

    With Brax's own `AutoResetWrapper`, every episode of an environment begins where its first
    episode began.
    """

    def reset(self, rng: Key) -> State:
        state = self.env.reset(rng)
        state.info["starts"] = _split(rng)[0]
        return state

    def step(self, state: State, action: Array) -> State:
        begun = state.replace(done=jnp.zeros_like(state.done))
        begun.info["steps"] = jnp.where(state.done, 0.0, state.info["steps"])
        taken = self.env.step(begun, action)
        keys, now = _split(taken.info["starts"])

        def draw(taken: State) -> State:
            fresh = self.env.reset(now)
            pipeline_state, obs = choose(
                taken.done, (fresh.pipeline_state, fresh.obs), (taken.pipeline_state, taken.obs)
            )
            return taken.replace(pipeline_state=pipeline_state, obs=obs)

        following = jax.lax.cond(jnp.any(taken.done), draw, lambda taken: taken, taken)
        following.info["starts"] = keys
        return following


def wrap(
    env: Env,
    episode_length: int = 1000,
    action_repeat: int = 1,
    randomization_fn: Callable | None = None,
) -> Wrapper:
    """Return a batch of environments in which each episode has a fresh start.

    Give this function to Brax's trainers as `wrap_env_fn`.

    Args:
        env: the environment of one task.
        episode_length: number of steps of the task after which an episode is truncated.
        action_repeat: number of steps of the task for which each action is taken.
        randomization_fn: must be None, because it is for Brax's own physics.

    Raises:
        ConfigError: there is a `randomization_fn`, or `action_repeat` is below 1.
    """
    if randomization_fn is not None:
        raise ConfigError("randomization_fn: give BraxEnv randomize={path: [low, high]} instead")
    checked_count("action_repeat", action_repeat)
    episodes = EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat=1)
    return FreshStarts(Repeat(episodes, action_repeat) if action_repeat > 1 else episodes)


def mend_brax() -> None:
    """Restore `jax.device_put_replicated`. Brax 0.14.2 calls it, and JAX 0.10 no longer has it."""
    if hasattr(jax, "device_put_replicated"):
        return

    def device_put_replicated(tree: Any, devices: Any) -> Any:
        copies = jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)
        mesh = jax.sharding.Mesh(devices, ("i",))
        return jax.device_put(
            copies, jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("i"))
        )

    jax.device_put_replicated = device_put_replicated


def _number(flag: Array) -> Array:
    return flag.astype(jnp.result_type(float))


def _split(keys: Key) -> tuple[Key, Key]:
    pairs = jax.vmap(jax.random.split)(keys)
    return pairs[:, 0], pairs[:, 1]
