"""`reset`, `reset_to` and `step`: structure, chosen starts, and the facts about an environment."""

import re
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.bounds import best_possible
from jaxsafe.environment import require_success
from jaxsafe.processors.reward import Reward
from jaxsafe.processors.status import Status
from jaxsafe.processors.terminal import TooFar
from jaxsafe.transition import advance
from jaxsafe.types import Sim, State, StatusName, TimeStep

START = {"deputy": {"position": [100.0, 50.0], "velocity": [0.1, -0.2]}}
OUTCOMES = ("running", "success", "crash", "distance", "timeout", "velocity", "diverged")

reset = jax.jit(jaxsafe.reset)
step = jax.jit(jaxsafe.step)


@pytest.fixture(scope="module")
def env() -> Environment:
    return jaxsafe.make("docking2d")


def shapes(tree: Any) -> Any:
    return jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)), tree
    )


def test_reset_to_agrees_with_reset(env: Environment) -> None:
    drawn = jax.eval_shape(jaxsafe.reset, env, jax.random.key(0))
    given = jaxsafe.reset_to(env, START)
    assert shapes(drawn) == shapes(jax.eval_shape(lambda: given))


def test_the_methods_are_the_functions(env: Environment) -> None:
    key = jax.random.key(1)
    action = jnp.ones(2)
    chex.assert_trees_all_equal(env.reset(key), jaxsafe.reset(env, key))
    state, _ = env.reset(key)
    chex.assert_trees_all_equal(env.step(state, action), jaxsafe.step(env, state, action))


def test_a_start_has_no_reward_no_cost_and_no_end(env: Environment) -> None:
    fast = {"deputy": {"position": [100.0, 0.0], "velocity": [5.0, 0.0]}}
    for state, timestep in (reset(env, jax.random.key(0)), jaxsafe.reset_to(env, fast)):
        assert timestep.reward == 0.0
        assert timestep.cost == 0.0
        assert not timestep.done
        assert state.num_steps == 0
        assert state.sim.time == 0.0
        assert all(value == 0.0 for value in timestep.info.reward_terms.values())
        assert all(value == 0.0 for value in timestep.info.reward_totals.values())
        assert state.sim.control_desired.tolist() == [0.0, 0.0]
        assert state.sim.control_actual.tolist() == [0.0, 0.0]
        assert not timestep.info.control_actual.any()
    assert timestep.info.margins["velocity_limit"] < 0.0


def test_reset_to_starts_where_it_is_told(env: Environment) -> None:
    state, timestep = jaxsafe.reset_to(env, START)
    np.testing.assert_array_equal(state.sim.platforms["deputy"].position, np.float32([100.0, 50.0]))
    np.testing.assert_array_equal(state.sim.platforms["deputy"].velocity, np.float32([0.1, -0.2]))
    np.testing.assert_array_equal(state.sim.platforms["chief"].position, [0.0, 0.0])
    distance = np.hypot(100, 50)
    speed = np.hypot(0.1, 0.2)
    expected = [1.0, 0.5, 0.2, -0.4, speed, 0.2 + 2 * 0.001027 * distance]
    np.testing.assert_allclose(timestep.observation, expected, rtol=1e-6)


def test_reset_to_takes_arrays_and_traced_values(env: Environment) -> None:
    position = jnp.asarray([[100.0, 0.0], [0.0, 0.4]])
    velocity = np.zeros(2)

    def start(position: jax.Array) -> tuple[State, TimeStep]:
        return jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": velocity}})

    state, timestep = jax.jit(jax.vmap(start))(position)
    np.testing.assert_array_equal(state.sim.platforms["deputy"].position, position)
    assert [env.outcomes[i] for i in timestep.info.outcome.tolist()] == ["running", "success"]


def test_reset_to_may_move_the_chief(env: Environment) -> None:
    _, timestep = jaxsafe.reset_to(env, START | {"chief": {"position": [100.0, 47.0]}})
    assert timestep.info.status["docking_distance"] == 3.0


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({}, r"^reset_to: deputy\.position is missing: it is random at reset, so give it$"),
        ({"deputy": {"position": [1, 2]}}, r"^reset_to: deputy\.velocity is missing"),
        (
            {"deputi": {}},
            (
                r"^reset_to: unknown platform 'deputi'\. Did you mean 'deputy'\? Choose from chief,"
                r" deputy$"
            ),
        ),
        (
            {"deputy": {"positon": [1, 2]}},
            r"^reset_to: deputy has no field 'positon'\. Did you mean 'position'\? Choose from",
        ),
        (
            {"deputy": {"position": [1, 2, 3], "velocity": [0, 0]}},
            r"position: expected shape \(2,\), found \(3,\)",
        ),
        (
            {"deputy": {"position": 1.0, "velocity": [0, 0]}},
            r"position: expected shape \(2,\), found \(\)",
        ),
        (
            {"deputy": {"position": ["a", "b"], "velocity": [0, 0]}},
            r"position: expected numbers, found \['a', 'b'\]",
        ),
        (
            {"deputy": {"position": None, "velocity": [0, 0]}},
            r"deputy\.position: expected numbers, found None",
        ),
        (
            {"deputy": {"position": [float("nan"), 0], "velocity": [0, 0]}},
            r"position: expected finite numbers",
        ),
        (
            {"deputy": {"position": [0, 0], "velocity": [0, float("inf")]}},
            r"velocity: expected finite numbers",
        ),
    ],
)
def test_a_bad_start_is_refused(env: Environment, start: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        jaxsafe.reset_to(env, start)
    assert re.search(message, str(caught.value))
    assert "\n" not in str(caught.value)


def test_a_start_at_the_chief_has_an_outcome_but_is_not_done(env: Environment) -> None:
    _, timestep = jaxsafe.reset_to(
        env, {"deputy": {"position": [0.0, 0.3], "velocity": [0.0, 0.0]}}
    )
    assert env.outcomes[int(timestep.info.outcome)] == "success"
    assert not timestep.done
    assert timestep.reward == 0.0
    assert timestep.info.ended["success"]


def test_a_step_ignores_the_earlier_outcome(env: Environment) -> None:
    state, _ = jaxsafe.reset_to(env, {"deputy": {"position": [0.0, 0.3], "velocity": [0.0, 3.0]}})
    state, away = step(env, state, jnp.zeros(2))
    assert env.outcomes[int(away.info.outcome)] == "running"
    assert not away.done
    state, _ = jaxsafe.reset_to(env, {"deputy": {"position": [0.0, 0.3], "velocity": [0.0, 0.0]}})
    for _ in range(3):
        state, docked = step(env, state, jnp.zeros(2))
        assert env.outcomes[int(docked.info.outcome)] == "success"
        assert docked.terminated
    assert float(docked.info.reward_terms["success"]) == pytest.approx(2.0 - 3.0 / 2000.0)


def test_a_step_depends_neither_on_statuses_of_the_state_nor_on_its_regions(
    env: Environment,
) -> None:
    state, _ = reset(env, jax.random.key(2))
    assert state.sim.ended == {}
    forgetful = state.replace(sim=state.sim.replace(status={}, regions={}))
    chex.assert_trees_all_equal(
        jaxsafe.step(env, state, jnp.ones(2)), jaxsafe.step(env, forgetful, jnp.ones(2))
    )


def test_rewards_of_the_steps_add_up_to_the_totals_and_terms_to_the_reward(
    env: Environment,
) -> None:
    state, _ = jaxsafe.reset_to(env, {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, 0.6]}})
    sums = dict.fromkeys((term.name for term in env.reward), 0.0)
    for action in jax.random.uniform(jax.random.key(0), (30, 2), minval=-1.0):
        state, timestep = step(env, state, action)
        assert float(timestep.reward) == pytest.approx(
            float(sum(timestep.info.reward_terms.values())), abs=1e-7
        )
        sums = {
            name: total + float(timestep.info.reward_terms[name]) for name, total in sums.items()
        }
        totals = {name: float(total) for name, total in timestep.info.reward_totals.items()}
        assert totals == pytest.approx(sums, abs=1e-5)
    assert sums["velocity_constraint"] < 0.0


def test_control_is_reported_in_physical_units_and_no_assurance_intervenes(
    env: Environment,
) -> None:
    state, _ = reset(env, jax.random.key(0))
    state, timestep = step(env, state, jnp.asarray([0.25, -7.0]))
    np.testing.assert_array_equal(timestep.info.control_desired, [0.25, -1.0])
    np.testing.assert_array_equal(timestep.info.control_actual, timestep.info.control_desired)
    assert not timestep.info.intervening
    for name in ("control_desired", "control_actual"):
        np.testing.assert_array_equal(getattr(state.sim, name), getattr(timestep.info, name))


class LastControl(Reward):
    """The first element of the control that acted minus that of the desired one."""

    def process(self, memory: Any, sim: Sim) -> Array:
        return sim.control_actual[0] - sim.control_desired[0]


@pytest.mark.thorough
def test_rewards_see_the_desired_and_the_actual_control_of_their_step() -> None:
    env = jaxsafe.make("docking2d", rta="default")
    env = jaxsafe.override(env, {"reward": [*env.reward, LastControl(name="correction")]})
    fast = {"deputy": {"position": [100.0, 0.0], "velocity": [-0.405, 0.0]}}
    _, timestep = step(env, jaxsafe.reset_to(env, fast)[0], jnp.asarray([-1.0, 0.0]))
    corrected = timestep.info.control_actual[0] - timestep.info.control_desired[0]
    assert corrected > 0.1
    assert timestep.info.reward_terms["correction"] == corrected


def test_a_predicted_step_carries_its_control(env: Environment) -> None:
    sim = jaxsafe.reset_to(env, START)[0].sim
    later = advance(env, sim, jnp.asarray([0.5, -1.0]))
    assert later.control_actual.tolist() == later.control_desired.tolist() == [0.5, -1.0]


def test_time_counts_steps(env: Environment) -> None:
    state, _ = reset(env, jax.random.key(0))
    for count in (1, 2, 3):
        state, _ = step(env, state, jnp.zeros(2))
        assert (state.num_steps, state.sim.time) == (count, count)


@pytest.mark.parametrize(("task", "axes"), [("docking2d", "xy"), ("docking3d", "xyz")])
def test_an_environment_names_its_parts(task: str, axes: str) -> None:
    env = jaxsafe.make(task)
    assert env.outcomes == OUTCOMES
    assert env.action_names == tuple(f"thrust_{axis}" for axis in axes)
    assert env.action_size == len(axes)
    assert env.num_action_points == ()
    vectors = [f"{name}.{axis}" for name in ("position", "velocity") for axis in axes]
    assert env.observation_names == (*vectors, "speed", "velocity_limit")
    assert env.observation_size == 2 * len(axes) + 2
    _, timestep = jaxsafe.reset(env, jax.random.key(0))
    assert timestep.observation.shape == (env.observation_size,)
    assert set(timestep.info.margins) == {"velocity_limit"}
    terms = ("distance_change", "velocity_constraint", "delta_v", "success", "failure")
    assert tuple(term.name for term in env.reward) == terms
    assert {"in_docking", "docking_distance", "velocity_limit"} <= set(timestep.info.status)


@pytest.mark.parametrize(
    ("task", "variant", "actions", "size", "outcomes"),
    [
        ("rejoin2d", "paper", "heading_rate acceleration", 12, "success crash distance timeout"),
        (
            "rejoin3d",
            "paper",
            "roll_rate flight_path_angle_rate acceleration",
            18,
            "success crash distance timeout",
        ),
        (
            "docking2d_oriented",
            "paper",
            "thrust attitude_acceleration",
            9,
            "success crash distance timeout velocity",
        ),
        ("rejoin2d", "released", "heading_rate acceleration", 12, "success crash timeout distance"),
        (
            "rejoin3d",
            "released",
            "flight_path_angle_rate roll_rate acceleration",
            18,
            "success crash timeout distance",
        ),
        (
            "docking2d",
            "released",
            "thrust_x thrust_y",
            6,
            "success timeout distance crash velocity",
        ),
        (
            "docking3d",
            "released",
            "thrust_x thrust_y thrust_z",
            8,
            "success timeout distance crash velocity",
        ),
        (
            "docking2d_oriented",
            "released",
            "thrust attitude_acceleration",
            9,
            "success timeout distance crash velocity",
        ),
    ],
)
def test_a_variant_orders_its_actions_and_outcomes(
    task: str, variant: Any, actions: str, size: int, outcomes: str
) -> None:
    env = jaxsafe.make(task, variant=variant)
    assert env.action_names == tuple(actions.split())
    assert env.observation_size == size
    assert env.outcomes == ("running", *outcomes.split(), "diverged")
    points = 11 if "docking" in task else 5
    assert (
        jaxsafe.make(task, variant=variant, actions="discrete").num_action_points
        == (points,) * env.action_size
    )


def test_discrete_actions_change_the_controller_and_nothing_else() -> None:
    continuous = jaxsafe.make("docking3d")
    discrete = jaxsafe.make("docking3d", actions="discrete")
    assert discrete.num_action_points == (11, 11, 11)
    assert discrete.action_names == continuous.action_names
    state, _ = jaxsafe.reset_to(
        continuous, {"deputy": {"position": [100.0, 50.0, 0.0], "velocity": [0.1, 0.0, 0.0]}}
    )
    pushed = step(continuous, state, jnp.asarray([-1.0, 0, 1]))
    chosen = step(discrete, state, jnp.asarray([0, 5, 10]))
    chex.assert_trees_all_close(pushed, chosen, atol=1e-7)
    assert jaxsafe.make("docking3d", actions="continuous") == continuous
    assert discrete != continuous


# Terminal conditions


def ends(
    env: Environment, position: Any, velocity: Any = (0.0, 0.0)
) -> tuple[list[str], str, TimeStep]:
    """Return what ended on the first step from a start, and the outcome."""
    state, _ = jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": velocity}})
    state, timestep = step(env, state, jnp.zeros(2))
    return (
        [name for name, ended in timestep.info.ended.items() if ended],
        env.outcomes[int(timestep.info.outcome)],
        timestep,
    )


def test_the_first_condition_that_holds_hides_those_after_it() -> None:
    numbers = {"terminal.timeout.limit": 0.5, "terminal.distance.limit": 0.1}
    env = jaxsafe.make("docking2d", numbers)
    assert ends(env, [0.3, 0.0])[:2] == (["success"], "success")
    assert ends(env, [5.0, 0.0])[:2] == (["distance"], "distance")
    names = ["timeout", "distance", "success", "crash"]
    swapped = jaxsafe.make("docking2d", numbers | {"terminal": names})
    assert swapped.outcomes == ("running", *names, "velocity", "diverged")
    assert ends(swapped, [0.3, 0.0])[:2] == (["timeout"], "timeout")


@pytest.mark.thorough
def test_a_condition_that_stands_apart_neither_hides_nor_is_hidden() -> None:
    numbers = {
        "terminal.timeout.limit": 0.5,
        "reward.success.time_scale": 2000.0,
        "terminal.distance.limit": 0.1,
    }
    for names, outcome in (
        (["success", "distance", "timeout", "crash"], "success"),
        (["distance", "success", "timeout", "crash"], "distance"),
    ):
        env = jaxsafe.make(
            "docking2d", numbers | {"terminal": names, "terminal.success.apart": True}
        )
        outcomes, first, timestep = ends(env, [0.3, 0.0])
        assert (set(outcomes), first) == ({"success", "distance"}, outcome)
        assert timestep.terminated
        assert float(timestep.info.reward_terms["success"]) == pytest.approx(2.0 - 1.0 / 2000.0)
        assert float(timestep.info.reward_terms["failure"]) == -1.0
    assert ends(jaxsafe.make("docking2d", {"terminal.success.apart": True}), [0.3, 0.0])[0] == [
        "success"
    ]
    every = {f"terminal.{name}.apart": True for name in ("success", "distance", "timeout")}
    assert set(ends(jaxsafe.make("docking2d", numbers | every), [0.3, 0.0])[0]) == {
        "success",
        "distance",
        "timeout",
    }


def test_a_bound_is_hidden_by_ends_but_not_by_those_that_stand_apart() -> None:
    tight = {"reward.velocity_constraint.bound.below": 1.0}
    assert ends(jaxsafe.make("docking2d", tight), [50.0, 0.0])[:2] == (["velocity"], "velocity")
    assert ends(jaxsafe.make("docking2d", tight), [0.3, 0.0])[:2] == (["success"], "success")
    beside = jaxsafe.make("docking2d", tight | {"terminal.success.apart": True})
    assert ends(beside, [0.3, 0.0])[:2] == (["success", "velocity"], "success")


def test_a_released_docking_that_crashes_too_late_is_a_timeout() -> None:
    numbers = {"terminal.timeout.limit": 0.5}
    outcomes = {}
    for variant in ("paper", "released"):
        outcomes[variant] = ends(
            jaxsafe.make("docking2d", numbers, variant=variant), [0.3, -1.0], [0.0, 1.0]
        )[1]
    assert outcomes == {"paper": "crash", "released": "timeout"}


@pytest.mark.parametrize("how", ["terminated", "truncated"])
def test_any_reward_term_may_carry_a_bound(how: str) -> None:
    bound = {"below": -0.05, "outcome": "thirst", "ends": how}
    env = jaxsafe.make("docking2d", {"reward.delta_v.bound": bound, "reward.delta_v.scale": -0.3})
    assert env.outcomes == (*OUTCOMES[:-1], "thirst", "diverged")
    state, _ = jaxsafe.reset_to(env, START)
    over = []
    kind = []
    for _ in range(4):  # each pays 0.3 √2/12 = 0.0354
        state, timestep = step(env, state, jnp.ones(2))
        over.append(env.outcomes[int(timestep.info.outcome)])
        kind.append((bool(timestep.terminated), bool(timestep.truncated)))
    assert over == ["running", *["thirst"] * 3]
    assert kind == [(False, False), *[(how == "terminated", how == "truncated")] * 3]


def test_a_state_holds_the_numbers_drawn_for_its_episode(env: Environment) -> None:
    assert reset(env, jax.random.key(0))[0].parameters == {}
    assert jaxsafe.reset_to(env, START)[0].parameters == {}
    random = jaxsafe.make("docking2d", randomize={"deputy.mass": [10, 14], "dt": [1, 1]})
    state, _ = reset(random, jax.random.key(0))
    assert set(state.parameters) == {"deputy.mass", "dt"}
    after, _ = step(random, state, jnp.zeros(2))
    chex.assert_trees_all_equal(after.parameters, state.parameters)


def test_reset_to_takes_arrays_inside_a_compiled_function() -> None:
    env = jaxsafe.make("docking2d")
    position = jnp.array([100.0, 0.0])
    velocity = jnp.array([0.0, 0.1])
    state = jax.jit(
        lambda env: jaxsafe.reset_to(env, {"deputy": {"position": position, "velocity": velocity}})[
            0
        ]
    )(env)
    assert (state.sim.platforms["deputy"].position == position).all()


class Broken(Status, type="broken_for_this_test"):
    """A status that is not finite near the chief."""

    distance: StatusName

    def process(self, memory: Any, sim: Sim) -> Float[Array, ""]:
        return jnp.log(sim.status[self.distance] - 50.0)


def test_a_status_that_is_not_a_number_ends_the_episode() -> None:
    plain = jaxsafe.make("docking2d")
    status = (*plain.status, Broken(name="broken", distance="docking_distance"))
    terminal = (*plain.terminal, TooFar(name="broken", distance="broken", limit=1e6))
    env = jaxsafe.override(plain, {"status": status, "terminal": terminal})
    for distance, expected in (
        (100.0, ([], "running", 0.0)),
        (10.0, (["diverged"], "diverged", 1.0)),
    ):
        ended, outcome, timestep = ends(env, [distance, 0.0])
        assert (ended, outcome, float(timestep.cost)) == expected


def test_each_constraint_has_a_cost_by_its_name() -> None:
    env = jaxsafe.make(Path(__file__).parent.parent / "configs" / "custom_env.yaml")
    state, timestep = jaxsafe.reset_to(
        env, {"deputy": {"position": [0.0, 60.0], "velocity": [0.0, 0.3]}}, {"deputy.mass": 12.0}
    )
    assert set(timestep.costs) == {"velocity_limit", "keep_out_speed", "keep_out"}
    assert all(float(cost) == 0.0 for cost in timestep.costs.values())  # no step was taken
    _, timestep = jaxsafe.step(env, state, jnp.zeros(2))
    costs = {name: float(cost) for name, cost in timestep.costs.items()}
    assert costs == {"velocity_limit": 0.0, "keep_out_speed": 1.0, "keep_out": 1.0}
    assert float(timestep.cost) == 1.0
    for name, margin in timestep.info.margins.items():
        assert costs[name] == float(margin < 0.0)


def test_the_cost_may_be_how_far_a_constraint_is_violated() -> None:
    file = Path(__file__).parent.parent / "configs" / "custom_env.yaml"
    start = {"deputy": {"position": [0.0, 60.0], "velocity": [0.0, 0.3]}}
    env = jaxsafe.make(file, {"cost": "severity"})
    state, timestep = jaxsafe.reset_to(env, start, {"deputy.mass": 12.0})
    assert not any(map(float, (timestep.cost, *timestep.costs.values())))
    _, timestep = jaxsafe.step(env, state, jnp.zeros(2))
    assert timestep.costs == timestep.info.severity
    assert timestep.costs["velocity_limit"] == 0.0 < timestep.costs["keep_out_speed"]
    assert timestep.cost == max(timestep.costs.values())
    assert float(timestep.cost) not in (0.0, 1.0)


def test_success_is_an_outcome_that_training_and_evaluation_ask_for() -> None:
    plain = jaxsafe.make("docking2d")
    require_success(plain)
    goal = plain.terminal[0].replace(name="docked")
    terms = tuple(term for term in plain.reward if term.name != "success")
    env = jaxsafe.override(plain, {"terminal": (goal, *plain.terminal[1:]), "reward": terms})
    with pytest.raises(
        ConfigError,
        match=r"no outcome counts as a success; mark .*docked, crash, distance, timeout, velocity",
    ):
        require_success(env)
    marked = jaxsafe.override(env, {"terminal.docked.success": True})
    require_success(marked)
    assert marked.successes == ("docked",)


def test_marked_outcomes_of_any_name_count_as_success(env: Environment) -> None:
    assert (env.successes, env.success_indices) == (("success",), (1,))
    marks = {"terminal.timeout.success": True, "reward.velocity_constraint.bound.success": True}
    several = jaxsafe.override(env, marks)
    assert several.successes == ("success", "timeout", "velocity")
    assert several.succeeded(np.arange(7)).tolist() == [0, 1, 0, 0, 1, 1, 0]
    assert jaxsafe.config.load(jaxsafe.dump(several)) == several

    others = jaxsafe.override(several, {"terminal.success.success": False})
    assert others.successes == ("timeout", "velocity")
    none = jaxsafe.override(env, {"terminal.success.success": False})
    assert none.successes == none.success_indices == ()
    assert not none.succeeded(np.arange(7)).any()


@pytest.mark.parametrize(
    ("start", "parameters", "message"),
    [
        (None, None, "expected platforms by name, found None"),
        ([], None, r"expected platforms by name, found \[\]"),
        ("deputy", None, "expected platforms by name, found 'deputy'"),
        ({"deputy": None}, None, "deputy: expected fields by name, found None"),
        (START, [1], r"expected parameters by name, found \[1\]"),
        (
            {"deputy": {**START["deputy"], "velocity": [0.0, 1e39]}},
            None,
            r"velocity: expected finite numbers, found \[0",
        ),
    ],
)
def test_reset_to_refuses_what_is_no_mapping_of_numbers(
    env: Environment, start: Any, parameters: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match=f"^reset_to: .*{message}"):
        jaxsafe.reset_to(env, start, parameters)


@pytest.mark.parametrize(
    ("state", "action", "message"),
    [
        (None, jnp.zeros((4, 2)), r"found \(4, 2\); for a batch, write jax.vmap around step$"),
        (None, jnp.zeros((2, 3)), r"found \(2, 3\)$"),
        (None, "left", "found 'left'$"),
        (None, None, "found None$"),
        ("timestep", jnp.zeros(2), "step: state: expected the State that reset or step returned"),
    ],
)
def test_a_step_from_what_is_no_state_or_action_is_refused(
    state: Any, action: Any, message: str, env: Environment
) -> None:
    start, timestep = jaxsafe.reset_to(env, START)
    with pytest.raises(ConfigError, match=message):
        jaxsafe.step(env, timestep if state else start, action)


NOTHING: Any = None
CALLS: dict[str, Any] = {
    "reset": lambda env: jaxsafe.reset(env, jax.random.key(0)),
    "reset_to": lambda env: jaxsafe.reset_to(env, START),
    "step": lambda env: jaxsafe.step(env, NOTHING, NOTHING),
    "rollout": lambda env: jaxsafe.rollout(env, NOTHING, jax.random.key(0), 1),
    "evaluate": lambda env: jaxsafe.evaluate(env, NOTHING),
    "fly": lambda env: jaxsafe.fly(env, NOTHING),
    "verify": lambda env: jaxsafe.verify(env, NOTHING, {}),
    "override": lambda env: jaxsafe.override(env, {"dt": 2.0}),
    "dump": jaxsafe.dump,
    "load_policy": lambda env: jaxsafe.load_policy("controller/lqr", env=env),
    "best_possible": lambda env: best_possible(env, NOTHING),
}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize(("given", "example"), [("rejoin2d", "rejoin2d"), (3, "docking2d")])
def test_the_name_of_a_task_is_no_environment(name: str, given: Any, example: str) -> None:
    with pytest.raises(ConfigError) as caught:
        CALLS[name](given)
    assert str(caught.value) == (
        f"{name}: env: expected an environment, such as jaxsafe.make('{example}'), found {given!r}"
    )
