"""Filters of rejoin in space with a bound: no disturbance and no wrong measurement does harm."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe import ConfigError
from jaxsafe.config import override
from jaxsafe.evaluate.bounded_worlds import world_at
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.rta import UncertaintyBound
from jaxsafe.rta.tube_in_space import (
    FAST_MODE,
    SLOW_MODE,
    TURN_GAIN,
    TubeInSpace,
    largest_mixture,
)
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.transition import advance, bounds, others_later
from jaxsafe.types import Sim

WORLDS: list[dict[str, float]] = [
    {"process": 0.38},
    {"process": 0.1, "position": 1.0, "velocity": 0.15},
    {"velocity": 0.3},
]
"""How far the true world may be from the one that the filter knows."""

LOWEST = 102.0
"""The distance that is kept [ft]: the separation and the margin."""


def unit(vector: jax.Array) -> jax.Array:
    return vector / jnp.maximum(safe_norm(vector), 1e-9)


def across(sim: Sim) -> jax.Array:
    """Return the horizontal direction to the left of the wingman's velocity."""
    velocity = sim.platforms["wingman"].velocity
    return unit(jnp.stack([-velocity[1], velocity[0], jnp.zeros_like(velocity[0])]))


def inward(sim: Sim) -> jax.Array:
    """Return the direction from the wingman to the lead."""
    return unit(sim.platforms["lead"].position - sim.platforms["wingman"].position)


def with_wingman(sim: Sim, wingman: Any) -> Sim:
    platforms = {**sim.platforms, "wingman": wingman}
    return sim.replace(platforms=platforms, regions={}, status={})


def measured(env: Any, sim: Sim, bound: UncertaintyBound, direction: jax.Array) -> Sim:
    own = sim.platforms["wingman"]
    velocity = own.velocity + bound.velocity * direction
    seen = env.agent_platform.with_velocity(own, velocity)
    return with_wingman(sim, seen.replace(position=own.position + bound.position * direction))


def true_step(
    env: Any, sim: Sim, control: jax.Array, bound: UncertaintyBound, direction: jax.Array
) -> Sim:
    """Return the simulation after a step with a disturbance in a direction."""
    sim = advance(env, sim, control)
    push = bound.process * direction
    moved = env.agent_platform.pushed(sim.platforms["wingman"], push, 0.0 * push, dt=env.dt)
    return with_wingman(sim, moved)


def robust(world: dict[str, float], **overrides: Any) -> Any:
    numbers = {"rta.bound.process": 0.0} | {f"rta.bound.{name}": x for name, x in world.items()}
    return jaxsafe.make("rejoin3d", numbers | overrides, rta="robust")


def anywhere(env: Any, key: jax.Array, count: int) -> Sim:
    """Draw simulations with the wingman anywhere about the lead, banked and climbing."""
    state, _ = jax.vmap(partial(jaxsafe.reset, env.replace(rta=None)))(jax.random.split(key, count))
    lead = state.sim.platforms["lead"]
    shares = jax.random.uniform(key, (5, count)) - 0.5
    way = jax.vmap(unit)(jax.random.normal(key, (count, 3)))
    far = 1100.0 + 2000.0 * shares[0]
    own = state.sim.platforms["wingman"].replace(
        position=lead.position + far[:, None] * way,
        heading=2.0 * jnp.pi * shares[1],
        speed=300.0 + 200.0 * shares[2],
        flight_path_angle=0.69 * shares[3],
        roll=2.09 * shares[4],
    )
    return with_wingman(state.sim, own)


def errors(true: Any, predicted: Any, gravity: jax.Array) -> dict[str, jax.Array]:
    """Return the differences of two states that a tube bounds, by the field of the tube."""
    heading = true.heading - predicted.heading
    sideways = gravity * (jnp.tan(true.roll) - jnp.tan(predicted.roll))
    turn = sideways / predicted.speed
    return {
        "position": safe_norm(true.position - predicted.position),
        "heading": jnp.abs(heading),
        "speed": jnp.abs(true.speed - predicted.speed),
        "climb": jnp.abs(true.flight_path_angle - predicted.flight_path_angle),
        "sideways": jnp.abs(sideways),
        "slow": jnp.abs(heading + SLOW_MODE * turn),
        "fast": jnp.abs(heading + FAST_MODE * turn),
    }


@partial(jax.jit, static_argnames="how")
def ways(
    env: Any, sims: Sim, controls: jax.Array, keys: jax.Array, how: str
) -> tuple[TubeInSpace, dict[str, jax.Array], jax.Array]:
    """Follow the first backup controller from measured states, after a step of some controls.

    Returns:
        The tubes, what they bound, and the least predicted distance less the tube's radius.
    """
    backup = env.rta.backups[0]
    bound = env.rta.bound
    low, high = bounds(env)

    def episode(sim: Sim, control: jax.Array, key: jax.Array) -> Any:
        def direction(sim: Sim, key: jax.Array) -> jax.Array:
            if how == "across":
                return jnp.sign(control[0]) * across(sim)
            return inward(sim) if how == "inward" else unit(jax.random.normal(key, (3,)))

        key, key_seen, key_step = jax.random.split(key, 3)
        seen = measured(env, sim, bound, -direction(sim, key_seen))
        predicted = advance(env, seen, control).replace(regions={}, status={})
        tube = backup.first_tube(env, seen, predicted, bound)
        true = true_step(env, sim, control, bound, direction(sim, key_step))

        def one_step(carry: Any, key: jax.Array) -> Any:
            true, predicted, tube = carry
            key_seen, key_step = jax.random.split(key)
            own = predicted.platforms["wingman"]
            found = errors(true.platforms["wingman"], own, env.agent_platform.gravity)
            apart = safe_norm(own.position - predicted.platforms["lead"].position)
            later = others_later(env, true)
            seen = measured(env, true, bound, -direction(true, key_seen))
            acts = [
                jnp.clip(backup.control(env, sim, later), low, high) for sim in (seen, predicted)
            ]
            after = advance(env, predicted, acts[1]).replace(regions={}, status={})
            wider = backup.next_tube(env, predicted, after, bound, tube)
            true = true_step(env, true, acts[0], bound, direction(true, key_step))
            return (true, after, wider), (tube, found, apart - tube.position)

        start = (with_wingman(true, true.platforms["wingman"]), predicted, tube)
        return jax.lax.scan(one_step, start, jax.random.split(key, 60))[1]

    return jax.vmap(episode)(sims, controls, keys)


@pytest.mark.parametrize("of_heading", [0.0, 1.0])
@pytest.mark.parametrize("of_turn", [0.0, SLOW_MODE, FAST_MODE])
def test_no_step_of_a_tube_turns_further_than_its_bound(of_heading: float, of_turn: float) -> None:
    random = np.random.default_rng(0)
    n = 2000
    psi, delta = random.normal(size=(2, n))
    speed, ratio = random.uniform(300.0, 500.0, n), random.uniform(0.9, 1.1, n)
    room = random.uniform(1.0, 3.0, (4, n))
    tube = TubeInSpace(
        position=jnp.zeros(n),
        speed=jnp.zeros(n),
        climb=jnp.zeros(n),
        heading=room[0] * np.abs(psi),
        sideways=room[1] * np.abs(delta) * speed,
        slow=room[2] * np.abs(psi + SLOW_MODE * delta),
        fast=room[3] * np.abs(psi + FAST_MODE * delta),
    )
    weights = np.sort(random.uniform(0.3, 0.8, (2, n)), axis=0)
    shares = np.sort(random.uniform(0.0, 2.0, (2, n)), axis=0)
    follows = random.random(n) < 0.7
    stays = ~follows | (random.random(n) < 0.7)
    bound = largest_mixture(
        tube, speed, of_heading, of_turn, ratio, (*weights,), (*shares,), follows, stays
    )

    for _ in range(100):
        a, b, mu = (
            low + (high - low) * random.random(n) for low, high in (weights, weights, shares)
        )
        theta = np.where(follows, np.where(stays, random.random(n), 1.0), 0.0)
        delta_after = ratio * ((1.0 - theta) * mu * delta - theta * TURN_GAIN * psi)
        psi_after = psi + a * ratio * delta + b * delta_after
        assert np.all(np.abs(of_heading * psi_after + of_turn * delta_after) <= bound * 1.00001)
    alone = largest_mixture(
        tube.replace(sideways=jnp.zeros(n)),
        speed,
        0.0,
        1.0,
        ratio,
        (*weights,),
        (*shares,),
        np.ones(n, bool),
        np.zeros(n, bool),
    )
    assert np.all(alone <= TURN_GAIN * ratio * tube.heading * 1.00001)


@pytest.mark.thorough
@pytest.mark.parametrize("how", ["across", "inward", "random"])
def test_a_tube_holds_every_way_that_is_flown_along_a_backup(how: str) -> None:
    key = jax.random.key(0)
    for world in WORLDS:
        env = robust(world)
        sims = anywhere(env, key, 256)
        low, high = bounds(env)
        controls = low + (high - low) * jax.random.uniform(key, (256, 3))
        tubes, found, least = ways(env, sims, controls, jax.random.split(key, 256), how)
        known = np.minimum.accumulate(np.asarray(least), axis=1) >= LOWEST
        assert known[:, 0].mean() > 0.5
        rounding = {"position": 0.1, "speed": 2e-3, "sideways": 0.02}
        for name, error in found.items():
            width = np.asarray(getattr(tubes, name))[known]
            assert np.all(np.asarray(error)[known] <= 1.001 * width + rounding.get(name, 3e-4))
        if how == "across" and "process" in world:  # the tube is hardly wider than it must be
            share = np.asarray(found["heading"] / tubes.heading)[known]
            assert np.max(share) > 0.98
            assert np.max(np.asarray(found["position"] / tubes.position)[known]) > 0.8


@jax.jit
def least_distances(env: Any, sims: Sim) -> jax.Array:
    """Return how near the lead gets in 300 s while the backup acts."""
    bound = env.rta.bound
    backup = env.rta.backups[0]
    low, high = bounds(env)

    def least(sim: Sim) -> jax.Array:
        def one_step(sim: Sim, _: None) -> tuple[Sim, jax.Array]:
            seen = measured(env, sim, bound, -inward(sim))
            control = jnp.clip(backup.control(env, seen, others_later(env, sim)), low, high)
            sim = true_step(env, sim, control, bound, inward(sim))
            apart = sim.platforms["lead"].position - sim.platforms["wingman"].position
            return sim, safe_norm(apart)

        return jnp.min(jax.lax.scan(one_step, sim, length=300)[1])

    return jax.vmap(least)(sims)


@pytest.mark.thorough
@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("climb", [0.0, 0.25])
def test_the_formation_is_never_left_to_the_lead(world: dict[str, float], climb: float) -> None:
    """A wingman at the edge of the set is pushed towards the lead for 300 s."""
    env = robust(world)
    terminal = env.rta.terminal
    key = jax.random.key(1)
    sims = anywhere(env, key, 256)
    lead = sims.platforms["lead"].replace(flight_path_angle=jnp.full(256, climb))
    sign = jnp.where(jax.random.bernoulli(key, shape=(5, 256)), 0.99, -0.99) * terminal.tolerance
    level_speed = lead.speed * jnp.cos(climb)
    lateral = jnp.clip(3.28 * sign[1] - SLOW_MODE * sign[0], -3.96 * 0.75, 3.96 * 0.75)
    way = jax.vmap(unit)(jax.random.normal(key, (256, 3)) * jnp.array([0.5, 1.0, 0.5]))
    own = sims.platforms["wingman"].replace(
        position=lead.position + terminal.clearance * way,
        heading=lead.heading + lateral / level_speed,
        speed=lead.speed + sign[2],
        flight_path_angle=lead.flight_path_angle + sign[3] / lead.speed,
        roll=jnp.arctan(sign[0] * 1.0 / env.agent_platform.gravity),
    )
    sims = with_wingman(sims.replace(platforms={**sims.platforms, "lead": lead}), own)

    assert np.min(least_distances(env, sims)) >= LOWEST


@pytest.mark.parametrize(
    "policy", [thorough("intercept"), pytest.param("head_on", marks=pytest.mark.slow)]
)
def test_within_the_bound_there_is_no_collision_and_all_is_certified(policy: str) -> None:
    world = world_at(robust({"process": 0.3}), 1.0)
    counts = attack(world, policy, 150, 32, jax.random.key(0))
    assert counts["violating_steps"] == counts["violating_steps_inside"] == 0
    assert counts["uncertified_steps"] == 0
    assert counts["unsafe_starts"] == 0.0
    assert counts["worst_margin_inside"] < 400.0  # the agent did come close


@pytest.mark.thorough
def test_a_start_of_the_task_is_certified_within_the_bound() -> None:
    env = jaxsafe.make("rejoin3d", rta="robust")
    state, timestep = jaxsafe.reset(env, jax.random.key(0))
    assert timestep.info.rta is not None
    assert timestep.info.rta.certified
    assert state.memory.rta.ahead == {}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"rta.bound.process": 0.4}, "rta.bound is larger than tolerance of velocity_matched"),
        *(
            thorough(overrides, message)
            for overrides, message in [
                ({"rta.bound.position": 10}, "rta.bound is larger than tolerance of velocity_mat"),
                ({"rta.bound.mass": 0.1}, "rta.bound.mass is not proved for aircraft"),
                ({"rta.bound.misalignment": 0.1}, "rta.bound.misalignment is not proved for"),
                ({"rta.bound.delay": 1}, "rta.bound.delay is not proved for aircraft in space"),
                ({"rta.backups.left_up.clearance": 190}, "rta.bound: clearance of match_velocity"),
                ({"rta.backups.left_up.clearance": 210}, "rta.bound: clearance of match_velocity"),
                (
                    {
                        "rta.backups.left_up.away_time": 26,
                        "rta.backups.left_up.clearance": 209,
                        "rta.terminal.clearance": 209,
                    },
                    "rta.bound in space is proved for an away_time of at most 25 s",
                ),
                ({"rta.backups.left_up.dead_zone": 0.01}, "rta.bound: dead_zone of match_veloc"),
                ({"rta.terminal.clearance": 190}, "rta.bound: clearance of velocity_matched is"),
                (
                    {"lead.controller.commands.heading_rate.at": 0.01},
                    "rta.bound in space is proved for a lead that flies straight, and 'lead' may",
                ),
                ({"dt": 0.5, "rta.horizon": 150}, "rta.bound in space is proved for steps of 1 s"),
                (
                    {"lead.start.speed.low": 205, "lead.start.speed.high": 206},
                    "rta.bound: 'lead' flies too close to the agent's slowest or fastest speed",
                ),
                (
                    {"wingman.controller.actuators.roll_rate.high": 0.01, "rta.horizon": 200},
                    "rta.bound: the agent rolls, climbs or accelerates too slowly",
                ),
            ]
        ),
    ],
)
def test_a_bound_that_is_not_proved_is_refused_in_one_line(
    overrides: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        jaxsafe.make("rejoin3d", overrides, rta="robust")
    assert "\n" not in str(caught.value)


@pytest.mark.thorough
def test_another_time_to_move_away_is_refused_in_the_plane() -> None:
    changes = {"rta.backups.left.away_time": 20}
    with pytest.raises(ConfigError, match=r"rta\.bound in the plane is proved for an away_time of"):
        jaxsafe.make("rejoin2d", changes, rta="robust")
    env = override(jaxsafe.make("rejoin2d", rta="default"), changes)
    assert env.rta is not None
