"""Draw the figures of docs/verification.md.

    python docs/draw_verification.py maps=runs/prove_and_retrain/round_0.npz,…/round_2.npz
    python docs/draw_verification.py starts=rest.npz,left.npz,away.npz

The `maps` are certificates of `examples/studies/prove_and_retrain.py`. Each is drawn as a row of
panels, one for each of some velocities. The `starts` are certificates of one policy from narrow
boxes of velocities, each drawn as a panel. The tube is that of the docking2d policy which comes
with the package.
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle

import jaxsafe
from jaxsafe.agents.policy_file import find_policy, read_policy
from jaxsafe.envs.docking import START_DISTANCES
from jaxsafe.plot.style import AMBER, BLUE, GREEN, GREY, ORANGE, save, styled
from jaxsafe.rollout import RecurrentPolicy
from jaxsafe.verify.certificate import load_certificate
from jaxsafe.verify.loop import closed_loop, start_of
from jaxsafe.verify.tube import tube
from jaxsafe.verify.verify import Verification

HERE = Path(__file__).parent
COLOURS = {"proved": GREEN, "refuted": ORANGE, "open": AMBER}

VELOCITIES = ((-0.19, -0.19), (0.01, 0.01), (0.19, -0.19))
"""The velocities of the panels of a map [m/s]. They are on no face of a box."""

START = ((88.0, 92.5), (78.0, 82.5), (-0.15, -0.125), (0.05, 0.075))
"""The box of the tube [m, m/s]."""

STEPS = 80
FLIGHTS = 200


@styled
def draw_maps(paths: list[str], target: Path) -> None:
    """Draw what is proved, refuted and open over the position."""
    figure = Figure(figsize=(8.2, 2.6 * len(paths) + 0.4), layout="constrained")
    panels = figure.subplots(len(paths), len(VELOCITIES), squeeze=False, sharex=True, sharey=True)
    for path, line in zip(paths, panels, strict=True):
        known = load_certificate(path)
        for velocity, panel in zip(VELOCITIES, line, strict=True):
            _map(known, np.array(velocity), panel)
        line[0].set_ylabel(f"{Path(path).stem.replace('_', ' ')}\ny [m]")
    for velocity, panel in zip(VELOCITIES, panels[0], strict=True):
        panel.set_title(f"ẋ = {velocity[0]:g} m/s, ẏ = {velocity[1]:g} m/s")
    for panel in panels[-1]:
        panel.set_xlabel("x [m]")
    handles = [Patch(facecolor=colour, label=name) for name, colour in COLOURS.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    save(figure, target)


@styled
def draw_starts(paths: list[str], target: Path) -> None:
    """Draw what is proved, refuted and open over the position, and the ring of a task's starts."""
    figure = Figure(figsize=(8.2, 3.5), layout="constrained")
    panels = figure.subplots(1, len(paths), squeeze=False, sharey=True)[0]
    for path, panel in zip(paths, panels, strict=True):
        known = load_certificate(path)
        low, high = known.box.low[0, 2:], known.box.high[0, 2:]
        _map(known, 0.5 * (low + high), panel)
        for distance in START_DISTANCES:
            panel.add_patch(Circle((0.0, 0.0), distance, fill=False, color="black", linewidth=0.8))
        x, y = 0.5 * (low + high) + 0.0  # −0 becomes 0
        panel.set(xlabel="x [m]", title=f"ẋ = {x:.3g} m/s, ẏ = {y:.3g} m/s")
    panels[0].set_ylabel("y [m]")
    handles = [Patch(facecolor=colour, label=name) for name, colour in COLOURS.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    save(figure, target)


def _map(known: Verification, velocity: np.ndarray, panel: Axes) -> None:
    """Draw the boxes that hold starts with this velocity."""
    for name, colour in COLOURS.items():
        low, high = getattr(known, name)
        chosen = np.all((low[:, 2:] <= velocity) & (velocity <= high[:, 2:]), axis=1)
        patches = [
            Rectangle(a, *(b - a)) for a, b in zip(low[chosen, :2], high[chosen, :2], strict=True)
        ]
        panel.add_collection(
            PatchCollection(patches, facecolor=colour, edgecolor="white", linewidth=0.2)
        )
    low, high = known.box.low[0], known.box.high[0]
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")


@styled
def draw_tube(target: Path) -> None:
    """Draw the bounds of all flights from a box, and some flights."""
    saved = read_policy(find_policy("docking2d"))
    policy = saved.agent.policy(saved.env, saved.params, True)
    assert not isinstance(policy, RecurrentPolicy)
    low, high = np.array(START).T
    with jax.enable_x64(True):
        loop = closed_loop(saved.env, policy)
        bounds = tube(loop, STEPS, jnp.asarray(low[None]), jnp.asarray(high[None]))
        bounds = jax.device_get(jax.tree.map(lambda x: x[0], bounds))
    share = np.random.default_rng(0).uniform(size=(FLIGHTS, 4))
    starts = jnp.asarray(low + share * (high - low), jnp.float32)

    def fly(start: jax.Array) -> tuple[jax.Array, jax.Array]:
        def seen(timestep: jaxsafe.TimeStep, state: jaxsafe.State) -> tuple[jax.Array, jax.Array]:
            own = state.sim.platforms["deputy"]
            return own.position, timestep.info.margins["velocity_limit"]

        def advance(carry: tuple, _: None) -> tuple[tuple, tuple[jax.Array, jax.Array]]:
            state, observation = carry
            action = policy(jax.random.key(0), observation[None])[0]
            state, timestep = jaxsafe.step(saved.env, state, action)
            return (state, timestep.observation), seen(timestep, state)

        state, timestep = jaxsafe.reset_to(saved.env, start_of(saved.env, start))
        return jax.lax.scan(advance, (state, timestep.observation), None, STEPS)[1]

    positions, margins = jax.device_get(jax.jit(jax.vmap(fly))(starts))
    figure = Figure(figsize=(8.2, 3.2), layout="constrained")
    where, when = figure.subplots(1, 2)
    boxes = [
        Rectangle(a, *(b - a))
        for a, b in zip(bounds.low[::5, :2], bounds.high[::5, :2], strict=True)
    ]
    where.add_collection(PatchCollection(boxes, facecolor="none", edgecolor=BLUE, linewidth=0.8))
    where.plot(*positions.T, color=GREY, linewidth=0.3)
    where.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    where.set_title("bounds every 5 s, and flights")
    times = np.arange(STEPS + 1)
    when.plot(times[1:], margins.T, color=GREY, linewidth=0.3)
    when.plot(times, bounds.margin, color=BLUE, label="proved lower bound")
    when.axhline(0.0, color=ORANGE, linewidth=0.8)
    when.set(xlabel="time [s]", ylabel="margin h of the speed limit [m/s]", ylim=(-0.01, None))
    when.legend()
    save(figure, target)


def main(words: list[str]) -> None:
    """Draw the figures. The maps are drawn if there are certificates."""
    options = dict(word.split("=", 1) for word in words)
    if "maps" in options:
        draw_maps(options["maps"].split(","), HERE / "figures_verification_maps.png")
    if "starts" in options:
        draw_starts(options["starts"].split(","), HERE / "figures_verification_starts.png")
    draw_tube(HERE / "figures_verification_tube.png")


if __name__ == "__main__":
    main(sys.argv[1:])
