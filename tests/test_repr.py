"""What environments, states, time steps and policies print."""

import jax
import pytest

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.envs import TASKS
from jaxsafe.rollout import reset_batch
from jaxsafe.types import Record

DOCKING = """\
Environment docking2d
  agent        deputy beside chief, 1 s a step
  observation  6 numbers: position.x, position.y, velocity.x, velocity.y, speed, velocity_limit
  action       2 numbers in [-1, 1]: thrust_x from -1 to 1 N; thrust_y from -1 to 1 N
  reward       distance_change, velocity_constraint, delta_v, success, failure
  ends         success, crash, distance, timeout, velocity, diverged
  constraints  velocity_limit
  filter       discrete_asif
  random       deputy.mass in (10, 14)"""

STATE = """\
State
  sim                   time 0, intervening False, control_desired, control_actual (0, 0)
  sim.platforms.chief   position (0, 0) m, velocity, delta_v (0, 0) m/s
  sim.platforms.deputy  position (100, 5) m, velocity (0, 0.1) m/s, delta_v (0, 0) m/s
  sim.status            delta_v, delta_v_l1 0, docking_distance 100.1, in_docking False, speed 0.1,
                        velocity_limit 0.4057
  reward_totals         delta_v, distance_change, failure, success, velocity_constraint 0
  num_steps             0
  sim.regions           docking_region position (0, 0), inside deputy False
  memory                of reward.distance_change, rta"""


def test_an_environment_prints_its_parts() -> None:
    env = jaxsafe.make("docking2d", rta="default", randomize={"deputy.mass": [10, 14]})
    assert repr(env) == DOCKING


@pytest.mark.parametrize("task", TASKS)
def test_every_task_prints_in_some_ten_lines_of_a_hundred_letters(task: str) -> None:
    env = jaxsafe.make(task)
    text = repr(env)
    assert text.startswith(f"Environment {task}\n")
    assert "None" not in text
    state, timestep = env.reset(jax.random.key(0))
    for lines in (text, repr(state), repr(timestep)):
        assert len(lines.splitlines()) <= 16
        assert max(map(len, lines.splitlines())) <= 100


def test_discrete_actions_and_physical_units_are_said() -> None:
    discrete = repr(jaxsafe.make("docking2d", actions="discrete"))
    assert "2 indices: thrust_x, 11 points from -1 to 1 N; thrust_y, " in discrete
    physical = {f"deputy.controller.actuators.thrust_{axis}.rescale": False for axis in "xy"}
    assert "2 numbers: thrust_x from -1 to 1 N" in repr(jaxsafe.make("docking2d", physical))


def test_the_name_survives_changes_and_not_transformations() -> None:
    env = jaxsafe.make("docking2d")
    assert jaxsafe.override(env, {"deputy.mass": 13.0}).task == "docking2d"
    assert env.task == "docking2d"
    assert jax.tree.map(lambda x: x, env).task == ""
    assert env == jax.tree.map(lambda x: x, env)


@pytest.mark.thorough
def test_what_is_traced_or_has_no_numbers_prints() -> None:
    env = jaxsafe.make("docking2d")
    texts = []

    def look(env: Environment, key: jax.Array) -> jax.Array:
        state, timestep = env.reset(key)
        texts.extend(map(repr, (env, state, timestep)))
        return timestep.reward

    jax.eval_shape(look, env, jax.random.key(0))
    shapes = jax.eval_shape(jaxsafe.reset, env, jax.random.key(0))
    batch = reset_batch(env, jax.random.key(0), 9)
    nothing = [jax.tree.map(lambda _, x=x: x, (env, *shapes)) for x in (None, object(), "text")]
    for tree in (*shapes, *batch, *(part for parts in nothing for part in parts)):
        texts.append(repr(tree))
        assert tree._repr_html_().startswith("<b>")
    assert "thrust_x from float32[] to float32[] N" in texts[0]
    assert "float32[9,2]" in "".join(texts)
    assert "speed, velocity_limit float32[9]" in " ".join("".join(texts).split())


def test_a_state_and_a_time_step_print_their_numbers() -> None:
    env = jaxsafe.make("docking2d", rta="default")
    start = {"deputy": {"position": [100.0, 5.0], "velocity": [0.0, 0.1]}}
    state, timestep = jaxsafe.reset_to(env, start)
    assert repr(state) == STATE
    assert "info.margins        velocity_limit 0.3057" in repr(timestep)


def test_html_shows_a_users_text_letter_by_letter() -> None:
    class Odd(Record):
        name: str

    assert "&lt;b&gt;" in Odd(name="<b>")._repr_html_()


def test_an_error_about_an_environment_stays_one_line() -> None:
    env = jaxsafe.make("docking2d")
    with pytest.raises(ConfigError, match="found Environment docking2d agent deputy") as caught:
        jaxsafe.make(env)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_the_package_says_its_version_and_tasks() -> None:
    assert isinstance(jaxsafe.__version__, str)
    assert tuple(TASKS) == jaxsafe.TASKS
    assert "docking2d" in jaxsafe.TASKS
    with pytest.raises(AttributeError, match="module 'jaxsafe' has no attribute 'tasks'"):
        _ = jaxsafe.tasks  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match=r"'evalute'\. Did you mean 'evaluate'\?"):
        _ = jaxsafe.evalute  # type: ignore[attr-defined]
    assert all(hasattr(jaxsafe, name) for name in jaxsafe.__all__)
