"""An episode of any environment as an animated GIF.

It shows where the agent is, how far from the other platform, and how safe.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator, NullFormatter
from PIL import Image

from jaxsafe.environment import Environment
from jaxsafe.plot.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    centre_patch,
    kept_out,
    labelled,
    length_unit,
    margin_unit,
    plain,
    region_patch,
)
from jaxsafe.processors.constraint import Separation
from jaxsafe.processors.status import Distance
from jaxsafe.storage.files import write_bytes
from jaxsafe.types import Sim, State, TimeStep

MAX_FRAMES = 80
"""Largest number of frames. In longer episodes steps are left out."""

FRAME_MS = 75
"""Duration of a frame."""

LAST_FRAME_MS = 1500
"""Duration of the last frame, before the animation repeats."""

MAX_TICK_INTERVALS = 4
"""Largest number of intervals between the numbers at an axis of the map."""


def animate(env: Environment, episode: tuple[State, TimeStep], path: Path, title: str) -> Path:
    """Write an episode as a GIF file that repeats.

    Args:
        env: the environment of the episode.
        episode: states and time steps from the start to the end, [steps + 1].
        path: the path of the file.
        title: the title, to which time and outcome are added.
    """
    states, timesteps = episode
    scene = Scene(env, sim=states.sim, margins=timesteps.info.margins, title=title)
    last = len(states.sim.time) - 1
    steps = np.unique(np.linspace(0, last, min(MAX_FRAMES, last + 1)).round().astype(int))
    images = [Image.fromarray(scene.draw(step)) for step in steps]
    palette = images[-1].quantize(128)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    buffer = io.BytesIO()
    images[0].save(
        buffer,
        "GIF",
        save_all=True,
        append_images=images[1:],
        duration=[FRAME_MS] * (len(images) - 1) + [LAST_FRAME_MS],
        loop=0,
        optimize=True,
    )
    write_bytes(path, buffer.getvalue())
    return path


class Scene:
    """Picture of one step: the paths of all platforms, and two curves over time.

    The paths are seen from the first platform that is not the agent.
    """

    def __init__(self, env: Environment, sim: Sim, margins: Mapping[str, Any], title: str) -> None:
        """Draw everything that does not move.

        Args:
            env: the environment of the episode.
            sim: the simulation at all steps. Every field has the shape [steps].
            margins: h of each constraint, shape [steps].
            title: the title.
        """
        self.env = env
        self.sim = sim
        self.margins = margins
        self.title = plain(title)
        others = [platform.name for platform in env.platforms if platform.name != env.agent]
        origin = sim.platforms[others[0] if others else env.agent].position
        self.origin = origin if others else np.zeros_like(origin)
        self.paths = {name: state.position - self.origin for name, state in sim.platforms.items()}
        self.planes = [(0, 1)] if origin.shape[1] == 2 else [(0, 1), (0, 2)]
        self.figure = Figure(
            figsize=(4.0 * len(self.planes) + 3.6, 4.2), dpi=80, layout="constrained"
        )
        FigureCanvasAgg(self.figure)
        parts: Any = self.figure.subfigures(1, 2, width_ratios=[4.0 * len(self.planes), 3.6])
        left, right = parts
        self.maps = np.atleast_1d(left.subplots(1, len(self.planes)))
        self.curves = right.subplots(2, 1, sharex=True)
        self.heading = self.figure.suptitle(self.title, fontsize="medium")
        self._draw_maps()
        self._draw_curves(self.paths[env.agent])
        self.draw(max(range(len(self.sim.time)), key=self._width))
        # The layout is fixed at the step with the widest numbers. Otherwise the panels would jump.
        self.figure.set_layout_engine("none")

    def draw(self, step: int) -> np.ndarray:
        """Return the picture of a step in 8-bit red, green and blue, shape (height, width, 3)."""
        sim = self.sim
        ended = [name for name, flag in sim.ended.items() if flag[step]]
        self.heading.set_text(
            f"{self.title}: {sim.time[step]:.0f} s, {plain(ended[0]) if ended else 'running'}"
        )
        reach = self._reach(step)
        for panel, plane, artists in zip(self.maps, self.planes, self.moving, strict=True):
            for name, (trail, dot, axis) in artists["platforms"].items():
                path = self.paths[name][:, plane]
                trail.set_data(*path[: step + 1].T)
                dot.set_data(*path[step : step + 1].T)
                end = path[step] + 0.12 * reach * self._axes[name][step, plane]
                axis.set_data(*np.stack([path[step], end], axis=1))
            for region, patch in artists["regions"].items():
                centre_patch(patch, (sim.regions[region].position - self.origin)[step][list(plane)])
            panel.set(xlim=(-reach, reach), ylim=(-reach, reach))
        for line, (at, values) in self.lines:
            line.set_data(at[: step + 1], values[: step + 1])
        canvas: Any = self.figure.canvas
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def _reach(self, step: int) -> float:
        """Return half the width of the map.

        All platforms and regions are on it, and it closes in with the agent.
        """
        regions = self.sim.regions.values()
        centres = [np.abs(region.position - self.origin)[step].max() for region in regions]
        radii = [float(getattr(region, "radius", 0.0)) for region in self.env.regions]
        reaches = [1.5 * (centre + radius) for centre, radius in zip(centres, radii, strict=True)]
        farthest_platform = max(np.abs(path[step]).max() for path in self.paths.values())
        return max(max(reaches, default=0.0), 1.2 * farthest_platform, 1e-6)

    def _width(self, step: int) -> int:
        """Return the number of characters of the longest number at the axes of the map."""
        reach = self._reach(step)
        ticks = MaxNLocator(MAX_TICK_INTERVALS).tick_values(-reach, reach)
        return max(len(f"{tick:.10g}") for tick in ticks)

    def _draw_maps(self) -> None:
        unit = length_unit(self.env)
        forbidden = kept_out(self.env)
        platforms = [platform.name for platform in self.env.platforms]
        others = [name for name in platforms if name != self.env.agent]
        self._axes = {name: _axis(state) for name, state in self.sim.platforms.items()}
        self.moving: list[dict[str, dict[str, Any]]] = []
        for panel, (i, j) in zip(self.maps, self.planes, strict=True):
            panel.set(
                xlabel=labelled("xyz"[i], unit), ylabel=labelled("xyz"[j], unit), aspect="equal"
            )
            panel.xaxis.set_major_locator(MaxNLocator(MAX_TICK_INTERVALS))
            panel.yaxis.set_major_locator(MaxNLocator(MAX_TICK_INTERVALS))
            artists: dict[str, dict[str, Any]] = {"platforms": {}, "regions": {}}
            for region in self.env.regions:
                patch = region_patch(region, j == 2, region.name in forbidden)
                artists["regions"][region.name] = panel.add_patch(patch)
                artists["regions"][region.name].set_label(plain(region.name))
            for radius in self._kept_away():
                look = {"color": ORANGE, "alpha": 0.35, "linewidth": 0}
                panel.add_patch(Circle((0.0, 0.0), radius, label="too near", **look))
            for name in self.paths:
                colour = BLUE if name == self.env.agent else GREY
                trail = panel.plot([], [], color=colour, linewidth=1.2)[0]
                axis = panel.plot([], [], color=colour, linewidth=2.4)[0]
                dot = panel.plot([], [], "o", color=colour, markersize=6, label=plain(name))[0]
                artists["platforms"][name] = (trail, dot, axis)
            self.moving.append(artists)
        self.maps[0].legend(loc="upper left", fontsize="x-small", frameon=False)
        if others:
            self.maps[0].set_title(plain(f"seen from the {others[0]}"), fontsize="small")

    def _kept_away(self) -> list[float]:
        """Return the distances to the other platforms that the agent must not go below."""
        own_distances = {
            status.name
            for status in self.env.status
            if isinstance(status, Distance) and self.env.agent in (status.of, status.to)
        }
        return [
            float(constraint.minimum)
            for constraint in self.env.constraints
            if isinstance(constraint, Separation) and constraint.distance in own_distances
        ]

    def _draw_curves(self, path: np.ndarray) -> None:
        unit = length_unit(self.env)
        time = self.sim.time
        distance = np.linalg.norm(path, axis=1)
        above, below = self.curves
        above.set(yscale="log", ylabel=labelled("distance", unit))
        above.set(
            xlim=(0, time[-1] or 1.0),
            ylim=(0.7 * max(distance.min(), 1e-3), 1.4 * distance.max() + 1e-3),
        )
        if np.ptp(np.log10(above.get_ylim())) > 1.0:
            # A power of ten is in the range and is labelled. More numbers would be too close to
            # each other.
            above.yaxis.set_minor_formatter(NullFormatter())
        below.axhline(0.0, color="black", linewidth=0.8)
        below.set(xlabel="time [s]", xlim=(0, time[-1] or 1.0))
        self.lines = [(above.plot([], [], color=BLUE, linewidth=1.4)[0], (time, distance))]
        colours = cycle((GREEN, ORANGE, GREY, BLUE))
        for colour, (name, margin) in zip(colours, self.margins.items(), strict=False):
            line = below.plot([], [], color=colour, linewidth=1.4, label=plain(name))[0]
            self.lines.append((line, (time, margin)))
        if self.margins:
            units = {margin_unit(constraint, unit) for constraint in self.env.constraints}
            below.set_ylabel(labelled("margin h", units.pop() if len(units) == 1 else None))
            values = np.concatenate([*self.margins.values()])
            low = np.nanmin(values, initial=0.0)
            high = np.nanmax(values, initial=0.0)
            below.set_ylim(low - 0.08 * (high - low) - 1e-3, high + 0.08 * (high - low) + 1e-3)
            below.axhspan(below.get_ylim()[0], 0.0, color=ORANGE, alpha=0.15, linewidth=0)
            below.legend(loc="best", fontsize="x-small", frameon=False)


def _axis(platform: Any) -> np.ndarray:
    """Return the direction in which a platform points, or else moves, shape (steps, d).

    It is 0 for a platform that rests.
    """
    if {"attitude", "heading"} & vars(platform).keys():
        return np.asarray(jax.vmap(lambda state: state.orientation[:, 0])(platform))
    velocity = np.asarray(platform.velocity)
    return velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
