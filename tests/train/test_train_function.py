"""Training and evaluation as functions do what the commands do, and work under jit and vmap."""

import inspect
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_process import check_as_compiled_by_commands
from tiny_run import TINY

import jaxsafe
from jaxsafe.agents.policy_file import read_policy
from jaxsafe.commands.train import main
from jaxsafe.config.arguments import Arguments
from jaxsafe.train.host.log import read_progress
from jaxsafe.train.host.options import TrainConfig, resolve

Recipe = tuple[TrainConfig, jaxsafe.Environment]
train: Any = jaxsafe.train


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    return resolve(Arguments.parse(TINY).options)[:2]


def check_that_it_trains_what_the_command_trains(directory: str) -> None:
    """Two updates run at a time, as in all but the shortest trainings.

    A single one is compiled without a loop.
    """
    longer = {"seeds=3": "seeds=2", "steps=1280": "steps=6400", "eval_every=320": "eval_every=6400"}
    words = [longer.get(word, word) for word in TINY if not word.startswith("checkpoint_every")]
    assert main([*words, f"out={directory}"]) == 0
    config, env, _ = resolve(Arguments.parse(words).options)
    arguments = (env, config.agent, config.ppo, jax.random.key(1), config.num_updates)
    saved = read_policy(Path(directory) / "policy" / "seed_1.npz").params
    rows = [row for row in read_progress(Path(directory)) if row["seed"] == 1]
    returns = [row["return"] or 0.0 for row in rows]  # null while no episode has ended
    for state, curves in (jax.jit(train, static_argnums=4)(*arguments), train(*arguments)):
        jax.tree.map(np.testing.assert_array_equal, jax.device_get(state.average), saved)
        np.testing.assert_allclose(curves["return"], returns, rtol=1e-4)
        for name in ("value_loss", "approx_kl", "learning_rate"):
            np.testing.assert_allclose(curves[name], [row[name] for row in rows], rtol=1e-4)


@pytest.mark.thorough
def test_it_trains_bit_for_bit_what_the_command_trains(tmp_path: Path) -> None:
    check_as_compiled_by_commands(
        check_that_it_trains_what_the_command_trains, str(tmp_path / "run")
    )


@pytest.mark.thorough
def test_seeds_and_hyperparameters_are_mapped(recipe: Recipe) -> None:
    config, env = recipe
    rates = jnp.array([1e-4, 1e-3])
    keys = jax.random.split(jax.random.key(0), 2)

    def final(rate: jax.Array, key: jax.Array) -> jax.Array:
        state, _ = train(env, config.agent, config.ppo.replace(learning_rate=rate), key, 2)
        return state.params["actor"]["hidden_0"]["kernel"]

    kernels = np.asarray(jax.jit(jax.vmap(final))(rates, keys))
    assert kernels.shape[0] == 2
    for index in range(2):
        np.testing.assert_allclose(
            kernels[index], jax.jit(final)(rates[index], keys[index]), rtol=1e-4, atol=1e-6
        )


@pytest.mark.thorough
def test_a_callback_sees_every_piece_and_can_stop() -> None:
    check_as_compiled_by_commands(check_that_a_callback_sees_every_piece)


def check_that_a_callback_sees_every_piece() -> None:
    config, env, _ = resolve(Arguments.parse(TINY).options)
    arguments = (env, config.agent, config.ppo, jax.random.key(1), 5)
    seen = []

    def watch(state: Any, curves: dict[str, jax.Array], last: int = 5) -> bool:
        seen.append((int(state.num_updates), len(curves["return"])))
        return int(state.num_updates) >= last

    state, curves = train(*arguments, callback=watch, every=2)
    assert seen == [(2, 2), (4, 2), (5, 1)]
    whole, expected = jax.jit(train, static_argnums=4)(*arguments)
    jax.tree.map(np.testing.assert_array_equal, state.params, whole.params)
    np.testing.assert_array_equal(curves["return"], expected["return"])
    seen.clear()
    state, _ = train(*arguments, callback=partial(watch, last=2), every=2)
    assert seen == [(2, 2)]
    assert int(state.num_updates) == 2


@pytest.mark.thorough
def test_what_was_trained_is_evaluated_as_any_policy(recipe: Recipe) -> None:
    config, env = recipe
    state, _ = train(env, config.agent, config.ppo, jax.random.key(0), 1)
    policy = config.agent.policy(env, state.average, deterministic=True)
    metrics = jaxsafe.evaluate(env, policy, jax.random.key(0), num_episodes=4)
    assert metrics["episode_length"] == 41.0  # the step on which 40 s are exceeded
    assert metrics["intervention_rate"] is None
    assert metrics["success_rate"] == 0.0


def test_the_packages_show_the_arguments_of_their_functions() -> None:
    names = ["env", "agent", "hyperparameters", "key", "num_updates", "callback", "every"]
    names.append("params")
    assert list(inspect.signature(train).parameters) == names
    assert "num_episodes" in inspect.signature(jaxsafe.evaluate).parameters
    with pytest.raises(AttributeError, match=r"module 'jaxsafe\.train' has no attribute 'trian'"):
        _ = train.trian


def test_importing_jaxsafe_does_not_load_the_optimizer() -> None:
    code = (
        "import sys, jaxsafe; assert callable(jaxsafe.train) and not {'optax', 'flax'} &"
        " {*sys.modules}"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
