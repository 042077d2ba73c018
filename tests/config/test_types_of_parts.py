"""A part gets another type by an override of `type`, and keeps what both types have."""

import itertools
import re
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import jaxsafe
from jaxsafe.config.override import override
from jaxsafe.schema.component import choices, fields
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation import Platform


def test_one_word_climbs_the_ladder() -> None:
    env = jaxsafe.make("docking3d", {"deputy.mass": 14.0})
    for kind in ("double_integrator", "two_body", "two_body_j2", "spacecraft"):
        env = override(env, {"deputy.type": kind})
        deputy = env.agent_platform
        assert deputy.type_name == kind
        assert deputy.mass == 14.0
        assert [initializer.name for initializer in deputy.start] == ["position", "velocity"]
        assert env.action_names == ("thrust_x", "thrust_y", "thrust_z")
        state, _ = env.reset(jax.random.key(0))
        jax.eval_shape(jaxsafe.step, env, state, jnp.zeros(3))


@pytest.mark.parametrize(
    ("task", "path", "kind"),
    [
        ("docking2d_oriented", "deputy.type", "reaction_wheel_spacecraft"),
        ("rejoin2d", "wingman.type", "dubins2d_lag"),
        ("rejoin3d", "wingman.type", "dubins3d_lag"),
        ("rejoin3d", "wingman.type", "point_mass_aircraft"),
    ],
)
def test_the_actuators_of_a_task_drive_the_other_models_of_its_domain(
    task: str, path: str, kind: str
) -> None:
    before = jaxsafe.make(task)
    env = override(before, {path: kind})
    assert env.agent_platform.type_name == kind
    assert env.action_names == before.action_names
    assert env.observation_names == before.observation_names


def test_a_type_comes_first_whatever_the_order_of_the_changes() -> None:
    changes = {
        "deputy.eccentricity": 0.3,
        "deputy.type": "two_body",
        "deputy.mass": 9.0,
        "platforms.deputy.substeps": 3,
        "deputy.controller.actuators.thrust_x.low": -0.5,
    }
    orders = [dict(order) for order in itertools.permutations(changes.items())]
    expected = jaxsafe.make("docking2d", orders[0])
    assert expected.agent_platform.eccentricity == jnp.float32(0.3)
    assert expected.agent_platform.substeps == 3
    for order in orders[:: len(orders) // 6]:
        assert jaxsafe.make("docking2d", order) == expected


def test_sub_parts_and_filters_change_their_type_too() -> None:
    env = jaxsafe.make("docking2d", {"deputy.controller.type": "discrete"})
    assert env.num_action_points == (11, 11)
    env = jaxsafe.make("docking2d", {"rta.type": "simplex"}, rta="default")
    assert env.rta is not None
    assert env.rta.type_name == "simplex"
    assert env.rta.constraints == ("velocity_limit",)
    changes = {
        "deputy.start.velocity.type": "uniform",
        "deputy.start.velocity.low": [-0.1, -0.1],
        "deputy.start.velocity.high": "0.1, 0.1",
    }
    velocity = jaxsafe.make("docking2d", changes).agent_platform.start[1]
    assert velocity.type_name == "uniform"
    assert velocity.high.tolist() == pytest.approx([0.1, 0.1])


def test_a_whole_part_that_is_given_comes_before_its_type() -> None:
    straight = {"type": "scripted", "commands": []}
    env = jaxsafe.make(
        "rejoin2d", {"lead.controller.type": "uncontrolled", "lead.controller": straight}
    )
    assert env.platform("lead").controller.type_name == "uncontrolled"


def test_a_part_that_is_not_there_is_made_of_the_given_fields() -> None:
    changes = {"regions.docking_region.offset.type": "aspect"}
    with pytest.raises(ConfigError, match=r"offset \(aspect\): field 'distance' is missing"):
        jaxsafe.make("docking2d", changes)
    more = {f"regions.docking_region.offset.{name}": 1.0 for name in ("distance", "angle")}
    offset = jaxsafe.make("docking2d", {**changes, **more}).regions[0].offset
    assert offset is not None
    assert offset.type_name == "aspect"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"deputy.type": "two_bodies"},
            "deputy: unknown type 'two_bodies'. Did you mean 'two_body'?",
        ),
        (
            {"deputy.type": "two_body_j2"},
            "deputy.dimension: expected a whole number in [3, 3], found 2",
        ),
        (
            {"deputy.type": "reaction_wheel_spacecraft"},
            "platforms.deputy.controller.actuators: reaction_wheel_spacecraft has no control"
            " 'thrust_x'. Did you mean 'thrust'? Choose from thrust, wheel_acceleration",
        ),
        (
            {"deputy.type": "spacecraft", "deputy.eccentricity": 0.1},
            "deputy.eccentricity: unknown field 'eccentricity'",
        ),
        ({"agent.type": "two_body"}, "agent.type: agent has no fields"),
        ({"deputy.kind.type": "two_body"}, "deputy.kind: unknown field 'kind'"),
        (
            {"reward.delta_v.type": "success"},
            "reward.delta_v (success): field 'outcome' is missing; it takes a name",
        ),
    ],
)
def test_a_mistake_is_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        jaxsafe.make("docking2d", changes)
    assert "\n" not in str(caught.value)


def test_a_command_line_changes_types(capsys: pytest.CaptureFixture[str]) -> None:
    from jaxsafe.commands.config import main

    words = ["docking3d", "env.deputy.type=two_body", "env.deputy.eccentricity=0.2"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "type: two_body\n" in text
    assert "eccentricity: 0.2\n" in text
    assert jaxsafe.load(text) == jaxsafe.make(
        "docking3d", {"deputy.type": "two_body", "deputy.eccentricity": 0.2}
    )


def test_no_part_has_a_field_called_type() -> None:
    assert all("type" not in fields(kind) for kind in choices(Platform).values())
