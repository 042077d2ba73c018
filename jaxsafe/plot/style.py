"""Colours, labels, units and patches that all figures share, and how a figure is saved."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.ticker import FixedLocator, MaxNLocator

from jaxsafe.environment import Environment
from jaxsafe.processors.constraint import ConeConstraint, KeepIn, KeepOut, Separation, SpeedLimit
from jaxsafe.processors.status import Distance
from jaxsafe.schema.dotted_paths import references
from jaxsafe.schema.errors import ConfigError, printable
from jaxsafe.simulation.regions import Box, Cone, HalfSpace
from jaxsafe.storage.files import write_bytes

FAR = 1e6
"""How far a region without an end is drawn, in the unit of lengths. No map shows as much."""

ZERO_WIDTH_SPACE = "\u200b"

# Colours of Okabe and Ito, which colour-blind readers can tell apart.
BLUE = "#0072B2"
ORANGE = "#D55E00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
AMBER = "#E69F00"
SKY = "#56B4E9"
GREY = "#8A8A8A"

styled = rc_context(
    {
        "font.size": 9.0,
        "axes.titlesize": 9.0,
        "axes.labelsize": 9.0,
        "xtick.labelsize": 8.0,
        "ytick.labelsize": 8.0,
        "legend.fontsize": 8.0,
        "figure.titlesize": 10.0,
        "axes.linewidth": 0.8,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "hatch.linewidth": 0.8,
        # Letters stay letters, which journals ask for.
        "pdf.fonttype": 42,
    }
)
"""Decorator of the functions that draw a figure. It gives all figures the same look."""

GOAL: dict[str, Any] = {"facecolor": f"{GREEN}59", "edgecolor": GREEN, "linewidth": 0.8}
"""Look of a region to reach."""

FORBIDDEN: dict[str, Any] = {
    "facecolor": f"{ORANGE}33",
    "edgecolor": ORANGE,
    "linewidth": 0.8,
    "hatch": "////",
}
"""Look of a region to stay out of. The hatch tells it from a goal without its colour."""

PATH_BEHIND: dict[str, Any] = {
    "color": "black",
    "linewidth": 1.0,
    "linestyle": (0, (4, 3)),
    "alpha": 0.6,
    "zorder": 1,
}
"""Look of the path of a platform that all is seen from. It is where that platform came from."""

NICE = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0)
"""Round numbers from 1 to 10. Others are a power of ten times one of these."""

ZOOM = 0.78
"""Size of a view in space. Larger ones have no room for their labels."""

SPACE_LABEL_PAD = 8.0
"""Distance of a label from its axis in space, in points. Numbers of five digits fit into it."""

CHARACTERS_PER_INCH = 13
"""Number of characters of a title that fit into an inch."""


def margin_unit(constraint: Any, length: str | None) -> str | None:
    """Return the unit of a constraint's h, or None if it is not known.

    Args:
        constraint: the constraint.
        length: the unit of positions.
    """
    if length is None:
        return None
    units_by_class = {
        SpeedLimit: f"{length}/s",
        Separation: length,
        KeepOut: length,
        ConeConstraint: "rad",
    }
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


def fitted(title: str, figure: Figure) -> str:
    """Return a title in lines that are no longer than the figure is wide."""
    room = int(CHARACTERS_PER_INCH * figure.get_figwidth())
    return "\n".join(part for line in title.split("\n") for part in textwrap.wrap(line, room))


def kept_out(env: Environment) -> set[str]:
    """Return the names of the regions that the agent must stay out of.

    A constraint or a failure watches such a region, and no success or constraint to stay in does.
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

    goals = [part for part in env.terminal if part.name in env.successes]
    failures = [part for part in env.terminal if part.name not in env.successes]
    allowed = [part for part in env.constraints if isinstance(part, KeepIn)]
    forbidding = [part for part in env.constraints if not isinstance(part, KeepIn)]
    return watched([*forbidding, *failures]) - watched([*goals, *allowed])


class Outline(Polygon):
    """The outline of a region around its centre."""

    def __init__(self, corners: np.ndarray, **style: Any) -> None:
        super().__init__(corners, closed=True, **style)
        self._corners = corners

    def move(self, centre: np.ndarray) -> None:
        """Put the centre to a place, shape (2,)."""
        self.set_xy(self._corners + centre)


def region_patch(
    region: Any, from_the_side: bool, forbidden: bool = False, turned: bool = False
) -> Any:
    """Return a patch of a region around the origin, seen from above or from the side.

    Seen from the side, a region with a height is a rectangle. A region to stay out of is hatched.
    If the axes of a box are those of the map, its outline is drawn. The same holds for a cone and a
    half-space in the plane. Otherwise only their centre is drawn.

    Args:
        region: the region.
        from_the_side: whether the map shows x and z, else x and y.
        forbidden: whether it is a region to stay out of.
        turned: whether the map turns with a platform.
    """
    style = FORBIDDEN if forbidden else GOAL
    if isinstance(region, Box | Cone | HalfSpace):
        aligned = not turned and not region.turns
        corners = _corners(region, [0, 2 if from_the_side else 1]) if aligned else None
        return Outline(np.zeros((1, 2)) if corners is None else corners, **style)
    if from_the_side and hasattr(region, "height"):
        width = 2.0 * float(region.radius)
        height = float(region.height)
        return Rectangle((-width / 2.0, -height / 2.0), width, height, **style)
    return Circle((0.0, 0.0), float(getattr(region, "radius", 0.0)), **style)


def _corners(region: Box | Cone | HalfSpace, axes: list[int]) -> np.ndarray | None:
    """Return the corners of a region in the plane of two axes, or None where it has none there."""
    if isinstance(region, Box):
        size = np.asarray(region.size, float)
        if len(size) < 2:
            return None
        return np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size[axes]
    if len(region.towards) != 2:
        return None
    ahead = np.asarray(region.towards, float)
    ahead /= np.linalg.norm(ahead)
    left = np.array([-ahead[1], ahead[0]])
    if isinstance(region, HalfSpace):
        return FAR * np.array([left, left + ahead, ahead - left, -left])
    length = FAR if region.length is None else float(region.length)
    aside = np.tan(float(region.half_angle)) * left
    return length * np.array([0.0 * ahead, ahead + aside, ahead - aside])


class Ball(NamedTuple):
    """A region that `region_surface` draws as a ball."""

    radius: float


def region_surface(panel: Any, region: Any, centre: np.ndarray, forbidden: bool = False) -> Any:
    """Draw and return the surface of a region in space: a ball, an upright cylinder or a box.

    Only the centre of any other region, and of a box that turns, is drawn.

    Args:
        panel: axes in space.
        region: the region.
        centre: its centre, shape (3,).
        forbidden: whether it is a region to stay out of.
    """
    radius = float(getattr(region, "radius", 0.0))
    turn, rise = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 25), np.linspace(-0.5, 0.5, 13))
    if hasattr(region, "height"):
        across = radius
        up = float(region.height) * rise
    else:
        across = radius * np.cos(np.pi * rise)
        up = radius * np.sin(np.pi * rise)
    surface = [across * np.cos(turn), across * np.sin(turn), up * np.ones_like(turn)]
    if isinstance(region, Box) and not region.turns:
        # A box is a ball that is blown up until it touches the sides of a cube.
        ball = [np.cos(np.pi * rise) * np.cos(turn), np.cos(np.pi * rise) * np.sin(turn)]
        ball = np.stack([*ball, np.sin(np.pi * rise)])
        surface = ball / np.abs(ball).max(axis=0) * np.reshape(region.size, (3, 1, 1)) / 2.0
    look = FORBIDDEN if forbidden else GOAL
    return panel.plot_surface(
        *(part + offset for part, offset in zip(surface, centre, strict=True)),
        color=look["facecolor"],
        edgecolor=look["edgecolor"] if forbidden else "none",  # a net in place of the hatch
        linewidth=0.4,
    )


def keep_away_distances(env: Environment) -> list[float]:
    """Return the distances to the other platforms that the agent must not go below."""
    own_distances = {
        status.name
        for status in env.status
        if isinstance(status, Distance) and env.agent in (status.of, status.to)
    }
    return [
        float(constraint.minimum)
        for constraint in env.constraints
        if isinstance(constraint, Separation) and constraint.distance in own_distances
    ]


def in_plane(vectors: np.ndarray) -> np.ndarray:
    """Return vectors on a line as vectors in the plane with y = 0, and all others as they are."""
    missing = max(0, 2 - vectors.shape[-1])
    return np.pad(vectors, [(0, 0)] * (vectors.ndim - 1) + [(0, missing)])


def along(vectors: np.ndarray, heading: np.ndarray | float) -> np.ndarray:
    """Return vectors in axes whose x is along a heading and whose z stays, shape (..., d).

    Args:
        vectors: the vectors in the axes of the world, shape (..., d) with d of at least 2.
        heading: the heading in rad, a number or one for each vector.
    """
    cosine = np.cos(heading)
    sine = np.sin(heading)
    turned = vectors.copy()
    turned[..., 0] = cosine * vectors[..., 0] + sine * vectors[..., 1]
    turned[..., 1] = cosine * vectors[..., 1] - sine * vectors[..., 0]
    return turned


def within(path: np.ndarray, half: float) -> np.ndarray:
    """Return a path with a gap where it leaves the box, because axes in space do not clip.

    Args:
        path: the path, shape (points, 3).
        half: half the width of the box.
    """
    return np.where((np.abs(path) <= half).all(axis=1, keepdims=True), path, np.nan)


def frame_labels(heads: str | None, unit: str | None) -> list[str]:
    """Return the labels of the axes x, y and z.

    Args:
        heads: the platform along whose heading x is, or None.
        unit: the unit of lengths.
    """
    if heads is None:
        return [labelled(name, unit) for name in "xyz"]
    sides = ("ahead of", "left of", "above")
    return [labelled(plain(f"{side} the {heads}"), unit) for side in sides]


def set_frame(
    panel: Any,
    view: Sequence[int],
    labels: Sequence[str],
    half: float,
    centre: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
) -> None:
    """Set labels, limits, numbers and proportions of axes that show positions.

    Args:
        panel: axes in the plane or in space.
        view: the coordinates that are shown.
        labels: the labels of `frame_labels`.
        half: half the width of what is shown.
        centre: the middle of what is shown.
    """
    spatial = len(view) == 3
    for coordinate, letter in zip(view, "xyz", strict=False):
        axis = getattr(panel, f"{letter}axis")
        axis.set_label_text(labels[coordinate])
        middle = float(centre[coordinate])
        getattr(panel, f"set_{letter}lim")(middle - half, middle + half)
        axis.set_major_locator(MaxNLocator(4))
        if spatial:
            # Numbers near the ends of axes in space would meet at the corners.
            space = nice(0.8 * half, up=False)
            first = np.ceil((middle - 0.8 * half) / space - 1e-6)
            last = np.floor((middle + 0.8 * half) / space + 1e-6)
            axis.set_major_locator(FixedLocator(space * np.arange(first, last + 1)))
            axis.labelpad = SPACE_LABEL_PAD
    if spatial:
        panel.set_box_aspect((1.0, 1.0, 1.0), zoom=ZOOM)
    else:
        panel.set_aspect("equal")


def nice(value: float, up: bool = True) -> float:
    """Return the nearest round number that is at least `value`, or at most `value`."""
    power = 10.0 ** np.floor(np.log10(value))
    if up:
        return next(float(size * power) for size in NICE if size * power >= value * (1 - 1e-9))
    return max(float(size * power) for size in NICE if size * power <= value * (1 + 1e-9))


def centre_patch(patch: Any, centre: np.ndarray) -> None:
    """Move a patch of `region_patch` to a centre, shape (2,)."""
    x = float(centre[0])
    y = float(centre[1])
    if isinstance(patch, Circle):
        patch.set_center((x, y))
    elif isinstance(patch, Outline):
        patch.move(np.array([x, y]))
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


class NotebookFigure(Figure):
    """A figure that a notebook shows, also where pyplot is not in use."""

    def _repr_png_(self) -> bytes:
        return to_bytes(self)


@styled
def to_bytes(figure: Figure, file_format: str = "png") -> bytes:
    """Return the content of a file of a figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=150, format=file_format)
    return buffer.getvalue()
