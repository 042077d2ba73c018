"""Disturbances, faults, delays, errors of sensors and of navigation, and what they leave alone."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.environment import modelled
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.uncertainty import in_unit_ball
from jaxsafe.types import State

KEY = jax.random.key(0)
PLACED = {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, 0.1]}}


def uncertain(*parts: dict[str, Any], task: str = "docking2d", **options: Any) -> Any:
    named = [{"name": part["type"], **part} for part in parts]
    return jaxsafe.make(task, {"uncertainty": named, **options.pop("overrides", {})}, **options)


def flown(env: Any, actions: list[Any], state: State | None = None) -> list[tuple[State, Any]]:
    state = jaxsafe.reset_to(env, PLACED, key=KEY)[0] if state is None else state
    found = []
    for action in actions:
        state, timestep = jaxsafe.step(env, state, jnp.asarray(action))
        found.append((state, timestep))
    return found


def deputy(env: Any, actions: list[Any]) -> Any:
    return flown(env, actions)[-1][0].sim.platforms["deputy"]


def test_a_disturbance_is_held_over_the_step_on_top_of_the_plant_s_own_motion() -> None:
    plain = deputy(jaxsafe.make("docking2d"), [[0.5, 0.0]])
    steady = {"type": "constant", "on": "deputy", "value": [0.01, -0.02]}
    pushed = deputy(uncertain(steady), [[0.5, 0.0]])
    np.testing.assert_allclose(pushed.velocity - plain.velocity, [0.01, -0.02], atol=1e-7)
    np.testing.assert_allclose(pushed.position - plain.position, [0.005, -0.01], atol=1e-4)
    drifted = deputy(uncertain({**steady, "kind": "wind"}), [[0.5, 0.0]])
    np.testing.assert_array_equal(drifted.velocity, plain.velocity)
    np.testing.assert_allclose(drifted.position - plain.position, [0.01, -0.02], atol=1e-4)


@pytest.mark.parametrize("task", ["rejoin2d", "rejoin3d"])
def test_a_pushed_aircraft_flies_with_the_velocity_that_the_push_leaves(task: str) -> None:
    plant = jaxsafe.make(task).platform("wingman")
    state = plant.reset(KEY, jaxsafe.reset(jaxsafe.make(task), KEY)[0].sim)
    push = jnp.arange(1.0, plant.dimension + 1.0)
    pushed = plant.pushed(state, push, jnp.zeros_like(push), jnp.asarray(2.0))
    np.testing.assert_allclose(pushed.velocity, state.velocity + 2.0 * push, rtol=1e-5)
    np.testing.assert_allclose(pushed.position, state.position + 2.0 * push, rtol=1e-5)
    assert abs(pushed.heading - state.heading) < 0.1


def test_random_disturbances_have_the_size_that_they_say() -> None:
    vectors = jax.vmap(lambda key: in_unit_ball(key, jnp.zeros(3)))(jax.random.split(KEY, 2000))
    lengths = np.linalg.norm(vectors, axis=1)
    assert 0.99 < lengths.max() <= 1.0 + 1e-6
    assert np.mean(lengths**3) == pytest.approx(0.5, abs=0.03)  # uniform in the ball

    env = uncertain(
        {"type": "gusts", "on": "deputy", "deviation": 2.0, "time_constant": 5.0, "bound": 3.0}
    )
    gusts = env.uncertainty[0]
    keys = jax.random.split(KEY, 2000)
    sim = jaxsafe.reset(env, KEY)[0].sim
    before = jax.vmap(lambda key: gusts.init(env, sim, key))(keys)
    after = jax.vmap(lambda key, x: gusts.increment(env, sim, key, x, jnp.zeros(2)))(
        jax.random.split(keys[0], 2000), before
    )
    assert np.std(after) == pytest.approx(2.0, rel=0.05)
    correlation = np.corrcoef(before[:, 0], after[:, 0])[0, 1]
    assert correlation == pytest.approx(np.exp(-1 / 5), abs=0.05)
    cut = jax.vmap(gusts.vector)(after)
    assert np.linalg.norm(cut, axis=1).max() <= 3.0 + 1e-5


def test_equal_keys_give_equal_episodes_and_others_give_others() -> None:
    env = uncertain(
        {"type": "normal", "on": "deputy", "deviation": 1e-3},
        overrides={"observation.position.noise": 1.0},
    )
    first, again, other = (
        flown(env, [[0.0, 0.0]] * 3, jaxsafe.reset(env, key)[0])
        for key in (KEY, KEY, jax.random.key(1))
    )
    pushes = [state.memory.uncertainty["normal"] for state, _ in first]
    assert len({tuple(np.asarray(push).tolist()) for push in pushes}) == 3  # drawn at every step
    for (state, timestep), (state_again, timestep_again) in zip(first, again, strict=True):
        jax.tree.map(np.testing.assert_array_equal, state, state_again)
        np.testing.assert_array_equal(timestep.observation, timestep_again.observation)
    assert not np.array_equal(
        first[0][0].memory.uncertainty["normal"], other[0][0].memory.uncertainty["normal"]
    )


def test_platforms_start_where_they_did_without_uncertainty() -> None:
    env = uncertain({"type": "normal", "on": "deputy", "deviation": 1e-3})
    with_it, without = (jaxsafe.reset(one, KEY)[0].sim for one in (env, jaxsafe.make("docking2d")))
    jax.tree.map(np.testing.assert_array_equal, with_it, without)


def test_a_perfect_world_keeps_nothing_for_uncertainty() -> None:
    state, _ = jaxsafe.reset(jaxsafe.make("docking2d"), KEY)
    assert state.key == ()
    assert state.memory.uncertainty == {} == state.memory.sensors


def test_faults_change_what_the_plant_receives_and_not_what_its_actuators_were_given() -> None:
    weak = uncertain({"type": "weak", "actuator": "thrust_x", "share": 0.5})
    (state, timestep) = flown(weak, [[1.0, 1.0]])[0]
    plain = jaxsafe.make("docking2d")
    expected = deputy(plain, [[0.5, 1.0]])
    np.testing.assert_array_equal(state.sim.platforms["deputy"].velocity, expected.velocity)
    np.testing.assert_array_equal(timestep.info.control_actual, [1.0, 1.0])

    stuck = uncertain({"type": "stuck", "actuator": "thrust_y", "at": -0.25, "since": 1.0})
    np.testing.assert_array_equal(
        deputy(stuck, [[0.0, 1.0], [0.0, 1.0]]).velocity,
        deputy(plain, [[0.0, 1.0], [0.0, -0.25]]).velocity,
    )


def test_thrusters_are_turned_together() -> None:
    turned = uncertain(
        {"type": "misaligned", "thrusters": ["thrust_x", "thrust_y"], "angle": np.pi / 2}
    )
    expected = deputy(jaxsafe.make("docking2d"), [[-0.5, 1.0]]).velocity
    np.testing.assert_allclose(deputy(turned, [[1.0, 0.5]]).velocity, expected, atol=1e-6)

    thrusters = ["thrust_x", "thrust_y", "thrust_z"]
    part = {"type": "misaligned", "thrusters": thrusters, "angle": np.pi / 2, "axis": [2.0, 0, 0]}
    env = uncertain(part, task="docking3d")
    received = env.uncertainty[0].received(env, None, (), jnp.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(received, [1.0, -3.0, 2.0], atol=1e-6)


def test_controls_arrive_late() -> None:
    late = uncertain({"type": "delay", "steps": 2})
    actions = [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.5, 0.5]]
    expected = deputy(jaxsafe.make("docking2d"), [[0.0, 0.0], [0.0, 0.0], *actions[:2]])
    np.testing.assert_array_equal(deputy(late, actions).velocity, expected.velocity)


@pytest.mark.thorough
def test_sensors_are_biased_noisy_late_and_drop_readings() -> None:
    def positions(steps: int = 6, **sensor: Any) -> np.ndarray:
        options = {f"observation.position.{name}": value for name, value in sensor.items()}
        env = jaxsafe.make("docking2d", options)
        state, first = jaxsafe.reset_to(env, PLACED, key=KEY)
        rows = [first, *(timestep for _, timestep in flown(env, [[1.0, 0.0]] * steps, state))]
        return np.stack([row.observation[:2] * 100.0 for row in rows])

    exact = positions()
    np.testing.assert_allclose(positions(bias=[3.0, -1.0]) - exact, [[3.0, -1.0]] * 7, atol=1e-4)
    np.testing.assert_array_equal(positions(delay=2), exact[[0, 0, 0, 1, 2, 3, 4]])
    np.testing.assert_array_equal(positions(dropout=1.0), exact[[0] * 7])
    noise = positions(noise=[2.0, 0.0], steps=60) - positions(steps=60)
    assert 1.4 < noise[:, 0].std() < 2.6
    np.testing.assert_array_equal(noise[:, 1], 0.0)


def test_navigation_is_what_filters_and_observations_see_and_the_end_of_an_episode_does_not() -> (
    None
):
    part = {"type": "navigation", "of": "deputy", "what": "velocity", "bias": [1.0, 0.0]}
    env = uncertain(part, rta="default")
    state, first = jaxsafe.reset_to(env, PLACED, key=KEY)
    np.testing.assert_allclose(first.observation[2:4] * 0.5, [1.0, 0.1], atol=1e-6)
    assert first.info.status["speed"] == pytest.approx(0.1)
    assert not first.info.rta.certified  # 1 m/s is above the limit
    assert first.info.margins["velocity_limit"] > 0.0
    _, timestep = flown(env, [[0.0, 0.0]], state)[0]
    assert timestep.info.intervening
    assert not timestep.done


def test_a_filter_predicts_with_numbers_of_its_own() -> None:
    env = jaxsafe.make("docking2d", {"rta.model.deputy.mass": 6.0}, rta="default")
    assert modelled(env).platform("deputy").mass == 6.0
    state = jaxsafe.reset_to(env, PLACED)[0]
    info = flown(env, [[0.3, 0.0]], state)[0][1].info
    light = jaxsafe.make("docking2d", {"deputy.mass": 6.0}, rta="default")
    predicted = flown(light, [[0.3, 0.0]])[0][1].info.rta.predicted_margin
    assert info.rta.predicted_margin == predicted != info.margins["velocity_limit"]


def test_a_filter_is_judged_by_the_numbers_that_it_predicts_with() -> None:
    """A spacecraft of 5000 kg cannot brake, whatever the true mass is."""
    heavy = {"deputy.mass": 5000.0}
    with pytest.raises(ConfigError, match="rta: thrust cannot hold the speed limit"):
        jaxsafe.make("docking2d", {"rta.model": heavy}, rta="default")
    with pytest.raises(ConfigError, match="rta: thrust cannot hold the speed limit"):
        jaxsafe.make("docking2d", heavy, rta="default")
    known_wrongly = {**heavy, "rta.model.deputy.mass": 12.0}
    assert jaxsafe.make("docking2d", known_wrongly, rta="default").rta is not None


def test_a_disturbance_chosen_from_outside_acts_and_is_cut_to_its_bound() -> None:
    env = uncertain({"type": "chosen", "on": "deputy", "bound": 0.05})
    state = jaxsafe.reset_to(env, PLACED)[0]
    memory = state.memory.replace(uncertainty={"chosen": jnp.array([3.0, 4.0])})
    pushed = flown(env, [[0.0, 0.0]], state.replace(memory=memory))[0][0].sim.platforms["deputy"]
    plain = deputy(jaxsafe.make("docking2d"), [[0.0, 0.0]])
    np.testing.assert_allclose(pushed.velocity - plain.velocity, [0.03, 0.04], atol=1e-6)


@pytest.mark.thorough
def test_a_step_is_differentiable_in_the_sizes_of_disturbances() -> None:
    env = uncertain({"type": "bounded", "on": "deputy", "bound": 1e-3})
    state = jaxsafe.reset_to(env, PLACED, key=KEY)[0]

    def velocity(bound: Any) -> Any:
        part = env.uncertainty[0].replace(bound=bound)
        after = jaxsafe.step(env.replace(uncertainty=(part,)), state, jnp.zeros(2))[0]
        return after.sim.platforms["deputy"].velocity

    slope = jax.jacfwd(velocity)(jnp.asarray(1e-3))
    drawn = jaxsafe.step(env, state, jnp.zeros(2))[0].memory.uncertainty["bounded"]
    np.testing.assert_allclose(slope * 1e-3, drawn, rtol=1e-4)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (
            {"type": "bounded", "on": "chief", "bound": 1.0},
            r"uncertainty\.bounded\.on: 'chief' is of type anchor, which nothing pushes",
        ),
        ({"type": "bounded", "on": "deputy", "bound": -1.0}, r"bound: expected a number ≥ 0"),
        (
            {"type": "constant", "on": "deputy", "value": [1.0, 2.0, 3.0]},
            r"uncertainty\.constant\.value: expected 2 numbers for 'deputy', found 3",
        ),
        (
            {"type": "weak", "actuator": "thrust", "share": 0.5},
            r"weak\.actuator: .* has no actuator 'thrust'\. Did you mean 'thrust_.'\? Choose from",
        ),
        (
            {"type": "navigation", "of": "deputy", "what": "speed", "bound": 1.0},
            r"uncertainty\.navigation\.what: deputy has no 'speed' in its state; choose from",
        ),
        (
            {"type": "misaligned", "thrusters": ["thrust_x"], "angle": 0.1},
            r"uncertainty\.misaligned: expected two or three thrusters, found thrust_x",
        ),
        ({"type": "delay", "steps": 0}, r"uncertainty\.delay\.steps: expected a whole number ≥ 1"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(part: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        uncertain(part)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            {"observation.range.noise": 1.0},
            r"observation\.range: unknown name 'range'; choose from",
        ),
        (
            {"observation.position.noise": [1.0, 2.0, 3.0]},
            r"noise: expected 1 or 2 numbers, found 3",
        ),
        ({"observation.position.dropout": 2.0}, r"dropout: expected a number in \[0, 1\]"),
        ({"rta.model.deputy.mas": 1.0}, r"rta\.model: deputy\.mas: unknown field 'mas'"),
        ({"rta.model.deputy.mass": -1.0}, r"rta\.model: deputy\.mass: expected a number in kg > 0"),
        (
            {"rta.model.rta.margin": 1.0},
            r"rta\.margin: expected the path of a number that a filter",
        ),
    ],
)
def test_numbers_that_are_nowhere_are_told_in_one_line(
    overrides: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        jaxsafe.make("docking2d", overrides, rta="default")


def test_a_chosen_start_needs_a_key_where_disturbances_are_random() -> None:
    env = uncertain({"type": "bounded", "on": "deputy", "bound": 1e-3})
    with pytest.raises(ConfigError, match=r"uncertainty\.bounded is random in every step"):
        jaxsafe.reset_to(env, PLACED)
