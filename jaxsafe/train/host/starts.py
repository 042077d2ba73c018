"""Starts of a training from the boxes of a certificate in which a policy is not proved."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsafe.environment import Environment
from jaxsafe.schema.convert import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.starts_in_boxes import SometimesInBoxes
from jaxsafe.storage.archive import CERTIFICATE, open_archive


def with_unproved_starts(env: Environment, path: str) -> Environment:
    """Return the environment with every second start in a box that is refuted or open.

    Args:
        env: the environment.
        path: a certificate of `jaxsafe verify`.

    Raises:
        ConfigError: the file is no certificate, it has no such box, or its boxes are not of the
            agent's platform.
    """
    columns, low, high = _unproved(path)
    platform = env.agent_platform
    fields = dict.fromkeys(column.partition(".")[0] for column in columns)
    axes = "xyz"[: platform.dimension]
    drawn = platform.random_fields
    if not fields.keys() <= set(drawn) or columns != [
        f"{x}.{axis}" for x in fields for axis in axes
    ]:
        raise ConfigError(
            f"starts: {path} has boxes of {', '.join(columns)}; "
            f"the start of {env.agent!r} draws {', '.join(drawn)} in {len(axes)} axes"
        )
    boxes = SometimesInBoxes(
        name="boxes",
        low={column: low[:, i] for i, column in enumerate(columns)},
        high={column: high[:, i] for i, column in enumerate(columns)},
    )
    placed = platform.replace(start=(*platform.start, normalise(boxes)))
    platforms = tuple(placed if one.name == env.agent else one for one in env.platforms)
    return env.replace(platforms=platforms)


def _unproved(path: str) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return the columns and the corners of the boxes that a certificate does not prove."""
    with open_archive(path, "not a certificate, or a damaged one") as archive:
        columns = archive.header("a certificate", CERTIFICATE)["columns"]
        ends: list[Any] = []
        for end in ("low", "high"):
            parts = [archive.read(f"{kind}/{end}") for kind in ("refuted", "open")]
            ends.append(np.concatenate(parts).astype(np.float32))
    low, high = ends
    if not len(low):
        raise ConfigError(f"starts: {path} has no box that is open or refuted")
    return columns, low, high
