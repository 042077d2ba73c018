"""Bounds of docking: a flight at the speed limit, and the primer vector of the least Δv."""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.linalg
from jaxtyping import Array, Float

from jaxsafe.environment import Environment
from jaxsafe.processors.reward import (
    DeltaVCost,
    DistanceChange,
    Failure,
    Success,
    VelocityConstraint,
)
from jaxsafe.processors.status import Distance, InRegion, Speed, VelocityLimit
from jaxsafe.processors.terminal import Crashed, Docked, Timeout, TooFar, time_limit
from jaxsafe.simulation.cwh import Anchor, Spacecraft
from jaxsafe.simulation.double_integrator import DoubleIntegrator
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.transition import bounds as control_bounds
from jaxsafe.types import State

PLANTS = (Spacecraft, DoubleIntegrator, OrientedSpacecraft)
REWARDS = (DistanceChange, VelocityConstraint, DeltaVCost, Success, Failure)
ENDS = (Docked, Crashed, TooFar, Timeout)

BLOCKS = 24
"""Number of lengths of an episode for which a primer vector is sought.

Lengths in between try those of the next shorter and the next longer one, as given by their values
at start and end.
"""

SAMPLES = 60
"""Number of instants at which the search looks at a primer vector."""

FINE = 0.02
"""Angle of the orbit [rad] between two samples of a primer vector of which a bound is made."""

ROUGH = 0.1
"""The same angle where a bound only has to rule out a length."""

ROUNDS = 300
"""Number of steps of gradient ascent on a bound. More rounds make it tighter, never wrong."""


def docking_bounds(env: Environment, starts: State) -> dict[str, np.ndarray] | None:
    """Return the bounds that `best_possible` describes, or None if the task is another one."""
    task = _Task.of(env)
    if task is None:
        return None
    state = starts.sim.platforms[env.agent]
    position = np.asarray(state.position, np.float64)
    velocity = np.asarray(state.velocity, np.float64)
    at_limit = _least_length(task, state, hurried=True)
    length = _least_length(task, state)
    delta_v, cost = _least_delta_v(task, np.concatenate([position, velocity], axis=-1), length)
    # Whoever breaks the limit may be a step faster for `offset`, and needs the least Δv of all.
    time = (at_limit - 1) * task.dt / task.time_scale
    cost = np.minimum(cost, task.offset + time + task.delta_v_cost * delta_v)
    bounds = {"length": length, "delta_v": delta_v}
    if task.pays_to_break_the_limit:
        return bounds
    share = 0.5 ** (np.linalg.norm(position, axis=-1) / task.half_distance)
    best = np.maximum(task.success - cost, 0.0)  # a failure pays nothing, or less
    return {**bounds, "return": task.potential * (1.0 - share) + best}


class _Axis(NamedTuple):
    """What a deputy can do that thrusts along its body axis."""

    forwards: float
    """Largest acceleration along the axis [m/s²]."""
    backwards: float
    """Largest acceleration against it [m/s²]."""
    rate: float
    """Largest attitude rate [rad/s]."""
    acceleration: float
    """Largest attitude acceleration [rad/s²]."""


class _Task(NamedTuple):
    """The numbers of a docking task on which the bounds rest."""

    dimension: int
    dt: float
    mean_motion: float
    push: float
    """Largest acceleration by thrust [m/s²]."""
    axis: _Axis | None
    """The body axis along which the deputy thrusts, if it cannot thrust in every direction."""
    radius: float
    floor: float
    slope: float
    constant_to: float
    last_step: int
    """Largest number of steps of a success."""
    potential: float
    half_distance: float
    success: float
    time_scale: float
    delta_v_cost: float
    offset: float
    """What a step above the limit costs at least."""
    excess_cost: float
    """What such a step costs in addition for each m/s above the limit."""

    @classmethod
    def of(cls, env: Environment) -> _Task | None:
        """Return the numbers of an environment, or None if it is no docking task."""
        plant = env.agent_platform
        rewards = {type(term): term for term in env.reward}
        limits = [item for item in env.status if type(item) is VelocityLimit]
        last = time_limit(env)
        known = (
            type(plant) in PLANTS
            and [type(item) for item in env.platforms if item is not plant] == [Anchor]
            and Counter(map(type, env.reward)) == Counter(REWARDS)
            and Counter(map(type, env.terminal)) == Counter(ENDS)
            and len(env.regions) == 1
            and len(limits) == 1
            and last is not None
            and env.successes == ("success",)
        )
        if not known:
            return None
        numbers: Any = rewards
        statuses = {status.name: type(status) for status in env.status}
        docked: Any = next(item for item in env.terminal if type(item) is Docked)
        measured = [numbers[DistanceChange].distance, docked.in_docking, docked.speed]
        if [statuses[name] for name in measured] != [Distance, InRegion, Speed]:
            return None
        dt = float(env.dt)
        low, high = control_bounds(env)
        largest = np.maximum(-np.asarray(low, float), np.asarray(high, float))
        names = env.action_names
        thrusts = [largest[i] for i, name in enumerate(names) if name.startswith("thrust")]
        axis = None
        if isinstance(plant, OrientedSpacecraft):
            by_name = dict(zip(names, zip(low.tolist(), high.tolist(), strict=True), strict=True))
            least, most = by_name.get("thrust", (0.0, 0.0))
            axis = _Axis(
                forwards=max(most, 0.0) / float(plant.mass),
                backwards=max(-least, 0.0) / float(plant.mass),
                rate=float(np.max(np.abs(np.asarray(plant.attitude_rate_limits)))),
                acceleration=max(map(abs, by_name.get("attitude_acceleration", (0.0,)))),
            )
        failures = numbers[Failure].values
        gains = (
            numbers[DistanceChange].scale,
            *(-value for value in failures.values()),
            -numbers[DeltaVCost].scale,
            -numbers[VelocityConstraint].scale,
            -numbers[VelocityConstraint].offset,
        )
        if min(map(float, gains)) < 0.0:  # such rewards could pay for failures or for thrust
            return None
        return cls(
            dimension=plant.dimension,
            dt=dt,
            mean_motion=float(getattr(plant, "mean_motion", 0.0)),
            push=float(np.linalg.norm(thrusts)) / float(plant.mass),  # type: ignore[attr-defined]
            axis=axis,
            radius=float(env.regions[0].radius),  # type: ignore[attr-defined]
            floor=float(limits[0].floor),
            slope=float(limits[0].slope),
            constant_to=float(limits[0].constant_to),
            last_step=int(np.floor(float(last) / dt + 1e-6)) + 1,  # type: ignore[arg-type]
            potential=float(numbers[DistanceChange].scale),
            half_distance=float(numbers[DistanceChange].half_distance),
            success=float(numbers[Success].value),
            time_scale=float(numbers[Success].time_scale),
            delta_v_cost=-float(numbers[DeltaVCost].scale),
            offset=-float(numbers[VelocityConstraint].offset),
            excess_cost=-float(numbers[VelocityConstraint].scale),
        )

    def limit(self, distance: Any) -> Any:
        """Return the speed limit [m/s] at a distance."""
        return self.floor + self.slope * np.maximum(distance - self.constant_to, 0.0)

    def highest_speed(self, distance: Any, first: Any) -> Any:
        """Return the highest speed in a step that begins at a distance [m/s].

        Within the step the speed may exceed that at its ends by dt²/8 times the largest second
        derivative of the velocity.

        Args:
            distance: the distance where the step begins, within the limit there.
            first: the speed where the step begins if it may be above the limit, else 0.
        """
        n = self.mean_motion
        speed = np.maximum(self.limit(distance), first)
        spin = 0.0 if self.axis is None else self.axis.rate
        bend = self.push * (2.0 * n + spin) + 8.0 * n**2 * speed + 6.0 * n**3 * distance
        return speed + self.dt**2 / 8.0 * bend

    @property
    def pays_to_break_the_limit(self) -> bool:
        """Whether a step above the limit may save more time than its penalty is worth.

        A step that is e m/s too fast moves at most 2 e dt farther, once before its sample and once
        after it. At the limit this way takes 2 e dt/ν₀, and the whole number of steps one more.
        """
        worth = 2.0 * self.dt / max(self.floor, 1e-9) / self.time_scale
        return worth > self.excess_cost or self.dt / self.time_scale > self.offset


def _least_length(task: _Task, start: Any, hurried: bool = False) -> np.ndarray:
    """Return the least number of steps of a success that never exceeds the limit, per start.

    In a step the distance falls by at most dt times the highest speed on the way. That is the limit
    at the beginning of the step, and what the speed may bulge in between: dt²/8 times the largest
    second derivative of the velocity.

    At first the deputy is slower, because it must gain speed. With the distance D, the unit vector
    s to the chief, the approach speed u = s·v and the speed w across s,

        du/dt = s·a − w²/D + s·f ≤ s·a + 3n²D + 2n‖v‖,

    where a is the acceleration by thrust and f that without it. So u is at most what it was at the
    start and the integral of the right-hand side. `_largest_approach` bounds s·a.

    By induction nothing is nearer than the distance that falls by the lesser of both in each step.

    Args:
        task: the task.
        start: the states of the deputy at the start. Every array is [starts, …].
        hurried: whether to leave out that the deputy must gain speed.
    """
    position = np.asarray(start.position, np.float64)
    velocity = np.asarray(start.velocity, np.float64)
    nearest = np.linalg.norm(position, axis=-1)
    farthest = nearest
    sight = -position / np.maximum(nearest, 1e-9)[:, None]
    approach = np.sum(sight * velocity, axis=-1)
    turned = np.zeros(nearest.shape)  # how far the line of sight can have turned
    steps = np.zeros(nearest.shape, int)
    first = np.linalg.norm(velocity, axis=-1)
    for step in range(task.last_step):
        outside = nearest > task.radius
        if not outside.any():
            break
        fastest = task.highest_speed(nearest, first)
        fall = fastest
        if not hurried:
            # The limit at the end of the step is that of a distance which grows by dt · `highest`.
            highest = task.highest_speed(farthest, first) / max(1.0 - task.dt * task.slope, 1e-9)
            farthest = farthest + task.dt * highest
            turned = turned + task.dt * highest / np.maximum(nearest - task.dt * fastest, 1e-9)
            drift = 3.0 * task.mean_motion**2 * farthest + 2.0 * task.mean_motion * highest
            push = _largest_approach(task, start, sight, (step + 1) * task.dt, turned)
            later = approach + task.dt * (push + drift)
            fall = np.minimum(fastest, (approach + later) / 2.0)
            approach = later
        nearest = nearest - task.dt * fall
        first = 0.0
        steps += outside
    return steps


def _largest_approach(
    task: _Task, start: Any, sight: np.ndarray, time: float, turned: np.ndarray
) -> np.ndarray:
    """Return a bound on the acceleration by thrust towards the chief, up to a time [m/s²].

    Thrust along a body axis pushes towards the chief by its cosine alone. The angle between both is
    that at the start, less how far the axis and the line of sight can have turned.

    Args:
        task: the task.
        start: the states of the deputy at the start, [starts].
        sight: the unit vectors to the chief at the start, (starts, d).
        time: the time since the start [s].
        turned: how far the line of sight can have turned by then [rad], (starts,).
    """
    if task.axis is None:
        return np.full(turned.shape, task.push)
    attitude = np.asarray(start.attitude, np.float64)
    rate = np.abs(np.asarray(start.attitude_rate, np.float64))
    gain = np.maximum(task.axis.rate - rate, 0.0)
    spent = np.minimum(gain / max(task.axis.acceleration, 1e-12), time)
    turn = np.minimum(rate, task.axis.rate) * time
    turn = turn + task.axis.acceleration * spent * (time - spent / 2.0)
    axis = np.stack([np.cos(attitude), np.sin(attitude)], axis=-1)
    angle = np.arccos(np.clip(np.sum(axis * sight, axis=-1), -1.0, 1.0))
    ahead = np.clip(angle - turn - turned, 0.0, np.pi / 2.0)
    astern = np.clip(np.pi - angle - turn - turned, 0.0, np.pi / 2.0)
    return np.maximum(task.axis.forwards * np.cos(ahead), task.axis.backwards * np.cos(astern))


def _least_delta_v(
    task: _Task, states: np.ndarray, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least Δv of a success [m/s], and the least cost of time and Δv, per start.

    Let q(t) be a primer vector: a solution of the adjoint of the linear motion, with the costate λ
    at the start and p at the end. For every thrust acceleration a(t)

        p·x(T) = λ·x(0) + ∫ q·a dt ≤ λ·x(0) + max‖q‖ ∫ ‖a‖ dt.

    A success ends with ‖r‖ ≤ R and ‖v‖ ≤ V, so p·x(T) ≥ −R‖p_r‖ − V‖p_v‖. Hence

        ∫ ‖a‖ dt ≥ (−λ·x(0) − R‖p_r‖ − V‖p_v‖) / max‖q‖

    for every λ: the weak duality of Neustadt (1964) and the primer vector of Lawden (1963).
    Gradient ascent looks for a good λ, for each start and some lengths T. What it finds is then
    evaluated for every length in float64. Thrust may be as large as it likes here, in any
    direction, and the speed limit counts at the end alone. So the bound holds for every success.

    Args:
        task: the task.
        states: position and velocity at the start, (starts, 2d).
        length: the least number of steps within the limit, per start.
    """
    size = task.dimension
    speed = float(task.limit(task.radius))
    step = scipy.linalg.expm(-task.dt * _motion(task))
    back = [np.eye(2 * size)]
    for _ in range(task.last_step):
        back.append(step @ back[-1])
    flows = np.stack(back)  # Φ(−k dt)
    primers = np.swapaxes(flows[:, :, size:], 1, 2)  # q(k dt) = primers[k] λ
    first = np.broadcast_to(primers[0], primers.shape)
    costates = np.linalg.pinv(np.concatenate([first, primers], axis=1))  # λ of q(0) and q(k dt)
    edges = np.unique(np.round(np.geomspace(1, task.last_step + 1, BLOCKS + 1)).astype(int))
    found = [
        _ascend(states, flows, costates[after - 1], after - 1, (task.radius, speed))
        for after in edges[1:]
    ]

    def bound(count: int, which: np.ndarray, angle: float) -> np.ndarray:
        """Return the bound on Δv of the starts `which`, for a flight of `count` steps."""
        block = int(np.searchsorted(edges, count, side="right")) - 1
        tried = np.stack([found[max(block - 1, 0)][which], found[block][which]])
        costate = tried @ costates[count].T
        arrival = costate @ flows[count]
        target = task.radius * np.linalg.norm(arrival[..., :size], axis=-1)
        target = target + speed * np.linalg.norm(arrival[..., size:], axis=-1)
        samples = np.unique([*range(0, count, _apart(task, angle)), count])
        q = costate @ np.transpose(primers[samples], (1, 2, 0))[:, None]
        largest = _largest(task, q, samples * task.dt)
        value = -np.sum(costate * states[which], axis=-1) - target
        return np.maximum(np.max(value / np.maximum(largest, 1e-300), axis=0), 0.0)

    # Few samples of q already tell that most lengths do not have the least Δv.
    least = np.full(len(states), np.inf)
    for count in range(task.last_step, 0, -1):
        rough = bound(count, np.arange(len(states)), ROUGH)
        which = np.flatnonzero(rough < least)
        if len(which):
            least[which] = np.minimum(least[which], bound(count, which, FINE))
    least_cost = np.full(len(states), np.inf)
    for count in range(max(int(length.min()), 1), task.last_step + 1):
        time = count * task.dt / task.time_scale
        open_ = time + task.delta_v_cost * least < least_cost
        if not open_.any():
            break
        which = np.flatnonzero(open_ & (length <= count))
        cost = time + task.delta_v_cost * bound(count, which, FINE)
        least_cost[which] = np.minimum(least_cost[which], cost)
    return least, least_cost


def _apart(task: _Task, angle: float) -> int:
    """Return the number of steps between two samples of a primer vector, `angle` of an orbit."""
    turn = task.mean_motion * task.dt
    return max(1, min(100, int(angle / turn))) if turn else 100


def _largest(task: _Task, q: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return a bound on the largest ‖q(t)‖ from the first sample of q to the last.

    Between two samples q leaves the straight line by h²/8 ‖q̈‖ at most. A primer vector moves like
    the spacecraft, so ‖q̈‖ ≤ 3n²‖q‖ + 2n‖q̇‖, and ‖q̇‖ is at most h/2 ‖q̈‖ above its mean value.

    Args:
        task: the task.
        q: the samples, (d, …, samples).
        times: their times, (samples,).
    """
    n = task.mean_motion
    gaps = np.diff(times)
    h = np.max(gaps)
    size = np.sqrt(np.max(np.sum(q**2, axis=0), axis=-1))
    rate = np.sqrt(np.max(np.sum(np.diff(q, axis=-1) ** 2, axis=0) / gaps**2, axis=-1))
    part = 1.0 - 3.0 * n**2 * h**2 / 8.0 - n * h
    if part <= 0.0:  # the samples are too far apart to say anything
        return np.full_like(size, np.inf)
    bend = (3.0 * n**2 * size + 2.0 * n * rate) / part
    return size + h**2 / 8.0 * bend


def _motion(task: _Task) -> np.ndarray:
    """Return A of ẋ = A x for the motion without thrust, Eqs. (12), (16), with x = (r, v)."""
    size = task.dimension
    n = task.mean_motion
    matrix = np.zeros((2 * size, 2 * size))
    matrix[:size, size:] = np.eye(size)
    if n:
        matrix[size, 0] = 3.0 * n**2
        matrix[size, size + 1] = 2.0 * n
        matrix[size + 1, size] = -2.0 * n
        if size == 3:
            matrix[5, 2] = -(n**2)
    return matrix


def _ascend(
    states: np.ndarray,
    flows: np.ndarray,
    to_costate: np.ndarray,
    count: int,
    ends: tuple[float, float],
) -> np.ndarray:
    """Return primer vectors at start and end that make the bound of one length large, per start.

    The search begins with the transfer to the origin by a single push.

    Args:
        states: position and velocity at the start, (starts, 2d).
        flows: Φ(−k dt) for every k, (steps, 2d, 2d).
        to_costate: the matrix that makes λ of the primer vectors at start and end.
        count: the number of steps.
        ends: the largest distance and the largest speed at the end.

    Returns:
        q(0) and q(T) of shape (starts, 2d), in float64.
    """
    size = states.shape[1] // 2
    # Φ(T) x(0) + Φ(T) (0, Δ) has the position 0.
    flow = np.linalg.inv(flows[count])
    push = -np.linalg.lstsq(flow[:size, size:], flow[:size] @ states.T, rcond=None)[0].T
    push = push / np.maximum(np.linalg.norm(push, axis=1, keepdims=True), 1e-12)
    # The number of samples is the same for all lengths, so that the search is compiled once.
    samples = np.linspace(0, count, SAMPLES).round().astype(int)
    arrays = (
        np.concatenate([push, np.zeros_like(push)], axis=1),
        states,
        to_costate,
        np.swapaxes(flows[samples][:, :, size:], 1, 2),
        flows[count],
        np.asarray(ends),
    )
    return np.asarray(_search(*(jnp.asarray(array, jnp.float32) for array in arrays)), np.float64)


@jax.jit
def _search(
    start: Float[Array, "s x"],
    states: Float[Array, "s x"],
    to_costate: Float[Array, "x x"],
    primers: Float[Array, "k d x"],
    flow: Float[Array, "x x"],
    ends: Float[Array, " 2"],
) -> Float[Array, "s x"]:
    """Return the primer vectors at start and end with the largest bound that was met."""
    size = primers.shape[1]

    def bound(ratios: Array, state: Array) -> Array:
        costate = to_costate @ ratios
        arrival = (costate @ flow).reshape(2, size)
        norms = jnp.sqrt(jnp.sum(arrival**2, axis=-1) + 1e-20)
        q = jnp.sqrt(jnp.sum((primers @ costate) ** 2, axis=-1) + 1e-20)
        return (-costate @ state - norms @ ends) / jnp.max(q)

    values = jax.vmap(jax.value_and_grad(bound))
    optimiser = optax.adam(optax.cosine_decay_schedule(0.03, ROUNDS))

    def improve(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
        ratios, memory, best, best_value = carry
        value, slope = values(ratios, states)
        better = value > best_value
        best = jnp.where(better[:, None], ratios, best)
        change, memory = optimiser.update(-slope, memory)
        following = optax.apply_updates(ratios, change)
        return (following, memory, best, jnp.maximum(value, best_value)), None

    begin = (start, optimiser.init(start), start, jnp.full(len(start), -jnp.inf))
    (_, _, best, _), _ = jax.lax.scan(improve, begin, None, ROUNDS)
    return best
