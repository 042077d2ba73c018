"""The search for a proof: boxes of starts are proved, refuted, or halved."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.devices.seed_mapper import usable_cores
from jaxsafe.environment import Environment, reset_to, step
from jaxsafe.rollout import Policy, RecurrentPolicy
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.verify.loop import FIELDS, Loop, closed_loop, start_of
from jaxsafe.verify.tube import Claims, tube

BATCH = 64
"""Number of boxes that are bounded at once."""

FIRST_WIDTHS = (18.0, 0.1)
"""Largest widths of the first boxes, of positions [m] and of velocities [m/s]."""

SCALES = (6.0, 0.047)
"""Widths that count the same when a box is halved, of positions [m] and of velocities [m/s]."""

SMALLEST = 2.0**-10
"""A box whose widths are below this share of `SCALES` stays open."""

SAMPLES = 16
"""Number of starts that are flown from a box without a proof."""

MAX_BOUND = 1e6
"""Largest absolute value of a bound of a box [m, m/s]."""

Box = Mapping[str, Any]
"""Intervals by field, `deputy.position` or `position`: one for each axis, or one for all axes."""


class Boxes(NamedTuple):
    """Boxes of starts, by their corners (position, velocity)."""

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
    """The step at whose end the margin is negative first, 0 for the start itself."""
    margin: float
    """The margin h there."""


class Verification(NamedTuple):
    """What is known of all starts in a box."""

    result: Literal["proved", "refuted", "open"]
    proved: Boxes
    refuted: Boxes
    """Boxes with a start that violates the property, if the search went on after the first."""
    open: Boxes
    claims: Claims
    """What the proof says of the policy, by proved box, see `jaxsafe.verify.tube.Claims`."""
    margin: float
    """A lower bound of h along all episodes from the proved boxes."""
    counterexample: Counterexample | None
    box: Boxes
    loop: Loop
    steps: int
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
    arithmetic: Literal["float32", "real"] = "float32",
    seconds: float = math.inf,
    max_boxes: int = 100_000,
    everything: bool = False,
    resume: Verification | None = None,
    progress: Callable[[Verification], None] = lambda _: None,
) -> Verification:
    """Prove that a policy keeps the safety constraint from every start in a box, or refute it.

    The proof is about `steps` steps of the environment, whether the episode has ended or not, and
    about the time between them.

    Args:
        env: the environment. Its agent is a point mass that keeps a speed limit.
        policy: `policy(key, observation)` returns actions for a batch of observations. It must be
            deterministic.
        box: intervals of the start, such as `{"deputy.position": [[70, 106], [70, 106]],
            "deputy.velocity": [-0.28, 0.28]}` [m, m/s].
        steps: number of steps.
        arithmetic: `float32` proves the loop as it runs in single precision, `real` that of real
            numbers.
        seconds: the time after which to stop [s]. Boxes that are left are then open.
        max_boxes: the largest number of boxes to bound. Those before `resume` do not count.
        everything: whether to go on after a counterexample, for a map of the box.
        resume: a verification of the same loop and box to go on from.
        progress: a function that is called after each batch of boxes.

    Returns:
        What is known. The first Ctrl-C ends the search as a limit does.

    Raises:
        ConfigError: the box is no box of starts, or nothing can be proved of the loop.
    """
    began = time.monotonic()
    if isinstance(policy, RecurrentPolicy):
        raise ConfigError(
            "run: the policy remembers; a proof needs one that sees the present alone"
        )
    loop = closed_loop(env, policy, arithmetic)
    whole = corners(env, box)
    if resume is None:
        waiting = _cells(whole, loop.dimension)
    else:
        _require_same(resume, loop, whole, steps)
        waiting = [*zip(*resume.open, strict=True)]
    search = _Search(env, policy, loop, whole, steps, deque(waiting), resume)
    try:
        while search.waiting and search.bounded < max_boxes:
            if time.monotonic() - began > seconds or (search.counterexample and not everything):
                break
            search.advance()
            progress(search.known(time.monotonic() - began))
    except KeyboardInterrupt:
        pass
    return search.known(time.monotonic() - began)


def corners(env: Environment, box: Box) -> Boxes:
    """Return the corners of a box of starts.

    Raises:
        ConfigError: a field is missing or unknown, or its value is not made of intervals.
    """
    names = {f"{env.agent}.{field}": field for field in FIELDS}
    for key in box:
        if key not in names and key not in FIELDS:
            raise ConfigError(f"box.{key}: no field of a start{choices_text(key, names)}")
    dimension = env.agent_platform.dimension
    ends = []
    for name, field in names.items():
        given = box.get(name, box.get(field))
        if given is None:
            raise ConfigError(f"box.{name}: missing; give an interval for each axis")
        try:
            array = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            array = np.zeros(0)
        array = np.broadcast_to(array, (dimension, 2)) if array.shape == (2,) else array
        fits = array.shape == (dimension, 2) and np.all(np.abs(array) <= MAX_BOUND)
        if not fits or np.any(array[:, 0] > array[:, 1]):
            raise ConfigError(
                f"box.{name}: expected {dimension} intervals [low, high] "
                f"within ±{MAX_BOUND:.0e}, found {show(given)}"
            )
        ends.append(array)
    low, high = np.concatenate(ends).T
    return Boxes(low[None], high[None])


def _require_same(known: Verification, loop: Loop, whole: Boxes, steps: int) -> None:
    """Refuse to go on from a verification of something else.

    Raises:
        ConfigError: the loop, the box or the number of steps differs.
    """
    same = {
        "the closed loop": _same_numbers(known.loop, loop),
        "the box": _same_numbers(known.box, whole),
        "steps": known.steps == steps,
    }
    for what, fits in same.items():
        if not fits:
            raise ConfigError(f"resume: {what} is not that of the certificate")


def _same_numbers(a: Any, b: Any) -> bool:
    leaves, others = jax.tree.leaves(a), jax.tree.leaves(b)
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        np.array_equal(x, y) for x, y in zip(leaves, others, strict=True)
    )


def _cells(whole: Boxes, dimension: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the first boxes, none of them wider than `FIRST_WIDTHS`."""
    largest = np.repeat(FIRST_WIDTHS, dimension)
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


class _Search:
    """The boxes of a search, and what is known of them."""

    def __init__(
        self,
        env: Environment,
        policy: Policy,
        loop: Loop,
        whole: Boxes,
        steps: int,
        waiting: deque[tuple[np.ndarray, np.ndarray]],
        known: Verification | None,
    ) -> None:
        self.env = env
        self.loop = loop
        self.whole = whole
        self.steps = steps
        self.waiting = waiting
        self.scales = np.repeat(SCALES, loop.dimension)
        self.proved: list[Any] = []
        self.refuted: list[Any] = []
        self.stuck: list[Any] = []
        self.margin = math.inf
        self.counterexample: Counterexample | None = None
        self.bounded = 0
        self.earlier_seconds = 0.0
        self.earlier_bounded = 0
        if known is not None:
            self.proved = [(*known.proved, known.claims)] if len(known.proved.low) else []
            self.refuted = [known.refuted]
            self.margin = known.margin
            self.counterexample = known.counterexample
            self.earlier_seconds = known.seconds
            self.earlier_bounded = known.bounded
        self.pool = ThreadPoolExecutor(usable_cores())
        self.key = jax.random.key(0)
        self.fly = jax.jit(jax.vmap(lambda x: _margins(env, policy, steps, x)))

    def advance(self) -> None:
        """Bound one batch of boxes on each core."""
        count = min(BATCH * usable_cores(), len(self.waiting))
        batch = [self.waiting.popleft() for _ in range(count)]
        low, high = (np.stack(ends) for ends in zip(*batch, strict=True))
        try:
            parts = [slice(i, i + BATCH) for i in range(0, count, BATCH)]
            bounds = list(self.pool.map(lambda part: self.bound(low[part], high[part]), parts))
            margin, claims = jax.tree.map(lambda *x: np.concatenate(x), *bounds)
            done = margin.min(axis=1) >= 0.0  # false where a bound is not a number
            least = self.flown(low[~done], high[~done]) if not done.all() else np.zeros(0)
        except BaseException:
            self.waiting.extendleft(reversed(batch))
            raise
        self.bounded += len(batch)
        if done.any():
            self.margin = min(self.margin, float(margin[done].min()))
            self.proved.append((low[done], high[done], jax.tree.map(lambda x: x[done], claims)))
        for index, violated in zip(np.flatnonzero(~done), least < 0.0, strict=True):
            widths = (high[index] - low[index]) / self.scales
            if widths.max() < SMALLEST:
                (self.refuted if violated else self.stuck).append(
                    (low[index][None], high[index][None])
                )
            else:
                self.halve(low[index], high[index], int(widths.argmax()))

    def bound(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, Claims]:
        """Return a lower bound of h in each step from each box, and the claims."""
        count = len(low)
        # Batches have one size, so that nothing is compiled again.
        full = [np.concatenate([x, np.repeat(x[:1], BATCH - count, axis=0)]) for x in (low, high)]
        with jax.enable_x64(True):
            tubes = tube(self.loop, self.steps, *map(jnp.asarray, full))
            margin, claims = jax.device_get((tubes.margin, tubes.claims))
        return margin[:count], jax.tree.map(lambda x: x[:count], claims)

    def halve(self, low: np.ndarray, high: np.ndarray, axis: int) -> None:
        """Put both halves of a box into the queue."""
        middle = 0.5 * (low[axis] + high[axis])
        for side in (low, high):
            ends = low.copy(), high.copy()
            ends[0 if side is high else 1][axis] = middle
            self.waiting.append(ends)

    def flown(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the least margin of some flights from each box, and keep the first violation.

        One flight begins in the middle of the box, the others at random starts.
        """
        self.key, own_key = jax.random.split(self.key)
        share = jax.random.uniform(own_key, (len(low), SAMPLES, low.shape[-1])).at[:, 0].set(0.5)
        lowest, highest = (jnp.asarray(x, jnp.float32)[:, None] for x in (low, high))
        starts = np.asarray(jnp.clip(lowest + share * (highest - lowest), lowest, highest))
        margins = np.asarray(self.fly(starts.reshape(-1, starts.shape[-1])))
        worst = int(np.argmin(margins.min(axis=1)))
        if margins[worst].min() < 0.0 and self.counterexample is None:
            when = int(np.argmax(margins[worst] < 0.0))
            start = starts.reshape(-1, starts.shape[-1])[worst]
            self.counterexample = Counterexample(
                start=jax.tree.map(lambda x: x.tolist(), start_of(self.env, start)),
                step=when,
                margin=float(margins[worst, when]),
            )
        return margins.reshape(len(low), -1).min(axis=1)

    def known(self, seconds: float) -> Verification:
        """Return what is known now."""
        size = self.whole.low.shape[-1]
        waiting = [(low[None], high[None]) for low, high in self.waiting]
        left = _pile(size, [*self.stuck, *waiting])
        claims = [item[2] for item in self.proved]
        total = size + self.loop.actions
        actions = self.loop.actions
        shapes = ((actions, total), (actions,), (actions,))
        empty = Claims(*(np.zeros((0, self.steps + 1, *shape)) for shape in shapes))
        result = "refuted" if self.counterexample else "open" if len(left.low) else "proved"
        return Verification(
            result=result,
            proved=_pile(size, self.proved),
            refuted=_pile(size, self.refuted),
            open=left,
            claims=jax.tree.map(lambda *x: np.concatenate(x), empty, *claims),
            margin=self.margin,
            counterexample=self.counterexample,
            box=self.whole,
            loop=self.loop,
            steps=self.steps,
            seconds=self.earlier_seconds + seconds,
            bounded=self.earlier_bounded + self.bounded,
        )


def _pile(size: int, items: Sequence[Any]) -> Boxes:
    """Return all boxes of some items, whose first two entries are corners."""
    empty = np.zeros((0, size))
    return Boxes(*(np.concatenate([empty, *(item[i] for item in items)]) for i in (0, 1)))


def _margins(env: Environment, policy: Policy, steps: int, x: Float[Array, " s"]) -> Array:
    """Return the smallest margin at the start and after each step, flown by the environment."""
    state, timestep = reset_to(env, start_of(env, x))

    def least(timestep: Any) -> Array:
        return jnp.min(jnp.stack(list(timestep.info.margins.values())))

    def fly(carry: Any, _: None) -> tuple[Any, Array]:
        state, observation = carry
        action = policy(jax.random.key(0), observation[None])[0]
        state, timestep = step(env, state, action)
        return (state, timestep.observation), least(timestep)

    _, later = jax.lax.scan(fly, (state, timestep.observation), None, steps)
    return jnp.concatenate([least(timestep)[None], later])
