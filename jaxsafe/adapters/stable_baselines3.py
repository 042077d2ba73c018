"""The compiled batch of environments as Stable-Baselines3 wants it: `PPO("MlpPolicy", SB3VecEnv("docking2d", 64))`."""
# pyright: reportMissingImports=false

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxsafe.adapters.gymnasium import GymVectorEnv
from jaxsafe.environment import Environment
from jaxsafe.errors import missing

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise missing(error, "stable_baselines3", "sb3") from None


class SB3VecEnv(VecEnv):
    """Many environments in one compiled step; a lane whose episode ends starts anew in the same step.

    `infos` holds per lane `cost` and, where an episode has ended, `terminal_observation`, `TimeLimit.truncated`,
    `is_success` and `outcome`. All other facts are in `self.env`, a `GymVectorEnv`.
    """

    def __init__(
        self,
        task: str | os.PathLike | Environment,
        num_envs: int,
        overrides: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """Make the environments; arguments as of `GymVectorEnv`.

        Raises:
            ConfigError: as `jaxsafe.make`.
        """
        self.env = GymVectorEnv(task, num_envs, overrides, autoreset_mode="SameStep", **options)
        super().__init__(num_envs, self.env.single_observation_space, self.env.single_action_space)

    def reset(self) -> np.ndarray:
        """Start an episode in each lane, from the seeds given before, if any."""
        observation, _ = self.env.reset(seed=self._seeds)
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, reward, terminated, truncated, facts = self.env.step(self._actions)
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{"cost": cost} for cost in facts["cost"].tolist()]
        for lane in np.flatnonzero(done):
            final = facts["final_info"]
            infos[lane] = {
                "cost": final["cost"][lane].item(),
                "terminal_observation": facts["final_obs"][lane],
                "TimeLimit.truncated": bool(truncated[lane] and not terminated[lane]),
                "is_success": bool(final["is_success"][lane]),
                "outcome": final["outcome"][lane],
            }
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray]:
        return self.env.render()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name)] * len(self._lanes(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(f"{attr_name}: the lanes are one program; give options when making the environments")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise AttributeError(f"{method_name}: the lanes are one program without methods of their own; see self.env")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(self._lanes(indices))

    def _lanes(self, indices: Any) -> list[int]:
        found: Iterable[int] = self._get_indices(indices)
        return list(found)
