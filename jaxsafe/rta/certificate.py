"""What a certificate rests on: a backup controller, and a set in which it may end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.tube import Tube
from jaxsafe.schema.component import Component
from jaxsafe.transition import Others
from jaxsafe.types import Number, Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment
    from jaxsafe.rta.certified import CertifiedRTA

Faults = dict[str, Bool[Array, ""]]
"""Reasons, in words, why a proof may not hold, and whether each applies at a given state."""


class BackupController(Component):
    """A control law that keeps the agent safe, or leads it to states in which it does.

    It has a name, because a filter may have several. A law without memory writes `control` alone.
    One with memory writes `init` and `act`. A memory begins at the state where the controller takes
    over, and changes only while the controller acts or is predicted to act.
    """

    name: str
    within_limits: ClassVar[bool] = False
    """Whether the plant reaches no limit of its state within a step while the controller acts.

    The filter then predicts with the plant's `step_within_limits`, which is cheaper.
    """
    knows_bound: ClassVar[bool] = False
    """Whether `faults` takes the `bound` of a filter into account."""

    def control(self, env: Environment, sim: Sim, later: Others) -> Float[Array, " m"]:
        """Return the control in physical units and action order. The filter clips it.

        Args:
            env: the environment.
            sim: the simulation before the step.
            later: the other platforms' states after the step, by name.
        """
        raise NotImplementedError

    def init(self, env: Environment, sim: Sim) -> Any:
        """Return the memory with which the controller takes over at a state, `()` for none."""
        return ()

    def act(
        self, env: Environment, sim: Sim, later: Others, memory: Any
    ) -> tuple[Float[Array, " m"], Any]:
        """Return the control, as `control` does, and the memory after the step."""
        return self.control(env, sim, later), memory

    def merged(
        self, others: Sequence[BackupController], index: Int[Array, ""]
    ) -> BackupController | None:
        """Return a controller without memory that acts as one of several, or None.

        With None each of them computes its control, and that of one is taken.

        Args:
            others: all backup controllers of a filter, this one among them.
            index: the index of the one that acts. It is traced.
        """
        return None

    def unfinished(self, env: Environment, sim: Sim, memory: Any) -> Bool[Array, ""]:
        """Return whether a manoeuvre is under way. The filter lets the controller finish it."""
        return jnp.zeros((), bool)

    @property
    def proved(self) -> BackupController:
        """The controller that the proofs of terminal sets look at: itself, or the one it wraps."""
        return self

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        """Return reasons why this controller is not proved to keep the constraints.

        There are none by default. At a state where a reason applies, the filter certifies nothing.
        A filter is refused when it is built if a reason applies at all of a few sampled starts.

        Args:
            env: the environment, with the numbers of this episode.
            sim: the simulation at the state.
            rta: the filter that asks.
        """
        return {}

    def duration(self, env: Environment) -> Number:
        """Return the longest time [s] to the terminal set, 0 where that is not known."""
        return jnp.zeros_like(env.dt)

    def keeps_from(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        """Return whether it is proved to keep the constraints for ever from a state.

        The proof needs no prediction, and no disturbance. The filter looks at `faults` besides.
        """
        return jnp.zeros((), bool)

    def most_rehearsed_steps(self, horizon: int) -> int:
        """Return the most steps for which it flies by memory, without looking at the agent.

        It is 0 for a controller that always looks at the agent.

        Args:
            horizon: the horizon of the filter.
        """
        return 0

    @property
    def has_tubes(self) -> bool:
        """Whether it has tubes. Without them it is not proved with a `bound` and a horizon."""
        return False

    def first_tube(
        self, env: Environment, before: Sim, after: Sim, bound: UncertaintyBound
    ) -> Tube:
        """Return the tube about a state that is predicted from a measured one.

        Args:
            env: the environment.
            before: the measured simulation.
            after: the simulation that is predicted one step later, whatever the control is.
            bound: how far the true world may be from the predicted one.
        """
        raise NotImplementedError

    def next_tube(
        self, env: Environment, before: Sim, after: Sim, bound: UncertaintyBound, tube: Tube
    ) -> Tube:
        """Return the tube after a step in which this controller acts.

        In the prediction the controller acts on the predicted state. In truth it acts on the
        measured one.

        Args:
            env: the environment.
            before: the predicted simulation before the step.
            after: the predicted simulation after the step.
            bound: how far the true world may be from the predicted one.
            tube: the tube before the step.
        """
        raise NotImplementedError


class TerminalSet(Component):
    """Set of states from which the backup controllers stay safe for ever.

    A certificate may end in it.
    """

    knows_bound: ClassVar[bool] = False
    """Whether `faults` takes the `bound` of a filter into account, and there is `contains_tube`."""

    def contains(self, env: Environment, sim: Sim) -> Bool[Array, ""]:
        """Return whether a state is in the set."""
        raise NotImplementedError

    def contains_tube(self, env: Environment, sim: Sim, tube: Tube) -> Bool[Array, ""]:
        """Return whether all states of a tube about a predicted state are in the set.

        From all of them the backup controllers must stay safe in every world within the filter's
        `bound`.
        """
        raise NotImplementedError

    def faults(self, env: Environment, sim: Sim, rta: CertifiedRTA) -> Faults:
        """Return reasons why the set is not proved safe, as `BackupController.faults` does."""
        return {}
