"""Active set invariance filters (ASIF), Eqs. (2)-(4).

They give the control nearest to the desired one that meets barrier constraints. `ExplicitASIF` is
the paper's continuous-time quadratic program. `DiscreteASIF` keeps a speed limit after a whole step
of held thrust, which is what a plant with a finite step needs.
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

    gamma: Annotated[Number, Unit("1"), Range(0.0, 1.0, open_low=True)] = 1.0

    def problem(self) -> str | None:
        return super().problem() or (
            None if len(self.constraints) == 1 else "expected one constraint, a speed limit"
        )

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        required = self.required_margin(env)
        limited = constraint(env, self.constraints[0])
        spare = jnp.maximum(limited.margin(judge(env, sim)) - required, 0.0)
        limit = limited.limit(judge(env, sim))
        rounding = ROUNDINGS_INSIDE * jnp.finfo(desired.dtype).eps * limit
        margin = required + (1.0 - self.gamma) * spare + rounding
        beta, p, k = speed_ball(
            env, sim, control=jnp.zeros_like(desired), name=self.constraints[0], margin=margin
        )
        low, high = bounds(env)
        return project_box_ball(u=desired, low=low, high=high, beta=beta, p=p, k=k)


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
    """Return the value of a function and its derivatives, which have an axis of m in front.

    Differentiation is forwards, so that nothing is stored.
    """
    along = functools.partial(jax.jvp, function, (at,))
    return jax.vmap(along, out_axes=(None, 0))((jnp.eye(at.shape[0], dtype=at.dtype),))


SlackCost = Annotated[Number, Unit("1"), Range(0.0, open_low=True)]
"""Cost σ of missing a constraint."""


class Strengthening(Component):
    """A strengthening function α of class κ, Eq. (4)."""

    def of(self, h: Float[Array, ""]) -> Float[Array, ""]:
        """Return α(h), which increases with h and is 0 at h = 0."""
        raise NotImplementedError


class Polynomial(Strengthening, type="polynomial"):
    """The strengthening function α(h) = linear·h + cubic·h³."""

    linear: Annotated[Number, Unit("1"), Range(0.0)] = 1.0
    cubic: Annotated[Number, Unit("1"), Range(0.0)] = 0.0

    def of(self, h: Float[Array, ""]) -> Float[Array, ""]:
        return self.linear * h + self.cubic * h**3


class ExplicitASIF(CertifiedRTA, type="explicit_asif"):
    """The paper's ASIF, Eqs. (2)-(4).

    It solves argmin ‖u − u_des‖² subject to L_f h + L_g h u + α(h) ≥ 0 for every constraint. These
    barrier rows come from h and the platforms' derivatives alone.

    If the control reaches h only after differentiating `degree` times, the constraint is lifted
    first (HOCBF): ψ₀ = h and ψᵢ = ψ̇ᵢ₋₁ + α(ψᵢ₋₁). The row is then that of the last ψ. With `slack`
    σ every row may be missed by s at a cost of σ s².

    Continuous-time barriers say nothing about a control that is held over a step. With `enforce`
    the prediction has the last word. Without it the solution acts, as in the paper.
    """

    strengthening: Strengthening = Polynomial()
    degree: Annotated[int, Range(1, 3)] = 1
    slack: SlackCost | None = None

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        rows, _ = self.rows(env, sim, env.action_size)
        reason = f"of degree {self.degree} the control has no influence on"
        no_influence = {
            f"{reason} {name!r}": jnp.all(row == 0.0)
            for name, row in zip(self.constraints, rows, strict=True)
        }
        return no_influence | super().unsuited(env, sim)

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        rows, offsets = self.rows(env, sim, desired.shape[0])
        low, high = bounds(env)
        if len(rows) == 1 and self.slack is None:
            return project_box_halfspace(u=desired, low=low, high=high, a=rows[0], b=offsets[0])
        return nearest_control(
            u=desired, low=low, high=high, rows=rows, offsets=offsets, slack=self.slack
        )

    def rows(
        self, env: Environment, sim: Sim, size: int
    ) -> tuple[Float[Array, "c m"], Float[Array, " c"]]:
        """Return the barrier rows a·u ≥ b, one for each of c constraints.

        Args:
            env: the environment.
            sim: the simulation at the state.
            size: the number m of controls.

        Returns:
            a of shape (c, m) and b of shape (c,).
        """
        rows = [self._row(env, sim, name, size) for name in self.constraints]
        return jnp.stack([a for a, _ in rows]), jnp.stack([b for _, b in rows])

    def _row(
        self, env: Environment, sim: Sim, name: str, size: int
    ) -> tuple[Float[Array, " m"], Float[Array, ""]]:
        def h(platforms: Any) -> Array:
            return constraint(env, name).margin(judge(env, sim.replace(platforms=platforms)))

        lifted = h
        for _ in range(self.degree - 1):
            lifted = self._lift(env, sim, lifted, size)

        def rate(u: Float[Array, " m"]) -> tuple[Array, Array]:
            derivative = _derivative(env, sim, sim.platforms, u)
            value, slope = jax.jvp(lifted, (sim.platforms,), (derivative,))
            return slope, value

        (drift, value), (gains, _) = linear(rate, jnp.zeros(size, env.dt.dtype))
        return gains, -(drift + self.strengthening.of(value))

    def _lift(self, env: Environment, sim: Sim, psi: Any, size: int) -> Any:
        """Return ψ̇ + α(ψ) without control, as a function of the platforms' states."""

        def lifted(platforms: Any) -> Array:
            still = jnp.zeros(size, env.dt.dtype)
            value, slope = jax.jvp(psi, (platforms,), (_derivative(env, sim, platforms, still),))
            return slope + self.strengthening.of(value)

        return lifted


class ImplicitASIF(CertifiedRTA, type="implicit_asif"):
    """An ASIF whose safe set is known only through backup controllers.

    H(x) is the smallest h on the way of the best backup controller from x. H after the step is
    linearised at the desired control, by differentiating the prediction. That gives one half-space
    to project onto: H(x′) + ∇H·(u − u_des) ≥ margin + `spare`.

    The half-space is an approximation, so the prediction decides whether the projection may act.
    The spare lets it pass more often, and so does linearising `rounds` times.
    """

    spare: Annotated[Number, Unit("as the constraint"), Range(0.0)] = 0.0
    rounds: Annotated[int, Range(1, 8)] = 2

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        low, high = bounds(env)
        required = self.required_margin(env)

        def least(u: Float[Array, " m"]) -> Float[Array, " backups"]:
            return self.certify(env, sim, advance(env, sim, u))

        def improve(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            proposal, feasible = carry
            values, gains = linear(least, proposal)
            best = jnp.argmax(values)
            known = jnp.isfinite(values[best])
            row = jnp.where(known, gains[:, best], 0.0)
            missing = jnp.where(known, required + self.spare - values[best], 0.0)
            projected, feasible = project_box_halfspace(
                u=desired, low=low, high=high, a=row, b=missing + jnp.sum(row * proposal)
            )
            safe = values[best] >= required
            return (jnp.where(safe, proposal, projected), safe | (known & feasible)), None

        return jax.lax.scan(improve, (desired, jnp.ones((), bool)), length=self.rounds)[0]


def _derivative(env: Environment, sim: Sim, platforms: Any, control: Float[Array, " m"]) -> Any:
    """Return the derivatives ẋ of all platforms by name, as a tangent of their states."""
    return {
        platform.name: platform.derivative(
            platforms[platform.name], commanded(env, platform, sim, control)
        )
        for platform in env.platforms
    }
