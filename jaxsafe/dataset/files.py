"""Datasets as files: an .npz with a header, or a dataset of Minari."""

from __future__ import annotations

import io
import json
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxsafe.dataset.collect import Dataset
from jaxsafe.environment import Environment
from jaxsafe.evaluate.episodes import max_steps
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.archive import open_archive
from jaxsafe.storage.files import write_bytes

FORMAT = "jaxsafe dataset 1"
"""What a header says of the form of the file."""


def facts(env: Environment, data: Dataset) -> dict[str, Any]:
    """Return what a header says of the data: names, counts, and averages over the episodes.

    Episodes that were given up are counted as `given_up`. They are part of the averages, as in an
    evaluation.
    """
    episodes = data.episodes()
    last = np.array([part.stop - 1 for part in episodes])
    lengths = np.array([part.stop - part.start for part in episodes])
    costs = [data.costs[part].sum(axis=0) for part in episodes]
    return {
        "observation_names": list(env.observation_names),
        "action_names": list(env.action_names),
        "constraints": [constraint.name for constraint in env.constraints],
        "steps": len(data.reward),
        "episodes": len(episodes),
        "given_up": int(np.sum(data.truncated[last] & (lengths == max_steps(env)))),
        "mean_return": float(np.mean([data.reward[part].sum() for part in episodes])),
        "mean_length": float(lengths.mean()),
        "mean_costs": np.mean(costs, axis=0).tolist(),
        "success_rate": float(data.success[last].mean()),
    }


def save_dataset(path: str | os.PathLike, data: Dataset, header: Mapping[str, Any]) -> None:
    """Write a dataset as an .npz file: an array for each field, and `header`, a JSON text.

    Args:
        path: the file.
        data: the steps.
        header: what the header says besides its format, such as what `facts` returns.
    """
    text = json.dumps({"format": FORMAT, **header}, allow_nan=False)
    buffer = io.BytesIO()
    arrays: dict[str, Any] = data._asdict()
    np.savez_compressed(buffer, header=np.array(text), **arrays)
    write_bytes(Path(path), buffer.getvalue())


def load_dataset(path: str | os.PathLike) -> tuple[Dataset, dict[str, Any]]:
    """Return a dataset and its header.

    Args:
        path: a file that `save_dataset` wrote.

    Raises:
        ConfigError: the file cannot be read, or is no dataset.
    """
    with open_archive(path, "not a dataset, or a damaged one") as archive:
        header = archive.header("a dataset", FORMAT)
        return Dataset(*(archive.read(name) for name in Dataset._fields)), header


def save_minari(
    name: str, env: Environment, data: Dataset, header: Mapping[str, Any], gymnasium_id: str | None
) -> None:
    """Write a dataset into Minari's directory of datasets.

    Each episode has `cost` (whether any constraint is violated), `costs` by constraint, and
    `success` among its infos.

    Args:
        name: its name, such as `jaxsafe/docking2d/expert-v0`.
        env: the environment.
        data: the steps.
        header: what the description says. Its `kind` is the name of the algorithm, and its
            `reference_returns` are the scores with which Minari normalises returns.
        gymnasium_id: the id of the environment, with which Minari can make it again.

    Raises:
        ConfigError: Minari is not installed, it has such a dataset, or the name is none for it.
    """
    require_minari(env)
    import minari
    from minari.data_collector import EpisodeBuffer

    from jaxsafe.adapters.gymnasium_spaces import spaces

    observation_space, action_space = spaces(env)
    buffers = []
    for number, part in enumerate(data.episodes()):
        costs = {
            constraint.name: _with_first(data.costs[part, index])
            for index, constraint in enumerate(env.constraints)
        }
        last = data.next_observation[part][-1:]
        episode: dict[str, Any] = {
            "observations": np.concatenate([data.observation[part], last]),
            "actions": data.action[part],
            "rewards": data.reward[part].tolist(),
            "terminations": data.terminated[part].tolist(),
            "truncations": data.truncated[part].tolist(),
            "infos": {
                "cost": _with_first(data.costs[part].max(axis=1, initial=0.0)),
                "costs": costs,
                "success": _with_first(data.success[part]),
            },
        }
        buffers.append(EpisodeBuffer(id=number, **episode))
    try:
        # Minari warns of each field of authors and links that is left out.
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            written = minari.create_dataset_from_buffers(
                dataset_id=name,
                buffer=buffers,
                env=gymnasium_id,
                observation_space=observation_space,
                action_space=action_space,
                algorithm_name=str(header["kind"]),
                description=json.dumps(dict(header)),
            )
    except (ValueError, FileExistsError) as error:
        raise ConfigError(f"out: {name}: {str(error).splitlines()[0]}") from None
    if reference := header["reference_returns"]:
        # As arguments they would be kept only together with the id of the environment.
        written.storage.update_metadata(
            {"ref_min_score": reference["random"], "ref_max_score": reference["expert"]}
        )


def require_minari(env: Environment) -> None:
    """Refuse a dataset that Minari cannot take, before its steps are collected.

    Raises:
        ConfigError: Minari is not installed, or actions mix numbers and choices.
    """
    try:
        import minari  # noqa: F401
    except ImportError:
        raise ConfigError("format: minari is not installed; pip install 'minari[hdf5]'") from None
    if env.action_kind == "mixed":
        raise ConfigError("format: minari takes continuous or discrete actions; use format=npz")


def _with_first(values: np.ndarray) -> np.ndarray:
    """Return values of steps with a zero for the reset, because Minari's infos begin there."""
    return np.concatenate([np.zeros_like(values[:1]), values])
