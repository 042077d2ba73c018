"""A figure of one episode: where the agent flew, and distance, controls and margins over time."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from jaxsafe.environment import Environment, control_unit, length_unit
from jaxsafe.plot.style import (
    AMBER,
    BLUE,
    FORBIDDEN,
    GREEN,
    ORANGE,
    PATH_BEHIND,
    PURPLE,
    SKY,
    Ball,
    NotebookFigure,
    along,
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
    within,
)
from jaxsafe.types import State, TimeStep

COLOURS = (BLUE, ORANGE, GREEN, PURPLE)
"""Colours of several curves in a panel."""

CRAFT_COLOURS = ("black", PURPLE, AMBER, SKY)
"""Colours of the platforms that are not the agent."""

MAP_WIDTH = 3.8
"""Width of a panel of the path in inches."""

NAMES_PER_MAP = 3
"""Number of names of a legend that fit below a map."""

CURVES_WIDTH = 4.6
"""Width of the panels over time in inches."""


@styled
def flight_figure(
    env: Environment, episode: tuple[State, TimeStep], title: str, world: bool = False
) -> NotebookFigure:
    """Return a figure of one episode.

    The paths are relative to the first platform that is not the agent. If that platform has a
    heading, x is along it. If it moves, regions that stay in place are left out, and a dashed line
    shows where it came from, as seen from its end. Paths in space are drawn in space and from
    above.

    Args:
        env: the environment of the episode.
        episode: states and time steps from the start to the end, [steps + 1].
        title: the title, to which the outcome is added.
        world: whether paths are drawn in the axes of the world instead. Regions are then where they
            are at the end.
    """
    states, timesteps = episode
    origin = None if world else _first_other(env)
    views = [(0, 1)] if env.agent_platform.dimension < 3 else [(0, 1, 2), (0, 1)]
    widths = [MAP_WIDTH * len(views), CURVES_WIDTH]
    figure = NotebookFigure(figsize=(sum(widths), 4.2), layout="constrained")
    parts: Any = figure.subfigures(1, 2, width_ratios=widths)
    left, right = parts
    for number, view in enumerate(views, start=1):
        spatial = len(view) == 3
        panel = left.add_subplot(1, len(views), number, projection="3d" if spatial else None)
        _draw_path(panel, view, env, states, origin)
    handles, names = left.axes[-1].get_legend_handles_labels()
    columns = min(len(names), NAMES_PER_MAP * len(views))
    left.legend(handles, names, loc="outside lower center", ncols=columns)
    distance, controls, margins = right.subplots(3, 1, sharex=True)
    times = np.asarray(states.sim.time)
    path = _path(states, env.agent, _first_other(env))
    distance.plot(times, np.linalg.norm(path, axis=1), color=BLUE, linewidth=1.4)
    name = f"distance to\nthe {plain(_first_other(env) or 'origin')}"
    distance.set(ylabel=labelled(name, length_unit(env)), ylim=(0.0, None))
    _draw_controls(controls, env, timesteps, times)
    _draw_margins(margins, env, timesteps, times)
    margins.set(xlabel="time [s]", xlim=(0.0, times[-1] or 1.0))
    right.align_ylabels([distance, controls, margins])
    outcome = plain(env.outcomes[int(timesteps.info.outcome[-1])])
    figure.suptitle(fitted(f"{plain(title)}: {outcome} after {len(times) - 1:,} steps", figure))
    return figure


def _first_other(env: Environment) -> str | None:
    """Return the name of the first platform that is not the agent."""
    return next((platform.name for platform in env.platforms if platform.name != env.agent), None)


def _moves(states: State, name: str | None) -> bool:
    """Return whether a platform changes its place."""
    return name is not None and bool(np.ptp(states.sim.platforms[name].position, axis=0).any())


def _heads(states: State, origin: str | None) -> str | None:
    """Return the name of the platform along whose heading x is, or None."""
    return origin if origin and "heading" in vars(states.sim.platforms[origin]) else None


def _path(states: State, of: str, origin: str | None) -> np.ndarray:
    """Return the positions of a platform or region, shape (steps, d).

    They are as seen from the platform `origin`, or those of the world if it is None.
    """
    sim = states.sim
    place = sim.platforms[of] if of in sim.platforms else sim.regions[of]
    path = in_plane(np.array(place.position, float))
    if origin is None:
        return path
    path -= in_plane(np.array(sim.platforms[origin].position, float))
    if _heads(states, origin):
        path = along(path, np.asarray(sim.platforms[origin].heading))
    return path


def _path_behind(states: State, name: str) -> np.ndarray:
    """Return where a platform has been, as seen from its end, shape (steps, d)."""
    platform = states.sim.platforms[name]
    path = in_plane(np.array(platform.position, float))
    path -= path[-1]
    return along(path, float(platform.heading[-1])) if _heads(states, name) else path


def _draw_path(
    panel: Any, view: tuple[int, ...], env: Environment, states: State, origin: str | None
) -> None:
    """Draw the paths in space, or in the plane of two axes, as seen from the platform `origin`."""
    axes = list(view)
    spatial = len(view) == 3
    forbidden = kept_out(env)
    heads = _heads(states, origin)
    for region in env.regions:
        if region.on is None and _moves(states, origin):
            continue  # it has no fixed position on a map that moves
        place = np.nan_to_num(_path(states, region.name, origin)[-1])
        if spatial:
            region_surface(panel, region, place, region.name in forbidden)
            continue
        patch = region_patch(region, False, region.name in forbidden, turned=heads is not None)
        panel.add_patch(patch)
        centre_patch(patch, place[axes])
        patch.set_label(plain(region.name))
    others = [platform.name for platform in env.platforms if platform.name != env.agent]
    for radius in keep_away_distances(env) if others else []:
        place = np.nan_to_num(_path(states, others[0], origin)[-1])
        if spatial:
            region_surface(panel, Ball(radius), place, forbidden=True)
        else:
            panel.add_patch(Circle(tuple(place[axes]), radius, label="too near", **FORBIDDEN))
    shown = [_path(states, env.agent, origin)]
    for name, colour in zip(others, cycle(CRAFT_COLOURS), strict=False):
        path = _path(states, name, origin)
        look = {"color": colour, "markersize": 7, "label": plain(name), "zorder": 1}
        marker = ">" if _heads(states, name) and name == origin else "*"
        if name != origin:
            shown.append(path)
            if _moves(states, name):
                marker = "o"
                look["markersize"] = 4
                panel.plot(*path[:, axes].T, color=colour, linewidth=1.0, linestyle="--", zorder=1)
        panel.plot(*path[-1:, axes].T, marker, **look)
    path = shown[0]
    panel.plot(*path[:, axes].T, color=BLUE, linewidth=1.4, label=plain(env.agent))
    panel.plot(*path[:1, axes].T, "o", color=BLUE, markersize=4)
    everywhere = np.concatenate(shown)
    if origin is None:
        low = np.nanmin(everywhere, axis=0)
        high = np.nanmax(everywhere, axis=0)
        centre = (low + high) / 2.0
        half = 0.55 * np.max(high - low) or 1.0
    else:
        centre = np.zeros(everywhere.shape[1])
        half = 1.1 * np.nanmax(np.abs(everywhere)) or 1.0
    if origin is not None and _moves(states, origin):
        behind = _path_behind(states, origin)
        behind = within(behind, half) if spatial else behind
        panel.plot(*behind[:, axes].T, label=f"path of the {plain(origin)}", **PATH_BEHIND)
    set_frame(panel, view, frame_labels(heads, length_unit(env)), half, centre)


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
