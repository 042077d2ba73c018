"""Training curves of several runs of one task in one figure, Figs. 12-16."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import cycle, product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxsafe.metrics import ENOUGH_EPISODES, ENOUGH_SEEDS, bootstrap_interval
from jaxsafe.plot.figures import (
    ALWAYS,
    AXES,
    CURVES,
    curve_table,
    panel_grid,
    set_axes,
    without_diverged,
)
from jaxsafe.plot.style import BLUE, GREEN, GREY, ORANGE, plain

LOOKS = tuple(product(("-", "--"), (BLUE, ORANGE, GREEN, "#CC79A7", GREY, "#E69F00", "#56B4E9")))
"""Line style and colour of each run in turn."""

FAR = 8.0
"""Between lengths of runs that one linear axis cannot show together."""

LEGEND = 9
"""Names in a row of the legend, at most."""

NAMED = 5
"""Seeds in the title of a panel, at most."""


def compare_curves(
    runs: Mapping[str, Sequence[Mapping[str, Any]]], title: str, x: str = "steps", mark: tuple[str, float] | None = None
) -> Figure:
    """A panel for each quantity, in it the mean over seeds of each run, and its 95 % interval where there are enough.

    A curve begins when every seed has finished as many episodes as Table 2 needs, or all that it ever finished. The
    horizontal axis is logarithmic where the longest run is more than `FAR` times as long as the shortest.

    Args:
        runs: rows of the progress log by the run's label.
        title: of the figure.
        x: `steps` or `wall`.
        mark: a name and the place on the horizontal axis of the first panel where it stands.
    """
    sound = {run: without_diverged(rows) for run, rows in runs.items()}
    runs = {f"{run}{left_out}": rows for run, (rows, left_out) in sound.items()}
    every = [row for rows in runs.values() for row in rows]
    curves = [curve for curve in CURVES if curve[0] in ALWAYS or any(row.get(curve[0]) for row in every)]
    figure, panels = panel_grid(len(curves), 3.6)
    column, label = AXES[x]
    ends = [max(row[column] for row in rows) for rows in runs.values()] + ([mark[1]] if mark else [])
    logarithmic = max(ends) > FAR * min(ends)
    counts = {run: curve_table(rows, column, "episodes")[1] for run, rows in runs.items()}
    enough = {run: (count >= np.minimum(ENOUGH_EPISODES, count[-1])).all(axis=1) for run, count in counts.items()}
    intervals = ""
    for panel, (name, quantity, factor) in zip(panels, curves, strict=False):
        for (line, colour), (run, rows) in zip(cycle(LOOKS), runs.items(), strict=False):
            at, values = curve_table(rows, column, name)
            known = enough[run] & ~np.isnan(values).any(axis=1)
            at, values = at[known], factor * values[known]
            panel.plot(at, values.mean(axis=1), color=colour, linestyle=line, linewidth=1.6, label=plain(run))
            if values.shape[1] >= ENOUGH_SEEDS and len(at):
                intervals = " and 95 % interval"
                panel.fill_between(at, *bootstrap_interval(values), color=colour, alpha=0.2, linewidth=0)
        set_axes(panel, label, quantity, name)
        if logarithmic:
            panel.set_xscale("log")
        panel.margins(x=0.0)
    if mark:
        panels[0].plot(mark[1], 80.0, "k*", markersize=9, label=plain(mark[0]), clip_on=False, zorder=4)
    shown, names = panels[0].get_legend_handles_labels()
    columns = min(len(names), LEGEND)
    figure.legend(shown, names, loc="outside lower center", ncols=columns, columnspacing=1.2, frameon=False)
    figure.suptitle(f"{plain(title)}: the last 100 training episodes, mean{intervals} over seeds", fontsize="medium")
    return figure


def seed_curves(
    runs: Mapping[str, Sequence[Mapping[str, Any]]], title: str, failed: Mapping[str, Collection[int]]
) -> Figure:
    """A panel for each run, in it the success rate in training of every seed, dashed if it failed.

    Args:
        runs: rows of the progress log by the run's label.
        title: of the figure.
        failed: the seeds of each run that failed.
    """
    figure, panels = panel_grid(len(runs), 3.6)
    name, quantity, factor = CURVES[0]
    column, label = AXES["steps"]
    for panel, (run, rows) in zip(panels, runs.items(), strict=False):
        at, values = curve_table(rows, column, name)
        for seed, curve in zip(sorted({row["seed"] for row in rows}), values.T, strict=True):
            colour, line, layer = (ORANGE, "--", 3) if seed in failed[run] else (BLUE, "-", 2)
            panel.plot(at, factor * curve, line, color=colour, linewidth=1.0, alpha=0.7, zorder=layer)
        set_axes(panel, label, quantity, name)
        count = len(failed[run])
        named = f"seed{'s' * (count > 1)} {', '.join(map(str, sorted(failed[run])))}" if count else "no seed"
        which = named if count <= NAMED else f"{count} of {values.shape[1]} seeds"
        panel.set_title(f"{plain(run)}: {which} failed", fontsize="medium")
        panel.margins(x=0.0)
    figure.suptitle(f"{plain(title)}: the last 100 training episodes of every seed", fontsize="medium")
    return figure
