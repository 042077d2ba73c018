"""Filters with a bound: what they certify is safe in a world that is not the one they know."""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough
from own_process import check_as_compiled_by_commands

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.envs.docking import BRAKE
from jaxsafe.rta import BackupController, Brake, Cascade, Simplex, Stage, UncertaintyBound
from jaxsafe.schema.dotted_paths import set_path
from jaxsafe.simulation.geometry import safe_norm
from jaxsafe.transition import Others, advance
from jaxsafe.types import Sim, TimeStep

MARGIN = 2.5e-4
"""What the presets keep at samples [m/s]."""

WORLDS = [
    {"process": 0.01},
    {"process": 0.05},
    {"mass": 0.05},
    {"mass": 0.2},
    {"misalignment": 0.05},
    {"misalignment": 0.2},
    {"position": 1.0},
    {"velocity": 0.01},
    {
        "process": 0.003,
        "mass": 0.05,
        "misalignment": 0.03,
        "position": 0.5,
        "velocity": 0.003,
    },
]
"""How the true world differs from the one that the filter knows, at most."""

PARTS = (0.25, 0.5, 0.75, 1.0)
"""Instants of a step at which h is looked at, as shares of it."""


def unit(vector: jax.Array) -> jax.Array:
    return vector / jnp.maximum(safe_norm(vector), 1e-9)


def turned(control: jax.Array, towards: jax.Array, angle: Any) -> jax.Array:
    """Return a control that is turned by an angle towards a direction."""
    along = unit(control)
    across = unit(towards - jnp.sum(towards * along) * along)
    return safe_norm(control) * (jnp.cos(angle) * along + jnp.sin(angle) * across)


def moved(env: Environment, sim: Sim, position: jax.Array, velocity: jax.Array) -> Sim:
    """Return the simulation with the agent moved, and changed in velocity."""
    own = sim.platforms[env.agent]
    own = own.replace(position=own.position + position, velocity=own.velocity + velocity)
    return sim.replace(platforms={**sim.platforms, env.agent: own})


def measured(env: Environment, sim: Sim, world: UncertaintyBound) -> Sim:
    """Return what is measured if all errors hide as much of h as they can."""
    own = sim.platforms[env.agent]
    return moved(
        env, sim, world.position * unit(own.position), -world.velocity * unit(own.velocity)
    )


def true_step(env: Any, sim: Sim, control: jax.Array, world: UncertaintyBound) -> Sim:
    """Return the simulation after a step of a world that takes as much of h as it can."""
    mass = env.agent_platform.mass * (1.0 - world.mass)
    lighter = set_path(env, f"{env.agent}.mass", mass)
    faster = unit(advance(env, sim, control).platforms[env.agent].velocity)
    sim = advance(lighter, sim, turned(control, faster, world.misalignment))
    acceleration = world.process * faster
    return moved(env, sim, 0.5 * env.dt**2 * acceleration, env.dt * acceleration)


def inward(sim: Sim) -> jax.Array:
    return -unit(sim.platforms["deputy"].position)


def along_velocity(sim: Sim) -> jax.Array:
    return unit(sim.platforms["deputy"].velocity)


def stacked(worlds: list[dict[str, float]], times: float = 1.0) -> UncertaintyBound:
    """Return several bounds in one, each number `times` as large."""
    names = ("process", "mass", "misalignment", "position", "velocity")
    numbers = {name: [times * world.get(name, 0.0) for world in worlds] for name in names}
    arrays: dict[str, Any] = {name: jnp.array(values) for name, values in numbers.items()}
    return UncertaintyBound(**arrays)


class Flights(NamedTuple):
    """What happened on all steps: arrays [world, episode, step] and [world, episode]."""

    h: Any  # at the end of the step
    inside: Any  # the least at the `PARTS` of the step
    certified: Any
    start: Any  # whether the start was certified


@partial(jax.jit, static_argnames=("policy", "num_steps", "delay", "known"))
def flown(
    env: Any,
    bounds: UncertaintyBound,
    worlds: UncertaintyBound,
    keys: jax.Array,
    policy: Callable[[Sim], jax.Array],
    num_steps: int,
    delay: int,
    known: int,
) -> Flights:
    def episode(bound: UncertaintyBound, world: UncertaintyBound, key: jax.Array) -> Flights:
        rta = env.rta.replace(bound=bound.replace(delay=known))
        sim = jaxsafe.reset(env.replace(rta=None), key)[0].sim.replace(regions={}, status={})
        memory, start = rta.begin(env, measured(env, sim, world))

        def one_step(carry: Any, _: None) -> Any:
            sim, memory, queue = carry
            chosen, memory, info = rta.filter(env, measured(env, sim, world), memory, policy(sim))
            queue = jnp.concatenate([queue, chosen[None]])
            control, queue = queue[0], queue[1:]

            def h_at(part: jax.Array) -> jax.Array:
                later = true_step(env.replace(dt=part * env.dt), sim, control, world)
                return rta.lowest(env, later, later)

            h = jax.vmap(h_at)(jnp.array(PARTS))
            after = (true_step(env, sim, control, world), memory, queue)
            return after, (h[-1], h.min(), info.certified)

        queue = jnp.zeros((delay, env.action_size))
        _, steps = jax.lax.scan(one_step, (sim, memory, queue), length=num_steps)
        return Flights(*steps, start=start.certified)

    many = jax.vmap(jax.vmap(episode, in_axes=(None, None, 0)), in_axes=(0, 0, None))
    return many(bounds, worlds, keys)


def fly(
    env: Any,
    bounds: UncertaintyBound,
    worlds: UncertaintyBound,
    policy: Callable[[Sim], jax.Array],
    num_steps: int = 150,
    delay: int = 0,
    known_delay: int | None = None,
) -> Flights:
    """Fly eight episodes in each of some worlds. Environments of one structure share a program.

    Args:
        env: the environment, with a filter.
        bounds: what the filter is told in each world.
        worlds: how far each world differs from what the filter knows.
        policy: what the agent asks for.
        num_steps: number of steps of an episode. It does not end before.
        delay: the number of steps after which a control acts.
        known_delay: what the filter is told of it. None stands for the truth.
    """
    keys = jax.random.split(jax.random.key(0), 8)
    known = delay if known_delay is None else known_delay
    return jax.tree.map(
        np.asarray, flown(env, bounds, worlds, keys, policy, num_steps, delay, known)
    )


@pytest.mark.parametrize(
    ("task", "preset", "changes"),
    [
        ("docking2d", "default", {}),
        thorough("docking3d", "default", {}),
        thorough("docking3d", "default", {"rta.gamma": 0.5}),
        thorough("docking2d", "explicit_simplex", {}),
        thorough("docking1d", "default", {}),
        thorough("docking2d", "default", {"dt": 3}),
        thorough("docking3d", "default", {"deputy.start.position.distance": [8000, 9000]}),
    ],
)
def test_whatever_is_certified_is_safe_within_the_bound_and_not_beyond(
    task: str, preset: str, changes: dict[str, Any]
) -> None:
    env = jaxsafe.make(task, changes, rta=preset)
    told = [stacked(WORLDS), stacked(WORLDS, 0.0), stacked(WORLDS)]
    true = [stacked(WORLDS), stacked(WORLDS), stacked(WORLDS, 2.0)]
    join = partial(jax.tree.map, lambda *parts: jnp.concatenate(parts))
    flights = fly(env, join(*told), join(*true), inward)
    within, untold, beyond = (
        Flights(*(np.split(part, 3)[index] for part in flights)) for index in range(3)
    )
    least = np.where(within.certified, within.h, np.inf).min(axis=(1, 2))
    assert least.min() >= 0.99 * MARGIN
    assert within.inside[within.certified].min() >= 0.0
    if "deputy.start.position.distance" not in changes:  # near the chief nothing is too far out
        assert within.start.all()
        assert within.certified.all()
    if not changes and preset == "default" and env.action_size > 1:
        exact = [index for index, world in enumerate(WORLDS) if len(world) == 1]
        assert least[exact].max() < 0.002  # no more is kept than is needed
        assert untold.certified.all()
        assert (untold.h.min(axis=(1, 2)) < 0.0).all()  # the same worlds break a filter without it
        assert (beyond.h.min(axis=(1, 2)) < 0.0).sum() >= 4


@pytest.mark.parametrize(
    ("task", "preset", "delay"),
    [
        thorough("docking1d", "explicit_simplex", 2),
        thorough("docking2d", "default", 2),
        thorough("docking3d", "default", 1),
        thorough("docking2d", "explicit_simplex", 3),
        thorough("docking1d", "default", 5),
    ],
)
def test_a_known_delay_costs_nothing_and_an_unknown_one_breaks_the_limit(
    task: str, preset: str, delay: int
) -> None:
    world = {"process": 0.002, "mass": 0.02, "misalignment": 0.01, "velocity": 0.003}
    env = jaxsafe.make(task, {"rta.bound": {**world, "delay": delay}}, rta=preset)
    worlds = stacked([{}, world])
    flights = fly(env, worlds, worlds, inward, delay=delay)
    certified = flights.certified
    assert certified[..., delay:].all()  # before, what the start had under way may not be
    assert flights.start.mean() > 0.8
    least = np.where(certified, flights.h, np.inf).min(axis=(1, 2))
    assert least.min() >= 0.99 * MARGIN
    assert flights.inside[..., delay + 1 :].min() >= 0.0
    if preset == "default":
        assert least[0] < 1.1 * MARGIN
    unknown = fly(env, worlds, worlds, inward, delay=delay, known_delay=0)
    assert (unknown.h.min(axis=(1, 2)) < -0.01).all()
    assert unknown.certified.mean() > 0.5


@pytest.mark.thorough
def test_a_start_that_no_thrust_would_lead_beyond_the_limit_is_not_certified_with_a_delay() -> None:
    env = jaxsafe.make("docking2d", {"rta.bound": {"delay": 2}}, rta="default")
    # The limit falls by 0.0009 m/s a step, and h is 0.001 m/s at first.
    start = {"position": [0.0, 120.0], "velocity": [0.0, -(0.2 + 0.002054 * 120.0 - 0.001)]}
    state, first = jaxsafe.reset_to(env, {"deputy": start})
    assert first.info.rta is not None
    assert not first.info.rta.certified
    assert state.memory.rta.under_way.controls.shape == (2, 2)
    without = jaxsafe.override(env, {"rta.bound.delay": 0})
    state, first = jaxsafe.reset_to(without, {"deputy": start})
    assert first.info.rta is not None
    assert first.info.rta.certified
    assert state.memory.rta.under_way == ()


@pytest.mark.thorough
def test_a_heavier_craft_and_one_that_pushes_along_its_velocity_are_safe_as_well() -> None:
    env = jaxsafe.make("docking3d", rta="default")
    told = stacked([*WORLDS, {"mass": 0.2}])
    flights = fly(env, told, stacked([*WORLDS, {"mass": -0.2}]), along_velocity)
    assert flights.certified.all()
    assert flights.h.min() >= 0.99 * MARGIN


@pytest.mark.thorough
def test_a_bound_of_nothing_changes_nothing() -> None:
    check_as_compiled_by_commands(a_bound_of_nothing_changes_nothing)


def a_bound_of_nothing_changes_nothing() -> None:
    env: Any = jaxsafe.make("docking2d", rta="default")
    none = jax.tree.map(lambda leaf: leaf[0], stacked([{}]))

    @jax.jit
    @jax.vmap
    def both(key: jax.Array) -> Any:
        state, _ = jaxsafe.reset(env, key)
        desired = jax.random.uniform(key, (2,), minval=-1.0)
        arguments = (env, state.sim, state.memory.rta, desired)
        return env.rta.filter(*arguments), env.rta.replace(bound=none).filter(*arguments)

    plain, bounded = both(jax.random.split(jax.random.key(0), 256))
    jax.tree.map(np.testing.assert_array_equal, plain, bounded)
    assert plain[2].correction.max() > 0.1


@pytest.mark.parametrize(
    ("preset", "bound", "message"),
    [
        (
            "default",
            {"process": 0.3},
            r"rta: margin is not below .* within rta\.bound",
        ),
        ("default", {"mass": 0.5}, r"rta: thrust cannot hold the speed limit within rta\.bound"),
        ("default", {"process": -1}, r"rta\.bound\.process: expected a number .*≥ 0, found -1"),
        ("default", {"mass": 1}, r"rta\.bound\.mass: expected a number in \[0, 1\), found 1"),
        ("default", {"proces": 1}, r"rta\.bound: unknown field 'proces'.*Did you mean 'process'"),
        ("implicit_simplex", {}, r"rta\.bound is proved for brake without a horizon, for"),
        ("explicit_asif", {}, r"rta: a bound needs enforce: true"),
    ],
)
def test_a_bound_that_cannot_be_kept_is_refused_in_one_line(
    preset: str, bound: dict[str, float], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        jaxsafe.make("docking2d", {"rta.bound": bound}, rta=preset)
    assert "\n" not in str(caught.value)


def test_only_the_last_filter_of_a_cascade_may_have_a_delay() -> None:
    """The others do not know which control will act."""
    delayed = Simplex(**BRAKE, bound=UncertaintyBound(delay=1))
    first = Stage(name="first", rta=delayed)
    last = Stage(name="last", rta=Simplex(**BRAKE))
    with pytest.raises(ConfigError, match=r"rta: stage 'first' has a bound.delay, which only the"):
        jaxsafe.make("docking2d", rta=Cascade(stages=(first, last)))
    assert Cascade(stages=(last, first)).problem() is None


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("task", "reason"),
    [
        ("docking2d_oriented", " is proved for brake without a horizon"),
        ("rejoin3d", ": clearance of match_velocity is too small"),
    ],
)
def test_a_bound_is_refused_where_nothing_is_proved_of_it(task: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=rf"^rta\.bound{reason}"):
        jaxsafe.make(task, {"rta.bound": {"process": 0.001}}, rta="default")


class Halt(BackupController, type="halt_of_robust_test"):
    def control(self, env: Environment, sim: Sim, later: Others) -> jax.Array:
        return Brake(name="").control(env, sim, later)


class ProvedHalt(Halt, type="proved_halt_of_robust_test"):
    knows_bound: ClassVar[bool] = True


def test_a_backup_of_ones_own_must_say_that_its_proof_knows_a_bound() -> None:
    bound = {"rta.bound": {"process": 0.001}}
    halt = Simplex(constraints=("velocity_limit",), margin=MARGIN, backups=(Halt(name="halt"),))
    with pytest.raises(ConfigError, match=r"^rta\.bound is proved for brake without a horizon"):
        jaxsafe.make("docking2d", bound, rta=halt)
    proved = halt.replace(backups=(ProvedHalt(name="halt"),))
    assert jaxsafe.make("docking2d", bound, rta=proved).rta is not None


def test_whatever_may_not_be_promised_is_not_certified() -> None:
    """The numbers of a bound change while programs run, so nothing can be refused."""
    env = jaxsafe.make("docking2d", {"rta.bound": {}}, rta="default")
    for name, value, certified in (
        ("process", 0.05, True),
        ("process", 0.25, False),
        ("mass", 0.6, False),
        ("position", 150.0, False),
        ("velocity", 0.19, False),
    ):
        too_much = set_path(env, f"rta.bound.{name}", jnp.asarray(value))
        start = {"position": [0.0, 120.0], "velocity": [0.0, -0.1]}
        info: Any = jaxsafe.reset_to(too_much, {"deputy": start})[1].info
        assert info.rta.certified == certified


def pushing_inward(env: Environment, num_steps: int) -> TimeStep:
    """Return the time steps of 32 episodes in which the agent pushes towards the chief."""

    @jax.jit
    @jax.vmap
    def episode(key: jax.Array) -> TimeStep:
        def one_step(state: Any, _: None) -> Any:
            return jaxsafe.step(env, state, inward(state.sim))

        return jax.lax.scan(one_step, jaxsafe.reset(env, key)[0], length=num_steps)[1]

    return jax.tree.map(np.asarray, episode(jax.random.split(jax.random.key(0), 32)))


def uncertain(task: str, delay: int = 0) -> dict[str, Any]:
    """Return changes to a task, so that its world differs from what a filter knows."""
    thrusters = [f"thrust_{axis}" for axis in "xyz"[: jaxsafe.make(task).action_size]]
    seen = {"type": "navigation", "of": "deputy"}
    late = [{"type": "delay", "name": "late", "steps": delay}] if delay else []
    return {
        "uncertainty": [
            {"type": "bounded", "name": "push", "on": "deputy", "bound": 0.001},
            {"type": "misaligned", "name": "turned", "thrusters": thrusters, "angle": 0.02},
            {**seen, "name": "where", "what": "position", "bound": 0.1},
            {**seen, "name": "how_fast", "what": "velocity", "bound": 0.001},
            *late,
        ],
        "deputy.mass": 11.8,
        "rta.model": {"deputy.mass": 12},
    }


@pytest.mark.parametrize(
    ("task", "delay"),
    [thorough("docking2d", 0), thorough("docking3d", 0), thorough("docking3d", 2)],
)
def test_the_preset_is_safe_in_an_uncertain_environment_within_its_bound(
    task: str, delay: int
) -> None:
    changes = uncertain(task, delay) | {"rta.bound.delay": delay}
    info: Any = pushing_inward(jaxsafe.make(task, changes, rta="robust"), 150).info
    assert info.rta.certified[:, delay:].mean() > 0.99
    assert info.margins["velocity_limit"][info.rta.certified].min() >= 0.99 * MARGIN
    assert info.intervening.mean() > 0.5


@pytest.mark.thorough
@pytest.mark.parametrize("task", ["docking2d", "docking3d"])
def test_the_same_environment_breaks_the_default_filter_while_it_certifies(task: str) -> None:
    timesteps = pushing_inward(jaxsafe.make(task, uncertain(task), rta="default"), 150)
    info: Any = timesteps.info
    assert timesteps.cost[info.rta.certified].mean() > 0.1
