"""Filters without an environment, for a simulator of one's own.

They are pure functions of a state and a control, so they compile, batch and differentiate. A state
is a vector or any tree of arrays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxsafe.processors.strengthening import Polynomial
from jaxsafe.rta.asif import barrier_row, nearest_by_priority
from jaxsafe.rta.filter import NO_CONSTRAINT
from jaxsafe.rta.projection import within
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.simulation.platform import Platform
from jaxsafe.types import Number, RTAInfo

Control = Float[Array, " m"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plant:
    """What a filter needs to know of a plant: a derivative for an ASIF, a step for a Simplex."""

    low: Any
    """The lowest control, shape (m,)."""
    high: Any
    """The highest control, shape (m,)."""
    derivative: Callable[[Any, Control], Any] | None = None
    """The function (x, u) ↦ ẋ, for instance f(x) + g(x) u."""
    step: Callable[[Any, Control], Any] | None = None
    """The function (x, u) ↦ x⁺ over a step, in which the control is held."""

    @classmethod
    def of(cls, platform: Platform, dt: Number) -> Plant:
        """Return the plant of a platform of jaxsafe, whose states are records.

        Args:
            platform: a platform with actuators that act at once.
            dt: length of a step [s].

        Raises:
            ConfigError: the platform has no actuators, or one has a lag or a rate limit.
        """
        if not isinstance(platform, Platform):
            raise ConfigError(
                f"Plant.of: expected a platform, such as env.agent_platform, found {show(platform)}"
            )
        actuators = getattr(platform.controller, "actuators", ())
        if not actuators:
            raise ConfigError(f"platforms.{platform.name}.controller: expected actuators")
        for actuator in actuators:
            if not actuator.at_once:
                raise ConfigError(
                    f"platforms.{platform.name}.controller.actuators.{actuator.name}: expected an"
                    " actuator that acts at once, without time_constant and rate_limit"
                )
        names = [actuator.name for actuator in actuators]
        return cls(
            low=jnp.stack([actuator.low for actuator in actuators]),
            high=jnp.stack([actuator.high for actuator in actuators]),
            derivative=lambda x, u: platform.derivative(x, dict(zip(names, u, strict=True))),
            step=lambda x, u: platform.step(x, dict(zip(names, u, strict=True)), dt),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Barrier:
    """A constraint h(x) ≥ 0 and what filters may ask of it. A function h alone has the defaults."""

    h: Callable[[Any], Array]
    """The function of a state."""
    alpha: Callable[[Array], Array] = Polynomial().of
    """The strengthening function α, for instance `Polynomial(linear=0.1, cubic=0.5).of`."""
    degree: int = 1
    """How often h is differentiated until the control reaches it."""
    slack: Number | None = None
    """The cost of missing the row, or None if it may not be missed."""
    priority: int = 0
    """Rows that cannot be met together are given up from the lowest priority on."""
    margin: Number = 0.0
    """The h that a certificate asks for."""


Constraints = Sequence[Callable[[Any], Array] | Barrier]


def filter_by_asif(
    plant: Plant, constraints: Constraints, state: Any, control: Control
) -> tuple[Control, RTAInfo]:
    """Return the control nearest to the desired one under a barrier row for each constraint.

    This is the active set invariance filter of Eqs. (2)-(4). It needs no backup controller and
    certifies nothing. Rows that cannot be met at all are missed as little as possible.

    Args:
        plant: the plant, with its derivative.
        constraints: functions h(x), or barriers.
        state: the state x.
        control: the desired control, shape (m,). Elements that are not numbers count as 0.

    Returns:
        The control that acts, and what happened. `predicted_margin` is the smallest h at x.

    Raises:
        ConfigError: the plant has no derivative, or there is no constraint, or a function or the
            control has another form than it should.
    """
    derivative = _given(plant.derivative, "filter_by_asif: the plant needs a `derivative`")
    state = jax.tree.map(jnp.asarray, state)
    barriers = _barriers(constraints, state)
    wanted, finite = _wanted(plant, control, "filter_by_asif")
    _require_like(state, jax.eval_shape(derivative, state, wanted), "plant: derivative")
    rows = [
        barrier_row(
            h=barrier.h,
            derivative=derivative,
            state=state,
            still=jnp.zeros_like(wanted),
            alpha=barrier.alpha,
            degree=barrier.degree,
        )
        for barrier in barriers
    ]
    actual, feasible, *cause = nearest_by_priority(
        u=wanted,
        low=_bound(plant.low, wanted),
        high=_bound(plant.high, wanted),
        rows=jnp.stack([a for a, _ in rows]),
        offsets=jnp.stack([b for _, b in rows]),
        slacks=[barrier.slack for barrier in barriers],
        priorities=[barrier.priority for barrier in barriers],
        miss_least=True,
    )
    changed = jnp.any(actual != wanted)
    info = RTAInfo(
        correction=safe_norm(actual - wanted),
        feasible=feasible & finite,
        certified=jnp.zeros((), bool),
        predicted_margin=jnp.min(_margins(barriers, state)),
        backup_index=jnp.full((), -1, jnp.int32),
        constraint=jnp.where(changed, cause[0], NO_CONSTRAINT()),
    )
    return actual, info


def filter_by_simplex(
    plant: Plant,
    constraints: Constraints,
    state: Any,
    control: Control,
    backup: Callable[[Any], Control],
    horizon: int = 0,
    terminal: Callable[[Any], Bool[Array, ""]] | None = None,
) -> tuple[Control, RTAInfo]:
    """Return the desired control if the state after it is certified, else that of the backup.

    This is the Simplex filter of Eq. (1). A state is certified if every constraint keeps its margin
    there and while the backup acts for `horizon` steps, and the last state is in the terminal set.

    Args:
        plant: the plant, with its step.
        constraints: functions h(x), or barriers.
        state: the state x.
        control: the desired control, shape (m,). If it is not finite the backup acts.
        backup: the backup controller x ↦ u. Its control is brought within the bounds.
        horizon: the number of predicted steps.
        terminal: whether a state is in the set from which the backup stays safe for ever. A horizon
            needs it.

    Returns:
        The control that acts, and what happened. `certified` says so of the state after it.

    Raises:
        ConfigError: the plant has no step, there is no constraint, only one of horizon and terminal
            set is given, or a function or the control has another form than it should.
    """
    step = _given(plant.step, "filter_by_simplex: the plant needs a `step`")
    if (horizon > 0) != (terminal is not None):
        raise ConfigError(
            "filter_by_simplex: a horizon needs a terminal set, and the set a horizon"
        )
    state = jax.tree.map(jnp.asarray, state)
    barriers = _barriers(constraints, state)
    wanted, finite = _wanted(plant, control, "filter_by_simplex")
    _require_like(state, jax.eval_shape(step, state, wanted), "plant: step")
    _require_like(wanted, jax.eval_shape(backup, state), "filter_by_simplex: backup", "the control")

    def back_up(x: Any) -> Control:
        return _admissible(plant, backup(x))[0]

    def certify(x: Any) -> tuple[Float[Array, " c"], Bool[Array, ""]]:
        """Return the least h − margin of each constraint on the way, and whether that certifies."""

        def one_step(carry: tuple[Any, Array], _: None) -> tuple[tuple[Any, Array], None]:
            x, least = carry
            after = step(x, back_up(x))
            return (after, jnp.minimum(least, _spare(barriers, after))), None

        (last, least), _ = jax.lax.scan(one_step, (x, _spare(barriers, x)), length=horizon)
        inside = jnp.ones((), bool) if terminal is None else terminal(last)
        return least, jnp.all(least >= 0.0) & inside

    backup_control = back_up(state)
    after_wanted = step(state, wanted)
    after_backup = step(state, backup_control)
    least, safe = certify(after_wanted)
    passes = safe & finite
    actual = jnp.where(passes, wanted, backup_control)
    changed = jnp.any(actual != wanted)
    after = jax.tree.map(lambda a, b: jnp.where(passes, a, b), after_wanted, after_backup)
    info = RTAInfo(
        correction=safe_norm(actual - wanted),
        feasible=jnp.ones((), bool),
        certified=passes | certify(after_backup)[1],
        predicted_margin=jnp.min(_margins(barriers, after)),
        backup_index=jnp.zeros((), jnp.int32),
        constraint=jnp.where(
            changed & finite, jnp.argmin(least).astype(jnp.int32), NO_CONSTRAINT()
        ),
    )
    return actual, info


def _given(function: Callable | None, fault: str) -> Callable:
    if function is None:
        raise ConfigError(fault)
    return function


def _barriers(constraints: Constraints, state: Any) -> list[Barrier]:
    if not isinstance(constraints, Sequence) or not constraints:
        found = "" if isinstance(constraints, Sequence) else f", found {show(constraints)}"
        raise ConfigError(f"constraints: expected a list of functions h(x) or barriers{found}")
    barriers = [item if isinstance(item, Barrier) else Barrier(h=item) for item in constraints]
    for index, barrier in enumerate(barriers):
        place = f"constraints: {index}"
        if not callable(barrier.alpha):
            raise ConfigError(
                f"{place}: alpha: expected a function, such as Polynomial(linear=0.1).of, "
                f"found {show(barrier.alpha)}"
            )
        if barrier.degree < 1:
            raise ConfigError(f"{place}: degree: expected 1 or more, found {barrier.degree}")
        margin = jax.eval_shape(barrier.h, state)
        dtype = getattr(margin, "dtype", bool)
        if jnp.shape(margin) or not jnp.issubdtype(dtype, jnp.floating):
            raise ConfigError(f"{place}: h: expected one real number, found {_forms(margin)}")
    return barriers


def _wanted(plant: Plant, control: Any, place: str) -> tuple[Control, Bool[Array, ""]]:
    """Return the desired control within its bounds, and whether it was finite.

    Raises:
        ConfigError: the control is no vector, or the bounds do not fit it or each other.
    """
    shape = np.shape(control)
    if len(shape) != 1:
        advice = "; for a batch, write jax.vmap around it" if len(shape) == 2 else ""
        raise ConfigError(f"{place}: control: expected shape (m,), found {shape}{advice}")
    for name, bound in {"low": plant.low, "high": plant.high}.items():
        if np.shape(bound) not in ((), shape):
            raise ConfigError(
                f"plant: {name}: expected a number or shape {shape} as the control, "
                f"found {np.shape(bound)}"
            )
    traced = isinstance(plant.low, Tracer) or isinstance(plant.high, Tracer)
    if not traced and np.any(np.asarray(plant.low) > np.asarray(plant.high)):
        raise ConfigError(f"plant: low: {show(plant.low)} is above high, {show(plant.high)}")
    return _admissible(plant, control)


def _require_like(expected: Any, found: Any, place: str, what: str = "the state") -> None:
    """Refuse what a function returns if it has another form than its state or control."""
    same = jax.tree.structure(expected) == jax.tree.structure(found)
    if not same or jax.tree.map(jnp.shape, expected) != jax.tree.map(jnp.shape, found):
        raise ConfigError(
            f"{place}: expected the form of {what}, {_forms(expected)}, found {_forms(found)}"
        )


def _forms(tree: Any) -> str:
    """Return a text with the types and shapes of all arrays of a tree."""
    forms = jax.tree.map(lambda x: f"{jnp.result_type(x)}{list(jnp.shape(x))}", tree)
    return show(forms).replace("'", "")


def _admissible(plant: Plant, control: Any) -> tuple[Control, Bool[Array, ""]]:
    """Return a control within its bounds, and whether it was finite."""
    control = jnp.asarray(control, jnp.result_type(float))
    finite = jnp.isfinite(control)
    numbers = jnp.where(finite, control, 0.0)
    inside = within(numbers, _bound(plant.low, control), _bound(plant.high, control))
    return inside, jnp.all(finite)


def _bound(bound: Any, control: Control) -> Control:
    return jnp.broadcast_to(jnp.asarray(bound, control.dtype), control.shape)


def _margins(barriers: Sequence[Barrier], state: Any) -> Float[Array, " c"]:
    return jnp.stack([barrier.h(state) for barrier in barriers])


def _spare(barriers: Sequence[Barrier], state: Any) -> Float[Array, " c"]:
    return _margins(barriers, state) - jnp.stack(
        [jnp.asarray(barrier.margin, jnp.result_type(float)) for barrier in barriers]
    )
