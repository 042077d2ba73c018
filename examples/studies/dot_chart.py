"""A chart of many ways of training: a line for each way, a panel for each metric."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from jaxsafe.plot.style import GREY, save, styled


class Dot(NamedTuple):
    """A value and its interval."""

    value: float
    low: float
    high: float


def dot(metric: Mapping[str, Any], unit: float) -> Dot | None:
    """Return a metric of `results.json` in a unit, with its interval if it has one.

    Return None if the metric is not known there.
    """
    value = metric["mean"] if "mean" in metric else metric["iqm"]
    if value is None:
        return None
    low, high = metric["ci95"] or (value, value)
    return Dot(unit * value, unit * low, unit * high)


@styled
def dot_chart(
    path: Path,
    lines: Sequence[str],
    panels: Mapping[str, Mapping[str, Sequence[Dot | None]]],
    looks: Mapping[str, Mapping[str, Any]],
    above: Collection[int] = (),
) -> None:
    """Draw a chart and write it to a file.

    Args:
        path: the file.
        lines: the name of each line, from the top.
        panels: for the label of each panel, the dots of each series by line. None leaves a line
            without a dot.
        looks: the look of the dots of each series.
        above: the lines with a rule above them.
    """
    figure = Figure(figsize=(10.5, 1.2 + 0.27 * len(lines)), layout="constrained")
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for (label, series), panel in zip(panels.items(), axes, strict=True):
        for index, (name, dots) in enumerate(series.items()):
            shift = 0.5 * ((index + 0.5) / len(series) - 0.5)
            known = [(line + shift, dot) for line, dot in enumerate(dots) if dot is not None]
            panel.errorbar(
                [dot.value for _, dot in known],
                [place for place, _ in known],
                xerr=[
                    [dot.value - dot.low for _, dot in known],
                    [dot.high - dot.value for _, dot in known],
                ],
                linestyle="none",
                markersize=4,
                elinewidth=0.8,
                label=name,
                **{"marker": "o", **looks[name]},
            )
        for line in above:
            panel.axhline(line - 0.5, color=GREY, linewidth=0.5)
        panel.set_xlabel(label)
        largest = panel.get_xlim()[1]
        panel.set_xlim(-0.03 * largest, 1.03 * largest)  # dots at both ends are seen whole
    axes[0].set_yticks(range(len(lines)), lines)
    axes[0].set_ylim(len(lines) - 0.5, -0.5)
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=4)
    save(figure, path)
