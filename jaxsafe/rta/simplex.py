"""Simplex filters, Eq. (1): the desired control or the backup control, and a mixture of both."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.filter import RTA, CertifiedRTA, RTAMemory, admissible
from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.geometry import direction, safe_norm, to_body
from jaxsafe.transition import advance, undirected
from jaxsafe.types import Length, Number, PlatformName, Positive, RadiansPerSecond, RTAInfo, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment


class Simplex(CertifiedRTA, type="simplex"):
    """The desired control if it is certified, else the backup control, Eq. (1)."""

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        return desired, jnp.ones((), bool)


class Blend(CertifiedRTA, type="blend"):
    """The largest share θ of the desired control that is certified: u = u_backup + θ (u_des − u_backup).

    θ is one of `parts` equal shares up to 1, each predicted by itself; without any the backup control acts. It needs no
    derivative and no structure of the plant, and corrects less than Simplex.
    """

    parts: Annotated[int, Range(1, 64)] = 8

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        shares = jnp.arange(1, self.parts + 1, dtype=desired.dtype) / self.parts
        mixed = backup + shares[:, None] * (desired - backup)
        mixed = mixed.at[-1].set(desired)  # to the last bit
        values = jax.vmap(lambda u: jnp.max(self.certify(env, sim, advance(env, sim, u))))(mixed)
        passes = values >= self.required_margin(env)
        largest = self.parts - 1 - jnp.argmax(passes[::-1])
        return jnp.where(jnp.any(passes), mixed[largest], backup), jnp.any(passes)


class CollisionSimplex(RTA, type="collision_simplex"):
    """The collision filter of the released 2D rejoin code, decision for decision; it does not prevent every collision.

    It predicts, at `points` instants over the next `window`, the distance between the agent turning at `turn_rate` away
    from the other's side and the other keeping its present rates. At `engage` or closer that turn acts, without
    acceleration, until the distance is above `release`. The desired control is never looked at.
    """

    other: PlatformName
    window: Annotated[Number, Unit("s"), Range(0.0, open_low=True, largest=1e4)] = 11.0
    points: Annotated[int, Range(2, largest=10_000)] = 111
    turn_rate: Annotated[RadiansPerSecond, Range(0.0, open_low=True, largest=1e3)] = math.radians(6.0)
    engage: Annotated[Length, Positive] = 200.0
    release: Annotated[Length, Positive] = 250.0

    def begin(self, env: Environment, sim: Sim) -> tuple[RTAMemory, RTAInfo]:
        no, zero = jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        nearest, _ = self._predict(env, sim)
        info = RTAInfo(jnp.zeros_like(sim.time), ~no, no, nearest - self.engage, zero)
        return RTAMemory(intervening=no, backup_index=zero, certified=no, ahead={}), info

    def filter(
        self, env: Environment, sim: Sim, memory: RTAMemory, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], RTAMemory, RTAInfo]:
        wanted, finite = admissible(env, desired)
        nearest, turn = self._predict(env, sim)
        on = ~(nearest > jnp.where(memory.intervening, self.release, self.engage))  # also where it is not a number
        controls = {"heading_rate": turn, "acceleration": jnp.zeros_like(turn)}
        backup = admissible(env, jnp.stack([controls[name] for name in env.action_names]))[0]
        actual = jnp.where(on, backup, wanted)
        memory = memory.replace(intervening=on)
        correction = safe_norm(actual - wanted)
        return actual, memory, RTAInfo(correction, finite, jnp.zeros((), bool), nearest - self.engage, memory.backup_index)

    def _predict(self, env: Environment, sim: Sim) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Smallest distance on the backup's way, and the turn that it makes."""
        own, other = sim.platforms[env.agent], sim.platforms[self.other]
        rate = undirected(env.platform(self.other), sim).get("heading_rate", jnp.zeros_like(sim.time))
        bearing = to_body(own.orientation, other.position - own.position)
        turn = jnp.where(bearing[1] >= 0.0, -self.turn_rate, self.turn_rate)
        times = jnp.linspace(0.0, 1.0, self.points) * self.window
        gap = _arc(own, turn, times) - _arc(other, rate, times)
        return jnp.min(safe_norm(gap)), turn


def _arc(state: Any, rate: Float[Array, ""], times: Float[Array, " n"]) -> Float[Array, "n 2"]:
    """Positions in the plane at constant speed and heading rate."""
    half = rate * times / 2.0
    chord = state.speed * times * jnp.sinc(half / jnp.pi)
    return state.position[None] + chord[:, None] * direction(state.heading + half)
