"""Figure of a sweep: the success rate of each setting in the course of training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from jaxsafe.plot.style import GREY, plain, save

MAX_NAMED_SETTINGS = 8
"""Number of the best settings that get a colour and a name."""


def sweep_curves(path: Path, curves: Sequence[tuple[str, dict[str, Any]]]) -> Path:
    """Draw the success rate of each setting, averaged over seeds, and return the path of the file.

    Args:
        path: the directory of the file.
        curves: label and curve of each setting, the best one first.
    """
    figure = Figure(figsize=(7.6, 4.4), layout="constrained")
    panel = figure.subplots()
    num_named = min(len(curves), MAX_NAMED_SETTINGS)
    for place, (label, curve) in reversed(list(enumerate(curves))):
        steps = np.array(curve["steps"])
        success = 100.0 * np.mean(np.array(curve["success_rate"], float), axis=0)
        named = place < MAX_NAMED_SETTINGS
        colour = colormaps["viridis"](0.85 * place / max(num_named - 1, 1)) if named else GREY
        panel.plot(
            steps,
            success,
            color=colour,
            linewidth=1.6 if named else 0.6,
            label=plain(label) if named else None,
            zorder=-place,
        )
    panel.axhline(80.0, color="black", linestyle=":", linewidth=1.0)
    panel.set(
        xlabel="environment steps per seed",
        ylabel="success rate [%], last 100 episodes",
        ylim=(-3, 103),
    )
    panel.ticklabel_format(axis="x", style="sci", scilimits=(-3, 4))
    panel.margins(x=0.0)
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(
        handles[::-1], labels[::-1], loc="outside right upper", fontsize="small", frameon=False
    )
    return save(figure, path / "curves.png")
