"""Figure of how the updates of a run learn: losses, entropy, step sizes and schedules."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxsafe.plot.curves import (
    MIN_SEEDS_FOR_MEAN,
    SEED_COLOURS,
    Axis,
    Rows,
    curve_table,
    panel_grid,
    without_diverged,
)
from jaxsafe.plot.style import BLUE, fitted, plain, styled

PANELS = (
    ("policy_loss", "policy loss", 1.0),
    ("value_loss", "value loss", 1.0),
    ("cost_value_loss", "value loss of the cost", 1.0),
    ("explained_variance", "explained variance", 1.0),
    ("entropy", "entropy [nat]", 1.0),
    ("action_std", "deviation of actions", 1.0),
    ("approx_kl", "approximate KL [nat]", 1.0),
    ("clip_fraction", "clip fraction [%]", 100.0),
    ("grad_norm", "gradient norm", 1.0),
    ("learning_rate", "learning rate", 1.0),
    ("gamma", "discount factor γ", 1.0),
    ("multiplier", "multiplier of the cost", 1.0),
    ("episode_severity", "severity of an episode", 1.0),
)
"""Column of the progress log, label, and factor of each panel."""

NAMED_PANELS = {
    "multiplier": "multiplier of",
    "episode_cost": "cost of an episode,",
    "measured": "measured",
}
"""Label of the panels of limited constraints and of one's own metrics, by the first part of their
columns."""

LOGARITHMIC = ("value_loss", "cost_value_loss", "multiplier")
"""Columns on a logarithmic axis, because they change by orders of magnitude during a training."""

IN_ROW = 5
"""Number of panels in a row."""

PANEL_WIDTH = 2.2
"""Width of a panel in inches, if the width of the figure is left open."""

WORST_SHOWN = -0.5
"""Lowest explained variance that is shown. The first updates may have far lower ones."""


@styled
def learning_curves(rows: Rows, x: str, title: str, width: float | None = None) -> Figure | None:
    """Return a figure with a small panel for each diagnostic, or None if the log has none.

    A panel shows the median of the seeds, and their range. Fewer than `MIN_SEEDS_FOR_MEAN` seeds
    are drawn alone, in the colours of `training_curves`. Logs of older versions have no
    diagnostics.

    Args:
        rows: rows of the progress log.
        x: what the horizontal axis shows, `steps` or `wall`.
        title: the title of the figure.
        width: the width of the figure in inches.
    """
    rows, left_out = without_diverged(rows)
    panels_of_run = [*PANELS, *_named_panels(rows)]
    shown = [panel for panel in panels_of_run if any(row.get(panel[0]) is not None for row in rows)]
    if not shown:
        return None
    axis = Axis.of(x, rows)
    figure, panels, _ = panel_grid(
        len(shown), width, panel_width=PANEL_WIDTH, ratio=0.85, in_row=IN_ROW
    )
    for panel, (name, quantity, factor) in zip(panels, shown, strict=True):
        at, values = curve_table(rows, axis.column, name)
        if values.shape[1] < MIN_SEEDS_FOR_MEAN:
            _draw_seeds(panel, at / axis.unit, factor * values)
        else:
            _band(panel, at / axis.unit, factor * values)
        panel.set_title(quantity)
        panel.margins(x=0.0)
        panel.set_xlim(left=0.0)
        if name.partition("/")[0] in LOGARITHMIC and np.nanmax(values, initial=0.0) > 0.0:
            panel.set_yscale("log")
        if name == "explained_variance":
            panel.set_ylim(max(WORST_SHOWN, panel.get_ylim()[0]), 1.05)
    figure.supxlabel(axis.label, fontsize="medium")
    seeds = sorted({row["seed"] for row in rows})
    alone = 1 < len(seeds) < MIN_SEEDS_FOR_MEAN
    if alone:
        entries = [
            Line2D([], [], color=colour, label=f"seed {seed}")
            for seed, colour in zip(seeds, SEED_COLOURS, strict=False)
        ]
        # Below the panels it would lie on the label of the horizontal axis.
        panels[-1].legend(handles=entries, loc="best")
    shown_seeds = "one seed" if len(seeds) == 1 else "median and range of the seeds"
    shown_seeds = "every seed" if alone else shown_seeds
    figure.suptitle(fitted(f"{plain(title)}\neach update, {shown_seeds}{left_out}", figure))
    return figure


def _named_panels(rows: Rows) -> list[tuple[str, str, float]]:
    """Return the panels of constraints with a limit of their own and of one's own metrics."""
    parts = [(name, *name.partition("/")) for name in (rows[0] if rows else ())]
    return [
        (column, f"{NAMED_PANELS[first]}\n{plain(name)}", 1.0)
        for column, first, slash, name in parts
        if slash and first in NAMED_PANELS
    ]


def _draw_seeds(panel: Axes, at: np.ndarray, values: np.ndarray) -> None:
    """Draw each seed alone, where it has a value.

    Args:
        panel: the panel.
        at: the horizontal axis, shape (points,).
        values: the values, shape (points, seeds).
    """
    for seed, colour in zip(values.T, SEED_COLOURS, strict=False):
        known = ~np.isnan(seed)
        panel.plot(at[known], seed[known], color=colour, linewidth=1.0)


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
