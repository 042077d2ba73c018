"""What run time assurance did along an episode: controls asked for and applied, steps altered, and how safe it stayed."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsafe.plot.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    control_unit,
    labelled,
    length_unit,
    margin_unit,
    plain,
)

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

SHADE = "#F0E442"  # of the same palette
Rows = list[dict[str, Any]]


def most_altered(episodes: Sequence[tuple[int, Rows]]) -> Rows:
    """Of the logged episodes, each with its training step, that of the last step with the most interventions."""
    last = max(step for step, _ in episodes)
    return max((rows for step, rows in episodes if step == last), key=lambda rows: int(_intervening(rows).sum()))


def interventions(rows: Rows, env: Environment, title: str) -> Figure:
    """A panel for each control, desired and actual, and one for h of each constraint, over time in s.

    Steps on which the filter altered the control are shaded. The margin that it predicted stands with h where it is about
    one constraint, else in a panel of its own.

    Args:
        rows: an episode of `episodes.jsonl`, start first: row k holds the control of the step that led to it.
        env: the environment, for bounds and units.
        title: of the figure.
    """
    actuators, length = env.actuators, length_unit(env)
    judged = getattr(env.rta, "constraints", ())
    apart = len(judged) != 1
    count = len(actuators) + len(env.constraints) + apart
    figure = Figure(figsize=(7.0, 1.0 + 1.35 * count), layout="constrained")
    panels = np.atleast_1d(figure.subplots(count, 1, sharex=True))
    times, altered = _column(rows, "t"), _intervening(rows)
    for panel in panels:
        _shade(panel, times, altered, "altered" if panel is panels[0] else None)
    for panel, actuator in zip(panels, actuators, strict=False):
        _control(panel, times, rows, actuator)
        _name(panel, actuator.name, control_unit(actuator.name, length))
    lower = panels[len(actuators) :]
    for panel, constraint in zip(lower, env.constraints, strict=False):
        panel.plot(times, _column(rows, "margins", constraint.name), color=GREEN, linewidth=1.6, label="h")
        _name(panel, f"h of {constraint.name}", margin_unit(constraint, length))
    watched = lower[-1] if apart else lower[[one.name for one in env.constraints].index(judged[0])]
    watched.plot(
        times, _column(rows, "rta", "predicted_margin"), color="black", linewidth=0.8, linestyle="--", label="h, predicted"
    )
    if apart:
        _name(watched, "predicted margin", None)
    for panel in lower:
        panel.axhline(0.0, color="black", linewidth=0.8, zorder=1)
    panels[-1].set(xlabel="time [s]", xlim=(times[0], times[-1]))
    entries = [each for panel in (panels[0], watched) for each in zip(*panel.get_legend_handles_labels(), strict=True)]
    figure.legend(
        *zip(*entries, strict=True), loc="outside lower center", ncols=len(entries), fontsize="small", frameon=False
    )
    figure.align_ylabels(list(panels))
    share = altered.mean() if len(altered) else 0.0
    figure.suptitle(
        f"{plain(title)}\naltered on {100.0 * share:.0f} % of the steps, ended with {plain(rows[-1]['outcome'])}",
        fontsize="medium",
    )
    return figure


def _control(panel: Axes, times: np.ndarray, rows: Rows, actuator: Any) -> None:
    """What was asked for and what acted, each held over its step, between the bounds."""
    low, high = float(actuator.low), float(actuator.high)
    for kind, look in (("desired", {"color": ORANGE, "linewidth": 1.0, "alpha": 0.8}), ("actual", {"color": BLUE})):
        held = _column(rows, f"control_{kind}", actuator.name)[1:]
        panel.stairs(held, times, baseline=None, label=kind, **{"linewidth": 1.4, **look})
    for bound in (low, high):
        panel.axhline(bound, color=GREY, linewidth=0.8, linestyle=":")
    room = 0.12 * (high - low)
    panel.set(ylim=(low - room, high + room))


def _name(panel: Axes, quantity: str, unit: str | None) -> None:
    """Label the y axis in short lines, as the panels are low."""
    lines = textwrap.wrap(labelled(quantity, unit).replace("_", " "), 14)
    panel.set_ylabel("\n".join(map(plain, lines)), fontsize="small")


def _shade(panel: Axes, times: np.ndarray, altered: np.ndarray, label: str | None) -> None:
    """A band over every stretch of altered steps."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], altered, [False]]).astype(int)))
    begin, end = times[edges[::2]], times[edges[1::2]]
    look = {"color": SHADE, "alpha": 0.35, "linewidth": 0, "label": label}
    panel.broken_barh(list(zip(begin, end - begin, strict=True)), (0.0, 1.0), transform=panel.get_xaxis_transform(), **look)


def _intervening(rows: Rows) -> np.ndarray:
    """Whether each step was altered, (steps,)."""
    return np.array([row["rta"]["intervening"] for row in rows[1:]], bool)


def _column(rows: Rows, *path: str) -> np.ndarray:
    """One number of every row; a null is nan and leaves a gap."""
    values: list[Any] = list(rows)
    for name in path:
        values = [value[name] for value in values]
    return np.array(values, float)
