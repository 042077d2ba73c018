"""Statuses, constraints, ends, rewards and observations against numbers worked out by hand from Tables 5 to 10."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsafe
from jaxsafe.component import normalise
from jaxsafe.environment import Environment
from jaxsafe.processors.constraint import SpeedLimit
from jaxsafe.processors.observation import Observe, ObserveStatus
from jaxsafe.processors.reward import DeltaVCost, DistanceChange, Failure, Success, VelocityConstraint
from jaxsafe.processors.status import DeltaV, Distance, InRegion, Speed, VelocityLimit
from jaxsafe.processors.terminal import Crashed, Docked, Timeout, TooFar
from jaxsafe.simulation.cwh import SpacecraftState
from jaxsafe.simulation.geometry import Circle
from jaxsafe.types import Sim, State, TimeStep

N = 0.001027
OUTCOMES = ("success", "crash", "distance", "timeout", "velocity")
SPEEDS = {"speed": "speed", "velocity_limit": "velocity_limit"}
REST = jnp.zeros(2)

step = jax.jit(jaxsafe.step)


@pytest.fixture(scope="module")
def env() -> Environment:
    return jaxsafe.make("docking2d")


def world(*, time: float = 0.0, ended: str | None = None, **status: Any) -> Sim:
    """A world with chosen statuses; the deputy at (3, 4) m with (0.6, −0.8) m/s after a Δv of (0.03, −0.04) m/s."""
    deputy = SpacecraftState(jnp.asarray([3.0, 4.0]), jnp.asarray([0.6, -0.8]), jnp.asarray([0.03, -0.04]))
    platforms = {"chief": SpacecraftState(REST, REST, REST), "deputy": deputy}
    region = normalise(Circle(name="region", on="chief", radius=5.0))
    return Sim(
        time=jnp.asarray(time),
        platforms=platforms,
        regions={"region": region.place(platforms)},
        status={name: jnp.asarray(value) for name, value in status.items()},
        ended={name: jnp.asarray(name == ended) for name in OUTCOMES},
    )


def start(env: Environment, position: tuple[float, ...], velocity: tuple[float, ...]) -> State:
    return jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": velocity}})[0]


def run(env: Environment, state: State, action: tuple[float, ...], num_steps: int) -> list[TimeStep]:
    timesteps = []
    for _ in range(num_steps):
        state, timestep = step(env, state, jnp.asarray(action))
        timesteps.append(timestep)
    return timesteps


def outcome(env: Environment, timestep: TimeStep) -> str:
    return env.outcomes[int(timestep.info.outcome)]


# Statuses


def test_distance_is_the_norm_of_the_offset() -> None:
    assert Distance(name="d", of="deputy", to="chief").process((), world()) == 5.0
    assert Distance(name="d", of="deputy", to="deputy").process((), world()) == 0.0


def test_speed_is_the_norm_of_the_velocity() -> None:
    assert Speed(name="s", of="deputy").process((), world()) == 1.0


def test_in_region_reads_the_region_and_the_boundary_is_inside() -> None:
    assert InRegion(name="i", of="deputy", region="region").process((), world())
    outside = world().replace(platforms={**world().platforms, "deputy": SpacecraftState(jnp.full(2, 4.0), REST, REST)})
    region = normalise(Circle(name="region", on="chief", radius=5.0)).place(outside.platforms)
    assert not InRegion(name="i", of="deputy", region="region").process((), outside.replace(regions={"region": region}))


def test_the_speed_limit_grows_by_twice_the_mean_motion_per_metre() -> None:
    limit = normalise(VelocityLimit(name="v", distance="d", floor=0.2, slope=2 * N))
    assert limit.process((), world(d=0.0)) == np.float32(0.2)
    assert float(limit.process((), world(d=0.5))) == pytest.approx(0.201027, rel=1e-6)
    assert float(limit.process((), world(d=100.0))) == pytest.approx(0.4054, rel=1e-6)


def test_delta_v_is_the_norm_of_the_velocity_change_bought_with_thrust() -> None:
    assert float(DeltaV(name="d", of="deputy").process((), world())) == pytest.approx(0.05)
    assert float(DeltaV(name="d", of="deputy", norm="l1").process((), world())) == pytest.approx(0.07)


# Constraints


@pytest.mark.parametrize(("speed", "margin"), [(0.1, 0.15), (0.25, 0.0), (0.5, -0.25)])
def test_the_margin_is_the_limit_minus_the_speed(speed: float, margin: float) -> None:
    constraint = SpeedLimit(name="c", **SPEEDS)
    sim = world(speed=speed, velocity_limit=0.25)
    assert float(constraint.margin(sim)) == pytest.approx(margin, abs=1e-7)
    assert constraint.limit(sim) == 0.25


# Ends


@pytest.mark.parametrize(
    ("in_docking", "speed", "docked", "crashed"),
    [
        (True, 0.1, True, False),
        (True, 0.25, True, False),
        (True, float(np.nextafter(np.float32(0.25), np.float32(1.0))), False, True),
        (True, 3.0, False, True),
        (False, 0.1, False, False),
        (False, 3.0, False, False),
    ],
)
def test_at_the_chief_the_speed_decides_and_the_limit_itself_is_allowed(
    in_docking: bool, speed: float, docked: bool, crashed: bool
) -> None:
    sim = world(in_docking=in_docking, speed=speed, velocity_limit=0.25)
    assert Docked(name="x", in_docking="in_docking", **SPEEDS).reached(sim) == docked
    assert Crashed(name="x", in_docking="in_docking", **SPEEDS).reached(sim) == crashed


def test_too_far_is_strictly_above_the_limit() -> None:
    too_far = normalise(TooFar(name="x", distance="d", limit=40_000.0))
    assert not too_far.reached(world(d=40_000.0))
    assert too_far.reached(world(d=40_000.01))


def test_timeout_is_strictly_after_the_limit() -> None:
    timeout = normalise(Timeout(name="x", limit=2000.0))
    assert not timeout.reached(world(time=2000.0))
    assert timeout.reached(world(time=2001.0))


# Rewards


def test_the_distance_reward_is_twice_the_change_of_the_exponential_potential() -> None:
    reward = normalise(DistanceChange(name="x", distance="d", half_distance=100.0, scale=2.0))
    memory = reward.init(world(d=200.0))
    assert reward.process(memory, world(d=200.0)) == 0.0
    memory = reward.increment(memory, world(d=100.0), 1.0)
    assert float(reward.process(memory, world(d=100.0))) == pytest.approx(2 * (0.5 - 0.25))
    memory = reward.increment(memory, world(d=0.0), 1.0)
    assert float(reward.process(memory, world(d=0.0))) == pytest.approx(2 * (1.0 - 0.5))
    memory = reward.increment(memory, world(d=300.0), 1.0)
    assert float(reward.process(memory, world(d=300.0))) == pytest.approx(2 * (0.125 - 1.0))


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(0.0, 1000.0), min_size=2, max_size=20))
def test_the_distance_reward_telescopes(distances: list[float]) -> None:
    reward = normalise(DistanceChange(name="x", distance="d", half_distance=100.0, scale=2.0))
    memory, total = reward.init(world(d=distances[0])), 0.0
    for distance in distances[1:]:
        memory = reward.increment(memory, world(d=distance), 1.0)
        total += float(reward.process(memory, world(d=distance)))
    ends = 2.0 * (0.5 ** (distances[-1] / 100.0) - 0.5 ** (distances[0] / 100.0))
    assert total == pytest.approx(ends, abs=1e-5)


@pytest.mark.parametrize(("speed", "value"), [(0.2, 0.0), (0.25, 0.0), (0.75, -0.015), (10.25, -0.11)])
def test_the_velocity_reward_is_paid_only_above_the_limit(speed: float, value: float) -> None:
    reward = normalise(VelocityConstraint(name="x", offset=-0.01, scale=-0.01, **SPEEDS))
    assert float(reward.process((), world(speed=speed, velocity_limit=0.25))) == pytest.approx(value, rel=1e-6)


def test_the_delta_v_reward_is_a_hundredth_of_delta_v() -> None:
    reward = normalise(DeltaVCost(name="x", delta_v="dv", scale=-0.01))
    assert float(reward.process((), world(dv=0.25))) == pytest.approx(-0.0025)


def test_success_pays_more_the_sooner_and_only_for_its_outcome() -> None:
    reward = normalise(Success(name="x", outcome="success", value=2.0, time_scale=2000.0))
    assert reward.process((), world(time=500.0, ended="success")) == 1.75
    assert reward.process((), world(time=2000.0, ended="success")) == 1.0
    assert reward.process((), world(time=500.0)) == 0.0
    assert reward.process((), world(time=500.0, ended="crash")) == 0.0


@pytest.mark.parametrize(
    ("ended", "value"), [("crash", -1.0), ("timeout", -3.0), ("velocity", 0.0), ("success", 0.0), (None, 0.0)]
)
def test_failure_pays_by_outcome(ended: str | None, value: float) -> None:
    reward = normalise(Failure(name="x", values={"crash": -1.0, "timeout": -3.0, "velocity": 0.0}))
    assert reward.process((), world(ended=ended)) == value


# Observations


def test_an_observation_is_divided_by_its_scale_and_then_clipped() -> None:
    plain = normalise(Observe(name="x", of="deputy", what="position", scale=2.0))
    np.testing.assert_allclose(plain.process((), world()), [1.5, 2.0])
    clipped = normalise(Observe(name="x", of="deputy", what="velocity", scale=0.5, clip=(-1.0, 1.0)))
    np.testing.assert_allclose(clipped.process((), world()), [1.0, -1.0])
    scaled = normalise(Observe(name="x", of="deputy", what="velocity", scale=-2.0))
    np.testing.assert_allclose(scaled.process((), world()), [-0.3, 0.4])


def test_a_status_is_observed_as_a_number() -> None:
    observed = normalise(ObserveStatus(name="x", status="s", scale=4.0)).process((), world(s=True))
    assert observed.dtype == jnp.float32
    assert observed.tolist() == [0.25]


def test_every_element_of_an_observation_has_a_name() -> None:
    assert Observe(name="x", of="deputy", what="position").labels(world()) == ("deputy.position.x", "deputy.position.y")
    assert ObserveStatus(name="x", status="s").labels(world(s=1.0)) == ("status.s",)


# The docking tasks


def test_a_docking_step_pays_what_table_8_says(env: Environment) -> None:
    (timestep,) = run(env, start(env, (200.0, 0.0), (-0.4, 0.3)), (0.6, -0.8), 1)
    info = timestep.info
    distance, speed = float(info.status["docking_distance"]), float(info.status["speed"])
    assert float(info.status["velocity_limit"]) == pytest.approx(0.2 + 2 * N * distance, rel=1e-6)
    assert float(info.status["delta_v"]) == pytest.approx(1.0 / 12.0, rel=1e-6)
    assert float(info.status["delta_v_l1"]) == pytest.approx(1.4 / 12.0, rel=1e-6)
    assert speed < 0.2 + 2 * N * distance
    expected = {
        "distance_change": 2 * (0.5 ** (distance / 100) - 0.5**2),
        "velocity_constraint": 0.0,
        "delta_v": -0.01 / 12.0,
        "success": 0.0,
        "failure": 0.0,
    }
    assert {name: float(term) for name, term in info.reward_terms.items()} == pytest.approx(expected, abs=2e-7)
    assert float(timestep.reward) == pytest.approx(sum(expected.values()), abs=2e-7)
    assert timestep.cost == 0.0


def test_the_delta_v_reward_is_of_the_thrust_that_acted(env: Environment) -> None:
    (timestep,) = run(env, start(env, (200.0, 0.0), (0.0, 0.0)), (-30.0, 40.0), 1)
    np.testing.assert_array_equal(timestep.info.control_actual, [-1.0, 1.0])
    assert float(timestep.info.reward_terms["delta_v"]) == pytest.approx(-0.01 * math.sqrt(2.0) / 12.0, rel=1e-6)


def test_a_step_above_the_limit_costs_and_its_severity_is_a_share_of_the_limit(env: Environment) -> None:
    (timestep,) = run(env, start(env, (100.0, 0.0), (0.0, 2.0)), (0.0, 0.0), 1)
    info = timestep.info
    limit, speed = float(info.status["velocity_limit"]), float(info.status["speed"])
    assert timestep.cost == 1.0
    assert float(info.margins["velocity_limit"]) == pytest.approx(limit - speed, rel=1e-6)
    assert float(info.severity["velocity_limit"]) == pytest.approx((speed - limit) / limit, rel=1e-6)
    assert float(info.reward_terms["velocity_constraint"]) == pytest.approx(-0.01 - 0.01 * (speed - limit), rel=1e-6)
    assert outcome(env, timestep) == "running"


def test_docking_slowly_succeeds_and_docking_fast_crashes(env: Environment) -> None:
    (docked,) = run(env, start(env, (0.6, 0.0), (-0.15, 0.0)), (0.0, 0.0), 1)
    assert outcome(env, docked) == "success"
    assert docked.terminated
    assert float(docked.info.reward_terms["success"]) == pytest.approx(2.0 - 1.0 / 2000.0)
    assert docked.info.reward_terms["failure"] == 0.0
    (crashed,) = run(env, start(env, (0.6, 0.0), (-0.3, 0.0)), (0.0, 0.0), 1)
    assert outcome(env, crashed) == "crash"
    assert crashed.terminated
    assert crashed.info.reward_terms["success"] == 0.0
    assert crashed.info.reward_terms["failure"] == -1.0


def test_the_surface_of_the_docking_region_is_inside(env: Environment) -> None:
    for position, inside in (((0.5, 0.0), True), ((0.0, -0.5), True), ((0.50001, 0.0), False)):
        _, timestep = jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": (0.0, 0.0)}})
        assert bool(timestep.info.status["in_docking"]) == inside
        assert outcome(env, timestep) == ("success" if inside else "running")


def test_flying_beyond_forty_kilometres_ends_with_distance(env: Environment) -> None:
    near, far = (run(env, start(env, (0.0, y), (0.0, 0.0)), (0.0, 0.0), 1)[0] for y in (39_999.0, 40_001.0))
    assert (outcome(env, near), outcome(env, far)) == ("running", "distance")
    assert far.info.reward_terms["failure"] == -1.0


def test_a_timeout_ends_the_episode_on_the_step_after_the_limit(env: Environment) -> None:
    short = jaxsafe.override(env, {"terminal.timeout.limit": 3})
    timesteps = run(short, start(short, (100.0, 0.0), (0.0, 0.0)), (0.0, 0.0), 4)
    assert [outcome(short, timestep) for timestep in timesteps] == ["running"] * 3 + ["timeout"]
    assert [bool(timestep.terminated) for timestep in timesteps] == [False] * 3 + [True]
    assert [float(timestep.info.reward_terms["failure"]) for timestep in timesteps] == [0.0] * 3 + [-1.0]


def test_a_timeout_may_be_declared_a_truncation() -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 1, "terminal.timeout.ends": "truncated"})
    assert env.can_truncate
    timesteps = run(env, start(env, (100.0, 0.0), (0.0, 0.0)), (0.0, 0.0), 2)
    assert [bool(timestep.truncated) for timestep in timesteps] == [False, True]
    assert not any(timestep.terminated for timestep in timesteps)
    assert timesteps[1].done
    assert not jaxsafe.make("docking2d").can_truncate


def test_time_counts_steps_times_their_length() -> None:
    env = jaxsafe.make("docking2d", {"dt": 0.5, "terminal.timeout.limit": 1.0})
    timesteps = run(env, start(env, (100.0, 0.0), (0.0, 0.0)), (1.0, 0.0), 3)
    assert [outcome(env, timestep) for timestep in timesteps] == ["running", "running", "timeout"]
    assert float(timesteps[0].info.status["delta_v"]) == pytest.approx(0.5 / 12.0)


# The bound on the velocity reward


def bounded(offset: float, **more: Any) -> Environment:
    """docking2d in which every step above the limit pays `offset` and nothing else."""
    changes = {"reward.velocity_constraint.offset": offset, "reward.velocity_constraint.scale": 0.0}
    return jaxsafe.make("docking2d", changes | more)


def too_fast(env: Environment, num_steps: int) -> list[TimeStep]:
    return run(env, start(env, (100.0, 0.0), (0.0, 5.0)), (0.0, 0.0), num_steps)


def test_the_velocity_bound_ends_the_episode_once_the_sum_is_below_minus_five() -> None:
    env = bounded(-2.0)
    timesteps = too_fast(env, 3)
    assert [outcome(env, timestep) for timestep in timesteps] == ["running", "running", "velocity"]
    assert [bool(timestep.terminated) for timestep in timesteps] == [False, False, True]
    assert timesteps[2].info.reward_totals["velocity_constraint"] == -6.0
    assert timesteps[2].info.reward_terms["failure"] == 0.0


def test_a_sum_of_exactly_minus_five_ends_nothing() -> None:
    env = bounded(-2.5)
    assert [outcome(env, timestep) for timestep in too_fast(env, 3)] == ["running", "running", "velocity"]


def test_the_unchanged_task_reaches_the_bound_when_the_sum_does(env: Environment) -> None:
    timesteps = run(env, start(env, (100.0, 0.0), (0.0, 20.0)), (0.0, 0.0), 30)
    totals = np.cumsum([float(timestep.info.reward_terms["velocity_constraint"]) for timestep in timesteps])
    ended = [outcome(env, timestep) == "velocity" for timestep in timesteps]
    assert ended == [total < -5.0 for total in totals]
    assert 20 < ended.index(True) < 28


def test_a_reward_after_the_bound_sees_the_end() -> None:
    env = bounded(-6.0, **{"reward.failure.values.velocity": -3.0})
    (timestep,) = too_fast(env, 1)
    assert outcome(env, timestep) == "velocity"
    assert timestep.info.reward_terms["failure"] == -3.0
    assert float(timestep.reward - timestep.info.reward_terms["distance_change"]) == pytest.approx(-9.0, rel=1e-6)


def test_a_bound_may_be_a_truncation() -> None:
    env = bounded(-6.0, **{"reward.velocity_constraint.bound.ends": "truncated"})
    (timestep,) = too_fast(env, 1)
    assert timestep.truncated
    assert not timestep.terminated


def test_an_earlier_end_on_the_same_step_is_kept_by_the_bound() -> None:
    env = bounded(-6.0)
    (timestep,) = run(env, start(env, (1.0, 0.0), (-1.0, 0.0)), (0.0, 0.0), 1)
    assert outcome(env, timestep) == "crash"
    assert timestep.info.reward_terms["velocity_constraint"] == -6.0
    assert timestep.info.reward_terms["failure"] == -1.0


# Several ends at once


def test_the_first_end_in_the_list_is_the_outcome() -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 0.5, "terminal.distance.limit": 0.1})
    for expected, x, speed in (("success", 0.4, 0.0), ("crash", 0.4, 0.3), ("distance", 9.0, 0.0)):
        (timestep,) = run(env, start(env, (x, 0.0), (-speed, 0.0)), (0.0, 0.0), 1)
        assert outcome(env, timestep) == expected
    patient = jaxsafe.override(env, {"terminal.distance.limit": 40_000.0})
    assert outcome(patient, run(patient, start(patient, (9.0, 0.0), (0.0, 0.0)), (0.0, 0.0), 1)[0]) == "timeout"


def test_success_with_a_timeout_pays_success_only() -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 0.5})
    (timestep,) = run(env, start(env, (0.4, 0.0), (0.0, 0.0)), (0.0, 0.0), 1)
    assert timestep.info.reward_terms["failure"] == 0.0
    assert float(timestep.info.reward_terms["success"]) == pytest.approx(2.0 - 1.0 / 2000.0)


@settings(deadline=None, max_examples=30)
@given(
    x=st.sampled_from([0.1, 0.6, 100.0, 50_000.0]),
    speed=st.sampled_from([0.0, 0.1, 1.0, 30.0]),
    limit=st.sampled_from([0.5, 2000.0]),
    offset=st.sampled_from([-0.01, -6.0]),
)
def test_there_is_at_most_one_outcome_and_it_is_the_flag_that_is_set(
    x: float, speed: float, limit: float, offset: float
) -> None:
    env = bounded(offset, **{"terminal.timeout.limit": limit})
    state, timestep = step(env, start(env, (x, 0.0), (-speed, 0.0)), jnp.zeros(2))
    flags = {name: bool(flag) for name, flag in state.sim.ended.items()}
    assert sum(flags.values()) <= 1
    assert flags == {name: name == outcome(env, timestep) for name in env.outcomes[1:]}
    assert bool(timestep.done) == any(flags.values())
    paid = {name: float(timestep.info.reward_terms[name]) for name in ("success", "failure")}
    assert (paid["success"] > 0) == flags["success"]
    assert (paid["failure"] < 0) == (flags["crash"] or flags["distance"] or flags["timeout"])
