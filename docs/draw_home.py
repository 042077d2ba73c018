"""Draw the picture of the README and of the site's first page.

    python docs/draw_home.py

The left panel shows approaches of the docking3d policy that comes with the package. The right panel
shows the speed of a controller that always thrusts towards the chief, without and with a filter.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

import jaxsafe
from jaxsafe.plot.style import BLUE, GREEN, ORANGE

NUM_APPROACHES = 12

FARTHEST = 120.0
"""Largest distance that is shown [m]."""

FASTEST = 1.0
"""Largest speed that is shown [m/s]. Without a filter the deputy passes the chief at 5 m/s."""


def approaches() -> list[np.ndarray]:
    """Return the paths of docked approaches, each of shape (steps + 1, 3) in m."""
    env = jaxsafe.make("docking3d")
    policy = jaxsafe.load_policy("docking3d", deterministic=True)
    keys = jax.random.split(jax.random.key(5), NUM_APPROACHES)
    flights = [jaxsafe.fly(env, policy, start=env.reset(key)) for key in keys]
    return [flight.platforms["deputy"].position for flight in flights]


def towards(key: jax.Array, observation: jax.Array) -> jax.Array:
    """Return full thrust towards the chief, which is where the observed position is 0."""
    return -observation[:3] / jnp.max(jnp.abs(observation[:3]))


def dash(rta: str) -> tuple[np.ndarray, np.ndarray]:
    """Return distance [m] and speed [m/s] of a deputy that always thrusts towards the chief.

    They are cut where it passes the chief.

    Args:
        rta: the filter, as `jaxsafe.make` takes it.
    """
    env = jaxsafe.make("docking3d", rta=rta)
    flight = jaxsafe.fly(env, towards, start=env.reset(jax.random.key(3)))
    deputy = flight.platforms["deputy"]
    # Without the start, from which it first has to be turned round.
    distance = np.linalg.norm(deputy.position[1:], axis=1)
    speed = np.linalg.norm(deputy.velocity[1:], axis=1)
    end = int(np.argmax(np.append(np.diff(distance) > 0.0, True))) + 1
    return distance[:end], speed[:end]


def draw() -> Figure:
    """Return the picture."""
    figure = Figure(figsize=(10.0, 4.2), layout=ConstrainedLayoutEngine(wspace=0.08))
    space: Any = figure.add_subplot(1, 2, 1, projection="3d")
    for path in approaches():
        space.plot(*path.T, color=BLUE, linewidth=1.2)
        space.plot(*path[0], "o", color=BLUE, markersize=3)
    space.plot(0, 0, 0, "o", color=GREEN, markersize=7)
    space.set_title(f"{NUM_APPROACHES} approaches of a trained policy")
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    space.view_init(elev=22, azim=-52)
    space.set_box_aspect((1, 1, 0.85), zoom=0.95)

    panel = figure.add_subplot(1, 2, 2)
    for rta, colour, label in (
        ("none", ORANGE, "without a filter"),
        ("default", BLUE, "with run time assurance"),
    ):
        distance, speed = dash(rta)
        panel.plot(distance, speed, color=colour, linewidth=2.0, label=label)
    limit = 0.2 + 0.002054 * np.array([0.0, FARTHEST])
    panel.plot([0.0, FARTHEST], limit, "k--", linewidth=1.2, label="speed limit")
    panel.fill_between([0.0, FARTHEST], limit, FASTEST, color=ORANGE, alpha=0.08, linewidth=0)
    panel.text(40.0, 0.62, "unsafe", color=ORANGE, fontsize="large", ha="center")
    panel.set_title("a controller that only thrusts towards the chief")
    panel.set(xlabel="distance to the chief [m]", ylabel="speed [m/s]")
    panel.set(xlim=(FARTHEST, 0.0), ylim=(0.0, FASTEST))
    panel.legend(loc="upper right", frameon=False)
    panel.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    draw().savefig(Path(__file__).parent / "home.png", dpi=110)
