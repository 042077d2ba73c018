"""Some environments of a batch get new starts.

Each start is the one of a draw for every environment, however many need one.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind, thorough

import jaxsafe
from jaxsafe.autoreset import MIN_RESETS_PER_ROUND, RESETS_PER_ROUND, SPARSE_RESETS_FROM, renew
from jaxsafe.rollout import reset_batch, step_or_reset_batch

SIZES = (24, SPARSE_RESETS_FROM, 1000, 1031)  # few, many, no power of two, a prime


@pytest.mark.parametrize("axis", [0, -1])
@pytest.mark.parametrize("size", one_of_each_kind(SIZES, [24, 1031]))
def test_environments_are_renewed_alike_however_many_they_are(
    size: int, axis: Literal[0, -1]
) -> None:
    def turned(x: jax.Array) -> jax.Array:
        return jnp.moveaxis(x, 0, axis)

    def draw(offset: jax.Array, indices: jax.Array) -> dict[str, jax.Array]:
        return {
            "a": turned(offset + indices[:, None] + jnp.zeros((len(indices), 3))),
            "b": -indices,
        }

    old = {"a": turned(jnp.zeros((size, 3))), "b": jnp.arange(size)}
    indices = np.arange(size)
    program = jax.jit(renew, static_argnums=(1, 4))
    order = np.random.default_rng(0).permutation(size)
    chunk = max(MIN_RESETS_PER_ROUND, int(size * RESETS_PER_ROUND))
    for chosen in (
        order[:0],
        order[:1],
        order[:chunk],
        order[: chunk + 1],
        indices[-chunk:],
        indices,
    ):
        where = np.isin(indices, chosen)
        computed = program(jnp.asarray(where), draw, jnp.ones(()), old, axis)
        np.testing.assert_array_equal(
            jnp.moveaxis(computed["a"], axis, 0),
            np.where(where, 1.0 + indices, 0.0)[:, None] * np.ones(3),
        )
        np.testing.assert_array_equal(computed["b"], np.where(where, -indices, indices))


@pytest.mark.thorough
@pytest.mark.parametrize("num_envs", [thorough(16), SPARSE_RESETS_FROM])
def test_gradients_reach_the_starts_of_batches_of_any_size(num_envs: int) -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 1.0})
    state, _ = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(0), num_envs)
    state = state.replace(num_steps=jnp.arange(num_envs) % 2)

    def total(least: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        wide = jaxsafe.override(
            env, {"deputy.start.position.distance": jnp.stack([least, jnp.float32(150.0)])}
        )
        (after, _), timestep = step_or_reset_batch(
            wide, state, jnp.zeros((num_envs, 2)), jax.random.key(1)
        )
        distances = jnp.linalg.norm(after.sim.platforms["deputy"].position, axis=-1)
        return jnp.sum(distances, where=timestep.done), (distances, timestep.done)

    for derivative in (jax.grad, jax.jacfwd):
        slope, (distances, done) = jax.jit(derivative(total, has_aux=True))(jnp.float32(100.0))
        distances = distances[done]
        assert len(distances) == num_envs // 2
        # The derivative follows from d = low + (high − low) u.
        np.testing.assert_allclose(slope, np.sum((150.0 - distances) / 50.0), rtol=1e-4)
