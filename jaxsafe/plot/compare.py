"""Training curves of several runs of one task in one figure, Figs. 12-16."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import cycle, product
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxsafe.plot.curves import (
    CURVES,
    MARKERS,
    TRAINING,
    Axis,
    Curve,
    Rows,
    add_legend,
    curve_entries,
    curve_table,
    is_main,
    panel_grid,
    set_axes,
    shown_curves,
    without_diverged,
)
from jaxsafe.plot.style import (
    AMBER,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    fitted,
    plain,
    styled,
)

LINE_STYLES = tuple(product(("-", "--"), (BLUE, ORANGE, GREEN, PURPLE, AMBER, SKY, GREY)))
"""Line style and colour of each run in turn."""

MAX_LINEAR_RATIO = 8.0
"""Largest ratio between the lengths of runs that a linear axis can show together."""

MAX_NAMED_SEEDS = 5
"""Largest number of failed seeds that the title of a panel names."""


@styled
def compare_curves(
    runs: Mapping[str, Rows],
    title: str,
    x: str = "steps",
    mark: tuple[str, float] | None = None,
    evaluations: Mapping[str, Rows] | None = None,
    panels: Sequence[str] = (),
    width: float | None = None,
) -> Figure:
    """Return a figure with a panel for each quantity and a curve for each run.

    A curve is the mean over seeds with its 95 % interval. If a run has fewer seeds than
    `MIN_SEEDS_FOR_MEAN`, each of them has a curve. The horizontal axis is logarithmic if the
    longest run is more than `MAX_LINEAR_RATIO` times as long as the shortest.

    Args:
        runs: rows of the progress log by the label of the run.
        title: the title of the figure.
        x: what the horizontal axis shows, `steps` or `wall`.
        mark: a name and its place on the horizontal axis, which the panel of the success rate shows
            as a star.
        evaluations: rows of `evaluation_rows` by the label of the run.
        panels: the columns to show. Without any, all that the rows have values for are shown.
        width: the width of the figure in inches.

    Raises:
        ConfigError: a column of `panels` has no values.
    """
    sound: dict[str, tuple[Rows, Rows]] = {}
    for run, rows in runs.items():
        kept, left_out = without_diverged(rows)
        seeds = {row["seed"] for row in kept}
        evaluated = [row for row in (evaluations or {}).get(run, ()) if row["seed"] in seeds]
        sound[f"{run}{left_out}"] = (kept, evaluated)
    every_row = [row for rows, _ in sound.values() for row in rows]
    every_evaluation = [row for _, evaluated in sound.values() for row in evaluated]
    curves = shown_curves([*every_row, *every_evaluation], panels)
    figure, places, spare = panel_grid(len(curves), width)
    axis = Axis.of(x, every_row)
    ends = [max(row[axis.column] for row in rows) for rows, _ in sound.values()]
    if mark:
        ends.append(mark[1])
    logarithmic = max(ends) > MAX_LINEAR_RATIO * min(ends)
    averaged = False
    for panel, (name, quantity, factor) in zip(places, curves, strict=True):
        for (line, colour), (rows, evaluated) in zip(
            cycle(LINE_STYLES), sound.values(), strict=False
        ):
            main = Curve.of(rows, axis, name, factor)
            if is_main(evaluated):
                main.draw(panel, [colour], False, linestyle=line, linewidth=0.8, alpha=0.5)
                main = Curve.of(evaluated, axis, name, factor, evaluated=True)
            marker = MARKERS if is_main(evaluated) else {}
            main.draw(panel, [colour], True, linestyle=line, linewidth=1.6, **marker)
            averaged |= main.has_mean
        set_axes(panel, axis, quantity=quantity, name=name)
        if logarithmic:
            first = min(row[axis.column] for row in every_row if row[axis.column] > 0)
            panel.set_xscale("log")
            panel.set_xlim(left=first / axis.unit)
            panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        if mark and name == "success_rate":
            panel.plot(mark[1] / axis.unit, 80.0, "k*", markersize=9, clip_on=False, zorder=4)
    entries: list[Any] = [
        Line2D([], [], color=colour, linestyle=line, linewidth=1.6, label=plain(run))
        for (line, colour), run in zip(cycle(LINE_STYLES), sound, strict=False)
    ]
    if mark:
        entries.append(Line2D([], [], marker="*", color="black", linestyle="none", markersize=9))
        entries[-1].set_label(plain(mark[0]))
    entries += curve_entries(every_row, every_evaluation, ("black", "black"))
    add_legend(figure, spare, entries)
    suffix = ": mean and 95 % interval over seeds" if averaged else ""
    figure.suptitle(fitted(f"{plain(title)}{suffix}", figure))
    return figure


@styled
def seed_curves(
    runs: Mapping[str, Rows], title: str, failed: Mapping[str, Collection[int]]
) -> Figure:
    """Return a figure with a panel for each run and a curve for each seed.

    A curve is the success rate in training. It is dashed if the seed failed.

    Args:
        runs: rows of the progress log by the label of the run.
        title: the title of the figure.
        failed: the seeds of each run that failed.
    """
    figure, panels, _ = panel_grid(len(runs))
    name, quantity, factor = CURVES[0]
    for panel, (run, rows) in zip(panels, runs.items(), strict=True):
        axis = Axis.of("steps", rows)
        at, values = curve_table(rows, axis.column, name)
        for seed, curve in zip(sorted({row["seed"] for row in rows}), values.T, strict=True):
            colour, line, layer = (ORANGE, "--", 3) if seed in failed[run] else (BLUE, "-", 2)
            look = {"color": colour, "linewidth": 1.0, "alpha": 0.7, "zorder": layer}
            panel.plot(at / axis.unit, factor * curve, line, **look)
        set_axes(panel, axis, quantity=quantity, name=name)
        panel.set_title(f"{plain(run)}: {_named(failed[run], values.shape[1])} failed")
    figure.suptitle(fitted(f"{plain(title)}: {TRAINING}, of every seed", figure))
    return figure


def _named(failed: Collection[int], num_seeds: int) -> str:
    """Return in words which of `num_seeds` seeds failed."""
    if not failed:
        return "no seed"
    if len(failed) > MAX_NAMED_SEEDS:
        return f"{len(failed)} of {num_seeds} seeds"
    return f"seed{'s' * (len(failed) > 1)} {', '.join(map(str, sorted(failed)))}"
