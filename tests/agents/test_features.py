from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.agents.agent import Agent, check_agent
from jaxsafe.agents.features import (
    ApproachFeatures,
    DockingFeatures,
    FarApproachFeatures,
    FarDirectionsFeatures,
    FarOrientedFeatures,
    Features,
    PlainFeatures,
    RejoinFeatures,
)
from jaxsafe.agents.networks import MLP, Directional
from jaxsafe.schema.errors import ConfigError

KEY = jax.random.key(3)
COURSE = np.array([-300.0, 250.0])
"""The lead's velocity seen from the wingman.

One flies along x at 300 ft/s and the other along y at 250.
"""


def observed(task: str, ahead: np.ndarray) -> tuple[jaxsafe.Environment, jax.Array]:
    """Return what the wingman observes with the lead at a place relative to it."""
    env = jaxsafe.make(task)
    rest = [0.0] * (env.observation_names.count("lead_position.z"))
    lead = {"position": [*ahead, *rest], "heading": np.pi / 2, "speed": 250.0}
    wingman = {"position": [0.0, 0.0, *rest], "heading": 0.0, "speed": 300.0}
    _, timestep = jaxsafe.reset_to(env, {"lead": lead, "wingman": wingman})
    return env, timestep.observation


def seen_inbound(
    task: str, distance: float
) -> tuple[jaxsafe.Environment, jax.Array, list[float], float]:
    """Return what a deputy on the x axis observes that flies inwards and a little sideways.

    Its speed towards the chief is 80 % of the limit, and 0.3 m/s across. Return the environment,
    the observation, a zero for the third axis if there is one, and the limit.
    """
    env = jaxsafe.make(task)
    rest = [0.0] * env.observation_names.count("position.z")
    limit = 0.2 + 2.0 * 0.001027 * distance
    deputy = {"position": [distance, 0.0, *rest], "velocity": [-0.8 * limit, 0.3, *rest]}
    _, timestep = jaxsafe.reset_to(env, {"deputy": deputy})
    return env, timestep.observation, rest, limit


def test_docking_features_are_direction_and_log_distance() -> None:
    env = jaxsafe.make("docking3d")
    agent = Agent(features=DockingFeatures())
    _, timestep = jaxsafe.reset_to(
        env, {"deputy": {"position": [30.0, 0.0, 40.0], "velocity": [0.0, 0.0, 0.0]}}
    )
    inputs = agent.inputs(env, timestep.observation)
    np.testing.assert_array_equal(inputs[:8], timestep.observation)
    np.testing.assert_allclose(inputs[8:], [0.3 / 0.51, 0.0, 0.4 / 0.51, np.log(0.505)], rtol=1e-6)
    assert agent.init(KEY, env)["actor"]["hidden_0"]["kernel"].shape == (12, 64)


@pytest.mark.parametrize("task", ["docking2d", "docking3d", "docking2d_oriented"])
def test_approach_features_measure_the_velocity_by_its_limit(task: str) -> None:
    env = jaxsafe.make(task)
    rest = [0.0] * env.observation_names.count("position.z")
    deputy = {"position": [60.0, 0.0, *rest], "velocity": [-0.1, 0.2, *rest]}
    _, timestep = jaxsafe.reset_to(
        env, {"deputy": deputy | ({"attitude": 0.0} if task == "docking2d_oriented" else {})}
    )
    inputs = np.asarray(Agent(features=ApproachFeatures()).inputs(env, timestep.observation))
    # The oriented craft observes the chief, seen from the deputy.
    sign = -1.0 if task == "docking2d_oriented" else 1.0
    velocity = np.array([-0.1, 0.2, *rest]) / (0.2 + 0.002054 * 60.0)
    d = velocity.size
    size = env.observation_size
    without = ApproachFeatures(with_observation=False)(env, timestep.observation)
    np.testing.assert_array_equal(without, inputs[size:])
    measured, along, across, speed = np.split(inputs[size + d + 1 :], np.cumsum([d, 1, d]))
    np.testing.assert_allclose(measured, velocity, rtol=1e-5)
    # The direction has length ‖p‖/(‖p‖ + 0.001).
    np.testing.assert_allclose(along, sign * velocity[0], rtol=3e-3)
    np.testing.assert_allclose(across, [0.0, *velocity[1:]], atol=2e-3)
    np.testing.assert_allclose(speed, np.linalg.norm(velocity), rtol=1e-5)
    np.testing.assert_array_equal(
        inputs[: size + d + 1], Agent(features=DockingFeatures()).inputs(env, timestep.observation)
    )


@pytest.mark.parametrize("task", ["docking2d", "docking3d"])
@pytest.mark.parametrize("distance", [100.0, 10_000.0])
def test_far_approach_features_measure_by_full_thrust(task: str, distance: float) -> None:
    env, observation, rest, limit = seen_inbound(task, distance)
    n, full_thrust = 0.001027, 1.0 / 12.0
    inputs = np.asarray(FarApproachFeatures()(env, observation))
    approach = ApproachFeatures(with_observation=False)(env, observation)
    np.testing.assert_array_equal(inputs[: approach.size], approach)
    d = 2 + len(rest)
    missing, along, across, held = np.split(inputs[approach.size :], [1, 1 + d, 1 + 2 * d])
    np.testing.assert_allclose(missing, np.arcsinh(0.2 * limit / full_thrust), rtol=1e-3)
    np.testing.assert_allclose(along, [missing[0], 0.0, *rest], rtol=1e-3)
    np.testing.assert_allclose(across, [0.0, np.arcsinh(0.3 / full_thrust), *rest], atol=0.02)
    # ẍ = 2nẏ + 3n²x, ÿ = −2nẋ, and the limit falls by 2n times the speed.
    falls = 2.0 * n * 0.8 * limit
    needed = [falls - 2.0 * n * 0.3 - 3.0 * n**2 * distance, -2.0 * n * 0.8 * limit]
    np.testing.assert_allclose(held, np.array([*needed, *rest]) / full_thrust, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("task", ["docking2d", "docking3d"])
@pytest.mark.parametrize("distance", [100.0, 10_000.0])
def test_far_directions_features_measure_by_full_thrust(task: str, distance: float) -> None:
    env, observation, rest, limit = seen_inbound(task, distance)
    n, full_thrust = 0.001027, 1.0 / 12.0
    inputs = np.asarray(FarDirectionsFeatures()(env, observation))
    d = 2 + len(rest)
    numbers, away, aside, held = np.split(inputs, [11, 11 + d, 11 + 2 * d])
    speed = np.hypot(0.8 * limit, 0.3)
    # ẍ = 2nẏ + 3n²x, ÿ = −2nẋ, and the limit falls by 2n times the speed towards the chief.
    falls = 2.0 * n * 0.8 * limit / full_thrust
    pulled = np.array([0.6 * n + 3.0 * n**2 * distance, 1.6 * n * limit]) / full_thrust
    needed = [falls - pulled[0], -pulled[1]]
    expected = [
        np.log(distance / 100.0 + 0.005),
        0.8,
        0.3 / limit,
        speed / limit,
        np.log1p(0.2 * limit / full_thrust),
        np.log1p(0.3 / full_thrust),
        -np.log1p((speed - limit) / full_thrust)
        if speed > limit
        else np.log1p((limit - speed) / full_thrust),
        falls + (-0.8 * limit * pulled[0] + 0.3 * pulled[1]) / speed,
        needed[0],
        needed[1],
        np.hypot(*needed),
    ]
    # Directions have a length of ‖w‖/(‖w‖ + Δ/10), and of that less a thousandth of a unit.
    np.testing.assert_allclose(numbers, expected, rtol=0.04, atol=1e-3)
    np.testing.assert_allclose(away, [1.0, 0.0, *rest], atol=2e-3)
    np.testing.assert_allclose(aside, [0.0, 1.0, *rest], atol=0.03)
    np.testing.assert_allclose(held, [*needed, *rest], rtol=2e-3, atol=1e-6)


def test_far_oriented_features_turn_with_the_body_alone() -> None:
    env = jaxsafe.make("docking2d_oriented")
    start = {"position": [3000.0, -4000.0], "velocity": [-5.0, 2.0]}
    seen = []
    for attitude in (0.0, 1.2):
        deputy = {**start, "attitude": attitude, "attitude_rate": 0.01}
        _, timestep = jaxsafe.reset_to(env, {"deputy": deputy})
        seen.append(np.asarray(FarOrientedFeatures()(env, timestep.observation)))
    straight, turned = seen
    np.testing.assert_allclose(turned[:12], straight[:12], rtol=1e-4, atol=1e-5)
    assert straight[11] == pytest.approx(0.01 / (np.pi / 90), rel=1e-5)
    to_body = np.array([[np.cos(1.2), np.sin(1.2)], [-np.sin(1.2), np.cos(1.2)]])
    for first in (12, 14):
        part = slice(first, first + 2)
        np.testing.assert_allclose(turned[part], to_body @ straight[part], atol=1e-5)
    # Without a turn the body frame is Hill's.
    away = np.array([0.6, -0.8])
    np.testing.assert_allclose(straight[12:14], away * 10.0 / 5010.0, rtol=1e-4)
    n, full_thrust = 0.001027, 2.0 / 12.0
    closing = 2.0 * n * (5.0 * 0.6 + 2.0 * 0.8)
    pulled = np.array([4.0 * n + 3.0 * n**2 * 3000.0, 10.0 * n])
    held = (closing * away - pulled) / full_thrust
    np.testing.assert_allclose(straight[[8, 10]], [held @ away, np.hypot(*held)], rtol=1e-4)
    aim = -0.95 * (0.2 + 2.0 * n * 5000.0) * away
    push = held + (aim - start["velocity"]) / (8.0 * full_thrust)
    size = np.hypot(*push)
    np.testing.assert_allclose(straight[14:16], push / (size + 0.05), rtol=1e-4)
    compressed = [np.log1p(4.0 * size), *(np.sign(push) * np.log1p(4.0 * np.abs(push)))]
    np.testing.assert_allclose(straight[16:], compressed, rtol=1e-4)


@pytest.mark.parametrize("task", ["docking2d", "docking3d"])
def test_a_directional_actor_turns_its_control_with_the_vectors(task: str) -> None:
    env = jaxsafe.make(task)
    agent = Agent(features=FarDirectionsFeatures(), actor=Directional(hidden=(16,)))
    params = agent.init(KEY, env)
    _, timestep = env.reset(KEY)
    inputs = agent.inputs(env, timestep.observation)
    d = env.action_size
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(d, d)))[0]
    vectors = np.asarray(inputs[11:]).reshape(3, d)
    turned = np.concatenate([inputs[:11], (vectors @ turn).ravel()])
    control, also_turned = (
        np.asarray(agent.distribution(env, params, jnp.asarray(seen)).mode())
        for seen in (inputs, turned)
    )
    assert np.abs(control).max() > 1e-4
    np.testing.assert_allclose(also_turned, control @ turn, atol=1e-6)
    assert agent.networks["critic"] == MLP(hidden=(16,))


@pytest.mark.parametrize(
    ("changes", "agent", "message"),
    [
        (
            {},
            {"actor": Directional()},
            "agent.actor: 'directional' needs features with 3 vectors, found 'none' with 0",
        ),
        (
            {"actions": "discrete"},
            {"features": FarDirectionsFeatures(), "actor": Directional()},
            "agent.actor: 'directional' needs continuous actions, found discrete ones; choose mlp",
        ),
        (
            {},
            {"critic": Directional()},
            "agent.critic: 'directional' is for an actor; choose mlp",
        ),
    ],
)
def test_what_a_directional_actor_needs(
    changes: dict[str, Any], agent: dict[str, Any], message: str
) -> None:
    env = jaxsafe.make("docking2d", **changes)
    with pytest.raises(ConfigError) as error:
        check_agent(Agent(**agent), env)
    assert str(error.value) == message


def test_features_of_far_starts_need_a_point_mass() -> None:
    env = jaxsafe.make("docking2d_oriented")
    _, timestep = env.reset(KEY)
    for features in (FarApproachFeatures(), FarDirectionsFeatures()):
        with pytest.raises(ConfigError, match=r"needs a point mass .* choose approach"):
            features(env, timestep.observation)


def test_features_of_far_starts_need_the_axes_of_the_thrusters() -> None:
    env = jaxsafe.make("docking2d")
    position, *others = env.observation
    env = env.replace(observation=(position.replace(frame="deputy"), *others))
    message = "needs the observation 'position' in the axes of the thrusters, found it in the frame"
    for features in (FarApproachFeatures(), FarDirectionsFeatures()):
        with pytest.raises(ConfigError, match=message):
            features(env, jnp.zeros(env.observation_size))


def test_far_oriented_features_need_a_body_that_is_observed_in_its_frame() -> None:
    env = jaxsafe.make("docking2d")
    with pytest.raises(ConfigError, match="'far_oriented' needs an oriented_spacecraft"):
        FarOrientedFeatures()(env, jnp.zeros(env.observation_size))
    env = jaxsafe.make("docking2d_oriented")
    position, *others = env.observation
    env = env.replace(observation=(position.replace(frame=None), *others))
    with pytest.raises(ConfigError, match="needs the observation 'position' in the frame of"):
        FarOrientedFeatures()(env, jnp.zeros(env.observation_size))


def test_plain_agents_see_the_observation_and_nothing_else() -> None:
    env = jaxsafe.make("docking2d")
    _, timestep = env.reset(KEY)
    np.testing.assert_array_equal(
        Agent(features=PlainFeatures()).inputs(env, timestep.observation), timestep.observation
    )


@pytest.mark.parametrize("task", ["rejoin2d", "rejoin3d"])
def test_rejoin_features_tell_a_collision_course(task: str) -> None:
    env, observation = observed(task, -2.0 * COURSE)
    inputs = np.asarray(Agent(features=RejoinFeatures()).inputs(env, observation))
    size = env.observation_size
    d = 3 if task == "rejoin3d" else 2
    np.testing.assert_array_equal(inputs[:size], observation)
    level = d if task == "rejoin3d" else 0
    _, way, near, relative, change, urgent, closing, across, miss, danger = np.split(
        inputs[size:], np.cumsum([level, d, d, d, d, d, 1, d, d])
    )
    assert np.abs(way).max() <= 1.0
    np.testing.assert_allclose(near, np.clip(5.0 * way, -1.0, 1.0), rtol=1e-6)
    np.testing.assert_allclose(relative[:2], COURSE / 400.0, atol=1e-6)
    np.testing.assert_allclose(400.0 * change, 400.0 * relative + 1000.0 * way / 10.0, rtol=1e-5)
    np.testing.assert_allclose(urgent, np.clip(5.0 * change, -1.0, 1.0), rtol=1e-6)
    # The direction of w has length ‖w‖/(‖w‖ + 0.01).
    np.testing.assert_allclose(closing, -1.0, atol=0.02)
    np.testing.assert_allclose([*across, *miss], 0.0, atol=0.1)
    np.testing.assert_allclose(danger, 1.0, atol=0.05)


def test_rejoin_features_are_level_however_the_wingman_rolls() -> None:
    env = jaxsafe.make("rejoin3d")
    inputs = []
    for roll, climb in ((0.0, 0.0), (0.7, 0.2), (-0.9, -0.3)):
        lead = {"position": [600.0, -300.0, 100.0], "heading": 0.4, "speed": 250.0}
        wingman = {
            "position": [0.0, 0.0, 0.0],
            "heading": 0.2,
            "speed": 300.0,
            "roll": roll,
            "flight_path_angle": climb,
        }
        _, timestep = jaxsafe.reset_to(env, {"lead": lead, "wingman": wingman})
        inputs.append(
            np.asarray(Agent(features=RejoinFeatures()).inputs(env, timestep.observation))[
                env.observation_size :
            ]
        )
    turn = np.array(
        [[np.cos(0.2), np.sin(0.2), 0.0], [-np.sin(0.2), np.cos(0.2), 0.0], [0.0, 0.0, 1.0]]
    )
    ahead = turn @ [600.0, -300.0, 100.0]
    np.testing.assert_allclose(inputs[0][:3], ahead / np.linalg.norm(ahead), atol=1e-6)
    for other in inputs[1:]:
        # These inputs are the lead, and the vector to the rejoin point.
        np.testing.assert_allclose(other[:9], inputs[0][:9], atol=1e-5)


@pytest.mark.parametrize("task", ["rejoin2d", "rejoin3d"])
def test_rejoin_features_measure_by_how_much_the_lead_is_missed(task: str) -> None:
    left = 300.0 * np.array([-COURSE[1], COURSE[0]]) / np.linalg.norm(COURSE)
    env, observation = observed(task, -COURSE + left)
    inputs = np.asarray(Agent(features=RejoinFeatures()).inputs(env, observation))
    d = 3 if task == "rejoin3d" else 2
    miss = inputs[-2 - d : -2]
    danger = inputs[-2:]
    np.testing.assert_allclose(1000.0 * miss[:2] / 4.0, left, atol=10.0)
    assert (danger < 0.15).all()
    env, observation = observed(task, COURSE)  # the lead flies away
    np.testing.assert_array_equal(
        Agent(features=RejoinFeatures()).inputs(env, observation)[-2:], 0.0
    )


def test_the_names_of_an_observation_are_worked_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    env, observation = observed("rejoin3d", COURSE)
    traced = []
    reset = jaxsafe.environment.reset
    monkeypatch.setattr("jaxsafe.environment.reset", lambda *args: traced.append(1) or reset(*args))
    Agent(features=RejoinFeatures()).inputs(env.replace(dt=env.dt), observation)
    assert len(traced) == 1


@pytest.mark.parametrize(
    ("features", "task", "missing"),
    [
        (DockingFeatures(), "rejoin2d", "position.x"),
        (RejoinFeatures(), "docking3d", "lead_position.magnitude"),
    ],
)
def test_features_of_another_task_are_refused(features: Features, task: str, missing: str) -> None:
    env = jaxsafe.make(task)
    message = f"agent.features: '{features.type_name}' needs an observation called '{missing}'"
    with pytest.raises(ConfigError, match=message):
        features(env, jnp.zeros(env.observation_size))


def test_features_of_an_observation_with_an_offset_are_refused() -> None:
    env = jaxsafe.make("docking2d", {"observation.position.offset": [50.0, 0.0]})
    message = "agent.features: 'docking' needs the observation 'position' without an offset"
    with pytest.raises(ConfigError, match=message):
        Agent(features=DockingFeatures()).inputs(env, jnp.zeros(6))
