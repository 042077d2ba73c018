"""Aerospace SafeRL benchmarks as pure JAX functions."""

import jaxsafe.address_space
import jaxsafe.quiet  # noqa: F401 before anything imports jaxlib
from jaxsafe.agents.policy_file import load_policy
from jaxsafe.config import dump, load, override
from jaxsafe.environment import Environment, reset, reset_to, step
from jaxsafe.envs import make
from jaxsafe.rollout import rollout
from jaxsafe.schema.errors import ConfigError

__all__ = [
    "ConfigError",
    "Environment",
    "dump",
    "load",
    "load_policy",
    "make",
    "override",
    "reset",
    "reset_to",
    "rollout",
    "step",
]
