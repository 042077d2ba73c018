"""Simplex filters, Eq. (1): either the desired or the backup control acts, or a mixture of both."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.rta.certified import CertifiedRTA, Proposal
from jaxsafe.rta.filter import RTA, RTAMemory, admissible
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
    ) -> Proposal:
        return desired, jnp.ones((), bool)


class Blend(CertifiedRTA, type="blend"):
    """The mixture u = u_backup + θ (u_des − u_backup) with the largest share θ that is certified.

    θ is one of `parts` equal shares up to 1. Each is predicted by itself. If none is certified, the
    backup control acts. This filter needs no derivative and no structure of the plant, and it
    corrects less than Simplex.
    """

    parts: Annotated[int, Range(1, 64)] = 8

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> Proposal:
        shares = jnp.arange(1, self.parts + 1, dtype=desired.dtype) / self.parts
        mixed = backup + shares[:, None] * (desired - backup)
        mixed = mixed.at[-1].set(desired)  # the sum above may differ from it in the last bit

        def predict(u: Float[Array, " m"]) -> tuple[Array, Array]:
            paths = self.follow(env, sim, advance(env, sim, u))
            best = jnp.argmax(paths.values)
            return paths.values[best], self.closest(env, paths.margins[best])

        values, closest = jax.vmap(predict)(mixed)
        certified = values >= jax.vmap(lambda u: self.margin_to_certify(env, u))(mixed)
        largest = self.parts - 1 - jnp.argmax(certified[::-1])
        control = jnp.where(jnp.any(certified), mixed[largest], backup)
        return control, jnp.any(certified), closest[-1]


class CollisionSimplex(RTA, type="collision_simplex"):
    """The collision filter of the released 2D rejoin code.

    It takes the same decisions as that code, and it does not prevent every collision.

    The filter predicts the distance between the two aircraft at `points` instants over the next
    `window` seconds. In the prediction the agent turns at `turn_rate`, away from the side on which
    the other aircraft is, and the other one keeps its present rates. If the smallest distance is at
    most `engage`, that turn acts, without acceleration, until the smallest distance is above
    `release`. The filter never looks at the desired control.
    """

    other: PlatformName
    window: Annotated[Number, Unit("s"), Range(0.0, open_low=True, largest=1e4)] = 11.0
    points: Annotated[int, Range(2, largest=10_000)] = 111
    turn_rate: Annotated[RadiansPerSecond, Range(0.0, open_low=True, largest=1e3)] = math.radians(
        6.0
    )
    engage: Annotated[Length, Positive] = 200.0
    release: Annotated[Length, Positive] = 250.0

    @property
    def constraints(self) -> tuple[str, ...]:
        """No names, because the filter looks at no constraint of the environment."""
        return ()

    def begin(self, env: Environment, sim: Sim) -> tuple[RTAMemory, RTAInfo]:
        false = jnp.zeros((), bool)
        index = jnp.zeros((), jnp.int32)
        nearest, _ = self._predict(env, sim)
        info = RTAInfo(
            correction=jnp.zeros_like(sim.time),
            feasible=~false,
            certified=false,
            predicted_margin=nearest - self.engage,
            backup_index=index,
        )
        memory = RTAMemory(intervening=false, backup_index=index, certified=false, ahead={})
        return memory, info

    def filter(
        self, env: Environment, sim: Sim, memory: RTAMemory, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], RTAMemory, RTAInfo]:
        wanted, finite = admissible(env, desired)
        nearest, turn = self._predict(env, sim)
        threshold = jnp.where(memory.intervening, self.release, self.engage)
        engaged = ~(nearest > threshold)  # also where `nearest` is NaN
        controls = {"heading_rate": turn, "acceleration": jnp.zeros_like(turn)}
        backup = admissible(env, jnp.stack([controls[name] for name in env.action_names]))[0]
        actual = jnp.where(engaged, backup, wanted)
        memory = memory.replace(intervening=engaged)
        info = RTAInfo(
            correction=safe_norm(actual - wanted),
            feasible=finite,
            certified=jnp.zeros((), bool),
            predicted_margin=nearest - self.engage,
            backup_index=memory.backup_index,
        )
        return actual, memory, info

    def _predict(self, env: Environment, sim: Sim) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the smallest predicted distance and the heading rate of the backup's turn."""
        own = sim.platforms[env.agent]
        other = sim.platforms[self.other]
        other_controls = undirected(env.platform(self.other), sim)
        other_turn = other_controls.get("heading_rate", jnp.zeros_like(sim.time))
        bearing = to_body(own.orientation, other.position - own.position)
        turn = jnp.where(bearing[1] >= 0.0, -self.turn_rate, self.turn_rate)
        times = jnp.linspace(0.0, 1.0, self.points) * self.window
        gap = _arc(own, turn, times) - _arc(other, other_turn, times)
        return jnp.min(safe_norm(gap)), turn


def _arc(state: Any, rate: Float[Array, ""], times: Float[Array, " n"]) -> Float[Array, "n 2"]:
    """Return the positions in the plane at some times, at constant speed and heading rate."""
    half = rate * times / 2.0
    chord = state.speed * times * jnp.sinc(half / jnp.pi)
    return state.position[None] + chord[:, None] * direction(state.heading + half)
