"""Worlds as bad as the bound of a filter, or worse, and what adversaries achieve in them."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.commands import falsify
from jaxsafe.config import override
from jaxsafe.evaluate.bounded_worlds import world_at
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.schema.errors import ConfigError
from jaxsafe.uncertain import measured

BOUND = {"process": 1e-2, "mass": 0.05, "misalignment": 0.02, "position": 0.5, "velocity": 1e-3}
AT_THE_LIMIT = {"deputy": {"position": [100.0, 0.0], "velocity": [-0.3, 0.0]}}


@pytest.mark.thorough
def test_violations_begin_beyond_the_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["env=docking2d", "env.rta.bound={process: 0.01}", "policies=inward", "num_envs=8"]
    assert falsify.main([*words, "levels=1,1.5", "steps=2400", "out=levels.json"]) == 0
    rows = json.loads(Path("levels.json").read_text())["policies"]
    within, beyond = rows
    assert (within["level"], beyond["level"]) == (1.0, 1.5)
    assert within["violating_steps"] == within["violating_steps_inside"] == 0
    assert within["violating_certified_steps"] == 0
    assert 0.0 < within["worst_margin_inside"] < 1e-3  # the margin is not larger than it must be
    assert beyond["violating_steps"] > 0  # which breaks no promise, and the exit code is 0
    shown = capsys.readouterr().out
    assert "1 times the bound" in shown
    assert "1.5 times the bound" in shown

    env = jaxsafe.make("docking2d", {"rta.bound": {"process": 0.01}}, rta="default")
    nominal = override(world_at(env, 1.0), {"rta.bound": None})
    counts = attack(nominal, "inward", 300, 8, jax.random.key(0))
    assert counts["violating_certified_steps"] >= counts["violating_steps"] > 0


@pytest.mark.thorough
@pytest.mark.parametrize("task", ["docking2d", "docking3d"])
@pytest.mark.parametrize("policy", ["greedy", "inward", "search"])
def test_no_adversary_breaks_a_robust_filter_within_its_bound(task: str, policy: str) -> None:
    env = jaxsafe.make(task, {"rta.bound": BOUND}, rta="default")
    world = world_at(env, 1.0, searched=policy == "search")
    counts = attack(world, policy, 600, 16, jax.random.key(1))
    assert counts["violating_steps"] == counts["violating_steps_inside"] == 0
    assert counts["uncertified_steps"] <= counts["unsafe_starts"] * counts["steps"]


@pytest.mark.thorough
def test_a_world_has_every_part_of_the_bound() -> None:
    small = {name: value / 20.0 for name, value in BOUND.items()}
    env = jaxsafe.make("docking3d", {"rta.bound": {**small, "delay": 2}}, rta="default")
    world = world_at(env, 2.0)
    kinds = [part.type_name for part in world.uncertainty]
    assert kinds == ["delay", "misaligned", "worst", "worst_navigation", "worst_navigation"]
    assert world.platform("deputy").mass == pytest.approx(12.0 * 0.995)
    assert world.rta.model["deputy.mass"] == 12.0
    assert world.uncertainty[2].bound == pytest.approx(1e-3)
    assert world_at(env, 1.0, searched=True).uncertainty[2].type_name == "chosen"


def test_the_worst_disturbance_lowers_h_more_than_any_other() -> None:
    worst = {"type": "worst", "name": "push", "on": "deputy", "bound": 0.01}
    env = jaxsafe.make("docking2d", {"uncertainty": [worst]})
    state = jaxsafe.reset_to(env, AT_THE_LIMIT)[0]
    after, timestep = jaxsafe.step(env, state, jnp.zeros(2))
    push = after.memory.uncertainty["push"]
    np.testing.assert_allclose(jnp.linalg.norm(push), 0.01, rtol=1e-5)

    chosen = jaxsafe.make("docking2d", {"uncertainty": [{**worst, "type": "chosen"}]})
    start = jaxsafe.reset_to(chosen, AT_THE_LIMIT)[0]
    for angle in np.linspace(0.0, 2 * np.pi, 12):
        other = 0.01 * jnp.array([np.cos(angle), np.sin(angle)])
        memory = start.memory.replace(uncertainty={"push": other})
        margin = jaxsafe.step(chosen, start.replace(memory=memory), jnp.zeros(2))[1].info.margins
        assert margin["velocity_limit"] >= timestep.info.margins["velocity_limit"] - 1e-6


def test_the_worst_error_of_navigation_looks_safer_than_the_truth() -> None:
    part = {"type": "worst_navigation", "name": "nav", "of": "deputy", "what": "velocity"}
    env = jaxsafe.make("docking2d", {"uncertainty": [{**part, "bound": 0.05}]})
    state, first = jaxsafe.reset_to(env, AT_THE_LIMIT)
    np.testing.assert_allclose(state.memory.uncertainty["nav"], [0.05, 0.0], atol=1e-6)
    np.testing.assert_allclose(first.observation[2] * 0.5, -0.25, atol=1e-6)


def test_levels_need_a_bound() -> None:
    with pytest.raises(ConfigError, match=r"levels: the filter has no rta\.bound"):
        world_at(jaxsafe.make("docking2d", rta="default"), 1.0)
    with pytest.raises(ConfigError, match=r"levels: expected numbers from 0 to 1e6, found -1"):
        falsify.main(["env=docking2d", "levels=-1"])


@pytest.mark.thorough
def test_a_wrong_velocity_makes_an_aircraft_seem_to_close_in_more_slowly() -> None:
    """The distance does not depend on the velocity, but the distance a step later does."""
    bound = {"process": 0.5, "velocity": 2.0}
    env = world_at(jaxsafe.make("rejoin2d", {"rta.bound": bound}, rta="robust"), 1.0)
    lead = {"position": [0.0, 0.0], "heading": 0.0, "speed": 250.0}
    wingman = {"position": [-2000.0, 500.0], "heading": 0.1, "speed": 300.0}
    state, _ = jaxsafe.reset_to(env, {"lead": lead, "wingman": wingman})
    own = state.sim.platforms["wingman"]
    seen = measured(env, state.sim, state.memory.uncertainty).platforms["wingman"]
    error = np.asarray(seen.velocity - own.velocity)
    np.testing.assert_allclose(np.linalg.norm(error), 2.0, rtol=1e-4)
    away = np.asarray(own.position + own.velocity - np.array([250.0, 0.0]))
    np.testing.assert_allclose(error / 2.0, away / np.linalg.norm(away), atol=1e-2)
