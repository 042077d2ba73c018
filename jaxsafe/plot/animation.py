"""An episode of any environment as a film, or as pictures while it goes on.

It shows where the agent is, what its thrusters do, how far it is from the other platform, and how
safe it is.
"""

from __future__ import annotations

import io
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import NullFormatter
from PIL import Image

from jaxsafe.environment import Environment, length_unit
from jaxsafe.plot.style import (
    AMBER,
    BLUE,
    FORBIDDEN,
    GOAL,
    GREEN,
    GREY,
    ORANGE,
    PATH_BEHIND,
    Ball,
    centre_patch,
    frame_labels,
    in_plane,
    keep_away_distances,
    kept_out,
    labelled,
    margin_unit,
    nice,
    plain,
    region_patch,
    region_surface,
    set_frame,
    styled,
    within,
)
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import write_bytes
from jaxsafe.types import Info, Sim, State, TimeStep

MAX_FRAMES = 80
"""Largest number of frames. In longer episodes steps are left out."""

FRAME_MS = 75
"""Duration of a frame."""

LAST_FRAME_MS = 1500
"""Duration of the last frame, before the animation repeats."""

SIZE = (8.6, 4.6)
"""Width and height of a picture in inches."""

DOTS_PER_INCH = 100

PLACES = {"map": (0.1, 0.2, 0.39, 0.69), "space": (0.0, 0.13, 0.54, 0.81)}
"""Places of the map and of the view in space: left, bottom, width and height."""

CURVE_PLACES = ((0.64, 0.58, 0.34, 0.31), (0.64, 0.2, 0.34, 0.31))
"""Places of the two curves."""

MAX_ROOM = 2.5
"""How many times larger than needed the map may be before it closes in."""

FIRST_STEPS = 50
"""Number of steps that the curves of an episode have room for at first."""

MIN_DISTANCE = 1e-3
"""Smallest distance on the logarithmic axis."""

MIN_ROOM = 0.05
"""Smallest gap between the values and the ends of an axis.

It is in the unit of the axis, or on a logarithmic axis in powers of ten.
"""

ARROW = 0.4
"""Length of the arrow of full thrust, as a share of half the width of the map."""


def animate(env: Environment, episode: tuple[State, TimeStep], path: Path, title: str) -> Path:
    """Write an episode as a film.

    Args:
        env: the environment of the episode.
        episode: states and time steps from the start to the end, [steps + 1].
        path: the path of the file. Its ending is `.gif` or `.mp4`.
        title: the title, to which time and outcome are added.

    Raises:
        ConfigError: the film is an mp4, and ffmpeg is missing or fails.
    """
    states, timesteps = episode
    scene = Scene(env, title)
    last = len(states.sim.time) - 1
    for step in range(last + 1):
        sim, info = jax.tree.map(lambda x, step=step: x[step], (states.sim, timesteps.info))
        scene.add(sim, info)
    steps = np.unique(np.linspace(0, last, min(MAX_FRAMES, last + 1)).round().astype(int))
    frames = (scene.draw(step) for step in steps)
    write_bytes(path, _mp4(frames) if path.suffix == ".mp4" else _gif(frames))
    return path


def require_ffmpeg() -> str:
    """Return the path of ffmpeg.

    Raises:
        ConfigError: there is none.
    """
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        raise ConfigError("render: mp4 needs the program ffmpeg, which is not on the PATH; use gif")
    return ffmpeg


def _gif(frames: Iterator[np.ndarray]) -> bytes:
    """Return a GIF file that repeats."""
    images = [Image.fromarray(frame) for frame in frames]
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
    return buffer.getvalue()


def _mp4(frames: Iterator[np.ndarray]) -> bytes:
    """Return an mp4 file, made by ffmpeg."""
    images = list(frames)
    images += images[-1:] * (LAST_FRAME_MS // FRAME_MS)
    height, width, _ = images[0].shape
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {1000 / FRAME_MS:.6g} -i -"
    # Only a fragmented file can be written to a pipe, because ffmpeg cannot go back in a pipe.
    target = "-pix_fmt yuv420p -movflags frag_keyframe+empty_moov -f mp4 -"
    command = [require_ffmpeg(), "-v", "error", *source.split(), *target.split()]
    run = subprocess.run(command, input=b"".join(map(bytes, images)), capture_output=True)
    if run.returncode:
        lines = run.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
        raise ConfigError(f"render: ffmpeg failed: {lines[-1]}")
    return run.stdout


class Moment(NamedTuple):
    """What a picture shows of one step.

    Vectors are relative to the platform that the scene is seen from.
    """

    time: float  # [s]
    origin: np.ndarray  # where the scene is seen from, in the axes of the world
    turn: np.ndarray  # the rotation from the axes of the world into those of the picture
    places: Mapping[str, np.ndarray]  # the position of each platform and region
    directions: Mapping[str, np.ndarray]  # where each platform points, or else moves
    thrust: np.ndarray | None  # as a share of the largest thrust
    distance: float  # from the agent to the platform that the scene is seen from
    margins: Mapping[str, float]  # h of each constraint
    outcome: str


class Ends:
    """The lowest and the highest value so far, and the ends of an axis that shows them."""

    def __init__(self, low: float = np.inf, high: float = -np.inf) -> None:
        self._low = low
        self._high = high
        self._shown = (np.inf, -np.inf)

    def include(self, value: float) -> None:
        """Take a value into account. One that is not finite leaves a gap in the curve."""
        if np.isfinite(value):
            self._low = min(self._low, value)
            self._high = max(self._high, value)

    @property
    def fits(self) -> bool:
        """Whether the axis shows all values."""
        return self._shown[0] <= self._low and self._high <= self._shown[1]

    def widen(self, room: float, logarithmic: bool = False) -> tuple[float, float]:
        """Return the ends of the axis, moved if a value lies beyond them.

        Args:
            room: the room beyond a value at an end that moves, as a share of the range.
            logarithmic: whether the axis is logarithmic. All values are positive then.
        """
        if not self._low <= self._high:
            return (0.1, 1.0)  # no value is known
        low, high = np.log10((self._low, self._high)) if logarithmic else (self._low, self._high)
        more = max(room * (high - low), MIN_ROOM)
        ends = (low - more, high + more)
        ends = (10.0 ** ends[0], 10.0 ** ends[1]) if logarithmic else ends
        if self._low < self._shown[0]:
            self._shown = (float(ends[0]), self._shown[1])
        if self._high > self._shown[1]:
            self._shown = (self._shown[0], float(ends[1]))
        return self._shown


class Scene:
    """Picture of one step: the paths of all platforms, and two curves over time.

    All is seen from the first platform that is not the agent, along its heading if it has one. A
    dashed line shows where that platform came from, as seen from where it is. What stands still is
    drawn once, and again when an axis changes.
    """

    def __init__(self, env: Environment, title: str) -> None:
        """Draw what does not move.

        Args:
            env: the environment of the episode.
            title: the title.
        """
        self.env = env
        self.title = plain(title)
        self.moments: list[Moment] = []
        others = [platform.name for platform in env.platforms if platform.name != env.agent]
        self._origin = next(iter(others), None)
        rest = {platform.name: platform.rest() for platform in env.platforms}
        self._turned = self._origin is not None and "heading" in vars(rest[self._origin])
        self._spatial = len(rest[env.agent].position) == 3
        self._set_up()

    def clear(self) -> None:
        """Forget the episode."""
        self.moments.clear()
        self._reach = 0.0
        self._end = 0.0
        self._distances = Ends()
        self._margins = Ends(0.0, 0.0)
        self._background: Any = None

    def add(self, sim: Sim, info: Info) -> None:
        """Remember one step.

        Args:
            sim: the simulation after the step.
            info: the facts about the step.
        """
        origin, turn = self._frame(sim)
        directions = {name: in_plane(_direction(state)) for name, state in sim.platforms.items()}
        states = {**sim.regions, **sim.platforms}
        places = {name: turn @ (_place(state) - origin) for name, state in states.items()}
        distance = float(np.linalg.norm(places[self.env.agent]))
        self.moments.append(
            Moment(
                time=float(sim.time),
                origin=origin,
                turn=turn,
                places=places,
                directions={name: turn @ direction for name, direction in directions.items()},
                thrust=self._thrust(np.asarray(info.control_actual), directions[self.env.agent]),
                distance=distance,
                margins={name: float(margin) for name, margin in info.margins.items()},
                outcome=plain(self.env.outcomes[int(info.outcome)]),
            )
        )
        self._distances.include(max(distance, MIN_DISTANCE))
        for margin in info.margins.values():
            self._margins.include(float(margin))

    @styled
    def draw(self, step: int = -1) -> np.ndarray:
        """Return the picture of a step in 8-bit red, green and blue, shape (height, width, 3)."""
        step %= len(self.moments)
        past = self.moments[: step + 1]
        now = past[-1]
        canvas: Any = self.figure.canvas
        if self._fit(now):
            self._draw_background(now)
            canvas.draw()
            self._background = canvas.copy_from_bbox(self.figure.bbox)
        canvas.restore_region(self._background)
        self._move(past)
        for panel, artists in self._moving:
            for artist in artists:
                panel.draw_artist(artist)
        self._heading.set_text(f"{self.title}: {now.time:.0f} s, {now.outcome}")
        self.figure.draw_artist(self._heading)
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    def _frame(self, sim: Sim) -> tuple[np.ndarray, np.ndarray]:
        """Return the position that all is seen from, and the rotation into its axes."""
        dimension = 3 if self._spatial else 2
        if self._origin is None:
            return np.zeros(dimension), np.eye(dimension)
        platform = sim.platforms[self._origin]
        turn = np.eye(dimension)
        if self._turned:
            cosine = np.cos(platform.heading)
            sine = np.sin(platform.heading)
            turn[:2, :2] = [[cosine, sine], [-sine, cosine]]
        return _place(platform), turn

    def _thrust(self, control: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """Return the thrust as a share of the largest one, or None if the agent has no thruster."""
        thrust = np.zeros(len(direction))
        has_thruster = False
        for actuator, value in zip(self.env.actuators, control, strict=True):
            axis = {"thrust_x": 0, "thrust_y": 1, "thrust_z": 2}.get(actuator.name)
            largest = max(abs(float(actuator.low)), abs(float(actuator.high))) or 1.0
            if actuator.name == "thrust":
                thrust = thrust + direction * value / largest
            elif axis is not None and axis < len(thrust):
                thrust[axis] += value / largest
            has_thruster |= actuator.name == "thrust" or axis is not None
        return thrust if has_thruster else None

    @styled
    def _set_up(self) -> None:
        """Make the panels and everything in them."""
        self.figure = Figure(figsize=SIZE, dpi=DOTS_PER_INCH)
        FigureCanvasAgg(self.figure)
        kind = "space" if self._spatial else "map"
        self.map: Any = self.figure.add_axes(
            PLACES[kind], projection="3d" if self._spatial else None
        )
        self.curves: Any = [self.figure.add_axes(place) for place in CURVE_PLACES]
        self._heading = self.figure.suptitle(self.title, animated=True)
        self._moving: list[tuple[Any, list[Any]]] = []
        self._surfaces: list[Any] = []
        self._set_up_map()
        self._set_up_curves()
        self.clear()

    def _set_up_map(self) -> None:
        self._regions = {}
        self._trails = {}
        self._shadow = None
        entries: list[Any] = []
        forbidden = kept_out(self.env)
        for region in self.env.regions:
            look = FORBIDDEN if region.name in forbidden else GOAL
            entries.append(Patch(label=plain(region.name), **look))
            if not self._spatial:
                patch = region_patch(region, False, region.name in forbidden, self._turned)
                patch.set_animated(True)
                self._regions[region.name] = self.map.add_patch(patch)
        radii = keep_away_distances(self.env)
        for radius in radii:
            if self._spatial:
                region_surface(self.map, Ball(radius), np.zeros(3), forbidden=True)
            else:
                self.map.add_patch(Circle((0.0, 0.0), radius, **FORBIDDEN))
        if radii:
            entries.append(Patch(label="too near", **FORBIDDEN))
        if self._spatial:
            self._shadow = self._line(color=GREY, linewidth=1.0, alpha=0.5)
        for platform in self.env.platforms:
            name = platform.name
            colour = BLUE if name == self.env.agent else "black"
            look = PATH_BEHIND if name == self._origin else {"color": colour, "linewidth": 1.4}
            trail = self._line(**look)
            nose = self._line(color=colour, linewidth=2.6)
            dot = self._line(
                marker="o", linestyle="", color=colour, markersize=6, label=plain(name)
            )
            self._trails[name] = (trail, nose, dot)
            entries.append(dot)
            if name == self._origin and self._turned:
                trail.set_label(f"path of the {plain(name)}")
                entries.append(trail)
        self._arrow = self._line(color=AMBER, linewidth=2.2, label="thrust (length √thrust)")
        if self._thrust(np.zeros(len(self.env.actuators)), np.zeros(2)) is not None:
            entries.append(self._arrow)
        self.figure.legend(handles=entries, loc="lower left", ncols=len(entries))
        lines = [line for trail in self._trails.values() for line in trail]
        shadow = [] if self._shadow is None else [self._shadow]
        self._moving.append((self.map, [*self._regions.values(), *shadow, *lines, self._arrow]))

    def _line(self, **look: Any) -> Any:
        """Return a line or a dot of the map that moves."""
        nothing = np.zeros((3 if self._spatial else 2, 0))
        return self.map.plot(*nothing, animated=True, **look)[0]

    def _set_up_curves(self) -> None:
        unit = length_unit(self.env)
        above, below = self.curves
        origin = plain(self._origin)
        quantity = "distance" if self._origin is None else f"distance to\nthe {origin}"
        above.set(yscale="log", ylabel=labelled(quantity, unit))
        above.tick_params(labelbottom=False)
        below.set(xlabel="time [s]")
        below.axhline(0.0, color="black", linewidth=0.8)
        self._distance_line = above.plot([], [], color=BLUE, linewidth=1.6, animated=True)[0]
        self._margin_lines = {}
        colours = cycle((GREEN, ORANGE, GREY, BLUE))
        names = [constraint.name for constraint in self.env.constraints]
        for colour, name in zip(colours, names, strict=False):
            line = below.plot([], [], color=colour, linewidth=1.6, animated=True, label=plain(name))
            self._margin_lines[name] = line[0]
        units = {margin_unit(constraint, unit) for constraint in self.env.constraints}
        shared = units.pop() if len(units) == 1 else None
        if len(names) == 1:
            below.set_ylabel(labelled(f"h of\n{plain(names[0])}", shared))
        elif names:
            below.set_ylabel(labelled("margin h", shared))
            below.legend(loc="upper right")
        self._unsafe: Any = below.axhspan(-1.0, 0.0, color=ORANGE, alpha=0.15, linewidth=0)
        self._moving += [(above, [self._distance_line]), (below, [*self._margin_lines.values()])]

    def _fit(self, now: Moment) -> bool:
        """Change the axes if what they show does not fit. Return whether to draw them again."""
        first = self._background is None
        needed = self._needed_reach(now)
        reach = self._reach
        if not needed <= reach <= MAX_ROOM * needed:
            reach = nice(needed)
        end = self.moments[-1].time
        if end > self._end or first:
            room = FIRST_STEPS * float(self.env.dt) * self.env.decision_period
            # The end of a film is known from the start.
            end = end if first and end > room else max(room, 2.0 * end)
        else:
            end = self._end
        changed = first or (reach, end) != (self._reach, self._end)
        self._reach = reach
        self._end = end
        return changed or not (self._distances.fits and self._margins.fits)

    def _needed_reach(self, now: Moment) -> float:
        """Return half the width of a map that shows all platforms and regions."""
        platforms = [platform.name for platform in self.env.platforms]
        reaches = [1.2 * float(np.abs(now.places[name]).max()) for name in platforms]
        for region in self.env.regions:
            radius = float(getattr(region, "radius", 0.0))
            reaches.append(1.5 * (float(np.abs(now.places[region.name]).max()) + radius))
        finite = [reach for reach in reaches if np.isfinite(reach)]
        return max([*finite, 1e-6])

    def _draw_background(self, now: Moment) -> None:
        """Set the axes and everything that depends only on them."""
        labels = frame_labels(self._origin if self._turned else None, length_unit(self.env))
        set_frame(self.map, range(3 if self._spatial else 2), labels, self._reach)
        if self._spatial:
            for surface in self._surfaces:
                surface.remove()
            forbidden = kept_out(self.env)
            self._surfaces = [
                region_surface(self.map, region, now.places[region.name], region.name in forbidden)
                for region in self.env.regions
            ]
        above, below = self.curves
        first = self._background is None
        low, high = self._distances.widen(0.1 if first else 0.5, logarithmic=True)
        above.set(xlim=(0.0, self._end), ylim=(low, high))
        # With a power of ten in the range, more numbers would be too close to each other.
        if np.log10(high / low) > 1.0:
            above.yaxis.set_minor_formatter(NullFormatter())
        low, high = self._margins.widen(0.1 if first else 0.5)
        below.set(xlim=(0.0, self._end), ylim=(low, high))
        self._unsafe.set(y=low, height=-low)

    def _move(self, past: Sequence[Moment]) -> None:
        """Put everything that moves to where it is after the last of these steps."""
        now = past[-1]
        for name, (trail, nose, dot) in self._trails.items():
            if name == self._origin:
                path = np.stack([moment.origin for moment in past]) - now.origin
                path = path @ now.turn.T
            else:
                path = np.stack([moment.places[name] for moment in past])
            here = path[-1]
            if self._spatial:
                path = within(path, self._reach)
            _put(trail, path)
            _put(dot, here[None])
            tip = here + 0.12 * self._reach * now.directions[name]
            _put(nose, np.stack([here, tip]))
            if name == self.env.agent and self._shadow is not None:
                floor = path.copy()
                floor[:, 2] = -self._reach
                _put(self._shadow, floor)
        if now.thrust is not None:
            tail = now.places[self.env.agent]
            # Without the root, the small thrusts of a long flight would not be seen.
            share = np.sqrt(np.linalg.norm(now.thrust)) or 1.0
            _put(self._arrow, _arrow(tail, ARROW * self._reach * now.thrust / share))
        for name, patch in self._regions.items():
            centre_patch(patch, now.places[name])
        time = [moment.time for moment in past]
        self._distance_line.set_data(time, [moment.distance for moment in past])
        for name, line in self._margin_lines.items():
            line.set_data(time, [moment.margins[name] for moment in past])


def _put(line: Any, points: np.ndarray) -> None:
    """Set the points of a line, shape (points, 2 or 3)."""
    if points.shape[1] == 3:
        line.set_data_3d(*points.T)
    else:
        line.set_data(*points.T)


def _arrow(tail: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the points of an arrow as one line, shape (5, d)."""
    tip = tail + vector
    upright = np.array([0.0, 0.0, 1.0]) if len(vector) == 3 and vector[:2].any() else None
    if len(vector) == 2:
        across = np.array([-vector[1], vector[0]])
    else:
        across = np.cross(vector, np.array([1.0, 0.0, 0.0]) if upright is None else upright)
        across *= np.linalg.norm(vector) / max(float(np.linalg.norm(across)), 1e-12)
    barbs = [tip - 0.3 * vector + side * 0.18 * across for side in (1.0, -1.0)]
    return np.stack([tail, tip, barbs[0], tip, barbs[1]])


def _place(platform: Any) -> np.ndarray:
    """Return the position of a platform or region. On a line it gets y = 0."""
    return in_plane(np.asarray(platform.position))


def _direction(platform: Any) -> np.ndarray:
    """Return the direction in which a platform points, or else moves, shape (d,).

    It is 0 for a platform that rests.
    """
    if {"attitude", "heading"} & vars(platform).keys():
        return np.asarray(_forward(platform))
    velocity = np.asarray(platform.velocity)
    return velocity / max(float(np.linalg.norm(velocity)), 1e-9)


@jax.jit
def _forward(platform: Any) -> Any:
    """Return the first axis of a platform's body."""
    return platform.orientation[:, 0]
