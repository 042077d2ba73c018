"""d3rlpy learns docking2d from recorded steps alone, by behaviour cloning.

    pip install . d3rlpy
    jaxsafe dataset pretrained/docking2d episodes=120
    python examples/d3rlpy_docking2d.py docking2d_expert.npz [updates]

The training takes some minutes on a core.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import d3rlpy
import jax
import numpy as np
import torch
from d3rlpy.optimizers import AdamFactory, CosineAnnealingLRFactory
from d3rlpy.preprocessing import MinMaxActionScaler, StandardObservationScaler

import jaxsafe
from jaxsafe.dataset import Dataset, load_dataset


def learn(data: Dataset, updates: int = 20_000, seed: int = 0) -> Any:
    """Return a learner that imitates the actions of a dataset."""
    torch.set_num_threads(1)  # these networks are too small for more
    d3rlpy.seed(seed)
    episodes = d3rlpy.dataset.MDPDataset(
        data.observation,
        data.action,
        data.reward,
        terminals=data.terminated,
        timeouts=data.truncated,
        action_space=d3rlpy.constants.ActionSpace.CONTINUOUS,
    )
    learner = d3rlpy.algos.BCConfig(
        batch_size=256,
        learning_rate=1e-3,  # down to 0: near the chief small errors of the thrust count
        optim_factory=AdamFactory(lr_scheduler_factory=CosineAnnealingLRFactory(T_max=updates)),
        observation_scaler=StandardObservationScaler(),
        action_scaler=MinMaxActionScaler(),
    ).create(device="cpu")
    learner.fit(
        episodes,
        n_steps=updates,
        n_steps_per_epoch=min(updates, 5_000),
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        show_progress=False,
    )
    return learner


def as_policy(learner: Any) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Return what a learner has learnt as a policy. Torch computes its actions."""

    def predict(observation: np.ndarray) -> np.ndarray:
        return learner.predict(np.asarray(observation)).astype(np.float32)

    def policy(key: jax.Array, observation: jax.Array) -> jax.Array:
        num_actions = learner.impl.action_size
        action = jax.ShapeDtypeStruct((*observation.shape[:-1], num_actions), observation.dtype)
        return jax.pure_callback(predict, action, observation)

    return policy


if __name__ == "__main__":
    data, _ = load_dataset(sys.argv[1])
    policy = as_policy(learn(data, *map(int, sys.argv[2:])))
    results = jaxsafe.evaluate(jaxsafe.make("docking2d"), policy, episodes=100)
    print(f"success: {results['success_rate']:.0%}")
    print(f"violating steps in an episode: {results['episode_cost']:.2f}")
