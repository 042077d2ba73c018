"""Aerospace SafeRL benchmarks as pure JAX functions."""

import jaxsafe.address_space
import jaxsafe.quiet  # noqa: F401 before anything imports jaxlib
from jaxsafe.adapters.registration import register_ids
from jaxsafe.config import override
from jaxsafe.environment import Environment, reset, reset_to, step
from jaxsafe.envs import make
from jaxsafe.errors import ConfigError
from jaxsafe.rollout import rollout
from jaxsafe.train.policy import load_policy

register_ids()

__all__ = ["ConfigError", "Environment", "load_policy", "make", "override", "reset", "reset_to", "rollout", "step"]
