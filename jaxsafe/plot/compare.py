"""Training curves of several runs of one task in one figure, Figs. 12-16."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle, product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxsafe.metrics import bootstrap_interval
from jaxsafe.plot.figures import ALWAYS, AXES, CURVES, curve_table, panel_grid, set_axes
from jaxsafe.plot.style import BLUE, GREEN, GREY, ORANGE

LOOKS = tuple(product(("-", "--"), (BLUE, ORANGE, GREEN, "#CC79A7", GREY)))
"""Line style and colour of each run in turn."""

FAR = 8.0
"""Between lengths of runs that one linear axis cannot show together."""

LEGEND = 7
"""Names in a row of the legend, at most."""


def compare_curves(runs: Mapping[str, Sequence[Mapping[str, Any]]], title: str, x: str = "steps") -> Figure:
    """A panel for each quantity, in it the mean and the 95 % interval over seeds of each run.

    The horizontal axis is logarithmic where the longest run is more than `FAR` times as long as the shortest.

    Args:
        runs: rows of the progress log by the run's label.
        title: of the figure.
        x: `steps` or `wall`.
    """
    every = [row for rows in runs.values() for row in rows]
    curves = [curve for curve in CURVES if curve[0] in ALWAYS or any(row.get(curve[0]) for row in every)]
    figure, panels = panel_grid(len(curves), 3.6)
    column, label = AXES[x]
    ends = [max(row[column] for row in rows) for rows in runs.values()]
    logarithmic = max(ends) > FAR * min(ends)
    for panel, (name, quantity, factor) in zip(panels, curves, strict=False):
        for (line, colour), (run, rows) in zip(cycle(LOOKS), runs.items(), strict=False):
            at, values = curve_table(rows, column, name)
            known = ~np.isnan(values).any(axis=1)
            at, values = at[known], factor * values[known]
            panel.plot(at, values.mean(axis=1), color=colour, linestyle=line, linewidth=1.6, label=run)
            if values.shape[1] > 1 and len(at):
                panel.fill_between(at, *bootstrap_interval(values), color=colour, alpha=0.2, linewidth=0)
        set_axes(panel, label, quantity, name)
        if logarithmic:
            panel.set_xscale("log")
        panel.margins(x=0.0)
    columns = min(len(runs), LEGEND)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=columns, frameon=False)
    figure.suptitle(f"{title}: the last 100 training episodes, mean and 95 % interval over seeds", fontsize="medium")
    return figure


def seed_curves(runs: Mapping[str, Sequence[Mapping[str, Any]]], title: str) -> Figure:
    """A panel for each run, in it the success rate in training of every seed; a seed that ends below 80 % is dashed.

    Args:
        runs: rows of the progress log by the run's label.
        title: of the figure.
    """
    figure, panels = panel_grid(len(runs), 3.6)
    name, quantity, factor = CURVES[0]
    column, label = AXES["steps"]
    for panel, (run, rows) in zip(panels, runs.items(), strict=False):
        at, values = curve_table(rows, column, name)
        low = ~(factor * values[-1] >= 80.0)
        for seed in range(values.shape[1]):
            colour, line = (ORANGE, "--") if low[seed] else (BLUE, "-")
            panel.plot(at, factor * values[:, seed], line, color=colour, linewidth=1.0, alpha=0.7)
        set_axes(panel, label, quantity, name)
        panel.set_title(f"{run}: {int(low.sum())} of {len(low)} end below 80 %", fontsize="medium")
        panel.margins(x=0.0)
    figure.suptitle(f"{title}: the last 100 training episodes of every seed", fontsize="medium")
    return figure
