"""Backup controllers with memory: they finish what they began, rehearse it, or hold a place."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.backups import AlignAndBrake
from jaxsafe.rta.certificate import BackupController, Faults
from jaxsafe.rta.certified import CertifiedRTA
from jaxsafe.rta.proofs import STEPS_TO_ALIGN, rehearsed_faults
from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.cwh import Spacecraft
from jaxsafe.transition import Others, advance, bounds
from jaxsafe.types import Number, Positive, Record, Seconds, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


class LatchMemory(Record):
    """Memory of `Latched`."""

    acted_for: Float[Array, ""]  # s since the controller took over
    inner: Any  # what the latched controller remembers


class Latched(BackupController, type="latched"):
    """Another backup controller that acts for at least `at_least` seconds once it has taken over.

    The agent gets control back only after that. The certificate is that of the other controller.
    """

    backup: BackupController
    at_least: Seconds

    @property
    def proved(self) -> BackupController:
        return self.backup.proved

    def init(self, env: Environment, sim: Sim) -> LatchMemory:
        return LatchMemory(acted_for=jnp.zeros_like(env.dt), inner=self.backup.init(env, sim))

    def act(
        self, env: Environment, sim: Sim, later: Others, memory: LatchMemory
    ) -> tuple[Float[Array, " m"], LatchMemory]:
        control, inner = self.backup.act(env, sim, later, memory.inner)
        return control, LatchMemory(acted_for=memory.acted_for + env.dt, inner=inner)

    def unfinished(self, env: Environment, sim: Sim, memory: LatchMemory) -> Bool[Array, ""]:
        # Half a step is for the rounding of the sum.
        begun = memory.acted_for > 0.0
        return begun & (memory.acted_for < self.at_least - 0.5 * env.dt)

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        return self.backup.faults(env, sim, rta)

    def duration(self, env: Environment) -> Number:
        return self.backup.duration(env)


class Rehearsed(BackupController, type="rehearsed"):
    """Another backup controller that flies as it would without disturbances and errors.

    It remembers the state that the agent would have then, and gives the controls of that state. So
    the true way leaves the remembered one by no more than disturbances and errors add up to. The
    other controller never decides otherwise on the true way, where a small difference may be enough
    to turn the other way round. The memory begins anew where the agent is, as soon as the other
    controller is proved to keep the constraint from there (`keeps_from`).

    It serves for filters with a `bound`.
    """

    backup: BackupController

    @property
    def proved(self) -> BackupController:
        return self.backup.proved

    def init(self, env: Environment, sim: Sim) -> Any:
        return sim.platforms[env.agent]

    def act(
        self, env: Environment, sim: Sim, later: Others, memory: Any
    ) -> tuple[Float[Array, " m"], Any]:
        own = sim.platforms[env.agent]
        anew = self.backup.keeps_from(env, sim)
        start = jax.tree.map(lambda now, then: jnp.where(anew, now, then), own, memory)
        platforms = {**sim.platforms, env.agent: start}
        rehearsal = sim.replace(platforms=platforms, regions={}, status={})
        control = jnp.clip(self.backup.control(env, rehearsal, later), *bounds(env))
        return control, advance(env, rehearsal, control, later=later).platforms[env.agent]

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        own = rehearsed_faults(env, rta, self.backup, keeper=AlignAndBrake)
        return own | self.backup.faults(env, sim, rta)

    def duration(self, env: Environment) -> Number:
        return self.backup.duration(env)

    def most_rehearsed_steps(self, horizon: int) -> int:
        # A step of the agent's control, a turn along the velocity, and a step of braking.
        return horizon + int(STEPS_TO_ALIGN) + 2


class HoldMemory(Record):
    """Memory of `HoldPosition`."""

    place: Float[Array, " d"]  # where the controller took over [m]
    missing: Float[Array, " d"]  # the distance from there, summed up over time [m s]


class HoldPosition(BackupController, type="hold_position"):
    """A linear-quadratic regulator with integral action that holds a spacecraft where it took over.

    Each axis is taken as a double integrator with the state z = ∫e dt, e and v, where e is the
    distance from the place. The thrust is −m (k_i z + k_r e + k_v v), which minimises the integral
    of w_i² z² + w_r² e² + w_v² v² + (F/m)². So k_i = w_i, k_r² = w_r² + 2 k_i k_v and k_v² = w_v² +
    2 k_r. While the thrust is at a bound, z rests, so that it does not wind up.
    """

    position_weight: Annotated[Number, Unit("1/s²"), Positive] = 0.01
    velocity_weight: Annotated[Number, Unit("1/s"), Range(0.0)] = 0.1
    integral_weight: Annotated[Number, Unit("1/s³"), Range(0.0)] = 0.0001

    def init(self, env: Environment, sim: Sim) -> HoldMemory:
        place = sim.platforms[env.agent].position
        return HoldMemory(place=place, missing=jnp.zeros_like(place))

    def act(
        self, env: Environment, sim: Sim, later: Others, memory: HoldMemory
    ) -> tuple[Float[Array, " m"], HoldMemory]:
        plant = cast(Spacecraft, env.agent_platform)
        own = sim.platforms[env.agent]
        of_integral, of_place, of_velocity = self.gains()
        apart = own.position - memory.place
        missing = memory.missing + apart * env.dt
        pull = of_integral * missing + of_place * apart + of_velocity * own.velocity
        axes = [plant.inputs.index(name) for name in env.action_names]
        thrust = -plant.mass * pull[jnp.array(axes)]
        low, high = bounds(env)
        free = (
            jnp.zeros(apart.shape, bool).at[jnp.array(axes)].set((thrust > low) & (thrust < high))
        )
        return thrust, memory.replace(missing=jnp.where(free, missing, memory.missing))

    def gains(self) -> tuple[Number, Number, Number]:
        """Return k_i [1/s³], k_r [1/s²] and k_v [1/s]."""
        of_integral = self.integral_weight
        of_place = self.position_weight
        of_velocity = self.velocity_weight
        for _ in range(12):  # each round leaves at most a quarter of the error
            of_place = jnp.sqrt(self.position_weight**2 + 2.0 * of_integral * of_velocity)
            of_velocity = jnp.sqrt(self.velocity_weight**2 + 2.0 * of_place)
        return of_integral, of_place, of_velocity

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        if rta.terminal is None or type(rta.terminal).__module__.startswith("jaxsafe."):
            fault = "hold_position is proved for no constraint: give a terminal set of your own"
            return {fault: jnp.ones((), bool)}
        return {}
