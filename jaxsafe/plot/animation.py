"""An episode as an animated GIF, for any environment: where the agent is, how far, and how safe."""

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

FRAMES = 80
"""At most; longer episodes leave steps out."""

PAUSE_MS, LAST_MS = 75, 1500
"""How long a frame stays, and the last one."""

TICKS = 4
"""Intervals between numbers at an axis of the map, at most."""


def animate(env: Environment, episode: tuple[State, TimeStep], path: Path, title: str) -> Path:
    """Write an episode as a GIF file that repeats.

    Args:
        env: the environment of the episode.
        episode: states and time steps from the start to the end, [steps + 1].
        path: of the file.
        title: what to write above it; time and outcome are added.
    """
    states, timesteps = episode
    scene = Scene(env, states.sim, timesteps.info.margins, title)
    last = len(states.sim.time) - 1
    steps = np.unique(np.linspace(0, last, min(FRAMES, last + 1)).round().astype(int))
    images = [Image.fromarray(scene.draw(step)) for step in steps]
    palette = images[-1].quantize(128)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    pauses = [PAUSE_MS] * (len(images) - 1) + [LAST_MS]
    buffer = io.BytesIO()
    images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=pauses, loop=0, optimize=True)
    write_bytes(path, buffer.getvalue())
    return path


class Scene:
    """The picture of one step: the paths of all platforms as seen from the first, and two curves over time."""

    def __init__(self, env: Environment, sim: Sim, margins: Mapping[str, Any], title: str) -> None:
        """Draw what does not move; every field [steps]."""
        self.env, self.sim, self.margins, self.title = env, sim, margins, plain(title)
        others = [platform.name for platform in env.platforms if platform.name != env.agent]
        origin = sim.platforms[others[0] if others else env.agent].position
        self.origin = origin if others else np.zeros_like(origin)
        self.paths = {name: one.position - self.origin for name, one in sim.platforms.items()}
        self.planes = [(0, 1)] if origin.shape[1] == 2 else [(0, 1), (0, 2)]
        self.figure = Figure(figsize=(4.0 * len(self.planes) + 3.6, 4.2), dpi=80, layout="constrained")
        FigureCanvasAgg(self.figure)
        parts: Any = self.figure.subfigures(1, 2, width_ratios=[4.0 * len(self.planes), 3.6])
        left, right = parts
        self.maps = np.atleast_1d(left.subplots(1, len(self.planes)))
        self.curves = right.subplots(2, 1, sharex=True)
        self.heading = self.figure.suptitle(self.title, fontsize="medium")
        self._draw_maps()
        self._draw_curves(self.paths[env.agent])
        self.draw(max(range(len(self.sim.time)), key=self._width))
        self.figure.set_layout_engine("none")  # or the panels would jump with the width of their numbers

    def draw(self, step: int) -> np.ndarray:
        """The picture of a step, red, green and blue in 8 bits: (height, width, 3)."""
        sim = self.sim
        ended = [name for name, flag in sim.ended.items() if flag[step]]
        self.heading.set_text(f"{self.title}: {sim.time[step]:.0f} s, {plain(ended[0]) if ended else 'running'}")
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
        """Half the width of the map: all platforms and regions are on it, and it closes in with the agent."""
        centres = [np.abs(one.position - self.origin)[step].max() for one in self.sim.regions.values()]
        sizes = [float(getattr(region, "radius", 0.0)) for region in self.env.regions]
        near = max([1.5 * (centre + size) for centre, size in zip(centres, sizes, strict=True)], default=0.0)
        return max(near, 1.2 * max(np.abs(path[step]).max() for path in self.paths.values()), 1e-6)

    def _width(self, step: int) -> int:
        """Characters of the numbers at the axes of the map."""
        ticks = MaxNLocator(TICKS).tick_values(-self._reach(step), self._reach(step))
        return max(len(f"{tick:.10g}") for tick in ticks)

    def _draw_maps(self) -> None:
        unit, forbidden = length_unit(self.env), kept_out(self.env)
        seen_from = next((platform.name for platform in self.env.platforms if platform.name != self.env.agent), None)
        self._axes = {name: _axis(one) for name, one in self.sim.platforms.items()}
        self.moving: list[dict[str, dict[str, Any]]] = []
        for panel, (i, j) in zip(self.maps, self.planes, strict=True):
            panel.set(xlabel=labelled("xyz"[i], unit), ylabel=labelled("xyz"[j], unit), aspect="equal")
            panel.xaxis.set_major_locator(MaxNLocator(TICKS))
            panel.yaxis.set_major_locator(MaxNLocator(TICKS))
            artists: dict[str, dict[str, Any]] = {"platforms": {}, "regions": {}}
            for region in self.env.regions:
                artists["regions"][region.name] = panel.add_patch(region_patch(region, j == 2, region.name in forbidden))
                artists["regions"][region.name].set_label(plain(region.name))
            for radius in self._kept_away():
                panel.add_patch(Circle((0.0, 0.0), radius, color=ORANGE, alpha=0.35, linewidth=0, label="too near"))
            for name in self.paths:
                colour = BLUE if name == self.env.agent else GREY
                trail, axis = (panel.plot([], [], color=colour, linewidth=width)[0] for width in (1.2, 2.4))
                dot = panel.plot([], [], "o", color=colour, markersize=6, label=plain(name))[0]
                artists["platforms"][name] = (trail, dot, axis)
            self.moving.append(artists)
        self.maps[0].legend(loc="upper left", fontsize="x-small", frameon=False)
        if seen_from:
            self.maps[0].set_title(plain(f"seen from the {seen_from}"), fontsize="small")

    def _kept_away(self) -> list[float]:
        """Radii within which the agent must not come near the platform that it is seen from."""
        near = {one.name for one in self.env.status if isinstance(one, Distance) and self.env.agent in (one.of, one.to)}
        return [float(one.minimum) for one in self.env.constraints if isinstance(one, Separation) and one.distance in near]

    def _draw_curves(self, path: np.ndarray) -> None:
        unit, time = length_unit(self.env), self.sim.time
        distance = np.linalg.norm(path, axis=1)
        above, below = self.curves
        above.set(yscale="log", ylabel=labelled("distance", unit))
        above.set(xlim=(0, time[-1] or 1.0), ylim=(0.7 * max(distance.min(), 1e-3), 1.4 * distance.max() + 1e-3))
        if np.ptp(np.log10(above.get_ylim())) > 1.0:  # a power of ten is among them, and others would crowd
            above.yaxis.set_minor_formatter(NullFormatter())
        below.axhline(0.0, color="black", linewidth=0.8)
        below.set(xlabel="time [s]", xlim=(0, time[-1] or 1.0))
        self.lines = [(above.plot([], [], color=BLUE, linewidth=1.4)[0], (time, distance))]
        for colour, (name, margin) in zip(cycle((GREEN, ORANGE, GREY, BLUE)), self.margins.items(), strict=False):
            line = below.plot([], [], color=colour, linewidth=1.4, label=plain(name))[0]
            self.lines.append((line, (time, margin)))
        if self.margins:
            kinds = {margin_unit(constraint, unit) for constraint in self.env.constraints}
            below.set_ylabel(labelled("margin h", kinds.pop() if len(kinds) == 1 else None))
            values = np.concatenate([*self.margins.values()])
            low, high = np.nanmin(values, initial=0.0), np.nanmax(values, initial=0.0)
            below.set_ylim(low - 0.08 * (high - low) - 1e-3, high + 0.08 * (high - low) + 1e-3)
            below.axhspan(below.get_ylim()[0], 0.0, color=ORANGE, alpha=0.15, linewidth=0)
            below.legend(loc="best", fontsize="x-small", frameon=False)


def _axis(platform: Any) -> np.ndarray:
    """The direction in which a platform points, or else moves, (steps, d); 0 for one that rests."""
    if {"attitude", "heading"} & vars(platform).keys():
        return np.asarray(jax.vmap(lambda one: one.orientation[:, 0])(platform))
    velocity = np.asarray(platform.velocity)
    return velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
