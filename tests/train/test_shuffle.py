import jax
import numpy as np
import pytest
import scipy.stats

from jaxsafe.train.shuffle import shuffle


@pytest.mark.parametrize("size", [1, 2, 3, 10, 97, 2048, 10_007])
def test_every_number_comes_once(size: int) -> None:
    np.testing.assert_array_equal(np.sort(shuffle(jax.random.key(size), size)), np.arange(size))


def orders(size: int, count: int) -> np.ndarray:
    keys = jax.random.split(jax.random.key(0), count)
    return np.asarray(jax.jit(jax.vmap(lambda key: shuffle(key, size)))(keys))


def test_every_order_of_a_few_is_equally_likely() -> None:
    drawn = orders(4, 24_000) @ np.array([64, 16, 4, 1])
    _, counts = np.unique(drawn, return_counts=True)
    assert len(counts) == 24
    assert scipy.stats.chisquare(counts).pvalue > 0.001


def test_every_number_is_equally_likely_in_every_place() -> None:
    drawn = orders(16, 16_000)
    counts = np.stack([np.bincount(drawn[:, place], minlength=16) for place in range(16)])
    # Rows and columns of the table both have fixed sums, so it has 15 × 15 degrees of freedom.
    assert scipy.stats.chi2.sf(((counts - 1000) ** 2 / 1000).sum(), 15 * 15) > 0.001


def test_neighbours_are_independent_in_a_batch_of_the_usual_size() -> None:
    drawn = orders(2048, 50).astype(float)
    centred = (drawn - 1023.5) / 591.2
    # A correlation of −1/2047 is expected, with a deviation of 1/√2048 for each of the 50 orders.
    correlation = (centred[:, 1:] * centred[:, :-1]).mean(axis=1)
    assert abs(correlation.mean()) < 4 / np.sqrt(2048 * 50)
    # A minibatch is half of all samples, drawn without replacement.
    minibatch = centred[:, :1024].mean(axis=1) * np.sqrt(1024) * np.sqrt(2)
    assert scipy.stats.kstest(minibatch, "norm").pvalue > 0.001


def test_minibatches_split_close_pairs_as_often_as_chance_does() -> None:
    drawn = orders(2048, 200)
    place = np.argsort(drawn, axis=1)
    # Count the pairs 2k and 2k + 1 that are in the same half.
    together = ((place[:, 0::2] < 1024) == (place[:, 1::2] < 1024)).sum(axis=1)
    assert together.mean() == pytest.approx(1024 * 1023 / 2047, abs=4 * 16 / np.sqrt(200))
    assert together.std() == pytest.approx(16, rel=0.25)
