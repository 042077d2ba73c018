"""Work for a few members of a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.sparse import MEMBERS_PER_ROUND, only_where

KEY = jax.random.key(0)


def costly(scale: jax.Array, x: dict[str, jax.Array]) -> dict[str, jax.Array]:
    return {"y": scale * x["a"] + x["b"], "n": x["n"] + 1}


def arguments(size: int) -> dict[str, jax.Array]:
    a, b = jax.random.normal(KEY, (2, size, 3))
    return {"a": a, "b": b, "n": jnp.arange(size)}


def one(needed: jax.Array, x: dict[str, jax.Array]) -> dict[str, jax.Array]:
    otherwise = {"y": jnp.full(3, -1.0), "n": x["n"]}
    return only_where(needed, costly, (jnp.float32(2.0), x), otherwise)


@pytest.mark.parametrize("size", [1, 5, MEMBERS_PER_ROUND, 3 * MEMBERS_PER_ROUND + 1, 300])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_those_that_need_it_get_the_result_and_no_others(size: int, share: float) -> None:
    needed = jax.random.uniform(KEY, (size,)) < share
    x = arguments(size)
    found = jax.jit(jax.vmap(one))(needed, x)
    np.testing.assert_array_equal(
        found["y"], jnp.where(needed[:, None], 2.0 * x["a"] + x["b"], -1.0)
    )
    np.testing.assert_array_equal(found["n"], x["n"] + needed)


def test_one_alone_branches() -> None:
    x = jax.tree.map(lambda leaf: leaf[0], arguments(2))
    for needed in (True, False):
        found = jax.jit(one)(jnp.asarray(needed), x)
        assert int(found["n"]) == int(needed)


def test_batches_of_batches() -> None:
    needed = jax.random.bernoulli(KEY, 0.3, (4, 11))
    x = jax.tree.map(lambda leaf: leaf.reshape(4, 11, *leaf.shape[1:]), arguments(44))
    found = jax.vmap(jax.vmap(one))(needed, x)
    np.testing.assert_array_equal(found["n"], x["n"] + needed)


def test_derivatives_are_zero_both_ways() -> None:
    x = arguments(12)
    needed = jnp.arange(12) % 3 == 0

    def total(a: jax.Array) -> jax.Array:
        return jnp.sum(a) + jnp.sum(jax.vmap(one)(needed, {**x, "a": a})["y"])

    np.testing.assert_array_equal(jax.grad(total)(x["a"]), jnp.ones((12, 3)))
    _, tangent = jax.jvp(total, (x["a"],), (jnp.ones((12, 3)),))
    assert float(tangent) == 36.0
