from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_modes import CHECKED_WHILE_RUNNING, CHECKED_WHILE_TRACING

import jaxsafe
from jaxsafe import ConfigError

pytestmark = [pytest.mark.peer, pytest.mark.filterwarnings("default")]
SHORT = {"terminal.timeout.limit": 3.0}


@pytest.fixture
def brax() -> Any:
    from jaxsafe.adapters import brax

    return brax


def test_a_step_is_ours(brax: Any) -> None:
    env = brax.BraxEnv("docking2d", SHORT)
    core = jaxsafe.make("docking2d", SHORT)
    state = env.reset(jax.random.key(0))
    expected, _ = core.reset(jax.random.key(0))
    action = jnp.array([0.5, -0.5])
    for _ in range(4):
        state = env.step(state, action)
        expected, timestep = core.step(expected, action)
        np.testing.assert_allclose(state.obs, timestep.observation, rtol=1e-6)
        np.testing.assert_allclose(state.reward, timestep.reward, rtol=1e-6)
        assert state.metrics["cost"] == timestep.cost
        assert state.metrics["cost_velocity_limit"] == timestep.costs["velocity_limit"]
    assert float(state.done) == 1.0
    assert (env.observation_size, env.action_size) == (6, 2)


def test_episodes_start_anew_each_time(brax: Any) -> None:
    env = brax.wrap(brax.BraxEnv("docking2d", SHORT), episode_length=100)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
    starts = [state.obs]
    step = jax.jit(env.step)
    for _ in range(12):
        state = step(state, jnp.zeros((3, 2)))
        if state.done.all():
            starts.append(state.obs)
    assert len(starts) == 4
    assert len({float(x) for start in starts for x in start[:, 0]}) == 12
    assert state.info["steps"].tolist() == [4.0] * 3


def test_episodes_may_be_cut(brax: Any) -> None:
    env = brax.wrap(brax.BraxEnv("docking2d"), episode_length=2)
    state = env.reset(jax.random.split(jax.random.PRNGKey(0), 2))
    for _ in range(2):
        state = env.step(state, jnp.zeros((2, 2)))
    assert state.done.tolist() == state.info["truncation"].tolist() == [1.0, 1.0]


FACTS = (
    "cost",
    "success",
    "reward_success",
    "reward_failure",
    "reward_distance_change",
    "sum_reward",
    "length",
)


def flown(
    brax: Any, action_repeat: int, start: Any, episode_length: int = 1000
) -> tuple[Any, dict[str, float]]:
    """Return the last state of an episode that drifts from a start, and two sums over the episode.

    One sum is by Brax's count, the other by ours.
    """
    env = brax.wrap(brax.BraxEnv("docking2d"), episode_length, action_repeat)
    state = env.reset(jax.random.split(jax.random.PRNGKey(0), 1))
    first, timestep = jaxsafe.reset_to(env.unwrapped.env, {"deputy": start})
    state = state.replace(
        pipeline_state=jax.tree.map(lambda x: x[None], first),
        obs=timestep.observation[None],
    )
    step = jax.jit(env.step)
    reward = cost = 0.0
    for _ in range(20):
        state = step(state, jnp.zeros((1, 2)))
        reward += float(state.reward[0])
        cost += float(state.metrics["cost"][0])
        if state.done.all():
            break
    facts = {name: float(state.info["episode_metrics"][name][0]) for name in FACTS}
    assert (facts["sum_reward"], facts["cost"], facts["length"]) == (
        pytest.approx(reward),
        cost,
        float(state.info["steps"][0]),
    )
    return state, facts


@pytest.mark.parametrize("action_repeat", [2, 4])
@pytest.mark.parametrize(
    ("start", "episode_length", "reward", "cost", "steps"),
    [
        pytest.param(
            {"position": [0.7, 0.0], "velocity": [-0.1, 0.0]}, 1000, 2.0, 0.0, 3.0, id="docked"
        ),
        pytest.param(
            {"position": [3.1, 0.0], "velocity": [-0.6, 0.0]}, 1000, -1.0, 5.0, 5.0, id="crashed"
        ),
        pytest.param(
            {"position": [80.0, 0.0], "velocity": [-0.6, 0.0]}, 3, 0.0, 3.0, 3.0, id="cut"
        ),
    ],
)
def test_nothing_counts_after_an_episode_ends_inside_a_repeated_action(
    brax: Any,
    action_repeat: int,
    start: Any,
    episode_length: int,
    reward: float,
    cost: float,
    steps: float,
) -> None:
    state, facts = flown(brax, action_repeat, start, episode_length)
    once, expected = flown(brax, 1, start, episode_length)
    assert facts == pytest.approx(expected, abs=1e-6)
    assert (facts["sum_reward"], facts["cost"], facts["length"]) == (
        pytest.approx(reward, abs=0.1),
        cost,
        steps,
    )
    assert state.done.tolist() == once.done.tolist() == [1.0]
    assert (
        state.info["truncation"].tolist()
        == once.info["truncation"].tolist()
        == [float(episode_length == 3)]
    )


@pytest.mark.parametrize("action_repeat", [1, 3])
def test_an_action_that_is_no_number_is_a_failure_that_costs(brax: Any, action_repeat: int) -> None:
    env = brax.wrap(brax.BraxEnv("docking2d"), action_repeat=action_repeat)
    state = env.reset(jax.random.split(jax.random.PRNGKey(0), 2))
    state = env.step(state, jnp.array([[0.0, 0.0], [jnp.nan, 0.0]]))
    assert state.done.tolist() == [0.0, 1.0]
    assert (float(state.metrics["cost"][1]), float(state.metrics["success"][1])) == (1.0, 0.0)
    assert np.isfinite(state.obs).all()


def test_a_return_has_a_gradient(brax: Any) -> None:
    env = brax.BraxEnv("docking2d")
    start = env.reset(jax.random.key(0))

    def total(action: jax.Array) -> jax.Array:
        return jax.lax.scan(
            lambda s, _: ((n := env.step(s, action)), n.reward), start, None, length=20
        )[1].sum()

    gradient = jax.grad(total)(jnp.array([0.1, 0.1]))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).min() > 0.0


def test_the_time_of_a_step_is_that_between_two_actions(brax: Any) -> None:
    assert brax.BraxEnv("docking2d", {"dt": 0.5, "decision_period": 4}).dt == 2.0


def test_mistakes_are_named(brax: Any) -> None:
    with pytest.raises(ConfigError, match="actions: Brax's agents need continuous actions"):
        brax.BraxEnv("docking2d", actions="discrete")
    physical = {"wingman.controller.actuators.acceleration.rescale": False}
    with pytest.raises(
        ConfigError,
        match=r"actuator acceleration: Brax's agents act in \[-1, 1\], found \[-96.5, 96.5\]",
    ):
        brax.BraxEnv("rejoin2d", physical)
    tanh = {"deputy.controller.actuators.thrust_x.post_activation": "tanh"}
    with pytest.raises(
        ConfigError, match=r"found \[-inf, inf\]; leave rescale on and post_activation: clip"
    ):
        brax.BraxEnv("docking2d", tanh)
    with pytest.raises(ConfigError, match="action_repeat: expected a whole number ≥ 1, found 0"):
        brax.wrap(brax.BraxEnv("docking2d"), action_repeat=0)
    with pytest.raises(ConfigError, match="randomization_fn: give BraxEnv randomize="):
        brax.wrap(brax.BraxEnv("docking2d"), randomization_fn=lambda: None)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "sac", "apg"])
def test_braxs_own_trainers_run(algorithm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("brax")
    monkeypatch.syspath_prepend("examples")
    import brax_docking2d

    assert brax_docking2d.train(algorithm)["eval/episode_reward"] > -2.0


MODES = CHECKED_WHILE_TRACING | CHECKED_WHILE_RUNNING | {"disable_jit": jax.disable_jit}


@pytest.mark.parametrize("mode", MODES)
def test_it_works_in_every_mode_of_jax(brax: Any, mode: str) -> None:
    with MODES[mode]():
        env = brax.BraxEnv("docking2d", SHORT)
        if mode == "dtype_promotion":  # Brax's own wrapper compares numbers of two types
            state = jax.jit(env.reset)(jax.random.key(0))
            action = np.zeros(2, np.float32)
        else:
            env = brax.wrap(env, episode_length=3, action_repeat=2)
            state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 3))
            action = np.zeros((3, 2), np.float32)
        step = jax.jit(env.step)
        for _ in range(3):
            state = step(state, action)
        assert np.isfinite(state.obs).all()
