"""One filter keeps five constraints at once, and still lets a controller reach its goal."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.types import State

FILE = Path(__file__).parents[2] / "examples" / "inspection.yaml"


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["greedy", "inward", "bang_bang", "sideways", "search"])
def test_adversaries_break_none_of_five_constraints(policy: str) -> None:
    env = jaxsafe.make(FILE)
    row = attack(env, policy, 200, 32, jax.random.key(1))
    assert row["violating_steps"] == row["violating_steps_inside"] == 0, row
    assert row["uncertified_steps"] == 0
    assert row["unsafe_starts"] == 0.0
    bare = attack(jaxsafe.override(env, {"rta": None}), policy, 200, 32, jax.random.key(1))
    assert bare["violating_steps_inside"] > 0


def controller(state: State) -> jax.Array:
    """Return thrust around the chief to the hold point, as an action."""
    own = state.sim.platforms["deputy"]
    x, y = own.position
    left = jnp.arctan2(x, y)  # the angle that is left to the hold point, which is along y
    far = jnp.abs(left) > 0.7
    ahead = left - jnp.clip(left, -0.7, 0.7)
    radius = jnp.where(far, jnp.maximum(0.9 * jnp.hypot(x, y), 45.0), 30.0)
    aim = radius * jnp.stack([jnp.sin(ahead), jnp.cos(ahead)]) - own.position
    wanted = 0.02 * aim
    wanted = wanted * jnp.minimum(1.0, 0.15 / jnp.linalg.norm(wanted))
    return jnp.clip(5.0 * (wanted - own.velocity), -1.0, 1.0)


@pytest.mark.thorough
def test_a_plain_controller_reaches_the_hold_point_under_the_filter() -> None:
    env = jaxsafe.make(FILE)

    def one_step(carry: tuple[State, jax.Array], _: None) -> Any:
        state, outcome = carry
        state, timestep = jaxsafe.step(env, state, controller(state))
        altered = timestep.info.intervening & (outcome == 0)
        outcome = jnp.where(outcome == 0, timestep.info.outcome, outcome)
        return (state, outcome), (altered, outcome == 0)

    def episode(key: jax.Array) -> Any:
        start, first = jaxsafe.reset(env, key)
        (_, outcome), (altered, running) = jax.lax.scan(
            one_step, (start, jnp.zeros((), jnp.int32)), length=1500
        )
        return first.info.rta.certified, outcome, altered.sum() / running.sum()

    keys = jax.random.split(jax.random.key(0), 32)
    certified, outcome, altered = jax.jit(jax.vmap(episode))(keys)
    assert certified.all()
    assert (outcome == env.outcomes.index("success")).all()
    assert np.mean(altered) < 0.05
