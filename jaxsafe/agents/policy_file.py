"""Policies as small .npz files.

A file holds arrays and one JSON string. It is read without pickle, so a stranger's file is only
data. The policies in `jaxsafe/pretrained/` come with the package and have the names of their tasks.
"""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.agents.agent import Agent, Params
from jaxsafe.environment import Environment
from jaxsafe.rollout import Policy
from jaxsafe.schema.component import normalise
from jaxsafe.schema.convert import to_component, to_data
from jaxsafe.schema.errors import ConfigError, nearest
from jaxsafe.storage.archive import Archive, open_archive
from jaxsafe.storage.files import parse_json, write_bytes
from jaxsafe.storage.forms import COUNT, TEXT, check


def save_policy(
    path: Path, env: Environment, agent: Agent, params: Params, about: dict[str, Any]
) -> None:
    """Write a policy file.

    It holds the weights, the agent's structure, and the complete environment they belong to.

    Args:
        path: the file.
        env: the environment.
        agent: the agent.
        params: its parameters.
        about: what else the header says, see `SavedPolicy.about`.
    """
    arrays = {
        jax.tree_util.keystr(key, simple=True, separator="/"): np.asarray(leaf)
        for key, leaf in jax.tree.leaves_with_path(params)
    }
    header = {
        "format": "jaxsafe policy 1",
        "agent": to_data(agent),
        "environment": to_data(env),
        **about,
    }
    buffer = io.BytesIO()
    np.savez(buffer, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())


MAX_LAYERS = 64
"""Largest number of hidden layers in a policy file. Each layer takes a while to trace."""

_ABOUT = {"env": TEXT, "preset": TEXT, "seed": COUNT, "step": COUNT}
"""The form of what else a header may say."""

PRETRAINED = "pretrained/"
"""Prefix of the name of a pretrained policy, where the directory of a run may be given as well."""

_PRETRAINED = Path(__file__).resolve().parent.parent / "pretrained"


class SavedPolicy(NamedTuple):
    """The content of a policy file."""

    env: Environment
    agent: Agent
    params: Params
    about: dict[str, Any]
    """The training that the policy came from: `env` (its name), `preset`, `seed` and `step`."""


def read_policy(path: str | os.PathLike) -> SavedPolicy:
    """Read a policy file.

    Raises:
        ConfigError: the file cannot be read, or holds something else.
    """
    with open_archive(
        path, "not a policy file (.npz without pickles, as in <run>/policy/)"
    ) as archive:
        header = parse_json(str(archive.read("header")), infinite=True)
    if not isinstance(header, dict) or header.pop("format", None) != "jaxsafe policy 1":
        raise ConfigError(f"{path}: not a policy file: expected format 'jaxsafe policy 1'")
    from jaxsafe.config import build

    env = build(to_component(header.pop("environment", None), Environment, f"{path}: environment"))
    agent = normalise(to_component(header.pop("agent", None), Agent, f"{path}: agent"))
    check(
        header, {name: form for name, form in _ABOUT.items() if name in header}, f"{path}: header"
    )
    if len(agent.hidden) > MAX_LAYERS:
        raise ConfigError(
            f"{path}: agent.hidden: expected at most {MAX_LAYERS} layers, "
            f"found {len(agent.hidden):,}"
        )
    try:
        like = jax.eval_shape(lambda key: agent.init(key, env), jax.random.key(0))
    except ConfigError:
        raise
    except Exception as error:  # JAX raises many kinds of errors
        raise ConfigError(
            f"{path}: agent: does not fit the environment: {str(error).partition(chr(10))[0]}"
        ) from None
    with open_archive(path, "not a policy file, or a damaged one") as archive:
        return SavedPolicy(env, agent, _fill(like, archive, str(path)), header)


def load_policy(policy: str | os.PathLike, deterministic: bool = True) -> Policy:
    """Return `policy(key, observation) -> action`. Observations may have leading batch axes.

    Args:
        policy: the name of a task, for the policy that comes with the package, or a policy file
            such as `runs/docking3d/policy/seed_0.npz`.
        deterministic: whether to act by the mode of the distribution over actions. The key then
            means nothing.

    Raises:
        ConfigError: there is no such policy, or the file holds something else.
    """
    saved = read_policy(find_policy(policy))
    act = saved.agent.policy(saved.env, saved.params, deterministic)
    # It is compiled, or each call would work out the inputs of the networks anew.
    return jax.jit(act)


def is_single(run: str) -> bool:
    """Return whether a command's `run` is one policy, in a file or of the package.

    Otherwise it is a directory with the policies of all seeds.
    """
    return run.endswith(".npz") or (run.startswith(PRETRAINED) and not Path(run).exists())


def find_policy(policy: str | os.PathLike) -> Path:
    """Return the file of a policy.

    Args:
        policy: a path, the name of a task, or `pretrained/` and the name of a task.

    Raises:
        ConfigError: there is no such policy.
    """
    path, known = Path(policy), {file.stem: file for file in sorted(_PRETRAINED.glob("*.npz"))}
    if path.suffix == ".npz":
        return path
    if not known:
        raise ConfigError(
            f"policy: no policies in {_PRETRAINED}; install the package unpacked, as pip does"
        )
    name = str(policy).removeprefix(PRETRAINED)
    if name not in known:
        raise ConfigError(
            f"policy: {str(policy)!r} is no .npz file and not pretrained; "
            f"choose from {nearest(name, known)}"
        )
    return known[name]


def _fill(like: Any, archive: Archive, path: str) -> Any:
    """Return the parameters in an archive, in the structure and shapes of `like`.

    Raises:
        ConfigError: an array is missing, or is not one of numbers of the right shape.
    """

    def pick(key: Any, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        name = jax.tree_util.keystr(key, simple=True, separator="/")
        shape, dtype = archive.describe(name) if name in archive.names else (None, None)
        if dtype is None or shape != leaf.shape or dtype.kind != "f":
            what = "nothing" if dtype is None else f"{dtype} of shape {shape}"
            raise ConfigError(
                f"{path}: {name}: expected numbers of shape {leaf.shape}, found {what}"
            )
        return jnp.asarray(archive.read(name), leaf.dtype)

    return jax.tree_util.tree_map_with_path(pick, like)
