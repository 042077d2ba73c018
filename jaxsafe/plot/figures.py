"""Figures of a run from its own log files.

They are training curves (Figs. 12-16), trajectories (Fig. 18), and speed and distance (Fig. 19).
What run time assurance altered is drawn by `jaxsafe.plot.interventions`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from jaxsafe.metrics import ENOUGH_SEEDS, bootstrap_interval
from jaxsafe.plot.style import BLUE, GREY, ORANGE, centre_patch, labelled, plain, region_patch

LAST_COLOUR = 0.85
"""Part of the colour map that is used. Its end is too light on white."""

CLOSE_UP = 3.0
"""Half the width of a close-up of the smallest region, in distances to the region's far end."""

CURVES = (
    ("success_rate", "success rate [%]", 100.0),
    ("return", "return", 1.0),
    ("length", "episode length [steps]", 1.0),
    ("delta_v", "Δv per episode [m/s]", 1.0),
    ("violating_share", "violating share\nof an episode's steps [%]", 100.0),
    ("episode_cost", "violating steps per episode", 1.0),
)
"""Column of the progress log, label, and factor of each curve."""

ALWAYS_SHOWN = ("success_rate", "return", "length")
"""Curves that are shown even where all values are 0."""

AXES = {"steps": ("step", "environment steps per seed"), "wall": ("wall_s", "wall time [s]")}
"""Column of the progress log and label of each horizontal axis."""

Rows = list[dict[str, Any]]
"""Rows of an episode in a log, one per step."""

Episodes = list[tuple[int, Rows]]
"""Logged episodes, each with the step of the training at which it was logged."""


def training_curves(rows: Sequence[Mapping[str, Any]], x: str, title: str) -> Figure:
    """Return a figure with a panel for each quantity.

    A panel shows a thin curve for every seed, their mean, and the mean's 95 % interval if there are
    enough seeds.

    Args:
        rows: rows of the progress log.
        x: what the horizontal axis shows, `steps` or `wall`.
        title: the title of the figure.
    """
    column, label = AXES[x]
    rows, left_out = without_diverged(rows)
    curves = shown_curves(rows)
    figure, panels = panel_grid(len(curves), 4.2)
    for panel, (name, quantity, factor) in zip(panels, curves, strict=False):
        at, values = curve_table(rows, column, name)
        _curve(panel, at, factor * values)
        set_axes(panel, label=label, quantity=quantity, name=name)
    if panels[0].get_legend_handles_labels()[0]:
        panels[0].legend(loc="best", fontsize="small", frameon=False)
    figure.suptitle(f"{plain(title)}\nthe last 100 training episodes{left_out}", fontsize="medium")
    return figure


def shown_curves(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, float]]:
    """Return the curves that rows of the progress log have values for."""
    return [
        curve
        for curve in CURVES
        if curve[0] in ALWAYS_SHOWN or any(row.get(curve[0]) for row in rows)
    ]


def without_diverged(rows: Sequence[Mapping[str, Any]]) -> tuple[Sequence[Mapping[str, Any]], str]:
    """Return the rows of the seeds that have not diverged and words that say which are left out.

    If every seed has diverged, all rows are returned. Their curves end where the seeds diverged.
    """
    diverged = {row["seed"] for row in rows if row.get("diverged")}
    sound = [row for row in rows if row["seed"] not in diverged]
    if not diverged or not sound:
        return rows, ""
    seeds = f"seed{'s' * (len(diverged) > 1)} {', '.join(map(str, sorted(diverged)))}"
    return sound, f", without {seeds}, which diverged"


def set_axes(panel: Axes, label: str, quantity: str, name: str) -> None:
    """Set the axes of a panel.

    A success rate is shown in its whole range, with the level of Table 2.

    Args:
        panel: the panel.
        label: the label of the horizontal axis.
        quantity: the label of the vertical axis.
        name: the column of the progress log.
    """
    panel.set(xlabel=label, ylabel=quantity)
    panel.ticklabel_format(axis="x", style="sci", scilimits=(-3, 4))
    if name == "success_rate":
        panel.set_ylim(-3, 103)
        panel.axhline(80.0, color="black", linestyle=":", linewidth=1.0)


def panel_grid(
    count: int, width: float, height: float = 3.1, in_row: int = 3
) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels.

    Args:
        count: number of panels.
        width: width of a panel in inches.
        height: height of a panel in inches.
        in_row: number of panels in a row.
    """
    rows = -(-count // in_row)
    columns = min(count, in_row)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for panel in panels[count:]:
        panel.remove()
    return figure, panels


def trajectories(
    episodes: Episodes,
    title: str,
    unit: str | None,
    regions: Sequence[Any] = (),
    forbidden: Collection[str] = (),
) -> Figure:
    """Return a figure of the agent's paths relative to the other platform.

    The first column shows the paths from one start in the course of training, the second column the
    last paths. A third column shows the last paths near the smallest region, if that is small
    beside the paths. There is a row for each plane.

    If the other platform has a heading, x is along it. Then the motion and the turn of that
    platform do not show, and a region that it carries is at rest.

    Args:
        episodes: logged episodes, in the order of training.
        title: the title of the figure.
        unit: the unit of lengths.
        regions: the regions of the environment.
        forbidden: the names of the regions to stay out of.
    """
    paths = [(step, _relative_path(rows, _agent(rows))) for step, rows in episodes]
    last = episodes[-1][1]
    first = next(iter(last[0]["platforms"]))
    start = paths[0][1][0]
    end = paths[-1][0]
    after = [path for step, path in paths if step == end]
    during = [(step, path) for step, path in paths if np.allclose(path[0], start)]
    logged = last[-1].get("regions", {})  # older logs have no regions
    regions = [region for region in regions if region.name in logged]
    places = [np.nan_to_num(_relative_path(last[-1:], region.name)[0]) for region in regions]
    sizes = [
        np.abs(place).max() + float(getattr(region, "radius", 0.0))
        for region, place in zip(regions, places, strict=True)
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
    planes = [(0, 1)] if len(start) == 2 else [(0, 1), (0, 2)]
    size = (3.7 * len(columns) + 1.2, 3.5 * len(planes) + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(planes), len(columns), squeeze=False)
    alone = len(last[0]["platforms"]) == 1
    turned = not alone and "heading" in last[0]["platforms"][first]
    along = f" along the heading of the {first}" if turned else ""
    for (i, j), row in zip(planes, panels, strict=True):
        for panel, (name, column), half in zip(row, columns, reach, strict=True):
            for region, place in zip(regions, places, strict=True):
                patch = panel.add_patch(region_patch(region, j == 2, region.name in forbidden))
                centre_patch(patch, place[[i, j]])
                patch.set_label(plain(region.name))
            if not alone:
                panel.plot(0, 0, "*", color=ORANGE, markersize=7, label=plain(first), zorder=1)
            for step, path in column:
                panel.plot(path[:, i], path[:, j], color=colour(step), linewidth=1.2)
                panel.plot(path[0, i], path[0, j], "o", color=colour(step), markersize=3)
            x_label = labelled(plain(f"x{along}"), unit)
            panel.set(xlabel=x_label, ylabel=labelled("xyz"[j], unit), aspect="equal")
            panel.set(xlim=(-half, half), ylim=(-half, half))
            panel.xaxis.set_major_locator(MaxNLocator(4))
            panel.yaxis.set_major_locator(MaxNLocator(4))
            if j == 1:
                panel.set_title(name, fontsize="medium")
    if panels[0, -1].get_legend_handles_labels()[0]:
        panels[0, -1].legend(loc="best", fontsize="small", frameon=False)
    _colour_bar(figure, colours, list(panels.ravel()))
    figure.suptitle(f"{plain(title)}\ndeterministic episodes of the first seed", fontsize="medium")
    return figure


def _farthest(paths: Sequence[np.ndarray]) -> float:
    """Return how far an axis must reach to show all paths, 0 if they rest at the origin."""
    return 1.1 * max(np.nanmax(np.abs(path)) for path in paths)


def speed_distance(episodes: Episodes, title: str) -> Figure:
    """Return a figure of speed against distance, with the speed limit at each distance.

    A speed below the dotted line is safe.

    Args:
        episodes: logged episodes, in the order of training.
        title: the title of the figure.
    """
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
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
    line = line[:, line[0] <= reach]  # the path of an early policy may lead far away
    line = line[:, np.argsort(line[0])]
    panel.plot(line[0], line[1], color="black", linestyle=":", linewidth=1.6, label="speed limit")
    panel.set(xlabel="distance to the chief [m]", ylabel="speed [m/s]")
    top = max(1.5 * np.nanmax(line[1], initial=0.2), 1.05 * fastest)
    panel.set(xlim=(0, reach), ylim=(0, top))
    panel.legend(loc="best", frameon=False)
    _colour_bar(figure, colours, panel)
    figure.suptitle(f"{plain(title)}\ndeterministic episodes of the first seed", fontsize="medium")
    return figure


def _curve(panel: Axes, at: np.ndarray, values: np.ndarray) -> None:
    known = ~np.isnan(values).any(axis=1)  # a mean over fewer seeds would be another curve
    at = at[known]
    values = values[known]
    if not len(at):
        panel.text(
            0.5,
            0.5,
            "no episode has ended yet",
            ha="center",
            va="center",
            transform=panel.transAxes,
        )
        return
    panel.plot(at, values, color=GREY, linewidth=0.6, alpha=0.6)
    panel.plot([], [], color=GREY, linewidth=0.6, label="each seed")
    panel.plot(at, values.mean(axis=1), color=BLUE, linewidth=1.8, label="mean")
    if values.shape[1] >= ENOUGH_SEEDS:
        low, high = bootstrap_interval(values)
        look = {"color": BLUE, "alpha": 0.25, "linewidth": 0}
        panel.fill_between(at, low, high, label="95 % interval", **look)
    panel.margins(x=0.0)


def curve_table(
    rows: Sequence[Mapping[str, Any]], column: str, name: str, most: int = 300
) -> tuple[np.ndarray, np.ndarray]:
    """Return a column of the progress log as a table over steps and seeds.

    Args:
        rows: rows of the progress log.
        column: the column of the horizontal axis.
        name: the column of the values.
        most: the largest number of points. More are thinned out.

    Returns:
        The values of `column`, shape (points,), and those of `name`, shape (points, seeds). A value
        that is missing is NaN.
    """
    steps = sorted({row["step"] for row in rows})
    kept = np.linspace(0, len(steps) - 1, min(most, len(steps))).astype(int)
    steps = sorted({steps[i] for i in kept})
    seeds = sorted({row["seed"] for row in rows})
    index = {step: i for i, step in enumerate(steps)}
    at = np.zeros(len(steps))
    values = np.full((len(steps), len(seeds)), np.nan)
    for row in rows:
        if row["step"] in index:
            point = index[row["step"]]
            at[point] = row[column]
            values[point, seeds.index(row["seed"])] = np.nan if row[name] is None else row[name]
    return at, values


def _agent(rows: list[dict[str, Any]]) -> str:
    """Return the name of the agent, which is the platform listed last."""
    return list(rows[0]["platforms"])[-1]


def _relative_path(rows: list[dict[str, Any]], of: str) -> np.ndarray:
    """Return the positions of a platform or region relative to the first platform, (steps, d).

    They are turned by the heading of the first platform if it has one. If there is only one
    platform they are not changed.
    """
    first = next(iter(rows[0]["platforms"]))
    places = [{**row.get("regions", {}), **row["platforms"]} for row in rows]
    path = np.array([place[of]["position"] for place in places], float)
    if len(rows[0]["platforms"]) == 1:
        return path
    origin = np.array([place[first]["position"] for place in places], float)
    path = path - origin  # a null, from a training that diverged, is NaN here and leaves a gap
    if "heading" in rows[0]["platforms"][first]:
        heading = np.array([row["platforms"][first]["heading"] for row in rows], float)
        cosine = np.cos(heading)
        sine = np.sin(heading)
        x = path[:, 0].copy()
        y = path[:, 1].copy()
        path[:, 0] = cosine * x + sine * y
        path[:, 1] = cosine * y - sine * x
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
    bar = figure.colorbar(colours, ax=panels, label="environment steps of training")
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda step, _: f"{step:,.0f}"))
