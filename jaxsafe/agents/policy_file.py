"""Policies as small .npz files.

A file holds arrays and one JSON string. It is read without pickle, so a stranger's file is only
data. The policies in `jaxsafe/pretrained/` come with the package. They are named after their tasks.
"""

from __future__ import annotations

import difflib
import io
import json
import os
from pathlib import Path
from typing import Any, NamedTuple, overload

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.agents.agent import Agent, check_agent
from jaxsafe.agents.callables import CONTROLLER, find_law
from jaxsafe.agents.networks import OUTPUT, Params
from jaxsafe.agents.trained_policy import (
    TrainedPolicy,
    TrainedRecurrentPolicy,
    trained_policy,
)
from jaxsafe.control.law import ControlLaw, LawPolicy
from jaxsafe.environment import Environment, require_environment
from jaxsafe.schema.component import choices, normalise
from jaxsafe.schema.convert import to_component, to_data
from jaxsafe.schema.errors import ConfigError, choices_text
from jaxsafe.schema.user_modules import imports_allowed
from jaxsafe.storage.archive import Archive, open_archive
from jaxsafe.storage.files import write_bytes
from jaxsafe.storage.forms import COUNT, TEXT, check

FORMAT = "jaxsafe policy 2"
"""The format of the file, as its header names it."""

OLD_FORMAT = "jaxsafe policy 1"
"""An older format. All networks are perceptrons of one size, and their layers have numbers."""


def save_policy(
    path: Path, env: Environment, agent: Agent, params: Params, about: dict[str, Any]
) -> None:
    """Write a policy file.

    The file holds the weights, the agent's structure, and the complete environment of the agent.

    Args:
        path: the file.
        env: the environment.
        agent: the agent.
        params: its parameters.
        about: further entries of the header, see `SavedPolicy.about`.
    """
    arrays = {
        jax.tree_util.keystr(key, simple=True, separator="/"): np.asarray(leaf)
        for key, leaf in jax.tree.leaves_with_path(params)
    }
    header = {
        "format": FORMAT,
        "agent": to_data(agent),
        "environment": to_data(env),
        **about,
    }
    buffer = io.BytesIO()
    np.savez(buffer, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())


_ABOUT = {"env": TEXT, "preset": TEXT, "seed": COUNT, "step": COUNT}
"""The form of the further entries that a header may have."""

PRETRAINED = "pretrained/"
"""Prefix of the name of a pretrained policy, in options that also take a run directory."""

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
        header = archive.header("a policy file", FORMAT, OLD_FORMAT, infinite=True)
    file_format = header.pop("format")
    from jaxsafe.config import build

    agent_data = header.pop("agent", None)
    if file_format == OLD_FORMAT:
        agent_data = with_networks(agent_data)
    with imports_allowed(False):
        env_data = header.pop("environment", None)
        env = build(to_component(env_data, Environment, f"{path}: environment"))
        agent = normalise(to_component(agent_data, Agent, f"{path}: agent"))
    check(
        header, {name: form for name, form in _ABOUT.items() if name in header}, f"{path}: header"
    )
    check_agent(agent, env, f"{path}: agent")
    like = jax.eval_shape(lambda key: agent.init(key, env), jax.random.key(0))
    with open_archive(path, "not a policy file, or a damaged one") as archive:
        params = _fill(like, archive, str(path), numbered=file_format == OLD_FORMAT)
    env = env.named(header.get("env", ""))
    return SavedPolicy(env=env, agent=agent, params=params, about=header)


def with_networks(agent: Any) -> Any:
    """Return the data of an agent with its networks as parts.

    The versions in which every network was a perceptron wrote the sizes of its layers only.
    """
    if not isinstance(agent, dict) or "hidden" not in agent:
        return agent
    rest = {name: value for name, value in agent.items() if name != "hidden"}
    return {"actor": {"type": "mlp", "hidden": agent["hidden"]}, **rest}


@overload
def load_policy(
    policy: str | os.PathLike, deterministic: bool = True, env: None = None
) -> TrainedPolicy | TrainedRecurrentPolicy: ...


@overload
def load_policy(
    policy: str | os.PathLike, deterministic: bool = True, *, env: Environment
) -> TrainedPolicy | TrainedRecurrentPolicy | LawPolicy: ...


def load_policy(
    policy: str | os.PathLike, deterministic: bool = True, env: Environment | None = None
) -> TrainedPolicy | TrainedRecurrentPolicy | LawPolicy:
    """Return `policy(key, observation) -> action`. Observations may have leading batch axes.

    A policy that remembers is a `RecurrentPolicy`, which `rollout` and `evaluate` take as well.

    Args:
        policy: the name of a task, for the policy that comes with the package, or a policy file
            such as `runs/docking3d/policy/seed_0.npz`, or `controller/NAME` for a classical
            controller.
        deterministic: whether to act by the mode of the distribution over actions. The key then
            means nothing.
        env: the environment that a classical controller shall fly. Other policies know their own.

    Raises:
        ConfigError: there is no such policy, or the file holds something else.
    """
    name = str(policy)
    if name.startswith(CONTROLLER):
        if env is None:
            raise ConfigError(f"env: missing; the environment in which {name} shall act")
        require_environment("load_policy: env", env)
        return find_law(name, env).policy(env)
    return trained_policy(*read_policy(find_policy(policy)), deterministic=deterministic)


def is_single(run: str) -> bool:
    """Return whether a command's `run` is one policy, in a file or of the package.

    Otherwise it is a directory with the policies of all seeds.
    """
    return run.endswith(".npz") or (run.startswith(PRETRAINED) and not Path(run).exists())


def meant_policy(run: str) -> str | None:
    """Return what a `run` with a misspelt prefix probably means, or None.

    So `controler/lqr` probably means `controller/lqr`.
    """
    head, slash, _ = run.partition("/")
    prefixes = [CONTROLLER.rstrip("/"), PRETRAINED.rstrip("/")]
    if not slash or not difflib.get_close_matches(head, prefixes, n=1, cutoff=0.75):
        return None
    names = [CONTROLLER + name for name in choices(ControlLaw)]
    names += [PRETRAINED + file.stem for file in _PRETRAINED.glob("*.npz")]
    return next(iter(difflib.get_close_matches(run, names, n=1)), None)


def find_policy(policy: str | os.PathLike) -> Path:
    """Return the file of a policy.

    Args:
        policy: a path, the name of a task, or `pretrained/` and the name of a task.

    Raises:
        ConfigError: there is no such policy.
    """
    path = Path(policy)
    if path.suffix == ".npz":
        return path
    if (path / "config.yaml").is_file():
        raise ConfigError(
            f"policy: {str(policy)!r} is a run; "
            f"jaxsafe.open_run({str(policy)!r}).policy() returns its policy"
        )
    pretrained = {file.stem: file for file in sorted(_PRETRAINED.glob("*.npz"))}
    if not pretrained:
        raise ConfigError(
            f"policy: no policies in {_PRETRAINED}; install the package unpacked, as pip does"
        )
    name = str(policy).removeprefix(PRETRAINED)
    if name not in pretrained:
        raise ConfigError(
            f"policy: {str(policy)!r} is no .npz file and not pretrained"
            f"{choices_text(name, pretrained)}"
        )
    return pretrained[name]


def _fill(like: Any, archive: Archive, path: str, numbered: bool) -> Any:
    """Return the parameters in an archive, in the structure and shapes of `like`.

    Args:
        like: parameters, or their shapes.
        archive: the archive.
        path: the file, for the message.
        numbered: whether the layers of the networks have numbers instead of names.

    Raises:
        ConfigError: an array is missing, has another shape, or does not hold floats.
    """

    def pick(key: Any, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        keys = [entry.key for entry in key]
        if numbered and len(keys) > 1:
            last = len(like[keys[0]]) - 1
            keys[1] = str(last) if keys[1] == OUTPUT else keys[1].removeprefix("hidden_")
        name = "/".join(keys)
        shape, dtype = archive.describe(name) if name in archive.names else (None, None)
        if dtype is None or shape != leaf.shape or dtype.kind != "f":
            found = "nothing" if dtype is None else f"{dtype} of shape {shape}"
            raise ConfigError(
                f"{path}: {name}: expected numbers of shape {leaf.shape}, found {found}"
            )
        return jnp.asarray(archive.read(name), leaf.dtype)

    return jax.tree_util.tree_map_with_path(pick, like)
