"""Environments as YAML and overrides.

What is written reads back, and every fault is one line with its place.
"""

import copy
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind
from own_process import check_as_compiled_by_commands

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.config import build, dump, load, load_filter, load_recipe_name, load_recipes
from jaxsafe.envs import adapt
from jaxsafe.processors.reward import Failure
from jaxsafe.processors.status import Status
from jaxsafe.schema.component import normalise
from jaxsafe.schema.convert import to_component, to_data
from jaxsafe.schema.errors import show
from jaxsafe.schema.user_modules import import_modules, imports_allowed, modules
from jaxsafe.schema.yaml12 import parse, write
from jaxsafe.simulation.cwh import Spacecraft
from jaxsafe.simulation.scripted import Schedule, Scripted
from jaxsafe.types import PlatformName

TASKS = ("rejoin2d", "rejoin3d", "docking2d", "docking3d", "docking2d_oriented")


class SpeedSquared(Status, type="speed_squared_of_test"):
    """A status as a user would write it."""

    of: PlatformName

    def process(self, memory: Any, sim: Any) -> jax.Array:
        return jnp.sum(sim.platforms[self.of].velocity ** 2)


@pytest.fixture(scope="module")
def env() -> Environment:
    return jaxsafe.make("docking2d")


@pytest.fixture
def tree(env: Environment) -> dict[str, Any]:
    """Return the plain data of docking2d, a fresh copy to break."""
    return parse(dump(env), "docking2d")


def fault(act: Callable[[], Any]) -> str:
    """Return the message of the ConfigError that `act` raises. Check that it is one line."""
    with pytest.raises(ConfigError) as caught:
        act()
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 600  # the longest lists the types of statuses
    return message


def fault_in(tree: Any) -> str:
    return fault(lambda: load(write(tree)))


def compose(tree: Any) -> Environment:
    """Do what `load` does with a file's content, without the text."""
    return build(to_component(tree, Environment, ""))


def put(tree: Any, path: str, value: Any) -> Any:
    """Return the tree with the value at a path such as `status.3.floor` replaced."""
    *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    inner = tree
    for part in parents:
        inner = inner[part]
    inner[last] = value
    return tree


def mappings(tree: Any) -> Iterator[dict[str, Any]]:
    """Yield every mapping in plain data."""
    if isinstance(tree, dict):
        yield tree
    for inner in (
        tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    ):
        yield from mappings(inner)


# What is written reads back


@pytest.mark.parametrize(
    ("actions", "variant"), [("continuous", "paper"), ("discrete", "released")]
)
@pytest.mark.parametrize("task", TASKS)
def test_loading_a_dump_gives_the_same_environment(task: str, actions: Any, variant: Any) -> None:
    env = jaxsafe.make(task, actions=actions, variant=variant)
    again = load(dump(env))
    assert again == env
    assert dump(again) == dump(env)
    assert jax.tree.map(lambda leaf: leaf.dtype, again) == jax.tree.map(
        lambda leaf: leaf.dtype, env
    )


def test_loading_a_dump_keeps_overrides_and_awkward_numbers(env: Environment) -> None:
    changes = {
        "deputy.mass": 1 / 3,
        "reward.delta_v.scale": -1e-30,
        "terminal.distance.limit": 1e30,
        "dt": 7.0e-5,
    }
    changes |= {"observation.position.clip": [-1, 1], "terminal.timeout.ends": "truncated"}
    changed = jaxsafe.override(env, changes)
    assert load(dump(changed)) == changed
    assert changed != env


def test_in_x64_a_dump_keeps_all_digits() -> None:
    with jax.enable_x64(True):
        env = jaxsafe.make("docking3d", {"deputy.mass": 1 / 3})
        assert float(load(dump(env)).agent_platform.mass) == 1 / 3
        assert load(dump(env)) == env


def test_a_dump_holds_shortest_decimals(env: Environment) -> None:
    assert "mean_motion: 0.001027\n" in dump(env)
    assert "scale: -0.01" in dump(env)


def test_an_environment_is_read_from_a_file_and_then_overridden(
    env: Environment, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(dump(env))
    assert load(path) == env
    assert load(str(path)) == env
    assert jaxsafe.make(path, actions="discrete") == jaxsafe.make("docking2d", actions="discrete")
    assert float(jaxsafe.make(str(path), {"deputy.mass": 10}).agent_platform.mass) == 10.0


def test_recipes_beside_an_environment_are_left_to_trainings(
    tree: dict[str, Any], env: Environment, tmp_path: Path
) -> None:
    tree["recipes"] = {"mine": {"steps": 7}, "empty": None}
    file = tmp_path / "mine.yaml"
    file.write_text(write(tree), encoding="utf-8")
    assert load(file) == jaxsafe.make(file) == env
    assert load_recipes(file) == {"mine": {"steps": 7}, "empty": {}}
    file.write_text(dump(env), encoding="utf-8")
    assert load_recipes(file) == {}
    for wrong in (3, [], {"mine": 3}):
        file.write_text(write({**tree, "recipes": wrong}), encoding="utf-8")
        assert fault(lambda: load_recipes(file)).startswith(
            f"{file}: recipes: expected names, each with options of a training, found"
        )
    assert "unknown field 'recips'" in fault_in({**tree, "recips": {}})


def test_a_file_may_name_its_recipe(tree: dict[str, Any], env: Environment, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    for name, found in (
        ("docking2d", "docking2d"),
        ("mine:hover", "mine:hover"),
        ("../other.yaml", str(tmp_path.parent / "other.yaml")),
    ):
        file.write_text(write({"recipe": name, **tree}), encoding="utf-8")
        assert load_recipe_name(file) == found
        assert load(file) == env
        assert load_recipes(file) == {}
    file.write_text(write(tree), encoding="utf-8")
    assert load_recipe_name(file) is None
    file.write_text(write({**tree, "recipe": 3}), encoding="utf-8")
    assert fault(lambda: load_recipe_name(file)) == (
        f"{file}: recipe: expected a task or a file, found 3"
    )
    file.write_text(write({**tree, "recipe": "docking2d", "recipes": {}}), encoding="utf-8")
    assert fault(lambda: load_recipe_name(file)) == (
        f"{file}: recipe: the file has recipes of its own; leave one out"
    )


def test_a_filter_is_read_from_a_file_with_recipes(tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d", rta="explicit_simplex")
    file = tmp_path / "mine.yaml"
    file.write_text(write({**parse(dump(env), ""), "recipes": {"mine": {}}}), encoding="utf-8")
    assert load_filter(file) == env.rta


def test_fields_with_a_default_may_be_left_out(tree: dict[str, Any], env: Environment) -> None:
    del tree["dt"], tree["terminal"][0]["ends"], tree["platforms"][1]["mass"]
    del tree["platforms"][1]["start"][0]["direction"]
    assert load(write(tree)) == env


def test_a_component_of_the_user_is_usable_from_yaml(tree: dict[str, Any]) -> None:
    tree["status"].append({"type": "speed_squared_of_test", "name": "energy", "of": "deputy"})
    tree["observation"].append({"type": "observe_status", "name": "energy", "status": "energy"})
    env = load(write(tree))
    assert load(dump(env)) == env
    _, timestep = jaxsafe.reset_to(
        env, {"deputy": {"position": [100.0, 0.0], "velocity": [0.3, 0.4]}}
    )
    assert timestep.info.status["energy"] == pytest.approx(0.25)
    assert timestep.observation[-1] == pytest.approx(0.25)


# Overrides


def test_overrides_reach_fields_of_fields_of_lists_and_of_mappings(env: Environment) -> None:
    changes = {
        "dt": 2,
        "deputy.mass": 10,
        "platforms.deputy.mean_motion": 0.002,
        "deputy.start.position.distance": (50, 60),
        "deputy.start.position.direction.azimuth": [0, 1],
        "deputy.controller.actuators.thrust_x.points": 5,
        "reward.velocity_constraint.bound.below": -7,
        "reward.failure.values.crash": -3,
        "terminal.timeout.ends": "truncated",
        "status.delta_v.norm": "l1",
        "observation.position.clip": [-1, 1],
    }
    changed = jaxsafe.override(env, changes)
    deputy = changed.agent_platform
    assert (changed.dt, deputy.mass) == (2.0, 10.0)
    assert deputy.mean_motion == np.float32(0.002)
    assert deputy.start[0].distance.tolist() == [50.0, 60.0]
    assert deputy.start[0].direction.azimuth.tolist() == [0.0, 1.0]
    assert deputy.controller.actuators[0].points == 5
    assert deputy.controller.actuators[1].points == 11
    assert changed.reward[1].bound is not None
    assert changed.reward[1].bound.below == -7.0
    assert {name: float(value) for name, value in changed.reward[4].values.items()} == {
        "crash": -3.0,
        "distance": -1.0,
        "timeout": -1.0,
        "velocity": 0.0,
    }
    assert changed.terminal[3].ends == "truncated"
    assert changed.status[4].norm == "l1"
    assert changed.observation[0].clip is not None
    assert env == jaxsafe.make("docking2d")


def test_an_override_with_the_value_it_has_changes_nothing(env: Environment) -> None:
    assert (
        jaxsafe.override(env, {"deputy.mass": 12, "reward.delta_v.scale": np.float64(-0.01)}) == env
    )
    assert jaxsafe.override(env, {}) == env


def test_a_list_of_names_keeps_those_parts_in_that_order(env: Environment) -> None:
    changed = jaxsafe.override(env, {"observation": ["velocity", "position"], "constraints": []})
    assert changed.observation == (env.observation[1], env.observation[0])
    assert changed.constraints == ()
    assert changed.observation_names == ("velocity.x", "velocity.y", "position.x", "position.y")
    swapped = jaxsafe.override(env, {"deputy.controller.actuators": ["thrust_y", "thrust_x"]})
    assert swapped.action_names == ("thrust_y", "thrust_x")
    assert load(dump(changed)) == changed


def test_new_parts_stand_beside_names_of_those_that_are_there(env: Environment) -> None:
    apart = {"type": "separation", "name": "apart", "distance": "docking_distance", "minimum": 2}
    fixed = {"type": "fixed", "name": "velocity", "value": [0.0, 0.1]}
    changes = {"constraints": [apart, "velocity_limit"], "deputy.start": ["position", fixed]}
    changed = jaxsafe.override(env, changes)
    assert [part.name for part in changed.constraints] == ["apart", "velocity_limit"]
    assert changed.constraints[1] == env.constraints[0]
    assert changed.agent_platform.start[0] == env.agent_platform.start[0]
    assert changed.agent_platform.start[1].type_name == "fixed"
    elliptic = jaxsafe.override(env, {"deputy.type": "two_body", **changes})
    assert elliptic.agent_platform.start == changed.agent_platform.start
    as_parts = jaxsafe.override(env, {"constraints": [changed.constraints[0], "velocity_limit"]})
    assert as_parts.constraints == changed.constraints
    message = fault(lambda: jaxsafe.override(env, {"constraints": [apart, "velocity_limt"]}))
    assert re.search(r"constraints\.velocity_limt: unknown name.* Did you mean 'vel", message)


def test_a_component_is_taken_as_it_is_written(env: Environment) -> None:
    written = Failure(name="failure", values={"crash": -1, "distance": -2.0})
    read = {"type": "failure", "name": "failure", "values": {"crash": -1, "distance": -2.0}}
    as_component, as_data = (
        jaxsafe.override(env, {"reward": [*env.reward[:4], reward]}) for reward in (written, read)
    )
    assert as_component == as_data
    assert {type(leaf) for leaf in jax.tree.leaves(as_component)} == {type(env.dt)}


def test_a_component_with_a_problem_is_refused_in_one_line(env: Environment) -> None:
    schedule = Schedule(name="thrust_x", times=(0.0, 1.0), values=(1.0,))
    chief = Spacecraft(name="chief", dimension=2, controller=Scripted(commands=(schedule,)))
    message = fault(lambda: jaxsafe.override(env, {"platforms": [chief, env.agent_platform]}))
    assert message.endswith("thrust_x: expected as many values as times, found 1 and 2")


def test_make_with_overrides_is_override_of_make(env: Environment) -> None:
    assert jaxsafe.make("docking2d", {"deputy.mass": 9}) == jaxsafe.override(
        env, {"deputy.mass": 9}
    )


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (
            "reward.delta_v.scal",
            1,
            r"reward\.delta_v\.scal: unknown field 'scal'.* Did you mean 'scale'\?",
        ),
        (
            "reward.delta.scale",
            1,
            r"reward\.delta: unknown name 'delta'\. Did you mean 'delta_v'\?.* success",
        ),
        ("rewards.delta_v.scale", 1, r"rewards: unknown field 'rewards'.* Did you mean 'reward'\?"),
        ("deputi.mass", 1, r"deputi: unknown field 'deputi'.* Did you mean 'deputy'\?"),
        (
            "deputy.start.positon.distance",
            1,
            r"deputy\.start\.positon: unknown name.* Did you mean 'position'\?",
        ),
        (
            "reward.failure.values.crsh",
            1,
            r"reward\.failure\.values: unknown name 'crsh'.* Did you mean 'crash'\?",
        ),
        ("", 1, r"unknown field ''; choose from agent"),
        ("reward..scale", 1, r"reward: unknown name ''"),
        ("agent.x", 1, r"agent\.x: agent has no fields"),
        ("dt.x", 1, r"dt\.x: dt has no fields"),
        ("reward.delta_v.bound.below", -1, r"bound has no fields because it is not set"),
        ("deputy", 1, r"deputy: name one of its fields: .*mass"),
        ("reward.delta_v", 1, r"reward\.delta_v: name one of its fields: .*scale"),
        ("reward", 1, r"reward: expected a list, found 1"),
        ("deputy.mass", 0, r"deputy\.mass: expected a number in kg > 0, found 0"),
        (
            "deputy.mass",
            np.array([10.0, 12.0]),
            r"found an array of shape \(2,\); for an environment with each value, use jax\.vmap$",
        ),
        ("deputy.mass", "heavy", r"deputy\.mass: expected a number in kg > 0, found 'heavy'"),
        ("deputy.mass", "12", r"deputy\.mass: expected a number .*, found '12'"),
        ("deputy.mass", True, r"deputy\.mass: expected a number .*, found True"),
        ("deputy.mass", None, r"deputy\.mass: expected a number .*, found None"),
        ("deputy.mass", float("nan"), r"deputy\.mass: expected a number .*, found nan"),
        ("deputy.mass", 1e-50, r"deputy\.mass: expected a number .* > 0, found 1e-50"),
        ("deputy.mass", 10**400, r"deputy\.mass: expected a number .*, found 1000"),
        ("deputy.mass", [1.0], r"deputy\.mass: expected a number .*, found \[1\.0\]"),
        ("deputy.mass", {"kg": 12}, r"deputy\.mass: expected a number .*, found \{'kg': 12\}"),
        ("deputy.mass", 1j, r"deputy\.mass: expected a number .*, found 1j"),
        (
            "deputy.start.position.distance",
            [3, 1],
            r"distance: expected low ≤ high, found \[3, 1\]",
        ),
        (
            "deputy.start.position.distance",
            [1, 2, 3],
            r"expected a list \[low, high\] in m or ft ≥ 0, found \[1, 2, 3\]",
        ),
        (
            "deputy.start.position.distance",
            [-1, 1],
            r"expected a list \[low, high\] in m or ft ≥ 0, found \[-1, 1\]",
        ),
        (
            "deputy.start.position.distance",
            [False, True],
            r"expected a list \[low, high\].*found \[False, True\]",
        ),
        (
            "deputy.start.position.distance",
            ["1", "2"],
            r"expected a list \[low, high\].*found \['1', '2'\]",
        ),
        (
            "deputy.start.position.distance",
            3,
            r"expected a list \[low, high\] in m or ft ≥ 0, found 3",
        ),
        ("deputy.controller.actuators.thrust_x.points", 1, r"expected a whole number ≥ 2, found 1"),
        (
            "deputy.controller.actuators.thrust_x.points",
            3.5,
            r"expected a whole number ≥ 2, found 3\.5",
        ),
        (
            "deputy.controller.actuators.thrust_x.points",
            True,
            r"expected a whole number ≥ 2, found True",
        ),
        ("deputy.controller.actuators.thrust_x.rescale", 1, r"expected true or false, found 1"),
        (
            "deputy.controller.actuators.thrust_x.low",
            2,
            r"thrust_x: expected low ≤ high, found 2 and 1",
        ),
        ("deputy.dimension", 4, r"deputy\.dimension: expected a whole number in \[2, 3\], found 4"),
        (
            "terminal.timeout.ends",
            "truncate",
            r"ends: found 'truncate'\. Did you mean 'truncated'\? Choose from ",
        ),
        ("status.delta_v.norm", "l3", r"norm: found 'l3'\. Did you mean 'l.'\? Choose from l1, l2"),
        (
            "status.speed.of",
            "chef",
            r"status\.speed\.of: nothing is called 'chef'.* Did you mean 'chief'\?",
        ),
        (
            "reward.failure.values",
            {"crsh": -1},
            r"nothing is called 'crsh'.* Did you mean 'crash'\?",
        ),
        (
            "reward.velocity_constraint.bound",
            None,
            r"nothing is called 'velocity'; choose from success, crash",
        ),
        (
            "reward.success.outcome",
            "sucess",
            r"nothing is called 'sucess'.* Did you mean 'success'\?",
        ),
        ("reward.delta_v.name", "success", r"reward: the name 'success' stands twice"),
        (
            "measure",
            ["cost.maximum"],
            r"measure: expected STATUS.{mean, maximum, minimum, final}, f",
        ),
        ("measure", ["speed.max"], r"found 'speed.max'. Did you mean 'speed.mean'."),
        (
            "observation",
            ["position", "velocty"],
            r"observation\.velocty: unknown name.* Did you mean 'velocity'\?",
        ),
        ("observation", ["position", "position"], r"observation: the name 'position' stands twice"),
        (
            "observation",
            ["position", 3],
            r"observation\.\[1\]: expected a mapping of fields, found 3",
        ),
        (
            "status",
            ["speed"],
            r"velocity_limit: nothing is called 'velocity_limit'; choose from speed",
        ),
        (
            "deputy.start",
            ["positon"],
            r"deputy\.start\.positon: unknown name.* Did you mean 'position'\?",
        ),
        (
            "deputy.controller",
            {"type": "uncontrolled"},
            r"agent: 'deputy' cannot be the agent: its controller takes no",
        ),
        ("agent", "chief", r"agent: 'chief' cannot be the agent: its controller takes no actions"),
    ],
)
def test_a_bad_override_is_refused(env: Environment, path: str, value: Any, message: str) -> None:
    assert re.search(message, fault(lambda: jaxsafe.override(env, {path: value})))


@pytest.mark.parametrize(
    ("path", "make_value", "message"),
    [
        (
            "deputy.mass",
            lambda w: jnp.stack([w, w]),
            r"deputy\.mass: expected a number .*an array of shape \(2,\)",
        ),
        (
            "deputy.start.position.distance",
            lambda w: w,
            r"expected a list \[low, high\].*an array of shape \(\)",
        ),
        (
            "deputy.controller.actuators.thrust_x.points",
            lambda w: w,
            r"points: expected a whole number",
        ),
        (
            "status.delta_v.norm",
            lambda w: w,
            r"norm: found an array of shape \(\); choose from l1, l2",
        ),
        ("agent", lambda w: w, r"agent: expected a name"),
        ("deputy.mas", lambda w: w, r"unknown field 'mas'"),
    ],
)
def test_a_misplaced_traced_value_is_refused(
    env: Environment, path: str, make_value: Any, message: str
) -> None:
    def act() -> Any:
        return jax.eval_shape(
            lambda w: jaxsafe.override(env, {path: make_value(w)}), jnp.float32(1.0)
        )

    assert re.search(message, fault(act))


def test_overrides_take_traced_values(env: Environment) -> None:
    masses = jnp.asarray([10.0, 12.0, 14.0])
    batch = jax.vmap(lambda mass: jaxsafe.override(env, {"deputy.mass": mass}))(masses)
    assert batch.agent_platform.mass.tolist() == masses.tolist()
    low = {"deputy.controller.actuators.thrust_x.low": jnp.float32(-2.0)}
    assert (
        jax.jit(lambda: jaxsafe.override(env, low))().agent_platform.controller.actuators[0].low
        == -2.0
    )
    slope = jax.grad(
        lambda mass: 3.0 * jaxsafe.override(env, {"deputy.mass": mass}).agent_platform.mass
    )(12.0)
    assert slope == 3.0


# Faults of `make`


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (
            lambda: jaxsafe.make("docking2"),
            r"env: unknown task 'docking2'.* Did you mean 'docking2d'\?",
        ),
        (
            lambda: jaxsafe.make(""),
            r"env: unknown task ''.*; choose from rejoin2d, rejoin3d, docking2d",
        ),
        (
            lambda: jaxsafe.make("docking2d", actions="discret"),
            r"actions: unknown kind.* Did you mean 'discrete'\?",
        ),
        (
            lambda: jaxsafe.make("no_such_file.yaml"),
            r"no_such_file\.yaml: cannot be read: No such file",
        ),
        (
            lambda: jaxsafe.make("docking2d", {"deputy.mas": 1}),
            r"deputy\.mas: .* Did you mean 'mass'\?",
        ),
        (
            lambda: jaxsafe.make(3),
            (
                r"env: expected the name of a task or a \.yaml file, found"
                r" 3"
            ),
        ),  # type: ignore[arg-type]
        (lambda: jaxsafe.make("docking2d", ["deputy.mass=1"]), r"override"),  # type: ignore[arg-type]
        (
            lambda: jaxsafe.make("docking2d", variant="releasd"),
            r"variant: unknown variant.* Did you mean 'released'\?",
        ),
        (
            lambda: jaxsafe.make("docking2d", randomize={"deputy.mas": [1, 2]}),
            r"randomize: deputy\.mas: .* 'mass'\?",
        ),
        (
            lambda: jaxsafe.make("docking2d", randomize={"deputi.mass": [1, 2]}),
            r"randomize: deputi: .* 'deputy'\?",
        ),
        (
            lambda: jaxsafe.make("docking2d", randomize={"deputy.mass": [2, 1]}),
            r"deputy\.mass: expected low ≤ high",
        ),
        (
            lambda: jaxsafe.make("docking2d", randomize={"deputy.mass": [-1, 1]}),
            r"randomize: deputy\.mass: .* > 0, found",
        ),
        (
            lambda: jaxsafe.make("docking2d", randomize={"deputy.mass": 3}),
            r"deputy\.mass: expected a list \[low, high\]",
        ),
        (
            lambda: jaxsafe.make("docking2d", randomize={"deputy.name": [1, 2]}),
            r"randomize: deputy\.name: expected the path",
        ),
        (
            lambda: jaxsafe.make("docking2d", randomize={"randomize.dt": [1, 2]}),
            r"randomize\.randomize\.dt: expected the",
        ),
        (
            lambda: jaxsafe.make("docking2d", randomize={"deputy.start.position.distance": [1, 2]}),
            r"list \[low, high\]",
        ),
        (
            lambda: jaxsafe.make("docking2d", randomize=3),
            r"randomize: expected paths with values, found 3",
        ),
    ],
)
def test_make_refuses_what_it_does_not_know(act: Callable[[], Any], message: str) -> None:
    assert re.search(message, fault(act))


def test_a_variant_is_for_a_task_by_name(env: Environment, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(dump(env))
    for variant in ("paper", "released"):
        message = fault(lambda variant=variant: jaxsafe.make(path, variant=variant))
        assert message.startswith(f"variant: {path} has no variants; a variant is for rejoin2d")
    assert "Did you mean 'released'?" in fault(lambda: jaxsafe.make(path, variant="releasd"))  # type: ignore[arg-type]


# Faults in a YAML file


@pytest.mark.parametrize("task", one_of_each_kind(TASKS))
def test_every_misspelt_field_is_refused_with_the_right_one(task: str) -> None:
    tree = parse(dump(jaxsafe.make(task)), task)
    places = [(mapping, key) for mapping in mappings(tree) for key in mapping]
    assert len(places) > 150
    for mapping, key in places:
        before = dict(mapping)
        mapping.clear()
        mapping.update(
            {f"{name}x" if name == key else name: value for name, value in before.items()}
        )
        message = fault(lambda: compose(tree))
        mapping.clear()
        mapping.update(before)
        if key == "type":
            assert re.search(r": field 'type' is missing; choose from \w+", message)
        else:
            name = key.rpartition(".")[2]  # of what is tied, a path
            assert f"'{name}x'" in message
            assert f"Did you mean '{name}'?" in message


@pytest.mark.parametrize("task", one_of_each_kind(TASKS))
def test_every_misspelt_type_choice_or_reference_is_refused(task: str) -> None:
    tree = parse(dump(jaxsafe.make(task)), task)
    words = [
        (mapping, key)
        for mapping in mappings(tree)
        for key, value in mapping.items()
        if isinstance(value, str)
    ]
    words = [(mapping, key) for mapping, key in words if key != "name"]
    assert len(words) > 50
    for mapping, key in words:
        right = mapping[key]
        mapping[key] = f"{right}x"
        message = fault(lambda: compose(tree))
        mapping[key] = right
        # A bound brings its outcome, so what refers to the misspelt outcome is then wrong.
        if key == "outcome" and mapping.get("below"):
            assert "nothing is called 'velocity'" in message
        else:
            name = right.rpartition(".")[2] if key == "to" else right
            assert f"'{name}x'" in message
            assert f"Did you mean '{name}'?" in message


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.* because it follows ")
def test_every_missing_field_without_a_default_is_named(tree: dict[str, Any]) -> None:
    places = [(mapping, key) for mapping in mappings(tree) for key in mapping]
    required = {
        (mapping.get("type"), key) for mapping, key in places if refusal_without(tree, mapping, key)
    }
    assert required >= {
        *(
            (None, key)
            for key in (
                "agent",
                "platforms",
                "terminal",
                "reward",
                "observation",
                "low",
                "high",
                "below",
            )
        ),
        *(("spacecraft", key) for key in ("type", "name", "dimension", "controller")),
        *(("at_distance", key) for key in ("type", "name", "about", "distance")),
        *(("circle", key) for key in ("type", "name", "on", "radius")),
        *(("velocity_limit", key) for key in ("type", "name", "distance", "floor", "slope")),
        *(("distance_change", key) for key in ("type", "name", "distance", "half_distance")),
        *(("observe", key) for key in ("type", "name", "of", "what")),
    }
    optional = {
        "dt",
        "ends",
        "points",
        "scale",
        "clip",
        "share",
        "offset",
        "mass",
        "mean_motion",
        "azimuth",
    }
    assert optional.isdisjoint(key for _, key in required)


def refusal_without(tree: dict[str, Any], mapping: dict[str, Any], key: str) -> bool:
    """Return whether the tree is refused without one key. The key is put back where it was."""
    before = dict(mapping)
    del mapping[key]
    try:
        compose(tree)
    except ConfigError as error:
        return "\n" not in str(error)
    finally:
        mapping.clear()
        mapping.update(before)
    return False


def test_a_missing_field_is_named_with_what_it_takes(tree: dict[str, Any]) -> None:
    del tree["status"][3]["floor"]
    message = fault_in(tree)
    assert message == (
        "status.velocity_limit (velocity_limit): field 'floor' is missing; it takes a number"
        " in m/s ≥ 0"
    )


@pytest.mark.thorough
def test_every_number_replaced_by_a_word_a_truth_value_or_nan_is_refused(
    tree: dict[str, Any],
) -> None:
    def is_number(value: Any) -> bool:
        return isinstance(value, (int, float)) and not isinstance(value, bool)

    def may_be_a_list(mapping: dict[str, Any], key: str) -> bool:
        return key == "scale" and mapping["type"].startswith("observe")

    numbers = [
        (mapping, key)
        for mapping in mappings(tree)
        for key, value in mapping.items()
        if is_number(value)
    ]
    assert len(numbers) > 30
    for mapping, key in numbers:
        right = mapping[key]
        for wrong in (
            "wrong",
            True,
            float("nan"),
            None,
            [None] if may_be_a_list(mapping, key) else [1.0],
            {"a": 1.0},
        ):
            mapping[key] = wrong
            assert re.search(rf"{key}: expected .*, found ", fault(lambda: compose(tree)))
        mapping[key] = right
    compose(tree)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("platforms.0", 3, r"platforms\.\[0\]: expected a mapping of fields, found 3"),
        ("platforms", {"a": 1}, r"platforms: expected a list, found \{'a': 1\}"),
        ("platforms", [], r"agent: nothing is called 'deputy'; choose from none"),
        ("reward", [], r"reward: an environment needs at least one"),
        ("observation", [], r"observation: an environment needs at least one"),
        (
            "platforms.0.type",
            "ancor",
            r"platforms\.chief: unknown type 'ancor'.* Did you mean 'anchor'\?",
        ),
        (
            "platforms.0.type",
            3,
            r"platforms\.chief: unknown type 3; choose from anchor, .*, two_body_j2$",
        ),
        ("platforms.0.type", ["anchor"], r"platforms\.chief: unknown type \['anchor'\]"),
        ("platforms.0.name", 3, r"platforms\.\[0\]\.name: expected a name, found 3"),
        (
            "platforms.0.dimension",
            3,
            r"platforms: expected the same dimension for all, found chief 3, deputy 2",
        ),
        (
            "platforms.1.start.0.about",
            "deputy",
            r"nothing placed before it is called 'deputy'; choose from chief, docking_region",
        ),
        (
            "platforms.1.start.0.name",
            "positon",
            r"positon: no such state field\. Did you mean 'position'\?",
        ),
        (
            "platforms.1.start.1.name",
            "position",
            r"platforms\.deputy\.start: the name 'position' stands twice",
        ),
        (
            "platforms.1.start.0.direction.polar",
            [0, 3],
            r"direction: draws 3 numbers, the platform has 2 dimensions",
        ),
        (
            "platforms.1.controller",
            {"type": "uncontrolled"},
            r"agent: 'deputy' cannot be .*: its controller takes no act",
        ),
        (
            "platforms.1.controller.actuators",
            [],
            r"agent: 'deputy' cannot be the agent: its controller takes no actions",
        ),
        (
            "platforms.1.controller.type",
            "uncontrolled",
            r"controller \(uncontrolled\): unknown field 'actuators'",
        ),
        (
            "platforms.1.controller",
            {"type": "scripted"},
            r"agent: 'deputy' cannot be .*: its controller takes no actions",
        ),
        (
            "platforms.1.controller.actuators.0.name",
            "thrust",
            r"spacecraft has no control 'thrust'\. Did you mean 'thrust_.'\? Choose from thrust_x",
        ),
        (
            "platforms.1.controller.actuators.0.name",
            "thrust_y",
            r"actuators: the name 'thrust_y' stands twice",
        ),
        (
            "platforms.1.controller.actuators.0.name",
            "a.b",
            r"actuators: expected a name without dots, found 'a\.b'",
        ),
        (
            "platforms.0.controller",
            {"type": "continuous", "actuators": []},
            (
                r"platforms\.chief\.controller \(continuous\): only the agent takes actions; choose"
                r" from pilot, scripted, uncontrolled"
            ),
        ),
        (
            "platforms.0.controller",
            {"type": "scripted", "commands": [{"type": "constant", "name": "thrust_x", "at": 1}]},
            (
                r"platforms\.chief\.controller\.commands: anchor has no control 'thrust_x'; choose"
                r" from none"
            ),
        ),
        (
            "regions.0.on",
            "chef",
            r"regions\.docking_region\.on: nothing is called 'chef'.* Did you mean 'chief'\?",
        ),
        (
            "regions.0.radius",
            -1,
            r"regions\.docking_region\.radius: expected a number in m or ft ≥ 0, found -1",
        ),
        (
            "regions.0.name",
            "dock",
            r"status\.in_docking\.region: nothing is called 'docking_region'; choose from dock",
        ),
        ("status.1.name", "speed", r"status: the name 'speed' stands twice"),
        (
            "status.3.distance",
            "delta_v",
            r"velocity_limit\.distance: nothing listed before it is called 'delta_v'",
        ),
        (
            "status.3.distance",
            "velocity_limit",
            r"nothing listed before it is called 'velocity_limit'",
        ),
        ("status.3.distance", "docking_distanc", r"Did you mean 'docking_distance'\?"),
        (
            "constraints.0.speed",
            "spee",
            r"constraints\.velocity_limit\.speed: nothing is called 'spee'.* 'speed'\?",
        ),
        ("status.0.name", "a.b", r"status: expected a name without dots, found 'a\.b'"),
        ("observation.0.name", "", r"observation: expected a name without dots, found ''"),
        ("platforms.0.name", "a.b", r"platforms: expected a name without dots, found 'a\.b'"),
        ("reward.1.bound.outcome", "a.b", r"outcomes: expected a name without dots, found 'a\.b'"),
        (
            "status.1.of",
            "chief",
            r"in_docking\.of: region 'docking_region' is on 'chief' itself; choose another",
        ),
        (
            "observation.0.relative_to",
            "chef",
            r"observation\.position\.relative_to: .* Did you mean 'chief'\?",
        ),
        (
            "observation.0.frame",
            "deputi",
            r"observation\.position\.frame: .* Did you mean 'deputy'\?",
        ),
        (
            "observation.0.form",
            "magnom",
            r"observation\.position\.form: found 'magnom'.* Did you mean 'magnorm'\?",
        ),
        (
            "observation.0.what",
            "orientation",
            r"deputy has no quantity 'orientation'\. Did you mean 'position'\? Choose from",
        ),
        (
            "observation.0.what",
            "roll",
            r"observation\.position\.what: deputy has no quantity 'roll'; choose from position",
        ),
        (
            "randomize",
            {"deputy.mas": [1, 2]},
            r"randomize: deputy\.mas: unknown field 'mas'.* Did you mean 'mass'\?",
        ),
        ("imports", "mine", r"imports: expected a list of modules, found 'mine'"),
        ("imports", [3], r"imports: expected a list of modules, found \[3\]"),
        ("imports", None, r"imports: expected a list of modules, found None"),
        (
            "imports",
            ["no.such.module"],
            r"imports: cannot import 'no\.such\.module': ModuleNotFoundError: No module named",
        ),
        ("imports", [""], r"imports: cannot import '': ValueError"),
        ("terminal.0.name", "running", r"outcomes: the name 'running' stands twice"),
        (
            "terminal.0.in_docking",
            "indocking",
            r"terminal\.success\.in_docking: .* Did you mean 'in_docking'\?",
        ),
        (
            "reward.1.bound",
            -5,
            r"reward\.velocity_constraint\.bound: expected a mapping of fields, found -5",
        ),
        ("reward.1.bound.outcome", "crash", r"outcomes: the name 'crash' stands twice"),
        (
            "reward.1.bound.outcom",
            "crash",
            r"bound: unknown field 'outcom'.* Did you mean 'outcome'\?",
        ),
        (
            "reward.4.values",
            3,
            r"reward\.failure\.values: expected a mapping of names to values, found 3",
        ),
        (
            "observation.0.what",
            "positon",
            r"observation\.position\.what: .* Did you mean 'position'\?",
        ),
        (
            "observation.0.scale",
            0,
            r"position\.scale: expected a number or a list of numbers other than 0, found 0",
        ),
        (
            "observation.0.clip",
            [1, -1],
            r"observation\.position\.clip: expected low ≤ high, found \[1, -1\]",
        ),
        ("observation.2.status", "sped", r"observation\.speed\.status: .* Did you mean 'speed'\?"),
        ("agent", "deputi", r"agent: nothing is called 'deputi'.* Did you mean 'deputy'\?"),
    ],
)
def test_a_broken_environment_is_refused(
    tree: dict[str, Any], path: str, value: Any, message: str
) -> None:
    assert re.search(message, fault_in(put(tree, path, value)))


def test_a_status_may_refer_only_to_earlier_ones(tree: dict[str, Any]) -> None:
    tree["status"].reverse()
    assert "nothing listed before it is called 'docking_distance'" in fault_in(tree)
    tree["status"].reverse()
    tree["platforms"].reverse()
    assert (
        "platforms.deputy.start.position.about: nothing placed before it is called 'chief'"
        in fault_in(tree)
    )


def test_the_direction_of_a_spatial_start_needs_a_polar_range() -> None:
    message = fault(
        lambda: jaxsafe.make("docking3d", {"deputy.start.velocity.direction.polar": None})
    )
    assert "start.velocity.direction: draws 2 numbers, the platform has 3 dimensions" in message


# Parts that fit by name but cannot be computed


class ChangesShape(Status, type="changes_shape_of_test"):
    """A status whose memory changes its shape between reset and the first step."""

    how: Literal["shape", "dtype", "structure"]

    def init(self, sim: Any) -> Any:
        return jnp.zeros(2)

    def increment(self, memory: Any, sim: Any, dt: Any) -> Any:
        return {"shape": jnp.zeros(3), "dtype": jnp.zeros(2, int), "structure": (memory,)}[self.how]

    def process(self, memory: Any, sim: Any) -> jax.Array:
        return jnp.zeros(())


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (
            "shape",
            r"^memory\.status\.odd: is float32\[2\] after reset and float32\[3\] after a step$",
        ),
        ("dtype", r"status\.odd: is float32\[2\] after reset and int32\[2\] after a step"),
        (
            "structure",
            r"^status\.odd: its memory has another structure after a step than after reset$",
        ),
    ],
)
def test_a_memory_that_changes_its_form_is_told_with_its_part(
    tree: dict[str, Any], how: str, message: str
) -> None:
    tree["status"].append({"type": "changes_shape_of_test", "name": "odd", "how": how})
    assert re.search(message, fault(lambda: compose(tree)))


class LosesVelocity(Spacecraft, type="loses_velocity_of_test"):
    """A platform whose velocity is of another type after a step."""

    def step(self, state: Any, controls: Any, dt: Any) -> Any:
        after = super().step(state, controls, dt)
        return after.replace(velocity=after.velocity.astype(int))


def test_a_platform_that_changes_its_form_is_told_with_its_field(tree: dict[str, Any]) -> None:
    [deputy] = [platform for platform in tree["platforms"] if platform["name"] == "deputy"]
    deputy["type"] = "loses_velocity_of_test"
    assert fault(lambda: compose(tree)) == (
        "platforms.deputy.velocity: is float32[2] after reset and int32[2] after a step"
    )


CYLINDER = {"type": "cylinder", "name": "docking_region", "on": "chief", "radius": 1, "height": 1}


@pytest.mark.parametrize(
    ("task", "changes", "place"),
    [
        ("docking2d", {"terminal.success.in_docking": "speed"}, "terminal.success"),
        ("docking2d", {"terminal.crash.in_docking": "delta_v"}, "terminal.crash"),
        ("docking2d", {"reward.failure.values": {}}, "reward.failure"),
        ("docking2d", {"regions": [CYLINDER]}, "regions.docking_region"),
        (
            "docking2d",
            {"regions.docking_region.offset": {"type": "displacement", "by": [1, 2, 3]}},
            "regions",
        ),
        (
            "docking2d",
            {"regions.docking_region.offset": {"type": "displacement", "by": [1]}},
            "regions.docking_region",
        ),
        ("docking2d", {"deputy.start": ["velocity", "position"]}, "platforms.deputy"),
        ("docking3d", {"observation.velocity.scale": [1, 2]}, "observation.velocity"),
        (
            "docking2d",
            {
                "observation.position.relative_to": "chief",
                "observation.position.scale": [1, 2, 3, 4],
            },
            "observation.position",
        ),
        (
            "rejoin2d",
            {
                "status.rejoin_time.status": "in_rejoin",
                "reward.in_rejoin_first_time.status": "lead_distance",
            },
            "reward.in_rejoin_first_time",
        ),
        (
            "rejoin2d",
            {"lead.start.position.low": [1, 1, 1], "lead.start.position.high": [2, 2, 2]},
            "platforms.lead",
        ),
        (
            "rejoin3d",
            {"wingman.start.heading.low": [1], "wingman.start.heading.high": [2]},
            "platforms.wingman",
        ),
    ],
)
def test_parts_that_cannot_be_computed_are_told_with_their_place(
    task: str, changes: dict[str, Any], place: str
) -> None:
    assert fault(lambda: jaxsafe.make(task, changes)).startswith(place)


def test_a_number_has_no_components_in_a_frame() -> None:
    changes = {"observation.attitude_rate.frame": "deputy"}
    assert fault(lambda: jaxsafe.make("docking2d_oriented", changes)).startswith(
        "observation.attitude_rate"
    )


@pytest.mark.parametrize("task", ["rejoin2d"])
def test_only_the_agent_may_take_actions(task: str) -> None:
    actuators = [{"name": "heading_rate", "low": -0.1, "high": 0.1}]
    message = fault(
        lambda: jaxsafe.make(
            task, {"lead.controller": {"type": "discrete", "actuators": actuators}}
        )
    )
    assert message.startswith(
        "platforms.lead.controller (discrete): only the agent takes actions; choose from pilot, "
        "scripted, uncontrolled"
    )
    assert "cannot be the agent" in fault(
        lambda: jaxsafe.make(task, {"wingman.controller": {"type": "scripted"}})
    )
    assert "cannot be the agent" in fault(lambda: jaxsafe.make(task, {"agent": "lead"}))


# Components of a user's own module

MODULE = """
import jax.numpy as jnp
from jaxsafe.processors.observation import Observation
from jaxsafe.processors.reward import Reward
from jaxsafe.processors.status import Status
from jaxsafe.processors.terminal import Terminal
from jaxsafe.simulation.initializers import Initializer
from jaxsafe.types import Dimensionless, StatusName

class Half(Status, type="half_of_test"):
    status: StatusName
    def process(self, memory, sim):
        return sim.status[self.status] / 2.0

class Bonus(Reward, type="bonus_of_test"):
    value: Dimensionless = 1.0
    def process(self, memory, sim):
        return self.value

class Clock(Observation, type="clock_of_test"):
    def measure(self, memory, sim):
        return sim.time[None]

class Slow(Terminal, type="slow_of_test"):
    status: StatusName
    below: Dimensionless
    def reached(self, sim):
        return sim.status[self.status] < self.below

class Aside(Initializer, type="aside_of_test"):
    distance: Dimensionless
    def draw(self, key, drawn, sim):
        return jnp.stack([self.distance, 0.0])
"""


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current directory.

    Modules are found in it, and what a test imports is forgotten after it.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "modules", dict(sys.modules))
    return tmp_path


def test_components_of_a_user_s_module_are_usable_from_yaml_at_once(
    tree: dict[str, Any], directory: Path
) -> None:
    (directory / "parts_of_test.py").write_text(MODULE)
    tree["imports"] = ["parts_of_test"]
    tree["status"].append({"type": "half_of_test", "name": "half", "status": "speed"})
    tree["reward"].append({"type": "bonus_of_test", "name": "bonus"})
    tree["observation"].append({"type": "clock_of_test", "name": "clock", "scale": 2.0})
    tree["terminal"].append(
        {"type": "slow_of_test", "name": "slow", "status": "half", "below": 1e-3}
    )
    tree["platforms"][1]["start"][0] = {
        "type": "aside_of_test",
        "name": "position",
        "distance": 70.0,
    }
    path = directory / "mine.yaml"
    path.write_text(write(tree))
    env = load(path)

    state, timestep = jaxsafe.reset(env, jax.random.key(0))
    assert state.sim.platforms["deputy"].position.tolist() == [70.0, 0.0]
    speed = float(timestep.info.status["speed"])
    assert float(timestep.info.status["half"]) == pytest.approx(speed / 2.0)
    _, timestep = jaxsafe.step(env, state, jnp.zeros(2))
    assert timestep.observation[-1] == 0.5
    assert timestep.info.reward_terms["bonus"] == 1.0
    assert "slow" in env.outcomes

    text = dump(env)
    assert text.startswith("imports: [parts_of_test]\n")
    assert load(text) == env
    assert dump(load(text)) == text
    path.write_text(text)
    code = "from jaxsafe.config import dump, load; print(dump(load('mine.yaml')), end='')"
    fresh = subprocess.run(
        [sys.executable, "-c", code], cwd=directory, check=True, capture_output=True, text=True
    )
    assert fresh.stdout == text


def test_an_environment_of_the_house_s_own_parts_needs_no_imports(env: Environment) -> None:
    assert "imports" not in dump(env)


def test_parts_within_parts_are_imported_too(env: Environment, directory: Path) -> None:
    text = (
        "from jaxsafe.simulation.scripted import Command\nclass Nod(Command,"
        " type='nod_of_test'):\n    pass\n"
    )
    (directory / "nested_of_test.py").write_text(text)
    import_modules(["nested_of_test"], "")
    nod = sys.modules["nested_of_test"].Nod(name="thrust_x")
    chief = normalise(Spacecraft(name="chief", dimension=2, controller=Scripted(commands=(nod,))))
    assert modules(env.replace(platforms=(chief, env.agent_platform))) == ["nested_of_test"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "raise RuntimeError('first line\\nsecond line')",
            r"cannot import 'bad_of_test': RuntimeError: first line \(bad_of_test\.py, line 1\)$",
        ),
        (
            "x = 1 / 0",
            (
                r"cannot import 'bad_of_test': ZeroDivisionError: division by zero"
                r" \(bad_of_test\.py, line 1\)$"
            ),
        ),
        (
            "\n\ndef f():\n    import json\n    return json.loads('{')\nf()",
            r"cannot import 'bad_of_test': JSONDecodeError: .* \(bad_of_test\.py, line 5\)$",
        ),
        ("def", r"cannot import 'bad_of_test': SyntaxError: [^(]*\(bad_of_test\.py, line 1\)$"),
        (
            "import no_such_module_of_test",
            r"cannot import 'bad_of_test': ModuleNotFoundError: No module named 'no_such",
        ),
        (
            "raise ValueError",
            r"cannot import 'bad_of_test': ValueError:  \(bad_of_test\.py, line 1\)$",
        ),
        (
            (
                "from jaxsafe.processors.status import Status\nclass Mine(Status, type='speed'):\n"
                "    pass"
            ),
            (
                r"type 'speed' of bad_of_test\.Mine: taken by jaxsafe\.processors\.status\.Speed;"
                r" choose another name$"
            ),
        ),
    ],
)
def test_a_module_that_cannot_be_imported_is_told_in_one_line(
    tree: dict[str, Any], directory: Path, text: str, message: str
) -> None:
    (directory / "bad_of_test.py").write_text(text)
    assert re.search(message, fault_in(tree | {"imports": ["bad_of_test"]}))


def test_imports_can_be_refused(tree: dict[str, Any], directory: Path) -> None:
    (directory / "evil_of_test.py").write_text("open('ran', 'w')")
    with imports_allowed(False):
        found = fault_in(tree | {"imports": ["evil_of_test"]})
        assert re.search(
            r"imports: names \['evil_of_test'\], whose code would run; imports=false refuses that$",
            found,
        )
        load(write(tree | {"imports": []}))
    assert not (directory / "ran").exists()


def test_an_error_in_the_code_of_a_user_names_its_line(
    tree: dict[str, Any], directory: Path
) -> None:
    (directory / "helper_of_test.py").write_text("def divide(x):\n    return x / 'two'\n")
    (directory / "fails_of_test.py").write_text(
        "from helper_of_test import divide\n"
        "from jaxsafe.processors.status import Status\n\n\n"
        "class Fails(Status, type='fails_of_test'):\n"
        "    def problem(self):\n"
        "        return None if self.name != 'early' else 1 + None\n\n"
        "    def process(self, memory, sim):\n"
        "        return divide(sim.time)\n"
    )
    for name, message in (
        (
            "late",
            r"^status\.late: cannot be computed: TypeError: .* \(helper_of_test\.py, line 2\)$",
        ),
        (
            "early",
            r"^status\.early: cannot be checked: TypeError: .* \(fails_of_test\.py, line 7\)$",
        ),
    ):
        data = copy.deepcopy(tree) | {"imports": ["fails_of_test"]}
        data["status"].append({"type": "fails_of_test", "name": name})
        assert re.search(message, fault_in(data))


def test_a_misspelt_type_of_a_user_s_module_is_refused(
    tree: dict[str, Any], directory: Path
) -> None:
    text = (
        "from jaxsafe.processors.status import Status\nclass Odd(Status,"
        " type='odd_one_of_test'):\n    pass\n"
    )
    (directory / "odd_of_test.py").write_text(text)
    tree["status"].append({"type": "odd_on_of_test", "name": "odd"})
    assert "Did you mean 'odd_one_of_test'?" in fault_in(tree | {"imports": ["odd_of_test"]})


@pytest.mark.parametrize("text", ["- 1\n- 2\n", "hello\n", "\n", "3\n"])
def test_a_file_that_is_no_mapping_is_refused(text: str) -> None:
    assert fault(lambda: load(text)).startswith("environment: expected a mapping of fields, found ")


# YAML itself


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e6", 1e6),
        ("3e-4", 3e-4),
        ("-1E+3", -1000.0),
        ("1.", 1.0),
        (".5", 0.5),
        ("12", 12),
        ("-7", -7),
        ("010", 10),
        ("0x10", "0x10"),
        ("1_000", "1_000"),
        ("1:30", "1:30"),
        ("2020-01-01", "2020-01-01"),
        ("on", "on"),
        ("off", "off"),
        ("yes", "yes"),
        ("no", "no"),
        ("true", True),
        ("false", False),
        ("True", "True"),
        ("null", None),
        ("~", None),
        ("", None),
        ("'12'", "12"),
        ("[1e-3, no]", [1e-3, "no"]),
        (".inf", float("inf")),
        ("-.inf", -float("inf")),
    ],
)
def test_scalars_are_read_as_users_expect(text: str, value: Any) -> None:
    read = parse(f"key: {text}\n", "file")["key"]
    assert read == value
    assert type(read) is type(value)


@pytest.mark.parametrize(
    "value", ["on", "no", "true", "1e6", "010", "", "null", 1e6, 3e-4, 10, True, None, [1, "1"]]
)
def test_plain_data_written_reads_back(value: Any) -> None:
    assert parse(write({"key": value}), "file") == {"key": value}


@pytest.mark.filterwarnings("ignore:.* because it follows ")
def test_numbers_without_a_point_reach_the_environment(env: Environment) -> None:
    text = (
        dump(env)
        .replace("mass: 12.0", "mass: 1e6")
        .replace("mean_motion: 0.001027", "mean_motion: 3e-4")
    )
    deputy = load(text.replace("points: 11", "points: 010")).agent_platform
    assert (deputy.mass, deputy.mean_motion) == (1e6, np.float32(3e-4))
    assert deputy.controller.actuators[0].points == 10


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "agent: a\nagent: b\n",
            r"^environment, line \d: not valid YAML: key 'agent' stands twice$",
        ),
        ("x:\n  - {a: 1, a: 2}\n", r"^environment, line 2: not valid YAML: key 'a' stands twice$"),
        ("agent: [1, 2\n", r"^environment, line \d: not valid YAML: expected"),
        ("agent: 'x\n", r"^environment, line \d: not valid YAML: "),
        ("a: b: c\n", r"^environment, line 1: not valid YAML: mapping values are not allowed"),
        (
            "x: {a: 1, agent:deputy}\n",
            r"^environment, line 1: .*'agent:deputy'; write a space after the colon: agent: d",
        ),
        ("agent: *x\n", r"^environment, line 1: not valid YAML: found undefined alias"),
        ("\tagent: x\n", r"^environment, line 1: not valid YAML: "),
        ("{[1, 2]: 3}\n", r"^environment.*: not valid YAML: "),
        ("a: 1\n---\nb: 2\n", r"^environment.*: not valid YAML: "),
        ("agent: \x00\n", r"^environment.*: not valid YAML: "),
        ("dt: " + "9" * 5000 + "\n", r"^environment: not valid YAML: "),
        ("[" * 5000 + "\n", r"^environment.*: not valid YAML: "),
    ],
)
def test_broken_yaml_is_refused(text: str, message: str) -> None:
    assert re.search(message, fault(lambda: load(text)))


def test_a_repeated_key_is_refused_deep_in_an_environment(env: Environment) -> None:
    text = dump(env).replace("  mass: 12.0\n", "  mass: 12.0\n  mass: 13.0\n")
    assert "key 'mass' stands twice" in fault(lambda: load(text))


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    missing = tmp_path / "missing.yaml"
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x81")
    assert fault(lambda: load(missing)) == f"{missing}: cannot be read: No such file or directory"
    assert fault(lambda: load(tmp_path)).startswith(f"{tmp_path}: cannot be read: ")
    assert fault(lambda: load(binary)) == f"{binary}: cannot be read: not a text file"
    broken = tmp_path / "broken.yaml"
    broken.write_text("dt: [1\n")
    assert fault(lambda: load(broken)).startswith(f"{broken}, line 2: not valid YAML: ")
    broken.write_text("platforms: 3\n")
    missing_field = f"{broken}: environment: field 'agent' is missing; it takes a name"
    assert fault(lambda: load(broken)) == missing_field
    broken.write_text(dump(jaxsafe.make("docking2d")).replace("agent: deputy", "agent: deputi"))
    unknown = f"{broken}: agent: nothing is called 'deputi'. Did you mean 'deputy'"
    assert fault(lambda: load(broken)).startswith(unknown)


@pytest.mark.parametrize(
    "kind", ["apply:os.system", "object/apply:os.system", "object/new:os.system"]
)
def test_tags_of_python_are_refused_and_nothing_runs(kind: str, tmp_path: Path) -> None:
    sign = tmp_path / "sign"
    for text in (f'!!python/{kind} ["touch {sign}"]\n', f'dt: !!python/{kind} ["touch {sign}"]\n'):
        assert "not valid YAML: could not determine a constructor for the tag" in fault(
            lambda text=text: load(text)
        )
    assert not sign.exists()


@pytest.mark.parametrize(
    ("task", "path", "status", "wanted"),
    [
        ("docking2d", "reward.distance_change.distance", "in_docking", "a number"),
        ("docking2d", "terminal.distance.distance", "in_docking", "a number"),
        ("docking2d", "terminal.success.in_docking", "speed", "true or false"),
        ("rejoin2d", "terminal.success.time", "in_rejoin", "a number"),
        ("rejoin2d", "reward.in_rejoin.status", "lead_distance", "true or false"),
        ("rejoin2d", "status.rejoin_time.status", "in_rejoin", None),
        ("docking2d", "observation.speed.status", "in_docking", None),
    ],
)
def test_a_status_of_the_wrong_kind_is_refused(
    task: str, path: str, status: str, wanted: str | None
) -> None:
    env = jaxsafe.make(task)
    if wanted is None:
        jaxsafe.override(env, {path: status})
    else:
        message = fault(lambda: jaxsafe.override(env, {path: status}))
        assert (
            message == f"{path}: expected a status that is {wanted}, found {status!r}, which is not"
        )


LAUGHS = "\n".join([f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 13)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("!!bool x", r"line 1: not valid YAML: found 'x' after the tag !!bool$"),
        ("!!bool yes", r"found 'yes' after the tag !!bool$"),
        ("!!bool [1]", r"found a collection after the tag !!bool$"),
        ("!!float ''", r"found '' after the tag !!float$"),
        ("!!float 1:30", r"found '1:30' after the tag !!float$"),
        ("!!int x", r"found 'x' after the tag !!int$"),
        ("!!null x", r"found 'x' after the tag !!null$"),
        ("!!map x", r"expected a mapping after the tag !!map$"),
        ("!!seq x", r"expected a sequence node, but found scalar$"),
        ("!!str [x]", r"expected a scalar node, but found sequence$"),
        *(
            (f"!!{tag} x", rf"could not determine a constructor for the tag '.*{tag}'$")
            for tag in (
                "timestamp",
                "binary",
                "set",
                "omap",
                "pairs",
                "merge",
                "value",
                "python/none",
            )
        ),
        ("!mine x", r"could not determine a constructor for the tag '!mine'$"),
        ("&a [*a]", r"an alias stands inside what it is the alias of$"),
        ("&a {b: {c: *a}}", r"an alias stands inside what it is the alias of$"),
        (
            f"{{a0: &a0 [1, 1],\n{LAUGHS}".replace("\n", " ").replace("] a", "], a") + "}",
            r"its aliases stand for more than 1,000,000 values$",
        ),
        ('"\\ud800"', r"found a control character in '\\ud800'$"),
        ('"a\\0b"', r"found a control character in 'a\\x00b'$"),
        (
            '"\\UFFFFFFFF"',
            r"^key: not valid YAML: (Python int too large|chr)",
            # These are Python's own words, and they differ between versions.
        ),
        ("9" * 5000, r"not valid YAML: Exceeds the limit"),
        ("x" * (2**20 + 1), r"^key: expected at most 1,048,576 letters$"),
    ],
)
def test_yaml_that_is_hard_to_read_is_refused(text: str, message: str) -> None:
    assert re.search(message, fault(lambda: parse(text, "key")))


def test_tags_of_the_core_schema_and_aliases_are_read() -> None:
    text = (
        "[!!str 12, !!int '12', !!float 12, !!bool 'true', !!null '', !!map {a: !!seq [1]}, ! 12]"
    )
    assert parse(text, "key") == ["12", 12, 12.0, True, None, {"a": [1]}, 12]
    assert parse("[&a [1, 2], *a, {<<: *a}]", "key") == [[1, 2], [1, 2], {"<<": [1, 2]}]


def test_a_value_is_shown_by_its_first_letters_however_large_it_is() -> None:
    huge: Any = [1]
    for _ in range(60):
        huge = [huge] * 9
    for path in (
        "agent",
        "dt",
        "platforms",
        "status.speed.of",
        "randomize",
        "reward.failure.values",
        "regions",
        "status.delta_v.norm",
    ):
        message = fault(lambda path=path: jaxsafe.make("docking2d", {path: huge}))
        assert "[[[" in message
    cyclic: list[Any] = []
    cyclic.append(cyclic)
    assert show(cyclic) == "[" * 57 + "..."
    assert show(10**5000) == "a number of thousands of digits"
    for value in (
        [],
        (),
        {},
        (1,),
        (1, [2.5, "x"]),
        {"a": {"b": None}},
        "it's",
        10**50,
        -1.5,
        True,
        {1},
        "x" * 55,
    ):
        assert show(value) == repr(value)


@pytest.mark.parametrize(
    ("task", "region", "fitting"),
    [
        (
            "docking3d",
            {"type": "circle", "radius": 1},
            "3 dimensions; choose from box, cone, cylinder, half_space, sphere$",
        ),
        (
            "rejoin3d",
            {"type": "circle", "radius": 1},
            "3 dimensions; choose from box, cone, cylinder, half_space, sphere$",
        ),
        (
            "docking2d",
            {"type": "cylinder", "radius": 1, "height": 1},
            "2 dimensions; choose from box, circle, cone, half_space, sphere$",
        ),
        ("docking2d", {"type": "sphere", "radius": 1}, None),
        ("docking3d", {"type": "cylinder", "radius": 1, "height": 1}, None),
    ],
)
def test_a_region_is_refused_in_a_space_where_its_name_says_something_else(
    task: str, region: dict[str, Any], fitting: str | None
) -> None:
    env = jaxsafe.make(task)
    regions = [{"name": env.regions[0].name, "on": env.regions[0].on, **region}]
    if fitting is None:
        jaxsafe.override(env, {"regions": regions})
    else:
        message = fault(lambda: jaxsafe.override(env, {"regions": regions}))
        assert re.search(
            (
                rf"^regions\.{env.regions[0].name}: a {region['type']} is no part of a space of"
                rf" {fitting}"
            ),
            message,
        )


@pytest.mark.parametrize(
    ("task", "path", "value", "message"),
    [
        *(
            ("docking2d", path, value, "of a magnitude|that is finite")
            for path, value in [
                ("dt", 1e30),
                ("dt", 1e-30),
                ("dt", float("inf")),
                ("deputy.mass", 1e-30),
                ("deputy.mass", 1e39),
                ("deputy.mean_motion", float("inf")),
                ("deputy.start.position.distance", [0, 1e38]),
                ("deputy.start.position.direction.azimuth", [0, float("inf")]),
                ("deputy.start.velocity.share", [0, 1e38]),
                ("deputy.controller.actuators.thrust_x.low", -float("inf")),
                ("regions.docking_region.radius", 1e38),
                ("deputy.controller.actuators.thrust_x.points", 1e30),
                ("terminal.distance.limit", 1e39),
                ("terminal.timeout.limit", float("inf")),
                ("reward.delta_v.scale", float("inf")),
                ("reward.success.value", -1e39),
                ("reward.success.time_scale", 1e-38),
                ("observation.position.scale", 1e-38),
                ("reward.velocity_constraint.offset", float("inf")),
                ("reward.velocity_constraint.bound.below", -float("inf")),
                ("reward.failure.values.crash", -float("inf")),
                ("reward.distance_change.half_distance", 1e-38),
                ("status.velocity_limit.slope", 1e38),
            ]
        ),
        ("docking2d", "terminal.distance.limit", -1, r"expected a number in m or ft > 0, found -1"),
        ("docking2d", "terminal.distance.limit", 0, r"expected a number in m or ft > 0, found 0"),
        (
            "docking2d",
            "observation.position.clip",
            [float("inf")] * 2,
            "low < high where a bound is infinite",
        ),
        ("rejoin3d", "lead.gravity", 0, r"lead\.gravity: expected a number in ft/s² > 0, found 0"),
        ("rejoin3d", "wingman.roll_limits", [-1.5707, 1.5707], "of a magnitude up to 1.57"),
        ("rejoin3d", "wingman.speed_limits", [1e-30, 400], "of a magnitude from 0.001 to 1e[+]09"),
        ("rejoin2d", "lead.start.position.low", [1e38, 1e38], "of a magnitude up to 1e[+]12"),
        (
            "rejoin2d",
            "regions.rejoin_region.offset.angle",
            float("inf"),
            "of a magnitude up to 10000",
        ),
        (
            "docking2d_oriented",
            "deputy.attitude_rate_limits",
            [1e38, 1e38],
            "of a magnitude up to 1e[+]06",
        ),
    ],
)
def test_a_number_from_which_no_finite_state_follows_is_refused(
    task: str, path: str, value: Any, message: str
) -> None:
    found = fault(lambda: jaxsafe.make(task, {path: value}))
    assert path in found
    assert re.search(message, found)


def test_a_speed_limit_of_nothing_is_refused() -> None:
    changes = {"status.velocity_limit.floor": 0, "status.velocity_limit.slope": 0}
    assert fault(lambda: jaxsafe.make("docking2d", changes)).startswith(
        "status.velocity_limit: expected a limit above 0"
    )
    jaxsafe.make("docking2d", {"status.velocity_limit.floor": 0})


def test_limits_may_be_infinite_and_read_back(env: Environment) -> None:
    changes = {
        "terminal.distance.limit": float("inf"),
        "observation.position.clip": [-float("inf"), 1.0],
    }
    changed = jaxsafe.override(env, changes)
    assert load(dump(changed)) == changed


def test_the_horizon_of_a_filter_has_an_end() -> None:
    message = fault(lambda: jaxsafe.make("docking2d", {"rta.horizon": 1e30}, rta="implicit_asif"))
    assert (
        message
        == "rta.horizon: expected a whole number ≥ 0 of a magnitude up to 10,000, found 1e+30"
    )


# Variants and filters


@pytest.mark.parametrize("task", TASKS)
def test_a_variant_puts_in_all_in_which_variants_differ(task: str) -> None:
    paper, released = (jaxsafe.make(task, variant=variant) for variant in ("paper", "released"))  # type: ignore[arg-type]
    assert dump(paper) == dump(jaxsafe.make(task))
    assert dump(adapt(paper, task, variant="released")) == dump(released)
    assert dump(adapt(released, task, variant="paper")) == dump(paper)


@pytest.mark.thorough
def test_a_filter_comes_from_a_file(tmp_path: Path) -> None:
    default = jaxsafe.make("docking2d", rta="default")
    (tmp_path / "filter.yaml").write_text(write(to_data(default.rta)))
    (tmp_path / "env.yaml").write_text(
        dump(jaxsafe.make("docking3d", {"deputy.mass": 20.0}, rta="default"))
    )
    for name in ("filter", "env"):
        found = jaxsafe.make("docking2d", rta=str(tmp_path / f"{name}.yaml"))
        assert dump(found) == dump(default)
    assert dump(
        jaxsafe.make("docking2d", {"rta.margin": 0.01}, rta=str(tmp_path / "filter.yaml"))
    ) == dump(jaxsafe.make("docking2d", {"rta.margin": 0.01}, rta="default"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"rta\.yaml"),
        ("", r"rta\.yaml: rta: expected a mapping"),
        ("[1, 2]", r"rta\.yaml: rta: expected a mapping"),
        ("margin: 0.1", r"rta\.yaml: rta: field 'type' is missing; choose from "),
        ("type: simplx", r"rta\.yaml: rta: unknown type 'simplx'.*Did you mean 'simplex'"),
        ("imports: 3\ntype: simplex", r"rta\.yaml: rta.imports: expected a list of modules"),
        (
            "imports: [no_such_module]\ntype: simplex",
            r"rta\.yaml: rta.imports: cannot import 'no_such_module'",
        ),
        ("ENV", r"rta: .*rta\.yaml is an environment without a filter"),
        ("platforms: 3", r"rta\.yaml: environment"),
        (
            "{type: simplex, constraints: [collision], backups: [{type: brake, name: b}]}",
            "collision",
        ),
        ("BROKEN", r"rta\.yaml: agent: nothing is called 'deputi'"),
    ],
)
def test_a_file_without_a_filter_is_told(text: str | None, message: str, tmp_path: Path) -> None:
    path = tmp_path / "rta.yaml"
    whole = dump(jaxsafe.make("docking2d"))
    texts = {"ENV": whole, "BROKEN": whole.replace("agent: deputy", "agent: deputi")}
    if text is not None:
        path.write_text(texts.get(text, text))
    with pytest.raises(ConfigError, match=message) as raised:
        jaxsafe.make("docking2d", rta=str(path))
    assert "\n" not in str(raised.value)


def test_a_section_of_thousands_of_parts_is_refused_at_once(tree: dict[str, Any]) -> None:
    tree["status"] += [
        {"type": "speed", "name": f"speed_{index}", "of": "deputy"} for index in range(1001)
    ]
    message = fault(lambda: compose(tree))
    assert message == "status: expected at most 1,000 parts, found 1,007"


def few_programs_are_compiled_to_make_a_task() -> None:
    compiled = []

    def note(event: str, *_: Any, **details: Any) -> None:
        if "backend_compile" in event:
            compiled.append(details)

    jax.monitoring.register_event_duration_secs_listener(note)
    for task in TASKS:
        jaxsafe.make(task)
    assert not compiled, compiled
    # What looks for faults of a filter is one program.
    jaxsafe.make("docking2d_oriented", rta="default")
    assert len(compiled) == 1, compiled


def test_few_programs_are_compiled_to_make_a_task() -> None:
    """Each small program takes some 15 ms, and a check of every number would be one."""
    check_as_compiled_by_commands(few_programs_are_compiled_to_make_a_task)
