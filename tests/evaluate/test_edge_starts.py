"""Starts at the edge of what a filter certifies are certified, and what is beyond them is not."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe import ConfigError
from jaxsafe.commands import falsify
from jaxsafe.evaluate.edge_starts import edge_start, unsafe
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.simulation.geometry import safe_norm

NUM_STARTS = 128


@jax.jit
def starts(env: jaxsafe.Environment) -> tuple[jaxsafe.State, jaxsafe.TimeStep]:
    keys = jax.random.split(jax.random.key(0), NUM_STARTS)
    return jax.vmap(edge_start, in_axes=(None, 0))(env, keys)


def test_starts_of_docking_are_near_far_at_rest_and_at_the_limit() -> None:
    env = jaxsafe.make("docking2d", rta="default")
    state, first = starts(env)
    assert not unsafe(first).any()
    assert not first.info.outcome.any()
    own = state.sim.platforms["deputy"]
    distance = np.asarray(safe_norm(own.position))
    margin = np.asarray(first.info.margins["velocity_limit"])
    at_the_limit = margin < 1.01 * env.rta.margin + 1e-4
    for edge in (distance < 1.0, distance > 5000.0, safe_norm(own.velocity) < 1e-4, at_the_limit):
        assert edge.mean() > 0.05
    assert (at_the_limit & (distance > 200.0)).any()
    assert (at_the_limit & (distance < 50.0)).any()

    # The limit is what is certified, not a number of the search.
    faster = 1.005 * own.velocity[at_the_limit]
    position = own.position[at_the_limit]

    def certified(position: jax.Array, velocity: jax.Array) -> jax.Array:
        start = {"deputy": {"position": position, "velocity": velocity}}
        return jaxsafe.reset_to(env, start)[1].info.rta.certified

    assert not jax.vmap(certified)(position, faster).any()


@pytest.mark.parametrize("rta", ["default", thorough("robust")])
def test_starts_of_rejoin_are_close_and_at_the_end_of_the_airspace(rta: str) -> None:
    env = jaxsafe.make("rejoin2d", rta=rta)
    state, first = starts(env)
    assert not unsafe(first).any()
    assert not first.info.outcome.any()
    apart = state.sim.platforms["lead"].position - state.sim.platforms["wingman"].position
    distance = np.asarray(safe_norm(apart))
    assert (distance < 130.0).any()
    assert (distance > 39_000.0).any()
    speed = np.asarray(state.sim.platforms["wingman"].speed)
    assert {200.0, 400.0} <= set(speed.round(1))


def test_without_a_filter_the_edge_is_that_of_the_safe_set() -> None:
    state, first = starts(jaxsafe.make("docking2d"))
    margin = first.info.margins["velocity_limit"]
    assert (margin >= 0.0).all()
    assert (margin < 1e-4).mean() > 0.1
    assert safe_norm(state.sim.platforms["deputy"].position).max() > 39_000.0


@pytest.mark.thorough
@pytest.mark.parametrize("policy", ["inward", "search"])
def test_adversaries_begin_at_the_edges_where_they_are_told_to(policy: str) -> None:
    env = jaxsafe.make("docking2d", rta="default")
    lowest = [
        attack(env, policy, 64, 16, jax.random.key(0), starts=kind)["mean_correction"]
        for kind in ("task", "edges")
    ]
    assert lowest[0] != lowest[1]
    counts = attack(env, policy, 64, 16, jax.random.key(0), starts="edges")
    assert counts["unsafe_starts"] == counts["violating_steps_inside"] == 0


def test_another_kind_of_starts_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"starts: .*edge.*task, edges"):
        falsify.main(["env=docking2d", "starts=edge"])
