"""A figure of how episodes ended over where they began."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from jaxsafe.environment import Environment, length_unit
from jaxsafe.plot.style import (
    BLUE,
    ORANGE,
    SKY,
    fitted,
    frame_labels,
    in_plane,
    labelled,
    plain,
    styled,
)
from jaxsafe.types import State

PANEL_WIDTH = 3.6
"""Width of a panel in inches."""

FEW_TO_ALL = LinearSegmentedColormap.from_list("few_to_all", [ORANGE, "#DDDDDD", SKY, BLUE])
"""Colours of a share, from 0 to 1."""


class Panel(NamedTuple):
    """What a panel of the map shows."""

    label: str
    unit: str | None
    factor: float = 1.0


PANELS = {
    "success": Panel("success", "%", 100.0),
    "violations": Panel("violating steps", None),
    "return": Panel("return", None),
    "length": Panel("length", "steps"),
    "delta_v": Panel("Δv", "m/s"),
}
"""The panels by name."""


def seen_from_the_other(env: Environment, starts: State) -> np.ndarray:
    """Return where the agent begins, relative to the first other platform, (starts, 2).

    If the other platform has a heading, x is along it. Without another platform the positions are
    those of the world.
    """
    own = in_plane(np.asarray(starts.sim.platforms[env.agent].position, float))[:, :2]
    others = [platform.name for platform in env.platforms if platform.name != env.agent]
    if not others:
        return own
    other = starts.sim.platforms[others[0]]
    apart = own - in_plane(np.asarray(other.position, float))[:, :2]
    heading = np.asarray(getattr(other, "heading", 0.0), float)
    cosine, sine = np.cos(heading), np.sin(heading)
    x, y = apart.T
    return np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=1)


@styled
def start_map(
    env: Environment, starts: State, values: Mapping[str, np.ndarray], title: str
) -> Figure:
    """Return a figure with a panel for each quantity. A dot is a start, seen from above.

    Args:
        env: the environment.
        starts: the states at the start. Every array is [starts, …].
        values: the quantities by the name of their panel in `PANELS`, each [starts]: a mean over
            the seeds.
        title: the title.
    """
    x, y = seen_from_the_other(env, starts).T
    others = [platform.name for platform in env.platforms if platform.name != env.agent]
    moves = bool(others) and "heading" in vars(env.platform(others[0]).shapes())
    labels = frame_labels(others[0] if moves else None, length_unit(env))
    figure = Figure(figsize=(PANEL_WIDTH * len(values), 3.4), layout="constrained")
    axes = figure.subplots(1, len(values), squeeze=False)[0]
    for axis, (name, quantity) in zip(axes, values.items(), strict=True):
        panel = PANELS[name]
        look: dict[str, Any] = {"cmap": "viridis"}
        if name == "success":
            look = {"cmap": FEW_TO_ALL, "vmin": 0.0, "vmax": panel.factor}
        # What is rare, and what is worst, is drawn last.
        order = np.argsort(-quantity if name in ("success", "return") else quantity)
        shown = panel.factor * quantity[order]
        dots = axis.scatter(x[order], y[order], c=shown, s=9, linewidths=0.0, **look)
        axis.plot(0.0, 0.0, marker="+", color="black", markersize=8)
        figure.colorbar(dots, ax=axis, label=labelled(panel.label, panel.unit), pad=0.02)
        axis.set(xlabel=labels[0], ylabel=labels[1], aspect="equal")
    figure.suptitle(fitted(plain(title), figure))
    return figure
