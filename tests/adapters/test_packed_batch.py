import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.adapters.packed_batch import Episodes, PackedBatch, packing


def test_packing_loses_no_bit() -> None:
    tree = {
        "flag": jnp.array([True, False]),
        "count": jnp.array([-7, 2**31 - 1]),
        "point": jnp.array([[1.1, jnp.nan, -0.0], [jnp.inf, 1e-42, 3.3]]),
        "matrix": jnp.arange(12.0).reshape(2, 3, 2),
    }
    layout = packing(tree, num_batch_axes=1)
    words = jax.jit(layout.pack)(tree)
    assert words.shape == (1 + 1 + 3 + 6, 2)
    for unpacked in (layout.receive(words), jax.jit(layout.unpack)(words)):
        for ours, expected in zip(jax.tree.leaves(unpacked), jax.tree.leaves(tree), strict=True):
            assert (ours.shape, ours.dtype) == (expected.shape, expected.dtype)
            assert np.asarray(ours).tobytes() == np.asarray(expected).tobytes()


def test_environments_of_one_structure_share_a_layout() -> None:
    env = jaxsafe.make("docking2d")
    other = jaxsafe.make("docking2d", {"deputy.mass": 11.0})
    assert packing(env) is packing(other)
    assert packing(env) is not packing(jaxsafe.make("docking2d", rta="explicit_simplex"))


@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_a_batch_does_what_the_pure_functions_do(actions: str) -> None:
    env = jaxsafe.make("docking2d", actions=actions)
    batch = PackedBatch(env, 3, np.inf)
    seeds = [4, 5, 6]
    batch.seed(np.ones(3, bool), seeds)
    batch.restart(np.ones(3, bool))
    action = (
        np.array([[0, 10], [3, 3], [7, 1]], np.int32)
        if actions == "discrete"
        else np.eye(3, 2, dtype=np.float32)
    )
    keys = [jax.random.split(jax.random.key(seed)) for seed in seeds]
    expected = [Episodes(*env.reset(now)) for _, now in keys]
    for _ in range(3):
        batch.step(action)
        expected = [
            Episodes(*env.step(member.state, a)) for member, a in zip(expected, action, strict=True)
        ]
    batch.restart(np.array([False, True, False]))
    expected[1] = Episodes(*env.reset(jax.random.split(keys[1][0])[1]))
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *expected)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), batch.now, stacked
    )
