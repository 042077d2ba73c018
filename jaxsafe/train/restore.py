"""Reading checkpoints back: the structure comes from the configuration, the numbers from the files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxsafe.environment import Environment
from jaxsafe.errors import ConfigError, nearest
from jaxsafe.train import ppo
from jaxsafe.train.agent import Params
from jaxsafe.train.checkpoint import Checkpoints
from jaxsafe.train.config import TrainConfig
from jaxsafe.train.seeds import SeedMapper


def structure(env: Environment, config: TrainConfig) -> dict[str, Any]:
    """Shapes and types of what a checkpoint holds, [seeds]: the training state and the best parameters of each seed."""

    def seeds(keys: jax.Array) -> ppo.TrainState:
        return jax.vmap(lambda one: ppo.init(env, config.agent, config.ppo, one))(keys)

    state = jax.eval_shape(seeds, jax.random.split(jax.random.key(0), config.seeds))
    return {
        "state": state,
        "best": {"params": state.average, "success": jax.ShapeDtypeStruct((config.seeds,), jnp.float32)},
    }


def load_params(mapper: SeedMapper, run: Path, config: TrainConfig, env: Environment, which: str) -> tuple[Params, int]:
    """The networks of every seed from a checkpoint, `last`, `best` or a step, and the step of that checkpoint.

    Raises:
        ConfigError: there is no such checkpoint, or it cannot be read.
    """
    checkpoints = Checkpoints(run)
    if not checkpoints.steps:
        raise ConfigError(f"run: {run} has no checkpoint yet")
    if which not in ("last", "best") and not which.isdecimal():
        choices = ["last", "best", *map(str, checkpoints.steps)]
        raise ConfigError(f"checkpoint: found {which!r}; choose from {nearest(which, choices)}")
    step = int(which) if which.isdecimal() else checkpoints.steps[-1]
    content, _ = checkpoints.restore(step, structure(env, config))
    return mapper.place(content["best"]["params"] if which == "best" else content["state"].average), step
