"""The falsifier writes a file that says what it was made by."""

import json
import shlex
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe.commands import falsify
from jaxsafe.commands.falsify import confidence, line, main
from jaxsafe.environment import drawn
from jaxsafe.evaluate import run_adversaries
from jaxsafe.evaluate.adversaries import ADVERSARIES
from jaxsafe.evaluate.run_adversaries import attack, longest_episode
from jaxsafe.processors.terminal import Timeout, time_limit


@pytest.mark.thorough
def test_the_numbers_name_the_command_and_the_versions_that_made_them(tmp_path: Path) -> None:
    argv = [
        "env=docking2d",
        "steps=40",
        "lanes=4",
        "policies=[uniform]",
        f"out={tmp_path / 'found.json'}",
    ]
    assert main(argv) == 0
    results = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))
    assert results["command"] == f"jaxsafe falsify {shlex.join(argv)}"
    assert {"jaxsafe", "jax", "device", "processor"} <= set(results["versions"])
    assert [
        (row["policy"], row["steps"], row["violating_steps"]) for row in results["policies"]
    ] == [("uniform", 40, 0)]


def test_adversaries_that_share_a_program_do_what_each_does_alone() -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 20.0})
    names = ("bang_bang", "outward")

    def run(name: str, among: tuple[str, ...]) -> Any:
        return attack(env, name, 20, 4, jax.random.key(0), among=among)

    before = run_adversaries._follow._cache_size()
    together = [run(name, among=names) for name in names]
    assert run_adversaries._follow._cache_size() == before + 1
    for name, row in zip(names, together, strict=True):
        alone = run(name, among=())
        for entry in ("policy", "violation_bound"):
            assert alone.pop(entry) == row.pop(entry)
        assert alone == pytest.approx(row, rel=1e-5)
    assert together[0]["worst_margin"] != together[1]["worst_margin"]


def test_a_violation_is_the_exit_code_and_bounds_nothing(tmp_path: Path) -> None:
    out = tmp_path / "found.json"
    assert (
        main(
            [
                "env=docking2d",
                "rta=none",
                "steps=2000",
                "lanes=10",
                "policies=[inward]",
                f"out={out}",
            ]
        )
        == 1
    )
    [row] = json.loads(out.read_text(encoding="utf-8"))["policies"]
    assert row["violating_steps"] > 0
    assert row["violation_bound"] is None
    assert confidence([row]) == ""
    # Violations inside steps count as well.
    assert confidence([{**row, "violating_steps": 0}]) == ""


@pytest.mark.thorough
def test_episodes_are_what_is_counted_and_whole_ones_unless_told_otherwise(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Steps of an episode depend on each other. So a million of them bound nothing for a step."""
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 30.0}, rta="default")
    assert longest_episode(env) == 32
    whole = attack(env, "uniform", longest_episode(env), 5, jax.random.key(0))
    cut = attack(env, "uniform", 20, 5, jax.random.key(0))
    assert (whole["whole_episodes"], whole["episodes"], whole["violation_bound"]) == (
        True,
        5,
        3.0 / 5,
    )
    assert (cut["whole_episodes"], cut["episodes"], cut["violation_bound"]) == (False, 5, 3.0 / 5)
    assert (
        main(["env=docking2d", "num_envs=5", "policies=[uniform]", "env.terminal.timeout.limit=30"])
        == 0
    )
    printed = capsys.readouterr().out
    assert " 160 " in printed
    assert "less than a share of 0.6 of the episodes has one" in printed


def test_a_time_limit_that_means_none_leaves_episodes_that_are_cut(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The limit is more steps than single precision holds."""

    class AttackError(Exception):
        pass

    def attack(env: Any, name: str, num_steps: int, num_envs: int, key: Any, **_: Any) -> Any:
        raise AttackError(num_steps, num_envs)

    monkeypatch.setattr(falsify, "attack", attack)
    for limit, length in (("1e38", 15_625), ("50", 502)):  # 15,625 · 64 = 1,000,000
        with pytest.raises(AttackError) as caught:
            main(["env=docking2d", "rta=none", "env.dt=0.1", f"env.terminal.timeout.limit={limit}"])
        assert caught.value.args == (length, 64)


@pytest.mark.thorough
def test_a_random_time_limit_is_read_as_each_episode_has_it() -> None:
    env = jaxsafe.make(
        "docking2d",
        {"terminal.timeout.limit": 10.0},
        randomize={"terminal.timeout.limit": [5.0, 30.0]},
    )
    assert longest_episode(env) == 32
    whole = attack(env, "there_and_back", longest_episode(env), 5, jax.random.key(0))
    assert whole["whole_episodes"]
    assert time_limit(env) == 10.0
    assert (
        time_limit(
            env.replace(terminal=(*env.terminal, Timeout(name="sooner", limit=jnp.float32(4.0))))
        )
        == 4.0
    )
    assert time_limit(env.replace(terminal=env.terminal[:1])) is None
    sim = jaxsafe.reset(env, jax.random.key(0))[0].sim
    key = jax.random.key(1)
    away = ADVERSARIES["outward"](env, sim, jax.random.key(1))
    # The time is 4 s. Whether the agent has turned by then depends on the limit of the episode.
    for limit, turned in (
        (5.0, True),
        (30.0, False),
    ):
        now = drawn(env, {"terminal.timeout.limit": jnp.float32(limit)})
        control = ADVERSARIES["there_and_back"](now, sim.replace(time=jnp.float32(4.0)), key)
        assert bool((control == away).all()) is not turned


def test_what_is_not_a_number_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(env: Any, sim: Any, key: Any) -> jax.Array:
        return jnp.full(2, jnp.nan)

    monkeypatch.setitem(ADVERSARIES, "broken", broken)
    row = attack(jaxsafe.make("docking2d"), "broken", 7, 3, jax.random.key(0))
    assert row["violating_steps"] == row["violating_steps_inside"] == 21
    assert row["violation_bound"] is None
    assert row["worst_margin"] is None
    assert "no number" in line(row)
    assert json.loads(json.dumps(row, allow_nan=False)) == row


@pytest.mark.parametrize(
    "policy", [thorough("there_and_back"), pytest.param("drain", marks=pytest.mark.slow)]
)
def test_adversaries_that_turn_back_and_that_take_the_least_certificate(policy: str) -> None:
    bare = jaxsafe.make(
        "docking2d", {"terminal.timeout.limit": 200.0, "deputy.start.velocity.share": [0.0, 0.1]}
    )
    row = attack(bare, policy, 202, 8, jax.random.key(0))
    assert row["violating_steps"] > 0
    kept = attack(
        jaxsafe.override(bare, {"rta": jaxsafe.make("docking2d", rta="default").rta}),
        policy,
        202,
        8,
        jax.random.key(0),
    )
    assert (
        kept["violating_steps"] == kept["violating_steps_inside"] == kept["uncertified_steps"] == 0
    )
    assert kept["worst_margin"] < (0.001 if policy == "drain" else 0.1)


@pytest.mark.thorough
def test_what_an_episode_draws_is_the_plant_that_is_counted_on() -> None:
    """The nominal limit is exceeded all the time.

    The limit that every episode draws is never exceeded.
    """
    loose = "env.randomize={status.velocity_limit.floor: [50, 60]}"
    argv = [
        "env=docking2d",
        "rta=none",
        "steps=200",
        "lanes=10",
        "policies=[inward]",
        "env.deputy.start.velocity.share=[0,0.1]",
    ]
    assert main([*argv, loose]) == 0
    assert main(argv) == 1
