"""Brax's own PPO, SAC or APG learns docking2d.

    pip install '.[brax]' && python examples/brax_docking2d.py [ppo | sac | apg]

APG differentiates the reward through the spacecraft's dynamics. The settings are a start and are
not tuned.
"""

import sys
from functools import partial
from typing import Any

from brax.training.agents.apg import train as apg
from brax.training.agents.ppo import train as ppo
from brax.training.agents.ppo.networks import make_ppo_networks
from brax.training.agents.sac import train as sac
from brax.training.agents.sac.networks import make_sac_networks
from jax.nn import tanh

from jaxsafe.adapters.brax import BraxEnv, mend_brax, wrap


def train(algorithm: str, scale: float = 1.0) -> dict[str, Any]:
    """Train, and return the metrics of the last evaluation. `scale` shortens the training."""
    mend_brax()  # needed by Brax 0.14.2 with JAX 0.10 or newer
    env = BraxEnv("docking2d")
    seen = []

    def progress(step: int, metrics: dict[str, Any]) -> None:
        seen.append(metrics)
        shown = {
            name: float(metrics[f"eval/episode_{name}"]) for name in ("reward", "success", "cost")
        }
        print(f"{step:>10,}", *(f"{name} {value:.2f}" for name, value in shown.items()), flush=True)

    common = {
        "wrap_env_fn": wrap,
        "episode_length": 2000,
        "num_eval_envs": 64,
        "progress_fn": progress,
    }
    if algorithm == "ppo":
        networks = partial(
            make_ppo_networks,
            distribution_type="normal",
            noise_std_type="log",
            init_noise_std=0.5,
            activation=tanh,
            policy_hidden_layer_sizes=(64, 64),
            value_hidden_layer_sizes=(64, 64),
        )
        ppo.train(
            env,
            int(1_000_000 * scale),
            num_envs=16,
            unroll_length=128,
            batch_size=8,
            num_minibatches=2,
            num_evals=5,
            num_updates_per_batch=10,
            learning_rate=1e-3,
            discounting=0.97,
            gae_lambda=0.97,
            entropy_cost=0.0,
            clipping_epsilon=0.2,
            network_factory=networks,
            **common,
        )
    elif algorithm == "sac":
        sac.train(
            env,
            int(200_000 * scale),
            num_envs=16,
            batch_size=256,
            grad_updates_per_step=8,
            learning_rate=6e-4,
            discounting=0.98,
            min_replay_size=8192,
            max_replay_size=262_144,
            num_evals=5,
            network_factory=partial(make_sac_networks, hidden_layer_sizes=(64, 64)),
            **common,
        )
    elif algorithm == "apg":
        apg.train(
            env,
            policy_updates=int(400 * scale),
            horizon_length=64,
            num_envs=64,
            learning_rate=1e-3,
            num_evals=9,
            normalize_observations=True,
            **common,
        )
    else:
        sys.exit(f"algorithm: found {algorithm!r}; choose from ppo, sac, apg")
    return seen[-1]


if __name__ == "__main__":
    train(*sys.argv[1:2] or ["ppo"])
