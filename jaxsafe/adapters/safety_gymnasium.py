"""The convention of constrained RL: a step returns the cost between reward and `terminated`, six values in all."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxsafe.adapters.gymnasium import GymEnv, GymVectorEnv
from jaxsafe.environment import Environment


class SafetyEnv:
    """A task as Safety-Gymnasium's environments are: `observation, reward, cost, terminated, truncated, info`.

    One environment, or with `num_envs` a compiled batch in which a lane whose episode ends starts anew in the same step.
    Then `infos["final_observation"]` holds what the ended episodes led to, where `infos["_final_observation"]`.
    """

    def __init__(
        self,
        task: str | os.PathLike | Environment,
        num_envs: int | None = None,
        overrides: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """Make the environment; `options` as of `GymEnv`.

        Raises:
            ConfigError: as `jaxsafe.make`.
        """
        if num_envs is None:
            self.env: GymEnv | GymVectorEnv = GymEnv(task, overrides, **options)
        else:
            self.env = GymVectorEnv(task, num_envs, overrides, autoreset_mode="SameStep", **options)
        self.num_envs = num_envs
        self.observation_space, self.action_space = (
            self.env.observation_space,
            self.env.action_space,
        )
        self.single_observation_space = getattr(
            self.env, "single_observation_space", self.observation_space
        )
        self.single_action_space = getattr(self.env, "single_action_space", self.action_space)
        self.metadata, self.render_mode = self.env.metadata, self.env.render_mode

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """As Gymnasium's."""
        return self.env.reset(seed=seed, options=options)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, Any, Any, Any, dict]:
        """Advance one time step: observation, reward, cost, terminated, truncated, info."""
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
        """As Gymnasium's."""
        return self.env.render()

    def close(self) -> None:
        """As Gymnasium's."""
        self.env.close()
