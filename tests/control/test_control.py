"""Classical controllers fly their tasks, from the whole state or from the observation."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import jaxsafe
from jaxsafe.commands.evaluate import main
from jaxsafe.commands.export import main as export
from jaxsafe.control import LQR, MPC, PD, Align, ControlLaw, Pursuit, observed_sim
from jaxsafe.control.docking import linear_model
from jaxsafe.control.riccati import lqr_gain, riccati
from jaxsafe.envs import STARTERS, TASKS
from jaxsafe.rollout import RecurrentPolicy
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import read_json
from jaxsafe.types import State

PAIRS = [
    (task.name, name) for task in (*STARTERS.values(), *TASKS.values()) for name in task.controllers
]
OWN = """
import jax
from jaxsafe.control import PD
from jaxsafe.rollout import RecurrentPolicy

def drawn(key, observation):
    return jax.random.uniform(key, (*observation.shape[:-1], 2))

def alone(seen):
    return seen[..., :2]

law = PD(share=0.5)
forgets = RecurrentPolicy(alone, 0.0)
remembering = RecurrentPolicy(lambda key, seen, memory: (0.0 * seen[..., :2], memory), 0.0)
number = 3
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a user's module, and make an empty directory the current one."""
    (tmp_path / "own_of_control_test.py").write_text(OWN, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return "own_of_control_test"


def placed(env: jaxsafe.Environment, position: list[float], velocity: list[float]) -> State:
    return jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": velocity}})[0]


def test_every_task_has_a_controller() -> None:
    assert {task for task, _ in PAIRS} == {*STARTERS, *TASKS}


@pytest.mark.parametrize("size", [1, 2, 3])
def test_riccati_is_that_of_scipy(size: int) -> None:
    rng = np.random.default_rng(size)
    a, b = rng.normal(size=(2 * size, 2 * size)), rng.normal(size=(2 * size, size))
    q, r = np.diag(rng.uniform(0.1, 2.0, 2 * size)), np.diag(rng.uniform(0.1, 2.0, size))
    wanted = scipy.linalg.solve_discrete_are(a, b, q, r)
    np.testing.assert_allclose(riccati(a, b, q, r), wanted, rtol=1e-8, atol=1e-8)


def test_a_plant_that_no_control_reaches_is_refused() -> None:
    with pytest.raises(ConfigError, match="the Riccati equation has no solution"):
        riccati(np.diag([2.0, 0.5]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1))


@pytest.mark.parametrize("task", ["docking1d", "docking2d", "docking3d"])
def test_lqr_is_optimal_for_the_step_of_the_plant(task: str) -> None:
    env = jaxsafe.make(task)
    size = env.action_size
    a, b = linear_model(env)
    x = np.arange(1.0, 2 * size + 1)
    later = env.agent_platform.step(
        env.agent_platform.rest().replace(position=x[:size], velocity=x[size:]),
        dict.fromkeys(env.action_names, jnp.float32(0.5)),
        env.dt,
    )
    wanted = np.concatenate([later.position, later.velocity])
    np.testing.assert_allclose(a @ x + b @ np.full(size, 0.5), wanted, rtol=1e-5)
    q = np.diag([1 / 150.0**2] * size + [1 / 0.5**2] * size)
    p = scipy.linalg.solve_discrete_are(a, b, q, np.eye(size))
    gain = np.linalg.solve(np.eye(size) + b.T @ p @ b, b.T @ p @ a)
    np.testing.assert_allclose(LQR().design(env), gain, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(lqr_gain(a, b, q, np.eye(size)), gain, rtol=1e-6, atol=1e-9)


def require_the_same_control(env: jaxsafe.Environment, name: str) -> None:
    """Compare the action for a state on its way with that for what is observed of it."""
    policy = jaxsafe.load_policy(f"controller/{name}", env=env)
    state, _ = jaxsafe.reset(env, jax.random.key(3))
    step = jax.jit(jaxsafe.step)
    for seed in range(4):
        action = jax.random.uniform(jax.random.key(seed), (env.action_size,), minval=-1.0)
        state, timestep = step(env, state, action)
    whole = jax.jit(policy.action)(state)  # type: ignore[union-attr]
    batch = jnp.stack([timestep.observation] * 2)
    found = jax.jit(policy)(jax.random.key(0), batch)
    np.testing.assert_allclose(found, [whole, whole], atol=2e-3)
    assert np.abs(whole).max() <= 1.0
    assert np.abs(whole).max() > 0.01


@pytest.mark.parametrize(("task", "name"), PAIRS)
def test_the_observation_gives_the_control_of_the_whole_state(task: str, name: str) -> None:
    require_the_same_control(jaxsafe.make(task), name)


@pytest.mark.thorough
@pytest.mark.parametrize(("task", "name"), [pair for pair in PAIRS if pair[0] in TASKS])
def test_the_same_holds_as_the_released_code_observes(task: str, name: str) -> None:
    require_the_same_control(jaxsafe.make(task, variant="released"), name)


def test_an_observation_shows_the_state_up_to_a_shift_and_a_turn() -> None:
    env = jaxsafe.make("rejoin3d")
    state, timestep = jaxsafe.reset(env, jax.random.key(0))
    seen = observed_sim(env, timestep.observation)
    own, shown = state.sim.platforms["wingman"], seen.platforms["wingman"]
    lead, shown_lead = state.sim.platforms["lead"], seen.platforms["lead"]
    for field in ("speed", "roll", "flight_path_angle"):
        np.testing.assert_allclose(getattr(shown, field), getattr(own, field), atol=1e-4)
    np.testing.assert_allclose(shown_lead.speed, lead.speed, rtol=1e-5)
    turned = (lead.heading - own.heading) - (shown_lead.heading - shown.heading)
    np.testing.assert_allclose(np.cos(turned), 1.0, atol=1e-6)
    assert np.linalg.norm(lead.position - own.position) > 5000.0
    np.testing.assert_allclose(np.linalg.norm(shown_lead.position), 1000.0, rtol=1e-5)  # clipped


def test_discrete_actions_are_the_nearest_choices() -> None:
    env = jaxsafe.make("docking2d", actions="discrete")
    policy = PD().policy(env)
    state, _ = jaxsafe.reset(env, jax.random.key(0))
    action = policy.action(state)
    assert action.dtype == jnp.int32
    np.testing.assert_allclose(-1.0 + 0.2 * action, policy.control(state.sim), atol=0.1 + 1e-6)
    mixed = jaxsafe.make(
        "docking2d", {"deputy.controller.actuators.thrust_x.discrete": True}, actions="mixed"
    )
    both = PD().policy(mixed).action(state)
    np.testing.assert_allclose(both, [action[0], policy.control(state.sim)[1]], atol=1e-6)


@pytest.mark.thorough
def test_mpc_finds_the_optimal_plan_within_limits() -> None:
    env = jaxsafe.make("docking2d")
    law = MPC(horizon=6)
    a, b = linear_model(env)
    held = np.sum([np.linalg.matrix_power(a, i) @ b for i in range(4)], axis=0)
    a = np.linalg.matrix_power(a, 4)
    q, r = np.diag([1 / 25.0] * 2 + [1.0] * 2), np.eye(2)
    last = scipy.linalg.solve_discrete_are(a, held, q, r)

    for start in ([100.0, -60.0, 0.1, -0.2], [30.0, 5.0, -0.2, -0.05], [-3.0, 2.0, 0.1, -0.1]):
        x = np.array(start)
        outwards = x[:2] / np.linalg.norm(x[:2])

        def states(plan: np.ndarray, x: np.ndarray = x) -> np.ndarray:
            found = [x]
            for thrust in plan.reshape(-1, 2):
                found.append(a @ found[-1] + held @ thrust)
            return np.array(found[1:])

        def cost(plan: np.ndarray, states=states) -> float:
            found = states(plan)
            end = found[-1] @ last @ found[-1]
            return sum(y @ q @ y for y in found[:-1]) + end + plan @ plan

        def spare(plan: np.ndarray, states=states, outwards=outwards) -> np.ndarray:
            found = states(plan)
            limit = 0.98 * (0.2 + 2 * 0.001027 * found[:, :2] @ outwards)
            return limit - np.sqrt(np.sum(found[:, 2:] ** 2, axis=1) + 1e-12)

        best = scipy.optimize.minimize(
            cost,
            np.zeros(12),
            method="SLSQP",
            bounds=[(-1.0, 1.0)] * 12,
            constraints=[{"type": "ineq", "fun": spare}],
            options={"maxiter": 500, "ftol": 1e-10},
        )
        sim = placed(env, start[:2], start[2:]).sim
        control = law.policy(env).control(sim)
        np.testing.assert_allclose(control, best.x[:2], atol=2e-2)
        exact = MPC(horizon=6, iterations=1000).policy(env).control(sim)
        np.testing.assert_allclose(exact, best.x[:2], atol=1e-3)


def test_mpc_plans_where_the_speed_limit_has_no_floor() -> None:
    env = jaxsafe.make("docking2d", {"status.velocity_limit.floor": 0.0})
    control = MPC().policy(env).control(placed(env, [100.0, 0.0], [0.0, 0.0]).sim)
    assert np.isfinite(control).all()
    assert control[0] < -0.1  # towards the chief


@pytest.mark.thorough
@pytest.mark.parametrize(("task", "name"), PAIRS)
def test_controllers_succeed_from_a_thousand_starts(task: str, name: str) -> None:
    env = jaxsafe.make(task)
    policy = jaxsafe.load_policy(f"controller/{name}", env=env)
    found = jaxsafe.evaluate(env, policy, jax.random.key(1), 100 if name == "mpc" else 1000)
    assert found["success_rate"] >= 0.99  # type: ignore[operator]
    assert found["episode_safety_violation_rate"] <= 0.001  # type: ignore[operator]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("task", "name"), [("docking2d", "pd"), ("docking3d", "mpc"), ("docking2d_oriented", "align")]
)
def test_docking_also_succeeds_from_a_kilometre(task: str, name: str) -> None:
    env = jaxsafe.make(task, {"deputy.start.position.distance": [1000.0, 1000.0]})
    policy = jaxsafe.load_policy(f"controller/{name}", env=env)
    found = jaxsafe.evaluate(env, policy, jax.random.key(0), 100)
    assert found["success_rate"] == 1.0
    assert found["episode_safety_violation_rate"] <= 0.001  # type: ignore[operator]


def test_pursuit_goes_around_the_lead() -> None:
    env = jaxsafe.make("rejoin2d")
    flown = {"heading": 0.0, "speed": 250.0}
    start = {name: {"position": [0.0, 0.0], **flown} for name in ("lead", "wingman")}
    point = jaxsafe.reset_to(env, start)[0].sim.regions["rejoin_region"].position
    start["wingman"]["position"] = -1.5 * point  # the lead is on the straight way to the point
    policies = {"around": Pursuit(), "straight": Pursuit(clearance=0.0, yielding=10.0)}
    flights = {
        name: jaxsafe.fly(env, law.policy(env), start=start) for name, law in policies.items()
    }
    assert flights["straight"].outcome == "crash"
    assert flights["around"].outcome == "success"
    assert flights["around"].margins["collision"].min() > 50.0


def test_align_flies_actuators_in_any_order() -> None:
    names = ["thrust", "attitude_acceleration"]
    controls = []
    for order in (names, names[::-1]):
        env = jaxsafe.make("docking2d_oriented", {"deputy.controller.actuators": order})
        state, _ = jaxsafe.reset(env, jax.random.key(0))
        control = Align().policy(env).control(state.sim)
        controls.append([float(control[order.index(name)]) for name in names])
    assert controls[0] == controls[1]


def test_a_controller_says_what_it_is_and_what_it_lacks() -> None:
    env = jaxsafe.make("docking2d")
    text = repr(jaxsafe.load_policy("controller/pd", env=env))
    assert "Control law pd" in text
    assert "share" in text
    cases = [
        (lambda: jaxsafe.load_policy("controller/pd"), "env: missing; the environment in which"),
        (
            lambda: jaxsafe.load_policy("controller/pf", env=env),
            "controller: docking2d has no controller 'pf'. Did you mean 'pd'. Choose from pd, lqr",
        ),
        (
            lambda: LQR().policy(jaxsafe.make("rejoin2d")),
            "controller: lqr gives thrust_x, thrust_y",
        ),
        (lambda: Pursuit().policy(env), "controller: pursuit flies dubins2d and dubins3d; deputy"),
        (
            lambda: Pursuit(lead="deputy").policy(jaxsafe.make("rejoin2d")),
            "controller: pursuit follows 'deputy'; there is lead",
        ),
        (
            lambda: Align().policy(
                jaxsafe.make("docking2d_oriented", {"deputy.controller.actuators": ["thrust"]})
            ),
            "controller: align gives thrust, attitude_acceleration; deputy takes thrust",
        ),
        (
            lambda: Pursuit().policy(
                jaxsafe.make(
                    "rejoin3d", {"wingman.controller.actuators.roll_rate.name": "heading_rate"}
                )
            ),
            "controller: pursuit gives roll_rate, flight_path_angle_rate, acceleration; wingman",
        ),
        (
            lambda: PD().policy(env)(None, jnp.zeros(5)),
            r"observation: expected 6 numbers on the last axis, found shape \(5,\)",
        ),
    ]
    for call, message in cases:
        with pytest.raises(ConfigError, match=message):
            call()
    blind = jaxsafe.make("docking2d", {"observation": ["velocity"]})
    with pytest.raises(ConfigError, match="needs the position of deputy, which is not observed"):
        PD().policy(blind)(None, jnp.zeros(2))
    state, _ = jaxsafe.reset(blind, jax.random.key(0))
    assert PD().policy(blind).action(state).shape == (2,)  # the whole state is enough


def test_an_environment_from_a_file_knows_all_controllers(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(jaxsafe.dump(jaxsafe.make("docking2d")), encoding="utf-8")
    env = jaxsafe.make(file)
    assert isinstance(jaxsafe.load_policy("controller/lqr", env=env).law, LQR)  # type: ignore[union-attr]
    with pytest.raises(ConfigError, match="mine has no controller 'x'; choose from pd, lqr"):
        jaxsafe.load_policy("controller/x", env=env)


@pytest.mark.thorough
def test_the_command_flies_and_films_a_controller(own: str) -> None:
    words = ["run=controller/pd", "env=docking2d", "episodes=5", "rta=default", "render=gif"]
    assert main([*words, "out=found"]) == 0
    results = read_json(Path("found/results.json"))
    assert results["evaluation"]["deterministic"]["success_rate"]["mean"] == 1.0
    assert (results["preset"], results["algorithm"], results["env"]) == (
        "pd",
        "not trained",
        "docking2d",
    )
    assert Path("found/episode_deterministic.gif").stat().st_size > 1000
    for run, kind in (
        ("law", "deterministic"),
        ("remembering", "deterministic"),
        ("drawn", "stochastic"),
    ):
        words = [f"run={own}:{run}", "env=docking2d", "episodes=3", f"out={run}"]
        assert main([*words, *["deterministic=false"] * (run == "drawn")]) == 0
        results = read_json(Path(run) / "results.json")
        assert results["algorithm"] == "unknown"  # a function may be trained
        found = results["evaluation"]
        assert [*found] == [kind]
        assert found[kind]["success_rate"]["mean"] == (run == "law")


def test_the_command_refuses_what_is_no_policy(own: str) -> None:
    cases = {
        "run=controller/pd": "env: missing; the task in which controller/pd shall act",
        "run=controller/mpc env=docking2d_oriented": "has no controller 'mpc'; choose from align",
        "run=controller/pd env=docking2d checkpoint=last": "checkpoint: means nothing",
        "run=controller/pd env=docking2d deterministic=false": "deterministic: expected true",
        "run=controller/pd env=docking2d env.observation=[speed]": "needs the position of deputy",
        f"run={own}:number env=docking2d": "expected a function policy.key, observation., found 3",
        f"run={own}:drwn env=docking2d": f"{own} has no policy called 'drwn'. Did you mean 'drawn'",
        f"run={own}:alone env=docking2d": (
            r"alone: policy: expected a function of \(key, observation\), found alone\(seen\)$"
        ),
        f"run={own}:forgets env=docking2d": (
            r"policy: expected a function of \(key, observation, memory\), found alone\(seen\)$"
        ),
        "run=no_such_module:x env=docking2d": "cannot import 'no_such_module'",
    }
    for words, message in cases.items():
        with pytest.raises(ConfigError, match=message):
            main(words.split())


@pytest.mark.thorough
def test_a_controller_is_exported(own: str) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    assert export(["run=controller/lqr", "env=docking3d", "batch=3"]) == 0
    session = onnxruntime.InferenceSession("lqr_docking3d.onnx")
    env = jaxsafe.make("docking3d")
    observation = np.random.default_rng(0).normal(size=(3, 8)).astype(np.float32)
    (found,) = session.run(None, {session.get_inputs()[0].name: observation})
    np.testing.assert_allclose(found, LQR().policy(env)(None, observation), atol=1e-5)
    assert export(["run=controller/mpc", "env=docking2d", "format=stablehlo"]) == 0
    stored = jax.export.deserialize(bytearray(Path("mpc_docking2d.stablehlo").read_bytes()))
    plan = MPC().policy(jaxsafe.make("docking2d"))
    seen = observation[:, :6]
    np.testing.assert_allclose(stored.call(seen), plan(None, seen), atol=1e-4)
    with pytest.raises(ConfigError, match="the policy remembers"):
        export([f"run={own}:remembering", "env=docking2d"])


def test_a_law_of_ones_own_needs_one_method() -> None:
    class Nothing(ControlLaw, type="nothing_of_control_test"):
        """No control."""

        def control(self, env, design, sim):
            return jnp.zeros(env.action_size)

    env = jaxsafe.make("docking2d")
    policy = Nothing().policy(env)
    assert jaxsafe.fly(env, policy).control_desired.max() == 0.0
    assert not isinstance(policy, RecurrentPolicy)
