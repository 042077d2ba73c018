"""Figures of the states that a filter certifies, on planes through the state space.

The command is `jaxsafe safe_set env=rejoin2d`.

H(x) is the smallest h on the flight of the best backup controller from x. Without a horizon it is
h(x) itself. A state is certified where H(x) reaches the margin that the filter keeps. A plane for
docking shows distance against speed, and a plane for rejoin shows the surroundings of the lead.
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

from jaxsafe.environment import Environment, filter_name, length_unit, reset_to
from jaxsafe.plot.style import (
    GREY,
    ORANGE,
    SKY,
    fitted,
    labelled,
    margin_unit,
    plain,
    styled,
)
from jaxsafe.rta.certified import CertifiedRTA
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.cwh import ThrustedSpacecraft
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.transition import constraint
from jaxsafe.types import Sim

LOST = "#C9C9C9"
"""Colour of states from which no backup controller ends in the terminal set."""

SHADES = LinearSegmentedColormap.from_list("shades", [ORANGE, "white", SKY]).with_extremes(bad=LOST)
"""Colours of H: orange where it is negative, blue where it is positive."""

CERTIFIED: dict[str, Any] = {"color": "black", "linewidth": 1.4}
"""Look of the line between states that are certified and states that are not."""

BOUNDARY: dict[str, Any] = {"color": GREY, "linewidth": 3.5}
"""Look of the line h = 0."""

Ends = tuple[float, float]
"""Lowest and highest value of an axis."""

Start = Callable[[Any, Any], dict[str, dict[str, Any]]]
"""A function from a value on each axis to the fields of platform states, by platform and field."""


@dataclasses.dataclass(frozen=True)
class Planes:
    """Planes through the state space: two axes, and a panel for each plane."""

    x_label: str
    x_ends: Ends
    y_label: str
    y_ends: Ends
    panels: Mapping[str, Start]  # by title
    spatial: bool  # whether both axes are positions relative to the other platform
    note: str  # what holds in all panels


def planes(env: Environment) -> Planes:
    """Return the planes on which the filter of an environment is shown.

    Raises:
        ConfigError: the environment is not one of two spacecraft or two aircraft.
    """
    agent = env.agent_platform
    others = [platform for platform in env.platforms if platform.name != env.agent]
    if len(others) == 1 and isinstance(agent, (ThrustedSpacecraft, OrientedSpacecraft)):
        return _docking(agent, others[0])
    if (
        len(others) == 1
        and isinstance(agent, (Dubins2D, Dubins3D))
        and isinstance(others[0], type(agent))
    ):
        return _rejoin(agent, others[0])
    types = ", ".join(part.type_name or type(part).__name__ for part in env.platforms)
    raise ConfigError(f"env: expected two spacecraft or two aircraft of one kind, found {types}")


def survey(env: Environment, start: Start, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return H and h on a grid, in the unit of the constraint.

    Args:
        env: an environment with a filter that certifies.
        start: gives platform states from a value on each axis.
        x: values along the first axis, shape (n,).
        y: values along the second axis, shape (m,).

    Returns:
        H and the smallest h of all constraints, each of shape (m, n). H is that of the best backup
        controller. It is −∞ where every backup controller ends outside of the terminal set.
    """

    def states(env: Environment, x: Any, y: Any) -> Sim:
        return jax.vmap(lambda y: jax.vmap(lambda x: place(env, start(x, y)))(x))(y)

    best, h = _assess(env, jax.jit(states)(env, jnp.asarray(x), jnp.asarray(y)))
    return np.asarray(best), np.asarray(h)


@jax.jit
def _assess(env: Environment, sims: Sim) -> tuple[Float[Array, "m n"], Float[Array, "m n"]]:
    """Return H and h of a grid of states.

    This is a program of its own, so that all panels share it.
    """

    def assess_state(sim: Sim) -> tuple[Float[Array, ""], Float[Array, ""]]:
        rta = cast(CertifiedRTA, env.rta)
        values = rta.certify(env, sim, sim)
        return jnp.max(jnp.where(jnp.isnan(values), -jnp.inf, values)), rta.lowest(env, sim, sim)

    return jax.vmap(jax.vmap(assess_state))(sims)


def place(env: Environment, start: Mapping[str, Mapping[str, Any]]) -> Sim:
    """Return the simulation with the given fields. All other fields are those at rest.

    Random numbers of the environment keep their present values.

    Args:
        env: the environment.
        start: values by platform and field.
    """
    states = {
        platform.name: {**vars(platform.rest()), **start.get(platform.name, {})}
        for platform in env.platforms
    }
    return reset_to(env.replace(rta=None, randomize={}), states)[0].sim


@styled
def draw(
    env: Environment, title: str, x: Ends | None = None, y: Ends | None = None, points: int = 161
) -> Figure:
    """Return a figure with a panel for each plane.

    A panel shows H in colour, the edge of what is certified, and the line h = 0.

    Args:
        env: the environment.
        title: the title of the figure.
        x: lowest and highest value of the first axis. None takes those of the planes.
        y: lowest and highest value of the second axis. None takes those of the planes.
        points: the number of states along each axis.

    Raises:
        ConfigError: the environment has no filter that certifies, or no planes are known for it.
    """
    if not isinstance(env.rta, CertifiedRTA) or not env.rta.backups:
        raise ConfigError(
            "rta: expected a filter that certifies states, for instance default,"
            f" found {filter_name(env)}"
        )
    plane = planes(env)
    left, right = x or plane.x_ends
    low, high = y or plane.y_ends
    across = np.linspace(left, right, points)
    up = np.linspace(low, high, points)
    surveys = {name: survey(env, start, x=across, y=up) for name, start in plane.panels.items()}
    finite = np.concatenate([H[np.isfinite(H)] for H, _ in surveys.values()])
    depth = max(-finite.min(initial=0.0), 1e-3)
    scale = TwoSlopeNorm(0.0, -depth, np.clip(finite.max(initial=0.0), depth, 4.0 * depth))

    width = 3.0
    figure = Figure(layout="compressed" if plane.spatial else "constrained")
    height = width * (high - low) / (right - left) if plane.spatial else 0.9 * width
    figure.set_size_inches(width * len(surveys) + 1.0, height + (1.2 if plane.spatial else 1.5))
    required = float(env.rta.margin_to_certify(env))
    panels = np.atleast_1d(figure.subplots(1, len(surveys), sharex=True, sharey=True))
    for panel, (name, (H, h)) in zip(panels, surveys.items(), strict=True):
        panel.pcolormesh(across, up, H, norm=scale, cmap=SHADES, shading="nearest", rasterized=True)
        finite_H = np.where(np.isneginf(H), -np.abs(h), H)  # a contour can be interpolated in it
        for values, level, look in ((h, 0.0, BOUNDARY), (finite_H, required, CERTIFIED)):
            if values.min() < level < values.max():
                style = {"colors": look["color"], "linewidths": look["linewidth"]}
                panel.contour(across, up, values, levels=[level], **style)
        panel.locator_params(nbins=5)
        aspect = "equal" if plane.spatial else "auto"
        panel.set(title=plain(name), xlabel=plain(plane.x_label), aspect=aspect)
        if plane.spatial:
            panel.plot(0, 0, ">", color="black", markersize=7)
    panels[0].set_ylabel(plain(plane.y_label))
    colours = ScalarMappable(scale, SHADES)
    figure.colorbar(colours, ax=list(panels), label=labelled("H", _unit(env)), extend="max")
    figure.legend(handles=_entries(surveys), loc="outside lower center", ncols=3)
    notes = [plane.note, "" if env.rta.enforce else "certificates not enforced"]
    figure.suptitle(fitted(plain("; ".join([title, *(note for note in notes if note)])), figure))
    return figure


def _docking(agent: Any, chief: Any) -> Planes:
    """Return planes of distance against speed, for three directions of flight.

    On a line there are only two directions. If the thrust turns with the body, the planes are for
    three attitudes instead.
    """
    x, *across = np.eye(agent.dimension)

    def start(way: np.ndarray, **fields: float) -> Start:
        def states(distance: Any, speed: Any) -> dict[str, dict[str, Any]]:
            return {agent.name: {"position": distance * x, "velocity": speed * way, **fields}}

        return states

    if isinstance(agent, OrientedSpacecraft):
        angles = {
            "thrust along the velocity": 0.0,
            "thrust at 45° to it": 0.25,
            "thrust across it": 0.5,
        }
        panels = {title: start(-x, attitude=share * np.pi) for title, share in angles.items()}
        note = f"flying towards the {chief.name}"
    else:
        panels = {f"flying towards the {chief.name}": start(-x)}
        if across:
            panels["flying across"] = start(across[0])
        panels["flying away"] = start(x)
        note = ""
    return Planes(
        x_label=f"distance to the {chief.name} [m]",
        x_ends=(0.0, 150.0),
        y_label="speed [m/s]",
        y_ends=(0.0, 0.6),
        panels=panels,
        spatial=False,
        note=note,
    )


def _rejoin(agent: Any, lead: Any) -> Planes:
    """Return planes of the agent's position about the lead, for three headings of the agent.

    The lead flies to the right at a medium speed, and the agent flies at its highest speed.
    """
    lead_speed = float(np.mean(lead.speed_limits))
    own_speed = float(agent.speed_limits[1])

    def start(heading: float) -> Start:
        def states(x: Array, y: Array) -> dict[str, dict[str, Any]]:
            position = jnp.stack([x, y, *jnp.zeros(agent.dimension - 2)])
            own = {"position": position, "heading": heading, "speed": own_speed}
            return {lead.name: {"speed": lead_speed}, agent.name: own}

        return states

    panels = {
        "head-on": start(np.pi),
        "crossing to the left": start(np.pi / 2),
        "overtaking": start(0.0),
    }
    speeds = (
        f"{lead.name} at {lead_speed:.0f} ft/s to the right, {agent.name} at {own_speed:.0f} ft/s"
    )
    return Planes(
        x_label=f"ahead of the {lead.name} [ft]",
        x_ends=(-400.0, 1800.0),
        y_label="to its left [ft]",
        y_ends=(-900.0, 400.0),
        panels=panels,
        spatial=True,
        note=speeds,
    )


def _unit(env: Environment) -> str | None:
    """Return the unit of H if it is the same for all constraints of the filter, else None."""
    length = length_unit(env)
    names = cast(CertifiedRTA, env.rta).constraints
    units = {margin_unit(constraint(env, name), length) for name in names}
    return units.pop() if len(units) == 1 else None


def _entries(surveys: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> list[Any]:
    """Return legend entries for the lines and, where it occurs, for the colour of −∞."""
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
