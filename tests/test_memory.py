from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from jaxsafe.errors import ConfigError
from jaxsafe.train import hosts, memory
from jaxsafe.train.__main__ import main


def test_a_training_that_would_not_fit_is_refused_before_it_starts(tmp_path: Path) -> None:
    words = ["env=docking2d", "seeds=2", f"out={tmp_path / 'run'}", "ppo.num_steps=1", "ppo.num_envs=1000000000"]
    with pytest.raises(
        ConfigError, match=r"ppo.num_envs, .*: this training needs [\d,.]+ GiB of memory, [\d,.]+ GiB are free"
    ):
        main(words)
    with pytest.raises(ConfigError, match=r"ppo.num_envs × ppo.num_steps: expected less than 2³¹, found 8,000,000,000"):
        main([*words[:-2], "ppo.num_envs=1000000000", "ppo.num_steps=8"])


def test_devices_of_one_machine_share_its_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 10 * memory.GIB)
    memory.require(5 * memory.GIB, 2, "x")
    with pytest.raises(ConfigError, match=r"x: this training needs 12.0 GiB of memory, 10.0 GiB are free"):
        memory.require(4 * memory.GIB, 3, "x")


def test_every_process_refuses_what_does_not_fit_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 10 * memory.GIB)
    monkeypatch.setattr(hosts, "anyone", lambda _: True)
    with pytest.raises(ConfigError, match=r"x: this training needs 2.0 GiB of memory, another process has less"):
        memory.require(memory.GIB, 2, "x")


def test_what_is_counted() -> None:
    tree = {"numbers": jnp.zeros((3, 4)), "flags": jnp.zeros(5, bool), "keys": jax.random.split(jax.random.key(0), 2)}
    assert memory.size(tree) == 3 * 4 * 4 + 5 + 2 * 8
    x = jnp.zeros((1000, 1000))
    compiled = jax.jit(lambda x: (x @ x.T) @ x).lower(x).compile()
    assert 3 * x.nbytes <= memory.footprint(compiled) <= 4 * x.nbytes
    free = memory.available()
    assert free is None or free > 0
