"""Colours, labels, units and patches that all figures share, and how a figure is saved."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from jaxsafe.environment import SUCCESS
from jaxsafe.environment import control_unit as control_unit
from jaxsafe.environment import length_unit as length_unit
from jaxsafe.processors.constraint import Separation, SpeedLimit
from jaxsafe.schema.dotted_paths import references
from jaxsafe.schema.errors import ConfigError, printable
from jaxsafe.storage.files import write_bytes

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

ZERO_WIDTH_SPACE = "\u200b"

# Colours of Okabe and Ito, which colour-blind readers can tell apart.
BLUE = "#0072B2"
ORANGE = "#D55E00"
GREEN = "#009E73"
GREY = "#8A8A8A"


def margin_unit(constraint: Any, length: str | None) -> str | None:
    """Return the unit of a constraint's h, or None if it is not known.

    Args:
        constraint: the constraint.
        length: the unit of positions.
    """
    if length is None:
        return None
    units_by_class = {SpeedLimit: f"{length}/s", Separation: length}
    return next((unit for cls, unit in units_by_class.items() if isinstance(constraint, cls)), None)


def plain(text: object) -> str:
    """Return a user's text so that a title or label shows it letter by letter.

    Matplotlib reads `$…$` as a formula, and legends leave out names that begin with `_`.
    """
    shown = printable(str(text)).replace("$", r"\$")
    return f"{ZERO_WIDTH_SPACE}{shown}" if shown.startswith("_") else shown


def labelled(quantity: str, unit: str | None) -> str:
    """Return the label of an axis."""
    return f"{quantity} [{unit}]" if unit else quantity


def kept_out(env: Environment) -> set[str]:
    """Return the names of the regions that the agent must stay out of.

    A constraint or a failure watches such a region, and no success does.
    """
    status = {part.name: part for part in env.status}

    def watched(parts: Iterable[Any]) -> set[str]:
        regions = set()
        for part in parts:
            for _, refers, name in references(part, ""):
                if refers.section == "regions":
                    regions.add(name)
                elif refers.section == "status":
                    # This ends, because a status refers only to earlier ones.
                    regions |= watched([status[name]])
        return regions

    goals = [part for part in env.terminal if part.name == SUCCESS]
    failures = [part for part in env.terminal if part.name != SUCCESS]
    return watched([*env.constraints, *failures]) - watched(goals)


def region_patch(region: Any, from_the_side: bool, forbidden: bool = False) -> Any:
    """Return a patch of a region around the origin, seen from above or from the side.

    Seen from the side, a region with a height is a rectangle.
    """
    style = {"color": ORANGE if forbidden else GREEN, "alpha": 0.35, "linewidth": 0}
    if from_the_side and hasattr(region, "height"):
        width = 2.0 * float(region.radius)
        height = float(region.height)
        return Rectangle((-width / 2.0, -height / 2.0), width, height, **style)
    return Circle((0.0, 0.0), float(getattr(region, "radius", 0.0)), **style)


def centre_patch(patch: Any, centre: np.ndarray) -> None:
    """Move a patch of `region_patch` to a centre, shape (2,)."""
    x = float(centre[0])
    y = float(centre[1])
    if isinstance(patch, Circle):
        patch.set_center((x, y))
    else:
        patch.set_xy((x - patch.get_width() / 2.0, y - patch.get_height() / 2.0))


def save(figure: Figure, path: Path) -> Path:
    """Write a figure to a file and return the path.

    The ending of the path says the format. It is PNG without an ending.

    Raises:
        ConfigError: the format is not known.
    """
    file_format = path.suffix[1:] or "png"
    known_formats = figure.canvas.get_supported_filetypes()
    if file_format not in known_formats:
        choices = ", .".join(sorted(known_formats))
        raise ConfigError(f"out: cannot draw {path.name}; choose from .{choices}")
    write_bytes(path, to_bytes(figure, file_format))
    return path


def to_bytes(figure: Figure, file_format: str = "png") -> bytes:
    """Return the content of a file of a figure."""
    for panel in figure.axes:
        panel.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=150, format=file_format)
    return buffer.getvalue()
