import numpy as np

from jaxsafe.adapters.safety_gymnasium import SafetyEnv

FAST = {"start": {"deputy": {"position": [60.0, 0.0], "velocity": [-0.6, 0.0]}}}


def test_the_cost_stands_between_reward_and_end() -> None:
    env = SafetyEnv("docking2d")
    _, info = env.reset(seed=0, options=FAST)
    observation, reward, cost, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert observation.shape == (6,)
    assert (cost, info["cost"], terminated, truncated) == (1.0, 1.0, False, False)
    assert isinstance(reward, float)


def test_the_cost_of_a_lane_is_that_of_the_step_even_where_it_starts_anew() -> None:
    ends = {"terminal.timeout.limit": 1.0, "reward.velocity_constraint.scale": -0.01}
    env = SafetyEnv("docking2d", 8, {**ends, "deputy.start.velocity.share": [1.5, 1.6]})  # every start is too fast
    assert env.single_action_space.shape == (2,)
    assert env.single_observation_space.shape == (6,)
    env.reset(seed=0)
    zero = np.zeros((8, 2), np.float32)
    costs, infos = [], []
    for _ in range(4):
        *_, cost, terminated, _, info = env.step(zero)
        costs.append(cost)
        infos.append((terminated, info))
    assert np.all(np.array(costs) == 1.0)
    terminated, info = infos[1]
    assert terminated.all()
    assert info["final_observation"].shape == (8, 6)
    assert info["_final_observation"].all()
    assert (info["cost"] == 0.0).all()  # of the new start
