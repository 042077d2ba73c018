"""Control laws for docking: PD along the speed limit, LQR, MPC, and thrust along one body axis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.control.law import ControlLaw, wrong_controls
from jaxsafe.control.observed import Needs
from jaxsafe.control.riccati import lqr_gain, riccati
from jaxsafe.environment import Environment
from jaxsafe.processors.status import VelocityLimit
from jaxsafe.schema.component import Range
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.geometry import direction, safe_norm
from jaxsafe.simulation.oriented import OrientedSpacecraft
from jaxsafe.simulation.trig import wrap
from jaxsafe.transition import bounds
from jaxsafe.types import (
    Dimensionless,
    Length,
    MetresPerSecond,
    Newtons,
    Number,
    PerSecond,
    Positive,
    Radians,
    Seconds,
    Sim,
)

Share = Annotated[Dimensionless, Range(0.0, 1.0, open_low=True)]
"""Share of the speed limit."""


class PD(ControlLaw, type="pd"):
    """Proportional-derivative control of a point mass along the speed limit.

    The desired velocity w points at the origin. Its size is ‖r‖ times `approach`, and at most
    `share` of the speed limit ν₀ + ν₁‖r‖, Eqs. (14), (17). The thrust m (w − v)/`response` is
    proportional to the error of the velocity. Where the speed limit does not cut w, this is a PD
    law in position.

    The numbers are chosen by hand: `share` leaves room for the lag behind the falling limit, and
    `approach` makes the last metre slower than the limit.
    """

    share: Share = 0.97
    approach: Annotated[PerSecond, Positive] = 0.3
    response: Seconds = 4.0

    def needs(self, env: Environment) -> Needs:
        return _point_mass(env, self)

    def control(self, env: Environment, design: Any, sim: Sim) -> Float[Array, " m"]:
        state = sim.platforms[env.agent]
        mass = env.agent_platform.mass  # type: ignore[attr-defined]
        desired = _towards_origin(env, state.position, self.share, self.approach)
        return mass * (desired - state.velocity) / self.response


class LQR(ControlLaw, type="lqr"):
    """Linear-quadratic regulator of a point mass, in discrete time: u = −K x, x = (r, v).

    K minimises Σ xᵀQx + uᵀRu for the plant's own step, which is linear. Q and R follow Bryson's
    rule: the weight of a quantity is 1/(its largest acceptable value)². The slow poles are near
    −`speed`/`position`, so with 150 m and 0.5 m/s the deputy of the paper flies below the speed
    limit from 150 m on: ‖v‖ ≈ ‖r‖/300 s.
    """

    position: Annotated[Length, Positive] = 150.0
    speed: Annotated[MetresPerSecond, Positive] = 0.5
    thrust: Annotated[Newtons, Positive] = 1.0

    def needs(self, env: Environment) -> Needs:
        return _point_mass(env, self)

    def design(self, env: Environment) -> Float[Array, "m 2*m"]:
        """Return the gain K."""
        a, b = linear_model(env)
        size = b.shape[1]
        q = _bryson([self.position] * size + [self.speed] * size)
        return jnp.asarray(lqr_gain(a, b, q, _bryson([self.thrust] * size)), env.dt.dtype)

    def control(self, env: Environment, design: Any, sim: Sim) -> Float[Array, " m"]:
        state = sim.platforms[env.agent]
        return -jnp.concatenate([state.position, state.velocity]) @ design.T


class MPC(ControlLaw, type="mpc"):
    """Model predictive control of a point mass under the speed limit and the bounds of its thrust.

    Every step it plans `horizon` thrusts, each held for `hold` steps, and gives the first. The plan
    minimises Σ xᵀQx + uᵀRu for the linear plant, with Q and R as in `LQR`. To this sum is added the
    cost of an LQR that goes on from the end of the plan for ever. After every thrust
    ‖v‖ ≤ `share` · (ν₀ + ν₁ e·r), where e is the present direction of the position r. This is a
    second-order cone. It lies within the speed limit, because e·r ≤ ‖r‖. In the cost a position
    farther away than `reach` counts as one at `reach`. Larger costs would need more rounds.

    Q and R are chosen by hand: a `position` that is small against the way to fly makes the plan as
    fast as the limit allows. A plan looks `horizon` · `hold` · Δt ahead.

    The plan is found by `iterations` rounds of ADMM (Boyd et al. 2011), as in OSQP and SCS. A round
    is one product with a matrix that `design` has inverted, and projections onto the box of the
    thrusts and the cones of the speeds.
    """

    position: Annotated[Length, Positive] = 5.0
    speed: Annotated[MetresPerSecond, Positive] = 1.0
    thrust: Annotated[Newtons, Positive] = 1.0
    share: Share = 0.98
    reach: Annotated[Length, Positive] = 200.0
    horizon: Annotated[int, Range(1, largest=200)] = 12
    hold: Annotated[int, Range(1, largest=1000)] = 4
    iterations: Annotated[int, Range(1, largest=10_000)] = 40
    penalty: Annotated[Dimensionless, Positive] = 2.0

    def needs(self, env: Environment) -> Needs:
        return _point_mass(env, self)

    def design(self, env: Environment) -> Mapping[str, Array]:
        """Return the matrices of the plan. Its thrusts u are shares of the largest one.

        With the Hessian H of the cost and the penalty ρ of ADMM they are:

        - `gradient`: its product with the state x is 1/ρ times the gradient of the cost at u = 0.
        - `rows` G and `offset`: G u plus `offset` times x are the constrained quantities of the
          plan. They are all positions times ν₁ and all velocities, both divided by `_unit`.
        - `step`: ρ (H + ρ (I + GᵀG))⁻¹.
        """
        a, b = linear_model(env)
        size = b.shape[1]
        count = self.horizon
        low, high = bounds(env)
        largest = float(jnp.max(jnp.maximum(-low, high)))
        b = b * largest
        held = np.sum([np.linalg.matrix_power(a, i) @ b for i in range(self.hold)], axis=0)
        a = np.linalg.matrix_power(a, self.hold)
        q = _bryson([self.position] * size + [self.speed] * size)
        r = _bryson([self.thrust / largest] * size)

        # x_k = powers[k] x + Σ_j responses[k][j] u_j for the states after thrust k.
        powers = np.stack([np.linalg.matrix_power(a, k + 1) for k in range(count)])
        responses = np.zeros((count, 2 * size, count, size))
        for k in range(count):
            for j in range(k + 1):
                responses[k, :, j] = np.linalg.matrix_power(a, k - j) @ held
        responses = responses.reshape(count, 2 * size, count * size)
        weights = np.stack([q] * (count - 1) + [riccati(a, held, q, r)])
        hessian = np.einsum("kxu,kxy,kyv->uv", responses, weights, responses)
        hessian = hessian + np.kron(np.eye(count), r)
        gradient = np.einsum("kxu,kxy,kyz->uz", responses, weights, powers)

        limit = speed_limit(env)
        scale = np.array([limit.slope] * size + [1.0] * size) / float(self._unit(limit))
        rows = (scale[:, None] * responses).reshape(-1, count * size)
        offset = (scale[:, None] * powers).reshape(-1, 2 * size)
        gram = np.eye(count * size) + rows.T @ rows
        penalty = float(self.penalty) * np.trace(hessian) / np.trace(gram)
        step = np.linalg.inv(hessian + penalty * gram)
        matrices = {
            "step": penalty * step,
            "gradient": gradient / penalty,
            "rows": rows,
            "offset": offset,
        }
        return {name: jnp.asarray(matrix, env.dt.dtype) for name, matrix in matrices.items()}

    def _unit(self, limit: VelocityLimit) -> Number:
        """Return the speed [m/s] that counts as 1: ν₀, or the limit at `position` if that is 0."""
        return jnp.maximum(limit.floor, limit.slope * self.position)

    def control(self, env: Environment, design: Any, sim: Sim) -> Float[Array, " m"]:
        state = sim.platforms[env.agent]
        size = state.position.size
        low, high = bounds(env)
        largest = jnp.max(jnp.maximum(-low, high))
        limit = speed_limit(env)
        distance = safe_norm(state.position)
        outwards = state.position / jnp.maximum(distance, 1e-6)
        to_go = jnp.minimum(distance, self.reach) * outwards
        gradient = design["gradient"] @ jnp.concatenate([to_go, state.velocity])
        offset = design["offset"] @ jnp.concatenate([state.position, state.velocity])
        unit = self._unit(limit)
        floor = (limit.floor - limit.slope * limit.constant_to) / unit

        def project(plan: Array, motion: Array) -> tuple[Array, Array]:
            """Return the nearest plan within the box, and the nearest motion within the cones."""
            plan = jnp.clip(plan.reshape(-1, size), low / largest, high / largest).ravel()
            position, velocity = jnp.split(motion.reshape(-1, 2 * size), 2, axis=1)
            height = position @ outwards
            speed, change = _into_cone(safe_norm(velocity), floor + height, self.share)
            velocity = velocity * (speed / jnp.maximum(safe_norm(velocity), 1e-9))[:, None]
            position = position + change[:, None] * outwards
            return plan, jnp.concatenate([position, velocity], axis=1).ravel()

        def improve(carry: tuple[Array, ...], _: Any) -> tuple[tuple[Array, ...], None]:
            plan, motion, plan_error, motion_error = carry
            aim = plan - plan_error + design["rows"].T @ (motion - offset - motion_error)
            free_plan = design["step"] @ (aim - gradient)
            free_motion = design["rows"] @ free_plan + offset
            plan, motion = project(free_plan + plan_error, free_motion + motion_error)
            plan_error = plan_error + free_plan - plan
            motion_error = motion_error + free_motion - motion
            return (plan, motion, plan_error, motion_error), None

        no_thrust = jnp.zeros_like(gradient)
        start = (*project(no_thrust, offset), no_thrust, jnp.zeros_like(offset))
        (plan, *_), _ = jax.lax.scan(improve, start, None, self.iterations)
        return largest * plan[:size]


def _into_cone(radius: Array, height: Array, slope: Number) -> tuple[Array, Array]:
    """Return the radius of the nearest point of a cone, and the change of its height.

    The cone is radius ≤ slope · height.
    """
    inside = radius <= slope * height
    nearest = jnp.maximum(slope * radius + height, 0.0) / (1.0 + slope**2)
    return jnp.where(inside, radius, slope * nearest), jnp.where(inside, 0.0, nearest - height)


class Align(ControlLaw, type="align"):
    """A turn of the body axis towards the desired acceleration, and thrust along it.

    The law is for a spacecraft that thrusts along its body. With the desired velocity w of `PD` the
    desired acceleration is (w − v)/`response` + ẇ − a, where a is the acceleration without thrust.
    So the axis points along the falling limit once the velocity is right, and does not follow
    noise.

    Let e be the angle from the nearer end of the body axis to the desired acceleration, and α the
    largest angular acceleration. The attitude follows the rate sign(e) min(√(1.6 α abs(e)),
    abs(e)/`settle`). While abs(e) ≤ `aligned`, the thrust gives the part of the desired
    acceleration along the axis, and else it is 0. Thrust across the desired acceleration would turn
    that away as fast as the body follows.

    From the rate √(2 α abs(e)) a full deceleration ends at e = 0. So 1.6 leaves a margin of a
    tenth of the rate. The other numbers are chosen by hand. `share` is smaller than in `PD`,
    because the body has to turn before it can brake. With 0.97 every ninth episode exceeds the
    limit.
    """

    share: Share = 0.9
    approach: Annotated[PerSecond, Positive] = 0.1
    response: Seconds = 8.0
    aligned: Annotated[Radians, Positive] = 0.1
    settle: Seconds = 4.0

    def needs(self, env: Environment) -> Needs:
        if not isinstance(env.agent_platform, OrientedSpacecraft):
            raise ConfigError(
                f"controller: align flies an oriented_spacecraft; {env.agent} is a "
                f"{env.agent_platform.type_name}"
            )
        controls = ("thrust", "attitude_acceleration")
        if sorted(env.action_names) != sorted(controls):
            raise wrong_controls(env, self, controls)
        return [(env.agent, what) for what in ("position", "velocity", "attitude", "attitude_rate")]

    def control(self, env: Environment, design: Any, sim: Sim) -> Float[Array, " 2"]:
        state = sim.platforms[env.agent]
        plant = cast(OrientedSpacecraft, env.agent_platform)

        def desired(position: Array) -> Array:
            return _towards_origin(env, position, self.share, self.approach)

        velocity, velocity_rate = jax.jvp(desired, (state.position,), (state.velocity,))
        drift = plant.derivative(state, {}).velocity
        push = (velocity - state.velocity) / self.response + velocity_rate - drift
        error = wrap(jnp.arctan2(push[1], push[0]) - state.attitude, -jnp.pi / 2, jnp.pi)
        _, high = bounds(env)
        largest_turn = high[env.action_names.index("attitude_acceleration")]
        fastest = jnp.sqrt(1.6 * largest_turn * jnp.abs(error))
        rate = jnp.sign(error) * jnp.minimum(fastest, jnp.abs(error) / self.settle)
        turn = (rate - state.attitude_rate) / env.dt
        thrust = plant.mass * jnp.sum(push * direction(state.attitude))
        thrust = jnp.where(jnp.abs(error) <= self.aligned, thrust, 0.0)
        controls = {"thrust": thrust, "attitude_acceleration": turn}
        return jnp.stack([controls[name] for name in env.action_names])


def linear_model(env: Environment) -> tuple[np.ndarray, np.ndarray]:
    """Return A and B of x' = A x + B u, the step of a linear point mass, with x = (r, v).

    Their shapes are (2m, 2m) and (2m, m) for m thrusts.
    """
    plant = env.agent_platform
    names = env.action_names
    size = len(names)

    def step(x: Array, u: Array) -> Array:
        state = plant.rest().replace(position=x[:size], velocity=x[size:])
        after = plant.step(state, dict(zip(names, u, strict=True)), env.dt)
        return jnp.concatenate([after.position, after.velocity])

    origin = (jnp.zeros(2 * size, env.dt.dtype), jnp.zeros(size, env.dt.dtype))
    a, b = jax.jacfwd(step, argnums=(0, 1))(*origin)
    return np.asarray(a, np.float64), np.asarray(b, np.float64)


def speed_limit(env: Environment) -> VelocityLimit:
    """Return the status that is the speed limit.

    Raises:
        ConfigError: there is none.
    """
    limits = [status for status in env.status if isinstance(status, VelocityLimit)]
    if not limits:
        raise ConfigError("controller: needs a status of type velocity_limit, found none")
    return limits[0]


def _towards_origin(
    env: Environment, position: Float[Array, " d"], share: Number, approach: Number
) -> Float[Array, " d"]:
    """Return the velocity towards the origin at a share of the speed limit, or less near it."""
    limit = speed_limit(env)
    distance = safe_norm(position)
    allowed = limit.floor + limit.slope * jnp.maximum(distance - limit.constant_to, 0.0)
    speed = jnp.minimum(share * allowed, approach * distance)
    return -speed * position / jnp.maximum(distance, 1e-6)


def _point_mass(env: Environment, law: ControlLaw) -> Needs:
    """Return what a law for point masses needs.

    Raises:
        ConfigError: the agent does not have a thruster pair along each axis.
    """
    plant = env.agent_platform
    axes = tuple(f"thrust_{axis}" for axis in "xyz"[: plant.dimension])
    if env.action_names != axes:
        raise wrong_controls(env, law, axes)
    return [(env.agent, "position"), (env.agent, "velocity")]


def _bryson(largest: list[Any]) -> np.ndarray:
    """Return the diagonal weights of quantities, given the largest acceptable value of each."""
    return np.diag(1.0 / np.array([float(value) for value in largest]) ** 2)
