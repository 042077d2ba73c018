"""Starts of a training from the boxes of a certificate in which a policy is not proved."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsafe.environment import Environment
from jaxsafe.schema.convert import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.starts_in_boxes import SometimesInBoxes
from jaxsafe.storage.archive import open_archive

FIELDS = ("position", "velocity")
"""The fields of the agent's platform that a box of a certificate has, one after the other."""


def with_unproved_starts(env: Environment, path: str) -> Environment:
    """Return the environment with every second start in a box that is refuted or open.

    Args:
        env: the environment.
        path: a certificate of `jaxsafe verify`.

    Raises:
        ConfigError: the file is no certificate, it has no such box, or its boxes are not of the
            agent's platform.
    """
    low, high = _unproved(path)
    platform = env.agent_platform
    axes = "xyz"[: platform.dimension]
    columns = [f"{field}.{axis}" for field in FIELDS for axis in axes]
    drawn = platform.random_fields
    if low.shape[1] != len(columns) or not set(FIELDS) <= set(drawn):
        raise ConfigError(
            f"starts: {path} has boxes of {low.shape[1]} numbers; expected position and velocity "
            f"of {env.agent!r}, {len(columns)} numbers that its start draws"
        )
    boxes = SometimesInBoxes(
        name="boxes",
        low={column: low[:, i] for i, column in enumerate(columns)},
        high={column: high[:, i] for i, column in enumerate(columns)},
    )
    placed = platform.replace(start=(*platform.start, normalise(boxes)))
    platforms = tuple(placed if one.name == env.agent else one for one in env.platforms)
    return env.replace(platforms=platforms)


def _unproved(path: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the boxes that a certificate does not prove."""
    with open_archive(path, "no certificate, or a damaged one") as archive:
        ends: list[Any] = []
        for end in ("low", "high"):
            parts = [archive.read(f"{kind}/{end}") for kind in ("refuted", "open")]
            ends.append(np.concatenate(parts).astype(np.float32))
    low, high = ends
    if not len(low):
        raise ConfigError(f"starts: {path} has no box that is open or refuted")
    return low, high
