"""A figure of one episode: where the agent flew, and distance, controls and margins over time."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxsafe.environment import Environment, control_unit, length_unit
from jaxsafe.plot.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    NotebookFigure,
    centre_patch,
    kept_out,
    labelled,
    margin_unit,
    plain,
    region_patch,
)
from jaxsafe.types import State, TimeStep

COLOURS = (BLUE, ORANGE, GREEN, GREY)
"""Colours of several curves in a panel."""


def flight_figure(env: Environment, episode: tuple[State, TimeStep], title: str) -> Figure:
    """Return a figure of one episode.

    The path is relative to the first platform that is not the agent. If that platform has a
    heading, x is along it. In space there is a second panel for the other plane.

    Args:
        env: the environment of the episode.
        episode: states and time steps from the start to the end, [steps + 1].
        title: the title, to which the outcome is added.
    """
    states, timesteps = episode
    planes = [(0, 1)] if env.agent_platform.dimension == 2 else [(0, 1), (0, 2)]
    figure = NotebookFigure(figsize=(4.4 * len(planes) + 5.4, 4.8), layout="constrained")
    parts: Any = figure.subfigures(1, 2, width_ratios=[4.4 * len(planes), 5.4])
    left, right = parts
    maps = np.atleast_1d(left.subplots(1, len(planes)))
    for panel, plane in zip(maps, planes, strict=True):
        _draw_path(panel, plane, env, states)
    if maps[0].get_legend_handles_labels()[0]:
        maps[0].legend(loc="best", fontsize="x-small", frameon=False)
    distance, controls, margins = right.subplots(3, 1, sharex=True)
    times = np.asarray(states.sim.time)
    unit = length_unit(env)
    path = _relative_path(env, states, env.agent)
    distance.plot(times, np.linalg.norm(path, axis=1), color=BLUE, linewidth=1.4)
    others = _others(env)
    name = f"distance to\nthe {plain(others[0])}" if others else "distance to\nthe origin"
    distance.set(ylabel=labelled(name, unit), ylim=(0.0, None))
    _draw_controls(controls, env, timesteps, times)
    _draw_margins(margins, env, timesteps, times)
    margins.set(xlabel="time [s]", xlim=(0.0, times[-1] or 1.0))
    right.align_ylabels([distance, controls, margins])
    outcome = env.outcomes[int(timesteps.info.outcome[-1])]
    figure.suptitle(
        f"{plain(title)}: {plain(outcome)} after {len(times) - 1:,} steps", fontsize="medium"
    )
    return figure


def _others(env: Environment) -> list[str]:
    return [platform.name for platform in env.platforms if platform.name != env.agent]


def _relative_path(env: Environment, states: State, of: str) -> np.ndarray:
    """Return the positions of a platform or region as seen from the first other platform."""
    sim = states.sim
    place = sim.platforms[of] if of in sim.platforms else sim.regions[of]
    path = np.array(place.position, float)
    if not _others(env):
        return path
    origin = sim.platforms[_others(env)[0]]
    path -= origin.position
    if "heading" in vars(origin):
        cosine = np.cos(origin.heading)
        sine = np.sin(origin.heading)
        x = cosine * path[:, 0] + sine * path[:, 1]
        path[:, 1] = cosine * path[:, 1] - sine * path[:, 0]
        path[:, 0] = x
    return path


def _draw_path(panel: Axes, plane: tuple[int, int], env: Environment, states: State) -> None:
    i, j = plane
    unit = length_unit(env)
    others = _others(env)
    forbidden = kept_out(env)
    for region in env.regions:
        patch = panel.add_patch(region_patch(region, j == 2, region.name in forbidden))
        centre_patch(patch, _relative_path(env, states, region.name)[-1, [i, j]])
        patch.set_label(plain(region.name))
    if others:
        panel.plot(0.0, 0.0, "*", color=ORANGE, markersize=8, label=plain(others[0]), zorder=1)
    path = _relative_path(env, states, env.agent)
    panel.plot(path[:, i], path[:, j], color=BLUE, linewidth=1.4, label=plain(env.agent))
    panel.plot(path[0, i], path[0, j], "o", color=BLUE, markersize=4)
    turned = bool(others) and "heading" in vars(states.sim.platforms[others[0]])
    along = f" along the heading of the {others[0]}" if turned else ""
    half = 1.1 * np.nanmax(np.abs(path)) or 1.0
    panel.set(
        xlabel=labelled(plain(f"x{along}"), unit),
        ylabel=labelled("xyz"[j], unit),
        xlim=(-half, half),
        ylim=(-half, half),
        aspect="equal",
    )
    panel.xaxis.set_major_locator(MaxNLocator(4))
    panel.yaxis.set_major_locator(MaxNLocator(4))


def _draw_controls(panel: Axes, env: Environment, timesteps: TimeStep, times: np.ndarray) -> None:
    """Draw the controls that acted, as shares of their bounds where these are known.

    Where run time assurance can change them, thin lines are what the policy asked for.
    """
    unit = length_unit(env)
    info = timesteps.info
    units = {control_unit(name, unit) for name in env.action_names}
    shared = units.pop() if len(units) == 1 else None
    scales = np.ones(env.action_size)
    if shared is None and env.actuators:
        scales = np.array([max(abs(float(a.low)), abs(float(a.high))) for a in env.actuators])
    for index, (name, colour) in enumerate(zip(env.action_names, cycle(COLOURS), strict=False)):
        values = info.control_actual[1:, index] / scales[index]
        panel.stairs(values, times, baseline=None, color=colour, linewidth=1.2, label=plain(name))
        if env.rta is not None:
            desired = info.control_desired[1:, index] / scales[index]
            panel.stairs(desired, times, baseline=None, color=colour, linewidth=0.5, alpha=0.6)
    panel.set_ylabel(labelled("controls", shared) if shared else "controls,\nshare of bound")
    panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="x-small", frameon=False)


def _draw_margins(panel: Axes, env: Environment, timesteps: TimeStep, times: np.ndarray) -> None:
    unit = length_unit(env)
    for constraint, colour in zip(env.constraints, cycle((GREEN, ORANGE, BLUE)), strict=False):
        margin = timesteps.info.margins[constraint.name]
        panel.plot(times, margin, color=colour, linewidth=1.4, label=plain(constraint.name))
    panel.axhline(0.0, color="black", linewidth=0.8)
    low, high = panel.get_ylim()
    panel.axhspan(min(low, -0.1 * (high - low)), 0.0, color=ORANGE, alpha=0.15, linewidth=0)
    units = {margin_unit(constraint, unit) for constraint in env.constraints}
    panel.set_ylabel(labelled("margin h", units.pop() if len(units) == 1 else None))
    if env.constraints:
        panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="x-small", frameon=False)
