"""The tasks with the interface of Safety-Gymnasium, as OmniSafe uses it.

A step returns six values. The cost is between the reward and `terminated`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxsafe.adapters.gymnasium import GymEnv, GymVectorEnv
from jaxsafe.environment import Environment


class SafetyEnv:
    """A task with the interface of Safety-Gymnasium's environments.

    A step returns `observation, reward, cost, terminated, truncated, info`.

    It is one environment, or with `num_envs` a compiled batch. An environment of the batch whose
    episode ends starts a new one in the same step. Then `infos["_final_observation"]` is True for
    that environment, and `infos["final_observation"]` holds the last observation of the old
    episode.
    """

    def __init__(
        self,
        task: str | os.PathLike | Environment,
        num_envs: int | None = None,
        overrides: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """Make the environment.

        Args:
            task: the name of a task, a YAML file, or an environment that `jaxsafe.make` returned.
            num_envs: number of environments of a batch. None stands for one environment without a
                batch axis.
            overrides: as `jaxsafe.make` takes them.
            options: as `GymEnv` takes them.

        Raises:
            ConfigError: as `jaxsafe.make`.
        """
        if num_envs is None:
            self.env: GymEnv | GymVectorEnv = GymEnv(task, overrides, **options)
        else:
            self.env = GymVectorEnv(task, num_envs, overrides, autoreset_mode="SameStep", **options)
        self.num_envs = num_envs
        self.observation_space = self.env.observation_space
        self.action_space = self.env.action_space
        self.single_observation_space = getattr(
            self.env, "single_observation_space", self.observation_space
        )
        self.single_action_space = getattr(self.env, "single_action_space", self.action_space)
        self.metadata = self.env.metadata
        self.render_mode = self.env.render_mode

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Start an episode, as `GymEnv.reset` or `GymVectorEnv.reset`."""
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[np.ndarray, Any, Any, Any, Any, dict]:
        """Advance one time step of the task.

        Args:
            action: the action as `GymEnv.step` or `GymVectorEnv.step` takes it.

        Returns:
            The observation, reward, cost, `terminated`, `truncated` and `info`.

        Raises:
            ResetNeeded: there was no reset before.
            ConfigError: the action has another shape, or actions are discrete and it is not whole
                numbers.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        cost = info["cost"]
        if "final_obs" in info:
            cost = np.where(info["_final_obs"], info["final_info"]["cost"], cost)
            for ours, theirs in (
                ("final_obs", "final_observation"),
                ("_final_obs", "_final_observation"),
            ):
                info[theirs] = info.pop(ours)
        return observation, reward, cost, terminated, truncated, info

    def render(self) -> Any:
        """Return a picture, or one for each environment of the batch."""
        return self.env.render()

    def close(self) -> None:
        self.env.close()
