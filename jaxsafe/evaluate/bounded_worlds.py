"""The world that is as bad as the bound of a filter allows, or worse."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from jaxsafe.config import override
from jaxsafe.environment import Environment
from jaxsafe.rta.certified import CertifiedRTA
from jaxsafe.schema.errors import ConfigError


def world_at(env: Environment, level: float, searched: bool = False) -> Environment:
    """Return an environment whose uncertainty is `level` times the bound of its filter.

    The disturbance and the errors of navigation have the worst direction in every step. The true
    mass is below the mass that the filter knows. The thrust is turned by the whole angle. The delay
    is the same at every level.

    Args:
        env: the environment, with a filter that has a `bound`.
        level: multiple of the bound. At 1 the filter promises safety.
        searched: whether the disturbance is of type `chosen`, so that a search can choose it.

    Raises:
        ConfigError: the filter has no bound, or the world does not fit the environment.
    """
    bound = getattr(env.rta, "bound", None)
    if not isinstance(env.rta, CertifiedRTA) or bound is None:
        raise ConfigError("levels: the filter has no rta.bound; choose rta=robust")
    agent = env.agent
    parts: list[dict[str, Any]] = []
    if bound.delay:
        parts.append({"type": "delay", "name": "bound_delay", "steps": bound.delay})
    if bound.misalignment > 0.0:
        thrusters = [name for name in env.action_names if name.startswith("thrust_")]
        parts.append(
            {
                "type": "misaligned",
                "name": "bound_misalignment",
                "thrusters": thrusters,
                "angle": float(jnp.minimum(level * bound.misalignment, jnp.pi)),
                "axis": [1.0, 1.0, 1.0],
            }
        )
    if bound.process > 0.0:
        kind = "chosen" if searched else "worst"
        size = float(level * bound.process)
        parts.append({"type": kind, "name": "bound_process", "on": agent, "bound": size})
    for what in ("position", "velocity"):
        size = float(level * getattr(bound, what))
        if size > 0.0:
            name = f"bound_{what}"
            parts.append(
                {"type": "worst_navigation", "name": name, "of": agent, "what": what, "bound": size}
            )
    changes: dict[str, Any] = {"uncertainty": [*env.uncertainty, *parts]}
    if bound.mass > 0.0:
        mass = env.agent_platform.mass  # type: ignore[attr-defined]
        changes[f"rta.model.{agent}.mass"] = float(mass)
        changes[f"{agent}.mass"] = float(mass * jnp.maximum(1.0 - level * bound.mass, 0.01))
    return override(env, changes)
