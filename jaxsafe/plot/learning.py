"""Figure of how the updates of a run learn: losses, entropy, step sizes and schedules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from jaxsafe.plot.figures import AXES, curve_table, panel_grid, without_diverged
from jaxsafe.plot.style import BLUE, plain

PANELS = (
    ("policy_loss", "policy loss", 1.0),
    ("value_loss", "value loss", 1.0),
    ("cost_value_loss", "value loss of the cost", 1.0),
    ("explained_variance", "explained variance", 1.0),
    ("entropy", "entropy [nat]", 1.0),
    ("action_std", "standard deviation of actions", 1.0),
    ("approx_kl", "approximate KL [nat]", 1.0),
    ("clip_fraction", "clip fraction [%]", 100.0),
    ("grad_norm", "gradient norm", 1.0),
    ("learning_rate", "learning rate", 1.0),
    ("gamma", "discount factor γ", 1.0),
)
"""Column of the progress log, label, and factor of each panel."""

LOGARITHMIC = ("value_loss", "cost_value_loss")
"""Columns on a logarithmic axis, because they fall by orders of magnitude during a training."""

IN_ROW = 5
"""Number of panels in a row."""

WORST_SHOWN = -0.5
"""Lowest explained variance that is shown. The first updates may have far lower ones."""


def learning_curves(rows: Sequence[Mapping[str, Any]], x: str, title: str) -> Figure | None:
    """Return a figure with a small panel for each diagnostic, or None if the log has none.

    A panel shows the median of the seeds, and their range. Logs of older versions have no
    diagnostics.

    Args:
        rows: rows of the progress log.
        x: what the horizontal axis shows, `steps` or `wall`.
        title: the title of the figure.
    """
    shown = [panel for panel in PANELS if panel[0] in rows[0]]
    if not shown:
        return None
    column, label = AXES[x]
    rows, left_out = without_diverged(rows)
    figure, panels = panel_grid(len(shown), 2.7, height=2.2, in_row=IN_ROW)
    for panel, (name, quantity, factor) in zip(panels, shown, strict=False):
        at, values = curve_table(rows, column, name)
        _band(panel, at, factor * values)
        panel.set_title(quantity, fontsize="medium")
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
        if name in LOGARITHMIC and np.nanmax(values, initial=0.0) > 0.0:
            panel.set_yscale("log")
        if name == "explained_variance":
            panel.set_ylim(max(WORST_SHOWN, panel.get_ylim()[0]), 1.05)
    for panel in panels[max(0, len(shown) - IN_ROW) : len(shown)]:
        panel.set_xlabel(label)
    several = len({row["seed"] for row in rows}) > 1
    what = "median and range of the seeds" if several else "one seed"
    figure.suptitle(f"{plain(title)}\neach update, {what}{left_out}", fontsize="medium")
    return figure


def _band(panel: Axes, at: np.ndarray, values: np.ndarray) -> None:
    """Draw the median over seeds and their range, where all seeds have a value.

    Args:
        panel: the panel.
        at: the horizontal axis, shape (points,).
        values: the values, shape (points, seeds).
    """
    known = ~np.isnan(values).any(axis=1)
    at = at[known]
    values = values[known]
    if not len(at):
        return
    panel.fill_between(
        at, values.min(axis=1), values.max(axis=1), color=BLUE, alpha=0.25, linewidth=0
    )
    panel.plot(at, np.median(values, axis=1), color=BLUE, linewidth=1.2)
    panel.margins(x=0.0)
