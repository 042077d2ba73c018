"""The worlds of the comparison of ways to train under a constraint."""

import importlib
from pathlib import Path

import jax.numpy as jnp
import pytest

import jaxsafe


def test_flying_too_fast_costs_no_reward_and_may_end_the_episode(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    constraints = importlib.import_module("constraints")
    fast = {"deputy": {"position": [100.0, 0.0], "velocity": [-2.0, 0.0]}}
    outcomes = []
    for path in constraints.write_worlds(tmp_path):
        env = jaxsafe.make(str(path))
        state, _ = jaxsafe.reset_to(env, fast)
        _, timestep = jaxsafe.step(env, state, jnp.zeros(2))
        assert timestep.cost == 1.0
        assert timestep.info.reward_terms["velocity_constraint"] == 0.0
        outcomes.append(env.outcomes[int(timestep.info.outcome)])
    assert outcomes == ["running", "violation"]
