"""Changes of an environment by dotted paths.

Such paths are `reward.delta_v.scale`, `deputy.mass` and `terminal.timeout.limit`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxsafe.config.check import check
from jaxsafe.config.tied import carry
from jaxsafe.environment import Environment, require_environment
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.schema.retype import set_paths


def override(env: Environment, changes: Mapping[str, Any], place: str = "") -> Environment:
    """Return the environment with the values at dotted paths replaced.

    Values may be traced. So a sweep is
    `jax.vmap(lambda w: f(override(env, {"reward.delta_v.scale": w})))(weights)`, and `jax.grad` of
    the same function is a gradient with respect to a parameter.

    Numbers that `env.tied` lists follow the changes. A tied number that is itself changed follows
    no longer, and a warning says so.

    Args:
        env: the environment.
        changes: new values by path. A path consists of field names and of the names of parts in a
            list. It may begin with the name of a platform. In the new value of a list of parts a
            name stands for the part that has it now: `{"observation": ["position", "velocity"]}`
            keeps these two in this order. New parts may stand beside names. A path that ends in
            `type` replaces a part by one of another type, which keeps the fields that both types
            have: `{"deputy.type": "two_body", "deputy.eccentricity": 0.1}`.
        place: what stands before the paths in error messages, such as `env` on a command line.

    Raises:
        ConfigError: a path leads nowhere, or a value has the wrong type, shape or range.
    """
    require_environment("override: env", env)
    for path in changes:
        if not isinstance(path, str):
            raise ConfigError(
                f"override: expected dotted paths such as 'deputy.mass', found {show(path)}"
            )
    changed = carry(env, set_paths(env, changes, place), changes)
    return check(changed, before=env)
