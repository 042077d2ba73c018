"""The packaged policy docks in a batch of Gymnasium's environments.

It flies with run time assurance or without.

    pip install . && python examples/gymnasium_docking3d.py [none | default]
"""

import sys

import gymnasium as gym
import jax
import numpy as np

import jaxsafe


def fly(rta: str = "none", num_envs: int = 64) -> dict[str, float]:
    """Fly one episode in each environment.

    Return the shares of successes and of episodes with a violation.
    """
    env = gym.make_vec(
        "jaxsafe/Docking3D-v0", num_envs=num_envs, autoreset_mode="SameStep", rta=rta
    )
    policy = jax.jit(jaxsafe.load_policy("docking3d"))
    key = jax.random.key(0)
    observation, _ = env.reset(seed=0)
    running = np.ones(num_envs, bool)
    success = np.zeros(num_envs, bool)
    violated = np.zeros(num_envs, bool)
    while running.any():
        key, key_now = jax.random.split(key)
        observation, _, terminated, truncated, info = env.step(
            np.asarray(policy(key_now, observation))
        )
        done = terminated | truncated
        # Where an episode has ended, `info` is that of the next one, and `final_info` of the last.
        ended = info.get("final_info", info)
        success |= running & done & ended["is_success"]
        violated |= running & (np.where(done, ended["cost"], info["cost"]) > 0)
        running &= ~done
    return {"success": float(success.mean()), "with a violation": float(violated.mean())}


if __name__ == "__main__":
    for name, share in fly(*sys.argv[1:2]).items():
        print(f"{name}: {share:.0%}")
