"""The general parts of the vocabulary: formulas against numbers by hand, memory, and mistakes."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.config import from_data
from jaxsafe.environment import Environment
from jaxsafe.processors.constraint import (
    ConeConstraint,
    KeepIn,
    KeepOut,
    LowerLimit,
    Separation,
    UpperLimit,
)
from jaxsafe.processors.observation import (
    ObserveControl,
    ObserveOrientation,
    ObserveRegion,
    ObserveTime,
    ObserveVector,
)
from jaxsafe.processors.reward import ConstantReward, DeltaVCost, Proportional, ThresholdReward
from jaxsafe.processors.status import (
    Accumulator,
    And,
    Angle,
    Change,
    ControlChange,
    ControlComponent,
    ControlEffort,
    Distance,
    ElapsedTime,
    LinearCombination,
    Magnitude,
    Norm,
    Not,
    Or,
    RelativeSpeed,
    SignedDistance,
    Speed,
    Status,
    Threshold,
    VectorComponent,
)
from jaxsafe.processors.terminal import Above, Below, TooClose, TooFar
from jaxsafe.schema.component import normalise
from jaxsafe.simulation.cwh import SpacecraftState
from jaxsafe.simulation.dubins import Dubins3DState
from jaxsafe.simulation.oriented import OrientedState
from jaxsafe.simulation.regions import BodyDisplacement, Box
from jaxsafe.simulation.vectors import BodyDirection, FixedDirection, Position, Velocity
from jaxsafe.transition import advance, smallest_margin, update_statuses, with_memory
from jaxsafe.types import Sim

CHIEF = SpacecraftState(jnp.asarray([1.0, 1.0]), jnp.asarray([0.0, 0.5]), jnp.zeros(2))
DEPUTY = OrientedState(
    position=jnp.asarray([4.0, 5.0]),
    velocity=jnp.asarray([0.6, -0.3]),
    delta_v=jnp.zeros(1),
    attitude=jnp.asarray(math.pi / 2),  # the body's x axis is y
    attitude_rate=jnp.asarray(0.1),
)
PORT = Box(
    name="port",
    on="deputy",
    size=(2.0, 2.0),
    offset=BodyDisplacement(by=(3.0, 0.0)),
    turns=True,
)
TO_CHIEF = Position(of="chief", relative_to="deputy")


def world(control: tuple[float, ...] = (3.0, -4.0), time: float = 2.0, **status: Any) -> Sim:
    """Return a simulation in which a port moves 3 m in front of the deputy."""
    platforms = {"chief": CHIEF, "deputy": DEPUTY}
    return Sim(
        time=jnp.asarray(time),
        platforms=platforms,
        regions={"port": normalise(PORT).place(platforms, moves=True, measures=True)},
        status={name: jnp.asarray(value) for name, value in status.items()},
        ended={},
        intervening=jnp.asarray(False),
        control_desired=jnp.asarray([10.0, 0.0]),
        control_actual=jnp.asarray(control),
    )


@pytest.mark.parametrize(
    ("status", "value"),
    [
        (Distance(name="s", of="deputy", to="port"), 3.0),
        (Distance(name="s", of="port", to="chief"), math.hypot(3.0, 7.0)),
        (SignedDistance(name="s", of="chief", region="port"), math.hypot(2.0, 6.0)),
        (RelativeSpeed(name="s", of="deputy", to="chief"), 1.0),
        # The port moves by ω × r = 0.1 · 3 m to the left of the body's x axis, which is −x.
        (RelativeSpeed(name="s", of="port", to="deputy"), 0.3),
        (Speed(name="s", of="port"), math.hypot(0.3, 0.3)),
        (ElapsedTime(name="s"), 2.0),
        (Magnitude(name="s", vector=TO_CHIEF), 5.0),
        (Magnitude(name="s", vector=FixedDirection(along=(3.0, 4.0))), 1.0),
        (VectorComponent(name="s", vector=TO_CHIEF, axis="x"), -3.0),
        (VectorComponent(name="s", vector=TO_CHIEF, axis="x", frame="deputy"), -4.0),
        (VectorComponent(name="s", vector=TO_CHIEF, axis="y", frame="port"), 3.0),
        (VectorComponent(name="s", vector=Velocity(of="chief"), axis="y"), 0.5),
        (
            Angle(
                name="s",
                first=BodyDirection(of="deputy", along=(2.0, 0.0)),
                second=FixedDirection(along=(1.0, 0.0)),
            ),
            math.pi / 2,
        ),
        (
            Angle(
                name="s",
                first=FixedDirection(along=(1.0, 0.0), rate=0.25),
                second=FixedDirection(along=(0.0, 5.0)),
            ),
            math.pi / 2 - 0.5,
        ),
        (ControlComponent(name="s", element=1), -4.0),
        (ControlComponent(name="s", element=0, which="desired"), 10.0),
        (ControlEffort(name="s"), 5.0),
        (ControlEffort(name="s", norm="l1", scale=(3.0, 2.0)), 3.0),
        (Norm(name="s", statuses=("a", "b")), 5.0),
        (LinearCombination(name="s", weights={"b": -1.0, "a": 2.0}, offset=0.5), 2.5),
        (Threshold(name="s", status="a", limit=3.0, side="above"), False),
        (Threshold(name="s", status="a", limit=3.0, side="above", inclusive=True), True),
        (Threshold(name="s", status="a", limit=3.1, side="below"), True),
        (And(name="s", statuses=("yes", "no")), False),
        (Or(name="s", statuses=("yes", "no")), True),
        (Not(name="s", status="no"), True),
    ],
)
def test_a_status_is_its_formula(status: Status, value: float | bool) -> None:
    sim = world(a=3.0, b=4.0, yes=True, no=False)
    status = normalise(status)
    found = status.process(status.init(sim), sim)
    assert found.shape == ()
    assert (found.dtype == bool) == isinstance(value, bool)
    np.testing.assert_allclose(found, value, atol=1e-6)


@pytest.mark.parametrize(
    "status",
    [
        Distance(name="s", of="deputy", to="chief"),
        SignedDistance(name="s", of="chief", region="port"),
        RelativeSpeed(name="s", of="deputy", to="chief"),
        Magnitude(name="s", vector=TO_CHIEF),
        Angle(name="s", first=TO_CHIEF, second=Velocity(of="deputy", relative_to="chief")),
        ControlEffort(name="s"),
        Norm(name="s", statuses=("a",)),
    ],
)
def test_gradients_are_finite_where_all_is_zero(status: Status) -> None:
    def value(x: jax.Array) -> jax.Array:
        zero = SpacecraftState(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))
        platforms = {"chief": zero, "deputy": zero.replace(position=x, velocity=x)}
        sim = world(a=0.0).replace(platforms=platforms, control_actual=x)
        port = normalise(PORT.replace(offset=None)).place(platforms, moves=True, measures=True)
        sim = sim.replace(regions={"port": port}, status={"a": x[0]})
        return normalise(status).process((), sim)

    assert np.isfinite(jax.grad(value)(jnp.zeros(2))).all()


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (Accumulator(name="s", status="a"), [0.0, 2.0, 5.0]),
        (Accumulator(name="s", status="a", per_second=True), [0.0, 1.0, 2.5]),
        (Accumulator(name="s", status="flag"), [0.0, 1.0, 1.0]),
        (Change(name="s", status="a"), [0.0, 1.0, 1.0]),
        (ControlChange(name="s"), [0.0, 5.0, 0.0]),
    ],
)
def test_memory_begins_with_the_sample_at_reset_and_moves_once_a_step(
    status: Status, expected: list[float]
) -> None:
    status = normalise(status)
    samples = [
        world((0.0, 0.0), a=1.0, flag=True),
        world(a=2.0, flag=True),
        world(a=3.0, flag=False),
    ]
    memory = status.init(samples[0])
    values = [float(status.process(memory, samples[0]))]
    for sim in samples[1:]:
        memory = status.increment(memory, sim, jnp.asarray(0.5))
        values.append(float(status.process(memory, sim)))
    np.testing.assert_allclose(values, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("reward", "value"),
    [
        (ConstantReward(name="r", value=-0.5), -0.5),
        (ConstantReward(name="r", value=-0.5, condition="no"), 0.0),
        (Proportional(name="r", status="a", scale=-2.0, offset=1.0), -5.0),
        (Proportional(name="r", status="a", scale=-2.0, condition="yes"), -6.0),
        (Proportional(name="r", status="a", scale=-2.0, offset=1.0, condition="no"), 0.0),
        (ThresholdReward(name="r", status="a", limit=2.0, side="above", value=7.0), 7.0),
        (ThresholdReward(name="r", status="a", limit=3.0, side="above", value=7.0), 0.0),
        (
            ThresholdReward(
                name="r", status="a", limit=3.0, side="below", inclusive=True, value=7.0
            ),
            7.0,
        ),
        (DeltaVCost(name="r", delta_v="a", scale=-2.0), -6.0),
    ],
)
def test_a_reward_is_its_formula(reward: Any, value: float) -> None:
    assert normalise(reward).process((), world(a=3.0, yes=True, no=False)) == value


@pytest.mark.parametrize("value", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("inclusive", [True, False])
def test_too_far_and_too_close_are_above_and_below_of_a_distance(
    value: float, inclusive: bool
) -> None:
    for general, kind in ((Above, TooFar), (Below, TooClose)):
        numbers: dict[str, Any] = {"name": "t", "limit": 2.0, "inclusive": inclusive}
        one = normalise(general(status="a", **numbers)).reached(world(a=value))
        other = normalise(kind(distance="a", **numbers)).reached(world(a=value))
        assert bool(one) == bool(other)
        assert bool(one) == ((value > 2.0) == (general is Above) if value != 2.0 else inclusive)


@pytest.mark.parametrize("value", [1.0, 2.0, 3.0])
def test_a_separation_is_a_lower_limit_whose_scale_is_its_minimum(value: float) -> None:
    sim = world(a=value)
    kind = normalise(Separation(name="c", distance="a", minimum=2.0))
    general = normalise(LowerLimit(name="c", status="a", minimum=2.0, scale=2.0))
    assert kind.margin(sim) == general.margin(sim)
    assert kind.limit(sim) == general.limit(sim)


@pytest.mark.parametrize(
    ("constraint", "margin", "limit"),
    [
        (LowerLimit(name="c", status="a", minimum=-1.0), 4.0, 1.0),
        (LowerLimit(name="c", status="a", minimum=5.0, scale=2.0), -2.0, 2.0),
        (UpperLimit(name="c", status="a", maximum=2.5), -0.5, 1.0),
        (
            KeepOut(name="c", of="chief", region="port", clearance=1.0),
            math.hypot(2.0, 6.0) - 1.0,
            1.0,
        ),
        (KeepIn(name="c", of="chief", region="port"), -math.hypot(2.0, 6.0), 1.0),
        (
            ConeConstraint(
                name="c",
                axis=BodyDirection(of="deputy", along=(0.0, 1.0)),  # points to −x
                target=TO_CHIEF,
                half_angle=1.0,
                keep="inside",
            ),
            1.0 - math.atan2(4.0, 3.0),
            1.0,
        ),
        (
            ConeConstraint(
                name="c",
                axis=BodyDirection(of="deputy", along=(0.0, 1.0)),
                target=TO_CHIEF,
                half_angle=0.5,
                keep="outside",
            ),
            math.atan2(4.0, 3.0) - 0.5,
            0.5,
        ),
    ],
)
def test_a_margin_is_its_formula(constraint: Any, margin: float, limit: float) -> None:
    sim = world(a=3.0)
    constraint = normalise(constraint)
    np.testing.assert_allclose(constraint.margin(sim), margin, atol=1e-5)
    assert float(constraint.limit(sim)) == limit


@pytest.mark.parametrize(
    ("observation", "values", "labels"),
    [
        (ObserveTime(name="o"), [2.0], ("o",)),
        (ObserveTime(name="o", offset=4.0, scale=2.0), [-1.0], ("o",)),
        (ObserveControl(name="o", scale=(3.0, 8.0)), [1.0, -0.5], ("o.0", "o.1")),
        (ObserveControl(name="o", which="desired", offset=(1.0, 2.0)), [9.0, -2.0], None),
        (ObserveOrientation(name="o", of="deputy"), [0.0, 1.0], ("o.cos", "o.sin")),
        (ObserveOrientation(name="o", of="chief", frame="deputy"), [0.0, -1.0], None),
        (ObserveOrientation(name="o", of="port"), [0.0, 1.0], None),
        (ObserveVector(name="o", what=TO_CHIEF, frame="deputy"), [-4.0, 3.0], ("o.x", "o.y")),
        (ObserveVector(name="o", what=Velocity(of="port")), [0.3, -0.3], None),
        (ObserveRegion(name="o", region="port", relative_to="port"), [0.0, 0.0], None),
        (
            ObserveVector(name="o", what=TO_CHIEF, form="magnorm", offset=(5.0, 0.0, 0.0)),
            [0.0, -0.6, -0.8],
            ("o.magnitude", "o.x", "o.y"),
        ),
    ],
)
def test_an_observation_is_its_formula(
    observation: Any, values: list[float], labels: tuple[str, ...] | None
) -> None:
    observation = normalise(observation)
    sim = world()
    np.testing.assert_allclose(observation.process((), sim), values, atol=1e-6)
    names = observation.labels(sim)
    assert len(names) == len(values)
    assert labels is None or names == labels


def test_an_orientation_in_space_is_two_axes_of_the_body() -> None:
    zero = jnp.asarray(0.0)
    lead = Dubins3DState(
        position=jnp.zeros(3),
        heading=jnp.asarray(math.pi / 2),
        flight_path_angle=zero,
        roll=jnp.asarray(math.pi / 2),
        speed=jnp.asarray(200.0),
    )
    sim = world().replace(platforms={"lead": lead})
    observation = ObserveOrientation(name="o", of="lead")
    measured = normalise(observation).process((), sim)
    np.testing.assert_allclose(measured, [0.0, 1.0, 0.0, 0.0, 0.0, 1.0], atol=1e-6)
    assert observation.labels(sim)[0] == "o.x_axis.x"
    assert observation.labels(sim)[-1] == "o.y_axis.z"


# An environment of nothing but general parts


def data() -> dict[str, Any]:
    """Return an environment with two zones, a docking corridor and every general part."""
    to_chief = {"type": "position", "of": "chief", "relative_to": "deputy"}
    return {
        "agent": "deputy",
        "platforms": [
            {"type": "anchor", "name": "chief", "dimension": 2},
            {
                "type": "oriented_spacecraft",
                "name": "deputy",
                "start": [
                    {
                        "type": "cases",
                        "name": "start",
                        "values": {
                            "position.x": [20, -20],
                            "position.y": [5, -5],
                            "attitude": [0, 1],
                        },
                    },
                    {
                        "type": "normal",
                        "name": "velocity",
                        "mean": [0, 0],
                        "deviation": [0.1, 0.1],
                        "low": [-0.1, -0.1],
                        "high": [0.1, 0.1],
                    },
                ],
                "controller": {
                    "type": "continuous",
                    "actuators": [
                        {"name": "thrust", "low": -1, "high": 1},
                        {"name": "attitude_acceleration", "low": -0.01, "high": 0.01},
                    ],
                },
            },
        ],
        "regions": [
            {
                "type": "box",
                "name": "zone",
                "on": None,
                "offset": {"type": "displacement", "by": [0, 30]},
                "size": [10, 1],
            },
            {
                "type": "cone",
                "name": "camera",
                "on": "deputy",
                "turns": True,
                "offset": {"type": "body_displacement", "by": [1, 0]},
                "towards": [1, 0],
                "half_angle": 0.5,
            },
            {"type": "circle", "name": "focus", "on": "camera", "radius": 2},
            {"type": "half_space", "name": "room", "on": "chief", "towards": [0, -1]},
        ],
        "status": [
            {"type": "distance", "name": "distance", "of": "deputy", "to": "chief"},
            {"type": "distance", "name": "focus_distance", "of": "focus", "to": "chief"},
            {"type": "signed_distance", "name": "to_zone", "of": "deputy", "region": "zone"},
            {"type": "relative_speed", "name": "closing", "of": "focus", "to": "chief"},
            {
                "type": "angle",
                "name": "off_sun",
                "first": {"type": "body", "of": "deputy", "along": [1, 0]},
                "second": {"type": "fixed", "along": [0, 1], "rate": -0.001},
            },
            {
                "type": "component",
                "name": "ahead",
                "vector": to_chief,
                "axis": "x",
                "frame": "camera",
            },
            {"type": "magnitude", "name": "range", "vector": to_chief},
            {"type": "control", "name": "thrust", "element": 0},
            {"type": "control_effort", "name": "effort", "scale": [1, 0.01]},
            {"type": "control_change", "name": "jerk"},
            {"type": "accumulator", "name": "budget", "status": "effort", "per_second": True},
            {"type": "change", "name": "approach", "status": "distance"},
            {"type": "norm", "name": "both", "statuses": ["effort", "jerk"]},
            {
                "type": "linear_combination",
                "name": "room_left",
                "weights": {"distance": 1, "budget": -0.1},
            },
            {"type": "elapsed_time", "name": "time"},
            {
                "type": "threshold",
                "name": "near",
                "status": "distance",
                "limit": 1,
                "side": "below",
            },
            {"type": "threshold", "name": "late", "status": "time", "limit": 5, "side": "above"},
            {"type": "and", "name": "near_and_late", "statuses": ["near", "late"]},
            {"type": "or", "name": "near_or_late", "statuses": ["near", "late"]},
            {"type": "not", "name": "far", "status": "near"},
        ],
        "constraints": [
            {"type": "lower_limit", "name": "apart", "status": "distance", "minimum": 0.5},
            {"type": "upper_limit", "name": "budget", "status": "budget", "maximum": 100},
            {"type": "keep_out", "name": "zone", "of": "deputy", "region": "zone"},
            {"type": "keep_in", "name": "room", "of": "deputy", "region": "room"},
            {
                "type": "cone",
                "name": "sun",
                "axis": {"type": "body", "of": "deputy", "along": [1, 0]},
                "target": {"type": "fixed", "along": [0, 1]},
                "half_angle": 0.3,
                "keep": "outside",
            },
        ],
        "terminal": [
            {"type": "below", "name": "success", "status": "distance", "limit": 1},
            {"type": "above", "name": "spent", "status": "budget", "limit": 50},
            {"type": "holds", "name": "late", "status": "near_and_late"},
            {"type": "timeout", "name": "timeout", "limit": 100},
        ],
        "reward": [
            {"type": "constant", "name": "time", "value": -0.01},
            {
                "type": "proportional",
                "name": "smooth",
                "status": "jerk",
                "scale": -0.1,
                "condition": "far",
            },
            {
                "type": "threshold",
                "name": "near",
                "status": "distance",
                "limit": 10,
                "side": "below",
                "value": 1,
            },
        ],
        "observation": [
            {"type": "observe_vector", "name": "chief", "what": to_chief, "frame": "deputy"},
            {"type": "observe_orientation", "name": "attitude", "of": "camera"},
            {"type": "observe_control", "name": "last", "scale": [1, 0.01]},
            {"type": "observe_time", "name": "time", "offset": 50, "scale": 50},
            {"type": "observe_region", "name": "zone", "region": "zone", "relative_to": "focus"},
        ],
    }


@pytest.fixture(scope="module")
def env() -> Environment:
    return from_data(data(), "")


@pytest.mark.thorough
def test_an_environment_of_general_parts_steps_in_batches(env: Environment) -> None:
    state, _ = jax.vmap(jaxsafe.reset, in_axes=(None, 0))(
        env, jax.random.split(jax.random.key(0), 3)
    )
    actions = jnp.asarray([[1.0, -1.0], [0.0, 0.0], [-1.0, 0.5]])
    step = jax.jit(jax.vmap(jaxsafe.step, in_axes=(None, 0, 0)))
    for _ in range(2):
        state, timestep = step(env, state, actions)
    status = timestep.info.status
    np.testing.assert_allclose(status["effort"], np.linalg.norm(actions, axis=1), rtol=1e-5)
    np.testing.assert_allclose(status["budget"], 2.0 * status["effort"], rtol=1e-5)
    np.testing.assert_allclose(status["jerk"], 0.0)
    np.testing.assert_allclose(status["time"], 2.0)
    np.testing.assert_allclose(timestep.observation[:, 4:6], actions, rtol=1e-5)
    assert env.observation_names[2:4] == ("attitude.cos", "attitude.sin")
    assert np.isfinite(timestep.observation).all()
    np.testing.assert_allclose(
        timestep.info.margins["room"], -state.sim.platforms["deputy"].position[:, 1], rtol=1e-5
    )


def test_what_is_dumped_reads_back_the_same(env: Environment) -> None:
    assert jaxsafe.config.load(jaxsafe.config.dump(env)) == env


def test_only_regions_that_are_named_so_know_their_motion_and_distances(env: Environment) -> None:
    start = {"deputy": {"position": [20.0, 5.0], "attitude": 0.0, "velocity": [0.0, 0.0]}}
    regions = jaxsafe.reset_to(env, start)[0].sim.regions
    assert {name for name, region in regions.items() if region.distance} == {"zone", "room"}
    moving = {name for name, region in regions.items() if not isinstance(region.velocity, tuple)}
    assert moving == {"camera", "focus"}


def test_a_predicted_step_through_a_zone_is_unsafe_though_both_its_ends_are_safe(
    env: Environment,
) -> None:
    start = {
        "deputy": {"position": [0.0, 31.0], "attitude": 0.0, "velocity": [0.3, -2.0]},
    }
    sim = jaxsafe.reset_to(env, start)[0].sim
    after = advance(env, sim, jnp.zeros(2))
    assert float(smallest_margin(env, sim, names=["zone"])) > 0.4
    assert float(smallest_margin(env, after, names=["zone"])) > 0.4
    assert float(smallest_margin(env, after, before=sim, names=["zone"])) < -0.3


def test_a_predicted_step_adds_its_control_to_a_budget(env: Environment) -> None:
    start = {"deputy": {"position": [20.0, 5.0], "attitude": 0.0, "velocity": [0.0, 0.0]}}
    state, _ = jaxsafe.reset_to(env, start)
    sim = with_memory(env, state.sim, state.memory.status)
    for steps in (1, 2):
        sim = advance(env, sim, jnp.asarray([0.5, 0.0]))
        margin = smallest_margin(env, sim, names=["budget"])
        assert float(margin) == pytest.approx(100.0 - 0.5 * steps)


def least_margins(
    env: jaxsafe.Environment, policy: Any, name: str, strengthening: float, num_steps: int
) -> list[float]:
    """Return the least margin of a constraint over 16 flights, without and with a barrier on it."""
    asif = {
        "type": "explicit_asif",
        "constraints": [name],
        "enforce": False,
        "strengthening": {"type": "polynomial", "linear": strengthening},
    }
    key = jax.random.key(0)
    return [
        float(jaxsafe.rollout(one, policy, key, num_steps, num_envs=16).info.margins[name].min())
        for one in (env, jaxsafe.override(env, {"rta": asif}))
    ]


@pytest.mark.thorough
def test_a_barrier_on_the_distance_to_a_box_keeps_out_of_it() -> None:
    env = jaxsafe.make("docking2d")
    zone = {
        "type": "box",
        "name": "zone",
        "on": "chief",
        "offset": {"type": "displacement", "by": [0, 60]},
        "size": [30, 10],
    }
    keep_out = {"type": "keep_out", "name": "zone", "of": "deputy", "region": "zone", "degree": 2}
    env = jaxsafe.override(
        env,
        {
            "regions": [*env.regions, zone],
            "constraints": [*env.constraints, keep_out],
            "deputy.start.position.direction.azimuth": [1.2, 1.9],
        },
    )

    def towards_the_chief(key: jax.Array, observation: jax.Array) -> jax.Array:
        return -jnp.sign(observation[:, :2])

    least = least_margins(env, towards_the_chief, "zone", strengthening=0.02, num_steps=200)
    assert least[0] < -3.0
    assert least[1] >= 0.0


@pytest.mark.thorough
def test_a_barrier_keeps_an_approach_within_its_cone() -> None:
    cone = {
        "type": "cone",
        "name": "corridor",
        "axis": {"type": "fixed", "along": [0, 1]},
        "target": {"type": "position", "of": "deputy", "relative_to": "chief"},
        "half_angle": 0.5,
        "keep": "inside",
        "degree": 2,
    }
    docking = jaxsafe.make("docking2d")
    env = jaxsafe.override(
        docking,
        {
            "constraints": [*docking.constraints, cone],
            "deputy.start.position.direction.azimuth": [1.4, 1.75],
            "deputy.start.velocity.share": [0.0, 0.2],
        },
    )

    def sideways(key: jax.Array, observation: jax.Array) -> jax.Array:
        return jnp.zeros((observation.shape[0], 2)).at[:, 0].set(1.0)

    least = least_margins(env, sideways, "corridor", strengthening=0.05, num_steps=150)
    assert least[0] < -0.2
    assert least[1] >= 0.0


ON_ARM = {"on": "deputy", "offset": {"type": "body_displacement", "by": [6, 0]}}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("of", "regions"),
    [
        ("chief", [ON_ARM | {"type": "box", "name": "zone", "turns": True, "size": [8, 1]}]),
        (
            "tip",
            [
                ON_ARM | {"type": "circle", "name": "tip", "radius": 1},
                {"type": "box", "name": "zone", "on": "chief", "size": [8, 1]},
            ],
        ),
    ],
    ids=["a platform and a region that turns", "the tip of an arm and a region at rest"],
)
def test_bounds_on_the_way_hold_for_a_carrier_that_turns(of: str, regions: list) -> None:
    """Compare with many small steps of the same motion."""
    tree = data()
    tree["regions"] = regions
    tree["status"] = [{"type": "elapsed_time", "name": "time"}]
    tree["constraints"] = [
        {"type": "keep_out", "name": "out", "of": of, "region": "zone"},
        {"type": "keep_in", "name": "in", "of": of, "region": "zone"},
    ]
    tree["terminal"] = [{"type": "timeout", "name": "timeout", "limit": 100}]
    tree["reward"] = [{"type": "constant", "name": "time", "value": -0.01}]
    tree["observation"] = [{"type": "observe_time", "name": "time"}]
    tree["platforms"][1]["attitude_rate_limits"] = [-1, 1]
    env = from_data(tree, "")

    @jax.jit
    def bounds(position: jax.Array, rate: jax.Array) -> tuple[jax.Array, jax.Array]:
        sim = jaxsafe.reset_to(
            env,
            {
                "deputy": {
                    "position": position,
                    "velocity": jnp.asarray([1.0, -2.0]),
                    "attitude": 3.0,
                    "attitude_rate": rate,
                }
            },
        )[0].sim

        def margins(share: jax.Array) -> jax.Array:
            part = env.replace(dt=env.dt * share)
            moved = update_statuses(env, advance(part, sim, jnp.zeros(2)), {})[0]
            return jnp.stack([one.margin(moved) for one in env.constraints])

        true = jax.vmap(margins)(jnp.linspace(1e-3, 1.0, 200)).min(axis=0)
        after = advance(env, sim, jnp.zeros(2))
        bounds = [smallest_margin(env, after, before=sim, names=[name]) for name in ("out", "in")]
        return true, jnp.stack(bounds)

    positions = jax.random.uniform(jax.random.key(1), (30, 2), minval=-12.0, maxval=12.0)
    rates = jnp.linspace(-0.9, 0.9, 30)
    true, bound = jax.vmap(bounds)(positions, rates)
    assert (np.asarray(bound) <= np.asarray(true) + 1e-4).all()
    assert (np.asarray(true - bound)[np.abs(rates) < 0.05] < 2.0).all()


def test_a_region_may_stand_where_a_platform_is() -> None:
    """The tip of an arm is inside a zone, near its edge and near another region."""
    tree = data()
    tree["regions"] = [
        ON_ARM | {"type": "circle", "name": "tip", "radius": 1},
        {"type": "circle", "name": "zone", "on": "chief", "radius": 5},
    ]
    related = {"of": "tip", "region": "zone"}
    tree["status"] = [
        {"type": "in_region", "name": "inside", **related},
        {"type": "signed_distance", "name": "edge", **related},
        {"type": "region_distance", "name": "centre", **related},
        {"type": "drift_distance", "name": "drift", "of": "deputy", "to": "tip", "duration": 1},
    ]
    room = {"of": "tip", "to": "zone", "radius": 1, "deceleration": 0.1}
    tree["constraints"] = [
        {"type": "keep_in", "name": "in", **related},
        {"type": "braking_distance", "name": "room", **room},
    ]
    tree["terminal"] = [{"type": "timeout", "name": "timeout", "limit": 100}]
    tree["reward"] = [{"type": "constant", "name": "time", "value": -0.01}]
    seen = {"type": "observe", "relative_to": "chief"}
    tree["observation"] = [
        {**seen, "name": "place", "of": "tip", "what": "position"},
        {**seen, "name": "way", "of": "zone", "what": "velocity"},
    ]
    env = from_data(tree, "")
    start = {"position": [-3.0, 0.0], "velocity": [0.0, 0.0], "attitude": 0.0}
    _, timestep = jaxsafe.reset_to(env, {"deputy": {**start, "attitude_rate": 0.0}})
    np.testing.assert_allclose(timestep.observation, [3.0, 0.0, 0.0, 0.0], atol=1e-6)
    status = timestep.info.status
    assert status["inside"]
    np.testing.assert_allclose([status["edge"], status["centre"]], [-2.0, 3.0], rtol=1e-6)
    np.testing.assert_allclose(status["drift"], 6.0, atol=1e-3)
    margins = timestep.info.margins
    np.testing.assert_allclose([margins["in"], margins["room"]], [2.0, 2.0], rtol=1e-6)
    for path, value, message in (
        ("status.edge.of", "zone", r"^status\.edge\.of: it is the region itself; choose another"),
        ("observation.way.what", "speed", r"what: zone has no quantity 'speed'; choose from pos"),
    ):
        with pytest.raises(jaxsafe.ConfigError, match=message):
            jaxsafe.override(env, {path: value})


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (
            "status.closing.of",
            "foccus",
            r"closing\.of: nothing is called 'foccus'\. Did you mean 'focus'",
        ),
        ("regions.camera.on", "focus", r"camera\.on: nothing listed before it is called 'focus'"),
        ("regions.camera.on", "nobody", r"camera\.on: nothing is called 'nobody'; choose from"),
        ("regions.zone.size", [1], r"regions\.zone\.size: expected 2 numbers, found 1"),
        ("regions.zone.size", [1, 1, 1], r"regions\.zone\.size: expected 2 numbers, found 3"),
        ("regions.room.towards", [0, 0], r"regions\.room: expected a `towards` other than 0"),
        ("regions.camera.half_angle", 2.0, r"half_angle: expected a number in rad in \(0, 1\.5"),
        ("status.ahead.axis", "z", r"status\.ahead\.axis: found 'z'; choose from x, y"),
        (
            "status.thrust.element",
            2,
            r"thrust\.element: found 2; choose from 0 \(thrust\), 1 \(attitude_acceleration\)",
        ),
        ("status.effort.scale", [1, 1, 1], r"effort\.scale: expected 1 or 2 numbers, found 3"),
        ("status.effort.scale", 0, r"effort\.scale: expected"),
        (
            "status.near.side",
            "over",
            r"near\.side: found 'over'\. Did you mean 'above'\? Choose from above, below",
        ),
        ("status.far.status", "distance", r"far\.status: expected a status that is true or false"),
        ("status.budget.status", "late", r"nothing listed before it is called 'late'"),
        ("status.near_and_late.statuses", [], r"near_and_late: expected at least one status"),
        ("status.off_sun.second.along", [0, 0], r"second: expected a `along` other than 0"),
        ("status.off_sun.first.along", [1], r"first\.along: expected 2 numbers, found 1"),
        ("constraints.zone.of", "chief", None),
        ("constraints.room.of", "chief", r"room\.of: region 'room' is on 'chief' itself"),
        (
            "constraints.sun.keep",
            "in",
            r"sun\.keep: found 'in'\. Did you mean 'inside'\? Choose from inside, outside",
        ),
        ("reward.smooth.condition", "jerk", r"smooth\.condition: expected a status that is true"),
        ("observation.time.offset", [1, 2], r"observation\.time.*offset: expected 1 or 1 numbers"),
        ("observation.attitude.of", "sun", r"attitude\.of: nothing is called 'sun'"),
    ],
)
def test_mistakes_are_one_line_with_their_place(
    env: Environment, path: str, value: Any, message: str | None
) -> None:
    if message is None:
        jaxsafe.override(env, {path: value})
        return
    with pytest.raises(jaxsafe.ConfigError, match=message) as caught:
        jaxsafe.override(env, {path: value})
    assert "\n" not in str(caught.value)
