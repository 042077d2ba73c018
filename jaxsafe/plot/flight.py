"""A figure of one episode: where the agent flew, and distance, controls and margins over time."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from jaxsafe.environment import Environment, control_unit, length_unit
from jaxsafe.plot.style import (
    BLUE,
    FORBIDDEN,
    GREEN,
    ORANGE,
    PURPLE,
    Ball,
    NotebookFigure,
    centre_patch,
    fitted,
    frame_labels,
    in_plane,
    keep_away_distances,
    kept_out,
    labelled,
    margin_unit,
    plain,
    region_patch,
    region_surface,
    set_frame,
    styled,
)
from jaxsafe.types import State, TimeStep

COLOURS = (BLUE, ORANGE, GREEN, PURPLE)
"""Colours of several curves in a panel."""

MAP_WIDTH = 3.8
"""Width of a panel of the path in inches."""

CURVES_WIDTH = 4.6
"""Width of the panels over time in inches."""


@styled
def flight_figure(env: Environment, episode: tuple[State, TimeStep], title: str) -> NotebookFigure:
    """Return a figure of one episode.

    The path is relative to the first platform that is not the agent. If that platform has a
    heading, x is along it. If it moves, regions that stay in place are left out. A path in space is
    drawn in space and from above.

    Args:
        env: the environment of the episode.
        episode: states and time steps from the start to the end, [steps + 1].
        title: the title, to which the outcome is added.
    """
    states, timesteps = episode
    views = [(0, 1)] if env.agent_platform.dimension < 3 else [(0, 1, 2), (0, 1)]
    widths = [MAP_WIDTH * len(views), CURVES_WIDTH]
    figure = NotebookFigure(figsize=(sum(widths), 4.2), layout="constrained")
    parts: Any = figure.subfigures(1, 2, width_ratios=widths)
    left, right = parts
    for number, view in enumerate(views, start=1):
        spatial = len(view) == 3
        panel = left.add_subplot(1, len(views), number, projection="3d" if spatial else None)
        _draw_path(panel, view, env, states)
    handles, names = left.axes[-1].get_legend_handles_labels()
    left.legend(handles, names, loc="outside lower center", ncols=len(names))
    distance, controls, margins = right.subplots(3, 1, sharex=True)
    times = np.asarray(states.sim.time)
    path = _relative_path(env, states, env.agent)
    distance.plot(times, np.linalg.norm(path, axis=1), color=BLUE, linewidth=1.4)
    name = f"distance to\nthe {plain(_origin(env) or 'origin')}"
    distance.set(ylabel=labelled(name, length_unit(env)), ylim=(0.0, None))
    _draw_controls(controls, env, timesteps, times)
    _draw_margins(margins, env, timesteps, times)
    margins.set(xlabel="time [s]", xlim=(0.0, times[-1] or 1.0))
    right.align_ylabels([distance, controls, margins])
    outcome = plain(env.outcomes[int(timesteps.info.outcome[-1])])
    figure.suptitle(fitted(f"{plain(title)}: {outcome} after {len(times) - 1:,} steps", figure))
    return figure


def _origin(env: Environment) -> str | None:
    """Return the name of the first platform that is not the agent."""
    others = [platform.name for platform in env.platforms if platform.name != env.agent]
    return others[0] if others else None


def _origin_moves(env: Environment, states: State) -> bool:
    """Return whether the first platform that is not the agent changes its place."""
    origin = _origin(env)
    return origin is not None and bool(np.ptp(states.sim.platforms[origin].position, axis=0).any())


def _heads(env: Environment, states: State) -> str | None:
    """Return the name of the platform along whose heading x is, or None."""
    origin = _origin(env)
    return origin if origin and "heading" in vars(states.sim.platforms[origin]) else None


def _relative_path(env: Environment, states: State, of: str) -> np.ndarray:
    """Return the positions of a platform or region as seen from `_origin`, shape (steps, d)."""
    sim = states.sim
    place = sim.platforms[of] if of in sim.platforms else sim.regions[of]
    path = in_plane(np.array(place.position, float))
    origin = _origin(env)
    if origin is None:
        return path
    path -= in_plane(np.array(sim.platforms[origin].position, float))
    if _heads(env, states):
        heading = sim.platforms[origin].heading
        x = np.cos(heading) * path[:, 0] + np.sin(heading) * path[:, 1]
        path[:, 1] = np.cos(heading) * path[:, 1] - np.sin(heading) * path[:, 0]
        path[:, 0] = x
    return path


def _draw_path(panel: Any, view: tuple[int, ...], env: Environment, states: State) -> None:
    """Draw the path in space, or in the plane of two axes."""
    axes = list(view)
    spatial = len(view) == 3
    forbidden = kept_out(env)
    for region in env.regions:
        if region.on is None and _origin_moves(env, states):
            continue  # it has no fixed position on a map that moves
        place = np.nan_to_num(_relative_path(env, states, region.name)[-1])
        if spatial:
            region_surface(panel, region, place, region.name in forbidden)
            continue
        turned = _heads(env, states) is not None
        patch = panel.add_patch(region_patch(region, False, region.name in forbidden, turned))
        centre_patch(patch, place[axes])
        patch.set_label(plain(region.name))
    for radius in keep_away_distances(env):
        if spatial:
            region_surface(panel, Ball(radius), np.zeros(3), forbidden=True)
        else:
            panel.add_patch(Circle((0.0, 0.0), radius, label="too near", **FORBIDDEN))
    heads = _heads(env, states)
    if origin := _origin(env):
        look = {"color": "black", "markersize": 7, "label": plain(origin), "zorder": 1}
        panel.plot(*np.zeros((len(view), 1)), ">" if heads else "*", **look)
    path = _relative_path(env, states, env.agent)
    panel.plot(*path[:, axes].T, color=BLUE, linewidth=1.4, label=plain(env.agent))
    panel.plot(*path[:1, axes].T, "o", color=BLUE, markersize=4)
    half = 1.1 * np.nanmax(np.abs(path)) or 1.0
    set_frame(panel, view, frame_labels(heads, length_unit(env)), half)


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
    panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


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
        panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
