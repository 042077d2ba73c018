"""Aerospace SafeRL benchmarks as pure JAX functions."""

from typing import TYPE_CHECKING

import jaxsafe.address_space
import jaxsafe.quiet  # noqa: F401 before anything imports jaxlib
from jaxsafe.agents.policy_file import load_policy
from jaxsafe.config import dump, load, override
from jaxsafe.environment import Environment, reset, reset_to, step
from jaxsafe.envs import make
from jaxsafe.rollout import rollout
from jaxsafe.schema.errors import ConfigError

if TYPE_CHECKING:
    from jaxsafe.evaluate.evaluate import evaluate
    from jaxsafe.train.train import train
else:
    from jaxsafe import evaluate, train  # packages that can be called

__all__ = [
    "ConfigError",
    "Environment",
    "dump",
    "evaluate",
    "load",
    "load_policy",
    "make",
    "override",
    "reset",
    "reset_to",
    "rollout",
    "step",
    "train",
]
