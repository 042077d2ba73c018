"""Stable-Baselines3's PPO learns docking2d on the compiled batch of environments.

It gets the paper's observation.

    pip install '.[sb3]' && python examples/stable_baselines3_docking2d.py [steps] [seed]

The training takes some minutes on two cores. torch needs no GPU.
"""

import sys

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

from jaxsafe.adapters.stable_baselines3 import SB3VecEnv


class GrowingHorizon(BaseCallback):
    """A horizon 1/(1 − gamma) that grows by a factor over the training.

    With a short horizon the agent finds the chief. With a longer one it then finds the quick way.
    """

    def __init__(self, factor: float, steps: int) -> None:
        super().__init__()
        self.factor = factor
        self.steps = steps

    def _on_training_start(self) -> None:
        self.first = 1.0 - self.model.gamma

    def _on_rollout_start(self) -> None:
        gamma = 1.0 - self.first / self.factor ** (self.num_timesteps / self.steps)
        self.model.gamma = self.model.rollout_buffer.gamma = gamma

    def _on_step(self) -> bool:
        return True


def train(steps: int = 1_000_000, seed: int = 0) -> PPO:
    """Train PPO with 64 environments."""
    torch.set_num_threads(1)  # these networks are too small for more
    env = VecMonitor(SB3VecEnv("docking2d", 64))  # counts returns and lengths of episodes
    model = PPO(
        "MlpPolicy",
        env,
        seed=seed,
        verbose=1,
        n_steps=128,
        batch_size=1024,
        n_epochs=10,
        gamma=0.965,
        gae_lambda=0.98,
        learning_rate=lambda remaining: 1e-4 + remaining * (2e-3 - 1e-4),
        policy_kwargs={"log_std_init": -0.35, "net_arch": [64, 64]},
    )
    return model.learn(steps, callback=GrowingHorizon(4.0, steps))


def success_rate(model: PPO, deterministic: bool, episodes: int = 100) -> float:
    """Return the success rate from other starts than those of the training.

    Args:
        model: the trained model.
        deterministic: whether it acts by the modes of its distributions. Else it samples.
        episodes: number of episodes, each in an environment of its own.
    """
    env = SB3VecEnv("docking2d", episodes)
    env.seed(1000)
    observation = env.reset()
    successes = np.full(episodes, np.nan)
    while np.isnan(successes).any():
        observation, _, done, infos = env.step(
            model.predict(observation, deterministic=deterministic)[0]
        )
        for index in np.flatnonzero(done & np.isnan(successes)):
            successes[index] = infos[index]["is_success"]
    return float(successes.mean())


if __name__ == "__main__":
    model = train(*map(int, sys.argv[1:]))
    print(
        *(
            f"success, {kind}: {success_rate(model, kind == 'modes'):.0%}"
            for kind in ("sampled", "modes")
        ),
        sep="\n",
    )
