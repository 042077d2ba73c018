"""Random starts against Tables 3 and 4: ranges, distributions and independence.

The statistics are Kolmogorov-Smirnov's and Spearman's. The keys are fixed, so a test either always
passes or always fails. At the level used here a correct sampler with other keys would fail one
comparison in a thousand.
"""

from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare, kstest, spearmanr

import jaxsafe
from jaxsafe.environment import Environment
from jaxsafe.schema.component import normalise
from jaxsafe.simulation.geometry import direction
from jaxsafe.simulation.initializers import (
    AroundAtAltitude,
    AtLogUniformDistance,
    Cases,
    Direction,
    Fixed,
    Initializer,
    Normal,
    Uniform,
    uniform,
)
from jaxsafe.simulation.starts_in_boxes import SometimesInBoxes
from jaxsafe.types import Sim

NUM_STARTS = 4000
LEVEL = 1e-3
N = 0.001027

draw_starts = jax.jit(jax.vmap(jaxsafe.reset, in_axes=(None, 0)))


def measure(env: Environment, seed: int = 0) -> dict[str, np.ndarray]:
    """Return what is drawn at each of many starts.

    It is computed from the positions and velocities alone.
    """
    state, _ = draw_starts(env, jax.random.split(jax.random.key(seed), NUM_STARTS))
    deputy = state.sim.platforms["deputy"]
    position = np.asarray(deputy.position, float)
    velocity = np.asarray(deputy.velocity, float)
    distance = np.linalg.norm(position, axis=1)
    speed = np.linalg.norm(velocity, axis=1)
    drawn = {"distance": distance, "share": speed / (0.2 + 2 * N * distance)}
    for name, vector, norm in (("position", position, distance), ("velocity", velocity, speed)):
        drawn[f"{name} azimuth"] = np.arctan2(vector[:, 1], vector[:, 0]) % (2 * np.pi)
        if vector.shape[1] == 3:
            drawn[f"{name} polar"] = np.arccos(np.clip(vector[:, 2] / norm, -1, 1))
    return drawn


@pytest.fixture(scope="module", params=["docking2d", "docking3d"])
def starts(request: pytest.FixtureRequest) -> dict[str, np.ndarray]:
    return measure(jaxsafe.make(request.param))


def is_uniform(sample: np.ndarray, low: float, high: float) -> bool:
    return kstest(sample, "uniform", args=(low, high - low)).pvalue > LEVEL


def test_the_check_of_uniformity_can_fail() -> None:
    sample = np.linspace(0.0, 1.0, NUM_STARTS)
    assert is_uniform(sample, 0.0, 1.0)
    assert not is_uniform(sample, 0.0, 1.05)
    assert not is_uniform(sample**1.1, 0.0, 1.0)


def test_distances_are_uniform_between_100_and_150_metres(starts: dict[str, np.ndarray]) -> None:
    assert starts["distance"].min() >= 100.0 - 1e-4
    assert starts["distance"].max() <= 150.0 + 1e-4
    assert is_uniform(starts["distance"], 100.0, 150.0)


def test_speeds_are_uniform_up_to_the_limit_at_their_distance(
    starts: dict[str, np.ndarray],
) -> None:
    assert starts["share"].max() <= 1.0 + 1e-6
    assert is_uniform(starts["share"], 0.0, 1.0)


def test_all_angles_are_uniform(starts: dict[str, np.ndarray]) -> None:
    for name, sample in starts.items():
        if name.endswith("azimuth"):
            assert is_uniform(sample, 0.0, 2.0 * np.pi), name
        if name.endswith("polar"):
            assert is_uniform(sample, 0.0, np.pi), name


def test_a_spatial_start_has_six_random_numbers_and_a_planar_one_four() -> None:
    assert len(measure(jaxsafe.make("docking2d"))) == 4
    assert len(measure(jaxsafe.make("docking3d"))) == 6


def test_what_is_drawn_is_drawn_independently(starts: dict[str, np.ndarray]) -> None:
    for first, second in combinations(starts, 2):
        assert spearmanr(starts[first], starts[second]).pvalue > LEVEL, (first, second)


def test_all_starts_differ_and_other_keys_give_other_starts(starts: dict[str, np.ndarray]) -> None:
    for sample in starts.values():
        assert len(np.unique(sample)) > 0.99 * NUM_STARTS
    env = jaxsafe.make("docking2d")
    first, again, second = (measure(env, seed)["distance"] for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert not np.isin(first, second).any()


def test_the_chief_starts_at_rest_at_the_origin_and_no_thrust_has_acted() -> None:
    state, timestep = jaxsafe.reset(jaxsafe.make("docking3d"), jax.random.key(1))
    assert all(not leaf.any() for leaf in jax.tree.leaves(state.sim.platforms["chief"]))
    assert not state.sim.platforms["deputy"].delta_v.any()
    assert timestep.info.status["delta_v"] == 0.0


def test_ranges_can_be_overridden_without_compiling_anew() -> None:
    chex.clear_trace_counter()
    reset = jax.jit(chex.assert_max_traces(jaxsafe.reset, n=1))
    env = jaxsafe.make("docking2d")
    key = jax.random.key(3)
    reset(env, key)
    changes = {
        "deputy.start.position.distance": [7, 7],
        "deputy.start.position.direction.azimuth": [np.pi / 2, np.pi / 2],
        "deputy.start.velocity.share": [2, 2],
        "deputy.start.velocity.direction.azimuth": [0, 0],
    }
    deputy = reset(jaxsafe.override(env, changes), key)[0].sim.platforms["deputy"]
    np.testing.assert_allclose(deputy.position, [0.0, 7.0], atol=1e-5)
    np.testing.assert_allclose(deputy.velocity, [2 * (0.2 + 2 * N * 7), 0.0], rtol=1e-6)


@pytest.mark.parametrize(("polar", "size"), [(None, 2), ((0.0, np.pi), 3)])
def test_a_direction_without_a_polar_range_is_planar(
    polar: tuple[float, float] | None, size: int
) -> None:
    drawn = direction(*uniform(jax.random.key(0), *normalise(Direction(polar=polar)).intervals))
    assert drawn.shape == (size,)
    assert float(jnp.linalg.norm(drawn)) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("low", "high"), [(2.0, 3.0), (4.0, 4.0), (-1e6, 1e6)])
def test_uniform_stays_within_its_interval(low: float, high: float) -> None:
    keys = jax.random.split(jax.random.key(0), 1000)
    sample = jax.vmap(uniform, in_axes=(0, None))(keys, jnp.asarray([low, high]))
    assert low <= sample.min()
    assert sample.max() <= high


# The generic initializers

NOWHERE = Sim(jnp.zeros(()), {}, {}, {}, {}, jnp.zeros((), bool))


@pytest.mark.parametrize("value", [3.0, (1.0, -2.0), (0.0, 5.0, 7.0)])
def test_a_fixed_start_is_its_value_whatever_the_key(value: float | tuple[float, ...]) -> None:
    fixed = normalise(Fixed(name="heading", value=value))
    for seed in (0, 1):
        np.testing.assert_array_equal(
            fixed.draw(jax.random.key(seed), {}, NOWHERE), np.asarray(value, np.float32)
        )


def draw(initializer: Initializer, sim: Sim = NOWHERE, seed: int = 0) -> np.ndarray:
    keys = jax.random.split(jax.random.key(seed), NUM_STARTS)
    return np.asarray(
        jax.jit(jax.vmap(lambda key: normalise(initializer).draw(key, {}, sim)))(keys), float
    )


def test_a_uniform_scalar_is_uniform_between_its_bounds() -> None:
    sample = draw(Uniform(name="speed", low=250.0, high=300.0))
    assert sample.shape == (NUM_STARTS,)
    assert is_uniform(sample, 250.0, 300.0)


def test_a_uniform_vector_is_uniform_and_independent_in_each_component() -> None:
    low = (-1.0, 5.0, 12_000.0)
    high = (1.0, 5.0, 14_000.0)
    sample = draw(Uniform(name="position", low=low, high=high))
    assert is_uniform(sample[:, 0], -1.0, 1.0)
    assert is_uniform(sample[:, 2], 12_000.0, 14_000.0)
    assert (sample[:, 1] == 5.0).all()
    assert spearmanr(sample[:, 0], sample[:, 2]).pvalue > LEVEL


@pytest.mark.parametrize(
    ("low", "high", "problem"),
    [
        (1.0, 2.0, None),
        (2.0, 2.0, None),
        ((0.0, 1.0), (0.0, 3.0), None),
        (2.0, 1.0, "expected low ≤ high, found 2.0 and 1.0"),
        ((0.0, 4.0), (1.0, 3.0), "expected low ≤ high, found [0.0, 4.0] and [1.0, 3.0]"),
        ((0.0, 1.0), (1.0, 2.0, 3.0), "expected low ≤ high, found [0.0, 1.0] and [1.0, 2.0, 3.0]"),
        (0.0, (1.0, 2.0), "expected low ≤ high, found 0.0 and [1.0, 2.0]"),
    ],
)
def test_uniform_bounds_must_be_in_order_and_of_one_shape(
    low: object, high: object, problem: str | None
) -> None:
    assert normalise(Uniform(name="position", low=low, high=high)).problem() == problem


def test_around_at_altitude_is_uniform_in_horizontal_distance_azimuth_and_altitude() -> None:
    lead = SimpleNamespace(position=jnp.asarray([300.0, -200.0, 9_999.0]))
    around = AroundAtAltitude(
        name="position", about="lead", distance=(5.0, 10.0), altitude=(-3.0, 16.0)
    )
    sample = draw(around, NOWHERE.replace(platforms={"lead": lead}))
    x = sample[:, 0] - 300.0
    y = sample[:, 1] + 200.0
    drawn = {
        "distance": np.hypot(x, y),
        "azimuth": np.arctan2(y, x) % (2 * np.pi),
        "altitude": sample[:, 2],
    }
    for name, (low, high) in {
        "distance": (5, 10),
        "azimuth": (0, 2 * np.pi),
        "altitude": (-3, 16),
    }.items():
        assert is_uniform(drawn[name], low, high), name
    for first, second in combinations(drawn, 2):
        assert spearmanr(drawn[first], drawn[second]).pvalue > LEVEL, (first, second)


def test_log_uniform_distances_are_uniform_in_their_logarithm_in_any_direction() -> None:
    chief = SimpleNamespace(position=jnp.asarray([30.0, -20.0]))
    far = AtLogUniformDistance(name="position", about="chief", distance=(100.0, 1e4))
    sample = draw(far, NOWHERE.replace(platforms={"chief": chief})) - np.array([30.0, -20.0])
    distance = np.linalg.norm(sample, axis=1)
    azimuth = np.arctan2(sample[:, 1], sample[:, 0]) % (2 * np.pi)
    assert is_uniform(np.log10(distance), 2.0, 4.0)
    assert is_uniform(azimuth, 0.0, 2 * np.pi)
    assert spearmanr(distance, azimuth).pvalue > LEVEL
    assert not is_uniform(distance, 100.0, 1e4)


@pytest.mark.parametrize("distance", [(0.0, 10.0), (10.0, 5.0)])
def test_a_log_uniform_distance_begins_above_0(distance: tuple[float, float]) -> None:
    far = normalise(AtLogUniformDistance(name="position", about="chief", distance=distance))
    assert far.problem() == f"expected 0 < low ≤ high as the distance, found {[*distance]}"


# The rejoin and oriented tasks


@pytest.mark.parametrize("task", ["rejoin2d", "rejoin3d"])
def test_a_rejoin_starts_as_in_table_3(task: str) -> None:
    state, _ = draw_starts(jaxsafe.make(task), jax.random.split(jax.random.key(7), NUM_STARTS))
    lead = state.sim.platforms["lead"]
    wingman = state.sim.platforms["wingman"]
    x, y = np.asarray(wingman.position - lead.position, float).T[:2]
    drawn = {
        "lead x": (lead.position[:, 0], 5000.0, 10_000.0),
        "lead y": (lead.position[:, 1], 5000.0, 10_000.0),
        "lead heading": (lead.heading, 0.0, 2 * np.pi),
        "lead speed": (lead.speed, 250.0, 300.0),
        "distance": (np.hypot(x, y), 5000.0, 10_000.0),
        "azimuth": (np.arctan2(y, x) % (2 * np.pi), 0.0, 2 * np.pi),
        "heading": (wingman.heading, 0.0, 2 * np.pi),
        "speed": (wingman.speed, 200.0, 400.0),
    }
    if task == "rejoin3d":
        drawn["lead z"] = (lead.position[:, 2], 12_000.0, 14_000.0)
        drawn["z"] = (wingman.position[:, 2], 10_000.0, 16_000.0)
        for craft in (lead, wingman):
            assert not craft.roll.any()
            assert not craft.flight_path_angle.any()
    for name, (sample, low, high) in drawn.items():
        assert is_uniform(np.asarray(sample, float), low, high), name
    for first, second in combinations(drawn, 2):
        assert spearmanr(drawn[first][0], drawn[second][0]).pvalue > LEVEL, (first, second)


def test_a_start_may_be_about_a_region_that_an_earlier_platform_carries() -> None:
    near = {"about": "rejoin_region", "distance": [10.0, 140.0]}
    changes = {f"wingman.start.position.{name}": value for name, value in near.items()}
    env = jaxsafe.make("rejoin2d", changes)
    state, timestep = draw_starts(env, jax.random.split(jax.random.key(8), NUM_STARTS))
    lead = state.sim.platforms["lead"]
    angle = np.asarray(lead.heading, float) + np.pi + np.pi / 3
    point = np.asarray(lead.position, float) + 500.0 * np.stack([np.cos(angle), np.sin(angle)], -1)
    x, y = (np.asarray(state.sim.platforms["wingman"].position, float) - point).T
    assert is_uniform(np.hypot(x, y), 10.0, 140.0)
    assert is_uniform(np.arctan2(y, x) % (2 * np.pi), 0.0, 2 * np.pi)
    assert timestep.info.status["in_rejoin"].all()


def test_a_start_may_be_about_a_region_in_its_place_or_on_another_region() -> None:
    docking = jaxsafe.make("docking2d")
    zone = {"type": "circle", "name": "zone", "on": None, "radius": 1.0}
    zone["offset"] = {"type": "displacement", "by": [30.0, 40.0]}
    gate = {**zone, "name": "gate", "on": "zone"}
    about = {"type": "at_distance", "name": "position", "about": "gate", "distance": [2.0, 2.0]}
    alone = {
        "platforms": [docking.agent_platform, docking.platform("chief")],
        "regions": [*docking.regions, zone, gate],
        "deputy.start": [about],
    }
    env = jaxsafe.make("docking2d", alone)
    deputy = env.reset(jax.random.key(0))[0].sim.platforms["deputy"]
    way = np.asarray(deputy.position) - [60.0, 80.0]
    assert np.linalg.norm(way) == pytest.approx(2.0, rel=1e-4)
    for path, value, fault in (
        ("regions.zone.on", "deputy", "'gate'; choose from none"),
        ("deputy.start.position.about", "docking_region", "'docking_region'; choose from zone"),
    ):
        with pytest.raises(jaxsafe.ConfigError) as error:
            jaxsafe.make("docking2d", {**alone, path: value})
        place = "platforms.deputy.start.position.about: nothing placed before it is called "
        assert str(error.value).startswith(f"{place}{fault}")


def test_an_oriented_start_has_any_attitude_and_no_turn_rate() -> None:
    state, _ = draw_starts(
        jaxsafe.make("docking2d_oriented"), jax.random.split(jax.random.key(8), NUM_STARTS)
    )
    deputy = state.sim.platforms["deputy"]
    assert is_uniform(np.asarray(deputy.attitude, float), -np.pi, np.pi)
    assert not deputy.attitude_rate.any()
    distance = np.linalg.norm(np.asarray(deputy.position, float), axis=1)
    assert is_uniform(distance, 100.0, 150.0)
    for sample in (distance, deputy.position[:, 0], deputy.velocity[:, 1]):
        assert spearmanr(deputy.attitude, sample).pvalue > LEVEL


# Normal distributions and lists of cases


def test_a_normal_start_has_its_mean_and_deviation_in_each_component() -> None:
    normal = normalise(Normal(name="position", mean=(1.0, -20.0), deviation=(0.5, 3.0)))
    keys = jax.random.split(jax.random.key(0), NUM_STARTS)
    sample = np.asarray(jax.vmap(lambda key: normal.draw(key, {}, NOWHERE))(keys), float)
    assert kstest((sample[:, 0] - 1.0) / 0.5, "norm").pvalue > LEVEL
    assert kstest((sample[:, 1] + 20.0) / 3.0, "norm").pvalue > LEVEL
    assert spearmanr(*sample.T).pvalue > LEVEL


def test_a_normal_start_with_bounds_is_truncated_and_not_clipped() -> None:
    normal = normalise(Normal(name="speed", mean=10.0, deviation=2.0, low=9.0, high=13.0))
    keys = jax.random.split(jax.random.key(1), NUM_STARTS)
    sample = np.asarray(jax.vmap(lambda key: normal.draw(key, {}, NOWHERE))(keys), float)
    assert kstest(sample, "truncnorm", (-0.5, 1.5, 10.0, 2.0)).pvalue > LEVEL
    above = normalise(Normal(name="speed", mean=10.0, deviation=2.0, low=9.0))
    assert float(jax.vmap(lambda key: above.draw(key, {}, NOWHERE))(keys).max()) > 14.0


@pytest.mark.parametrize(
    ("numbers", "fault"),
    [
        ({"mean": (0.0, 0.0), "deviation": 1.0}, "of the same number of elements"),
        ({"mean": 0.0, "deviation": 1.0, "low": (0.0, 1.0)}, "of the same number of elements"),
        ({"mean": 0.0, "deviation": 1.0, "low": 2.0, "high": 1.0}, "expected low < high"),
        ({"mean": 0.0, "deviation": 1.0, "low": -2.0, "high": 1.0}, None),
    ],
)
def test_a_normal_start_needs_numbers_that_fit(numbers: dict, fault: str | None) -> None:
    problem = normalise(Normal(name="x", **numbers)).problem()
    assert problem is None if fault is None else fault in (problem or "")


CASES = {
    "position.x": (1.0, 2.0, 3.0),
    "heading": (10.0, 20.0, 30.0),
    "position.y": (4.0, 5.0, 6.0),
}


def test_the_fields_of_a_case_are_drawn_together_and_all_cases_alike() -> None:
    cases = normalise(Cases(name="start", values=CASES))
    assert set(cases.draws) == {"position", "heading"}
    keys = jax.random.split(jax.random.key(0), 3000)
    drawn = jax.vmap(lambda key: cases.draw(key, {}, NOWHERE))(keys)
    index = np.asarray(drawn["position"][:, 0], int)
    np.testing.assert_array_equal(drawn["position"][:, 1], index + 3.0)
    np.testing.assert_array_equal(drawn["heading"], 10.0 * index)
    assert chisquare(np.bincount(index)[1:]).pvalue > LEVEL


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({}, "expected at least one case"),
        ({"speed": ()}, "expected at least one case"),
        ({"speed": (1.0,), "heading": (1.0, 2.0)}, "same length, found heading 2, speed 1"),
        ({"position.x": (1.0,), "position.z": (1.0,)}, "or position.x, position.y; found"),
        ({"position": (1.0,), "position.x": (1.0,)}, "found position, position.x"),
    ],
)
def test_cases_need_columns_that_fit(values: dict, fault: str) -> None:
    assert fault in (normalise(Cases(name="start", values=values)).problem() or "")


USUAL = (
    Uniform(name="position", low=(0.0, 0.0), high=(1.0, 1.0)),
    Uniform(name="heading", low=-1.0, high=1.0),
)
CORNERS = {
    "low": {"position.y": (10.0, 20.0), "heading": (3.0, 4.0)},
    "high": {"position.y": (11.0, 22.0), "heading": (3.0, 5.0)},
}


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_share_of_the_starts_is_in_boxes_each_as_likely(share: float) -> None:
    mixed = normalise(SometimesInBoxes(name="boxes", share=share, **CORNERS))
    assert set(mixed.draws) == {"position", "heading"}
    usual_starts = [normalise(initializer) for initializer in USUAL]

    def draw(key: jax.Array) -> dict[str, jax.Array]:
        keys = jax.random.split(key, 3)
        drawn = {x.name: x.draw(k, {}, NOWHERE) for x, k in zip(usual_starts, keys, strict=False)}
        return mixed.draw(keys[2], drawn, NOWHERE)

    drawn = jax.vmap(draw)(jax.random.split(jax.random.key(0), NUM_STARTS))
    x, y = np.asarray(drawn["position"]).T
    heading = np.asarray(drawn["heading"])
    assert np.all((x >= 0.0) & (x <= 1.0))  # no box has this number
    usual = (y <= 1.0) & (np.abs(heading) <= 1.0)
    boxes = [(y >= 10.0) & (y <= 11.0) & (heading == 3.0), (y >= 20.0) & (heading >= 4.0)]
    assert np.all(usual | boxes[0] | boxes[1])
    counts = [usual.sum(), *(box.sum() for box in boxes)]
    expected = NUM_STARTS * np.array([1.0 - share, share / 2.0, share / 2.0])
    assert np.all(np.abs(counts - expected) <= 4.0 * np.sqrt(expected))
    if share:
        assert kstest((y[boxes[1]] - 20.0) / 2.0, "uniform").pvalue > LEVEL


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"low": {}}, "expected the same numbers in low and high, found none and"),
        ({"high": {"position.y": (1.0,), "heading": (3.0,)}}, "expected lists of one length"),
        ({"high": {"position.y": (9.0, 9.0), "heading": (3.0, 5.0)}}, "expected low ≤ high, which"),
        (
            {"low": {"position.a": (0.0,)}, "high": {"position.a": (1.0,)}},
            "expected a field, or a field and x, y or z, found position.a",
        ),
    ],
)
def test_boxes_need_corners_that_fit(changes: dict, fault: str) -> None:
    fields = {**CORNERS, **changes}
    assert fault in (normalise(SometimesInBoxes(name="boxes", **fields)).problem() or "")


@pytest.mark.parametrize(
    ("column", "fault"),
    [
        ("position.z", r"no such axis: position\.z, and position has 2"),
        ("heading", "start.boxes: heading: no such state field"),
        ("delta_v", "start.boxes: delta_v must be drawn before it, and nothing draws it"),
    ],
)
def test_a_box_of_a_field_that_is_not_drawn_is_refused(column: str, fault: str) -> None:
    corners = {"low": {column: [0.0]}, "high": {column: [1.0]}}
    boxes = SometimesInBoxes(name="boxes", **corners)
    usual = jaxsafe.make("docking2d").agent_platform.start
    with pytest.raises(jaxsafe.ConfigError, match=fault):
        jaxsafe.make("docking2d", {"deputy.start": [*usual, boxes]})


ENVIRONMENT = """\
agent: deputy
platforms:
- type: spacecraft
  name: deputy
  dimension: 2
  start: [{type: cases, name: start, file: starts.csv}]
  controller: {type: continuous, actuators: [{name: thrust_x, low: -1, high: 1}]}
terminal: [{type: timeout, name: timeout, limit: 10}]
reward: [{type: constant, name: time, value: -1}]
observation: [{type: observe, name: position, of: deputy, what: position}]
"""


def test_cases_are_read_beside_their_file_and_dumped_whole(tmp_path: Path) -> None:
    (tmp_path / "starts.csv").write_text("position.x, position.y,velocity.x,velocity.y\n1,2,3,4\n")
    path = tmp_path / "mine.yaml"
    path.write_text(ENVIRONMENT)
    env = jaxsafe.make(str(path))
    deputy = env.reset(jax.random.key(0))[0].sim.platforms["deputy"]
    assert deputy.position.tolist() == [1.0, 2.0]
    assert deputy.velocity.tolist() == [3.0, 4.0]
    (tmp_path / "starts.csv").unlink()
    text = jaxsafe.config.dump(env)
    assert "starts.csv" not in text
    assert jaxsafe.config.load(text) == env
    with pytest.raises(jaxsafe.ConfigError, match=r"deputy\.velocity is missing: it is random"):
        jaxsafe.reset_to(env, {"deputy": {"position": [0.0, 0.0]}})


@pytest.mark.parametrize("extra", [", values: {heading: [1]}, file: starts.csv", ""])
def test_cases_have_either_values_or_a_file(extra: str) -> None:
    text = ENVIRONMENT.replace(", file: starts.csv", extra)
    with pytest.raises(jaxsafe.ConfigError, match="expected `values` or the `file` of them"):
        jaxsafe.config.load(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"start \(cases\): cannot read .*starts\.csv: .*No such file"),
        ("", r"expected different names in row 1, found \[\]"),
        ("position.x,position.x\n1,2\n", "expected different names in row 1"),
        ("position.x,position.y\n1\n", "row 2: expected 2 numbers, found"),
        ("position.x,position.y\n1,2\n1,b\n", "row 3: expected 2 numbers, found"),
        ("position.x,position.y\n1,nan\n", r"values\.position\.y: expected a list of numbers"),
        ("position.x\n1\n", r"start\.start: position: expected shape \(2,\), found \(1,\)"),
        ("place\n1\n", r"start\.start: place: no such state field; choose from"),
    ],
)
def test_a_wrong_file_of_cases_is_told_in_one_line(
    text: str | None, message: str, tmp_path: Path
) -> None:
    if text is not None:
        (tmp_path / "starts.csv").write_text(text)
    path = tmp_path / "mine.yaml"
    path.write_text(ENVIRONMENT)
    with pytest.raises(jaxsafe.ConfigError, match=message) as caught:
        jaxsafe.make(str(path))
    assert "\n" not in str(caught.value)
