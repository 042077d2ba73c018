"""What a filter knows of the state in which a delayed control begins to act.

Until then the controls that are under way act. The filter predicts through them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsafe.rta.bound import Errors
from jaxsafe.rta.speed_limit import speed_limit_facts
from jaxsafe.rta.tube import errors_after_delay
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.transition import advance
from jaxsafe.types import Sim

if TYPE_CHECKING:
    from jaxsafe.environment import Environment
    from jaxsafe.rta.certified import CertifiedRTA


def ahead_of_delay(
    rta: CertifiedRTA, env: Environment, sim: Sim, controls: Float[Array, "delay m"]
) -> tuple[CertifiedRTA, Sim, Bool[Array, " delay"]]:
    """Return what remains to be filtered after the controls under way have acted.

    Args:
        rta: the filter, which has a bound with a delay.
        env: the environment.
        sim: the simulation, as it is measured.
        controls: the controls under way.

    Returns:
        The filter without delay, the predicted simulation, and whether the state after each control
        is certified. The filter takes the predicted state for a measured one, with the errors of
        the prediction.
    """
    bound = rta.bound
    assert bound is not None
    start = sim.replace(regions={}, status={})
    if rta.has_tubes:
        ahead = rta.replace(bound=bound.after_delay(errors_after_delay(env, bound)))

        def one_step_in_tube(sim: Sim, control: Float[Array, " m"]) -> tuple[Sim, Array]:
            later = advance(env, sim, control)
            assert ahead.bound is not None
            tube = rta.backups[0].first_tube(env, sim, later, ahead.bound)
            least = jnp.min(rta.compared(env, rta.margins(env, sim, later)))
            return later, least - tube.position >= rta.required_margin(env)

        sim, certified = jax.lax.scan(one_step_in_tube, start, controls)
        return ahead, sim, certified
    facts = [speed_limit_facts(env, name) for name in rta.constraints]

    def one_step(carry: tuple[Sim, Errors], control: Float[Array, " m"]) -> Any:
        sim, errors = carry
        later = advance(env, sim, control)
        if facts[0] is not None:
            acceleration = safe_norm(control) / facts[0].mass
            errors = bound.errors_after(facts[0], errors, acceleration)
        rta_there = rta.replace(bound=bound.after_delay(errors))
        value = rta_there.follow(env, sim, later).values[0]
        return (later, errors), value >= rta_there.margin_to_certify(env)

    (sim, errors), certified = jax.lax.scan(one_step, (start, bound.measured), controls)
    return rta.replace(bound=bound.after_delay(errors)), sim, certified
