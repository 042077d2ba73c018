"""Figure of a sweep: the success rate of each setting in the course of training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from jaxsafe.plot.curves import CURVES, TRAINING, Axis, set_axes
from jaxsafe.plot.style import GREY, plain, save, styled

MAX_NAMED_SETTINGS = 8
"""Number of the best settings that get a colour and a name."""


@styled
def sweep_curves(path: Path, curves: Sequence[tuple[str, dict[str, Any]]]) -> Path:
    """Draw the success rate of each setting, averaged over seeds, and return the path of the file.

    Args:
        path: the directory of the file.
        curves: label and curve of each setting, the best one first.
    """
    figure = Figure(figsize=(7.6, 4.4), layout="constrained")
    panel = figure.subplots()
    axis = Axis.of("steps", [{"step": max(curve["steps"])} for _, curve in curves])
    num_named = min(len(curves), MAX_NAMED_SETTINGS)
    for rank, (label, curve) in reversed(list(enumerate(curves))):
        steps = np.array(curve["steps"])
        success = 100.0 * np.mean(np.array(curve["success_rate"], float), axis=0)
        named = rank < MAX_NAMED_SETTINGS
        colour = colormaps["viridis"](0.85 * rank / max(num_named - 1, 1)) if named else GREY
        panel.plot(
            steps / axis.unit,
            success,
            color=colour,
            linewidth=1.6 if named else 0.6,
            label=plain(label) if named else None,
            zorder=-rank,
        )
    name, quantity, _ = CURVES[0]
    set_axes(panel, axis, quantity=quantity, name=name)
    figure.suptitle(f"{TRAINING}, averaged over seeds")
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside right upper")
    return save(figure, path / "curves.png")
