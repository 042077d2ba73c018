"""The compiled batch of environments with the interface of Stable-Baselines3.

An algorithm of that library takes it as its environment::

    PPO("MlpPolicy", SB3VecEnv("docking2d", 64))
"""
# pyright: reportMissingImports=false

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxsafe.adapters.gymnasium import GymVectorEnv
from jaxsafe.adapters.gymnasium_spaces import of_environment
from jaxsafe.environment import Environment, action_bounds
from jaxsafe.schema.errors import ConfigError, missing

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise missing(error, "stable_baselines3", "sb3") from None


class SB3VecEnv(VecEnv):
    """Many environments in one compiled step.

    An environment whose episode ends starts a new one in the same step.

    For each environment `infos` holds `cost`, and `costs` by constraint. Where an episode has ended
    it also holds `terminal_observation`, `TimeLimit.truncated`, `is_success` and `outcome`.
    `reset_infos` holds, for each environment, the `info` that `GymEnv.reset` would return at its
    latest start. `set_options` takes the options of `GymEnv.reset`.
    """

    def __init__(
        self,
        task: str | os.PathLike | Environment,
        num_envs: int,
        overrides: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """Make the environments.

        Args:
            task: the name of a task, a YAML file, or an environment that `jaxsafe.make` returned.
            num_envs: number of environments.
            overrides: as `jaxsafe.make` takes them.
            options: the other arguments of `GymVectorEnv`, except `autoreset_mode`.

        Raises:
            ConfigError: as `jaxsafe.make`, or actions are mixed or without bounds, which
                Stable-Baselines3 does not know.
        """
        self.env = GymVectorEnv(task, num_envs, overrides, autoreset_mode="SameStep", **options)
        _check_actions(self.env.env)
        super().__init__(num_envs, self.env.single_observation_space, self.env.single_action_space)

    def reset(self) -> np.ndarray:
        """Start an episode in each environment.

        Seeds and options that were given before this reset are used once.

        Returns:
            The observations, [num_envs, observation].
        """
        observation, infos = self.env.start_each(self._seeds, self._options)
        self.reset_infos = [of_environment(infos, index) for index in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def set_options(self, options: list[dict] | dict | None = None) -> None:
        """Set the options of the next reset.

        Args:
            options: the options of `GymEnv.reset`, as one dict for all environments or as a list
                with a dict for each.

        Raises:
            ConfigError: the list has another length than there are environments.
        """
        if not isinstance(options, dict | None) and len(options) != self.num_envs:
            raise ConfigError(
                f"set_options: expected options for {self.num_envs} environments, "
                f"found {len(options)}"
            )
        super().set_options(options)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, reward, terminated, truncated, batch = self.env.step(self._actions)
        done = terminated | truncated
        infos = _costs(batch)
        begun = {name: value for name, value in batch.items() if name in self.reset_infos[0]}
        final = batch["final_info"] if done.any() else {}
        last = _costs(final) if done.any() else []
        for index in np.flatnonzero(done):
            infos[index] = {
                **last[index],
                "terminal_observation": batch["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                "is_success": bool(final["is_success"][index]),
                "outcome": final["outcome"][index],
            }
            self.reset_infos[index] = of_environment(begun, int(index))
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray]:
        return self.env.render()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name)] * self._count(indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(
            f"{attr_name}: the environments are one program; give options when making them"
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        raise AttributeError(
            f"{method_name}: the environments are one program without own methods; see self.env"
        )

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * self._count(indices)

    def _count(self, indices: Any) -> int:
        """Return to how many environments the indices refer. None refers to all of them."""
        return len(list(self._get_indices(indices)))


def _check_actions(env: Environment) -> None:
    """Refuse actions that Stable-Baselines3 does not know.

    Raises:
        ConfigError: actions are mixed or without bounds.
    """
    if env.action_kind == "mixed":
        raise ConfigError(
            "actions: Stable-Baselines3 knows no mixed actions; choose continuous or discrete"
        )
    for name, low, high in zip(env.action_names, *action_bounds(env), strict=True):
        if not np.isfinite([low, high]).all():
            raise ConfigError(
                f"actuator {name}: Stable-Baselines3 needs actions with bounds;"
                " leave post_activation: clip"
            )


def _costs(infos: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return for each environment its cost, and its costs by constraint.

    Args:
        infos: the infos of the batch, in Gymnasium's form.
    """
    names = [name for name in infos["costs"] if not name.startswith("_")]
    columns = zip(*(infos["costs"][name].tolist() for name in names), strict=True)
    rows = [dict(zip(names, row, strict=True)) for row in columns] or [{}] * len(infos["cost"])
    pairs = zip(infos["cost"].tolist(), rows, strict=True)
    return [{"cost": cost, "costs": costs} for cost, costs in pairs]
