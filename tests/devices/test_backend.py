"""Programs take other paths on an accelerator, and the results are the same."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe import autoreset
from jaxsafe.devices import backend
from jaxsafe.devices.backend import packing, scan_packed
from jaxsafe.devices.seed_mapper import claim_cores
from jaxsafe.rollout import reset_batch, step_or_reset_batch
from jaxsafe.train import ppo, shuffle
from jaxsafe.train.hyperparameters import PPO


@pytest.fixture
def as_accelerated(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    return lambda module: monkeypatch.setattr(module, "accelerated", lambda: True)


def same(first: Any, second: Any) -> bool:
    return jax.tree.structure(first) == jax.tree.structure(second) and all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True)
    )


def test_a_packed_scan_returns_what_a_scan_returns() -> None:
    def step(carry: jax.Array, x: jax.Array) -> tuple[jax.Array, Any]:
        carry = carry + x
        return carry, {
            "sum": carry,
            "twice": 2 * carry,
            "whole": carry.astype(int),
            "rows": jnp.outer(carry, carry),
            "none": (),
        }

    start = jnp.zeros(3)
    xs = jnp.arange(12.0).reshape(4, 3)
    assert same(scan_packed(step, start, xs), jax.lax.scan(step, start, xs))


def test_a_packed_tree_is_a_vector_on_an_accelerator_alone(
    as_accelerated: Callable[[Any], None],
) -> None:
    tree = {"kernel": jnp.ones((2, 3)), "bias": jnp.zeros(3)}
    pack, unpack = packing(tree)
    assert pack(tree) is tree
    assert unpack(tree) is tree
    as_accelerated(backend)
    pack, unpack = packing(tree)
    assert pack(tree).shape == (9,)
    assert same(unpack(pack(tree)), tree)


@pytest.mark.thorough
def test_an_accelerator_draws_the_same_starts(as_accelerated: Callable[[Any], None]) -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 3.0})
    state, _ = jax.jit(reset_batch, static_argnums=2)(
        env, jax.random.key(0), autoreset.SPARSE_RESETS_FROM
    )
    action = jnp.zeros((autoreset.SPARSE_RESETS_FROM, env.action_size))

    def following(_: None) -> Any:
        return jax.lax.scan(
            lambda s, key: (step_or_reset_batch(env, s, action, key)[0][0], None), state, keys
        )[0]

    keys = jax.random.split(jax.random.key(1), 8)
    expected = jax.jit(following)(None).sim.platforms["deputy"].position
    as_accelerated(autoreset)
    found = jax.jit(lambda _: following(None))(None).sim.platforms["deputy"].position
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.thorough
def test_an_accelerator_learns_the_same(as_accelerated: Callable[[Any], None]) -> None:
    from jaxsafe.agents.agent import Agent
    from jaxsafe.agents.networks import MLP
    from jaxsafe.schema.component import normalise

    env = jaxsafe.make("docking2d")
    agent = normalise(Agent(actor=MLP(hidden=(8,))))
    hyper = normalise(PPO(num_envs=4, num_steps=8, num_epochs=2))
    start = ppo.init(env, agent, hyper, jax.random.key(0))
    expected = jax.jit(lambda state: ppo.update(env, agent, hyper, 4, state)[0])(start)
    for module in (backend, ppo, shuffle):
        as_accelerated(module)
    found = jax.jit(lambda state: ppo.update(env, agent, hyper, 4, state)[0])(start)
    for first, second in zip(
        jax.tree.leaves(found.params), jax.tree.leaves(expected.params), strict=True
    ):
        np.testing.assert_allclose(first, second, atol=1e-5)


@pytest.mark.parametrize(
    ("plugin", "platforms", "disabled"),
    [(None, "", True), (object(), "", False), (object(), "cpu", True)],
)
def test_llvm_keeps_its_expensive_passes_for_an_accelerator(
    monkeypatch: pytest.MonkeyPatch, plugin: object, platforms: str, disabled: bool
) -> None:
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setenv("JAX_PLATFORMS", platforms)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: plugin)
    claim_cores()
    assert ("disable_expensive_passes" in os.environ["XLA_FLAGS"]) == disabled


@pytest.mark.parametrize("own", ["", "--xla_backend_extra_options=xla_cpu_optimize_for_size"])
def test_small_loops_become_one_function_unless_the_user_has_set_such_options(
    monkeypatch: pytest.MonkeyPatch, own: str
) -> None:
    monkeypatch.setenv("XLA_FLAGS", own)
    claim_cores()
    flags = os.environ["XLA_FLAGS"]
    assert flags.count("--xla_backend_extra_options") == 1
    assert ("xla_cpu_small_while_loop_byte_threshold=1000000" in flags) == (not own)


@pytest.mark.parametrize("started", ["by itself", "by a process that imported jax first"])
def test_a_cached_program_loads_without_a_word_even_if_jax_came_first(
    started: str, tmp_path: Path
) -> None:
    code = (
        "import jax, jaxsafe\n"
        "from jaxsafe.devices.compilation_cache import enable_compilation_cache\n"
        "enable_compilation_cache()\n"
        "print(jax.jit(lambda x: x + 1)(2))"
    )
    if started != "by itself":
        command = [sys.executable, "-c", code.replace("import jax, jaxsafe", "import jaxsafe, jax")]
        code = f"import jax, jaxsafe, subprocess\nsubprocess.run({command}, check=True)"
    kept = {"JAX_COMPILATION_CACHE_DIR", "TF_CPP_MIN_LOG_LEVEL"}
    own = {name: value for name, value in os.environ.items() if name not in kept}
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**own, "XDG_CACHE_HOME": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        )
        assert (done.stdout, done.stderr) == ("3\n", "")
    assert any((tmp_path / "jaxsafe").iterdir())
