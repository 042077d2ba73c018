from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsafe.where_needed import MIN_PER_ROUND, where_needed

SIZES = [1, MIN_PER_ROUND, MIN_PER_ROUND + 1, 300]


def cubes(scale: Any, element: Any) -> Any:
    x, y = element
    return {"cube": scale * x**3, "sum": jnp.stack([x, y]).sum()}


def some(size: int, share: float) -> tuple[jax.Array, jax.Array, jax.Array]:
    key_x, key_needed = jax.random.split(jax.random.key(size))
    x, y = jax.random.normal(key_x, (2, size, 2))
    return jax.random.uniform(key_needed, (size, 2)) < share, x, y


def expected(scale: Any, needed: jax.Array, x: jax.Array, y: jax.Array) -> Any:
    scale = jnp.broadcast_to(jnp.asarray(scale), x.shape[:1])[:, None]
    return {"cube": jnp.where(needed, scale * x**3, 0.0), "sum": jnp.where(needed, x + y, 0.0)}


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("size", SIZES)
def test_a_batch_has_the_results_that_are_needed(size: int, share: float) -> None:
    needed, x, y = some(size, share)

    @jax.jit
    def run(needed: Any, x: Any, y: Any) -> Any:
        return jax.vmap(lambda *given: where_needed(given[0], cubes, 2.0, given[1:]))(needed, x, y)

    jax.tree.map(np.testing.assert_array_equal, run(needed, x, y), expected(2.0, needed, x, y))


def test_one_member_of_a_batch_alone() -> None:
    needed, x, y = (leaf[0] for leaf in some(1, 0.5))
    result = where_needed(needed, cubes, 2.0, (x, y))
    wanted = expected(2.0, needed[None], x[None], y[None])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[0]), result, wanted)


def test_what_is_shared_may_differ_between_members() -> None:
    needed, x, y = some(100, 0.3)
    scale = jnp.arange(100.0)
    run = jax.vmap(lambda scale, *given: where_needed(given[0], cubes, scale, given[1:]))
    jax.tree.map(
        np.testing.assert_array_equal, run(scale, needed, x, y), expected(scale, needed, x, y)
    )


def test_batches_of_batches_on_any_axis() -> None:
    needed, x, y = some(120, 0.3)
    inner = jax.vmap(lambda *given: where_needed(given[0], cubes, 2.0, given[1:]), in_axes=-1)
    stacked = [jnp.moveaxis(leaf.reshape(3, 40, 2), 1, -1) for leaf in (needed, x, y)]
    result = jax.tree.map(lambda leaf: leaf.reshape(120, 2), jax.vmap(inner)(*stacked))
    jax.tree.map(np.testing.assert_array_equal, result, expected(2.0, needed, x, y))


def test_derivatives_do_not_pass() -> None:
    needed, x, y = some(40, 0.5)

    def total(x: jax.Array, y: jax.Array) -> jax.Array:
        found = jax.vmap(lambda *given: where_needed(given[0], cubes, 2.0, given[1:]))(needed, x, y)
        return jnp.sum(found["cube"]) + jnp.sum(x * y)

    for value, other in zip(jax.grad(total, (0, 1))(x, y), (y, x), strict=True):
        np.testing.assert_array_equal(value, other)
