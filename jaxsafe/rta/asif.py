"""Active set invariance filters, Eqs. (2)-(4): the control nearest to the desired one that meets barrier constraints.

`ExplicitASIF` is the paper's continuous-time quadratic program. `DiscreteASIF` keeps a speed limit after a whole step of
held thrust, which is what a plant with a finite step needs.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.filter import CertifiedRTA
from jaxsafe.rta.projection import project_box_ball, project_box_halfspace
from jaxsafe.rta.qp import nearest_control
from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.transition import advance, bounds, commanded, constraint, judge
from jaxsafe.types import Number, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

T = TypeVar("T")


class DiscreteASIF(CertifiedRTA, type="discrete_asif"):
    """Sampled-data ASIF for a speed limit: h(x') ≥ margin + (1 − γ) max(h(x) − margin, 0) after a step of held control.

    The velocity after the step is v̄ + Bu and the limit at least c + gᵀu, as a norm is convex. With columns of B that are
    orthogonal and of equal length √β, ‖v̄ + Bu‖ ≤ c + gᵀu follows from β‖u‖² + 2(Bᵀv̄ − cg)·u + ‖v̄‖² − c² ≤ 0, a ball, and
    the projection onto box and ball is closed. It aims some rounding errors inside, so that its solution is certified.
    """

    gamma: Annotated[Number, Unit("1"), Range(0.0, 1.0, open_low=True)] = 1.0

    def problem(self) -> str | None:
        return super().problem() or (None if len(self.constraints) == 1 else "expected one constraint, a speed limit")

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        required = self.required_margin(env)
        spare = jnp.maximum(constraint(env, self.constraints[0]).margin(judge(env, sim)) - required, 0.0)
        rounding = 16.0 * jnp.finfo(desired.dtype).eps * constraint(env, self.constraints[0]).limit(judge(env, sim))
        margin = required + (1.0 - self.gamma) * spare + rounding
        ball = speed_ball(env, sim, jnp.zeros_like(desired), self.constraints[0], margin)
        return project_box_ball(desired, *bounds(env), *ball)


def speed_ball(
    env: Environment, sim: Sim, control: Float[Array, " m"], name: str, margin: Number, free: int | None = None
) -> tuple[Float[Array, ""], Float[Array, " f"], Float[Array, ""]]:
    """β, p and k of the ball β‖w‖² + 2p·w + k ≤ 0 in which a speed limit keeps a margin after the step.

    Args:
        env: the environment.
        sim: the simulation before the step.
        control: about which the first `free` elements are free, w being their change.
        name: of the constraint.
        margin: to keep below the limit.
        free: number of free elements; None is all.
    """
    count = control.shape[0] if free is None else free

    def after(w: Float[Array, " f"]) -> tuple[Array, Array]:
        later = advance(env, sim, control.at[:count].add(w))
        return later.platforms[env.agent].velocity, constraint(env, name).limit(judge(env, later))

    origin = jnp.zeros(count, control.dtype)
    (velocity, limit), (pushed, gained) = linear(after, origin)  # v̄ and c, Bᵀ and g
    c = limit - margin
    beta = jnp.max(jnp.sum(pushed * pushed, axis=-1))
    return beta, jnp.sum(pushed * velocity[None], axis=-1) - c * gained, jnp.sum(velocity**2) - c * c


def linear(function: Callable[[Array], T], at: Float[Array, " m"]) -> tuple[T, T]:
    """The value of a function and its derivatives, an axis of m in front; forwards, so that nothing is stored."""
    along = functools.partial(jax.jvp, function, (at,))
    return jax.vmap(along, out_axes=(None, 0))((jnp.eye(at.shape[0], dtype=at.dtype),))


SlackCost = Annotated[Number, Unit("1"), Range(0.0, open_low=True)]


class Strengthening(Component):
    """A strengthening function α of class κ, Eq. (4)."""

    def of(self, h: Float[Array, ""]) -> Float[Array, ""]:
        """Return α(h): increasing, 0 at 0."""
        raise NotImplementedError


class Polynomial(Strengthening, type="polynomial"):
    """α(h) = linear·h + cubic·h³."""

    linear: Annotated[Number, Unit("1"), Range(0.0)] = 1.0
    cubic: Annotated[Number, Unit("1"), Range(0.0)] = 0.0

    def of(self, h: Float[Array, ""]) -> Float[Array, ""]:
        return self.linear * h + self.cubic * h**3


class ExplicitASIF(CertifiedRTA, type="explicit_asif"):
    """The paper's ASIF: argmin ‖u − u_des‖² with L_f h + L_g h u + α(h) ≥ 0 for every constraint, Eqs. (2)-(4).

    The barrier rows come from h and the platforms' derivatives alone. A constraint that the control reaches only after
    differentiating `degree` times is lifted first (HOCBF): ψ₀ = h, ψᵢ = ψ̇ᵢ₋₁ + α(ψᵢ₋₁), and the row is that of the last ψ.
    With `slack` σ every row may be missed by s at a cost of σ s². Continuous-time barriers say nothing about a control
    that is held over a step: with `enforce`, prediction has the last word; without, as in the paper, the solution acts.
    """

    strengthening: Strengthening = Polynomial()
    degree: Annotated[int, Range(1, 3)] = 1
    slack: SlackCost | None = None

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        rows, _ = self.rows(env, sim, env.action_size)
        reason = f"of degree {self.degree} the control has no influence on"
        empty = {f"{reason} {name!r}": jnp.all(row == 0.0) for name, row in zip(self.constraints, rows, strict=True)}
        return empty | super().unsuited(env, sim)

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        rows, offsets = self.rows(env, sim, desired.shape[0])
        if len(rows) == 1 and self.slack is None:
            return project_box_halfspace(desired, *bounds(env), rows[0], offsets[0])
        return nearest_control(desired, *bounds(env), rows, offsets, self.slack)

    def rows(self, env: Environment, sim: Sim, size: int) -> tuple[Float[Array, "c m"], Float[Array, " c"]]:
        """Barrier rows a·u ≥ b, one a constraint."""
        both = [self._row(env, sim, name, size) for name in self.constraints]
        return jnp.stack([a for a, _ in both]), jnp.stack([b for _, b in both])

    def _row(self, env: Environment, sim: Sim, name: str, size: int) -> tuple[Float[Array, " m"], Float[Array, ""]]:
        def h(platforms: Any) -> Array:
            return constraint(env, name).margin(judge(env, sim.replace(platforms=platforms)))

        lifted = h
        for _ in range(self.degree - 1):
            lifted = self._lift(env, sim, lifted, size)

        def rate(u: Float[Array, " m"]) -> tuple[Array, Array]:
            value, slope = jax.jvp(lifted, (sim.platforms,), (_derivative(env, sim, sim.platforms, u),))
            return slope, value

        (drift, value), (gains, _) = linear(rate, jnp.zeros(size, env.dt.dtype))
        return gains, -(drift + self.strengthening.of(value))

    def _lift(self, env: Environment, sim: Sim, psi: Any, size: int) -> Any:
        def lifted(platforms: Any) -> Array:
            still = jnp.zeros(size, env.dt.dtype)
            value, slope = jax.jvp(psi, (platforms,), (_derivative(env, sim, platforms, still),))
            return slope + self.strengthening.of(value)

        return lifted


class ImplicitASIF(CertifiedRTA, type="implicit_asif"):
    """ASIF with a safe set that is only known through backup controllers: H(x) = min of h on the way of the best of them.

    H after the step is linearised at the desired control, by differentiating the prediction, which gives one half-space to
    project onto: H(x′) + ∇H·(u − u_des) ≥ margin + `spare`. As that is an approximation, the prediction decides whether the
    projection may act; the spare, and linearising `rounds` times, let it pass more often.
    """

    spare: Annotated[Number, Unit("as the constraint"), Range(0.0)] = 0.0
    rounds: Annotated[int, Range(1, 8)] = 2

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        (low, high), required = bounds(env), self.required_margin(env)

        def least(u: Float[Array, " m"]) -> Float[Array, " backups"]:
            return self.certify(env, sim, advance(env, sim, u))

        def improve(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            proposal, feasible = carry
            values, gains = linear(least, proposal)
            best = jnp.argmax(values)
            known = jnp.isfinite(values[best])
            row = jnp.where(known, gains[:, best], 0.0)
            short = jnp.where(known, required + self.spare - values[best], 0.0)
            projected, feasible = project_box_halfspace(desired, low, high, row, short + jnp.sum(row * proposal))
            safe = values[best] >= required
            return (jnp.where(safe, proposal, projected), safe | (known & feasible)), None

        return jax.lax.scan(improve, (desired, jnp.ones((), bool)), length=self.rounds)[0]


def _derivative(env: Environment, sim: Sim, platforms: Any, control: Float[Array, " m"]) -> Any:
    """ẋ of all platforms, as a tangent."""
    return {
        platform.name: platform.derivative(platforms[platform.name], commanded(env, platform, sim, control))
        for platform in env.platforms
    }
