"""The figures of `docs/tasks`, drawn by `docs/make_tasks.py`.

They show ranges and regions of a task, and episodes in it. Ranges come from the environment. The
episodes are steps of it under simple scripted policies.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Annulus, Circle, Rectangle

import jaxsafe
from jaxsafe.plot.style import BLUE, FORBIDDEN, GOAL, GREEN, GREY, ORANGE, PATH_BEHIND

PALETTE = ("#3B2F8F", "#C2568F", "#A67C00")
SEEDS = {
    "rejoin2d": (5, 3),
    "rejoin3d": (1, 127),
    "docking2d": (2, 9, 6),
    "docking3d": (2, 3, 8),
    "docking2d_oriented": (2, 9, 6),
}
"""The episodes that the figures show."""

PACES = (0.9, 0.6, 1.15)
"""Speeds that the scripted deputies aim for, as shares of the limit."""


def draw(task: str) -> Figure:
    """Return the figure of a task.

    It shows where the task starts, where an agent may go, and episodes under a scripted policy.
    """
    env = jaxsafe.make(task)
    episodes = [episode(env, seed, pace) for seed, pace in zip(SEEDS[task], PACES, strict=False)]
    return (draw_docking if env.agent == "deputy" else draw_rejoin)(env, episodes)


def episode(env: Any, seed: int, pace: float) -> tuple[Any, str]:
    """Return the simulations from a random start to the end, stacked, and the outcome."""
    lows, highs = (
        jnp.stack([getattr(actuator, end) for actuator in env.agent_platform.controller.actuators])
        for end in ("low", "high")
    )
    steer = steer_spacecraft if env.agent == "deputy" else steer_aircraft
    centred = jnp.array(
        [actuator.zero_centred for actuator in env.agent_platform.controller.actuators]
    )

    def one_step(state: Any, _: None) -> tuple[Any, Any]:
        wish = jnp.stack([steer(env, state.sim, pace)[name] for name in env.action_names])
        affine = 2.0 * (wish - lows) / (highs - lows) - 1.0
        action = jnp.where(centred, wish / jnp.where(wish < 0.0, -lows, highs), affine)
        after, timestep = jaxsafe.step(env, state, jnp.clip(action, -1.0, 1.0))
        return after, (state.sim, timestep.info.outcome)

    sims, outcome = jax.jit(
        lambda key: jax.lax.scan(one_step, jaxsafe.reset(env, key)[0], None, 3002)
    )(jax.random.key(seed))[1]
    last = int(np.argmax(np.asarray(outcome) > 0))
    return jax.tree.map(lambda leaf: np.asarray(leaf[: last + 2]), sims), env.outcomes[
        int(outcome[last])
    ]


def steer_spacecraft(env: Any, sim: Any, pace: float) -> dict[str, Any]:
    """Return thrust towards the chief, for a speed that is a share of the limit."""
    deputy = sim.platforms["deputy"]
    status = sim.status
    wish = -pace * status["velocity_limit"] * deputy.position / jnp.linalg.norm(deputy.position)
    thrust = env.platforms[1].mass * (wish - deputy.velocity)
    if env.action_names[0] != "thrust":
        return dict(zip(env.action_names, thrust, strict=True))
    axis = deputy.orientation[:, 0]
    across = axis[0] * thrust[1] - axis[1] * thrust[0]
    error = jnp.arctan(across / (thrust @ axis + 1e-6))  # either end of the body may push
    still = jnp.linalg.norm(thrust) < 0.1
    turn = jnp.where(still, 0.0, 0.1 * error) - deputy.attitude_rate
    return {
        "thrust": jnp.where(jnp.abs(error) < 0.3, thrust @ axis, 0.0),
        "attitude_acceleration": turn,
    }


def steer_aircraft(env: Any, sim: Any, pace: float) -> dict[str, Any]:
    """Return controls that fly at the lead's velocity and towards the rejoin point.

    The speed towards the point is at most 100 ft/s.
    """
    lead = sim.platforms["lead"]
    wingman = sim.platforms["wingman"]
    away = sim.regions["rejoin_region"].position - wingman.position
    wish = lead.velocity + away * jnp.minimum(0.05, 100.0 / (jnp.linalg.norm(away) + 1e-6))
    speed = jnp.linalg.norm(wish)
    error = jnp.arctan2(wish[1], wish[0]) - wingman.heading
    rate = 0.5 * jnp.arctan2(jnp.sin(error), jnp.cos(error))
    controls = {"heading_rate": rate, "acceleration": speed - wingman.speed}
    if "roll_rate" in env.action_names:
        bank = jnp.clip(jnp.arctan(rate * wingman.speed / env.platforms[1].gravity), -1.0, 1.0)
        climb = -jnp.arcsin(wish[2] / speed) - wingman.flight_path_angle
        controls |= {"roll_rate": bank - wingman.roll, "flight_path_angle_rate": climb}
    return controls


def draw_docking(env: Any, episodes: list[tuple[Any, str]]) -> Figure:
    """Draw paths about the chief, their last metres, and speed against distance."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    spatial = env.platforms[0].dimension == 3
    left: Any = figure.add_subplot(1, 2, 1, projection="3d" if spatial else None)
    zoom = None if spatial else left.inset_axes((0.70, 0.02, 0.28, 0.28))
    right = figure.add_subplot(1, 2, 2)
    near, far = np.asarray(env.agent_platform.start[0].distance)
    radius = float(env.regions[0].radius)
    limit = next(status for status in env.status if status.name == "velocity_limit")
    if zoom is None:
        azimuth, polar = np.mgrid[0 : 2 * np.pi : 25j, 0 : np.pi : 13j]
        ball = np.stack(
            [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
        )
        for r in (near, far):
            left.plot_surface(*(r * ball), color=BLUE, linewidth=0, alpha=0.08)
        left.set(zlabel="z [m]", **{f"{axis}ticks": (-100, 0, 100) for axis in "xyz"})
        left.set_box_aspect((1, 1, 1), zoom=0.95)
    else:
        left.add_patch(Annulus((0, 0), far, far - near, color=BLUE, alpha=0.15, linewidth=0))
        left.set_aspect("equal")
        zoom.add_patch(Circle((0, 0), radius, color=GREEN, alpha=0.4))
        zoom.set(xlim=(-1.5, 1.5), ylim=(-1.5, 1.5), aspect="equal", xticks=[], yticks=[])
        zoom.set_title(f"docking region, {radius:g} m", fontsize=8)
    for colour, (sim, outcome) in zip(PALETTE, episodes, strict=False):
        deputy = sim.platforms["deputy"]
        status = sim.status
        left.plot(*deputy.position.T, color=colour, linewidth=1.6)
        left.plot(*deputy.position[:1].T, "o", color=colour, markersize=5)
        if zoom:
            zoom.plot(*deputy.position.T, color=colour, linewidth=1.4)
        if hasattr(deputy, "attitude"):
            every = slice(0, None, 40)
            body = (
                deputy.position[every],
                14.0 * np.stack([np.cos(deputy.attitude), np.sin(deputy.attitude)], 1)[every],
            )
            left.quiver(
                *body[0].T,
                *body[1].T,
                color=colour,
                angles="xy",
                scale_units="xy",
                scale=1.0,
                width=0.004,
            )
        right.plot(
            status["docking_distance"], status["speed"], color=colour, linewidth=1.6, label=outcome
        )
        right.plot(
            status["docking_distance"][0], status["speed"][0], "o", color=colour, markersize=5
        )
    left.plot(*np.zeros((env.platforms[0].dimension, 1)), "*", color="black", markersize=11)
    left.set(xlabel="x [m]", ylabel="y [m]")

    r = np.linspace(0.0, 1.1 * far, 200)
    speed = float(limit.floor) + float(limit.slope) * r
    right.plot(r, speed, color=ORANGE, linewidth=1.8)
    right.fill_between(r, speed, 1.0, color=ORANGE, alpha=0.12, linewidth=0)
    start = np.array([near, far])
    right.fill_between(
        start,
        0.0,
        float(limit.floor) + float(limit.slope) * start,
        color=BLUE,
        alpha=0.15,
        linewidth=0,
    )
    right.text(0.04 * far, 0.4, "above the speed limit", color=ORANGE)
    right.text(far - 1.0, 0.012, "start", color=BLUE, ha="right")
    right.legend(loc="lower left", frameon=False, title="outcome")
    right.set(
        xlim=(0, 1.1 * far), ylim=(0, 0.6), xlabel="distance to the chief [m]", ylabel="speed [m/s]"
    )
    return figure


def draw_rejoin(env: Any, episodes: list[tuple[Any, str]]) -> Figure:
    """Draw paths over the ground and paths seen from the lead.

    In space, also draw the altitude over that of the lead.
    """
    spatial = env.platforms[0].dimension == 3
    figure = Figure(figsize=(14 if spatial else 11, 4.6), layout="constrained")
    ground, close, *height = figure.subplots(1, 3 if spatial else 2)
    low, high = (
        np.asarray(getattr(env.platforms[0].start[0], end))[:2] / 1e3 for end in ("low", "high")
    )
    near, far = np.asarray(env.platforms[1].start[0].distance) / 1e3
    region = env.regions[0]
    ground.add_patch(
        Rectangle(
            (low[0], low[1]),
            *(high - low),
            color=GREY,
            alpha=0.25,
            linewidth=0,
            label="start of the lead",
        )
    )
    for index, (colour, (sim, outcome)) in enumerate(zip(PALETTE, episodes, strict=False)):
        lead, wingman = (sim.platforms[name] for name in ("lead", "wingman"))
        if not index:
            ring = Annulus(
                lead.position[0, :2] / 1e3, far, far - near, color=colour, alpha=0.12, linewidth=0
            )
            ring.set_label("start of this wingman, given the start of its lead")
            ground.add_patch(ring)
        ground.plot(
            *lead.position[:, :2].T / 1e3,
            color=GREY,
            linewidth=1.6,
            linestyle="--",
            label="lead" if index else None,
        )
        ground.plot(*lead.position[:1, :2].T / 1e3, "s", color=GREY, markersize=5)
        ground.plot(*lead.position[-1:, :2].T / 1e3, "x", color=GREY, markersize=6)
        ground.plot(*wingman.position[:, :2].T / 1e3, color=colour, linewidth=1.6)
        ground.plot(*wingman.position[:1, :2].T / 1e3, "o", color=colour, markersize=5)
        x, y = (wingman.position - lead.position)[:, :2].T
        c = np.cos(lead.heading)
        s = np.sin(lead.heading)
        label = f"ended with {outcome}"
        close.plot(c * x + s * y, c * y - s * x, color=colour, linewidth=1.6, label=label)
        for axes in height:
            axes.plot(
                sim.time, (wingman.position - lead.position)[:, 2], color=colour, linewidth=1.6
            )
    angle = np.pi + float(region.offset.angle)
    centre = float(region.offset.distance) * np.array([np.cos(angle), np.sin(angle)])
    close.add_patch(Circle((centre[0], centre[1]), float(region.radius), **GOAL))
    close.text(
        centre[0] - float(region.radius) - 20,
        centre[1],
        "rejoin region",
        color=GREEN,
        ha="right",
        va="center",
    )
    crash = float(env.constraints[0].minimum)
    close.add_patch(Circle((0, 0), crash, **FORBIDDEN))
    close.text(0, crash + 20, "crash", color=ORANGE, ha="center")
    close.plot([-1e4, 0], [0, 0], label="path of the lead", **PATH_BEHIND)
    close.plot([centre[0], 0], [centre[1], 0], color=GREY, linewidth=0.8, linestyle=":")
    close.plot(0, 0, ">", color="black", markersize=8)
    ground.set(aspect="equal", xlabel="x [1000 ft]", ylabel="y [1000 ft]", title="from above")
    close.legend(loc="lower right", frameon=False)
    close.set(
        aspect="equal",
        xticks=range(-800, 900, 400),
        xlim=(-900, 900),
        ylim=(-1100, 600),
        title="seen from the lead, which flies to the right",
    )
    close.set(xlabel="ahead of the lead [ft]", ylabel="to its left [ft]")
    figure.legend(
        *ground.get_legend_handles_labels(), loc="outside lower left", ncols=3, frameon=False
    )
    for axes in height:
        axes.axhspan(
            -float(region.height) / 2, float(region.height) / 2, color=GREEN, alpha=0.3, linewidth=0
        )
        axes.set(xlabel="time [s]", ylabel="altitude over that of the lead [ft]", title="altitude")
    return figure
