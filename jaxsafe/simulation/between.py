"""Bounds of distances on the way between two samples.

A filter knows the world at the beginning and at the end of a step. What happens within the step is
bounded. Platforms leave the straight line by no more than `Platform.bend`. The carrier of a region
is assumed to turn at a constant rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.simulation.geometry import safe_norm, to_body, turn_between
from jaxsafe.simulation.regions import Region
from jaxsafe.types import RegionState, Sim, place

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


def bend(env: Environment, before: Sim, sim: Sim, name: str) -> Float[Array, ""]:
    """Return how far the path of a platform or region may leave the line between two samples.

    The centre of a region that turns with its carrier moves on an arc. It leaves its chord by
    chord·tan(φ/4)/2 ≤ 0.15 chord·φ, where φ is the angle of the turn.
    """
    if name in sim.platforms:
        duration = sim.time - before.time
        return env.platform(name).bend(before.platforms[name], sim.platforms[name], duration)
    region = next(region for region in env.regions if region.name == name)
    if region.on is None:
        return jnp.zeros_like(sim.time)
    carried = bend(env, before, sim, region.on)
    if region.offset is None or not region.offset.turns:
        return carried
    levers = [
        instant.regions[name].position - place(instant, region.on).position
        for instant in (before, sim)
    ]
    return carried + 0.15 * safe_norm(levers[1] - levers[0]) * _turn(before, sim, region.on)


def regions_on_the_way(env: Environment, before: Sim, sim: Sim) -> Mapping[str, RegionState]:
    """Return the regions of `sim` with lower bounds of all distances and depths since `before`.

    Only regions that measure distances change.
    """
    regions = {**sim.regions}
    for region in env.regions:
        state = sim.regions[region.name]
        bounds = {
            of: _signed_distance_bounds(env, region, before, sim, of) for of in state.distance
        }
        if bounds:
            regions[region.name] = state.replace(
                distance={of: low for of, (low, _) in bounds.items()},
                depth={of: -high for of, (_, high) in bounds.items()},
            )
    return regions


def _signed_distance_bounds(
    env: Environment, region: Region, before: Sim, sim: Sim, of: str
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return bounds of the signed distance of a platform or region to a region on the way.

    The first is the lower one.

    Seen from axes that turn by φ in the step, a straight line is bent. Let its length be L, and let
    its points be no farther away than R. Then its second derivative with respect to the share of
    the step is at most 2φL + φ²R, and so it leaves its chord by no more than an eighth of that.
    """
    offsets = []
    global_offsets = []
    for instant in (before, sim):
        offset = place(instant, of).position - instant.regions[region.name].position
        axes = None if region.on is None else region.axes(place(instant, region.on))
        global_offsets.append(offset)
        offsets.append(offset if axes is None else to_body(axes, offset))
    slack = bend(env, before, sim, of) + bend(env, before, sim, region.name)
    if region.on is not None and region.axes(place(sim, region.on)) is not None:
        turn = _turn(before, sim, region.on)
        way = safe_norm(global_offsets[1] - global_offsets[0])
        farthest = jnp.maximum(safe_norm(global_offsets[0]), safe_norm(global_offsets[1]))
        slack = slack + (2.0 * turn * way + turn**2 * farthest) / 8.0
    low = region.nearest(offsets[0], offsets[1]) - slack
    return low, region.farthest(offsets[0], offsets[1]) + slack


def _turn(before: Sim, sim: Sim, name: str) -> Float[Array, ""]:
    """Return the angle by which a platform or region has turned [rad]."""
    return turn_between(place(before, name).orientation, place(sim, name).orientation)
