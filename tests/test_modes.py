"""Everything works in the modes that JAX offers.

These are modes for debugging, for other random numbers and for double precision.
"""

import contextlib
import gc
import itertools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind

import jaxsafe
from jaxsafe.envs import TASKS
from jaxsafe.evaluate.episodes import run_episodes
from jaxsafe.train.host.options import resolve
from jaxsafe.train.train import begin, chunk

Mode = Callable[[], AbstractContextManager]


@contextlib.contextmanager
def checking_leaks() -> Iterator[None]:
    """Check for leaked tracers.

    JAX collects garbage after each trace. The objects that exist already are left out of that, or
    it would take minutes after many other tests.
    """
    gc.freeze()
    try:
        with jax.checking_leaks():
            yield
    finally:
        gc.unfreeze()


CHECKED_WHILE_TRACING: dict[str, Mode] = {
    "x64": lambda: jax.enable_x64(True),
    "rank_promotion": lambda: jax.numpy_rank_promotion("raise"),
    "dtype_promotion": lambda: jax.numpy_dtype_promotion("strict"),
}
CHECKED_WHILE_RUNNING: dict[str, Mode] = {
    "rbg": lambda: jax.default_prng_impl("rbg"),
    "unsafe_rbg": lambda: jax.default_prng_impl("unsafe_rbg"),
    "key_reuse": lambda: jax.debug_key_reuse(True),
    "nans": lambda: jax.debug_nans(True),
    "tracer_leaks": checking_leaks,
}
TRAININGS: dict[str, dict[str, Any]] = {
    "ppo": {},
    "ppo_lagrangian": {"algorithm": "ppo_lagrangian", "cost_limit": 1},
    "discrete": {"actions": "discrete"},
    "recurrent": {"agent.actor": {"type": "gru", "hidden": [4], "units": 4}},
    "corrected": {"rta": "default", "rta_training": "corrected_action"},
}
SMALL = {
    "ppo.num_envs": 2,
    "ppo.num_steps": 2,
    "ppo.num_epochs": 1,
    "ppo.num_minibatches": 1,
    "env.terminal.timeout.limit": 1,
}


def core(env: jaxsafe.Environment, key: jax.Array, num_envs: int) -> Any:
    """Return a start, a step, and a rollout long enough for a second start."""
    key_reset, key_rollout = jax.random.split(key)
    state, timestep = jaxsafe.reset(env, key_reset)
    action = jnp.zeros(
        env.action_size, int if env.num_action_points else timestep.observation.dtype
    )
    state, timestep = jaxsafe.step(env, state, action)

    def policy(key: jax.Array, observation: jax.Array) -> jax.Array:
        return jnp.broadcast_to(action, (*observation.shape[:-1], env.action_size))

    return state, timestep, jaxsafe.rollout(env, policy, key_rollout, 3, num_envs)


def learn(words: dict[str, Any], key: jax.Array, run: Callable[..., Any]) -> Any:
    """Make two updates and evaluate what they learn."""
    small = {} if "agent.actor" in words else {"agent.actor.hidden": [4]}
    config, env, _ = resolve({"env": "docking2d", **SMALL, **small, **words})
    shared = env, config.agent, config.ppo
    keys = jax.random.split(key)

    def train(shared: Any, keys: jax.Array) -> Any:
        state, curves = chunk(shared, begin(shared, keys[0]), 2, 2)
        env, agent, _ = shared
        return state, curves, run_episodes(env, agent.policy(env, state.average, False), keys[1], 2)

    return run(train, shared, keys)


@pytest.mark.parametrize("mode", CHECKED_WHILE_TRACING)
@pytest.mark.parametrize("task", ["docking2d", pytest.param("rejoin3d", marks=pytest.mark.slow)])
def test_steps_and_rollouts_can_be_traced(mode: str, task: str) -> None:
    with CHECKED_WHILE_TRACING[mode]():
        env = jaxsafe.make(task)
        for num_envs in (2, 300):
            jax.eval_shape(lambda env, key, n=num_envs: core(env, key, n), env, jax.random.key(0))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("training", "mode"),
    one_of_each_kind(
        itertools.product(TRAININGS, CHECKED_WHILE_TRACING),
        [
            *(("ppo", mode) for mode in CHECKED_WHILE_TRACING),
            ("ppo_lagrangian", "rank_promotion"),
            ("discrete", "x64"),
            ("corrected", "dtype_promotion"),
        ],
    ),
)
def test_training_and_evaluation_can_be_traced(mode: str, training: str) -> None:
    with CHECKED_WHILE_TRACING[mode]():
        learn(TRAININGS[training], jax.random.key(0), jax.eval_shape)


@pytest.mark.slow
@pytest.mark.parametrize("mode", CHECKED_WHILE_TRACING)
@pytest.mark.parametrize(
    ("task", "rta"), [(task, rta) for task in TASKS for rta in TASKS[task].filters]
)
def test_every_filter_can_be_traced(mode: str, task: str, rta: str) -> None:
    with CHECKED_WHILE_TRACING[mode]():
        env = jaxsafe.make(task, rta=rta)
        jax.eval_shape(lambda env, key: core(env, key, 2), env, jax.random.key(0))


@pytest.mark.slow
@pytest.mark.parametrize("mode", CHECKED_WHILE_RUNNING)
def test_everything_runs(mode: str) -> None:
    with CHECKED_WHILE_RUNNING[mode]():
        *keys, key = jax.random.split(jax.random.key(0), 3)
        plain = jaxsafe.make("docking2d")
        filtered = jaxsafe.make("docking2d", rta="default")
        for env, key_core in zip((plain, filtered), keys, strict=True):
            _, timestep, _ = jax.jit(lambda env, key: core(env, key, 2))(env, key_core)
            assert bool(jnp.isfinite(timestep.observation).all())
        state, _ = learn(TRAININGS["ppo"], key, lambda function, *given: jax.jit(function)(*given))[
            :2
        ]
        assert int(state.num_updates) == 2
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(state.params))


@pytest.mark.slow
@pytest.mark.parametrize("rta", [None, "default", "explicit_simplex"])
def test_steps_and_filters_run_without_compilation(rta: str | None) -> None:
    env = jaxsafe.make("docking2d", rta=rta)
    key = jax.random.key(0)
    compiled = jax.jit(lambda env, key: core(env, key, 2))(env, key)
    with jax.disable_jit():
        eager = core(env, key, 2)
    for left, right in zip(jax.tree.leaves(compiled[:2]), jax.tree.leaves(eager[:2]), strict=True):
        if jnp.issubdtype(left.dtype, jnp.number):
            np.testing.assert_allclose(left, right, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_training_runs_without_compilation() -> None:
    with jax.disable_jit():
        state = learn(
            TRAININGS["ppo"], jax.random.key(0), lambda function, *given: function(*given)
        )[0]
    assert int(state.num_updates) == 2
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(state.params))


@pytest.mark.thorough
@pytest.mark.parametrize("rta", [None, "default"])
def test_a_state_may_be_donated_after_an_eager_start(rta: str | None) -> None:
    env = jaxsafe.make("docking2d", rta=rta, randomize={"deputy.mass": [10, 14]})
    place = {"position": jnp.array([60.0, 40.0]), "velocity": jnp.zeros(2)}
    given = {"deputy.mass": jnp.array(12.0)}
    step = jax.jit(jaxsafe.step, donate_argnums=1)
    starts = jaxsafe.reset(env, jax.random.key(0)), jaxsafe.reset_to(env, {"deputy": place}, given)
    for state, timestep in starts:
        leaves = jax.tree.leaves(state)
        assert len({leaf.unsafe_buffer_pointer() for leaf in leaves}) == len(leaves)
        before = np.asarray(timestep.observation)
        step(env, state, jnp.zeros(2))
        kept = jax.tree.leaves((env, place, given, timestep))
        assert not any(leaf.is_deleted() for leaf in kept)
        np.testing.assert_array_equal(timestep.observation, before)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("rta", "mode"),
    [
        ("explicit_simplex", "rbg"),
        ("explicit_simplex", "unsafe_rbg"),
        ("explicit_asif", "nans"),
        ("implicit_asif", "tracer_leaks"),
        ("robust", "nans"),
        ("robust", "key_reuse"),
    ],
)
def test_other_filters_run_in_the_modes_that_are_checked_while_running(rta: str, mode: str) -> None:
    jax.clear_caches()
    with CHECKED_WHILE_RUNNING[mode]():
        env = jaxsafe.make("docking2d", rta=rta)
        state, _ = jaxsafe.reset(env, jax.random.key(0))
        _, timestep = jax.jit(jaxsafe.step)(env, state, jnp.ones(2))
        assert jnp.isfinite(timestep.info.rta.predicted_margin)
