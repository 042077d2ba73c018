"""Figures of a run from its own log files: training curves (Figs. 12-16), trajectories (18), speed and distance (19).

Of a run with run time assurance also what it altered, see `interventions`.
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

LAST_COLOUR = 0.85  # the end of the colour map is too light on white
NEAR = 3.0  # half the width of what is shown near the smallest region, in distances to its far end
CURVES = (
    ("success_rate", "success rate [%]", 100.0),
    ("return", "return", 1.0),
    ("length", "episode length [steps]", 1.0),
    ("delta_v", "Δv per episode [m/s]", 1.0),
    ("violating_share", "violating share\nof an episode's steps [%]", 100.0),
    ("episode_cost", "violating steps per episode", 1.0),
)
ALWAYS = ("success_rate", "return", "length")
AXES = {"steps": ("step", "environment steps per seed"), "wall": ("wall_s", "wall time [s]")}

Rows = list[dict[str, Any]]
Episodes = list[tuple[int, Rows]]


def training_curves(rows: Sequence[Mapping[str, Any]], x: str, title: str) -> Figure:
    """A panel for each quantity: every seed thin, their mean, and its 95 % interval where there are enough of them."""
    column, label = AXES[x]
    rows, left_out = without_diverged(rows)
    curves = [curve for curve in CURVES if curve[0] in ALWAYS or any(row.get(curve[0]) for row in rows)]
    figure, panels = panel_grid(len(curves), 4.2)
    for panel, (name, quantity, factor) in zip(panels, curves, strict=False):
        at, values = curve_table(rows, column, name)
        _curve(panel, at, factor * values)
        set_axes(panel, label, quantity, name)
    if panels[0].get_legend_handles_labels()[0]:
        panels[0].legend(loc="best", fontsize="small", frameon=False)
    figure.suptitle(f"{plain(title)}\nthe last 100 training episodes{left_out}", fontsize="medium")
    return figure


def without_diverged(rows: Sequence[Mapping[str, Any]]) -> tuple[Sequence[Mapping[str, Any]], str]:
    """Return the rows of the seeds that have not diverged, and words that say which were left out.

    Where every seed has diverged all rows are returned: their curves end where they did.
    """
    diverged = {row["seed"] for row in rows if row.get("diverged")}
    sound = [row for row in rows if row["seed"] not in diverged]
    if not diverged or not sound:
        return rows, ""
    return sound, f", without seed{'s' * (len(diverged) > 1)} {', '.join(map(str, sorted(diverged)))}, which diverged"


def set_axes(panel: Axes, label: str, quantity: str, name: str) -> None:
    """The axes of a panel for a column of the progress log; a success rate has its whole range, and Table 2's level."""
    panel.set(xlabel=label, ylabel=quantity)
    panel.ticklabel_format(axis="x", style="sci", scilimits=(-3, 4))
    if name == "success_rate":
        panel.set_ylim(-3, 103)
        panel.axhline(80.0, color="black", linestyle=":", linewidth=1.0)


def panel_grid(count: int, width: float) -> tuple[Figure, np.ndarray]:
    """A figure with as many panels, three in a row."""
    rows, columns = -(-count // 3), min(count, 3)
    figure = Figure(figsize=(width * columns, 3.1 * rows), layout="constrained")
    panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for panel in panels[count:]:
        panel.remove()
    return figure, panels


def trajectories(
    episodes: Episodes, title: str, unit: str | None, regions: Sequence[Any] = (), forbidden: Collection[str] = ()
) -> Figure:
    """Paths of the agent relative to the other platform: from one start in the course of training, and the last ones.

    A row for each plane; in a third column the last paths near the smallest region, if it is small beside them. Where the
    other platform has a heading, x is along it: its own motion and turn do not show, and a region that it carries rests.
    """
    paths = [(step, _relative_path(rows, _agent(rows))) for step, rows in episodes]
    last = episodes[-1][1]
    first = next(iter(last[0]["platforms"]))
    start, end = paths[0][1][0], paths[-1][0]
    after = [path for step, path in paths if step == end]
    during = [(step, path) for step, path in paths if np.allclose(path[0], start)]
    regions = [region for region in regions if region.name in last[-1].get("regions", {})]  # older logs have none
    places = [np.nan_to_num(_relative_path(last[-1:], region.name)[0]) for region in regions]
    sizes = [np.abs(at).max() + float(getattr(one, "radius", 0.0)) for one, at in zip(regions, places, strict=True)]
    colours, colour = _colours(paths)
    groups = [
        ("one start, during training", during),
        ("after training" if last[0].get("final", True) else f"after {end:,} steps", [(end, path) for path in after]),
    ]
    reach = [
        max(1.6 * np.abs(start).max(), _farthest([during[-1][1]])) or 1.0,  # an early policy may go far away
        _farthest(after) or 1.0,
    ]
    if sizes and NEAR * min(sizes) < 0.5 * reach[1]:
        groups, reach = [*groups, ("their ends", groups[1][1])], [*reach, NEAR * min(sizes)]
    planes = [(0, 1)] if len(start) == 2 else [(0, 1), (0, 2)]
    figure = Figure(figsize=(3.7 * len(groups) + 1.2, 3.5 * len(planes) + 0.6), layout="constrained")
    panels = figure.subplots(len(planes), len(groups), squeeze=False)
    alone = len(last[0]["platforms"]) == 1
    along = f" along the heading of the {first}" if not alone and "heading" in last[0]["platforms"][first] else ""
    for (i, j), row in zip(planes, panels, strict=True):
        for panel, (name, group), half in zip(row, groups, reach, strict=True):
            for region, place in zip(regions, places, strict=True):
                patch = panel.add_patch(region_patch(region, j == 2, region.name in forbidden))
                centre_patch(patch, place[[i, j]])
                patch.set_label(plain(region.name))
            if not alone:
                panel.plot(0, 0, "*", color=ORANGE, markersize=7, label=plain(first), zorder=1)
            for step, path in group:
                panel.plot(path[:, i], path[:, j], color=colour(step), linewidth=1.2)
                panel.plot(path[0, i], path[0, j], "o", color=colour(step), markersize=3)
            panel.set(xlabel=labelled(plain(f"x{along}"), unit), ylabel=labelled("xyz"[j], unit), aspect="equal")
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
    """How far an axis must go to show all of them; 0 if they rest."""
    return 1.1 * max(np.nanmax(np.abs(path)) for path in paths)


def speed_distance(episodes: Episodes, title: str) -> Figure:
    """Speed against distance with the distance-dependent limit: safe is below the dotted line."""
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    panel = figure.subplots()
    colours, colour = _colours(episodes)
    limits, starts, fastest = [], [], 0.0
    for step, rows in episodes:
        status = [row["status"] for row in rows]
        distance, speed, limit = (
            np.array([one[k] for one in status], float) for k in ("docking_distance", "speed", "velocity_limit")
        )
        panel.plot(distance, speed, color=colour(step), linewidth=1.0)
        limits.append(np.stack([distance, limit]))
        starts.append(distance[0])
        if step == episodes[-1][0]:
            fastest = max(fastest, np.nanmax(speed))
    line = np.concatenate(limits, axis=1)
    reach = 1.2 * max(starts) or 1.0
    line = line[:, line[0] <= reach]  # an early policy may go far away
    line = line[:, np.argsort(line[0])]
    panel.plot(line[0], line[1], color="black", linestyle=":", linewidth=1.6, label="speed limit")
    panel.set(xlabel="distance to the chief [m]", ylabel="speed [m/s]")
    panel.set(xlim=(0, reach), ylim=(0, max(1.5 * np.nanmax(line[1], initial=0.2), 1.05 * fastest)))
    panel.legend(loc="best", frameon=False)
    _colour_bar(figure, colours, panel)
    figure.suptitle(f"{plain(title)}\ndeterministic episodes of the first seed", fontsize="medium")
    return figure


def _curve(panel: Axes, at: np.ndarray, values: np.ndarray) -> None:
    known = ~np.isnan(values).any(axis=1)  # a mean over fewer seeds would be another curve
    at, values = at[known], values[known]
    if not len(at):
        panel.text(0.5, 0.5, "no episode has ended yet", ha="center", va="center", transform=panel.transAxes)
        return
    panel.plot(at, values, color=GREY, linewidth=0.6, alpha=0.6)
    panel.plot([], [], color=GREY, linewidth=0.6, label="each seed")
    panel.plot(at, values.mean(axis=1), color=BLUE, linewidth=1.8, label="mean")
    if values.shape[1] >= ENOUGH_SEEDS:
        panel.fill_between(at, *bootstrap_interval(values), color=BLUE, alpha=0.25, linewidth=0, label="95 % interval")
    panel.margins(x=0.0)


def curve_table(
    rows: Sequence[Mapping[str, Any]], column: str, name: str, most: int = 300
) -> tuple[np.ndarray, np.ndarray]:
    """One column as (updates, seeds) at the values of the x column, thinned to at most `most` points."""
    steps = sorted({row["step"] for row in rows})
    steps = sorted({steps[i] for i in np.linspace(0, len(steps) - 1, min(most, len(steps))).astype(int)})
    seeds = sorted({row["seed"] for row in rows})
    index = {step: i for i, step in enumerate(steps)}
    at, values = np.zeros(len(steps)), np.full((len(steps), len(seeds)), np.nan)
    for row in rows:
        if row["step"] in index:
            at[index[row["step"]]] = row[column]
            values[index[row["step"]], seeds.index(row["seed"])] = np.nan if row[name] is None else row[name]
    return at, values


def _agent(rows: list[dict[str, Any]]) -> str:
    """The platform that was listed last."""
    return list(rows[0]["platforms"])[-1]


def _relative_path(rows: list[dict[str, Any]], of: str) -> np.ndarray:
    """Positions of a platform or region relative to the first platform, turned by its heading if it has one, (steps, d).

    As they are where there is one platform only.
    """
    first = next(iter(rows[0]["platforms"]))
    everything = [{**row.get("regions", {}), **row["platforms"]} for row in rows]
    if len(rows[0]["platforms"]) == 1:
        return np.array([one[of]["position"] for one in everything], float)
    path, origin = (np.array([one[name]["position"] for one in everything], float) for name in (of, first))
    path = path - origin  # a null, from a training that diverged, is nan here and leaves a gap
    if "heading" in rows[0]["platforms"][first]:
        heading = np.array([row["platforms"][first]["heading"] for row in rows], float)
        ahead, aside = np.cos(heading), np.sin(heading)
        x, y = path[:, 0].copy(), path[:, 1].copy()
        path[:, 0], path[:, 1] = ahead * x + aside * y, ahead * y - aside * x
    return path


def _colours(episodes: Sequence[tuple[int, Any]]) -> tuple[ScalarMappable, Any]:
    """The colour of each training step, from purple to green, mostly for the beginning, when most is learnt."""
    steps = [step for step, _ in episodes]
    shades = ListedColormap(colormaps["viridis"](np.linspace(0.0, LAST_COLOUR, 256)))
    scale = PowerNorm(0.4, 0, max(steps) or 1)
    return ScalarMappable(scale, shades), lambda step: shades(scale(step))


def _colour_bar(figure: Figure, colours: ScalarMappable, panels: Any) -> None:
    bar = figure.colorbar(colours, ax=panels, label="environment steps of training")
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda step, _: f"{step:,.0f}"))
