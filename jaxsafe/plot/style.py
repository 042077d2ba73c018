"""What all figures share: colours that are safe for colour-blind readers, and how a figure is saved."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from jaxsafe.environment import SUCCESS
from jaxsafe.processors.constraint import Separation, SpeedLimit
from jaxsafe.schema.dotted_paths import references
from jaxsafe.schema.errors import ConfigError, printable
from jaxsafe.storage.files import write_bytes
from jaxsafe.types import units

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

ZERO_WIDTH_SPACE = "\u200b"
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8A8A8A"  # Okabe-Ito, safe for colour-blind readers


def length_unit(env: Environment) -> str | None:
    """The unit of positions: m or ft; None if the platform does not say."""
    return units(type(env.agent_platform.rest())).get("position")


def control_unit(name: str, length: str | None) -> str | None:
    """The unit of a control by the words in its name, given that of lengths; None if it is not known."""
    known = {"thrust": "N", "rate": "rad/s", "attitude_acceleration": "rad/s²", "acceleration": f"{length}/s²"}
    return next((unit for word, unit in known.items() if word in name), None)


def margin_unit(constraint: Any, length: str | None) -> str | None:
    """The unit of a constraint's h, given that of positions; None if it is not known."""
    if length is None:
        return None
    known = {SpeedLimit: f"{length}/s", Separation: length}
    return next((unit for kind, unit in known.items() if isinstance(constraint, kind)), None)


def plain(text: object) -> str:
    """Return a text of the user as a figure shows it letter by letter, for titles and labels.

    Matplotlib reads `$…$` as a formula, and leaves out of legends what begins with `_`.
    """
    shown = printable(str(text)).replace("$", r"\$")
    return f"{ZERO_WIDTH_SPACE}{shown}" if shown.startswith("_") else shown


def labelled(quantity: str, unit: str | None) -> str:
    """The label of an axis."""
    return f"{quantity} [{unit}]" if unit else quantity


def kept_out(env: Environment) -> set[str]:
    """Return the names of the regions to stay out of: a constraint or a failure watches them, and no success does."""
    status = {part.name: part for part in env.status}

    def watched(parts: Iterable[Any]) -> set[str]:
        found = set()
        for part in parts:
            for _, refers, name in references(part, ""):
                if refers.section == "regions":
                    found.add(name)
                elif refers.section == "status":
                    found |= watched([status[name]])  # which refers to those before it only
        return found

    goals = [part for part in env.terminal if part.name == SUCCESS]
    failures = [part for part in env.terminal if part.name != SUCCESS]
    return watched([*env.constraints, *failures]) - watched(goals)


def region_patch(region: Any, from_the_side: bool, forbidden: bool = False) -> Any:
    """The area of a region around the origin, seen from above or from the side, where one with a height is a rectangle."""
    style = {"color": ORANGE if forbidden else GREEN, "alpha": 0.35, "linewidth": 0}
    if from_the_side and hasattr(region, "height"):
        size = (2.0 * float(region.radius), float(region.height))
        return Rectangle((-size[0] / 2.0, -size[1] / 2.0), *size, **style)
    return Circle((0.0, 0.0), float(getattr(region, "radius", 0.0)), **style)


def centre_patch(patch: Any, centre: np.ndarray) -> None:
    """Move what `region_patch` made; centre [2]."""
    if isinstance(patch, Circle):
        patch.set_center((float(centre[0]), float(centre[1])))
    else:
        patch.set_xy((float(centre[0]) - patch.get_width() / 2.0, float(centre[1]) - patch.get_height() / 2.0))


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as a file of the kind that its name says, PNG if none, and return its path.

    Raises:
        ConfigError: there is no such kind.
    """
    kind, known = path.suffix[1:] or "png", figure.canvas.get_supported_filetypes()
    if kind not in known:
        raise ConfigError(f"out: cannot draw {path.name}; choose from .{', .'.join(sorted(known))}")
    for panel in figure.axes:
        panel.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=150, format=kind)
    write_bytes(path, buffer.getvalue())
    return path
