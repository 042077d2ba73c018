"""A figure of what run time assurance did in an episode.

It shows the controls that were asked for and those that acted, the steps that were altered, and how
safe the episode stayed.
"""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsafe.environment import Environment, control_unit, length_unit
from jaxsafe.plot.figures import Episodes, Rows
from jaxsafe.plot.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    NotebookFigure,
    fitted,
    labelled,
    margin_unit,
    plain,
    styled,
)

SHADE = "#F0E442"
"""Colour of altered steps, from the palette of `jaxsafe.plot.style`."""


def most_altered(episodes: Episodes) -> Rows:
    """Return the episode with the most interventions among those of the last training step.

    Args:
        episodes: logged episodes, each with the step of the training at which it was logged.
    """
    last = max(step for step, _ in episodes)
    latest = [rows for step, rows in episodes if step == last]
    return max(latest, key=lambda rows: int(_intervening(rows).sum()))


@styled
def interventions(rows: Rows, env: Environment, title: str, width: float | None = None) -> Figure:
    """Return a figure of one episode over time in s.

    Each control has a panel of the desired and the actual control. Each constraint has a panel of
    its h. Steps on which the filter altered the control are shaded. The predicted margin is drawn
    beside h if the filter keeps one constraint, else in a panel of its own.

    Args:
        rows: an episode of `episodes.jsonl`, from its start. Row k holds the control of the step
            that led to it.
        env: the environment, for bounds and units.
        title: the title of the figure.
        width: the width of the figure in inches.
    """
    actuators = env.actuators
    length = length_unit(env)
    filtered = getattr(env.rta, "constraints", ())
    apart = len(filtered) != 1
    count = len(actuators) + len(env.constraints) + apart
    figure = NotebookFigure(figsize=(width or 7.0, 1.0 + 1.35 * count), layout="constrained")
    panels = np.atleast_1d(figure.subplots(count, 1, sharex=True))
    times = _column(rows, "t")
    altered = _intervening(rows)
    for panel in panels:
        _shade(panel, times, altered, "altered" if panel is panels[0] else None)
    for panel, actuator in zip(panels, actuators, strict=False):
        _control(panel, times, rows, actuator)
        _name(panel, actuator.name, control_unit(actuator.name, length))
    lower = panels[len(actuators) :]
    for panel, constraint in zip(lower, env.constraints, strict=False):
        panel.plot(
            times, _column(rows, "margins", constraint.name), color=GREEN, linewidth=1.6, label="h"
        )
        _name(panel, f"h of {constraint.name}", margin_unit(constraint, length))
    names = [constraint.name for constraint in env.constraints]
    margin_panel = lower[-1] if apart else lower[names.index(filtered[0])]
    margin_panel.plot(
        times,
        _column(rows, "rta", "predicted_margin"),
        color="black",
        linewidth=0.8,
        linestyle="--",
        label="h, predicted",
    )
    if apart:
        _name(margin_panel, "predicted margin", None)
    for panel in lower:
        panel.axhline(0.0, color="black", linewidth=0.8, zorder=1)
    panels[-1].set(xlabel="time [s]", xlim=(times[0], times[-1]))
    entries = [
        entry
        for panel in (panels[0], margin_panel)
        for entry in zip(*panel.get_legend_handles_labels(), strict=True)
    ]
    handles, labels = zip(*entries, strict=True)
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=len(entries),
    )
    figure.align_ylabels(list(panels))
    share = altered.mean() if len(altered) else 0.0
    outcome = plain(rows[-1]["outcome"])
    subtitle = f"altered on {100.0 * share:.0f} % of the steps, ended with {outcome}"
    figure.suptitle(fitted(f"{plain(title)}\n{subtitle}", figure))
    return figure


def _control(panel: Axes, times: np.ndarray, rows: Rows, actuator: Any) -> None:
    """Draw the desired and the actual control, each held over its step, and the bounds."""
    low = float(actuator.low)
    high = float(actuator.high)
    looks = {
        "desired": {"color": ORANGE, "linewidth": 1.0, "alpha": 0.8},
        "actual": {"color": BLUE, "linewidth": 1.4},
    }
    for which, look in looks.items():
        held = _column(rows, f"control_{which}", actuator.name)[1:]
        panel.stairs(held, times, baseline=None, label=which, **look)
    for bound in (low, high):
        panel.axhline(bound, color=GREY, linewidth=0.8, linestyle=":")
    room = 0.12 * (high - low)
    panel.set(ylim=(low - room, high + room))


def _name(panel: Axes, quantity: str, unit: str | None) -> None:
    """Label the y axis in short lines, because the panels are low."""
    lines = textwrap.wrap(labelled(quantity, unit).replace("_", " "), 14)
    panel.set_ylabel("\n".join(map(plain, lines)))


def _shade(panel: Axes, times: np.ndarray, altered: np.ndarray, label: str | None) -> None:
    """Draw a band over every stretch of altered steps."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], altered, [False]]).astype(int)))
    begins = times[edges[::2]]
    ends = times[edges[1::2]]
    spans = list(zip(begins, ends - begins, strict=True))
    look = {"color": SHADE, "alpha": 0.35, "linewidth": 0, "label": label}
    panel.broken_barh(spans, (0.0, 1.0), transform=panel.get_xaxis_transform(), **look)


def _intervening(rows: Rows) -> np.ndarray:
    """Return whether each step was altered, shape (steps,)."""
    return np.array([row["rta"]["intervening"] for row in rows[1:]], bool)


def _column(rows: Rows, *path: str) -> np.ndarray:
    """Return the number at a path in every row, shape (rows,). A null is NaN and leaves a gap."""
    values: list[Any] = list(rows)
    for name in path:
        values = [value[name] for value in values]
    return np.array(values, float)
