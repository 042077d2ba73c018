"""Active set invariance filters (ASIF), Eqs. (2)-(4).

They give the control nearest to the desired one that meets barrier constraints. `ExplicitASIF` is
the paper's continuous-time quadratic program. `DiscreteASIF` keeps a speed limit after a whole step
of held thrust, which is what a plant with a finite step needs.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsafe.processors.constraint import SlackCost
from jaxsafe.processors.strengthening import Polynomial, Strengthening
from jaxsafe.rta.certified import CertifiedRTA, Proposal
from jaxsafe.rta.projection import project_box_ball, project_box_halfspace
from jaxsafe.rta.proofs import slow_actuators
from jaxsafe.rta.qp import nearest_solution
from jaxsafe.schema.component import Range, Unit
from jaxsafe.transition import advance, bounds, commanded, constraint, judge
from jaxsafe.types import Number, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

T = TypeVar("T")

ROUNDINGS_INSIDE = 16.0
"""How far inside the limit `DiscreteASIF` aims, in rounding units of the limit.

Its projection lies on the boundary of what is certified, where rounding errors would decide.
"""


class DiscreteASIF(CertifiedRTA, type="discrete_asif"):
    """A sampled-data ASIF for a speed limit.

    It asks for h(x') ≥ margin + (1 − γ) max(h(x) − margin, 0) after a step of held control.

    The velocity after the step is v̄ + Bu. The limit is at least c + gᵀu, because a norm is convex.
    The columns of B are orthogonal and of equal length √β. So ‖v̄ + Bu‖ ≤ c + gᵀu follows from
    β‖u‖² + 2(Bᵀv̄ − cg)·u + ‖v̄‖² − c² ≤ 0. That is a ball, and the projection onto a box and a
    ball has a closed form. The filter aims some rounding errors inside, so that its solution is
    certified.
    """

    backup_optional: ClassVar[bool] = True
    gamma: Annotated[Number, Unit("1"), Range(0.0, 1.0, open_low=True)] = 1.0

    def problem(self) -> str | None:
        return super().problem() or (
            None if len(self.constraints) == 1 else "expected one constraint, a speed limit"
        )

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> Proposal:
        required = self.required_margin(env, self.constraints[0])
        limited = constraint(env, self.constraints[0])
        spare = jnp.maximum(limited.margin(judge(env, sim)) - required, 0.0)
        limit = limited.limit(judge(env, sim))
        rounding = ROUNDINGS_INSIDE * jnp.finfo(desired.dtype).eps * limit
        low, high = bounds(env)

        def project(margin: Number) -> tuple[Array, Array]:
            """Return the nearest control that keeps a margin, and whether there is one."""
            beta, p, k = speed_ball(
                env, sim, control=jnp.zeros_like(desired), name=self.constraints[0], margin=margin
            )
            return project_box_ball(u=desired, low=low, high=high, beta=beta, p=p, k=k)

        margin = required + (1.0 - self.gamma) * spare + rounding
        if self.bound is None:
            return project(margin)

        # How much h is lost depends on the control. So the first projection allows for what the
        # strongest control loses, and each further one for what the control before it loses. A
        # control that loses no more than was allowed for replaces the one before. At least one of
        # two rounds finds such a control.
        control, feasible = project(margin + self.lost(env, jnp.maximum(-low, high)))
        lost = self.lost(env, control)
        for _ in range(2):
            nearer, exists = project(margin + lost)
            own = self.lost(env, nearer)
            better = exists & (own <= lost)
            control = jnp.where(better, nearer, control)
            feasible = feasible | better
            lost = own
        return control, feasible


def speed_ball(
    env: Environment,
    sim: Sim,
    control: Float[Array, " m"],
    name: str,
    margin: Number,
    free: int | None = None,
) -> tuple[Float[Array, ""], Float[Array, " f"], Float[Array, ""]]:
    """Return the ball of controls under which a speed limit keeps a margin after the step.

    It is given by β, p and k: the change w of the control must meet β‖w‖² + 2p·w + k ≤ 0.

    Args:
        env: the environment.
        sim: the simulation before the step.
        control: the control that w changes, shape (m,).
        name: the name of the constraint.
        margin: the h to keep after the step [m/s].
        free: how many of the first elements w changes. None stands for all.

    Returns:
        β, p of shape (free,), and k.
    """
    count = control.shape[0] if free is None else free

    def after(w: Float[Array, " f"]) -> tuple[Array, Array]:
        later = advance(env, sim, control.at[:count].add(w))
        return later.platforms[env.agent].velocity, constraint(env, name).limit(judge(env, later))

    # In the terms of `DiscreteASIF`: v̄ is velocity, c is limit − margin, Bᵀ is velocity_gain and g
    # is limit_gain.
    origin = jnp.zeros(count, control.dtype)
    (velocity, limit), (velocity_gain, limit_gain) = linear(after, origin)
    c = limit - margin
    beta = jnp.max(jnp.sum(velocity_gain * velocity_gain, axis=-1))
    p = jnp.sum(velocity_gain * velocity[None], axis=-1) - c * limit_gain
    k = jnp.sum(velocity**2) - c * c
    return beta, p, k


def linear(function: Callable[[Array], T], at: Float[Array, " m"]) -> tuple[T, T]:
    """Return the value of a function at a point, and its derivatives by the m elements there.

    The derivatives have an axis of length m in front. They are taken forwards, so that nothing is
    stored.
    """
    along = functools.partial(jax.jvp, function, (at,))
    return jax.vmap(along, out_axes=(None, 0))((jnp.eye(at.shape[0], dtype=at.dtype),))


class ExplicitASIF(CertifiedRTA, type="explicit_asif"):
    """The paper's ASIF, Eqs. (2)-(4).

    It solves argmin ‖u − u_des‖² subject to L_f h + L_g h u + α(h) ≥ 0 for every constraint. These
    barrier rows come from h and the platforms' derivatives alone.

    If the control reaches h only after differentiating `degree` times, the constraint is lifted
    first (HOCBF): ψ₀ = h and ψᵢ = ψ̇ᵢ₋₁ + α(ψᵢ₋₁). The row is then that of the last ψ. With `slack`
    σ every row may be missed by s at a cost of σ s². Each constraint may have a `strengthening`, a
    `degree` and a `slack` of its own.

    If no control meets all rows without slack, those of the lowest `priority` are given up, then
    those of the next, until the others can be met.

    Continuous-time barriers say nothing about a control that is held over a step. With `enforce`
    the prediction has the last word. Without it the solution acts, as in the paper.
    """

    backup_optional: ClassVar[bool] = True
    strengthening: Strengthening = Polynomial()
    degree: Annotated[int, Range(1, 3)] = 1
    slack: SlackCost | None = None

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        rows, _ = self.rows(env, sim)
        no_influence = {}
        for name, row in zip(self.constraints, rows, strict=True):
            degree = self._degree(env, name)
            fault = f"of degree {degree} the control has no influence on {name!r}"
            no_influence[fault] = jnp.all(row == 0.0)
        late = slow_actuators(env, "a barrier row")
        return no_influence | late | super().unsuited(env, sim)

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> Proposal:
        rows, offsets = self.rows(env, sim)
        limits = [constraint(env, name) for name in self.constraints]
        low, high = bounds(env)
        return nearest_by_priority(
            u=desired,
            low=low,
            high=high,
            rows=rows,
            offsets=offsets,
            slacks=[self.slack if limit.slack is None else limit.slack for limit in limits],
            priorities=[limit.priority for limit in limits],
            miss_least=not self.backups,
        )

    def rows(self, env: Environment, sim: Sim) -> tuple[Float[Array, "c m"], Float[Array, " c"]]:
        """Return the barrier rows a·u ≥ b, one for each of c constraints.

        Args:
            env: the environment.
            sim: the simulation at the state.

        Returns:
            a of shape (c, m) and b of shape (c,).
        """
        rows = [self._row(env, sim, name) for name in self.constraints]
        return jnp.stack([a for a, _ in rows]), jnp.stack([b for _, b in rows])

    def _row(
        self, env: Environment, sim: Sim, name: str
    ) -> tuple[Float[Array, " m"], Float[Array, ""]]:
        limit = constraint(env, name)
        strengthening = limit.strengthening
        return barrier_row(
            h=lambda platforms: limit.margin(judge(env, sim.replace(platforms=platforms))),
            derivative=functools.partial(_derivative, env, sim),
            state=sim.platforms,
            still=jnp.zeros(env.action_size, env.dt.dtype),
            alpha=(self.strengthening if strengthening is None else strengthening).of,
            degree=self._degree(env, name),
        )

    def _degree(self, env: Environment, name: str) -> int:
        own = constraint(env, name).degree
        return self.degree if own is None else own


MISS_LEAST = 1e4
"""Slack with which rows that cannot be met are missed hardly more than they must be."""


def barrier_row(
    h: Callable[[Any], Array],
    derivative: Callable[[Any, Array], Any],
    state: Any,
    still: Float[Array, " m"],
    alpha: Callable[[Array], Array],
    degree: int,
) -> tuple[Float[Array, " m"], Float[Array, ""]]:
    """Return the barrier row a·u ≥ b of Eq. (4) at a state: its a of shape (m,) and its b.

    Args:
        h: the constraint as a function of the state.
        derivative: the derivative ẋ of the state, as a function of state and control.
        state: the state, any tree of arrays.
        still: the control 0.
        alpha: the strengthening function α.
        degree: how often h is differentiated until the control reaches it.
    """

    def lift(psi: Callable[[Any], Array]) -> Callable[[Any], Array]:
        """Return ψ̇ + α(ψ) without control, as a function of the state."""

        def lifted(state: Any) -> Array:
            value, slope = jax.jvp(psi, (state,), (derivative(state, still),))
            return slope + alpha(value)

        return lifted

    psi = h
    for _ in range(degree - 1):
        psi = lift(psi)

    def rate(u: Float[Array, " m"]) -> tuple[Array, Array]:
        value, slope = jax.jvp(psi, (state,), (derivative(state, u),))
        return slope, value

    (drift, value), (gains, _) = linear(rate, still)
    return gains, -(drift + alpha(value))


def nearest_by_priority(
    u: Float[Array, " m"],
    low: Float[Array, " m"],
    high: Float[Array, " m"],
    rows: Float[Array, "c m"],
    offsets: Float[Array, " c"],
    slacks: Sequence[Number | None],
    priorities: Sequence[int],
    miss_least: bool = False,
) -> Proposal:
    """Return the control nearest to u within its bounds and under rows a·u ≥ b.

    If the rows without slack cannot be met together, those of the lowest priority are given up
    until the others can.

    Args:
        u: the desired control, shape (m,).
        low: lower bounds, shape (m,).
        high: upper bounds, shape (m,).
        rows: a of each of c rows, shape (c, m).
        offsets: b of each row, shape (c,).
        slacks: the cost of missing each row, None where it may not be missed.
        priorities: the priority of each row.
        miss_least: whether rows of the highest priority that cannot be met together are missed as
            little as possible. Otherwise the control is then u within its bounds.

    Returns:
        The control, whether rows without slack of the highest priority could be met, and the index
        of the row that moves the control most.
    """
    if len(rows) == 1 and slacks[0] is None:
        control, feasible = project_box_halfspace(u=u, low=low, high=high, a=rows[0], b=offsets[0])
        return control, feasible, jnp.zeros((), jnp.int32)

    def solve(
        least_priority: int, hard_slack: Number | None = None
    ) -> tuple[Array, Array, Array, Array]:
        """Return control, `solved`, `feasible` and the row that moves the control most.

        Rows without slack are left out below `least_priority`. The others have `hard_slack`.
        """
        kept = [
            index
            for index, (slack, priority) in enumerate(zip(slacks, priorities, strict=True))
            if slack is not None or priority >= least_priority
        ]
        costs = [slacks[i] if slacks[i] is not None else hard_slack for i in kept]
        solution = nearest_solution(
            u, low, high, rows[np.array(kept)], offsets[np.array(kept)], costs
        )
        index = jnp.array(kept, jnp.int32)[jnp.argmax(solution.multipliers)]
        return solution.control, solution.solved, solution.feasible, index

    hard = {priority for slack, priority in zip(slacks, priorities, strict=True) if slack is None}
    levels = sorted(hard) or [0]
    chosen = solve(levels[-1])
    for level in reversed(levels[:-1]):  # from the highest priority alone to all rows
        more = solve(level)
        chosen = jax.tree.map(functools.partial(jnp.where, more[1]), more, chosen)
    control, solved, feasible, index = chosen
    if miss_least:
        missed, _, _, missed_index = solve(levels[-1], hard_slack=MISS_LEAST)
        control = jnp.where(solved, control, missed)
        index = jnp.where(solved, index, missed_index)
    return control, feasible, index


class ImplicitASIF(CertifiedRTA, type="implicit_asif"):
    """An ASIF whose safe set is known only through backup controllers.

    H(x) is the smallest h on the flight of the best backup controller from x. H after the step is
    linearised at the desired control, by differentiating the prediction. That gives one half-space
    to project onto: H(x′) + ∇H·(u − u_des) ≥ margin + `spare`.

    The half-space is an approximation, so the prediction decides whether the projection may act.
    The spare lets it pass more often, and so does linearising `rounds` times.
    """

    spare: Annotated[Number, Unit("the unit of the constraint"), Range(0.0)] = 0.0
    rounds: Annotated[int, Range(1, 8)] = 2

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> Proposal:
        low, high = bounds(env)

        def predict(u: Float[Array, " m"]) -> tuple[Array, Array]:
            paths = self.follow(env, sim, advance(env, sim, u))
            return paths.values, paths.margins

        def improve(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
            proposal, feasible = carry
            (values, margins), (gains, _margin_gains) = linear(predict, proposal)
            best = jnp.argmax(values)
            proved = jnp.isfinite(values[best])
            row = jnp.where(proved, gains[:, best], 0.0)
            required = self.margin_to_certify(env, proposal)
            missing = jnp.where(proved, required + self.spare - values[best], 0.0)
            projected, feasible = project_box_halfspace(
                u=desired, low=low, high=high, a=row, b=missing + jnp.sum(row * proposal)
            )
            safe = values[best] >= required
            closest = self.closest(env, margins[best])
            return (jnp.where(safe, proposal, projected), safe | (proved & feasible)), closest

        (control, feasible), closest = jax.lax.scan(
            improve, (desired, jnp.ones((), bool)), length=self.rounds
        )
        return control, feasible, closest[0]


def _derivative(env: Environment, sim: Sim, platforms: Any, control: Float[Array, " m"]) -> Any:
    """Return the derivatives ẋ of all platforms by name, as a tangent of their states."""
    return {
        platform.name: platform.derivative(
            platforms[platform.name], commanded(env, platform, sim, control)
        )
        for platform in env.platforms
    }
