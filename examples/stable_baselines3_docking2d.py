"""Stable-Baselines3's PPO learns docking2d on the compiled batch of environments.

    pip install 'jaxsafe[sb3]' && python examples/stable_baselines3_docking2d.py

About three minutes on two cores; torch needs no GPU.
"""

import sys

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from jaxsafe.adapters.stable_baselines3 import SB3VecEnv


def train(steps: int = 400_000, seed: int = 0) -> PPO:
    """PPO from 16 environments, on the paper's observation."""
    torch.set_num_threads(1)  # these networks are too small for more
    env = VecMonitor(SB3VecEnv("docking2d", 16))  # counts returns and lengths of episodes
    model = PPO(
        "MlpPolicy", env, seed=seed, verbose=1,
        n_steps=128, batch_size=1024, n_epochs=10, gamma=0.97, gae_lambda=1.0,
        learning_rate=lambda remaining: 3e-4 + remaining * (3e-3 - 3e-4),
        policy_kwargs={"log_std_init": -0.7, "net_arch": [64, 64]},
    )  # fmt: skip
    return model.learn(steps)


def success_rate(model: PPO, episodes: int = 100) -> float:
    """With sampled actions, as in training, from starts of their own.

    The modes of this policy alone mostly stop short of the chief: gamma = 0.97 sees 33 s ahead, and it is in no hurry.
    """
    env = SB3VecEnv("docking2d", episodes)
    env.seed(1000)
    observation, successes = env.reset(), np.full(episodes, np.nan)
    while np.isnan(successes).any():
        observation, _, done, infos = env.step(model.predict(observation, deterministic=False)[0])
        for lane in np.flatnonzero(done & np.isnan(successes)):
            successes[lane] = infos[lane]["is_success"]
    return float(successes.mean())


if __name__ == "__main__":
    print(f"success: {success_rate(train(*map(int, sys.argv[1:]))):.0%}")
