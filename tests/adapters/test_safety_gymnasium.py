import csv
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from jaxsafe.adapters.safety_gymnasium import SafetyEnv

CUSTOM = Path(__file__).parents[2] / "configs" / "custom_env.yaml"

MOVING = {"deputy.start.velocity.share": [1.5, 1.6]}
"""Every start is too fast."""

FAST = {"start": {"deputy": {"position": [60.0, 0.0], "velocity": [-0.6, 0.0]}}}


def test_the_cost_stands_between_reward_and_end() -> None:
    env = SafetyEnv("docking2d")
    _, info = env.reset(seed=0, options=FAST)
    observation, reward, cost, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert observation.shape == (6,)
    assert (cost, info["cost"], terminated, truncated) == (1.0, 1.0, False, False)
    assert isinstance(reward, float)


@pytest.mark.thorough
def test_the_cost_in_a_batch_is_that_of_the_step_even_where_an_environment_starts_anew() -> None:
    ends = {"terminal.timeout.limit": 1.0, "reward.velocity_constraint.scale": -0.01}
    # Every start is too fast.
    env = SafetyEnv("docking2d", 8, {**ends, "deputy.start.velocity.share": [1.5, 1.6]})
    assert env.single_action_space.shape == (2,)
    assert env.single_observation_space.shape == (6,)
    env.reset(seed=0)
    zero = np.zeros((8, 2), np.float32)
    costs = []
    infos = []
    for _ in range(4):
        *_, cost, terminated, _, info = env.step(zero)
        costs.append(cost)
        infos.append((terminated, info))
    assert np.all(np.array(costs) == 1.0)
    terminated, info = infos[1]
    assert terminated.all()
    assert info["final_observation"].shape == (8, 6)
    assert info["_final_observation"].all()
    assert (info["cost"] == 0.0).all()  # the cost of the new start


@pytest.mark.parametrize("num_envs", [None, 2])
def test_an_action_that_is_no_number_costs_and_ends_the_episode(num_envs: int | None) -> None:
    env = SafetyEnv("docking2d", num_envs)
    env.reset(seed=0)
    _, _, cost, terminated, truncated, _ = env.step(
        np.full(env.action_space.shape, np.nan, np.float32)
    )
    assert np.all(cost == 1.0)
    assert np.all(terminated)
    assert not np.any(truncated)


@pytest.mark.peer
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_omnisafe_learns_to_dock_within_the_budget(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # Importing OmniSafe needs what the example puts in place first.
    if importlib.util.find_spec("omnisafe") is None:
        pytest.skip("needs omnisafe")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    monkeypatch.chdir(tmp_path)
    from omnisafe_docking2d import train  # pyright: ignore[reportMissingImports]

    train()
    [log] = tmp_path.glob("runs/*/*/progress.csv")
    rows = list(csv.DictReader(log.open(encoding="utf-8")))
    early = rows[3]
    late = rows[-1]
    assert float(late["Metrics/EpRet"]) > float(early["Metrics/EpRet"]) + 3.0
    assert float(late["Metrics/EpCost"]) <= 25.0


@pytest.mark.parametrize("num_envs", [None, 2])
def test_each_constraint_has_its_cost_by_name_in_each_step(num_envs: int | None) -> None:
    env = SafetyEnv(CUSTOM, num_envs, {"terminal.timeout.limit": 3.0, **MOVING})
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    names = {"velocity_limit", "keep_out_speed", "keep_out"}
    seen = []
    for _ in range(4):
        *_, cost, _, _, info = env.step(action)
        if "final_info" in info:  # the step belongs to the episode that ended
            assert info["_final_observation"].all()
            info = info["final_info"]
        costs = {name: value for name, value in info["costs"].items() if name[0] != "_"}
        assert {*costs} == names
        np.testing.assert_array_equal(cost, np.max([*costs.values()], axis=0))
        seen.append(np.mean(costs["velocity_limit"]))
    assert seen == [1.0] * 4
