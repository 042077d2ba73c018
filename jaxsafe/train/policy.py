"""Policies as small .npz files: arrays and one JSON string, read without pickle, so a stranger's file is only data."""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.component import normalise
from jaxsafe.config.convert import to_component, to_data
from jaxsafe.environment import Environment
from jaxsafe.errors import ConfigError
from jaxsafe.rollout import Policy
from jaxsafe.train.agent import Agent, Params
from jaxsafe.train.files import write_bytes


def save_policy(path: Path, env: Environment, agent: Agent, params: Params, about: dict[str, Any]) -> None:
    """Write weights, the agent's structure and the complete environment they belong to."""
    arrays = {
        jax.tree_util.keystr(key, simple=True, separator="/"): np.asarray(leaf)
        for key, leaf in jax.tree.leaves_with_path(params)
    }
    header = {"format": "jaxsafe policy 1", "agent": to_data(agent), "environment": to_data(env), **about}
    buffer = io.BytesIO()
    np.savez(buffer, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())


def read_policy(path: str | os.PathLike) -> tuple[Environment, Agent, Params]:
    """Read a policy file: the environment, the agent and its parameters.

    Raises:
        ConfigError: the file cannot be read, or holds something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            arrays = {name: file[name] for name in file.files if name != "header"}
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or 'not a policy file'}") from None
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise ConfigError(f"{path}: not a policy file (.npz without pickles, as in <run>/policy/)") from None
    if not isinstance(header, dict) or header.get("format") != "jaxsafe policy 1":
        raise ConfigError(f"{path}: not a policy file: expected format 'jaxsafe policy 1'")
    from jaxsafe.config import build

    env = build(to_component(header.get("environment"), Environment, f"{path}: environment"))
    agent = normalise(to_component(header.get("agent"), Agent, f"{path}: agent"))
    like = jax.eval_shape(lambda key: agent.init(key, env), jax.random.key(0))
    return env, agent, _fill(like, arrays, str(path))


def load_policy(path: str | os.PathLike, deterministic: bool = True) -> Policy:
    """Return `policy(key, observation) -> action` from a policy file; observations may have leading batch axes.

    Raises:
        ConfigError: the file cannot be read, or holds something else.
    """
    env, agent, params = read_policy(path)
    return jax.jit(agent.policy(env, params, deterministic))  # or each call would work out the observation anew


def _fill(like: Any, arrays: dict[str, np.ndarray], path: str) -> Any:
    def pick(key: Any, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        name = jax.tree_util.keystr(key, simple=True, separator="/")
        found = arrays.get(name)
        if found is None or found.shape != leaf.shape or found.dtype.kind != "f":
            what = "nothing" if found is None else f"{found.dtype} of shape {found.shape}"
            raise ConfigError(f"{path}: {name}: expected numbers of shape {leaf.shape}, found {what}")
        return jnp.asarray(found, leaf.dtype)

    return jax.tree_util.tree_map_with_path(pick, like)
