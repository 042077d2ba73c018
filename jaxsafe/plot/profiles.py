"""Performance profiles of several runs (Agarwal et al. 2021)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxsafe.metrics import bootstrap_interval
from jaxsafe.plot.compare import LINE_STYLES
from jaxsafe.plot.curves import MIN_SEEDS_FOR_MEAN, add_legend, panel_grid
from jaxsafe.plot.style import fitted, plain, styled

NUM_SCORES = 400
"""Number of scores at which a profile is drawn."""

Scores = Mapping[str, Sequence[float]]
"""The score of each seed by the label of the run."""


@styled
def performance_profiles(panels: Mapping[str, Scores], title: str, width: float | None) -> Figure:
    """Return a figure with a panel for each score and a profile for each run.

    A profile is the share of seeds whose score is above τ, over τ. The band is its 95 % interval
    from a bootstrap over seeds, if there are `MIN_SEEDS_FOR_MEAN` or more.

    Args:
        panels: the scores of each panel by the label of its horizontal axis.
        title: the title of the figure.
        width: the width of the figure in inches.
    """
    figure, places, spare = panel_grid(len(panels), width)
    labels = list(dict.fromkeys(label for scores in panels.values() for label in scores))
    looks = dict(zip(labels, cycle(LINE_STYLES), strict=False))
    banded = False
    for panel, (quantity, scores) in zip(places, panels.items(), strict=True):
        pooled = np.concatenate([np.asarray(values, float) for values in scores.values()])
        room = 0.02 * np.ptp(pooled) or 0.02 * abs(float(pooled[0])) or 1.0
        at = np.linspace(pooled.min() - room, pooled.max() + room, NUM_SCORES)
        for label, values in scores.items():
            line, colour = looks[label]
            above = 100.0 * (np.asarray(values, float) > at[:, None])
            panel.plot(at, above.mean(axis=1), line, color=colour, drawstyle="steps-post")
            if len(values) >= MIN_SEEDS_FOR_MEAN:
                banded = True
                band = bootstrap_interval(above)
                panel.fill_between(at, *band, color=colour, alpha=0.2, linewidth=0, step="post")
        panel.set(
            xlabel=quantity,
            ylabel="seeds with more than τ [%]",
            xlim=at[[0, -1]],
            ylim=(-3, 103),
        )
    entries = [
        Line2D([], [], color=colour, linestyle=line, label=plain(label))
        for label, (line, colour) in looks.items()
    ]
    add_legend(figure, spare, entries)
    spread = "95 % interval over seeds" if banded else "every seed"
    subtitle = f"performance profiles after training, {spread}"
    figure.suptitle(fitted(f"{plain(title)}\n{subtitle}", figure))
    return figure
