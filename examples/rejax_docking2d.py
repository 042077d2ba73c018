"""rejax's PPO, unmodified, learns docking2d: four seeds in one program.

    pip install '.[gymnax]' rejax && python examples/rejax_docking2d.py

rejax 0.1.3 needs gymnax 0.0.9, and its distrax needs a nightly TensorFlow Probability:

    pip install gymnax==0.0.9 six --pre tfp-nightly
"""

import sys

import jax
from rejax import PPO

from jaxsafe.adapters.gymnax import GymnaxEnv

NUM_SEEDS = 4


def train(steps: int = 500_000) -> tuple[jax.Array, jax.Array]:
    """Train, and return length and return of the evaluations.

    Both have the shape (seeds, evaluations, episodes).
    """
    env = GymnaxEnv("docking2d", legacy=True)
    ppo = PPO.create(
        env=env,
        env_params=env.default_params,
        total_timesteps=steps,
        eval_freq=steps // 4,
        num_envs=16,
        num_steps=128,
        num_epochs=10,
        num_minibatches=2,
        learning_rate=1e-3,
        gamma=0.97,
        gae_lambda=0.97,
        ent_coef=0.0,
        max_grad_norm=0.5,
        agent_kwargs={"hidden_layer_sizes": (64, 64), "activation": "tanh"},
    )
    return jax.jit(jax.vmap(ppo.train))(jax.random.split(jax.random.PRNGKey(0), NUM_SEEDS))[1]


if __name__ == "__main__":
    lengths, returns = train(*map(int, sys.argv[1:]))
    for length, values in zip(lengths.mean(axis=-1).T, returns.mean(axis=-1).T, strict=True):
        print(
            "return of each seed",
            *(f"{x:6.2f}" for x in values),
            "  length",
            *(f"{x:6.0f}" for x in length),
        )
