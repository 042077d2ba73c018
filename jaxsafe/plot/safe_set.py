"""Where a filter certifies, on planes through the state space: `python -m jaxsafe.plot.safe_set env=rejoin2d`.

H(x) is the smallest h on the way of the best backup controller from x; without a horizon it is h(x) itself. A state is
certified where H(x) reaches the margin that the filter keeps. For docking the plane is distance against speed, for rejoin
the surroundings of the lead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxsafe.environment import Environment, reset_to
from jaxsafe.plot.style import GREY, ORANGE, labelled, length_unit, margin_unit, plain
from jaxsafe.rta.filter import CertifiedRTA
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.cwh import Spacecraft
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.transition import constraint
from jaxsafe.types import Sim

SKY, LOST = "#56B4E9", "#C9C9C9"
SHADES = LinearSegmentedColormap.from_list("shades", [ORANGE, "white", SKY]).with_extremes(bad=LOST)
CERTIFIED: dict[str, Any] = {"color": "black", "linewidth": 1.4}
BOUNDARY: dict[str, Any] = {"color": GREY, "linewidth": 3.5}
Ends = tuple[float, float]
Start = Callable[[Any, Any], dict[str, dict[str, Any]]]


@dataclasses.dataclass(frozen=True)
class Planes:
    """Planes through the state space: two axes, and a panel for each plane."""

    x_label: str
    x_ends: Ends
    y_label: str
    y_ends: Ends
    panels: Mapping[str, Start]  # by title: platform states, by name and field, from a value on each axis
    spatial: bool  # whether both axes are lengths, about the other platform
    note: str  # what all panels have in common


def planes(env: Environment) -> Planes:
    """The planes on which the filter of an environment is shown.

    Raises:
        ConfigError: the environment is not one of two spacecraft or two aircraft.
    """
    agent, others = env.agent_platform, [one for one in env.platforms if one.name != env.agent]
    if len(others) == 1 and isinstance(agent, (Spacecraft, OrientedSpacecraft)):
        return _docking(agent, others[0])
    if len(others) == 1 and isinstance(agent, (Dubins2D, Dubins3D)) and isinstance(others[0], type(agent)):
        return _rejoin(agent, others[0])
    raise ConfigError(
        f"env: expected two spacecraft or two aircraft of one kind, found {', '.join(map(_kind, env.platforms))}"
    )


def survey(env: Environment, start: Start, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    """H and h on a grid, each [m, n], in the unit of the constraint.

    Args:
        env: with a filter that certifies.
        start: platform states from a value on each axis.
        x: values along the first axis, shape (n,).
        y: values along the second axis, shape (m,).

    Returns:
        The highest H of all backup controllers, −∞ where each ends outside of the terminal set, and the smallest h.
    """

    def states(env: Environment, x: Any, y: Any) -> Sim:
        return jax.vmap(lambda y: jax.vmap(lambda x: place(env, start(x, y)))(x))(y)

    best, h = _assess(env, jax.jit(states)(env, jnp.asarray(x), jnp.asarray(y)))
    return np.asarray(best), np.asarray(h)


@jax.jit
def _assess(env: Environment, sims: Sim) -> tuple[Float[Array, "m n"], Float[Array, "m n"]]:
    """H and h of a grid of states; a program of its own, so that all panels share it."""

    def one(sim: Sim) -> tuple[Float[Array, ""], Float[Array, ""]]:
        rta = cast(CertifiedRTA, env.rta)
        values = rta.certify(env, sim, sim)
        return jnp.max(jnp.where(jnp.isnan(values), -jnp.inf, values)), rta.lowest(env, sim, sim)

    return jax.vmap(jax.vmap(one))(sims)


def place(env: Environment, start: Mapping[str, Mapping[str, Any]]) -> Sim:
    """The simulation with the given fields, all others as at rest, and random numbers of the environment as they stand."""
    rest = {one.name: {**vars(one.rest()), **start.get(one.name, {})} for one in env.platforms}
    return reset_to(env.replace(rta=None, randomize={}), rest)[0].sim


def draw(env: Environment, title: str, x: Ends | None = None, y: Ends | None = None, points: int = 161) -> Figure:
    """A panel for each plane, with `points` states along each axis: H in colour, the edge of what is certified, and h = 0.

    Args:
        env: the environment.
        title: of the figure.
        x: lowest and highest value of the first axis; None chooses.
        y: the same of the second axis.
        points: along each axis.

    Raises:
        ConfigError: the environment has no filter that certifies, or no planes are known for it.
    """
    if not isinstance(env.rta, CertifiedRTA):
        kind = "none" if env.rta is None else _kind(env.rta)
        raise ConfigError(f"rta: expected a filter that certifies states, for instance default, found {kind}")
    plane = planes(env)
    (left, right), (low, high) = x or plane.x_ends, y or plane.y_ends
    across, up = np.linspace(left, right, points), np.linspace(low, high, points)
    surveys = {each: survey(env, start, across, up) for each, start in plane.panels.items()}
    finite = np.concatenate([H[np.isfinite(H)] for H, _ in surveys.values()])
    depth = max(-finite.min(initial=0.0), 1e-3)
    scale = TwoSlopeNorm(0.0, -depth, np.clip(finite.max(initial=0.0), depth, 4.0 * depth))

    width = 3.0
    figure = Figure(layout="compressed" if plane.spatial else "constrained")
    height = width * (high - low) / (right - left) if plane.spatial else 0.9 * width
    figure.set_size_inches(width * len(surveys) + 1.0, height + (1.2 if plane.spatial else 1.5))
    required = float(env.rta.required_margin(env))
    panels = np.atleast_1d(figure.subplots(1, len(surveys), sharex=True, sharey=True))
    for panel, (each, (H, h)) in zip(panels, surveys.items(), strict=True):
        panel.pcolormesh(across, up, H, norm=scale, cmap=SHADES, shading="nearest", rasterized=True)
        finite_H = np.where(np.isneginf(H), -np.abs(h), H)  # so that a line between states can be interpolated
        for values, level, look in ((h, 0.0, BOUNDARY), (finite_H, required, CERTIFIED)):
            if values.min() < level < values.max():
                panel.contour(across, up, values, levels=[level], colors=look["color"], linewidths=look["linewidth"])
        panel.locator_params(nbins=5)
        panel.set(title=plain(each), xlabel=plain(plane.x_label), aspect="equal" if plane.spatial else "auto")
        if plane.spatial:
            panel.plot(0, 0, ">", color="black", markersize=7)
    panels[0].set_ylabel(plain(plane.y_label))
    figure.colorbar(ScalarMappable(scale, SHADES), ax=list(panels), label=labelled("H", _unit(env)), extend="max")
    figure.legend(handles=_entries(surveys), loc="outside lower center", ncols=3, frameon=False)
    notes = [plane.note, "" if env.rta.enforce else "certificates not enforced"]
    figure.suptitle(plain("; ".join([title, *(note for note in notes if note)])))
    return figure


def _docking(agent: Any, chief: Any) -> Planes:
    """Distance against speed: three directions of flight or, where the thrust turns with the body, three attitudes."""
    x, y = np.eye(agent.dimension)[:2]

    def start(way: np.ndarray, **fields: float) -> Start:
        return lambda distance, speed: {agent.name: {"position": distance * x, "velocity": speed * way, **fields}}

    if isinstance(agent, OrientedSpacecraft):
        angles = {"thrust along the velocity": 0.0, "thrust at 45° to it": 0.25, "thrust across it": 0.5}
        panels = {title: start(-x, attitude=share * np.pi) for title, share in angles.items()}
        note = f"flying towards the {chief.name}"
    else:
        panels = {f"flying towards the {chief.name}": start(-x), "flying across": start(y), "flying away": start(x)}
        note = ""
    return Planes(f"distance to the {chief.name} [m]", (0.0, 150.0), "speed [m/s]", (0.0, 0.6), panels, False, note)


def _rejoin(agent: Any, lead: Any) -> Planes:
    """The plane about the lead, which flies to the right at a medium speed, for three headings at the highest speed."""
    slow, fast = float(np.mean(lead.speed_limits)), float(agent.speed_limits[1])

    def start(heading: float) -> Start:
        def states(x: Array, y: Array) -> dict[str, dict[str, Any]]:
            position = jnp.stack([x, y, *jnp.zeros(agent.dimension - 2)])
            return {lead.name: {"speed": slow}, agent.name: {"position": position, "heading": heading, "speed": fast}}

        return states

    panels = {"head-on": start(np.pi), "crossing to the left": start(np.pi / 2), "overtaking": start(0.0)}
    ends, labels = ((-400.0, 1800.0), (-900.0, 400.0)), (f"ahead of the {lead.name} [ft]", "to its left [ft]")
    note = f"{lead.name} at {slow:.0f} ft/s to the right, {agent.name} at {fast:.0f} ft/s"
    return Planes(labels[0], ends[0], labels[1], ends[1], panels, True, note)


def _kind(component: Any) -> str:
    return component.type_name or type(component).__name__


def _unit(env: Environment) -> str | None:
    """The unit of H, if all constraints of the filter agree."""
    found = {margin_unit(constraint(env, name), length_unit(env)) for name in env.rta.constraints}  # type: ignore[union-attr]
    return found.pop() if len(found) == 1 else None


def _entries(surveys: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> list[Any]:
    """What the lines mean and, where it occurs, the colour of −∞."""
    entries: list[Any] = [
        Line2D([], [], label="H = margin kept; certified on the side of higher H", **CERTIFIED),
        Line2D([], [], label="h = 0", **BOUNDARY),
    ]
    if any(np.isneginf(H).any() for H, _ in surveys.values()):
        entries.append(Patch(color=LOST, label="no backup ends in the terminal set"))
    return entries


if __name__ == "__main__":
    from jaxsafe.commands.safe_set import command

    command()
