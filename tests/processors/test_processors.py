"""Statuses, constraints, terminal conditions, rewards and observations of Tables 5 to 10.

The expected numbers are worked out by hand.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsafe
from jaxsafe.environment import Environment
from jaxsafe.processors.constraint import Separation, SpeedLimit
from jaxsafe.processors.observation import (
    Observation,
    Observe,
    ObserveAngle,
    ObserveRegion,
    ObserveStatus,
)
from jaxsafe.processors.reward import (
    DeltaVCost,
    DistanceChange,
    Failure,
    FirstTime,
    LogDistanceChange,
    Success,
    VelocityConstraint,
    WhileIn,
)
from jaxsafe.processors.status import (
    DeltaV,
    Distance,
    InRegion,
    RegionDistance,
    Speed,
    TimeHeld,
    VelocityLimit,
)
from jaxsafe.processors.terminal import Crashed, Docked, Held, Holds, Timeout, TooClose, TooFar
from jaxsafe.schema.component import normalise
from jaxsafe.simulation.cwh import SpacecraftState
from jaxsafe.simulation.dubins import Dubins2DState, Dubins3DState
from jaxsafe.simulation.oriented import OrientedState
from jaxsafe.simulation.regions import Circle, Displacement
from jaxsafe.types import Sim, State, TimeStep

N = 0.001027
OUTCOMES = ("success", "crash", "distance", "timeout", "velocity", "diverged")
SPEEDS = {"speed": "speed", "velocity_limit": "velocity_limit"}
REST = jnp.zeros(2)

step = jax.jit(jaxsafe.step)


@pytest.fixture(scope="module")
def env() -> Environment:
    return jaxsafe.make("docking2d")


def world(*, time: float = 0.0, ended: str | None = None, **status: Any) -> Sim:
    """Return a simulation with chosen statuses.

    The deputy is at (3, 4) m with a velocity of (0.6, −0.8) m/s after a Δv of (0.03, −0.04) m/s.
    """
    deputy = SpacecraftState(
        jnp.asarray([3.0, 4.0]), jnp.asarray([0.6, -0.8]), jnp.asarray([0.03, -0.04])
    )
    platforms = {"chief": SpacecraftState(REST, REST, REST), "deputy": deputy}
    region = normalise(Circle(name="region", on="chief", radius=5.0))
    return Sim(
        time=jnp.asarray(time),
        platforms=platforms,
        regions={"region": region.place(platforms)},
        status={name: jnp.asarray(value) for name, value in status.items()},
        ended={name: jnp.asarray(name == ended) for name in OUTCOMES},
        intervening=jnp.asarray(False),
    )


def start(env: Environment, position: tuple[float, ...], velocity: tuple[float, ...]) -> State:
    return jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": velocity}})[0]


def run(
    env: Environment, state: State, action: tuple[float, ...], num_steps: int
) -> list[TimeStep]:
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
    outside = world().replace(
        platforms={**world().platforms, "deputy": SpacecraftState(jnp.full(2, 4.0), REST, REST)}
    )
    region = normalise(Circle(name="region", on="chief", radius=5.0)).place(outside.platforms)
    assert not InRegion(name="i", of="deputy", region="region").process(
        (), outside.replace(regions={"region": region})
    )


def test_the_speed_limit_grows_by_twice_the_mean_motion_per_metre() -> None:
    limit = normalise(VelocityLimit(name="v", distance="d", floor=0.2, slope=2 * N))
    assert limit.process((), world(d=0.0)) == np.float32(0.2)
    assert float(limit.process((), world(d=0.5))) == pytest.approx(0.201027, rel=1e-6)
    assert float(limit.process((), world(d=100.0))) == pytest.approx(0.4054, rel=1e-6)


def test_delta_v_is_the_norm_of_the_velocity_change_bought_with_thrust() -> None:
    assert float(DeltaV(name="d", of="deputy").process((), world())) == pytest.approx(0.05)
    assert float(DeltaV(name="d", of="deputy", norm="l1").process((), world())) == pytest.approx(
        0.07
    )


def test_the_speed_limit_may_begin_to_grow_at_a_distance() -> None:
    limit = normalise(VelocityLimit(name="v", distance="d", floor=0.2, slope=0.1, constant_to=0.5))
    computed = [float(limit.process((), world(d=distance))) for distance in (0.0, 0.5, 1.5)]
    np.testing.assert_allclose(computed, [0.2, 0.2, 0.3], rtol=1e-6)


def test_region_distance_is_from_the_centre() -> None:
    sim = pair()
    assert float(RegionDistance(name="d", of="wingman", region="region").process((), sim)) == 8.0
    assert float(RegionDistance(name="d", of="lead", region="region").process((), sim)) == 3.0


def held_for(inside: str, dt: float = 1.0, **options: bool) -> list[float]:
    """Return the time held at reset and after each step.

    `inside` has a letter for each sample: `1` where the status holds, `0` where it does not.
    """
    status = normalise(TimeHeld(name="t", status="in", **options))
    samples = [world(**{"in": flag == "1"}) for flag in inside]
    memory = status.init(samples[0])
    times = [float(status.process(memory, samples[0]))]
    for sim in samples[1:]:
        memory = status.increment(memory, sim, jnp.asarray(dt))
        times.append(float(status.process(memory, sim)))
    return times


@pytest.mark.parametrize(
    ("inside", "first_sample", "times"),
    [
        ("1111", False, [0, 1, 2, 3]),
        ("1111", True, [0, 1, 2, 3]),
        ("0111", False, [0, 0, 1, 2]),
        ("0111", True, [0, 1, 2, 3]),
        ("110110", False, [0, 1, 0, 0, 1, 0]),
        ("110110", True, [0, 1, 0, 1, 2, 0]),
        ("0000", False, [0, 0, 0, 0]),
        ("1000", True, [0, 0, 0, 0]),
    ],
)
def test_time_held_counts_from_the_sample_on_which_it_became_true(
    inside: str, first_sample: bool, times: list
) -> None:
    assert held_for(inside, first_sample=first_sample) == times


def test_time_held_is_steps_times_their_length_without_drift() -> None:
    assert held_for("1" * 201, dt=0.1)[-1] == np.float32(200) * np.float32(0.1)


# Constraints


@pytest.mark.parametrize(("speed", "margin"), [(0.1, 0.15), (0.25, 0.0), (0.5, -0.25)])
def test_the_margin_is_the_limit_minus_the_speed(speed: float, margin: float) -> None:
    constraint = SpeedLimit(name="c", **SPEEDS)
    sim = world(speed=speed, velocity_limit=0.25)
    assert float(constraint.margin(sim)) == pytest.approx(margin, abs=1e-7)
    assert constraint.limit(sim) == 0.25


def test_separation_is_the_distance_beyond_its_minimum() -> None:
    constraint = normalise(Separation(name="c", distance="d", minimum=100.0))
    assert [float(constraint.margin(world(d=distance))) for distance in (150.0, 100.0, 40.0)] == [
        50.0,
        0.0,
        -60.0,
    ]
    assert constraint.limit(world(d=40.0)) == 100.0


# Terminal conditions


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


@pytest.mark.parametrize(
    ("end", "below", "at", "above"),
    [
        (TooFar(name="x", distance="d", limit=100.0), False, False, True),
        (TooFar(name="x", distance="d", limit=100.0, inclusive=True), False, True, True),
        (TooClose(name="x", distance="d", limit=100.0), True, True, False),
        (TooClose(name="x", distance="d", limit=100.0, inclusive=False), True, False, False),
        (Held(name="x", time="d", duration=100.0), False, True, True),
        (Held(name="x", time="d", duration=100.0, inclusive=False), False, False, True),
    ],
)
def test_a_limit_itself_counts_where_it_is_inclusive(
    end: Any, below: bool, at: bool, above: bool
) -> None:
    built = normalise(end)
    assert [bool(built.reached(world(d=distance))) for distance in (99.9, 100.0, 100.1)] == [
        below,
        at,
        above,
    ]


def test_a_boolean_status_may_end_an_episode() -> None:
    assert Holds(name="x", status="s").reached(world(s=True))
    assert not Holds(name="x", status="s").reached(world(s=False))


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


def test_the_logarithmic_reward_pays_the_same_per_second_at_the_limit_from_anywhere() -> None:
    floor, slope = 0.2, 0.002054
    reward = normalise(LogDistanceChange(name="x", distance="d", offset=floor / slope, scale=2.0))
    for distance in (50.0, 1000.0, 10_000.0):
        memory = reward.init(world(d=distance))
        assert reward.process(memory, world(d=distance)) == 0.0
        nearer = world(d=distance - 20.0 * (floor + slope * distance))
        memory = reward.increment(memory, nearer, 20.0)
        expected = -2.0 * np.log(1.0 - 20.0 * slope)
        assert float(reward.process(memory, nearer)) == pytest.approx(expected, rel=1e-4)


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(0.0, 1000.0), min_size=2, max_size=20))
def test_the_distance_reward_telescopes(distances: list[float]) -> None:
    reward = normalise(DistanceChange(name="x", distance="d", half_distance=100.0, scale=2.0))
    memory = reward.init(world(d=distances[0]))
    total = 0.0
    for distance in distances[1:]:
        memory = reward.increment(memory, world(d=distance), 1.0)
        total += float(reward.process(memory, world(d=distance)))
    ends = 2.0 * (0.5 ** (distances[-1] / 100.0) - 0.5 ** (distances[0] / 100.0))
    assert total == pytest.approx(ends, abs=1e-5)


@pytest.mark.parametrize(
    ("speed", "value"), [(0.2, 0.0), (0.25, 0.0), (0.75, -0.015), (10.25, -0.11)]
)
def test_the_velocity_reward_is_paid_only_above_the_limit(speed: float, value: float) -> None:
    reward = normalise(VelocityConstraint(name="x", offset=-0.01, scale=-0.01, **SPEEDS))
    assert float(reward.process((), world(speed=speed, velocity_limit=0.25))) == pytest.approx(
        value, rel=1e-6
    )


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
    ("ended", "value"),
    [("crash", -1.0), ("timeout", -3.0), ("velocity", 0.0), ("success", 0.0), (None, 0.0)],
)
def test_failure_pays_by_outcome(ended: str | None, value: float) -> None:
    reward = normalise(Failure(name="x", values={"crash": -1.0, "timeout": -3.0, "velocity": 0.0}))
    assert reward.process((), world(ended=ended)) == value


def paid(reward: Any, inside: str) -> list[float]:
    """Return what a reward pays at reset and after each step.

    `inside` has a letter for each sample: `1` where the status holds, `0` where it does not.
    """
    reward = normalise(reward)
    samples = [world(s=flag == "1") for flag in inside]
    memory = reward.init(samples[0])
    values = [float(reward.process(memory, samples[0]))]
    for sim in samples[1:]:
        memory = reward.increment(memory, sim, 1.0)
        values.append(float(reward.process(memory, sim)))
    return values


@pytest.mark.parametrize(
    ("inside", "both_samples", "values"),
    [
        ("00110", False, [0, 0, 2, 2, -4]),
        ("00110", True, [0, 0, 0, 2, -2]),
        ("1110", False, [0, 2, 2, -4]),
        ("1110", True, [0, 2, 2, -4]),
        ("011011100", False, [0, 2, 2, -4, 2, 2, 2, -6, 0]),
        ("011011100", True, [0, 0, 2, -2, 0, 2, 2, -4, 0]),
        ("10", False, [0, 0]),
        ("10", True, [0, 0]),
        ("01010", True, [0, 0, 0, 0, 0]),
    ],
)
def test_while_in_pays_each_step_inside_and_leaving_refunds_exactly(
    inside: str, both_samples: bool, values: list[float]
) -> None:
    assert (
        paid(WhileIn(name="x", status="s", value=2.0, both_samples=both_samples), inside) == values
    )


@settings(deadline=None, max_examples=30)
@given(inside=st.text("01", min_size=1, max_size=15), both_samples=st.booleans())
def test_the_sum_of_while_in_is_never_negative_and_zero_whenever_outside(
    inside: str, both_samples: bool
) -> None:
    values = paid(WhileIn(name="x", status="s", value=0.5, both_samples=both_samples), inside)
    for total, flag in zip(np.cumsum(values), inside, strict=True):
        assert total >= 0.0
        assert flag == "1" or total == 0.0


@pytest.mark.parametrize(
    ("inside", "count_start", "values"),
    [
        ("00101", True, [0, 0, 3, 0, 0]),
        ("00101", False, [0, 0, 3, 0, 0]),
        ("11011", True, [0, 0, 0, 0, 0]),
        ("11011", False, [0, 3, 0, 0, 0]),
        ("10011", True, [0, 0, 0, 0, 0]),
        ("10011", False, [0, 0, 0, 3, 0]),
        ("0000", True, [0, 0, 0, 0]),
    ],
)
def test_first_time_pays_once_an_episode(
    inside: str, count_start: bool, values: list[float]
) -> None:
    assert (
        paid(FirstTime(name="x", status="s", value=3.0, count_start=count_start), inside) == values
    )


# Observations


def test_an_observation_is_divided_by_its_scale_and_then_clipped() -> None:
    plain = normalise(Observe(name="x", of="deputy", what="position", scale=2.0))
    np.testing.assert_allclose(plain.process((), world()), [1.5, 2.0])
    clipped = normalise(
        Observe(name="x", of="deputy", what="velocity", scale=0.5, clip=(-1.0, 1.0))
    )
    np.testing.assert_allclose(clipped.process((), world()), [1.0, -1.0])
    scaled = normalise(Observe(name="x", of="deputy", what="velocity", scale=-2.0))
    np.testing.assert_allclose(scaled.process((), world()), [-0.3, 0.4])


def test_a_status_is_observed_as_a_number() -> None:
    observed = normalise(ObserveStatus(name="x", status="s", scale=4.0)).process((), world(s=True))
    assert observed.dtype == jnp.float32
    assert observed.tolist() == [0.25]


def test_every_element_of_an_observation_has_a_name() -> None:
    assert Observe(name="x", of="deputy", what="position").labels(world()) == ("x.x", "x.y")
    magnorm = Observe(name="v", of="deputy", what="velocity", form="magnorm")
    assert magnorm.labels(world()) == ("v.magnitude", "v.x", "v.y")
    assert Observe(name="h", of="deputy", what="heading").labels(world()) == ("h",)
    assert ObserveAngle(name="a", of="deputy", what="heading").labels(world()) == ("a.cos", "a.sin")
    assert ObserveStatus(name="s", status="s").labels(world(s=1.0)) == ("s",)
    assert ObserveStatus(name="s", status="s").labels(world(s=[1.0, 2.0, 3.0, 4.0])) == (
        "s.0",
        "s.1",
        "s.2",
        "s.3",
    )


def pair() -> Sim:
    """Return a simulation with a wingman, a lead and a region.

    The wingman is at (1, 2) m and flies along y. The lead is at (1, 7) m and flies along −x. The
    region is 3 m above the lead.
    """
    wingman = Dubins2DState(jnp.asarray([1.0, 2.0]), jnp.asarray(jnp.pi / 2), jnp.asarray(4.0))
    lead = Dubins2DState(jnp.asarray([1.0, 7.0]), jnp.asarray(-jnp.pi), jnp.asarray(2.0))
    platforms = {"lead": lead, "wingman": wingman}
    region = normalise(
        Circle(name="region", on="lead", offset=Displacement(by=(0.0, 3.0)), radius=1.0)
    )
    return world().replace(platforms=platforms, regions={"region": region.place(platforms)})


def measured(observation: Observation, sim: Sim) -> np.ndarray:
    return np.asarray(normalise(observation).process((), sim))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, [1.0, 7.0]),
        ({"relative_to": "wingman"}, [0.0, 5.0]),
        ({"relative_to": "wingman", "frame": "wingman"}, [5.0, 0.0]),
        ({"relative_to": "wingman", "frame": "lead"}, [0.0, -5.0]),
        ({"relative_to": "wingman", "frame": "wingman", "form": "magnorm"}, [5.0, 1.0, 0.0]),
        (
            {"relative_to": "wingman", "form": "magnorm", "scale": (10.0, 1.0, 4.0)},
            [0.5, 0.0, 0.25],
        ),
        ({"relative_to": "lead", "form": "magnorm"}, [0.0, 0.0, 0.0]),
        ({"relative_to": "wingman", "scale": (1.0, -2.0)}, [0.0, -2.5]),
        ({"relative_to": "wingman", "scale": (1.0, -2.0), "clip": (-1.0, 1.0)}, [0.0, -1.0]),
    ],
)
def test_a_position_is_observed_in_any_frame_and_form(
    options: dict[str, Any], expected: list[float]
) -> None:
    computed = measured(Observe(name="x", of="lead", what="position", **options), pair())
    np.testing.assert_allclose(computed, expected, atol=1e-6)


def test_a_velocity_is_observed_in_any_frame() -> None:
    for options, expected in (
        ({}, [-2.0, 0.0]),
        ({"frame": "lead"}, [2.0, 0.0]),
        ({"frame": "wingman"}, [0.0, 2.0]),
    ):
        computed = measured(Observe(name="x", of="lead", what="velocity", **options), pair())
        np.testing.assert_allclose(computed, expected, atol=1e-6)
    computed = measured(
        Observe(name="x", of="lead", what="velocity", relative_to="wingman"), pair()
    )
    np.testing.assert_allclose(computed, [-2.0, -4.0], atol=1e-6)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, [1.0, 10.0]),
        ({"relative_to": "wingman"}, [0.0, 8.0]),
        ({"relative_to": "wingman", "frame": "wingman"}, [8.0, 0.0]),
        (
            {"relative_to": "wingman", "frame": "wingman", "form": "magnorm", "scale": 2.0},
            [4.0, 0.5, 0.0],
        ),
    ],
)
def test_a_region_is_observed_by_its_centre(options: dict[str, Any], expected: list[float]) -> None:
    computed = measured(ObserveRegion(name="x", region="region", **options), pair())
    np.testing.assert_allclose(computed, expected, atol=1e-6)


def test_an_angle_is_observed_as_cosine_and_sine_and_does_not_jump() -> None:
    angle = ObserveAngle(name="x", of="craft", what="attitude", scale=-1.0)
    for attitude in (0.3, -2.0, math.pi, -math.pi):
        craft = OrientedState(REST, REST, jnp.zeros(1), jnp.asarray(attitude), jnp.zeros(()))
        computed = measured(angle, world().replace(platforms={"craft": craft}))
        np.testing.assert_allclose(computed, [-math.cos(attitude), -math.sin(attitude)], atol=1e-6)


def test_a_body_frame_in_space_takes_heading_flight_path_and_roll_into_account() -> None:
    craft = Dubins3DState(jnp.zeros(3), *map(jnp.asarray, (0.7, 300.0, 0.2, -0.5)))
    below = Dubins3DState(jnp.asarray([0.0, 0.0, -10.0]), *map(jnp.asarray, (0.0, 200.0, 0.0, 0.0)))
    sim = world().replace(platforms={"craft": craft, "below": below})
    ahead = measured(Observe(name="x", of="craft", what="velocity", frame="craft"), sim)
    np.testing.assert_allclose(ahead, [300.0, 0.0, 0.0], atol=1e-3)
    seen = measured(
        Observe(name="x", of="below", what="position", relative_to="craft", frame="craft"), sim
    )
    down = -10.0 * np.array(
        [-math.sin(0.2), math.cos(0.2) * math.sin(-0.5), math.cos(0.2) * math.cos(-0.5)]
    )
    np.testing.assert_allclose(seen, down, atol=1e-5)
    roll = Observe(name="x", of="craft", what="roll", scale=0.25, clip=(-1.0, 1.0))
    assert measured(roll, sim).tolist() == [-1.0]


@pytest.mark.parametrize(
    ("task", "name", "scale"),
    [
        ("docking2d", "position", [1.0, 2.0, 3.0]),
        ("docking2d", "speed", [1.0, 2.0]),
        ("rejoin2d", "lead_position", [1000.0, 1.0]),
        ("docking2d_oriented", "attitude", [1.0, 1.0, 1.0]),
    ],
)
def test_a_scale_of_the_wrong_length_is_told_with_its_observation(
    task: str, name: str, scale: list[float]
) -> None:
    with pytest.raises(
        jaxsafe.ConfigError, match=rf"^observation\.{name}: cannot be computed: "
    ) as caught:
        jaxsafe.make(task, {f"observation.{name}.scale": scale})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("task", "names"),
    [
        (
            "rejoin2d",
            [
                f"{item}.{part}"
                for item in (
                    "lead_position",
                    "rejoin_position",
                    "wingman_velocity",
                    "lead_velocity",
                )
                for part in ("magnitude", "x", "y")
            ],
        ),
        (
            "rejoin3d",
            [
                f"{item}.{part}"
                for item in (
                    "lead_position",
                    "rejoin_position",
                    "wingman_velocity",
                    "lead_velocity",
                )
                for part in ("magnitude", "x", "y", "z")
            ]
            + ["roll", "flight_path_angle"],
        ),
        (
            "docking2d",
            ["position.x", "position.y", "velocity.x", "velocity.y", "speed", "velocity_limit"],
        ),
        (
            "docking2d_oriented",
            [
                "position.x",
                "position.y",
                "velocity.x",
                "velocity.y",
                "attitude.cos",
                "attitude.sin",
                "attitude_rate",
                "speed",
                "velocity_limit",
            ],
        ),
    ],
)
def test_the_elements_of_each_task_s_observation_have_these_names(
    task: str, names: list[str]
) -> None:
    assert jaxsafe.make(task).observation_names == tuple(names)


# The docking tasks


def test_a_docking_step_pays_what_table_8_says(env: Environment) -> None:
    (timestep,) = run(env, start(env, (200.0, 0.0), (-0.4, 0.3)), (0.6, -0.8), 1)
    info = timestep.info
    distance = float(info.status["docking_distance"])
    speed = float(info.status["speed"])
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
    assert {name: float(term) for name, term in info.reward_terms.items()} == pytest.approx(
        expected, abs=2e-7
    )
    assert float(timestep.reward) == pytest.approx(sum(expected.values()), abs=2e-7)
    assert timestep.cost == 0.0


def test_the_delta_v_reward_is_of_the_thrust_that_acted(env: Environment) -> None:
    (timestep,) = run(env, start(env, (200.0, 0.0), (0.0, 0.0)), (-30.0, 40.0), 1)
    np.testing.assert_array_equal(timestep.info.control_actual, [-1.0, 1.0])
    assert float(timestep.info.reward_terms["delta_v"]) == pytest.approx(
        -0.01 * math.sqrt(2.0) / 12.0, rel=1e-6
    )


def test_a_step_above_the_limit_costs_and_its_severity_is_a_share_of_the_limit(
    env: Environment,
) -> None:
    (timestep,) = run(env, start(env, (100.0, 0.0), (0.0, 2.0)), (0.0, 0.0), 1)
    info = timestep.info
    limit = float(info.status["velocity_limit"])
    speed = float(info.status["speed"])
    assert timestep.cost == 1.0
    assert float(info.margins["velocity_limit"]) == pytest.approx(limit - speed, rel=1e-6)
    assert float(info.severity["velocity_limit"]) == pytest.approx(
        (speed - limit) / limit, rel=1e-6
    )
    assert float(info.reward_terms["velocity_constraint"]) == pytest.approx(
        -0.01 - 0.01 * (speed - limit), rel=1e-6
    )
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
        _, timestep = jaxsafe.reset_to(
            env, {"deputy": {"position": position, "velocity": (0.0, 0.0)}}
        )
        assert bool(timestep.info.status["in_docking"]) == inside
        assert outcome(env, timestep) == ("success" if inside else "running")


def test_flying_beyond_forty_kilometres_ends_with_distance(env: Environment) -> None:
    near, far = (
        run(env, start(env, (0.0, y), (0.0, 0.0)), (0.0, 0.0), 1)[0] for y in (39_999.0, 40_001.0)
    )
    assert (outcome(env, near), outcome(env, far)) == ("running", "distance")
    assert far.info.reward_terms["failure"] == -1.0


def test_a_timeout_ends_the_episode_on_the_step_after_the_limit(env: Environment) -> None:
    short = jaxsafe.override(env, {"terminal.timeout.limit": 3})
    timesteps = run(short, start(short, (100.0, 0.0), (0.0, 0.0)), (0.0, 0.0), 4)
    assert [outcome(short, timestep) for timestep in timesteps] == ["running"] * 3 + ["timeout"]
    assert [bool(timestep.terminated) for timestep in timesteps] == [False] * 3 + [True]
    assert [float(timestep.info.reward_terms["failure"]) for timestep in timesteps] == [0.0] * 3 + [
        -1.0
    ]


def test_a_timeout_may_be_declared_a_truncation() -> None:
    env = jaxsafe.make(
        "docking2d", {"terminal.timeout.limit": 1, "terminal.timeout.ends": "truncated"}
    )
    timesteps = run(env, start(env, (100.0, 0.0), (0.0, 0.0)), (0.0, 0.0), 2)
    assert [bool(timestep.truncated) for timestep in timesteps] == [False, True]
    assert not any(timestep.terminated for timestep in timesteps)
    assert timesteps[1].done


def test_time_counts_steps_times_their_length() -> None:
    env = jaxsafe.make("docking2d", {"dt": 0.5, "terminal.timeout.limit": 1.0})
    timesteps = run(env, start(env, (100.0, 0.0), (0.0, 0.0)), (1.0, 0.0), 3)
    assert [outcome(env, timestep) for timestep in timesteps] == ["running", "running", "timeout"]
    assert float(timesteps[0].info.status["delta_v"]) == pytest.approx(0.5 / 12.0)


# The bound on the velocity reward


def bounded(offset: float, **more: Any) -> Environment:
    """Return docking2d in which every step above the limit pays `offset` and nothing else."""
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
    assert [outcome(env, timestep) for timestep in too_fast(env, 3)] == [
        "running",
        "running",
        "velocity",
    ]


def test_the_unchanged_task_reaches_the_bound_when_the_sum_does(env: Environment) -> None:
    timesteps = run(env, start(env, (100.0, 0.0), (0.0, 20.0)), (0.0, 0.0), 30)
    totals = np.cumsum(
        [float(timestep.info.reward_terms["velocity_constraint"]) for timestep in timesteps]
    )
    ended = [outcome(env, timestep) == "velocity" for timestep in timesteps]
    assert ended == [total < -5.0 for total in totals]
    assert 20 < ended.index(True) < 28


def test_a_reward_after_the_bound_sees_the_end() -> None:
    env = bounded(-6.0, **{"reward.failure.values.velocity": -3.0})
    (timestep,) = too_fast(env, 1)
    assert outcome(env, timestep) == "velocity"
    assert timestep.info.reward_terms["failure"] == -3.0
    assert float(timestep.reward - timestep.info.reward_terms["distance_change"]) == pytest.approx(
        -9.0, rel=1e-6
    )


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


# Several terminal conditions at once


def test_the_first_end_in_the_list_is_the_outcome() -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 0.5, "terminal.distance.limit": 0.1})
    for expected, x, speed in (("success", 0.4, 0.0), ("crash", 0.4, 0.3), ("distance", 9.0, 0.0)):
        (timestep,) = run(env, start(env, (x, 0.0), (-speed, 0.0)), (0.0, 0.0), 1)
        assert outcome(env, timestep) == expected
    patient = jaxsafe.override(env, {"terminal.distance.limit": 40_000.0})
    assert (
        outcome(patient, run(patient, start(patient, (9.0, 0.0), (0.0, 0.0)), (0.0, 0.0), 1)[0])
        == "timeout"
    )


def test_success_with_a_timeout_pays_success_only() -> None:
    env = jaxsafe.make("docking2d", {"tied": {}, "terminal.timeout.limit": 0.5})
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
    env = bounded(offset, **{"tied": {}, "terminal.timeout.limit": limit})
    _, timestep = step(env, start(env, (x, 0.0), (-speed, 0.0)), jnp.zeros(2))
    flags = {name: bool(flag) for name, flag in timestep.info.ended.items()}
    assert sum(flags.values()) <= 1
    assert flags == {name: name == outcome(env, timestep) for name in env.outcomes[1:]}
    assert bool(timestep.done) == any(flags.values())
    paid = {name: float(timestep.info.reward_terms[name]) for name in ("success", "failure")}
    assert (paid["success"] > 0) == flags["success"]
    assert (paid["failure"] < 0) == (flags["crash"] or flags["distance"] or flags["timeout"])
