"""Curves of a training over its steps or its time, Figs. 12-16.

The main curves are those of the evaluations, which fly from the same starts each time. Beside them
are the means of the latest training episodes.
"""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxsafe.metrics import ENOUGH_EPISODES, bootstrap_interval
from jaxsafe.plot.style import (
    AMBER,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    NotebookFigure,
    fitted,
    plain,
    styled,
)
from jaxsafe.schema.errors import ConfigError

CURVES = (
    ("success_rate", "success rate [%]", 100.0),
    ("return", "return", 1.0),
    ("length", "episode length [steps]", 1.0),
    ("delta_v", "Δv per episode [m/s]", 1.0),
    ("control_effort", "control,\nshare of full control [%]", 100.0),
    ("violating_share", "violating share\nof an episode's steps [%]", 100.0),
    ("episode_cost", "violating steps per episode", 1.0),
    ("intervention_share", "altered share\nof an episode's steps [%]", 100.0),
)
"""Column of the progress log, label, and factor of each curve."""

ALWAYS_SHOWN = ("success_rate", "return", "length")
"""Curves that are shown even where all values are 0."""

AXES = ("steps", "wall")
"""Names of the horizontal axes."""

MIN_SEEDS_FOR_MEAN = 5
"""Smallest number of seeds whose mean and interval are drawn. Fewer are drawn one by one."""

MIN_EVALUATIONS = 3
"""Smallest number of evaluations that make a curve. Fewer are points beside the training."""

MILLIONS_FROM = 100_000
"""Number of steps from which an axis counts millions. Below, it counts thousands."""

PANEL_WIDTH = 3.3
"""Width of a panel in inches, if the width of the figure is left open."""

MIN_PANEL_WIDTH = 2.1
"""Smallest width of a panel in inches. A figure that is not wide enough has fewer columns."""

PANEL_RATIO = 0.78
"""Height of a panel over its width."""

LEGEND_ENTRY_WIDTH = 2.7
"""Width of a legend entry in inches, which decides how many stand side by side."""

LEGEND_HANDLE_WIDTH = 0.5
"""Width in inches that a legend entry needs beside its text."""

LEGEND_CHARACTERS_PER_INCH = 14
"""Number of characters of a legend entry that fit into an inch."""

SEED_COLOURS = (BLUE, ORANGE, GREEN, PURPLE)
"""Colours of seeds that are drawn one by one."""

MARKERS: dict[str, Any] = {"marker": "o", "markersize": 3.0, "clip_on": False}
"""Look of evaluations. Those at step 0 lie on the axis and are drawn whole."""

EVALUATIONS = "evaluations, deterministic, from the same starts"
TRAINING = "mean of the latest 100 training episodes"
FEW = f"fewer than {ENOUGH_EPISODES} training episodes yet"

Rows = Sequence[Mapping[str, Any]]
"""Rows of a progress log, or of `evaluation_rows`."""


@dataclasses.dataclass(frozen=True)
class Axis:
    """The horizontal axis of training curves."""

    column: str  # the column of the progress log
    label: str
    unit: float  # the value of the column that is 1 on the axis

    @classmethod
    def of(cls, x: str, rows: Rows) -> Self:
        """Return the axis for some rows. `x` is `steps` or `wall`."""
        if x == "wall":
            return cls(column="wall_s", label="wall time [s]", unit=1.0)
        millions = max(row["step"] for row in rows) >= MILLIONS_FROM
        label = f"environment steps per seed [{'M' if millions else 'k'}]"
        return cls(column="step", label=label, unit=1e6 if millions else 1e3)


@dataclasses.dataclass(frozen=True)
class Curve:
    """A quantity of several seeds."""

    at: np.ndarray
    """Places on the horizontal axis, shape (points,)."""
    values: np.ndarray
    """The quantity, shape (points, seeds). It is NaN where it is not known."""
    sure: np.ndarray
    """Whether enough episodes are behind a value, shape (points, seeds)."""

    @classmethod
    def of(cls, rows: Rows, axis: Axis, name: str, factor: float, evaluated: bool = False) -> Self:
        """Return a column of some rows as a curve.

        Args:
            rows: the rows.
            axis: the horizontal axis.
            name: the column.
            factor: what to multiply the values by.
            evaluated: whether the rows are those of evaluations.
        """
        at, values = curve_table(rows, axis.column, name)
        count = curve_table(rows, axis.column, "episodes")[1]
        return cls(
            at=at / axis.unit,
            values=factor * values,
            sure=(count >= ENOUGH_EPISODES) | evaluated,
        )

    @property
    def has_mean(self) -> bool:
        """Whether there are enough seeds for a mean."""
        return self.values.shape[1] >= MIN_SEEDS_FOR_MEAN

    def draw(self, panel: Axes, colours: Sequence[str], interval: bool, **look: Any) -> None:
        """Draw the mean over seeds, where all seeds have a value. Draw fewer seeds one by one.

        Args:
            panel: the panel.
            colours: the colours of seeds in turn. The mean has the first one.
            interval: whether to draw the 95 % interval of the mean.
            look: the look of the lines.
        """
        if not self.has_mean:
            for index, (values, sure) in enumerate(zip(self.values.T, self.sure.T, strict=True)):
                colour = colours[index % len(colours)]
                _draw_line(panel, self.at, values, sure, color=colour, **look)
            return
        _draw_line(
            panel,
            self.at,
            self.values.mean(axis=1),
            self.sure.all(axis=1),
            color=colours[0],
            **look,
        )
        # A mean over fewer seeds would be another curve.
        known = ~np.isnan(self.values).any(axis=1)
        if interval and known.any():
            band = bootstrap_interval(self.values[known])
            panel.fill_between(self.at[known], *band, color=colours[0], alpha=0.2, linewidth=0)


@styled
def training_curves(
    rows: Rows,
    x: str,
    title: str,
    evaluations: Rows = (),
    panels: Sequence[str] = (),
    width: float | None = None,
) -> Figure:
    """Return a figure with a panel for each quantity of a run.

    With `MIN_SEEDS_FOR_MEAN` seeds or more, a panel shows a thin curve for every seed, their mean,
    and the mean's 95 % interval. Fewer seeds are drawn alone, each in its colour.

    Args:
        rows: rows of the progress log.
        x: what the horizontal axis shows, `steps` or `wall`.
        title: the title of the figure.
        evaluations: rows of `evaluation_rows`.
        panels: the columns to show. Without any, all that the rows have values for are shown.
        width: the width of the figure in inches.

    Raises:
        ConfigError: a column of `panels` has no values.
    """
    rows, left_out = without_diverged(rows)
    seeds = sorted({row["seed"] for row in rows})
    evaluations = [row for row in evaluations if row["seed"] in seeds]
    curves = shown_curves([*rows, *evaluations], panels)
    figure, places, spare = panel_grid(len(curves) or 1, width)
    axis = Axis.of(x, rows)
    together = len(seeds) >= MIN_SEEDS_FOR_MEAN
    main = is_main(evaluations)
    for panel, (name, quantity, factor) in zip(places, curves, strict=False):
        drawn = [(Curve.of(rows, axis, name, factor), AMBER, not main)]
        if evaluations:
            drawn.append((Curve.of(evaluations, axis, name, factor, True), BLUE, main))
        for curve, colour, leads in drawn:
            colours = [colour] if together else SEED_COLOURS
            if together and leads:
                panel.plot(curve.at, curve.values, color=colour, linewidth=0.6, alpha=0.35)
            curve.draw(panel, colours, interval=leads, **_look(leads, colour == BLUE, main))
        set_axes(panel, axis, quantity=quantity, name=name)
    if curves:
        colours = (BLUE, AMBER) if together else ("black", "black")
        entries = curve_entries(rows, evaluations, colours)
        if together:
            leading = BLUE if main else AMBER
            thin = {"color": leading, "linewidth": 0.6, "alpha": 0.6}
            entries += [
                Line2D([], [], label="each seed", **thin),
                Patch(color=leading, alpha=0.2, linewidth=0, label="95 % interval of the mean"),
            ]
        elif len(seeds) > 1:
            entries = [
                Line2D([], [], color=colour, linewidth=1.6, label=f"seed {seed}")
                for seed, colour in zip(seeds, SEED_COLOURS, strict=False)
            ] + entries
        add_legend(figure, spare, entries)
    else:
        places[0].set_axis_off()
        places[0].text(0.5, 0.5, "no episode has ended yet", ha="center", va="center")
    figure.suptitle(fitted(f"{plain(title)}{left_out}", figure))
    return figure


def evaluation_rows(log: Rows, progress: Rows) -> list[dict[str, Any]]:
    """Return the means of the evaluations during training, in columns of the progress log.

    Args:
        log: rows of `eval.jsonl`, one for each episode.
        progress: rows of the progress log, which have the time.

    Returns:
        A row for each seed of each evaluation.
    """
    clock = {0: 0.0} | {row["step"]: row["wall_s"] for row in progress}
    grouped: dict[tuple[int, int], list[Mapping[str, Any]]] = {}
    for episode in log:
        if not episode["final"] and episode["step"] in clock:
            grouped.setdefault((episode["step"], episode["seed"]), []).append(episode)
    return [
        {
            "seed": seed,
            "step": step,
            "wall_s": clock[step],
            "episodes": len(episodes),
            "success_rate": _mean([episode["success"] for episode in episodes]),
            "return": _mean([episode["return"] for episode in episodes]),
            "length": _mean([episode["length"] for episode in episodes]),
            "delta_v": _mean([episode.get("delta_v") for episode in episodes]),
            "control_effort": _mean([episode.get("control_effort") for episode in episodes]),
            "episode_cost": _mean([episode.get("violating_steps") for episode in episodes]),
            "violating_share": _mean_share(episodes, "violating_steps"),
            "intervention_share": _mean_share(episodes, "interventions"),
        }
        for (step, seed), episodes in sorted(grouped.items())
    ]


def is_main(evaluations: Rows) -> bool:
    """Return whether there are enough evaluations to be the main curve."""
    return len({row["step"] for row in evaluations}) >= MIN_EVALUATIONS


def shown_curves(rows: Rows, panels: Sequence[str] = ()) -> list[tuple[str, str, float]]:
    """Return the curves to show.

    Args:
        rows: the rows that the curves are drawn from.
        panels: the columns to show. Without any, all that the rows have values for are shown.

    Raises:
        ConfigError: a column of `panels` has no values.
    """
    available = [
        curve
        for curve in CURVES
        if any(
            row.get(curve[0]) if not panels and curve[0] not in ALWAYS_SHOWN else _knows(row, curve)
            for row in rows
        )
    ]
    if not panels:
        return available
    by_name = {curve[0]: curve for curve in available}
    for name in panels:
        if name not in by_name:
            choices = ", ".join(by_name) or "none, because no episode has ended yet"
            raise ConfigError(f"panels: no values of {name} here; choose from {choices}")
    return [by_name[name] for name in panels]


def without_diverged(rows: Rows) -> tuple[Rows, str]:
    """Return the rows of the seeds that have not diverged, and a text that names the others.

    If every seed has diverged, all rows are returned. Their curves end where the seeds diverged.
    """
    diverged = {row["seed"] for row in rows if row.get("diverged")}
    sound = [row for row in rows if row["seed"] not in diverged]
    if not diverged or not sound:
        return rows, ""
    seeds = f"seed{'s' * (len(diverged) > 1)} {', '.join(map(str, sorted(diverged)))}"
    return sound, f", without {seeds}, which diverged"


def set_axes(panel: Axes, axis: Axis, quantity: str, name: str) -> None:
    """Set the axes of a panel. They begin at step 0.

    A success rate is shown in its whole range, with the level of Table 2.

    Args:
        panel: the panel.
        axis: the horizontal axis.
        quantity: the label of the vertical axis.
        name: the column of the progress log.
    """
    panel.set(xlabel=axis.label, ylabel=quantity)
    panel.margins(x=0.02)
    panel.set_xlim(left=0.0)
    if name == "success_rate":
        panel.set_ylim(-3, 103)
        panel.axhline(80.0, color=GREY, linewidth=0.6, zorder=0)


def curve_entries(rows: Rows, evaluations: Rows, colours: tuple[str, str]) -> list[Any]:
    """Return legend entries that tell evaluations from the episodes of the training.

    Args:
        rows: rows of progress logs.
        evaluations: rows of `evaluation_rows`.
        colours: the colours of evaluations and of training.
    """
    main = is_main(evaluations)
    entries = []
    if evaluations:
        look = _look(main, True, main)
        entries.append(Line2D([], [], color=colours[0], label=EVALUATIONS, **look))
    look = _look(not main, False, main)
    entries.append(Line2D([], [], color=colours[1], label=TRAINING, **look))
    if any(_knows(row, CURVES[0]) and row["episodes"] < ENOUGH_EPISODES for row in rows):
        look |= {"linestyle": ":"}
        entries.append(Line2D([], [], color=colours[1], label=FEW, **look))
    return entries


def add_legend(figure: Figure, spare: Sequence[Axes], entries: Sequence[Any]) -> None:
    """Put a legend into the spare panels, or else below the panels."""
    if spare:
        grid = spare[0].get_gridspec()
        room = len(spare) * figure.get_figwidth() / (grid.ncols if grid else 1)
        characters = int(LEGEND_CHARACTERS_PER_INCH * (room - LEGEND_HANDLE_WIDTH))
        for entry in entries:
            entry.set_label("\n".join(textwrap.wrap(entry.get_label(), characters)))
        legend = spare[0].legend(handles=entries, loc="center left", borderaxespad=0.0)
        # The layout would widen one column of panels for a legend that stretches over two.
        legend.set_in_layout(False)
        return
    columns = max(1, int(figure.get_figwidth() / LEGEND_ENTRY_WIDTH))
    # Rows of equal length leave no gap at the end.
    lines = -(-len(entries) // columns)
    figure.legend(handles=entries, loc="outside lower center", ncols=-(-len(entries) // lines))


def panel_grid(
    count: int,
    width: float | None = None,
    panel_width: float = PANEL_WIDTH,
    ratio: float = PANEL_RATIO,
    in_row: int = 3,
) -> tuple[Figure, list[Axes], list[Axes]]:
    """Return a figure, its panels, and panels that are left over and show nothing.

    Args:
        count: number of panels.
        width: width of the figure in inches. None makes each panel as wide as `panel_width`.
        panel_width: width of a panel in inches.
        ratio: height of a panel over its width.
        in_row: largest number of panels in a row.
    """
    if width is not None:
        in_row = max(1, min(in_row, int(width / min(panel_width, MIN_PANEL_WIDTH))))
    rows = -(-count // in_row)
    columns = -(-count // rows)
    panel_width = panel_width if width is None else width / columns
    height = ratio * panel_width * rows + 0.6  # for title and legend
    figure = NotebookFigure(figsize=(panel_width * columns, height), layout="constrained")
    panels = list(np.atleast_1d(figure.subplots(rows, columns)).ravel())
    for panel in panels[count:]:
        panel.set_axis_off()
    return figure, panels[:count], panels[count:]


def curve_table(
    rows: Rows, column: str, name: str, most: int = 300
) -> tuple[np.ndarray, np.ndarray]:
    """Return a column of the progress log as a table over steps and seeds.

    Args:
        rows: rows of the progress log.
        column: the column of the horizontal axis.
        name: the column of the values.
        most: the largest number of points. More are thinned out.

    Returns:
        The values of `column`, shape (points,), and those of `name`, shape (points, seeds). A value
        that is missing is NaN.
    """
    steps = sorted({row["step"] for row in rows})
    kept = np.linspace(0, len(steps) - 1, min(most, len(steps))).astype(int)
    steps = sorted({steps[i] for i in kept})
    seed_index = {seed: i for i, seed in enumerate(sorted({row["seed"] for row in rows}))}
    point_index = {step: i for i, step in enumerate(steps)}
    at = np.zeros(len(steps))
    values = np.full((len(steps), len(seed_index)), np.nan)
    for row in rows:
        if row["step"] in point_index:
            point = point_index[row["step"]]
            at[point] = row[column]
            value = row.get(name)
            values[point, seed_index[row["seed"]]] = np.nan if value is None else value
    return at, values


def _draw_line(panel: Axes, at: np.ndarray, values: np.ndarray, sure: Any, **look: Any) -> None:
    """Draw a line that is dotted until enough episodes have ended."""
    known = ~np.isnan(values)
    at = at[known]
    values = values[known]
    begin = int(np.argmax(sure[known])) if sure[known].any() else len(at)
    if begin:
        dotted: dict[str, Any] = look | {"linestyle": ":"}
        panel.plot(at[: begin + 1], values[: begin + 1], **dotted)
    panel.plot(at[begin:], values[begin:], **look)


def _look(leads: bool, evaluated: bool, main: bool) -> dict[str, Any]:
    """Return the look of a line.

    Args:
        leads: whether it is the main curve.
        evaluated: whether it shows evaluations.
        main: whether there are enough evaluations for a line.
    """
    look: dict[str, Any] = {"linewidth": 1.6} if leads else {"linewidth": 1.0, "alpha": 0.7}
    if evaluated:
        look |= MARKERS | {"alpha": 1.0}
        look |= {} if main else {"linestyle": "none"}
    return look


def _knows(row: Mapping[str, Any], curve: tuple[str, str, float]) -> bool:
    return row.get(curve[0]) is not None


def _mean(values: Collection[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _mean_share(episodes: Sequence[Mapping[str, Any]], name: str) -> float | None:
    """Return the mean over episodes of the share of their steps that a column counts."""
    counts = [(episode.get(name), episode["length"]) for episode in episodes]
    return _mean([None if count is None else count / max(length, 1) for count, length in counts])
