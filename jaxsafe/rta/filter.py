"""The base of filters between desired and actual control.

One rule carries every guarantee: propose, certify, else back up.
"""

from __future__ import annotations

import dataclasses
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
    driven,
    later_sim,
    others_later,
    smallest_margin,
)
from jaxsafe.types import ConstraintName, Number, Record, RTAInfo, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

Margin = Annotated[Number, Unit("as the constraint"), Range(0.0)]
"""A value of h, in the unit of the constraint."""

Faults = dict[str, Bool[Array, ""]]
"""Reasons why a proof does not hold, in words, each with whether it applies at a given state."""


class RTA(Component):
    """A filter between desired and actual control (Section 2, Fig. 2).

    It is pure. What it remembers is part of the environment's state.
    """

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        """Return reasons why the filter would be useless, each with whether it applies at a state.

        They are asked for once, when the filter is built.
        """
        return {}

    def begin(self, env: Environment, sim: Sim) -> tuple[Any, RTAInfo]:
        """Return the memory at the start of an episode and the facts about the start.

        The memory is a record that has a field `intervening`.
        """
        raise NotImplementedError

    def filter(
        self, env: Environment, sim: Sim, memory: Any, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Any, RTAInfo]:
        """Return the control that acts, the memory after it, and what happened.

        Args:
            env: the environment, with the numbers of this episode.
            sim: the simulation before the step.
            memory: the memory after the last step.
            desired: the agent's control in physical units and action order. Elements that are not
                numbers are never passed on.
        """
        raise NotImplementedError


class RTAMemory(Record):
    """Memory of a filter."""

    intervening: Bool[Array, ""]  # whether it changed the control of the last step
    backup_index: Int[Array, ""]  # the backup controller that the last certificate is about
    certified: Bool[Array, ""]  # whether following that backup controller is known to be safe
    ahead: Mapping[str, Any]  # platforms at the end of the certificate's horizon; empty without one
    # `Sim.actuators` at that end.
    actuators_ahead: Mapping[str, Any] = dataclasses.field(default_factory=dict)


class BackupController(Component):
    """A control law that keeps the agent safe, or leads it to states in which it does.

    It has a name, because a filter may have several.
    """

    name: str
    within_limits: ClassVar[bool] = False
    """Whether no state of the plant reaches a limit before the end of a step.

    Prediction is then cheaper.
    """

    def control(self, env: Environment, sim: Sim, later: Others) -> Float[Array, " m"]:
        """Return the control in physical units and action order. The filter clips it.

        Args:
            env: the environment.
            sim: the simulation before the step.
            later: the other platforms' states after the step, by name.
        """
        raise NotImplementedError

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        """Return reasons why this controller is not proved to keep the constraints.

        There are none by default. At a state where a reason applies, the filter certifies nothing.
        A filter is refused when it is built if a reason applies at every one of a few starts.

        Args:
            env: the environment, with the numbers of this episode.
            sim: the simulation at the state.
            rta: the filter that asks.
        """
        return {}

    def duration(self, env: Environment) -> Number:
        """Return the longest time [s] to the terminal set, 0 where that is not known."""
        return jnp.zeros_like(env.dt)


class TerminalSet(Component):
    """Set of states from which the backup controllers stay safe for ever.

    A certificate may end in it.
    """

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        """Return whether a state is in the set."""
        raise NotImplementedError

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        """Return reasons why the set is not proved safe, as `BackupController.faults` does."""
        return {}


class Paths(Record):
    """Predicted ways from one state, one for each backup controller."""

    least: Float[Array, " backups"]  # smallest h on the way
    certified: Bool[Array, " backups"]  # whether all but the margin holds: terminal set and proof
    ahead: Mapping[str, Any]  # platforms at the end, [backups, ...]; empty without a horizon
    # `Sim.actuators` at the end, [backups]
    actuators_ahead: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def values(self) -> Float[Array, " backups"]:
        """Smallest h on each way, −∞ where the way proves nothing whatever its h."""
        return jnp.where(self.certified, self.least, -jnp.inf)


class CertifiedRTA(RTA):
    """A filter that passes a control only if a prediction with the plant's own map shows it safe.

    A control is certified if every constraint keeps its `margin`, h ≥ margin, after the step. With
    a `horizon` the constraints must also keep it while a backup controller acts for that many steps
    from there, and the last state must lie in the `terminal` set. The filter also checks what the
    proofs of the backup controller and of the set assume of the environment's numbers.

    A control that is not certified is replaced by the backup controller of the last certificate.
    The certificate is renewed while that controller acts. If renewing fails, or nothing has been
    certified yet, the backup controllers compete. The first one that is certified acts. Until then
    the one with the largest h on its way acts.

    After an intervention, control returns to the agent only with `release` on top of the margin.
    Without `enforce` a feasible proposal acts whatever the prediction says. That is how filters of
    the literature work, and it serves to compare.
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
        """Return the control to certify and whether it meets the filter's own constraints.

        Args:
            env: the environment.
            sim: the simulation before the step.
            desired: the agent's control, within its bounds.
            backup: the control that acts if the proposal is not certified, within its bounds.
        """
        raise NotImplementedError

    def required_margin(self, env: Environment) -> Number:
        """Return the h to keep at samples.

        It is `margin`, or more where h could otherwise fall below 0 between two samples. For speed
        limits that depends on the length of a step, see docs/safety/proofs.md. Separations are
        bounded within the step instead.
        """
        facts = [speed_limit_facts(env, name) for name in self.constraints]
        least_margins = [limit.least_margin for limit in facts if limit]
        return functools.reduce(jnp.maximum, least_margins, self.margin)

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        if not self.enforce:
            return {}
        faults = dict(self.terminal.faults(env, sim, self)) if self.terminal else {}
        for backup in self.backups:
            faults |= backup.faults(env, sim, self)
            if self.horizon:
                too_short = (
                    f"{self.horizon} steps of the horizon are too short"
                    f" for backup controller {backup.name!r}"
                )
                faults[too_short] = self.horizon * env.dt < backup.duration(env)
        return faults

    def begin(self, env: Environment, sim: Sim) -> tuple[RTAMemory, RTAInfo]:
        """Return the memory at the start of an episode and the facts about the start.

        The memory holds the backup controller that is safest from there.
        """
        paths = self.follow(env, sim, sim)
        best = self._best(env, paths)
        memory = RTAMemory(
            intervening=jnp.zeros((), bool),
            backup_index=best,
            certified=paths.values[best] >= self.required_margin(env),
            ahead=_selected(paths.ahead, best),
            actuators_ahead=_selected(paths.actuators_ahead, best),
        )
        info = RTAInfo(
            correction=jnp.zeros_like(sim.time),
            feasible=jnp.ones((), bool),
            certified=memory.certified,
            predicted_margin=self.lowest(env, sim, sim),
            backup_index=best,
        )
        return memory, info

    def filter(
        self, env: Environment, sim: Sim, memory: RTAMemory, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], RTAMemory, RTAInfo]:
        """Propose a control, certify it, else back up. Arguments and results are those of `RTA`."""
        wanted, finite = admissible(env, desired)
        later = others_later(env, sim)
        backup = self._backup(env, sim, memory=memory, later=later)
        proposal, feasible = self.propose(env, sim, wanted, backup)

        # A certificate with a horizon takes many predicted steps, so only one is made per step.
        # From a certified state it is a certificate of the proposal. From any other state the
        # backup acts whatever is proposed, so it is one of the backup.
        certified_before = memory.certified if self.enforce and self.horizon else jnp.ones((), bool)
        after_proposal = advance(env, sim, proposal, later=later)
        after_backup = advance(env, sim, backup, later=later)
        paths = self.follow(env, sim, _where(certified_before, after_proposal, after_backup))
        best = self._best(env, paths)
        required = self.required_margin(env)
        safe = paths.values[best] >= required + jnp.where(memory.intervening, self.release, 0.0)
        passes = finite & certified_before & (safe if self.enforce else feasible)

        backup_margin = self.lowest(env, sim, after_backup)
        new_certificate = passes | ~certified_before
        if self.horizon:
            backup_certified, ahead, actuators_ahead = self._renew(
                env, sim, memory=memory, after_backup=after_backup, backup_margin=backup_margin
            )
            backup_certified = jnp.where(
                certified_before, backup_certified, paths.values[best] >= required
            )
            ahead = _where(new_certificate, _selected(paths.ahead, best), ahead)
            actuators_ahead = _where(
                new_certificate, _selected(paths.actuators_ahead, best), actuators_ahead
            )
        else:
            backup_certified = self.follow(env, sim, after_backup).values[0] >= required
            ahead = {}
            actuators_ahead = {}
        actual = jnp.where(passes, proposal, backup)
        correction = jnp.where(jnp.isfinite(desired), actual - wanted, actual)
        certified = jnp.where(passes, safe, backup_certified)
        memory = RTAMemory(
            intervening=jnp.any(correction != 0.0) | ~finite,
            backup_index=jnp.where(new_certificate, best, memory.backup_index),
            certified=certified,
            ahead=ahead,
            actuators_ahead=actuators_ahead,
        )
        info = RTAInfo(
            correction=safe_norm(correction),
            feasible=feasible,
            certified=certified,
            predicted_margin=jnp.where(
                passes, self.lowest(env, sim, after_proposal), backup_margin
            ),
            backup_index=memory.backup_index,
        )
        return actual, memory, info

    def lowest(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, ""]:
        """Return the smallest h of the constraints at `sim`.

        For separations it is the smallest h on the way from `before`, one step earlier.
        """
        return smallest_margin(env, sim, before=before, names=self.constraints)

    def certify(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, " backups"]:
        """Return for each backup controller the smallest h on its way from `sim`.

        It is −∞ for a way that proves nothing. Such a way ends outside the terminal set, or the
        proof of the controller or of the set does not hold for the numbers of the environment.

        Args:
            env: the environment, with the numbers of this episode.
            before: the simulation one step before `sim`.
            sim: the simulation from which the backup controllers act.
        """
        return self.follow(env, before, sim).values

    def follow(self, env: Environment, before: Sim, sim: Sim) -> Paths:
        """Return the predicted way of each backup controller from `sim`.

        Args:
            env: the environment, with the numbers of this episode.
            before: the simulation one step before `sim`.
            sim: the simulation from which the backup controllers act.
        """
        first = self.lowest(env, before, sim)
        faultless = [_none(backup.faults(env, sim, self)) for backup in self.backups]
        proved = jnp.stack(faultless) & _finite(sim)
        if self.terminal is None:
            return Paths(least=first[None], certified=proved & jnp.isfinite(first), ahead={})
        # The other platforms are predicted once for all backup controllers, unless they react to
        # what the agent does.
        groups = [[backup] for backup in self.backups] if others_react(env, sim) else [self.backups]
        predicted = [self._follow(env, backups, first=first, sim=sim) for backups in groups]
        least, group_ends = zip(*predicted, strict=True)
        ends = [end for ends in group_ends for end in ends]
        reached = jnp.stack([self._may_end(env, end) for end in ends])
        stacked = lambda trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)  # noqa: E731
        return Paths(
            least=jnp.concatenate(least),
            certified=reached & proved,
            ahead=stacked([end.platforms for end in ends]),
            actuators_ahead=stacked([end.actuators for end in ends]),
        )

    def _follow(
        self,
        env: Environment,
        backups: Sequence[BackupController],
        first: Float[Array, ""],
        sim: Sim,
    ) -> tuple[Float[Array, " backups"], list[Sim]]:
        """Return the smallest h on the way, and the last simulation, of each backup controller.

        Args:
            env: the environment.
            backups: backup controllers under which the other platforms move alike. The other
                platforms are predicted once.
            first: the smallest h at `sim`.
            sim: the simulation from which the backup controllers act.
        """
        low, high = bounds(env)
        plant = env.agent_platform

        def with_agent(sim: Sim, agent: tuple[Any, Any]) -> Sim:
            state, actuators = agent
            platforms = {**sim.platforms, env.agent: state}
            return sim.replace(platforms=platforms, actuators=actuators)

        def one_step(
            carry: tuple[Sim, list[Any], list[Array]],
        ) -> tuple[Sim, list[Any], list[Array]]:
            sim, agents, least = carry
            later = others_later(env, sim)
            after = later_sim(env, sim, {**later, env.agent: agents[0][0]})
            for i, backup in enumerate(backups):
                before = with_agent(sim, agents[i])
                control = jnp.clip(backup.control(env, before, later), low, high)
                move = plant.step_within_limits if backup.within_limits else plant.step
                controls, actuators = driven(env, before, control)
                agents[i] = (move(agents[i][0], controls, env.dt), actuators)
                moved = with_agent(after, agents[i])
                moved = moved.replace(control_desired=control, control_actual=control)
                lowest = self.lowest(env, before, moved)
                least[i] = jnp.minimum(least[i], lowest)
            return with_agent(after, agents[0]), agents, least

        sim = sim.replace(regions={}, status={})
        agent = (sim.platforms[env.agent], sim.actuators)
        start = (sim, [agent] * len(backups), [first] * len(backups))
        last, agents, least = repeat(one_step, start, self.horizon)
        return jnp.stack(least), [with_agent(last, agent) for agent in agents]

    def _may_end(self, env: Environment, end: Sim) -> Bool[Array, ""]:
        """Return whether a certificate may end in a state."""
        assert self.terminal is not None
        inside = self.terminal.contains(env, end)
        return inside & _none(self.terminal.faults(env, end, self)) & _finite(end)

    def _renew(
        self,
        env: Environment,
        sim: Sim,
        memory: RTAMemory,
        after_backup: Sim,
        backup_margin: Float[Array, ""],
    ) -> tuple[Bool[Array, ""], Mapping[str, Any], Mapping[str, Any]]:
        """Return whether the state after a step of the backup is certified, and its horizon's end.

        The end is that of all platforms, and that of the agent's actuators.

        All steps of the new certificate but the last are steps of the one before it. So only the
        last step is predicted.

        Args:
            env: the environment.
            sim: the simulation before the step.
            memory: the memory before the step.
            after_backup: the simulation after a step of the backup controller.
            backup_margin: the smallest h on that step.
        """
        end_time = sim.time + self.horizon * env.dt
        end = sim.replace(
            time=end_time,
            platforms=memory.ahead,
            actuators=memory.actuators_ahead,
            regions={},
            status={},
        )
        later = others_later(env, end)
        control = self._backup(env, end, memory=memory, later=later)
        new_end = advance(env, end, control, later=later)
        faultless = [_none(backup.faults(env, after_backup, self)) for backup in self.backups]
        proved = jnp.stack(faultless)[memory.backup_index]
        last_step_keeps = self.lowest(env, end, new_end) >= self.required_margin(env)
        keeps = last_step_keeps & (backup_margin >= 0.0)
        renewed = memory.certified & keeps & self._may_end(env, new_end)
        renewed = renewed & proved & _finite(after_backup)
        ends = (new_end.platforms, new_end.actuators)
        return renewed, *jax.lax.stop_gradient(ends)

    def _best(self, env: Environment, paths: Paths) -> Int[Array, ""]:
        """Return the index of the backup controller with the largest h on its way.

        Only certified ones are compared if there are any.
        """
        certified = paths.values >= self.required_margin(env)
        compared = jnp.where(jnp.any(certified), paths.values, paths.least)
        return jnp.argmax(jnp.where(jnp.isnan(compared), -jnp.inf, compared)).astype(jnp.int32)

    def _backup(
        self, env: Environment, sim: Sim, memory: RTAMemory, later: Others
    ) -> Float[Array, " m"]:
        controls = jnp.stack([backup.control(env, sim, later) for backup in self.backups])
        chosen = controls[memory.backup_index] if len(self.backups) > 1 else controls[0]
        return admissible(env, chosen)[0]


def admissible(
    env: Environment, control: Float[Array, " m"]
) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
    """Return the control within its bounds and whether all elements are finite.

    Elements that are not finite become 0 before they are brought within the bounds.
    """
    low, high = bounds(env)
    finite = jnp.isfinite(control)
    return within(jnp.where(finite, control, 0.0), low, high), jnp.all(finite)


def repeated(parts: Sequence[Any]) -> str | None:
    """Return what is wrong if two parts have the same name, else None."""
    names = [part.name for part in parts]
    twice = next((name for name in names if names.count(name) > 1), None)
    return f"the name {twice!r} is there twice" if twice else None


def _none(faults: Faults) -> Bool[Array, ""]:
    """Return whether none of the faults applies."""
    return ~functools.reduce(jnp.logical_or, faults.values(), jnp.zeros((), bool))


def _finite(sim: Sim) -> Bool[Array, ""]:
    leaves = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(sim.platforms)]
    return functools.reduce(jnp.logical_and, leaves)


def _where(condition: Bool[Array, ""], this: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), this, other)


def _selected(ahead: Mapping[str, Any], index: Int[Array, ""]) -> Mapping[str, Any]:
    return jax.lax.stop_gradient(jax.tree.map(lambda leaf: leaf[index], ahead))
