import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.metrics import Episode, begin
from jaxsafe.rollout import reset_batch
from jaxsafe.train.recent_episodes import SIZE, empty_window, latest_cost, means, push, total_cost

ENV = jaxsafe.make("docking2d")


def episodes_like(values: np.ndarray) -> Episode:
    zero = begin(reset_batch(ENV, jax.random.key(0), 1)[1])
    shaped = jax.tree.map(lambda x: jnp.zeros(values.shape, x.dtype), zero)
    return shaped.replace(
        episode_return=jnp.asarray(values),
        length=jnp.full(values.shape, 7),
        outcome=jnp.ones(values.shape, int),
    )


@pytest.mark.thorough
def test_the_window_keeps_the_last_hundred_finished_episodes_in_order() -> None:
    rng = np.random.default_rng(0)
    window = empty_window(episodes_like(np.zeros(1, np.float32)))
    finished: list[float] = []
    for _ in range(8):
        values = rng.normal(size=(30, 4)).astype(np.float32)
        done = rng.random((30, 4)) < 0.2
        window = jax.jit(push)(window, episodes_like(values), jnp.asarray(done))
        finished += values[done].tolist()
        kept = np.sort(np.asarray(window.episodes.episode_return)[: min(len(finished), SIZE)])
        np.testing.assert_array_equal(kept, np.sort(np.float32(finished[-SIZE:])))
    assert int(window.count) == len(finished) > SIZE


@pytest.mark.thorough
def test_the_cost_counts_the_violating_steps_of_all_finished_episodes() -> None:
    episodes = episodes_like(np.zeros((150, 2), np.float32))
    episodes = episodes.replace(violating_steps=jnp.arange(300).reshape(150, 2))
    done = jnp.asarray(np.arange(300).reshape(150, 2) % 3 == 0)
    window = push(push(empty_window(episodes), episodes, done), episodes, done)
    assert int(window.cost) == 2 * sum(range(0, 300, 3))


@pytest.mark.thorough
def test_the_cost_of_the_training_counts_every_violating_step_once() -> None:
    rng = np.random.default_rng(2)
    window = empty_window(episodes_like(np.zeros(1, np.float32)))
    counted = 0
    before = np.zeros(3, int)
    for _ in range(20):
        violated = rng.random((5, 3)) < 0.5
        done = rng.random((5, 3)) < 0.2
        rows = []
        for step in range(5):
            rows.append(before + violated[step])
            before = np.where(done[step], 0, rows[-1])
        episodes = episodes_like(np.zeros((5, 3), np.float32)).replace(
            violating_steps=jnp.asarray(np.stack(rows))
        )
        window = jax.jit(push)(window, episodes, jnp.asarray(done))
        counted += violated.sum()
        assert int(total_cost(window)) == counted


@pytest.mark.thorough
def test_a_batch_with_more_episodes_than_the_window_leaves_its_last_ones() -> None:
    values = np.arange(300, dtype=np.float32).reshape(100, 3)
    window = push(
        empty_window(episodes_like(values)), episodes_like(values), jnp.ones((100, 3), bool)
    )
    np.testing.assert_array_equal(np.sort(window.episodes.episode_return), np.arange(200, 300))


def test_averages_are_over_the_filled_part_only() -> None:
    values = np.array([[1.0, 3.0, 9.0]], np.float32)
    window = push(
        empty_window(episodes_like(values)), episodes_like(values), jnp.array([[True, True, False]])
    )
    row = means(window, ENV.outcomes, ENV.successes)
    assert float(row["return"]) == 2.0
    assert float(row["length"]) == 7.0
    assert float(row["success_rate"]) == float(row["outcome/success"]) == 1.0
    assert float(row["outcome/crash"]) == 0.0
    for successes, rate in (((), 0.0), (("crash",), 0.0), (("crash", "success"), 1.0)):
        assert float(means(window, ENV.outcomes, successes)["success_rate"]) == rate


def test_a_share_of_steps_is_the_mean_of_the_shares_of_the_episodes() -> None:
    """Episodes count alike here, however long they are. Of all 100 steps 20 % violate."""
    episodes = episodes_like(np.zeros((1, 2), np.float32)).replace(
        length=jnp.array([[10, 90]]),
        violating_steps=jnp.array([[5, 15]]),
        interventions=jnp.array([[1, 45]]),
        control_effort=jnp.array([[2.5, 9.0]]),
    )
    window = push(empty_window(episodes), episodes, jnp.ones((1, 2), bool))
    row = means(window, ENV.outcomes, ENV.successes)
    assert float(row["violating_share"]) == pytest.approx((5 / 10 + 15 / 90) / 2)
    assert float(row["intervention_share"]) == pytest.approx((1 / 10 + 45 / 90) / 2)
    assert float(row["control_effort"]) == pytest.approx((2.5 / 10 + 9.0 / 90) / 2)


@pytest.mark.thorough
def test_the_latest_cost_is_that_of_the_last_episodes() -> None:
    rng = np.random.default_rng(1)
    window = empty_window(episodes_like(np.zeros(1, np.float32)))
    assert float(latest_cost(window, window.episodes.violating_steps)) == 0.0
    finished: list[int] = []
    for _ in range(60):
        costs = rng.integers(0, 50, (4, 2))
        done = rng.random((4, 2)) < 0.5
        episodes = episodes_like(np.zeros((4, 2), np.float32)).replace(
            violating_steps=jnp.asarray(costs, jnp.int32)
        )
        window = jax.jit(push)(window, episodes, jnp.asarray(done))
        finished += costs[done].tolist()
        assert float(latest_cost(window, window.episodes.violating_steps)) == pytest.approx(
            np.mean(finished[-25:])
        )
    assert len(finished) > 2 * SIZE
