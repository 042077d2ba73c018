"""Figures of logged episodes: trajectories (Fig. 18), and speed against distance (Fig. 19).

`jaxsafe.plot.interventions` draws what run time assurance altered.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from jaxsafe.plot.curves import MILLIONS_FROM
from jaxsafe.plot.style import (
    FORBIDDEN,
    PATH_BEHIND,
    Ball,
    NotebookFigure,
    along,
    centre_patch,
    fitted,
    frame_labels,
    in_plane,
    plain,
    region_patch,
    region_surface,
    set_frame,
    styled,
    within,
)

LAST_COLOUR = 0.85
"""Part of the colour map that is used. Its end is too light on white."""

CLOSE_UP = 3.0
"""Half the width of a close-up, as a multiple of the distance to the far end of its region."""

PANEL_WIDTH = 3.2
"""Width of a panel of trajectories in inches, if the width of the figure is left open."""

COLOUR_BAR_WIDTH = 0.9
"""Width of the colour bar with its label in inches."""

SUBTITLE = "deterministic episodes of the first seed"

Rows = list[dict[str, Any]]
"""Rows of an episode in a log, one per step."""

Episodes = list[tuple[int, Rows]]
"""Logged episodes, each with the step of the training at which it was logged."""


@styled
def trajectories(
    episodes: Episodes,
    title: str,
    unit: str | None,
    regions: Sequence[Any] = (),
    forbidden: Collection[str] = (),
    keep_away: Sequence[float] = (),
    width: float | None = None,
) -> Figure:
    """Return a figure of the agent's paths relative to the other platform.

    The first column shows the paths from one start in the course of training, the second column the
    last paths. A third column shows the last paths near the smallest region, if that is small
    beside the paths. Paths in space are drawn in space, from above and from the side. Paths in the
    plane have a single row.

    If the other platform has a heading, x is along it. Then the turn of that platform does not
    show, and a region that it carries is at rest. A dashed line shows where that platform came
    from, as seen from its end.

    Args:
        episodes: logged episodes, in the order of training.
        title: the title of the figure.
        unit: the unit of lengths.
        regions: the regions of the environment.
        forbidden: the names of the regions to stay out of.
        keep_away: distances to the other platform that the agent must not go below.
        width: the width of the figure in inches.
    """
    paths = [(step, _relative_path(rows, _agent(rows))) for step, rows in episodes]
    last = episodes[-1][1]
    first = next(iter(last[0]["platforms"]))
    alone = len(last[0]["platforms"]) == 1
    start = paths[0][1][0]
    end = paths[-1][0]
    after = [path for step, path in paths if step == end]
    during = [(step, path) for step, path in paths if np.allclose(path[0], start)]
    logged = last[-1].get("regions", {})  # older logs have no regions
    regions = [region for region in regions if region.name in logged]
    origin = np.array([row["platforms"][first]["position"] for row in last], float)
    if not alone and np.ptp(origin, axis=0).any():
        # The map moves, so a region that stays in place has no fixed position on it.
        regions = [region for region in regions if region.on is not None]
    places = [np.nan_to_num(_relative_path(last[-1:], region.name)[0]) for region in regions]
    sizes = [
        np.abs(place).max() + float(region.radius)
        for region, place in zip(regions, places, strict=True)
        if getattr(region, "radius", 0.0) > 0.0  # a region without a radius has no close-up
    ]
    colours, colour = _colours(paths)
    when = "after training" if last[0].get("final", True) else f"after {end:,} steps"
    columns = [
        ("one start, during training", during),
        (when, [(end, path) for path in after]),
    ]
    reach = [
        # The path of an early policy may lead far away, so it does not count.
        max(1.6 * np.abs(start).max(), _farthest([during[-1][1]])) or 1.0,
        _farthest(after) or 1.0,
    ]
    if sizes and CLOSE_UP * min(sizes) < 0.5 * reach[1]:
        columns.append(("their ends", columns[1][1]))
        reach.append(CLOSE_UP * min(sizes))
    views: list[tuple[int, ...]] = [(0, 1)] if len(start) == 2 else [(0, 1, 2), (0, 1), (0, 2)]
    side = PANEL_WIDTH if width is None else (width - COLOUR_BAR_WIDTH) / len(columns)
    size = (side * len(columns) + COLOUR_BAR_WIDTH, side * len(views) + 0.5)
    figure = NotebookFigure(figsize=size, layout="constrained")
    grid = figure.add_gridspec(len(views), len(columns))
    turned = not alone and "heading" in last[0]["platforms"][first]
    labels = frame_labels(first if turned else None, unit)
    behind = origin - origin[-1]
    if turned:
        behind = along(behind, last[-1]["platforms"][first]["heading"])
    panels: list[Any] = []
    for number, ((name, column), half) in enumerate(zip(columns, reach, strict=True)):
        for row, view in enumerate(views):
            spatial = len(view) == 3
            panel: Any = figure.add_subplot(grid[row, number], projection="3d" if spatial else None)
            panels.append(panel)
            axes = list(view)
            for region, place in zip(regions, places, strict=True):
                kept_out = region.name in forbidden
                if spatial:
                    region_surface(panel, region, place, kept_out)
                    continue
                patch = panel.add_patch(region_patch(region, view == (0, 2), kept_out, turned))
                centre_patch(patch, place[axes])
                patch.set_label(plain(region.name))
            for radius in keep_away:
                if spatial:
                    region_surface(panel, Ball(radius), np.zeros(3), forbidden=True)
                else:
                    panel.add_patch(Circle((0.0, 0.0), radius, label="too near", **FORBIDDEN))
            if not alone:
                look = {"color": "black", "markersize": 7, "label": plain(first), "zorder": 1}
                panel.plot(*np.zeros((len(view), 1)), ">" if turned else "*", **look)
            if turned:
                shown = within(behind, half) if spatial else behind
                panel.plot(*shown[:, axes].T, label=f"path of the {plain(first)}", **PATH_BEHIND)
            for step, path in column:
                shown = within(path, half) if spatial else path
                panel.plot(*shown[:, axes].T, color=colour(step), linewidth=1.2)
                panel.plot(*shown[:1, axes].T, "o", color=colour(step), markersize=3)
            set_frame(panel, view, labels, half)
            if row == 0:
                panel.set_title(name)
    handles, names = panels[-1].get_legend_handles_labels()
    if handles:
        figure.legend(handles, names, loc="outside lower center", ncols=len(names))
    _colour_bar(figure, colours, panels)
    figure.suptitle(fitted(f"{plain(title)}\n{SUBTITLE}", figure))
    return figure


def _farthest(paths: Sequence[np.ndarray]) -> float:
    """Return how far an axis must reach to show all paths, 0 if they rest at the origin."""
    return 1.1 * max(np.nanmax(np.abs(path)) for path in paths)


@styled
def speed_distance(episodes: Episodes, title: str, width: float | None = None) -> Figure:
    """Return a figure of speed against distance, with the speed limit at each distance.

    A speed below the dotted line is safe.

    Args:
        episodes: logged episodes, in the order of training.
        title: the title of the figure.
        width: the width of the figure in inches.
    """
    width = width or 6.4
    figure = NotebookFigure(figsize=(width, 0.66 * width), layout="constrained")
    panel = figure.subplots()
    colours, colour = _colours(episodes)
    limits = []
    starts = []
    fastest = 0.0
    for step, rows in episodes:
        distance, speed, limit = (
            np.array([row["status"][name] for row in rows], float)
            for name in ("docking_distance", "speed", "velocity_limit")
        )
        panel.plot(distance, speed, color=colour(step), linewidth=1.0)
        limits.append(np.stack([distance, limit]))
        starts.append(distance[0])
        if step == episodes[-1][0]:
            fastest = max(fastest, np.nanmax(speed))
    line = np.concatenate(limits, axis=1)
    reach = 1.2 * max(starts) or 1.0
    line = line[:, line[0] <= reach]  # the path of an early policy may lead farther away
    line = line[:, np.argsort(line[0])]
    panel.plot(line[0], line[1], color="black", linestyle=":", linewidth=1.6, label="speed limit")
    panel.set(xlabel="distance to the chief [m]", ylabel="speed [m/s]")
    top = max(1.5 * np.nanmax(line[1], initial=0.2), 1.05 * fastest)
    panel.set(xlim=(0, reach), ylim=(0, top))
    panel.legend(loc="best")
    _colour_bar(figure, colours, panel)
    figure.suptitle(fitted(f"{plain(title)}\n{SUBTITLE}", figure))
    return figure


def _agent(rows: list[dict[str, Any]]) -> str:
    """Return the name of the agent, which is the platform listed last."""
    return list(rows[0]["platforms"])[-1]


def _relative_path(rows: list[dict[str, Any]], of: str) -> np.ndarray:
    """Return the positions of a platform or region relative to the first platform, (steps, d).

    If the first platform has a heading, x is along it. If there is only one platform, the positions
    are not changed.
    """
    first = next(iter(rows[0]["platforms"]))
    places = [{**row.get("regions", {}), **row["platforms"]} for row in rows]
    path = in_plane(np.array([place[of]["position"] for place in places], float))
    if len(rows[0]["platforms"]) == 1:
        return path
    origin = in_plane(np.array([place[first]["position"] for place in places], float))
    path = path - origin  # a null, from a training that diverged, is NaN here and leaves a gap
    if "heading" in rows[0]["platforms"][first]:
        heading = np.array([row["platforms"][first]["heading"] for row in rows], float)
        path = along(path, heading)
    return path


def _colours(episodes: Sequence[tuple[int, Any]]) -> tuple[ScalarMappable, Any]:
    """Return a colour bar's scale and a function from a training step to its colour.

    Colours go from purple to green. Most of them are for the beginning, when most is learnt.
    """
    steps = [step for step, _ in episodes]
    shades = ListedColormap(colormaps["viridis"](np.linspace(0.0, LAST_COLOUR, 256)))
    scale = PowerNorm(0.4, 0, max(steps) or 1)
    return ScalarMappable(scale, shades), lambda step: shades(scale(step))


def _colour_bar(figure: Figure, colours: ScalarMappable, panels: Any) -> None:
    last: Any = colours.norm.vmax
    unit, name = (1e6, "M") if last >= MILLIONS_FROM else (1e3, "k")
    label = f"environment steps of training [{name}]"
    bar = figure.colorbar(colours, ax=panels, label=label, aspect=40, pad=0.02)
    bar.ax.yaxis.set_major_formatter(lambda step, _: f"{step / unit:g}")
