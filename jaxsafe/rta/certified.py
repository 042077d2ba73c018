"""Filters that pass a control only if a prediction shows it safe.

One rule carries every guarantee: propose, certify, else back up.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.certificate import BackupController, Faults, TerminalSet
from jaxsafe.rta.delay import ahead_of_delay
from jaxsafe.rta.filter import (
    NO_CONSTRAINT,
    RTA,
    RTAMemory,
    UnderWay,
    admissible,
    altered,
    repeated,
)
from jaxsafe.rta.prediction import others_react, repeat
from jaxsafe.rta.speed_limit import lowered, speed_limit_facts
from jaxsafe.rta.ways import Paths, Reserve, Way
from jaxsafe.schema.component import Range, Unit
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.sparse import only_where
from jaxsafe.transition import (
    Others,
    advance,
    bounds,
    constraint,
    driven,
    later_sim,
    margins_of,
    others_later,
    remember,
)
from jaxsafe.types import ConstraintName, Number, RTAInfo, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

Margin = Annotated[Number, Unit("the unit of the constraint"), Range(0.0)]
"""A value of h, in the unit of the constraint."""

Proposal = (
    tuple[Float[Array, " m"], Bool[Array, ""]]
    | tuple[Float[Array, " m"], Bool[Array, ""], Int[Array, ""]]
)
"""A control, and whether it meets the filter's own constraints.

A filter that knows for which constraint it changed the control adds the index of that constraint.
"""


class CertifiedRTA(RTA):
    """A filter that passes a control only if a prediction with the plant's own map shows it safe.

    A control is certified if every constraint keeps its `margin`, h ≥ margin, after the step. With
    a `horizon` the constraints must also keep it while a backup controller acts for that many steps
    from there, and the last state must lie in the `terminal` set. The filter also checks what the
    proofs of the backup controller and of the set assume of the environment's numbers.

    The backup controller of the last certificate is in reserve. Where there are more than two, its
    way is predicted first, and the ways of the others only if it does not certify the control. A
    control that nothing certifies is replaced by the controller in reserve, whose certificate is
    renewed while it acts. If renewing fails, or nothing has been certified yet, the backup
    controllers compete. The first one that is certified acts. Until then the one with the largest h
    on its way acts.

    After an intervention, control returns to the agent only with `release` on top of the margin.
    Without `enforce` a feasible proposal acts whatever the prediction says. That is how filters of
    the literature work, and it serves to compare. Some of them then need no backup controller. What
    they propose acts, and nothing is certified.

    A change of each control by at most `tolerance`, as a share of its range, is no intervention.

    A `bound` says how far the true world may be from the one that the filter predicts with. The
    filter then keeps a larger margin of a speed limit, so that its certificates hold in the true
    world. With a horizon it predicts a tube that holds all ways of the true world, or its backup
    controllers are `rehearsed`. Such a certificate is true for as long as its backup controller
    acts, so it is not renewed.
    """

    constraints: tuple[ConstraintName, ...]
    margin: Margin = 0.0
    backups: tuple[BackupController, ...] = ()
    horizon: Annotated[int, Range(0, largest=10_000)] = 0
    terminal: TerminalSet | None = None
    release: Margin = 0.0
    enforce: bool = True
    tolerance: Annotated[Number, Unit("1"), Range(0.0)] = 0.0
    bound: UncertaintyBound | None = None

    backup_optional: ClassVar[bool] = False
    """Whether what the filter proposes may act by itself, without any backup controller."""

    def problem(self) -> str | None:
        needs_no_backup = self.backup_optional and not self.enforce
        if not self.constraints or not (self.backups or needs_no_backup):
            expected = "expected at least one constraint and one backup controller"
            without = "; with enforce: false it needs no backup controller"
            return expected + (without if self.backup_optional else "")
        if self.horizon and not self.backups:
            return "a horizon needs a backup controller"
        if (self.horizon > 0) != (self.terminal is not None):
            return "a horizon needs a terminal set, and a terminal set a horizon"
        if self.horizon == 0 and len(self.backups) > 1:
            return "without a horizon there is one backup controller"
        if self.bound is not None and not self.enforce:
            return "a bound needs enforce: true"
        return repeated(self.backups)

    def propose(
        self, env: Environment, sim: Sim, desired: Float[Array, " m"], backup: Float[Array, " m"]
    ) -> Proposal:
        """Return the control to certify and whether it meets the filter's own constraints.

        A third value may be the index of the one of `constraints` for which the control was
        changed.

        Args:
            env: the environment.
            sim: the simulation before the step.
            desired: the agent's control, within its bounds.
            backup: the control that acts if the proposal is not certified, within its bounds.
        """
        raise NotImplementedError

    def required_margin(self, env: Environment, name: str | None = None) -> Number:
        """Return the h to keep at samples.

        It is `margin`, or more where h could otherwise fall below 0 between two samples. For speed
        limits that depends on the length of a step, see docs/safety/proofs.md. Separations are
        bounded within the step instead.

        Args:
            env: the environment.
            name: the name of a constraint, which may have a margin of its own. None stands for all
                constraints without a margin of their own.
        """
        own_margins = {other: constraint(env, other).required_margin for other in self.constraints}
        margin = self.margin
        names = [other for other in self.constraints if own_margins[other] is None]
        if name is not None and name not in names:
            margin = jnp.asarray(own_margins[name])
            names = [name]
        facts = [speed_limit_facts(env, other) for other in names]
        least_margins = [limit.least_margin for limit in facts if limit]
        return functools.reduce(jnp.maximum, least_margins, margin)

    def margin_to_certify(
        self, env: Environment, control: Float[Array, " m"] | None = None
    ) -> Number:
        """Return the h that a predicted state must have to be certified.

        It is `required_margin`. A `bound` adds how far the true h may be below the predicted one.

        Args:
            env: the environment.
            control: the control of the step to that state. A weaker control adds less, because less
                of its effect is unknown. None stands for the state before a step.
        """
        required = self.required_margin(env)
        return required if self.bound is None else required + self.lost(env, control)

    def lost(self, env: Environment, control: Float[Array, " m"] | None = None) -> Float[Array, ""]:
        """Return how far the true h may be below that of a prediction, within the `bound`.

        It is infinite if nothing is proved with a bound. Arguments are those of
        `margin_to_certify`.
        """
        if self.bound is None or self.has_tubes:
            return jnp.zeros_like(env.dt)
        facts = [speed_limit_facts(env, name) for name in self.constraints]
        speed_limits = [limit for limit in facts if limit]
        if len(speed_limits) < len(facts) or not self._bound_is_proved:
            return jnp.full_like(env.dt, jnp.inf)
        if self._rehearsed_steps:
            return self.bound.lost_by_drifting(speed_limits, self._rehearsed_steps)
        acceleration = None if control is None else safe_norm(control) / speed_limits[0].mass
        return self.bound.lost(speed_limits, acceleration)

    @property
    def _bound_is_proved(self) -> bool:
        all_know_bound = all(backup.proved.knows_bound for backup in self.backups)
        proved_without_horizon = not self.horizon and all_know_bound
        return self.has_tubes or proved_without_horizon or self._rehearsed_steps > 0

    @property
    def _rehearsed_steps(self) -> int:
        """The most steps for which a backup controller flies by memory within a bound, or 0."""
        if self.bound is None or not self.horizon:
            return 0
        return min(backup.most_rehearsed_steps(self.horizon) for backup in self.backups)

    def _within_bound(self, env: Environment) -> Environment:
        """Return the environment for whose constraints the backup controllers fly.

        A backup controller that flies by memory keeps a limit that is lower by all that the bound
        may cost meanwhile.
        """
        if not self._rehearsed_steps:
            return env
        lost = self.lost(env)
        for name in self.constraints:
            env = lowered(env, name, lost)
        return env

    @property
    def has_tubes(self) -> bool:
        """Whether its certificates are about all states of a tube."""
        if self.bound is None or self.terminal is None:
            return False
        return self.terminal.knows_bound and all(backup.has_tubes for backup in self.backups)

    def unsuited(self, env: Environment, sim: Sim) -> dict[str, Bool[Array, ""]]:
        if not self.enforce:
            return {}
        faults = {}
        if self.bound is not None and not self._bound_is_proved:
            faults[
                "rta.bound is proved for brake without a horizon, for match_velocity and rehearsed"
            ] = jnp.ones((), bool)
        strict = self._within_bound(env)
        if self.terminal:
            faults |= self.terminal.faults(strict, sim, self)
        for backup in self.backups:
            faults |= backup.faults(strict, sim, self)
            if self.horizon:
                too_short = (
                    f"{self.horizon} steps of the horizon are too short"
                    f" for backup controller {backup.name!r}"
                )
                faults[too_short] = self.horizon * env.dt < backup.duration(env)
        return faults

    def begin(self, env: Environment, sim: Sim) -> tuple[RTAMemory, RTAInfo]:
        """Return the memory at the start of an episode and the facts about the start.

        The memory holds the backup controller that is safest from there. With a delay the controls
        under way are 0, or as near to 0 as their bounds allow. The states after them must be safe
        as well.
        """
        if self.bound is not None and self.bound.delay:
            no_control, _ = admissible(env, jnp.zeros(env.action_size, env.dt.dtype))
            controls = jnp.tile(no_control, (self.bound.delay, 1))
            _, start_info = self.replace(bound=self.bound.replace(delay=0)).begin(env, sim)
            undelayed, predicted, certified = ahead_of_delay(self, env, sim, controls)
            memory, info = undelayed.begin(env, predicted)
            memory = memory.replace(under_way=UnderWay(controls=controls, certified=certified))
            return memory, info.replace(certified=start_info.certified & jnp.all(certified))
        best = self._best(env, self.follow(env, sim, sim))
        memory = RTAMemory(
            intervening=jnp.zeros((), bool),
            backup_index=best.index,
            certified=best.value >= self.margin_to_certify(env),
            ahead=best.ahead,
            actuators_ahead=best.actuators_ahead,
            backups=self._fresh(env, sim),
            backups_ahead=best.memories_ahead,
            remembered_ahead=best.remembered_ahead,
        )
        info = RTAInfo(
            correction=jnp.zeros_like(sim.time),
            feasible=jnp.ones((), bool),
            certified=memory.certified,
            predicted_margin=self.lowest(env, sim, sim),
            backup_index=best.index,
            constraint=NO_CONSTRAINT(),
        )
        return memory, info

    def filter(
        self, env: Environment, sim: Sim, memory: RTAMemory, desired: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], RTAMemory, RTAInfo]:
        """Propose a control, certify it, else back up. Arguments and results are those of `RTA`.

        With a delay this is done in the state in which the control will begin to act. The control
        is certified only if all controls that act before it are.
        """
        if self.bound is not None and self.bound.delay:
            assert isinstance(memory.under_way, UnderWay)
            controls = memory.under_way.controls
            certified = memory.under_way.certified
            undelayed, predicted, _ = ahead_of_delay(self, env, sim, controls)
            control, memory, info = undelayed.filter(env, predicted, memory, desired)
            under_way = UnderWay(
                controls=jnp.concatenate([controls[1:], control[None]]),
                certified=jnp.append(certified[1:], info.certified),
            )
            info = info.replace(certified=info.certified & jnp.all(certified))
            return control, memory.replace(under_way=under_way), info
        wanted, finite = admissible(env, desired)
        later = others_later(env, sim)
        memories = memory.backups
        if self._rehearsed_steps:  # nothing is rehearsed before there is a certificate
            memories = _where(memory.certified, memories, self._fresh(env, sim))
        backup, moved = self._backup(
            env, sim, index=memory.backup_index, memories=memories, later=later
        )
        proposal, feasible, *changed_for = self.propose(env, sim, wanted, backup)
        if not self.backups:
            backup = proposal

        # A certificate with a horizon takes many predicted steps, so only one is made per step.
        # From a certified state it is a certificate of the proposal. From any other state the
        # backup acts whatever is proposed, so it is a certificate of the backup.
        certified_before = memory.certified if self.enforce and self.horizon else jnp.ones((), bool)
        after_proposal = advance(env, sim, proposal, later=later)
        after_backup = advance(env, sim, backup, later=later)
        memories_if_passed = self._fresh(env, after_proposal)
        memories_if_backed_up = self._memories_after(
            env, after_backup, index=memory.backup_index, moved=moved
        )
        to_pass = self.margin_to_certify(env, proposal)
        to_back_up = self.margin_to_certify(env, backup)
        required = to_pass + jnp.where(memory.intervening, self.release, 0.0)
        way = self._way(
            env,
            sim,
            _where(certified_before, after_proposal, after_backup),
            memories=_where(certified_before, memories_if_passed, memories_if_backed_up),
            reserve=memory.backup_index,
            required=jnp.where(certified_before, required, jnp.inf),
        )
        safe = way.value >= required
        passes = finite & certified_before & (safe if self.enforce else feasible)
        passes = passes & ~self._unfinished(env, sim, memory)

        backup_margin = self.lowest(env, sim, after_backup)
        new_certificate = passes | ~certified_before
        ends = ({}, {}, {})  # nothing is renewed with a bound or without a horizon
        memories_ahead = way.memories_ahead
        if self.horizon and self.bound is not None:
            still_certified = _finite(after_backup)
            if self._rehearsed_steps and self.terminal:  # a rehearsal may begin at this state
                still_certified &= _none(self.terminal.faults(self._within_bound(env), sim, self))
                for each in self.backups:
                    still_certified &= _none(each.faults(env, sim, self))
            backup_certified = jnp.where(certified_before, still_certified, way.value >= to_back_up)
        elif self.horizon:
            backup_certified, end, memories_ahead = self._renew(
                env, sim, memory=memory, after_backup=after_backup, backup_margin=backup_margin
            )
            backup_certified = jnp.where(
                certified_before, backup_certified, way.value >= to_back_up
            )
            ends = _where(
                new_certificate,
                (way.ahead, way.actuators_ahead, way.remembered_ahead),
                (end.platforms, end.actuators, end.remembered),
            )
            memories_ahead = _where(new_certificate, way.memories_ahead, memories_ahead)
        else:
            backup_certified = self.follow(env, sim, after_backup).values[0] >= to_back_up
        ahead, actuators_ahead, remembered_ahead = ends
        actual = jnp.where(passes, proposal, backup)
        correction = jnp.where(jnp.isfinite(desired), actual - wanted, actual)
        certified = jnp.where(passes, safe, backup_certified)
        intervening = altered(env, correction, self.tolerance) | ~finite
        cause = self.closest(env, way.margins)
        if changed_for:
            cause = jnp.where(passes if self.backups else True, changed_for[0], cause)
        memory = RTAMemory(
            intervening=intervening,
            backup_index=jnp.where(new_certificate, way.index, memory.backup_index),
            certified=certified,
            ahead=ahead,
            actuators_ahead=actuators_ahead,
            backups=_where(passes, memories_if_passed, memories_if_backed_up),
            backups_ahead=memories_ahead,
            remembered_ahead=remembered_ahead,
        )
        info = RTAInfo(
            correction=safe_norm(correction),
            feasible=feasible,
            certified=certified,
            predicted_margin=jnp.where(
                passes, self.lowest(env, sim, after_proposal), backup_margin
            ),
            backup_index=memory.backup_index,
            constraint=jnp.where(intervening & finite, cause, NO_CONSTRAINT()),
        )
        return actual, memory, info

    def lowest(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, ""]:
        """Return the smallest h of the constraints at `sim`.

        For separations it is the smallest h on the way from `before`, one step earlier.
        """
        return jnp.min(self.margins(env, before, sim))

    def margins(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, " c"]:
        """Return the h of each of the c constraints at `sim`. Arguments are those of `lowest`."""
        return margins_of(env, sim, before=before, names=self.constraints)

    def compared(self, env: Environment, margins: Float[Array, " c"]) -> Float[Array, " c"]:
        """Return the h of each constraint, shifted so that `required_margin` is the margin of all.

        A constraint with a margin of its own is shifted by the difference of the two margins.
        """
        if all(constraint(env, name).required_margin is None for name in self.constraints):
            return margins
        own = [self.required_margin(env, name) for name in self.constraints]
        return margins + self.required_margin(env) - jnp.stack(own)

    def closest(self, env: Environment, margins: Float[Array, " c"]) -> Int[Array, ""]:
        """Return the index of the constraint that is closest to its margin."""
        return jnp.argmin(self.compared(env, margins)).astype(jnp.int32)

    def certify(self, env: Environment, before: Sim, sim: Sim) -> Float[Array, " backups"]:
        """Return for each backup controller the smallest h on its flight from `sim`.

        It is to be compared with `margin_to_certify`. It is −∞ for a way that proves nothing. Such
        a way ends outside the terminal set, or the proof of the controller or of the set does not
        hold for the numbers of the environment. The shape is (backups,).

        Args:
            env: the environment, with the numbers of this episode.
            before: the simulation one step before `sim`.
            sim: the simulation from which the backup controllers act.
        """
        return self.follow(env, before, sim).values

    def follow(
        self, env: Environment, before: Sim, sim: Sim, memories: tuple[Any, ...] | None = None
    ) -> Paths:
        """Return the predicted way of each backup controller from `sim`.

        Args:
            env: the environment, with the numbers of this episode.
            before: the simulation one step before `sim`.
            sim: the simulation from which the backup controllers act.
            memories: what each backup controller remembers there. With None they take over there.
        """
        memories = self._fresh(env, sim) if memories is None else memories
        first = self.margins(env, before, sim)
        strict = self._within_bound(env)
        faultless = [_none(backup.faults(strict, sim, self)) for backup in self.backups]
        proved = jnp.stack(faultless or [jnp.zeros((), bool)]) & _finite(sim)
        if self.terminal is None:
            least = jnp.min(self.compared(env, first))
            return Paths(
                margins=first[None],
                least=least[None],
                certified=proved & jnp.isfinite(least),
                ahead={},
                memories_ahead=memories,
            )
        # The other platforms are predicted once for all backup controllers, unless they react to
        # what the agent does.
        pairs = list(zip(self.backups, memories, strict=True))
        groups = [[pair] for pair in pairs] if others_react(env, sim) else [pairs]
        predicted = [
            self._follow(env, group, first=first, earlier=before, sim=sim) for group in groups
        ]
        margins, group_ends, group_memories, group_arrived = zip(*predicted, strict=True)
        margins = jnp.concatenate(margins)
        ends = list(itertools.chain(*group_ends))
        arrived = itertools.chain(*group_arrived)
        reached = jnp.stack([self._may_end(env, *pair) for pair in zip(ends, arrived, strict=True)])
        states = [(end.platforms, end.actuators, end.remembered) for end in ends]
        if self.bound is not None:  # nothing is renewed
            states = [({}, {}, {})]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        ahead, actuators_ahead, remembered_ahead = stacked
        compared = jnp.stack([self.compared(env, on_the_way) for on_the_way in margins])
        return Paths(
            margins=margins,
            least=jnp.min(compared, axis=-1),
            certified=reached & proved,
            ahead=ahead,
            actuators_ahead=actuators_ahead,
            remembered_ahead=remembered_ahead,
            memories_ahead=jax.lax.stop_gradient(tuple(itertools.chain(*group_memories))),
        )

    def _follow(
        self,
        env: Environment,
        backups: Sequence[tuple[BackupController, Any]],
        first: Float[Array, " c"],
        earlier: Sim,
        sim: Sim,
    ) -> tuple[Float[Array, "backups c"], list[Sim], list[Any], list[Any]]:
        """Return the smallest margins on the way, and the last simulation and memory, by backup.

        With tubes a way ends where its tube is in the terminal set. The last list says whether it
        ever was, and holds None without tubes.

        Args:
            env: the environment.
            backups: backup controllers, each with its memory, under which the other platforms move
                alike. The other platforms are predicted once.
            first: the h of each constraint at `sim`.
            earlier: the simulation one step before `sim`.
            sim: the simulation from which the backup controllers act.
        """
        assert self.terminal is not None
        terminal = self.terminal
        bound = self.bound if self.has_tubes else None
        strict = self._within_bound(env)
        low, high = bounds(env)
        plant = env.agent_platform

        def with_agent(sim: Sim, agent: tuple[Any, Any, Any]) -> Sim:
            """Return the simulation with another state and other actuators of the agent.

            What the statuses remember depends on the agent too, so it is replaced as well.
            """
            state, actuators, remembered = agent
            platforms = {**sim.platforms, env.agent: state}
            return sim.replace(platforms=platforms, actuators=actuators, remembered=remembered)

        def one_step(
            carry: tuple[Sim, list[Any], list[Any], list[Array], list[Any]],
        ) -> tuple[Sim, list[Any], list[Any], list[Array], list[Any]]:
            sim, agents, memories, least, tubes = carry
            later = others_later(env, sim)
            after = later_sim(env, sim, {**later, env.agent: agents[0][0]})
            for i, (backup, _) in enumerate(backups):
                before = with_agent(sim, agents[i])
                control, memories[i] = backup.act(strict, before, later, memories[i])
                control = jnp.clip(control, low, high)
                move = plant.step_within_limits if backup.within_limits else plant.step
                controls, actuators = driven(env, before, control)
                state = move(before.platforms[env.agent], controls, env.dt)
                moved = with_agent(after, (state, actuators, before.remembered))
                moved = moved.replace(control_desired=control, control_actual=control)
                moved = remember(env, before, moved, env.dt)
                agents[i] = (state, actuators, moved.remembered)
                h = self.margins(env, before, moved)
                if bound is not None:
                    tube, arrived = tubes[i]
                    tube = backup.next_tube(env, before, moved, bound, tube)
                    h = jnp.where(arrived, least[i], h - tube.position)
                    tubes[i] = (tube, arrived | terminal.contains_tube(env, moved, tube))
                least[i] = jnp.minimum(least[i], h)
            return with_agent(after, agents[0]), agents, memories, least, tubes

        sim = sim.replace(regions={}, status={})
        count = len(backups)
        memories = [memory for _, memory in backups]
        agent = (sim.platforms[env.agent], sim.actuators, sim.remembered)
        least = [first] * count
        tubes = []
        if bound is not None:
            first_tubes = [backup.first_tube(env, earlier, sim, bound) for backup, _ in backups]
            least = [first - tube.position for tube in first_tubes]
            tubes = [(tube, terminal.contains_tube(env, sim, tube)) for tube in first_tubes]
        start = (sim, [agent] * count, memories, least, tubes)
        last, agents, memories, least, tubes = repeat(one_step, start, self.horizon)
        ends = [with_agent(last, agent) for agent in agents]
        arrived = [arrived for _, arrived in tubes] or [None] * count
        return jnp.stack(least), ends, memories, arrived

    def _may_end(
        self, env: Environment, end: Sim, arrived: Bool[Array, ""] | None = None
    ) -> Bool[Array, ""]:
        """Return whether a certificate may end in a state.

        Args:
            env: the environment.
            end: the simulation at the end of the horizon.
            arrived: whether the tube was in the terminal set on the way. None without tubes.
        """
        assert self.terminal is not None
        strict = self._within_bound(env)
        inside = self.terminal.contains(strict, end) if arrived is None else arrived
        return inside & _none(self.terminal.faults(strict, end, self)) & _finite(end)

    def _renew(
        self,
        env: Environment,
        sim: Sim,
        memory: RTAMemory,
        after_backup: Sim,
        backup_margin: Float[Array, ""],
    ) -> tuple[Bool[Array, ""], Sim, tuple[Any, ...]]:
        """Return whether the state after a step of the backup is certified.

        The other two values are the simulation and the memories of the backup controllers at the
        end of the new certificate's horizon.

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
            remembered=memory.remembered_ahead,
        )
        later = others_later(env, end)
        control, memories = self._backup(
            env, end, index=memory.backup_index, memories=memory.backups_ahead, later=later
        )
        new_end = advance(env, end, control, later=later)
        faultless = [_none(backup.faults(env, after_backup, self)) for backup in self.backups]
        proved = jnp.stack(faultless)[memory.backup_index]
        last_step = jnp.min(self.compared(env, self.margins(env, end, new_end)))
        keeps = (last_step >= self.required_margin(env)) & (backup_margin >= 0.0)
        renewed = memory.certified & keeps & self._may_end(env, new_end)
        renewed = renewed & proved & _finite(after_backup)
        return renewed, *jax.lax.stop_gradient((new_end, memories))

    def _way(
        self,
        env: Environment,
        before: Sim,
        sim: Sim,
        memories: tuple[Any, ...],
        reserve: Int[Array, ""],
        required: Number,
    ) -> Way:
        """Return the way that decides: that in reserve if it suffices, else the best of all.

        So most steps predict one way. All ways are predicted where there are only two, where
        there is a `bound`, and where other platforms react to the agent.

        Args:
            env: the environment.
            before: the simulation one step before `sim`.
            sim: the simulation from which the backup controllers act.
            memories: what each backup controller remembers there.
            reserve: the index of the backup controller in reserve.
            required: the value from which on its way suffices.
        """

        def best_of_all(rta: CertifiedRTA, env: Environment, *state: Any) -> Way:
            return rta._best(env, rta.follow(env, *state))

        state = (self, env, before, sim, memories)
        if len(self.backups) < 3 or self.bound is not None or others_react(env, sim):
            return best_of_all(*state)
        kept = self._kept(env, before, sim, memories, reserve)
        return only_where(~(kept.value >= required), best_of_all, state, otherwise=kept)

    def _kept(
        self,
        env: Environment,
        before: Sim,
        sim: Sim,
        memories: tuple[Any, ...],
        reserve: Int[Array, ""],
    ) -> Way:
        """Return the way of the backup controller in reserve. Arguments are those of `_way`."""
        alone = cast(BackupController, Reserve(self.backups, reserve))
        faultless = [_none(backup.faults(env, sim, self)) for backup in self.backups]
        first = self.margins(env, before, sim)
        margins, (end,), (moved,), _ = self._follow(
            env, [(alone, memories)], first=first, earlier=before, sim=sim
        )
        proved = jnp.stack(faultless)[reserve] & _finite(sim) & self._may_end(env, end)
        least = jnp.min(self.compared(env, margins[0]))
        return jax.lax.stop_gradient(
            Way(
                index=reserve,
                margins=margins[0],
                value=jnp.where(proved, least, -jnp.inf),
                memories_ahead=moved,
                ahead=end.platforms,
                actuators_ahead=end.actuators,
                remembered_ahead=end.remembered,
            )
        )

    def _best(self, env: Environment, paths: Paths) -> Way:
        """Return the way with the largest h. Only certified ones are compared if there are any."""
        if self.backups:
            certified = paths.values >= self.required_margin(env)
            compared = jnp.where(jnp.any(certified), paths.values, paths.least)
            compared = jnp.where(jnp.isnan(compared), -jnp.inf, compared)
            best = jnp.argmax(compared).astype(jnp.int32)
        else:
            best = jnp.full((), -1, jnp.int32)
        return Way(
            index=best,
            margins=paths.margins[best],
            value=paths.values[best],
            memories_ahead=paths.memories_ahead,
            ahead=_selected(paths.ahead, best),
            actuators_ahead=_selected(paths.actuators_ahead, best),
            remembered_ahead=_selected(paths.remembered_ahead, best),
        )

    def _backup(
        self,
        env: Environment,
        sim: Sim,
        index: Int[Array, ""],
        memories: tuple[Any, ...],
        later: Others,
    ) -> tuple[Float[Array, " m"], tuple[Any, ...]]:
        """Return the control of a backup controller, and the memories as if all had acted.

        Args:
            env: the environment.
            sim: the simulation before the step.
            index: the index of the controller whose control is returned.
            memories: what each backup controller remembers.
            later: the other platforms after the step.
        """
        if not self.backups:
            return jnp.zeros(env.action_size, env.dt.dtype), ()
        strict = self._within_bound(env)
        control, moved = Reserve(self.backups, index).act(strict, sim, later, memories)
        return admissible(env, control)[0], moved

    def _fresh(self, env: Environment, sim: Sim) -> tuple[Any, ...]:
        """Return the memories of backup controllers that take over at a state."""
        return tuple(backup.init(env, sim) for backup in self.backups)

    def _memories_after(
        self, env: Environment, sim: Sim, index: Int[Array, ""], moved: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        """Return the memories of all backup controllers after a step of one of them.

        Args:
            env: the environment.
            sim: the simulation after the step.
            index: the index of the controller that acted. The memories of the others start again.
            moved: the memories of all controllers, as if each had acted.
        """
        pairs = zip(moved, self._fresh(env, sim), strict=True)
        return tuple(_where(index == i, acted, fresh) for i, (acted, fresh) in enumerate(pairs))

    def _unfinished(self, env: Environment, sim: Sim, memory: RTAMemory) -> Bool[Array, ""]:
        """Return whether the last certificate's backup controller has a manoeuvre under way."""
        pairs = enumerate(zip(self.backups, memory.backups, strict=True))
        under_way = [
            (memory.backup_index == i) & backup.unfinished(env, sim, own)
            for i, (backup, own) in pairs
        ]
        return functools.reduce(jnp.logical_or, under_way, jnp.zeros((), bool))


def _none(faults: Faults) -> Bool[Array, ""]:
    """Return whether none of the faults applies."""
    return ~functools.reduce(jnp.logical_or, faults.values(), jnp.zeros((), bool))


def _finite(sim: Sim) -> Bool[Array, ""]:
    leaves = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(sim.platforms)]
    return functools.reduce(jnp.logical_and, leaves)


def _where(condition: Bool[Array, ""], this: Any, other: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), this, other)


def _selected(ahead: Any, index: Int[Array, ""]) -> Any:
    return jax.lax.stop_gradient(jax.tree.map(lambda leaf: leaf[index], ahead))
