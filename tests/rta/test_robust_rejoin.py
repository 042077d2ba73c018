"""Filters of rejoin with a bound: no disturbance and no wrong measurement within it does harm."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe import ConfigError
from jaxsafe.config import override
from jaxsafe.evaluate.adversaries import ADVERSARIES
from jaxsafe.evaluate.bounded_worlds import world_at
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.rta import UncertaintyBound
from jaxsafe.rta.tube import errors_after_delay
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.transition import advance, bounds, others_later
from jaxsafe.types import Sim

WORLDS: list[dict[str, float]] = [
    {"process": 2.0},
    {"process": 0.5, "position": 5.0, "velocity": 1.0},
    {"position": 20.0, "velocity": 1.0},
]
"""How far the true world may be from the one that the filter knows."""


def across(sim: Sim) -> jax.Array:
    """Return the direction to the left of the wingman's velocity."""
    velocity = sim.platforms["wingman"].velocity
    return jnp.stack([-velocity[1], velocity[0]]) / safe_norm(velocity)


def inward(sim: Sim) -> jax.Array:
    """Return the direction from the wingman to the lead."""
    apart = sim.platforms["lead"].position - sim.platforms["wingman"].position
    return apart / jnp.maximum(safe_norm(apart), 1e-6)


def moved(sim: Sim, position: jax.Array, velocity: jax.Array) -> Sim:
    """Return the simulation with the wingman moved, and changed in velocity."""
    own = sim.platforms["wingman"]
    before = own.velocity
    after = before + velocity
    turn = jnp.arctan2(before[0] * after[1] - before[1] * after[0], jnp.sum(before * after))
    own = own.replace(
        position=own.position + position, heading=own.heading + turn, speed=safe_norm(after)
    )
    return sim.replace(platforms={**sim.platforms, "wingman": own})


def measured(sim: Sim, bound: UncertaintyBound, direction: jax.Array) -> Sim:
    return moved(sim, bound.position * direction, bound.velocity * direction)


def true_step(
    env: Any, sim: Sim, control: jax.Array, bound: UncertaintyBound, direction: jax.Array
) -> Sim:
    """Return the simulation after a step with a disturbance in a direction."""
    push = bound.process * direction
    return moved(advance(env, sim, control), 0.5 * env.dt**2 * push, env.dt * push)


def bare(sim: Sim) -> Sim:
    return sim.replace(regions={}, status={})


def distance(sim: Sim) -> jax.Array:
    return safe_norm(sim.platforms["lead"].position - sim.platforms["wingman"].position)


def robust(world: dict[str, float], **overrides: Any) -> Any:
    numbers = {"rta.bound.process": 0.0} | {f"rta.bound.{name}": x for name, x in world.items()}
    return jaxsafe.make("rejoin2d", numbers | overrides, rta="robust")


class Ways(NamedTuple):
    """A flown way beside the predicted one, [episode, step]."""

    apart: Any  # the distance between the two [ft]
    faster: Any  # the length of the difference of the velocities [ft/s]
    radius: Any  # of the tube [ft]
    speed: Any  # of the tube [ft/s]
    least: Any  # the least predicted distance from the lead, less the tube's radius [ft]


@partial(jax.jit, static_argnames="random")
def ways(env: Any, sims: Sim, controls: jax.Array, keys: jax.Array, random: bool) -> Ways:
    """Follow the first backup controller from measured states, after a step of some controls."""
    backup = env.rta.backups[0]
    bound = env.rta.bound
    low, high = bounds(env)

    def episode(sim: Sim, control: jax.Array, key: jax.Array) -> Ways:
        def direction(sim: Sim, key: jax.Array) -> jax.Array:
            angle = 2.0 * jnp.pi * jax.random.uniform(key)
            drawn = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
            return drawn if random else jnp.sign(control[0]) * across(sim)

        key, key_seen, key_step = jax.random.split(key, 3)
        seen = measured(sim, bound, -direction(sim, key_seen))
        predicted = advance(env, seen, control)
        tube = backup.first_tube(env, seen, predicted, bound)
        true = true_step(env, sim, control, bound, direction(sim, key_step))

        def one_step(carry: Any, key: jax.Array) -> Any:
            true, predicted, tube = carry
            key_seen, key_step = jax.random.split(key)
            own = predicted.platforms["wingman"]
            flown = true.platforms["wingman"]
            ways = Ways(
                apart=safe_norm(flown.position - own.position),
                faster=safe_norm(flown.velocity - own.velocity),
                radius=tube.position,
                speed=tube.velocity(own.speed),
                least=distance(predicted) - tube.position,
            )
            later = others_later(env, true)
            seen = measured(true, bound, -direction(true, key_seen))
            acts = [
                jnp.clip(backup.control(env, sim, later), low, high) for sim in (seen, predicted)
            ]
            after = bare(advance(env, predicted, acts[1]))
            tube = backup.next_tube(env, predicted, after, bound, tube)
            true = bare(true_step(env, true, acts[0], bound, direction(true, key_step)))
            return (true, after, tube), ways

        return jax.lax.scan(
            one_step, (bare(true), bare(predicted), tube), jax.random.split(key, 45)
        )[1]

    return jax.vmap(episode)(sims, controls, keys)


def beside(env: Any, key: jax.Array, near: bool, count: int) -> Sim:
    """Draw simulations with the wingman anywhere about the lead, or in formation close to it."""
    state, _ = jax.vmap(partial(jaxsafe.reset, env.replace(rta=None)))(jax.random.split(key, count))
    sim = bare(state.sim)
    lead = sim.platforms["lead"]
    shares = jax.random.uniform(key, (4, count))
    far = 105.0 + jnp.where(near, 80.0, 2000.0) * shares[0]
    angle = 2.0 * jnp.pi * shares[1]
    own = sim.platforms["wingman"].replace(
        position=lead.position + far[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1),
        heading=lead.heading - jnp.where(near, 0.1 * (shares[2] - 0.5), 6.0 * shares[2] - 0.4),
        speed=jnp.where(near, lead.speed + 8.0 * (shares[3] - 0.5), 200.0 + 200.0 * shares[3]),
    )
    return sim.replace(platforms={**sim.platforms, "wingman": own})


@pytest.mark.thorough
@pytest.mark.parametrize("random", [False, thorough(True)])
@pytest.mark.parametrize("near", [False, thorough(True)])
def test_a_tube_holds_every_way_that_is_flown_along_a_backup(near: bool, random: bool) -> None:
    key = jax.random.key(0)
    for world, turn in zip(WORLDS, (0.0, 0.05, -0.05), strict=True):
        env = robust(world, **{"lead.controller.commands.heading_rate.at": turn})
        sims = beside(env, key, near, 256)
        low, high = bounds(env)
        controls = low + (high - low) * jax.random.uniform(key, (256, 2))
        flown = ways(env, sims, controls, jax.random.split(key, 256), random)
        apart, faster, radius, speed, least = map(np.asarray, flown)
        # A certificate asks for 101 ft all the way.
        known = np.minimum.accumulate(least, axis=1) >= 101.0
        assert known[:, 0].mean() > 0.5
        assert np.all(apart[known] <= 1.001 * radius[known] + 0.05)
        assert np.all(faster[known] <= 1.001 * speed[known] + 0.01)
        if not random and not near:  # the tube is hardly wider than it must be
            assert np.max((apart / radius)[known]) > 0.8


@jax.jit
def least_distances(env: Any, sims: Sim, shares: jax.Array) -> jax.Array:
    """Return how near the lead gets while the backup acts, from shares of the terminal set."""
    bound = env.rta.bound
    low, high = bounds(env)
    terminal = env.rta.terminal
    backup = env.rta.backups[0]

    def least(sim: Sim, share: jax.Array) -> jax.Array:
        lead = sim.platforms["lead"]
        closing = share * 0.99 * terminal.tolerance
        direction = inward(sim)
        own = sim.platforms["wingman"].replace(
            position=lead.position - (terminal.clearance + terminal.drift * closing) * direction,
            heading=lead.heading,
            speed=lead.speed,
        )
        sim = sim.replace(platforms={**sim.platforms, "wingman": own})
        sim = moved(sim, jnp.zeros(2), closing * direction)

        def one_step(sim: Sim, _: None) -> tuple[Sim, jax.Array]:
            seen = measured(sim, bound, -inward(sim))
            control = jnp.clip(backup.control(env, seen, others_later(env, sim)), low, high)
            middle = true_step(env.replace(dt=0.5 * env.dt), sim, control, bound, inward(sim))
            sim = bare(true_step(env, sim, control, bound, inward(sim)))
            return sim, jnp.minimum(distance(middle), distance(sim))

        return jnp.min(jax.lax.scan(one_step, sim, length=150)[1])

    return jax.vmap(least)(sims, shares)


@pytest.mark.thorough
@pytest.mark.parametrize("world", [*WORLDS[:2], *map(thorough, [WORLDS[2], {"process": 3.3}])])
def test_the_widened_terminal_set_is_never_left_to_the_lead(world: dict[str, float]) -> None:
    """A wingman at its edge is pushed towards the lead while the backup acts, for 150 s."""
    env = robust(world)
    sims = beside(env, jax.random.key(1), near=True, count=128)
    assert np.min(least_distances(env, sims, jnp.linspace(0.0, 1.0, 128))) >= 101.0


def pursue(env: Any, sim: Sim, key: jax.Array) -> jax.Array:
    """Return a turn straight at the lead, at full thrust."""
    aim = inward(sim)
    ahead = jnp.stack([across(sim)[1], -across(sim)[0]])
    turn = jnp.arctan2(jnp.sum(across(sim) * aim), jnp.sum(ahead * aim))
    low, high = bounds(env)
    return jnp.clip(jnp.stack([turn / env.dt, 1e3]), low, high)


@partial(jax.jit, static_argnames=("policy", "num_steps"))
def flights(
    env: Any, bound: UncertaintyBound, keys: jax.Array, policy: str, num_steps: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    act = {"pursue": pursue, **ADVERSARIES}[policy]

    def episode(key: jax.Array) -> Any:
        sim = bare(jaxsafe.reset(env.replace(rta=None), key)[0].sim)
        memory, start = env.rta.begin(env, measured(sim, bound, -inward(sim)))

        def one_step(carry: Any, key: jax.Array) -> Any:
            sim, memory = carry
            control = act(env, sim, key)
            seen = measured(sim, bound, -inward(sim))
            control, memory, info = env.rta.filter(env, seen, memory, control)
            sim = bare(true_step(env, sim, control, bound, inward(sim)))
            return (sim, memory), (distance(sim), info.certified)

        _, flown = jax.lax.scan(one_step, (sim, memory), jax.random.split(key, num_steps))
        return *flown, start.certified

    return jax.vmap(episode)(keys)


def collisions(
    env: Any, world: dict[str, float], policy: str, num_steps: int = 120
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distances, whether steps were certified, and whether the starts were.

    All worlds share a program for each policy.
    """
    bound = UncertaintyBound(
        process=jnp.asarray(world.get("process", 0.0)),
        position=jnp.asarray(world.get("position", 0.0)),
        velocity=jnp.asarray(world.get("velocity", 0.0)),
    )
    keys = jax.random.split(jax.random.key(0), 32)
    distances, certified, starts = flights(env, bound, keys, policy, num_steps)
    return np.asarray(distances), np.asarray(certified), np.asarray(starts)


@pytest.mark.thorough
def test_without_a_bound_a_disturbance_of_2_ft_per_s_leads_to_collisions() -> None:
    env = jaxsafe.make("rejoin2d", rta="default")
    distances, certified, starts = collisions(env, WORLDS[0], "pursue")
    assert starts.all()
    assert np.mean(distances.min(axis=1) < 100.0) > 0.2
    assert np.any(certified & (distances < 100.0))


@pytest.mark.parametrize(
    ("world", "policy"),
    [
        thorough(WORLDS[0], "pursue"),
        *(thorough(world, policy) for world in WORLDS for policy in ("intercept", "head_on")),
    ],
)
def test_within_the_bound_there_is_no_collision(world: dict[str, float], policy: str) -> None:
    distances, certified, starts = collisions(robust(world), world, policy)
    assert starts.all()
    assert certified.all()
    assert np.min(distances) >= 101.0
    assert np.median(distances.min(axis=1)) < 300.0  # the agent did come close


@pytest.mark.thorough
def test_a_known_delay_does_no_harm_and_an_unknown_one_leads_to_collisions() -> None:
    env = robust({"process": 0.5, "delay": 2})
    world = world_at(env, 1.0)
    counts = attack(world, "intercept", 120, 32, jax.random.key(0))
    assert counts["violating_steps"] == counts["violating_steps_inside"] == 0
    assert counts["uncertified_steps"] == 0
    assert counts["unsafe_starts"] == 0.0
    assert counts["intervention_rate"] > 0.05  # the agent did come close
    unknown = override(world, {"rta.bound.delay": 0})
    counts = attack(unknown, "intercept", 120, 32, jax.random.key(0))
    assert counts["violating_steps"] > 0


@pytest.mark.thorough
def test_errors_after_a_delay_hold_whatever_controls_are_under_way() -> None:
    env = robust({"process": 0.1, "position": 0.5, "velocity": 0.1, "delay": 3})
    bound = env.rta.bound
    errors = errors_after_delay(env, bound)
    key = jax.random.key(0)
    sims = beside(env, key, near=False, count=512)
    low, high = bounds(env)

    @jax.jit
    @jax.vmap
    def apart(sim: Sim, controls: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        angle = 2.0 * jnp.pi * jax.random.uniform(key, (2,))
        seen, push = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        predicted = measured(sim, bound, seen)
        for control in controls:
            sim = true_step(env, bare(sim), control, bound, push)
            predicted = advance(env, bare(predicted), control)
        true, known = (state.platforms["wingman"] for state in (sim, predicted))
        return safe_norm(true.position - known.position), safe_norm(true.velocity - known.velocity)

    drawn = jax.random.uniform(key, (512, 3, 2))
    controls = low + (high - low) * jnp.where(drawn > 0.3, jnp.round(drawn), drawn)
    position, velocity = apart(sims, controls, jax.random.split(key, 512))
    assert 0.4 * errors.position < jnp.max(position) <= errors.position + 0.01
    assert 0.4 * errors.velocity < jnp.max(velocity) <= errors.velocity + 0.001


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"rta.bound.process": 3.4}, "rta.bound is larger than velocity_matched is proved for"),
        ({"rta.bound.mass": 0.1}, "rta.bound.mass is not proved for aircraft"),
        ({"rta.bound.misalignment": 0.1}, "rta.bound.misalignment is not proved for aircraft"),
        ({"rta.bound.delay": 2}, "rta.bound is larger than velocity_matched is proved for"),
        ({"rta.backups.left.dead_zone": 0.05}, "rta.bound: dead_zone of match_velocity"),
        ({"rta.backups.left.clearance": 110}, "rta.bound: clearance of match_velocity"),
        ({"rta.terminal.tolerance": 4}, "rta.bound: tolerance of velocity_matched"),
        (
            {"rta.terminal.clearance": 101.5, "rta.bound.process": 2},
            "rta.bound: clearance of velocity_matched is too small",
        ),
        (
            {"lead.controller.commands.heading_rate.at": 0.15},
            "rta.bound: 'lead' may turn faster than the agent can copy within it",
        ),
    ],
)
def test_a_bound_that_is_not_proved_is_refused(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        jaxsafe.make("rejoin2d", overrides, rta="robust")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("delay", "process"), [(1, 1.6), (2, 0.86), (3, 0.49), (4, 0.29), (5, 0.18), (6, 0.11)]
)
def test_the_largest_push_with_a_delay_is_what_the_page_says(delay: int, process: float) -> None:
    numbers = {"rta.bound.process": process, "rta.bound.delay": delay}
    assert jaxsafe.make("rejoin2d", numbers, rta="robust").rta is not None
    with pytest.raises(ConfigError, match=r"rta\.bound is larger than velocity_matched is proved"):
        jaxsafe.make("rejoin2d", numbers | {"rta.bound.process": 1.1 * process}, rta="robust")


def test_a_certificate_with_a_bound_is_not_renewed() -> None:
    env = jaxsafe.make("rejoin2d", rta="robust")
    state, timestep = jaxsafe.reset(env, jax.random.key(0))
    assert timestep.info.rta is not None
    assert timestep.info.rta.certified
    assert state.memory.rta.ahead == {}
