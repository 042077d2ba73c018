"""Training curves of several runs of one task in one figure, Figs. 12-16."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import cycle, product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxsafe.metrics import ENOUGH_EPISODES, ENOUGH_SEEDS, bootstrap_interval
from jaxsafe.plot.figures import (
    AXES,
    CURVES,
    curve_table,
    panel_grid,
    set_axes,
    shown_curves,
    without_diverged,
)
from jaxsafe.plot.style import BLUE, GREEN, GREY, ORANGE, plain

LINE_STYLES = tuple(
    product(("-", "--"), (BLUE, ORANGE, GREEN, "#CC79A7", GREY, "#E69F00", "#56B4E9"))
)
"""Line style and colour of each run in turn."""

MAX_LINEAR_RATIO = 8.0
"""Largest ratio between the lengths of runs that a linear axis can show together."""

MAX_LEGEND_COLUMNS = 9
"""Largest number of names in a row of the legend."""

MAX_NAMED_SEEDS = 5
"""Largest number of failed seeds that the title of a panel names."""


def compare_curves(
    runs: Mapping[str, Sequence[Mapping[str, Any]]],
    title: str,
    x: str = "steps",
    mark: tuple[str, float] | None = None,
) -> Figure:
    """Return a figure with a panel for each quantity and a curve for each run.

    A curve is the mean over seeds, with its 95 % interval if there are enough seeds. It begins when
    every seed has finished as many episodes as Table 2 needs, or all that it ever finished. The
    horizontal axis is logarithmic if the longest run is more than `MAX_LINEAR_RATIO` times as long
    as the shortest.

    Args:
        runs: rows of the progress log by the label of the run.
        title: the title of the figure.
        x: what the horizontal axis shows, `steps` or `wall`.
        mark: a name and its place on the horizontal axis, which the first panel shows as a star.
    """
    sound = {run: without_diverged(rows) for run, rows in runs.items()}
    runs = {f"{run}{left_out}": rows for run, (rows, left_out) in sound.items()}
    curves = shown_curves([row for rows in runs.values() for row in rows])
    figure, panels = panel_grid(len(curves), 3.6)
    column, label = AXES[x]
    ends = [max(row[column] for row in rows) for rows in runs.values()]
    if mark:
        ends.append(mark[1])
    logarithmic = max(ends) > MAX_LINEAR_RATIO * min(ends)
    counts = {run: curve_table(rows, column, "episodes")[1] for run, rows in runs.items()}
    enough = {
        run: (count >= np.minimum(ENOUGH_EPISODES, count[-1])).all(axis=1)
        for run, count in counts.items()
    }
    intervals = ""
    for panel, (name, quantity, factor) in zip(panels, curves, strict=False):
        for (line, colour), (run, rows) in zip(cycle(LINE_STYLES), runs.items(), strict=False):
            at, values = curve_table(rows, column, name)
            known = enough[run] & ~np.isnan(values).any(axis=1)
            at = at[known]
            values = factor * values[known]
            panel.plot(
                at,
                values.mean(axis=1),
                color=colour,
                linestyle=line,
                linewidth=1.6,
                label=plain(run),
            )
            if values.shape[1] >= ENOUGH_SEEDS and len(at):
                intervals = " and 95 % interval"
                panel.fill_between(
                    at, *bootstrap_interval(values), color=colour, alpha=0.2, linewidth=0
                )
        set_axes(panel, label=label, quantity=quantity, name=name)
        if logarithmic:
            panel.set_xscale("log")
        panel.margins(x=0.0)
    if mark:
        panels[0].plot(
            mark[1], 80.0, "k*", markersize=9, label=plain(mark[0]), clip_on=False, zorder=4
        )
    shown, names = panels[0].get_legend_handles_labels()
    figure.legend(
        shown,
        names,
        loc="outside lower center",
        ncols=min(len(names), MAX_LEGEND_COLUMNS),
        columnspacing=1.2,
        frameon=False,
    )
    what = f"the last 100 training episodes, mean{intervals} over seeds"
    figure.suptitle(f"{plain(title)}: {what}", fontsize="medium")
    return figure


def seed_curves(
    runs: Mapping[str, Sequence[Mapping[str, Any]]],
    title: str,
    failed: Mapping[str, Collection[int]],
) -> Figure:
    """Return a figure with a panel for each run and a curve for each seed.

    A curve is the success rate in training. It is dashed if the seed failed.

    Args:
        runs: rows of the progress log by the label of the run.
        title: the title of the figure.
        failed: the seeds of each run that failed.
    """
    figure, panels = panel_grid(len(runs), 3.6)
    name, quantity, factor = CURVES[0]
    column, label = AXES["steps"]
    for panel, (run, rows) in zip(panels, runs.items(), strict=False):
        at, values = curve_table(rows, column, name)
        for seed, curve in zip(sorted({row["seed"] for row in rows}), values.T, strict=True):
            colour, line, layer = (ORANGE, "--", 3) if seed in failed[run] else (BLUE, "-", 2)
            panel.plot(
                at, factor * curve, line, color=colour, linewidth=1.0, alpha=0.7, zorder=layer
            )
        set_axes(panel, label=label, quantity=quantity, name=name)
        panel.set_title(
            f"{plain(run)}: {_named(failed[run], values.shape[1])} failed", fontsize="medium"
        )
        panel.margins(x=0.0)
    figure.suptitle(
        f"{plain(title)}: the last 100 training episodes of every seed", fontsize="medium"
    )
    return figure


def _named(failed: Collection[int], num_seeds: int) -> str:
    """Return in words which of `num_seeds` seeds failed."""
    if not failed:
        return "no seed"
    if len(failed) > MAX_NAMED_SEEDS:
        return f"{len(failed)} of {num_seeds} seeds"
    return f"seed{'s' * (len(failed) > 1)} {', '.join(map(str, sorted(failed)))}"
