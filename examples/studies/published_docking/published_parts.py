"""The plant and the four filters of a public study of run time assurance in docking.

Dunlap, Mote, Delsing and Hobbs, "Run Time Assured Reinforcement Learning for Safe Satellite
Docking", 2023. The parts act as that study's code does, for comparisons with it. Nothing that they
let pass is certified; the filters of `jaxsafe.rta` are.

All filters keep one constraint, h = ν₀ + ν₁‖r‖ − ‖v‖ ≥ 0.
"""

from typing import Annotated

import jax
import jax.numpy as jnp

from jaxsafe.parts import (
    RTA,
    MetresPerSecond,
    PerSecond,
    Positive,
    Range,
    RTAInfo,
    RTAMemory,
    Status,
    safe_norm,
)
from jaxsafe.rta.qp import nearest_solution
from jaxsafe.simulation.cwh import Spacecraft, cwh_acceleration
from jaxsafe.transition import bounds


class SemiImplicitSpacecraft(Spacecraft, type="semi_implicit_spacecraft"):
    """A spacecraft in Hill's frame, integrated by the semi-implicit rule of Euler.

    The velocity is moved by the acceleration at the old state, and then the position by the new
    velocity: v ← v + a(r, v)Δt, r ← r + vΔt.
    """

    def step(self, state, controls, dt):
        moved = self.derivative(state, controls)
        velocity = state.velocity + moved.velocity * dt
        return state.replace(
            position=state.position + velocity * dt,
            velocity=velocity,
            delta_v=self._thrust_acceleration(controls) * dt,
        )


class Intervened(Status, type="intervened"):
    """Whether the filter changed the size of the control: |‖u‖ − ‖u_des‖| ≥ 10⁻⁴ N."""

    def process(self, memory, sim):
        sizes = safe_norm(sim.control_actual) - safe_norm(sim.control_desired)
        return jnp.abs(sizes) >= 1e-4


class PublishedFilter(RTA):
    """Base of the four filters. A subclass says which control acts."""

    floor: MetresPerSecond = 0.2
    """The limit ν₀ at the chief."""
    slope: PerSecond = 0.002054
    """The limit's rise ν₁ with the distance, 2n."""

    @property
    def constraints(self):
        """No names, because the filters compute the one constraint themselves."""
        return ()

    def begin(self, env, sim):
        false = jnp.zeros((), bool)
        backup_index = jnp.zeros((), jnp.int32)
        h = self.h(*self.state(env, sim))
        info = RTAInfo(
            correction=jnp.zeros_like(sim.time),
            feasible=~false,
            certified=false,
            predicted_margin=h,
            backup_index=backup_index,
        )
        memory = RTAMemory(intervening=false, backup_index=backup_index, certified=false, ahead={})
        return memory, info

    def filter(self, env, sim, memory, desired):
        low, high = bounds(env)
        wanted = jnp.clip(desired, low, high)
        position, velocity = self.state(env, sim)
        control, feasible = self.act(env, position, velocity, wanted)
        control = jnp.clip(control, low, high)
        correction = safe_norm(control - wanted)
        info = RTAInfo(
            correction=correction,
            feasible=feasible,
            certified=jnp.zeros((), bool),
            predicted_margin=self.h(*self.after(env, position, velocity, control)),
            backup_index=memory.backup_index,
        )
        return control, memory.replace(intervening=correction >= 1e-4), info

    def act(self, env, position, velocity, wanted):
        """Return the control that acts [N], shape (2,), and whether it meets the filter's rows."""
        raise NotImplementedError

    def state(self, env, sim):
        """Return the position [m] and the velocity [m/s] of the agent, each of shape (2,)."""
        own = sim.platforms[env.agent]
        return own.position, own.velocity

    def h(self, position, velocity):
        """Return the constraint, ν₀ + ν₁‖r‖ − ‖v‖."""
        return self.floor + self.slope * safe_norm(position) - safe_norm(velocity)

    def drift(self, env, position, velocity):
        """Return the acceleration without thrust [m/s²], shape (2,)."""
        n = env.agent_platform.mean_motion
        return cwh_acceleration(r=position, v=velocity, a=jnp.zeros_like(velocity), n=n)

    def after(self, env, position, velocity, control):
        """Return position and velocity after an explicit Euler step of the control."""
        pushed = self.drift(env, position, velocity) + control / env.agent_platform.mass
        return position + velocity * env.dt, velocity + pushed * env.dt


class PublishedExplicitSimplex(PublishedFilter, type="published_explicit_simplex"):
    """Explicit switching: the desired control unless h < 0 after one step of it.

    The backup scales the velocity after the step onto the limit, and inverts the dynamics.
    """

    def act(self, env, position, velocity, wanted):
        position_after, velocity_after = self.after(env, position, velocity, wanted)
        limit = self.floor + self.slope * safe_norm(position_after)
        scaled = velocity_after * limit / jnp.maximum(safe_norm(velocity_after), 1e-9)
        needed = (scaled - velocity) / env.dt - self.drift(env, position, velocity)
        violated = self.h(position_after, velocity_after) < 0.0
        backup = env.agent_platform.mass * needed
        return jnp.where(violated, backup, wanted), jnp.ones((), bool)


class PublishedImplicitSimplex(PublishedFilter, type="published_implicit_simplex"):
    """Implicit switching: the desired control unless h < 0 after one step of it.

    The published loop over the horizon of 5 s looks at the first predicted state only, and so does
    this filter.
    """

    gain: Annotated[PerSecond, Positive] = 0.6
    """The gain κ of the backup law."""

    def act(self, env, position, velocity, wanted):
        violated = self.h(*self.after(env, position, velocity, wanted)) < 0.0
        backup = to_ellipse(env, self.gain, position, velocity)
        return jnp.where(violated, backup, wanted), jnp.ones((), bool)


class PublishedExplicitASIF(PublishedFilter, type="published_explicit_asif"):
    """Explicit optimisation: the nearest control with ∇h̃·(f + gu) + α(h) ≥ 0.

    Here h̃ = (ν₀ + ν₁‖r‖)² − ‖v‖² gives the gradient, and α(h) = 0.1h + 0.1h³.
    """

    def act(self, env, position, velocity, wanted):
        def squared(position, velocity):
            positions, velocities = self.path(env, position, velocity)
            limits = self.floor + self.slope * safe_norm(positions)
            return limits**2 - jnp.sum(velocities**2, axis=-1)

        by_position, by_velocity = jax.jacfwd(squared, (0, 1))(position, velocity)
        h = self.h(*self.path(env, position, velocity))
        falling = by_position @ velocity + by_velocity @ self.drift(env, position, velocity)
        low, high = bounds(env)
        rows = by_velocity / env.agent_platform.mass
        solution = nearest_solution(wanted, low, high, rows, -(0.1 * h + 0.1 * h**3) - falling)
        return solution.control, solution.solved

    def path(self, env, position, velocity):
        """Return positions and velocities at which there is a row, each of shape (rows, 2)."""
        return position[None], velocity[None]


class PublishedImplicitASIF(PublishedExplicitASIF, type="published_implicit_asif"):
    """Implicit optimisation: the same along the backup law, by its sensitivity."""

    gain: Annotated[PerSecond, Positive] = 0.6
    """The gain κ of the backup law."""
    steps: Annotated[int, Range(0, 20)] = 5
    """How many steps the backup law is followed."""

    def path(self, env, position, velocity):
        def one_step(at, _):
            return self.after(env, *at, to_ellipse(env, self.gain, *at)), at

        return jax.lax.scan(one_step, (position, velocity), length=self.steps + 1)[1]


def to_ellipse(env, gain, position, velocity):
    """Return the control [N], shape (2,), of the law that leads to a closed natural motion.

    With e₁ = ẋ − ½ny and e₂ = ẏ + 2nx it is u_x = tanh(m(−1.5ne₂ − κe₁)), u_y = tanh(−mκe₂).
    """
    n = env.agent_platform.mean_motion
    first = velocity[0] - 0.5 * n * position[1]
    second = velocity[1] + 2.0 * n * position[0]
    thrust = [-1.5 * n * second - gain * first, -gain * second]
    return jnp.tanh(env.agent_platform.mass * jnp.stack(thrust))
