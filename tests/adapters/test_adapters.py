import importlib
import math
import sys

import pytest

from jaxsafe.adapters import observation_bounds
from jaxsafe.environment import action_bounds
from jaxsafe.envs import make
from jaxsafe.schema.errors import missing


@pytest.mark.parametrize(
    ("module", "blocked", "extra"),
    [
        ("jaxsafe.adapters.brax", "brax.envs.base", "brax"),
        ("jaxsafe.adapters.gymnax", "gymnax.environments", "gymnax"),
        ("jaxsafe.adapters.stable_baselines3", "stable_baselines3.common.vec_env", "sb3"),
        ("jaxsafe.export.onnx", "onnx", "export"),
    ],
)
def test_a_missing_package_names_its_extra(
    module: str, blocked: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, blocked, None)
    monkeypatch.delitem(sys.modules, module, raising=False)
    package = blocked.partition(".")[0]
    with pytest.raises(ImportError) as raised:
        importlib.import_module(module)
    assert (
        str(raised.value)
        == f"{package} is not installed; in a clone of jaxsafe: pip install '.[{extra}]'"
    )


def test_a_broken_package_says_what_is_wrong_with_it() -> None:
    broken = ModuleNotFoundError("No module named 'flax'", name="flax")
    assert missing(broken, "brax", "brax") is broken
    assert str(missing(ModuleNotFoundError(name="brax.envs"), "brax", "brax")) == (
        "brax is not installed; in a clone of jaxsafe: pip install '.[brax]'"
    )


def test_observations_are_bounded_where_they_are_clipped() -> None:
    env = make("docking2d", {"observation.speed.clip": [-1.0, 2.0]})
    low, high = observation_bounds(env)
    assert len(low) == len(high) == env.observation_size
    at = env.observation_names.index("speed")
    assert (low[at], high[at]) == (-1.0, 2.0)
    assert set(low[:at]) == {-float("inf")}


THRUST_X = "deputy.controller.actuators.thrust_x"
PHYSICAL = {f"{THRUST_X}.rescale": False, f"{THRUST_X}.low": -3.0, f"{THRUST_X}.high": 0.5}


def test_actions_are_bounded_by_the_actuators_that_do_not_rescale() -> None:
    assert action_bounds(make("docking2d")) == ([-1.0, -1.0], [1.0, 1.0])
    assert action_bounds(make("docking2d", PHYSICAL)) == ([-3.0, -1.0], [0.5, 1.0])
    drawn = make(
        "docking2d",
        PHYSICAL,
        randomize={f"{THRUST_X}.low": [-4.0, -2.0], f"{THRUST_X}.high": [0.25, 2.0]},
    )
    assert action_bounds(drawn) == ([-4.0, -1.0], [2.0, 1.0])


def test_an_action_without_bounds_and_an_index_have_bounds_of_their_own() -> None:
    thrust_y = "deputy.controller.actuators.thrust_y"
    env = make("docking2d", {f"{THRUST_X}.post_activation": "tanh"})
    assert action_bounds(env) == ([-math.inf, -1.0], [math.inf, 1.0])
    mixed = make("docking2d", {**PHYSICAL, f"{thrust_y}.discrete": True}, actions="mixed")
    assert action_bounds(mixed) == ([-3.0, 0.0], [0.5, 10.0])
