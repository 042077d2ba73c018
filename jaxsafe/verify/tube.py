"""Tubes: bounds of the loop's states over many steps from a box of starts.

The set of states is a zonotope. A linear plant maps it without loss, and the policy adds one
generator per actuator in every step, as wide as what its linearisation leaves open. A plant that is
not linear adds such a generator for each number of its state. From time to time the generators that
matter least are replaced by a parallelotope around them.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.verify.forms import Bounds, Domain, bound
from jaxsafe.verify.loop import Loop, Plant, Property
from jaxsafe.verify.program import FINE

ROOM = 2.0**-12
"""Share by which the radii of a tube are wider than they were computed.

Chords over short intervals have slopes that roundings change, by up to 4e-6 of a radius.
"""


EVERY = 41
"""Number of samples between two reductions of a zonotope.

A proof over 40 steps has 41 samples with the start, and so it needs no reduction.
"""

FLAT = 1e-20
"""A row of generators counts as 0 if its square falls below this part as others are subtracted."""


class Claims(NamedTuple):
    """What a tube says of the policy in every step: |action − slope·y − centre| ≤ radius.

    y is the state before the step. The first entry is about the action at the start.
    """

    slope: Float[Array | np.ndarray, "t m d"]
    centre: Float[Array | np.ndarray, "t m"]
    radius: Float[Array | np.ndarray, "t m"]


class Tube(NamedTuple):
    """What is known of all ways from a box."""

    margin: Float[Array, " t"]
    """A lower bound of h at the start, and of the smallest h of each step, between samples too."""
    claims: Claims
    low: Float[Array, "t d"]
    """The lowest state at each sample."""
    high: Float[Array, "t d"]
    depth: Float[Array, "t g"]
    """A lower bound of the depth in the docking region at each sample [m].

    g is 1 for a loop with the property `docks`, else 0.
    """

    def proved_steps(self, property: Property) -> np.ndarray:
        """Return after how many steps the property is proved of each of a batch of boxes.

        It is -1 where it is not proved. Bounds that are not numbers prove nothing.
        """
        margin, depth = np.asarray(self.margin), np.asarray(self.depth)
        proved = np.logical_and.accumulate(margin >= 0.0, axis=1)
        if property == "docks":
            proved &= depth[..., 0] >= 0.0
            proved[:, 0] = False  # an episode does not end at its start
        else:
            proved[:, :-1] = False
        return np.where(proved.any(axis=1), proved.argmax(axis=1), -1)


class _Sample(NamedTuple):
    """What the bound between two samples needs to know of the states at one."""

    margin: Array
    speed: Array
    distance: Array
    nearest: Array


def tube(
    loop: Loop,
    steps: int,
    low: Float[Array, "n s"],
    high: Float[Array, "n s"],
    order: int = 0,
) -> Tube:
    """Return bounds of all ways from the starts between two corners, for a batch of boxes.

    They end early, after a step at which each box has docked or is known to be without a proof.

    Args:
        loop: the closed loop.
        steps: number of steps.
        low: the lowest (position, velocity) of each box.
        high: the highest (position, velocity) of each box.
        order: number of generators per number of the state that a reduction leaves, 0 to keep all.
    """
    size = low.shape[-1]
    total = size + loop.actions
    linear = 0 if loop.curved else size
    slots = min(EVERY, steps + 1) if order else steps + 1
    first = order * total if slots <= steps else size
    domain, rounding = _boxes(low, high, loop.actions, first, slots, linear)
    end = total + 1 + (loop.property == "docks")
    samples = []
    claims = []
    lows = []
    highs = []
    depths = []
    undecided = np.ones(len(low), bool)
    for t in range(steps + 1):
        slot = t % slots
        if t and not slot:
            domain, rounding = _reduced(domain, rounding, order)
        bounds = _with_room(bound(loop.following if t else loop.first, domain), size)
        domain, rounding = _following(bounds, domain, rounding, linear, first, slot)
        motion = bounds if loop.motion else domain
        samples.append(_sample(motion, bounds.low[:, total], loop.motion, loop.dimension))
        claims.append(Claims(*(x[:, size:total] for x in bounds[:3])))
        lows.append(domain.low)
        highs.append(domain.high)
        depths.append(bounds.low[:, total + 1 : end])
        undecided &= np.asarray(samples[-1].margin >= 0.0)
        if t and loop.property == "docks":
            undecided &= ~np.asarray(depths[-1][:, 0] >= 0.0)
        if not undecided.any():
            break

    def stack(*x: Array) -> Array:
        return jnp.stack(x, axis=1)

    margin = _with_gaps(loop.plant, jax.tree.map(stack, *samples))
    return Tube(margin, jax.tree.map(stack, *claims), stack(*lows), stack(*highs), stack(*depths))


@jax.jit
def _with_room(bounds: Bounds, size: int) -> Bounds:
    """Widen the bounds of the actions, so that a checker that rounds otherwise confirms them.

    The first `size` outputs are the state of the platforms, and stay as they are.
    """
    wider = bounds.radius * (1.0 + ROOM) + FINE
    acts = jnp.arange(wider.shape[-1]) >= size
    return bounds._replace(radius=jnp.where(acts, wider, bounds.radius))


@functools.partial(jax.jit, static_argnums=(2, 3, 4, 5))
@functools.partial(jax.vmap, in_axes=(0, 0, None, None, None, None))
def _boxes(
    low: Array, high: Array, actions: int, first: int, slots: int, linear: int
) -> tuple[Domain, Array]:
    """Return the set of starts of each box, and the generators of its rounding. The actions are 0.

    There is room for `first` generators, and for those of `slots` steps: one for each element from
    `linear` on.
    """
    size = low.shape[0]
    total = size + actions
    middle = 0.5 * (low + high)
    half = (1.0 + FINE) * jnp.maximum(high - middle, middle - low)

    def pad(x: Array) -> Array:
        return jnp.concatenate([x, jnp.zeros(actions)])

    generators = jnp.zeros((total, first + (total - linear) * slots))
    domain = Domain.of(
        centre=pad(middle),
        generators=generators.at[:size, :size].set(jnp.diag(half)),
        box=jnp.zeros(total),
        low=pad(low),
        high=pad(high),
    )
    return domain, jnp.zeros((total, total * (slots + 1)))


@functools.partial(jax.jit, static_argnums=2)
@functools.partial(jax.vmap, in_axes=(0, 0, None))
def _reduced(domain: Domain, rounding: Array, order: int) -> tuple[Domain, Array]:
    """Return a set with fewer generators around a set, and the generators of its rounding.

    This is the reduction of Girard: Reachability of Uncertain Linear Systems Using Zonotopes (HSCC
    2005), in coordinates in which the generators are not correlated. The generators whose box would
    be the least tight are kept. There is a box around the others in these coordinates.

    Args:
        domain: the states.
        rounding: generators that are so short that only the box around them counts.
        order: number of generators per element that are left.
    """
    total, count = domain.generators.shape
    kept = (order - 1) * total
    shear, rows = _uncorrelated(jnp.concatenate([domain.generators, rounding], axis=1))
    lengths = jnp.abs(rows)
    width = lengths.sum(-1, keepdims=True)
    share = lengths[:, :count] / jnp.where(width > 0.0, width, 1.0)
    longest = jnp.argsort(share.max(0) - share.sum(0))[:kept]
    half = (1.0 + FINE) * lengths.at[:, longest].set(0.0).sum(-1)
    left = jnp.zeros((total, count - kept - total))
    generators = jnp.concatenate([domain.generators[:, longest], shear * half, left], axis=1)
    fine = FINE * (jnp.abs(shear) @ half)
    rounding = jnp.zeros_like(rounding).at[:, :total].set(jnp.diag(fine))
    box = (1.0 + FINE) * fine
    return Domain.of(domain.centre, generators, box, domain.low, domain.high), rounding


def _uncorrelated(rows: Float[Array, "d k"]) -> tuple[Float[Array, "d d"], Float[Array, "d k"]]:
    """Return a unit lower triangular matrix and orthogonal rows whose product are the given rows.

    So the position comes first, the velocity is what the position does not tell of it, and the
    action what both do not tell.
    """
    total = len(rows)
    squares = (rows**2).sum(-1)
    shear = jnp.eye(total)
    for i in range(total - 1):
        square = rows[i] @ rows[i]
        counts = square > FLAT * squares[i]
        share = jnp.where(counts, rows[i + 1 :] @ rows[i] / jnp.where(counts, square, 1.0), 0.0)
        rows = rows.at[i + 1 :].add(-share[:, None] * rows[i])
        shear = shear.at[i + 1 :, i].set(share)
    return shear, rows


@functools.partial(jax.jit, static_argnums=3)
@functools.partial(jax.vmap, in_axes=(0, 0, 0, None, None, None))
def _following(
    bounds: Bounds, domain: Domain, rounding: Array, linear: int, first: Any, slot: Any
) -> tuple[Domain, Array]:
    """Return the states after a step, and the generators of their rounding.

    Args:
        bounds: bounds of the step's outputs.
        domain: the states before the step.
        rounding: generators that are so short that only the box around them counts.
        linear: number of elements that the plant maps without loss. What rounding leaves open of
            them is no generator of its own.
        first: number of generators before those of the first slot.
        slot: the slot for the generators of this step.
    """
    total = domain.centre.shape[0]
    slope = bounds.slope[:total]
    radius = bounds.radius[:total]
    fine = FINE * (jnp.abs(slope) @ domain.reach + jnp.abs(bounds.centre[:total]))
    curved = jnp.arange(total) >= linear
    rounded = jnp.diag((1.0 + FINE) * (jnp.where(curved, 0.0, radius) + fine))
    new = jnp.diag(radius)[:, linear:]
    put = jax.lax.dynamic_update_slice
    centre = slope @ domain.centre + bounds.centre[:total]
    generators = put(slope @ domain.generators, new, (0, first + (total - linear) * slot))
    rounding = put(slope @ rounding, rounded, (0, total * (slot + 1)))
    box = (1.0 + FINE) * jnp.abs(rounding).sum(-1)
    half = jnp.abs(generators).sum(-1) + box
    half = (1.0 + FINE) * half + FINE * jnp.abs(centre)
    following = Domain.of(
        centre=centre,
        generators=generators,
        box=box,
        low=jnp.maximum(bounds.low[:total], centre - half),
        high=jnp.minimum(bounds.high[:total], centre + half),
    )
    return following, rounding


@functools.partial(jax.jit, static_argnums=(2, 3))
def _sample(motion: Bounds | Domain, margin: Array, begin: int, dimension: int) -> _Sample:
    """Return what the bound between samples needs to know.

    Args:
        motion: bounds of vectors that have the position, and then the velocity, from `begin` on.
        margin: a lower bound of h.
        begin: the place of the position.
        dimension: number of elements of a position.
    """
    position, velocity = (
        slice(begin + i * dimension, begin + (i + 1) * dimension) for i in range(2)
    )
    far = jnp.maximum(jnp.abs(motion.low), jnp.abs(motion.high))
    near = jnp.maximum(jnp.maximum(motion.low, -motion.high), 0.0)

    def length(x: Array) -> Array:
        return jnp.sqrt((x**2).sum(-1))

    return _Sample(
        margin=margin,
        speed=length(far[:, velocity]) * (1.0 + FINE),
        distance=length(far[:, position]) * (1.0 + FINE),
        nearest=length(near[:, position]) * (1.0 - FINE),
    )


@jax.jit
def _with_gaps(plant: Plant, samples: _Sample) -> Float[Array, " t"]:
    """Return lower bounds of h over each step from what is known at its ends.

    See docs/verification.md for the proof.
    """
    before = jax.tree.map(lambda x: x[:, :-1], samples)
    after = jax.tree.map(lambda x: x[:, 1:], samples)
    gap = between(
        plant,
        speed=jnp.maximum(before.speed, after.speed),
        distance=jnp.maximum(before.distance, after.distance),
        nearest=jnp.maximum(before.nearest, after.nearest),
    )
    inside = jnp.minimum(before.margin, after.margin) - gap
    return jnp.concatenate([samples.margin[:, :1], inside], axis=1)


def between(plant: Plant, speed: Array, distance: Array, nearest: Array) -> Array:
    """Return by how much h may fall below its values at both ends of a step.

    Args:
        plant: numbers of the plant.
        speed: a bound on ‖v‖ at the ends [m/s].
        distance: a bound on ‖r‖ at the ends [m].
        nearest: a lower bound of ‖r‖ at one end [m].
    """
    n = plant.mean_motion
    time = plant.dt
    share = 1.0 - n * time - 0.75 * (n * time) ** 2
    v = (speed + 0.5 * time * (plant.acceleration + 3.0 * n**2 * distance)) / share
    r = distance + 0.5 * time * v
    first = plant.acceleration + 2.0 * n * v + 3.0 * n**2 * r  # ‖r̈‖
    turning = plant.turn_rate * plant.acceleration
    second = 3.0 * n**2 * v + 2.0 * n * first + turning  # ‖v̈‖
    way = time * v
    chord = jnp.maximum(nearest - way, 0.0)
    bend = jnp.where(chord > 0.0, 0.5 * way**2 / jnp.where(chord > 0.0, chord, 1.0), jnp.inf)
    lag = jnp.minimum(2.0 * way, bend)
    drop = 0.25 * (0.5 * time**2 * second + plant.slope * (0.5 * time**2 * first + lag))
    return jnp.where(share > 0.0, drop, jnp.inf) * (1.0 + 1e-6)
