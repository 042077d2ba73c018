"""Policies that nobody trained: classical controllers by name, and functions of a user's module."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxsafe.agents.imported_policy import ForeignAgent, ForeignPolicy
from jaxsafe.control.law import ControlLaw
from jaxsafe.environment import Environment
from jaxsafe.envs.task import registered
from jaxsafe.rollout import Policy, RecurrentPolicy, require_policy
from jaxsafe.schema.component import choices
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.schema.user_modules import import_modules

CONTROLLER = "controller/"
"""Prefix of the name of a classical controller, in options that also take a run directory."""

_FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


class Chosen(NamedTuple):
    """Actions that stand in the place of a distribution over actions."""

    action: Array

    def mode(self) -> Array:
        """Return the actions."""
        return self.action


@jax.tree_util.register_static
class CallableAgent(ForeignAgent):
    """A stand-in for `Agent` around a policy that is a function."""

    def __init__(self, function: Policy | RecurrentPolicy) -> None:
        """Wrap `function(key, observations)`, or a `RecurrentPolicy`."""
        self.function = function

    def distribution(self, env: Environment, params: Any, inputs: Array) -> Chosen:
        """Return the actions for a batch of observations, with a fixed key."""
        if isinstance(self.function, RecurrentPolicy):
            raise ConfigError("run: the policy remembers; an exported function has no memory")
        return Chosen(jnp.asarray(self.function(jax.random.key(0), inputs)))

    def policy(
        self, env: Environment, params: Any, deterministic: Array | bool
    ) -> Policy | RecurrentPolicy:
        """Return the function."""
        return self.function


def is_callable(run: str) -> bool:
    """Return whether a `run` is a controller or a function of a module, and not a file."""
    named = run.startswith(CONTROLLER) or _FUNCTION.fullmatch(run)
    return bool(named) and not Path(run).exists()


def draws(run: str) -> bool:
    """Return whether a `run` is a function of a module, which may draw its actions at random."""
    return is_callable(run) and not run.startswith(CONTROLLER)


def read_callable(run: str, env: Environment) -> ForeignPolicy:
    """Return a classical controller, or a function of a module, to act in an environment.

    Args:
        run: `controller/NAME`, or `MODULE:NAME` for a `policy(key, observations)`, a
            `RecurrentPolicy` or a `ControlLaw` in a module, which is imported.
        env: where it will act.

    Raises:
        ConfigError: there is no such controller or function, or it does not fit the environment.
    """
    function = find_law(run, env) if run.startswith(CONTROLLER) else _from_module(run)
    if isinstance(function, ControlLaw):
        function = function.policy(env)
        # Tracing reports a missing observation before anything is compiled.
        observation = jax.ShapeDtypeStruct((env.observation_size,), env.dt.dtype)
        jax.eval_shape(function, jax.random.key(0), observation)
    # There is one leaf, because policies are mapped over the seed axis of their parameters.
    return ForeignPolicy(env, CallableAgent(function), {"none": jnp.zeros(())})


def find_law(run: str, env: Environment) -> ControlLaw:
    """Return the control law with a name. It has the numbers of the environment's task.

    Args:
        run: `controller/NAME` or the name alone.
        env: where it will act. If its task is not registered or has no controllers, all laws are
            known, with their defaults.

    Raises:
        ConfigError: there is no such controller.
    """
    name = run.removeprefix(CONTROLLER)
    task = registered(env.task)
    laws: dict[str, Callable[[], ControlLaw]] = dict(task.controllers if task else {})
    if not laws:
        laws.update(choices(ControlLaw))
    if name not in laws:
        whose = env.task or "this environment"
        raise ConfigError(
            f"controller: {whose} has no controller {show(name)}{choices_text(name, laws)}"
        )
    return laws[name]()


def _from_module(run: str) -> Any:
    """Return the function, `RecurrentPolicy` or `ControlLaw` that `MODULE:NAME` names."""
    module, _, name = run.partition(":")
    import_modules([module], "run")
    imported = importlib.import_module(module)
    policy: Any = getattr(imported, name, None)
    if policy is None:
        names = [
            known
            for known, value in vars(imported).items()
            if isinstance(value, RecurrentPolicy | ControlLaw)
            or (callable(value) and getattr(value, "__module__", None) == module)
        ]
        raise ConfigError(
            f"run: {module} has no policy called {show(name)}{choices_text(name, names)}"
        )
    if isinstance(policy, ControlLaw):
        return policy
    if not (callable(policy) or isinstance(policy, RecurrentPolicy)):
        raise ConfigError(
            f"run: {run}: expected a function policy(key, observation), found {show(policy)}"
        )
    function: Any = policy
    try:
        require_policy(function)
    except ConfigError as error:
        raise ConfigError(f"run: {run}: {error}") from None
    return policy
