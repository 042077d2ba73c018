"""Between desired and actual control: the rule that carries every guarantee is propose, certify, else back up."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.rta.prediction import others_react, repeat
from jaxsafe.rta.projection import within
from jaxsafe.rta.speed_limit import speed_limit_facts
from jaxsafe.schema.component import Component, Range, Unit
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.transition import (
    Others,
    advance,
    bounds,
    commanded,
    later_sim,
    others_later,
    smallest_margin,
)
from jaxsafe.types import ConstraintName, Number, Record, RTAInfo, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

Margin = Annotated[Number, Unit("as the constraint"), Range(0.0)]

Faults = dict[str, Bool[Array, ""]]
"""Why a proof does not hold, each with whether that is so at a state."""


class RTA(Component):
    """A filter between desired and actual control (Section 2, Fig. 2): pure, with its memory in the state."""

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        """What would make the filter useless, each with whether it is so at a state; asked once, when it is built."""
        return {}

    def begin(self, env: Environment, sim: Sim) -> tuple[Any, RTAInfo]:
        """Return the memory at the start of an episode, a record with `intervening`, and the facts about the start."""
        raise NotImplementedError

    def filter(
        self, env: Environment, sim: Sim, memory: Any, desired: Float[Array, " m"]
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
    ahead: Mapping[str, Any]  # the platforms at the end of that certificate's horizon; empty without a horizon


class BackupController(Component):
    """A control that keeps safe or leads to where it does; named, as several may stand side by side."""

    name: str
    within_limits: ClassVar[bool] = False
    """Whether no state of the plant reaches a limit before the end of a step, which makes prediction cheaper."""

    def control(self, env: Environment, sim: Sim, later: Others) -> Float[Array, " m"]:
        """Return the control in physical units, action order; the filter clips it.

        Args:
            env: the environment.
            sim: the simulation before the step.
            later: the other platforms' states after it, by name.
        """
        raise NotImplementedError

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        """Return what is missing at a state for the proof that this controller keeps the constraints; nothing by default.

        Where anything is missing the filter certifies nothing. A filter that lacks it at all of a few starts is refused.

        Args:
            env: the environment, with the numbers of this episode.
            sim: the simulation at the state.
            rta: the filter that asks.
        """
        return {}

    def duration(self, env: Environment) -> Number:
        """Return the time it may take to the terminal set [s]; 0 where that is not known."""
        return jnp.zeros_like(env.dt)


class TerminalSet(Component):
    """States from which the backup controller stays safe for ever: where a certificate may end."""

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        """Whether the state is in the set."""
        raise NotImplementedError

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        """Return what is missing at a state for the proof of this set, as `BackupController.faults` does."""
        return {}


class Paths(Record):
    """What becomes of a state under each backup controller."""

    least: Float[Array, " backups"]  # smallest h on the way
    certified: Bool[Array, " backups"]  # whether it keeps the margin, ends in the terminal set, and its proof holds
    ahead: Mapping[str, Any]  # the platforms at the end, with an axis of backups in front; empty without a horizon

    @property
    def values(self) -> Float[Array, " backups"]:
        """The smallest h of those that are certified but for the margin, −∞ of the others."""
        return jnp.where(self.certified, self.least, -jnp.inf)


class CertifiedRTA(RTA):
    """A filter that lets a control pass only after predicting with the plant's own map that it is safe.

    A control is certified if after the step every constraint keeps its `margin`, h ≥ margin, and, with a `horizon`, also on
    the way of a backup controller from there over that many steps, which must end in the `terminal` set. What the proof of
    the backup controller or the set assumes of the environment's numbers is checked as well. What is not certified is
    replaced by the backup controller of the last certificate, which is renewed while it acts. Where that fails, or nothing
    was certified yet, the backup controllers compete: the first that is certified acts, and until then the one of the
    largest h on its way. After an intervention control returns to the agent only with `release` on top of the margin.
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
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
        """Return the control to certify, and whether it meets the filter's own constraints.

        Args:
            env: the environment.
            sim: the simulation before the step.
            desired: the agent's control, within its bounds.
            backup: what acts if the proposal is not certified, within the bounds.
        """
        raise NotImplementedError

    def required_margin(self, env: Environment) -> Number:
        """Return the h to keep at samples: `margin`, or more where a constraint would be broken inside a step.

        For speed limits that depends on the length of a step, see docs/rta.md; separations are bounded within the step.
        """
        facts = [speed_limit_facts(env, name) for name in self.constraints]
        return functools.reduce(jnp.maximum, [one.least_margin for one in facts if one], self.margin)

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        if not self.enforce:
            return {}
        found = dict(self.terminal.faults(env, sim, self)) if self.terminal else {}
        for backup in self.backups:
            found |= backup.faults(env, sim, self)
            if self.horizon:
                fault = f"{self.horizon} steps of the horizon are too short for backup controller {backup.name!r}"
                found[fault] = self.horizon * env.dt < backup.duration(env)
        return found

    def begin(self, env: Environment, sim: Sim) -> tuple[RTAMemory, RTAInfo]:
        """Memory with the backup controller that is safest from the start."""
        paths = self.follow(env, sim, sim)
        best, no, yes = self._best(env, paths), jnp.zeros((), bool), jnp.ones((), bool)
        memory = RTAMemory(
            intervening=no,
            backup_index=best,
            certified=paths.values[best] >= self.required_margin(env),
            ahead=_chosen(paths.ahead, best),
        )
        return memory, RTAInfo(jnp.zeros_like(sim.time), yes, memory.certified, self.lowest(env, sim, sim), best)

    def filter(
        self, env: Environment, sim: Sim, memory: RTAMemory, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], RTAMemory, RTAInfo]:
        """Propose, certify, else back up."""
        wanted, finite = admissible(env, desired)
        later = others_later(env, sim)
        backup = self._backup(env, sim, memory, later)
        proposal, feasible = self.propose(env, sim, wanted, backup)

        # A certificate with a horizon is dear, and one a step is made. From a state that is certified it is the proposal's.
        # From another the backup acts whatever is proposed, and it is the backup's.
        known = memory.certified if self.enforce and self.horizon else jnp.ones((), bool)
        after, backed = advance(env, sim, proposal, later), advance(env, sim, backup, later)
        paths = self.follow(env, sim, _where(known, after, backed))
        best, required = self._best(env, paths), self.required_margin(env)
        safe = paths.values[best] >= required + jnp.where(memory.intervening, self.release, 0.0)
        passes = finite & known & (safe if self.enforce else feasible)

        fallback = self.lowest(env, sim, backed)
        fresh = passes | ~known
        if self.horizon:
            kept, ahead = self._renew(env, sim, memory, backed, fallback)
            kept = jnp.where(known, kept, paths.values[best] >= required)
            ahead = _where(fresh, _chosen(paths.ahead, best), ahead)
        else:
            kept, ahead = self.follow(env, sim, backed).values[0] >= required, {}
        actual = jnp.where(passes, proposal, backup)
        correction = jnp.where(jnp.isfinite(desired), actual - wanted, actual)
        certified = jnp.where(passes, safe, kept)
        memory = RTAMemory(
            intervening=jnp.any(correction != 0.0) | ~finite,
            backup_index=jnp.where(fresh, best, memory.backup_index),
            certified=certified,
            ahead=ahead,
        )
        info = RTAInfo(
            correction=safe_norm(correction),
            feasible=feasible,
            certified=certified,
            predicted_margin=jnp.where(passes, self.lowest(env, sim, after), fallback),
            backup_index=memory.backup_index,
        )
        return actual, memory, info

    def lowest(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, ""]:
        """Return the smallest h of the constraints at `sim` and, for separations, on the way from `before`."""
        return smallest_margin(env, sim, before, self.constraints)

    def certify(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, " backups"]:
        """Return for each backup controller the smallest h on its way from `sim`, −∞ if that proves nothing.

        It proves nothing where the way ends outside the terminal set, or where the proof of the controller or of the set
        does not hold for the numbers of the environment.
        """
        return self.follow(env, before, sim).values

    def follow(self, env: Environment, before: Sim, sim: Sim) -> Paths:
        """Return what becomes of `sim`, one step after `before`, under each backup controller."""
        first = self.lowest(env, before, sim)
        holds = jnp.stack([_none(backup.faults(env, sim, self)) for backup in self.backups]) & _finite(sim)
        if self.terminal is None:
            return Paths(least=first[None], certified=holds & jnp.isfinite(first), ahead={})
        together = [[one] for one in self.backups] if others_react(env, sim) else [self.backups]
        least, ends = zip(*(self._follow(env, backups, first, sim) for backups in together), strict=True)
        ends = [end for several in ends for end in several]
        reached = jnp.stack([self._ended(env, end) for end in ends])
        platforms = [end.platforms for end in ends]
        ahead = jax.tree.map(lambda *leaves: jnp.stack(leaves), *platforms)
        return Paths(least=jnp.concatenate(least), certified=reached & holds, ahead=ahead)

    def _follow(
        self, env: Environment, backups: Sequence[BackupController], first: Float[Array, ""], sim: Sim
    ) -> tuple[Float[Array, " backups"], list[Sim]]:
        """The smallest h, and the end, for backup controllers among whom the other platforms move alike.

        These are predicted once.
        """
        low, high = bounds(env)
        plant = env.agent_platform

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
        return jnp.stack(least), [placed(last, own) for own in crafts]

    def _ended(self, env: Environment, end: Sim) -> Bool[Array, ""]:
        """Whether a certificate may end in a state."""
        assert self.terminal is not None
        return self.terminal.contains(env, end) & _none(self.terminal.faults(env, end, self)) & _finite(end)

    def _renew(
        self, env: Environment, sim: Sim, memory: RTAMemory, backed: Sim, fallback: Float[Array, ""]
    ) -> tuple[Bool[Array, ""], Mapping[str, Any]]:
        """The certificate of the state after a step of backing up, and the end of its horizon.

        All but the last of its steps are those of the certificate before it, so only that one is predicted.
        """
        end = sim.replace(time=sim.time + self.horizon * env.dt, platforms=memory.ahead, regions={}, status={})
        later = others_later(env, end)
        further = advance(env, end, self._backup(env, end, memory, later), later)
        holds = jnp.stack([_none(backup.faults(env, backed, self)) for backup in self.backups])[memory.backup_index]
        keeps = (self.lowest(env, end, further) >= self.required_margin(env)) & (fallback >= 0.0)
        renewed = memory.certified & keeps & self._ended(env, further) & holds & _finite(backed)
        return renewed, jax.lax.stop_gradient(further.platforms)

    def _best(self, env: Environment, paths: Paths) -> Int[Array, ""]:
        """The backup controller of the largest h on its way, among those that are certified if there are any."""
        certified = paths.values >= self.required_margin(env)
        compared = jnp.where(jnp.any(certified), paths.values, paths.least)
        return jnp.argmax(jnp.where(jnp.isnan(compared), -jnp.inf, compared)).astype(jnp.int32)

    def _backup(self, env: Environment, sim: Sim, memory: RTAMemory, later: Others) -> Float[Array, " m"]:
        each = jnp.stack([backup.control(env, sim, later) for backup in self.backups])
        chosen = each[memory.backup_index] if len(self.backups) > 1 else each[0]
        return admissible(env, chosen)[0]


def admissible(env: Environment, control: Float[Array, " m"]) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
    """The control within its bounds, 0 for what is not a number, and whether all of it was finite."""
    low, high = bounds(env)
    finite = jnp.isfinite(control)
    return within(jnp.where(finite, control, 0.0), low, high), jnp.all(finite)


def repeated(parts: Sequence[Any]) -> str | None:
    """What is wrong if two parts have the same name."""
    names = [one.name for one in parts]
    twice = next((name for name in names if names.count(name) > 1), None)
    return f"the name {twice!r} is there twice" if twice else None


def _none(faults: Faults) -> Bool[Array, ""]:
    return ~functools.reduce(jnp.logical_or, faults.values(), jnp.zeros((), bool))


def _finite(sim: Sim) -> Bool[Array, ""]:
    return functools.reduce(jnp.logical_and, [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(sim.platforms)])


def _where(condition: Bool[Array, ""], this: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), this, other)


def _chosen(ahead: Mapping[str, Any], index: Int[Array, ""]) -> Mapping[str, Any]:
    return jax.lax.stop_gradient(jax.tree.map(lambda leaf: leaf[index], ahead))
