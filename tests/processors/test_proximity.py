"""Drift without thrust is bounded from below, and room to brake is what braking takes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe.evaluate.run_adversaries import attack, within_step
from jaxsafe.processors import BrakingDistance, DriftDistance
from jaxsafe.simulation.cwh import MEAN_MOTION, cwh_flow
from jaxsafe.transition import advance
from jaxsafe.types import Sim


def sims(task: str, count: int) -> tuple[jaxsafe.Environment, Sim]:
    """Return random states within 100 m and 0.5 m/s of the chief."""
    env = jaxsafe.make(task)
    rng = np.random.default_rng(0)
    r, v = rng.normal(size=(2, count, env.agent_platform.dimension))
    start = {"position": jnp.asarray(30.0 * r), "velocity": jnp.asarray(0.15 * v)}
    state, _ = jax.vmap(lambda fields: jaxsafe.reset_to(env, {"deputy": fields}))(start)
    return env, state.sim.replace(regions={}, status={})


def drifted(sim: Sim, duration: float) -> jax.Array:
    """Return the smallest distance of a drift at 2001 instants."""
    own = sim.platforms["deputy"]
    still = jnp.zeros_like(own.position)

    def distance(time: jax.Array) -> jax.Array:
        place, _ = cwh_flow(r=own.position, v=own.velocity, a=still, n=MEAN_MOTION, t=time)
        return jnp.linalg.norm(place)

    return jnp.min(jax.vmap(distance)(jnp.linspace(0.0, duration, 2001)))


@pytest.mark.thorough
@pytest.mark.parametrize("duration", [300.0, thorough(6000.0)])
@pytest.mark.parametrize("task", ["docking2d", thorough("docking3d")])
@pytest.mark.usefixtures("x64")
def test_no_drift_comes_nearer_than_its_bound(task: str, duration: float) -> None:
    _, batch = sims(task, 200)
    status = DriftDistance(name="drift", of="deputy", to="chief", duration=duration)

    def both(sim: Sim) -> tuple[jax.Array, jax.Array]:
        return status.process((), sim), drifted(sim, duration)

    bound, true = jax.jit(jax.vmap(both))(batch)
    assert (bound <= true + 1e-9).all()
    assert np.median(true - bound) < 0.01 * duration / 60.0


@pytest.mark.parametrize("task", [thorough("docking2d"), thorough("docking3d")])
@pytest.mark.usefixtures("x64")
def test_thrust_that_fails_within_a_step_leaves_no_nearer_drift(task: str) -> None:
    env, batch = sims(task, 100)
    duration = 300.0
    status = DriftDistance(name="drift", of="deputy", to="chief", duration=duration)
    controls = jnp.sign(jnp.asarray(np.random.default_rng(1).normal(size=(100, env.action_size))))

    def both(sim: Sim, control: jax.Array) -> tuple[jax.Array, jax.Array]:
        shares = jnp.linspace(0.0, 1.0, 21)
        way = jax.vmap(lambda share: within_step(env, sim, control, share))(shares)
        true = jnp.min(jax.vmap(lambda sim: drifted(sim, duration))(way))
        return status.on_the_way(env, sim, advance(env, sim, control)), true

    bound, true = jax.jit(jax.vmap(both))(batch, controls)
    assert (bound <= true + 1e-9).all()
    assert np.median(true - bound) < 2.0


@pytest.mark.parametrize(
    ("stay", "position", "velocity", "expected"),
    [
        ("outside", [50.0, 0.0], [-1.0, 0.5], 40.0 - 10.0),
        ("outside", [50.0, 0.0], [1.0, 0.5], 40.0),
        ("inside", [6.0, 0.0], [0.2, 0.5], 4.0 - 0.4),
        ("inside", [0.0, 0.0], [0.2, 0.0], 10.0),
    ],
)
def test_room_to_brake_is_the_distance_less_what_braking_takes(
    stay: str, position: list, velocity: list, expected: float
) -> None:
    env = jaxsafe.make("docking2d")
    constraint = BrakingDistance(
        name="room", of="deputy", to="chief", radius=10.0, stay=stay, deceleration=0.05
    )
    start = {"deputy": {"position": position, "velocity": velocity}}
    sim = jaxsafe.reset_to(env, start)[0].sim
    np.testing.assert_allclose(constraint.margin(sim), expected, rtol=1e-6)


ROOM = {"name": "room", "of": "deputy", "to": "chief", "radius": 20, "deceleration": 0.05}
DRIFT = {"name": "drift", "of": "deputy", "to": "chief", "duration": 200, "samples": 20}
KEPT = [
    ({}, ROOM | {"type": "braking_distance"}),
    (
        DRIFT | {"type": "drift_distance"},
        {"type": "separation", "name": "room", "distance": "drift", "minimum": 10},
    ),
]


@pytest.mark.thorough
@pytest.mark.parametrize(("status", "constraint"), KEPT)
def test_a_filter_keeps_the_constraint(status: dict, constraint: dict) -> None:
    rta = {
        "type": "simplex",
        "constraints": ["room"],
        "margin": 0.1,
        "backups": [{"type": "brake", "name": "brake"}],
        "horizon": 20,
        "terminal": {"type": "at_rest"},
    }
    bare = jaxsafe.make("docking2d", {"deputy.start.velocity.share": [0.0, 0.1]})
    statuses = [*bare.status, *([status] if status else [])]
    env = jaxsafe.override(bare, {"status": statuses, "constraints": [constraint], "rta": rta})
    for policy in ("inward", "bang_bang"):
        row = attack(env, policy, 300, 16, jax.random.key(0))
        assert row["violating_steps"] == row["violating_steps_inside"] == 0, row
        assert row["uncertified_steps"] == 0
    assert attack(jaxsafe.override(env, {"rta": None}), "inward", 300, 16, jax.random.key(0))[
        "violating_steps"
    ]
