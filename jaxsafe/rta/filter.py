"""Between desired and actual control: the rule that carries every guarantee is propose, certify, else back up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.component import Component, Range, Unit
from jaxsafe.rta.prediction import (
    Others,
    advance,
    bounds,
    commanded,
    later_sim,
    others_later,
    others_react,
    repeat,
    smallest_margin,
)
from jaxsafe.types import ConstraintName, Number, Record, RTAInfo, Sim

Margin = Annotated[Number, Unit("as the constraint"), Range(0.0)]


class RTA(Component):
    """A filter between desired and actual control (Section 2, Fig. 2): pure, with its memory in the state."""

    def unsuited(self, env: Any, sim: Sim) -> dict[str, Bool[Array, ""]]:
        """What would make the filter useless, each with whether it is so at a state; asked once, when it is built."""
        return {}

    def begin(self, env: Any, sim: Sim) -> tuple[Any, RTAInfo]:
        """Return the memory at the start of an episode, a record with `intervening`, and the facts about the start."""
        raise NotImplementedError

    def filter(
        self, env: Any, sim: Sim, memory: Any, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Any, RTAInfo]:
        """Return the control that acts, the memory after it, and what happened.

        Args:
            env: the environment, with the numbers of this episode.
            sim: the simulation before the step.
            memory: of the last step.
            desired: the agent's control in physical units, action order; what is not a number is never passed on.
        """
        raise NotImplementedError


class RTAMemory(Record):
    """What a filter remembers."""

    intervening: Bool[Array, ""]
    backup_index: Int[Array, ""]  # the backup controller that the last certificate is about
    certified: Bool[Array, ""]  # whether following it is known to be safe


class BackupController(Component):
    """A control that keeps safe or leads to where it does; named, as several may stand side by side."""

    name: str
    within_limits: ClassVar[bool] = False
    """Whether no state of the plant reaches a limit before the end of a step, which makes prediction cheaper."""

    def control(self, env: Any, sim: Sim, later: Others) -> Float[Array, " m"]:
        """Return the control in physical units, action order; the filter clips it.

        Args:
            env: the environment.
            sim: the simulation before the step.
            later: the other platforms' states after it, by name.
        """
        raise NotImplementedError


class TerminalSet(Component):
    """States from which the backup controller stays safe for ever: where a certificate may end."""

    def contains(self, env: Any, sim: Sim) -> Bool[Array, ""]:
        """Whether the state is in the set."""
        raise NotImplementedError


class CertifiedRTA(RTA):
    """A filter that lets a control pass only after predicting with the plant's own map that it is safe.

    A control is certified if after the step every constraint keeps its `margin`, h ≥ margin, and, with a `horizon`, also on
    the way of a backup controller from there over that many steps, which must end in the `terminal` set. What is not
    certified is replaced by the backup controller of the last certificate. After an intervention control returns to the
    agent only with `release` on top of the margin.
    Without `enforce` a feasible proposal acts whatever the prediction says, as filters of the literature do: to compare.
    """

    constraints: tuple[ConstraintName, ...]
    margin: Margin = 0.0
    backups: tuple[BackupController, ...]
    horizon: Annotated[int, Range(0, largest=10_000)] = 0
    terminal: TerminalSet | None = None
    release: Margin = 0.0
    enforce: bool = True

    def problem(self) -> str | None:
        if not self.constraints or not self.backups:
            return "expected at least one constraint and one backup controller"
        if (self.horizon > 0) != (self.terminal is not None):
            return "a horizon needs a terminal set, and a terminal set a horizon"
        if self.horizon == 0 and len(self.backups) > 1:
            return "without a horizon there is one backup controller"
        return repeated(self.backups)

    def propose(
        self, env: Any, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        """Return the control to certify, and whether it meets the filter's own constraints.

        Args:
            env: the environment.
            sim: the simulation before the step.
            desired: the agent's control, within its bounds.
            backup: what acts if the proposal is not certified, within the bounds.
        """
        raise NotImplementedError

    def begin(self, env: Any, sim: Sim) -> tuple[RTAMemory, RTAInfo]:
        """Memory with the backup controller that is safest from the start."""
        values = self.certify(env, sim, sim)
        best, no, yes = _highest(values), jnp.zeros((), bool), jnp.ones((), bool)
        memory = RTAMemory(no, best, values[best] >= self.margin)
        return memory, RTAInfo(jnp.zeros_like(sim.time), yes, memory.certified, self.lowest(env, sim, sim), best)

    def filter(
        self, env: Any, sim: Sim, memory: RTAMemory, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], RTAMemory, RTAInfo]:
        """Propose, certify, else back up."""
        wanted, finite = admissible(env, desired)
        later = others_later(env, sim)
        backup = self._backup(env, sim, memory, later)
        proposal, feasible = self.propose(env, sim, wanted, backup)

        after = advance(env, sim, proposal, later)
        values = self.certify(env, sim, after)
        best = _highest(values)
        required = self.margin + jnp.where(memory.intervening, self.release, 0.0)
        safe = values[best] >= required
        passes = finite & (safe if self.enforce else feasible)

        fallback = self.lowest(env, sim, advance(env, sim, backup, later))
        kept = fallback >= self.margin if self.horizon == 0 else memory.certified & ~jnp.isnan(fallback)
        actual = jnp.where(passes, proposal, backup)
        correction = jnp.where(jnp.isfinite(desired), actual - wanted, actual)
        certified = jnp.where(passes, safe, kept)
        memory = RTAMemory(
            intervening=jnp.any(correction != 0.0) | ~finite,
            backup_index=jnp.where(passes, best, memory.backup_index),
            certified=certified,
        )
        info = RTAInfo(
            correction=jnp.sqrt(jnp.sum(correction**2)),
            feasible=feasible,
            certified=certified,
            predicted_margin=jnp.where(passes, self.lowest(env, sim, after), fallback),
            backup_index=memory.backup_index,
        )
        return actual, memory, info

    def lowest(self, env: Any, before: Sim, sim: Sim) -> Float[Array, ""]:
        """Return the smallest h of the constraints at `sim` and, for separations, on the way from `before`."""
        return smallest_margin(env, sim, before, self.constraints)

    def certify(self, env: Any, before: Sim, sim: Sim) -> Float[Array, " backups"]:
        """Return for each backup controller the smallest h on its way from `sim`; −∞ if it ends outside the last set."""
        first = self.lowest(env, before, sim)
        if self.terminal is None:
            return first[None]
        together = [[one] for one in self.backups] if others_react(env, sim) else [self.backups]
        return jnp.concatenate([self._follow(env, backups, first, sim) for backups in together])

    def _follow(
        self, env: Any, backups: Sequence[BackupController], first: Float[Array, ""], sim: Sim
    ) -> Float[Array, " backups"]:
        """`certify` for backup controllers among whom the other platforms move alike, and so are predicted once."""
        low, high = bounds(env)
        plant, terminal = env.agent_platform, self.terminal
        assert terminal is not None

        def placed(sim: Sim, own: Any) -> Sim:
            return sim.replace(platforms={**sim.platforms, env.agent: own})

        def one(carry: tuple[Sim, list[Any], list[Array]]) -> tuple[Sim, list[Any], list[Array]]:
            sim, crafts, least = carry
            later = others_later(env, sim)
            after = later_sim(env, sim, {**later, env.agent: crafts[0]})
            for i, backup in enumerate(backups):
                before = placed(sim, crafts[i])
                control = jnp.clip(backup.control(env, before, later), low, high)
                move = plant.step_within_limits if backup.within_limits else plant.step
                crafts[i] = move(crafts[i], commanded(env, plant, before, control), env.dt)
                least[i] = jnp.minimum(least[i], self.lowest(env, before, placed(after, crafts[i])))
            return placed(after, crafts[0]), crafts, least

        sim = sim.replace(regions={}, status={})
        start = (sim, [sim.platforms[env.agent]] * len(backups), [first] * len(backups))
        last, crafts, least = repeat(one, start, self.horizon)
        reached = jnp.stack([terminal.contains(env, placed(last, own)) for own in crafts])
        return jnp.where(reached, jnp.stack(least), -jnp.inf)

    def _backup(self, env: Any, sim: Sim, memory: RTAMemory, later: Others) -> Float[Array, " m"]:
        each = jnp.stack([backup.control(env, sim, later) for backup in self.backups])
        chosen = each[memory.backup_index] if len(self.backups) > 1 else each[0]
        return admissible(env, chosen)[0]


def admissible(env: Any, control: Float[Array, " m"]) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
    """The control within its bounds, 0 for what is not a number, and whether all of it was finite."""
    low, high = bounds(env)
    finite = jnp.isfinite(control)
    return jnp.clip(jnp.where(finite, control, 0.0), low, high), jnp.all(finite)


def repeated(parts: Sequence[Any]) -> str | None:
    """What is wrong if two parts have the same name."""
    names = [one.name for one in parts]
    twice = next((name for name in names if names.count(name) > 1), None)
    return f"the name {twice!r} is there twice" if twice else None


def _highest(values: Float[Array, " n"]) -> Int[Array, ""]:
    return jnp.argmax(jnp.where(jnp.isnan(values), -jnp.inf, values)).astype(jnp.int32)
