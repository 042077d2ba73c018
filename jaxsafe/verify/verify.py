"""The search for a proof: boxes of starts are proved, refuted, or halved."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.devices.seed_mapper import usable_cores
from jaxsafe.environment import Environment, require_environment, reset_to, step
from jaxsafe.processors.terminal import TooFar, time_limit
from jaxsafe.rollout import Policy, RecurrentPolicy
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.types import State, TimeStep
from jaxsafe.verify.loop import (
    CRAFT,
    Loop,
    Property,
    closed_loop,
    depth,
    docking_region,
    parts,
    start_of,
)
from jaxsafe.verify.tube import Claims, tube

BATCH = 64
"""Number of boxes that are bounded at once."""

FIRST_WIDTHS: Mapping[str, float] = {
    "position": 18.0,
    "velocity": 0.1,
    "attitude": 0.2,
    "attitude_rate": 0.02,
}
"""Largest widths of the first boxes of spacecraft, by field [m, m/s, rad, rad/s]."""

AIRCRAFT_WIDTHS: Mapping[str, float] = {"position": 200.0, "heading": 0.1, "speed": 20.0}
"""Largest widths of the first boxes of aircraft, by field [ft, rad, ft/s].

A box is halved where it is widest in units of these.
"""

SCALES: Mapping[Property, Mapping[str, float]] = {
    "safe": {**FIRST_WIDTHS, "position": 6.0, "velocity": 0.047},
    "docks": {**FIRST_WIDTHS, "position": 0.125, "velocity": 0.02},
}
"""Widths of spacecraft that count the same when a box is halved, by field [m, m/s, rad, rad/s].

Near the chief the direction to it changes most with the position.
"""

RESOLUTION = 2048
"""The default resolution: a box below this part of `FIRST_WIDTHS` is not halved."""

SAMPLES = 16
"""Number of starts that are flown from a box without a proof."""

MAX_BOUND = 1e6
"""Largest absolute value of a bound of a box [m, m/s]."""

_Corners = tuple[np.ndarray, np.ndarray]
"""The lowest and the highest corner of a box."""

Box = Mapping[str, Any]
"""Intervals by field, `deputy.position` or `position`: one for each axis, or one for all axes.

The fields of platforms other than the agent's have the name of the platform.
"""


class Boxes(NamedTuple):
    """Boxes of starts, by their corners. `Loop.columns` says what each number is."""

    low: Float[np.ndarray, "n s"]
    high: Float[np.ndarray, "n s"]

    @property
    def volume(self) -> float:
        """The sum of their volumes. An axis that a box does not have counts as 1."""
        widths = self.high - self.low
        return float(np.prod(np.where(widths > 0.0, widths, 1.0), axis=1).sum())


class Counterexample(NamedTuple):
    """A start from which the property is violated."""

    start: dict[str, dict[str, list[float]]]
    """For `jaxsafe.reset_to`, in single precision."""
    step: int
    """The step at whose end the margin is negative first, 0 for the start itself.

    For a flight that does not dock it is the last step.
    """
    margin: float
    """The margin h there. For a flight that does not dock it is the largest depth in the region."""
    undocked: bool = False
    """Whether the flight keeps the limit and does not dock."""


class Verification(NamedTuple):
    """What is known of all starts in a box."""

    result: Literal["proved", "refuted", "open"]
    proved: Boxes
    refuted: Boxes
    """Boxes with a start that violates the property, if the search went on after the first."""
    open: Boxes
    claims: Claims
    """What the proof says of the policy, by proved box, see `jaxsafe.verify.tube.Claims`."""
    last: np.ndarray
    """The last step of each proved box that the proof covers: where all its starts have docked."""
    margin: float
    """A lower bound of h along all episodes from the proved boxes, up to their last steps."""
    counterexample: Counterexample | None
    box: Boxes
    loop: Loop
    steps: int
    order: int
    """Number of generators per number of the state that a reduction left, 0 without one."""
    seconds: float
    bounded: int
    """Number of boxes that were bounded, before `resume` too."""

    def shares(self) -> dict[str, float]:
        """Return which share of the volume is proved, refuted and open."""
        whole = self.box.volume
        return {name: getattr(self, name).volume / whole for name in ("proved", "refuted", "open")}


def verify(
    env: Environment,
    policy: Policy | RecurrentPolicy,
    box: Box,
    steps: int = 40,
    *,
    property: Property = "safe",
    arithmetic: Literal["float32", "real"] = "float32",
    seconds: float = math.inf,
    max_boxes: int = 100_000,
    everything: bool = False,
    resolution: int = RESOLUTION,
    order: int = 0,
    resume: Verification | None = None,
    progress: Callable[[Verification], None] = lambda _: None,
) -> Verification:
    """Prove that a policy keeps the safety constraint from every start in a box, or refute it.

    The proof is about `steps` steps of the environment, whether the episode has ended or not, and
    about the time between them. With the property `docks` it says that every episode ends with a
    success after at most `steps` steps, and keeps the constraint until then.

    Args:
        env: the environment. Its agent is a spacecraft that keeps a speed limit, or an aircraft
            that keeps a distance from another one.
        policy: `policy(key, observation)` returns actions for a batch of observations. It must be
            deterministic.
        box: intervals of the start, such as `{"deputy.position": [[70, 106], [70, 106]],
            "deputy.velocity": [-0.28, 0.28]}` [m, m/s].
        steps: number of steps.
        property: `safe` or `docks`.
        arithmetic: `float32` proves the loop as it runs in single precision, `real` that of real
            numbers.
        seconds: the time after which to stop [s]. Boxes that are left are then open.
        max_boxes: the largest number of boxes to bound. Those before `resume` do not count.
        everything: whether to go on after a counterexample, for a map of the box.
        resolution: a box is not halved if all its widths are at most this part of `FIRST_WIDTHS`.
        order: number of generators per number of the state to which the sets of states are reduced
            from time to time, 0 to keep all generators.
        resume: a verification of the same loop and box to go on from.
        progress: a function that is called after each batch of boxes.

    Returns:
        What is known. The first Ctrl-C ends the search as a limit does.

    Raises:
        ConfigError: the box is no box of starts, or nothing can be proved of the loop.
    """
    require_environment("verify: env", env)
    began = time.monotonic()
    if isinstance(policy, RecurrentPolicy):
        raise ConfigError(
            "run: the policy remembers; a proof needs one that sees the present alone"
        )
    if property not in get_args(Property):
        raise ConfigError(f"property: found {show(property)}; choose from safe, docks")
    loop = closed_loop(env, policy, arithmetic, property)
    _require_time(env, property, steps)
    whole = corners(env, box)
    if order < 0:
        raise ConfigError(f"order: found {order}; expected 0 or more")
    search = _Search(env, policy, loop, whole, steps, resolution, order)
    if resume is not None:
        _require_same(resume, loop, whole, steps, order)
        search.go_on(resume)
    most = search.known.bounded + max_boxes
    try:
        while search.known.waiting and search.known.bounded < most:
            if time.monotonic() - began > seconds:
                break
            if search.known.counterexample and not everything:
                break
            search.advance()
            progress(search.verification(time.monotonic() - began))
    except KeyboardInterrupt:
        pass
    return search.verification(time.monotonic() - began)


def _require_time(env: Environment, property: Property, steps: int) -> None:
    """Refuse to ask whether the agent docks after the end of the episode.

    Raises:
        ConfigError: the episode ends before the last step.
    """
    limit = time_limit(env)
    if property == "docks" and limit is not None and steps * float(env.dt) > float(limit):
        raise ConfigError(
            f"steps: found {steps}; the episode ends after {float(limit):g} s, and a step "
            f"takes {float(env.dt):g} s"
        )


def corners(env: Environment, box: Box) -> Boxes:
    """Return the corners of a box of starts.

    Raises:
        ConfigError: a field is missing or unknown, or its value is not made of intervals.
    """
    known = {f"{part.platform}.{part.field}": part for part in parts(env)}
    short = {part.name for part in known.values()}
    for key in box:
        if key not in known and key not in short:
            raise ConfigError(f"box.{key}: no field of a start{choices_text(key, known)}")
    drawn = {
        f"{platform.name}.{field}" for platform in env.platforms for field in platform.random_fields
    }
    ends = []
    for name, part in known.items():
        # What no start of the task draws is 0 unless it is given.
        given = box.get(name, box.get(part.name, None if name in drawn else (0.0, 0.0)))
        if given is None:
            raise ConfigError(f"box.{name}: missing; give an interval for each axis")
        try:
            array = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            array = np.zeros(0)
        count = part.size or 1
        array = np.broadcast_to(array, (count, 2)) if array.shape == (2,) else array
        fits = array.shape == (count, 2) and np.all(np.abs(array) <= MAX_BOUND)
        if not fits or np.any(array[:, 0] > array[:, 1]):
            wanted = f"{count} intervals" if part.size else "an interval"
            raise ConfigError(
                f"box.{name}: expected {wanted} [low, high] "
                f"within ±{MAX_BOUND:.0e}, found {show(given)}"
            )
        ends.append(array)
    low, high = np.concatenate(ends).T
    if isinstance(env.agent_platform, CRAFT):
        _require_near(env, low, high)
    return Boxes(low[None], high[None])


def _widths(env: Environment, by_field: Mapping[str, float]) -> Float[np.ndarray, " s"]:
    """Return a width for each number of a start."""
    return np.concatenate([np.full(part.size or 1, by_field[part.field]) for part in parts(env)])


def first_widths(env: Environment) -> Float[np.ndarray, " s"]:
    """Return the largest width of the first boxes, for each number of a start."""
    craft = isinstance(env.agent_platform, CRAFT)
    return _widths(env, FIRST_WIDTHS if craft else AIRCRAFT_WIDTHS)


def _require_near(env: Environment, low: np.ndarray, high: np.ndarray) -> None:
    """Refuse a box whose start nearest to the chief is beyond the distance that ends episodes.

    Raises:
        ConfigError: it is.
    """
    _, timestep = reset_to(env, start_of(env, np.clip(0.0, low, high)))
    for end in env.terminal:
        if isinstance(end, TooFar) and timestep.info.ended[end.name]:
            raise ConfigError(
                f"box.{env.agent}.position: every start is farther than {float(end.limit):,.10g} m,"
                f" where {end.name} ends the episode"
            )


def _require_same(known: Verification, loop: Loop, whole: Boxes, steps: int, order: int) -> None:
    """Refuse to go on from a verification of something else.

    Raises:
        ConfigError: the loop, the box, the number of steps or the order differs.
    """
    same = {
        "the property": known.loop.property == loop.property,
        "the closed loop": _same_numbers(known.loop, loop),
        "the box": _same_numbers(known.box, whole),
        "steps": known.steps == steps,
        "order": known.order == order,
    }
    for what, fits in same.items():
        if not fits:
            raise ConfigError(f"resume: {what} is not that of the certificate")


def _same_numbers(a: Any, b: Any) -> bool:
    leaves, others = jax.tree.leaves(a), jax.tree.leaves(b)
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        np.array_equal(x, y) for x, y in zip(leaves, others, strict=True)
    )


def _cells(whole: Boxes, largest: Float[np.ndarray, " s"]) -> list[_Corners]:
    """Return the first boxes, none of them wider than the largest widths."""
    counts = np.maximum(1, np.ceil((whole.high[0] - whole.low[0]) / largest)).astype(int)
    edges = [
        np.linspace(low, high, count + 1)
        for low, high, count in zip(whole.low[0], whole.high[0], counts, strict=True)
    ]
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1).reshape(
        -1, len(edges)
    )
    low, high = (
        np.stack([edge[i + shift] for edge, i in zip(edges, index.T, strict=True)], axis=-1)
        for shift in (0, 1)
    )
    return list(zip(low, high, strict=True))


class _Known(NamedTuple):
    """What a search knows at one time. It is replaced as a whole, so that Ctrl-C loses no box."""

    waiting: list[_Corners]
    """Boxes to bound, as their lowest and highest corner."""
    proved: list[Any]
    """Corners, claims and last steps of proved boxes, by batch."""
    refuted: list[Any]
    stuck: list[Any]
    """Boxes that are too small to halve."""
    margin: float = math.inf
    counterexample: Counterexample | None = None
    seconds: float = 0.0
    """The time that earlier searches took [s]."""
    bounded: int = 0


class _Search:
    """The boxes of a search, and what is known of them."""

    def __init__(
        self,
        env: Environment,
        policy: Policy,
        loop: Loop,
        whole: Boxes,
        steps: int,
        resolution: int,
        order: int = 0,
    ) -> None:
        self.env = env
        self.loop = loop
        self.whole = whole
        self.steps = steps
        self.resolution = resolution
        self.order = order
        self.widths = first_widths(env)
        craft = isinstance(env.agent_platform, CRAFT)
        self.scales = _widths(env, SCALES[loop.property]) if craft else self.widths
        self.most = BATCH * usable_cores()
        self.pool = ThreadPoolExecutor(usable_cores())
        self.key = jax.random.key(0)
        self.fly = jax.jit(jax.vmap(lambda x: _flight(env, policy, steps, loop.property, x)))
        self.known = _Known(_cells(whole, self.widths), [], [], [])

    def go_on(self, earlier: Verification) -> None:
        """Begin with what an earlier search knows."""
        self.known = _Known(
            waiting=[*zip(*earlier.open, strict=True)],
            proved=[(*earlier.proved, earlier.claims, earlier.last)]
            if len(earlier.proved.low)
            else [],
            refuted=[earlier.refuted],
            stuck=[],
            margin=earlier.margin,
            counterexample=earlier.counterexample,
            seconds=earlier.seconds,
            bounded=earlier.bounded,
        )

    def advance(self) -> None:
        """Bound one batch of boxes on each core."""
        known = self.known
        count = min(self.most, len(known.waiting))
        low, high = (np.stack(ends) for ends in zip(*known.waiting[:count], strict=True))
        parts = [slice(i, i + BATCH) for i in range(0, count, BATCH)]
        bounds = list(self.pool.map(lambda part: self.bound(low[part], high[part]), parts))
        margin, claims, last = jax.tree.map(lambda *x: np.concatenate(x), *bounds)
        done = last >= 0
        share = np.zeros(count)
        violation = None
        if not done.all():
            share[~done], violation = self.flown(low[~done], high[~done], known.bounded)
        widths = (high - low) / self.widths
        small = widths.max(axis=1) * self.resolution <= 1.0
        # Where all flights violate the property, smaller boxes would say nothing more.
        refuted = ~done & ((share == 1.0) | (small & (share > 0.0)))
        stuck = ~done & small & ~refuted
        wide = np.flatnonzero(~done & ~refuted & ~stuck)
        proved = [(low[done], high[done], jax.tree.map(lambda x: x[done], claims), last[done])]
        halves = [half for i in wide for half in self.halves(low[i], high[i])]
        self.known = known._replace(
            waiting=known.waiting[count:] + halves,
            proved=known.proved + (proved if done.any() else []),
            refuted=[*known.refuted, (low[refuted], high[refuted])],
            stuck=[*known.stuck, (low[stuck], high[stuck])],
            margin=min(known.margin, float(margin[done].min(initial=math.inf))),
            counterexample=known.counterexample or violation,
            bounded=known.bounded + count,
        )

    def bound(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, Claims, np.ndarray]:
        """Return a lower bound of h from each box, the claims, and the steps that are proved."""
        count = len(low)
        full = [_filled(x, BATCH) for x in (low, high)]
        with jax.enable_x64(True):
            tubes = tube(self.loop, self.steps, *map(jnp.asarray, full), order=self.order)
            tubes = jax.tree.map(lambda x: x[:count], jax.device_get(tubes))
        last = tubes.proved_steps(self.loop.property)
        covered = np.arange(tubes.margin.shape[1]) <= last[:, None]
        margin = np.where(covered, tubes.margin, math.inf).min(axis=1)
        claims = jax.tree.map(lambda x: _claimed(x, covered, self.steps + 1), tubes.claims)
        return margin, claims, last

    def halves(self, low: np.ndarray, high: np.ndarray) -> list[_Corners]:
        """Return both halves of a box. It is cut where it is widest."""
        axis = int(((high - low) / self.scales).argmax())
        middle = 0.5 * (low[axis] + high[axis])
        top, bottom = high.copy(), low.copy()
        top[axis] = bottom[axis] = middle
        return [(low, top), (bottom, high)]

    def flown(
        self, low: np.ndarray, high: np.ndarray, number: int
    ) -> tuple[np.ndarray, Counterexample | None]:
        """Fly from some starts in each box: from the middle, and from random ones.

        Args:
            low: the lowest corners of the boxes.
            high: the highest corners of the boxes.
            number: the number of the random draw.

        Returns:
            The share of the flights from each box that violate the property, and the worst one. A
            flight that breaks the limit counts as worse than one that does not dock.
        """
        count = len(low)
        full = [_filled(x, self.most)[:, None] for x in (low, high)]
        key = jax.random.fold_in(self.key, number)
        share = jax.random.uniform(key, (self.most, SAMPLES, low.shape[-1])).at[:, 0].set(0.5)
        lowest, highest = (jnp.asarray(x, jnp.float32) for x in full)
        starts = jnp.clip(lowest + share * (highest - lowest), lowest, highest)
        starts = starts.reshape(-1, starts.shape[-1])
        margins, depths = (np.asarray(x)[: count * SAMPLES] for x in self.fly(starts))
        least, deepest = margins.min(axis=1), depths.max(axis=1)
        undocked = (least >= 0.0) & (deepest < 0.0)
        share_violating = ((least < 0.0) | undocked).reshape(count, SAMPLES).mean(axis=1)
        if not share_violating.any():
            return share_violating, None
        only_undocked = least.min() >= 0.0
        worst = int(np.argmin(deepest if only_undocked else least))
        when = self.steps if only_undocked else int(np.argmax(margins[worst] < 0.0))
        start = start_of(self.env, starts[worst])
        violation = Counterexample(
            start=jax.tree.map(lambda x: x.tolist(), start),
            step=when,
            margin=float(deepest[worst] if only_undocked else margins[worst, when]),
            undocked=bool(only_undocked),
        )
        return share_violating, violation

    def verification(self, seconds: float) -> Verification:
        """Return what is known now."""
        known = self.known
        size = self.whole.low.shape[-1]
        waiting = [(low[None], high[None]) for low, high in known.waiting]
        left = _pile(size, [*known.stuck, *waiting])
        claims = [item[2] for item in known.proved]
        total = size + self.loop.actions
        actions = self.loop.actions
        shapes = ((actions, total), (actions,), (actions,))
        empty = Claims(*(np.zeros((0, self.steps + 1, *shape)) for shape in shapes))
        result = "refuted" if known.counterexample else "open" if len(left.low) else "proved"
        return Verification(
            result=result,
            proved=_pile(size, known.proved),
            refuted=_pile(size, known.refuted),
            open=left,
            claims=jax.tree.map(lambda *x: np.concatenate(x), empty, *claims),
            last=np.concatenate([np.zeros(0, int), *(item[3] for item in known.proved)]),
            margin=known.margin,
            counterexample=known.counterexample,
            box=self.whole,
            loop=self.loop,
            steps=self.steps,
            order=self.order,
            seconds=known.seconds + seconds,
            bounded=known.bounded,
        )


def _filled(corners: np.ndarray, count: int) -> np.ndarray:
    """Repeat the first box to a fixed number of boxes, so that nothing is compiled again."""
    return np.concatenate([corners, np.repeat(corners[:1], count - len(corners), axis=0)])


def _pile(size: int, items: Sequence[Any]) -> Boxes:
    """Return all boxes of some items, whose first two entries are corners."""
    empty = np.zeros((0, size))
    return Boxes(*(np.concatenate([empty, *(item[i] for item in items)]) for i in (0, 1)))


def _claimed(x: np.ndarray, covered: np.ndarray, count: int) -> np.ndarray:
    """Return claims of `count` steps. They are 0 in steps that are not covered.

    Bounds of such steps may be infinite.
    """
    own = np.where(covered.reshape(*covered.shape, *[1] * (x.ndim - 2)), x, 0.0)
    claims = np.zeros((len(x), count, *x.shape[2:]))
    claims[:, : x.shape[1]] = own
    return claims


def _flight(
    env: Environment, policy: Policy, steps: int, property: Property, x: Float[Array, " s"]
) -> tuple[Array, Array]:
    """Fly from a start, and return what decides whether the flight has a property.

    Returns:
        The smallest margin at the start and after each step, and the depth in the docking region.
        With the property `docks` the margin is infinite after the step in which the agent docks.
        With the property `safe` the depth is 0.
    """
    region = docking_region(env) if property == "docks" else None
    state, timestep = reset_to(env, start_of(env, x))

    def seen(state: State, timestep: TimeStep) -> tuple[Array, Array]:
        margin = jnp.min(jnp.stack(list(timestep.info.margins.values())))
        return margin, jnp.zeros(()) if region is None else depth(env, region, state.sim)

    def fly(carry: Any, _: None) -> tuple[Any, tuple[Array, Array]]:
        state, observation, docked = carry
        action = policy(jax.random.key(0), observation[None])[0]
        state, timestep = step(env, state, action)
        margin, deep = seen(state, timestep)
        margin = jnp.where(docked, jnp.inf, margin)
        docked |= (deep >= 0.0) & (region is not None)
        return (state, timestep.observation, docked), (margin, deep)

    margin, deep = seen(state, timestep)
    _, later = jax.lax.scan(fly, (state, timestep.observation, jnp.asarray(False)), None, steps)
    # An episode does not end at its start, so that the depth there does not count.
    first = margin, deep if region is None else jnp.full_like(deep, -jnp.inf)
    return jax.tree.map(lambda one, others: jnp.concatenate([one[None], others]), first, later)
