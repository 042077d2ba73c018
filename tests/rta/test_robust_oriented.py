"""The filter of oriented docking with a bound: pushes and wrong measurements do no harm."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe import ConfigError
from jaxsafe.evaluate.bounded_worlds import world_at
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.rta import Brake, Rehearsed, Simplex
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.simulation.trig import wrap

LARGEST = 2.8e-4
"""Nearly the largest push that can be kept [m/s²]."""


def robust(rta: str = "robust", **bound: float) -> Any:
    overrides = {f"rta.bound.{name}": value for name, value in bound.items()}
    return jaxsafe.make("docking2d_oriented", overrides, rta=rta)


@partial(jax.jit, static_argnums=2)
def flown(env: Any, key: jax.Array, num_steps: int) -> Any:
    """Fly with full thrust and the wheel at a random bound, from a hundred starts."""

    def one_step(state: Any, key: jax.Array) -> Any:
        signs = jnp.where(jax.random.bernoulli(key, 0.5, (100, 2)), 1.0, -1.0)
        state, timestep = jax.vmap(jaxsafe.step, (None, 0, 0))(env, state, signs.at[:, 0].set(1.0))
        own = state.sim.platforms["deputy"]
        rehearsed = state.memory.rta.backups[0]
        apart = safe_norm(own.velocity - rehearsed.velocity)
        apart += 0.002054 * safe_norm(own.position - rehearsed.position)
        turned = jnp.abs(wrap(own.attitude - rehearsed.attitude, -jnp.pi, 2.0 * jnp.pi))
        return state, (apart, turned, timestep)

    state, _ = jax.vmap(jaxsafe.reset, (None, 0))(env, jax.random.split(key, 100))
    return jax.lax.scan(one_step, state, jax.random.split(key, num_steps))[1]


slow = partial(pytest.param, marks=pytest.mark.slow)
"""A case that takes minutes."""


@pytest.mark.thorough
def test_starts_below_the_lower_limit_are_certified() -> None:
    certified = jax.jit(
        jax.vmap(lambda env, key: jaxsafe.reset(env, key)[1].info.rta.certified, (None, 0))
    )
    keys = jax.random.split(jax.random.key(0), 5000)
    assert 0.015 < 1.0 - float(certified(robust(), keys).mean()) < 0.03
    slower = jaxsafe.override(robust(), {"deputy.start.velocity.share": [0.0, 0.97]})
    assert certified(slower, keys).all()


@pytest.mark.thorough
@pytest.mark.parametrize(
    "bound", [{"process": LARGEST}, thorough({"process": 1e-4, "position": 1.0, "velocity": 4e-3})]
)
def test_the_true_way_stays_as_near_to_the_rehearsal_as_the_bound_says(
    bound: dict[str, float],
) -> None:
    env = world_at(robust(**bound), 1.0)
    apart, turned, timestep = flown(env, jax.random.key(0), 600)
    certified = np.asarray(timestep.info.rta.certified)
    assert certified.mean() > 0.9
    assert np.asarray(timestep.info.intervening).mean() > 0.2
    lost = float(env.rta.lost(env))
    assert lost <= 0.03
    assert np.max(apart[certified]) <= lost
    assert np.max(apart[certified]) > 5.0 * bound["process"]  # many steps are rehearsed
    assert np.max(turned[certified]) < 1e-4
    assert np.all(timestep.info.margins["velocity_limit"][certified] >= 0.0)


@pytest.mark.parametrize("starts", ["task", "edges"])
@pytest.mark.parametrize("policy", [thorough("greedy"), slow("inward"), slow("search")])
def test_no_adversary_breaks_the_limit_within_the_bound(policy: str, starts: str) -> None:
    world = world_at(robust(process=LARGEST), 1.0, searched=policy == "search")
    counts = attack(world, policy, 1000, 32, jax.random.key(1), starts=starts)
    assert counts["violating_certified_steps"] == 0
    assert starts == "task" or counts["violating_steps_inside"] == 0


@pytest.mark.slow
def test_without_a_bound_such_pushes_break_certified_steps() -> None:
    world = world_at(robust(process=LARGEST), 1.0)
    nominal = jaxsafe.config.override(
        world, {"rta": jaxsafe.make("docking2d_oriented", rta="default").rta}
    )
    counts = attack(nominal, "greedy", 1000, 32, jax.random.key(1))
    assert counts["violating_certified_steps"] > 0


@pytest.mark.parametrize(
    ("bound", "message"),
    [
        ({"process": 3e-4}, r"rta: bound costs more than 0\.03 m/s of the speed limit"),
        ({"mass": 0.01}, r"rta\.bound\.mass and misalignment are not proved for rehearsed"),
        ({"delay": 1}, r"rta\.bound\.delay is not proved for rehearsed"),
    ],
)
def test_a_bound_that_no_rehearsal_can_keep_is_refused_in_one_line(
    bound: dict[str, float], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        robust(**bound)
    assert "\n" not in str(caught.value)


def test_only_a_turn_before_braking_is_rehearsed() -> None:
    backup = Rehearsed(name="rehearsed", backup=Brake(name="brake"))
    rta = Simplex(constraints=("velocity_limit",), margin=2.5e-4, backups=(backup,))
    with pytest.raises(ConfigError, match="rehearsed is proved for align_and_brake alone"):
        jaxsafe.make("docking2d", rta=rta)
