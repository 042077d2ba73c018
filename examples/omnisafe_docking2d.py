"""OmniSafe's PPO-Lagrangian learns docking2d under a budget of violations.

OmniSafe 0.5 asks for Safety-Gymnasium, which is tied to Gymnasium 0.28.1, and for pandas 2.0.3.
Neither is needed here:

    pip install . torch tensorboard wandb moviepy typer seaborn pandas gdown rich xmltodict
    pip install --no-deps omnisafe
    python examples/omnisafe_docking2d.py
"""

from __future__ import annotations

import sys
import types
from typing import Any, ClassVar

import torch

from jaxsafe.adapters.safety_gymnasium import SafetyEnv

# OmniSafe imports Safety-Gymnasium for tasks of its own, which are not used here.
sys.modules.setdefault("safety_gymnasium", types.ModuleType("safety_gymnasium"))
import omnisafe  # noqa: E402
from omnisafe.envs.core import CMDP, env_register  # noqa: E402


@env_register
class Docking(CMDP):
    """The compiled batch of environments with OmniSafe's tensors."""

    _support_envs: ClassVar[list[str]] = ["jaxsafe-docking2d"]
    need_time_limit_wrapper = False

    def __init__(self, env_id: str, num_envs: int = 1, device: str = "cpu", **options: Any) -> None:
        """Make `num_envs` environments. A single one has no batch axis, and OmniSafe resets it."""
        super().__init__(env_id)
        self._env = SafetyEnv(
            env_id.removeprefix("jaxsafe-"), num_envs if num_envs > 1 else None, **options
        )
        self.need_auto_reset_wrapper = num_envs == 1
        self._num_envs = num_envs
        self._device = device
        self._metadata = self._env.metadata
        self._action_space = self._env.single_action_space
        self._observation_space = self._env.single_observation_space

    @property
    def max_episode_steps(self) -> int:
        """Number of steps after which the task itself ends an episode."""
        return 2001

    def step(self, action: torch.Tensor) -> tuple:
        """Take a step and return OmniSafe's six values."""
        *values, info = self._env.step(action.detach().cpu().numpy())
        if "final_observation" in info:
            info["final_observation"] = self._tensor(info["final_observation"])
        return *(self._tensor(x) for x in values), info

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[torch.Tensor, dict]:
        """Start every environment."""
        observation, info = self._env.reset(seed=seed, options=options)
        return self._tensor(observation), info

    def set_seed(self, seed: int) -> None:
        """Start every environment from a seed."""
        self.reset(seed=seed)

    def render(self) -> Any:
        """Return a picture, or None without a render mode."""
        return self._env.render()

    def close(self) -> None:
        """Do nothing, because there is nothing to close."""

    def _tensor(self, array: Any) -> torch.Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=self._device)


def train(steps: int = 1_000_000, cost_limit: float = 25.0) -> Any:
    """Train PPO-Lagrangian under a budget of violating steps per episode.

    Batches and rates suit the task. OmniSafe starts all environments anew in each epoch. So each of
    the 8 environments takes 2,048 steps of the 16,384, which hold a whole episode of 2,001 steps.
    """
    rate = {"lr": 2e-3}
    agent = omnisafe.Agent(
        "PPOLag",
        "jaxsafe-docking2d",
        custom_cfgs={
            "train_cfgs": {"total_steps": steps, "vector_env_nums": 8, "torch_threads": 1},
            "algo_cfgs": {
                "steps_per_epoch": 16384,
                "update_iters": 10,
                "batch_size": 1024,
                "gamma": 0.98,
                "cost_gamma": 0.98,
                "lam": 0.98,
                "lam_c": 0.98,
                "obs_normalize": False,
                "use_critic_norm": False,
                "max_grad_norm": 0.5,
                "kl_early_stop": False,
            },
            "model_cfgs": {
                "weight_initialization_mode": "orthogonal",
                "actor": rate,
                "critic": rate,
            },
            "lagrange_cfgs": {"cost_limit": cost_limit, "lambda_lr": 0.01},
            "logger_cfgs": {
                "use_wandb": False,
                "use_tensorboard": False,
                "save_model_freq": 10_000,
            },
        },
    )
    agent.learn()
    return agent


if __name__ == "__main__":
    train(*map(int, sys.argv[1:2]))
