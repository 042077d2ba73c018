"""The metrics of Section 5, over streams of time steps written by hand."""

import functools
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import bootstrap, trim_mean

import jaxsafe
from jaxsafe.metrics import (
    METRICS,
    OVER_STEPS,
    Episode,
    accumulate,
    begin,
    bootstrap_interval,
    full_controls,
    interaction_efficiency,
    measures,
    over_seeds,
    stratified_iqm,
    summarise,
    with_interval,
)
from jaxsafe.types import Info, TimeStep

SUCCESS = 1
CRASH = 2


def time_step(
    reward: float,
    delta_v: tuple[float, ...] = (0.0, 0.0),
    severity: tuple[float, ...] = (0.0, 0.0),
    outcome: int = 0,
) -> TimeStep:
    """Return a step with two safety constraints. Its totals are carried along but not used."""
    margins = {name: jnp.asarray(-share) for name, share in zip("ab", severity, strict=True)}
    info = Info(
        outcome=jnp.asarray(outcome),
        ended={},
        status={"delta_v": jnp.asarray(delta_v[0]), "delta_v_l1": jnp.asarray(delta_v[1])},
        reward_terms={"term": jnp.asarray(reward)},
        reward_totals={"term": jnp.asarray(10.0 * reward)},
        control_desired=jnp.zeros(1),
        control_actual=jnp.zeros(1),
        intervening=jnp.asarray(severity[0] > 0.0),  # so that some steps intervene
        margins=margins,
        severity={name: jnp.asarray(share) for name, share in zip("ab", severity, strict=True)},
        rta=None,
    )
    ended = jnp.asarray(outcome != 0)
    cost = jnp.asarray(float(max(severity) > 0.0))
    return TimeStep(jnp.zeros(1), jnp.asarray(reward), cost, ended, jnp.asarray(False), info)


def follow(*timesteps: TimeStep) -> Episode:
    episode = begin(timesteps[0])
    for timestep in timesteps:
        episode = accumulate(episode, timestep)
    return episode


@pytest.fixture
def episodes() -> Episode:
    """Return three episodes.

    They are a safe success, a success with two violating steps, and a crash on its only step.
    """
    safe = follow(time_step(1.0, (0.1, 0.2)), time_step(3.0, (0.2, 0.3), outcome=SUCCESS))
    unsafe = follow(
        time_step(-1.0, severity=(0.5, 0.25)),
        time_step(0.0, (0.3, 0.4)),
        time_step(0.0),
        time_step(2.0, severity=(0.0, 2.0), outcome=SUCCESS),
    )
    crash = follow(time_step(-2.0, severity=(0.1, 0.1), outcome=CRASH))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), safe, unsafe, crash)


def test_sums_begin_at_zero() -> None:
    assert all(
        leaf == 0 for leaf in jax.tree.leaves(begin(time_step(5.0, (1.0, 1.0), (1.0, 1.0), 1)))
    )


def test_steps_add_up(episodes: Episode) -> None:
    expected = {
        "episode_return": [4.0, 1.0, -2.0],
        "length": [2, 4, 1],
        "outcome": [SUCCESS, SUCCESS, CRASH],
        "delta_v": [0.3, 0.3, 0.0],
        "delta_v_l1": [0.5, 0.4, 0.0],
        "violating_steps": [0, 2, 1],
        "severity_sum": [0.0, 2.5, 0.1],
        "severity_max": [0.0, 2.0, 0.1],
        "interventions": [0, 1, 1],
        "control_effort": [0.0, 0.0, 0.0],
    }
    assert set(vars(episodes)) == {*expected, "reward_totals", "costs", "measured"}
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(episodes, name), values, rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(episodes.reward_totals["term"], [30.0, 20.0, -20.0])


def test_counts_are_integers_and_shapes_do_not_change_from_step_to_step() -> None:
    before = begin(time_step(1.0))
    after = accumulate(before, time_step(1.0, (0.1, 0.1), (0.5, 0.5), SUCCESS))
    chex.assert_trees_all_equal_shapes_and_dtypes(before, after)
    assert {before.length.dtype, before.outcome.dtype, before.violating_steps.dtype} == {
        jnp.dtype("int32")
    }


def test_sums_work_on_batches_and_without_delta_v() -> None:
    batch = jax.tree.map(
        lambda leaf: jnp.stack([leaf, 2 * leaf]), time_step(1.0, (0.5, 0.5), (0.5, 0.25))
    )
    episode = accumulate(accumulate(begin(batch), batch), batch)
    np.testing.assert_allclose(episode.episode_return, [2.0, 4.0])
    np.testing.assert_allclose(episode.severity_max, [0.5, 1.0])
    bare = batch.replace(info=batch.info.replace(status={}, severity={}))
    episode = accumulate(begin(bare), bare)
    assert episode.delta_v.tolist() == episode.severity_sum.tolist() == [0.0, 0.0]
    assert episode.delta_v.shape == episode.reward_totals["term"].shape == (2,)


def test_the_metrics_of_three_episodes_are_those_worked_out_by_hand(episodes: Episode) -> None:
    computed = summarise(episodes, SUCCESS, has_rta=True)
    assert tuple(computed) == METRICS
    assert computed.pop("control_effort") is None  # of controls that were not summed
    assert computed == pytest.approx(
        {
            "average_return": 3.0 / 3,
            "episode_length": 7.0 / 3,
            "success_rate": 2.0 / 3,
            "control_usage": 0.6 / 3,
            "control_usage_l1": 0.9 / 3,
            "safety_violation_rate": 2.0 / 3,  # per episode
            "episode_safety_violation_rate": 3.0 / 7,  # per step
            "episode_cost": 3.0 / 3,
            "episode_violation_severity_mean": 2.6 / 3,  # over the three violating steps
            "episode_violation_severity_p95": 2.0,
            "episode_violation_severity_p99": 2.0,
            "episode_violation_severity_max": 2.0,
            "mean_reward": 3.0 / 7,
            "intervention_rate": 2.0 / 7,
        },
        rel=1e-6,
    )


def test_several_outcomes_may_count_as_success(episodes: Episode) -> None:
    for success, rate in (([SUCCESS, 3], 1.0), ([3], 1.0 / 3), ((), None)):
        outcomes = episodes.replace(outcome=jnp.array([SUCCESS, 3, SUCCESS]))
        found = summarise(outcomes, success)["success_rate"]
        assert found == (rate if rate is None else pytest.approx(rate))


def test_without_violations_severity_is_zero() -> None:
    episode = follow(time_step(1.0, outcome=SUCCESS))
    computed = summarise(jax.tree.map(lambda leaf: leaf[None], episode), SUCCESS)
    for name in ("safety_violation_rate", "episode_safety_violation_rate"):
        assert computed[name] == 0.0
    assert (
        computed["episode_violation_severity_mean"]
        == computed["episode_violation_severity_max"]
        == 0.0
    )
    assert computed["success_rate"] == 1.0


def test_control_usage_is_none_where_there_is_no_delta_v(episodes: Episode) -> None:
    computed = summarise(episodes, SUCCESS, has_delta_v=False)
    assert computed["intervention_rate"] is None
    assert computed["control_usage"] is None
    assert computed["control_usage_l1"] is None


def test_what_an_environment_does_not_measure_is_none(episodes: Episode) -> None:
    computed = summarise(
        episodes, -1, has_delta_v=True, has_delta_v_l1=False, has_constraints=False
    )
    known = {"average_return", "episode_length", "control_usage", "mean_reward"}
    assert {name for name, value in computed.items() if value is not None} == known
    assert (
        summarise(episodes, SUCCESS, has_delta_v=False, has_delta_v_l1=True)["control_usage_l1"]
        is not None
    )


def test_an_environment_says_what_it_measures() -> None:
    assert measures(jaxsafe.make("docking2d", rta="default")) == {
        "has_delta_v": True,
        "has_delta_v_l1": True,
        "has_constraints": True,
        "has_rta": True,
        "has_controls": True,
    }
    custom = jaxsafe.make(str(Path(__file__).parent.parent / "configs" / "custom_env.yaml"))
    assert measures(custom) | {"has_rta": False} == {
        "has_delta_v": True,
        "has_delta_v_l1": False,
        "has_constraints": True,
        "has_rta": False,
        "has_controls": True,
    }
    assert not measures(jaxsafe.make("rejoin2d"))["has_delta_v"]


def test_control_effort_is_the_mean_share_of_full_control_over_controls_and_steps() -> None:
    controls = [[0.5, -40.0], [-1.0, 0.0], [0.0, 20.0]]
    timesteps = [time_step(0.0) for _ in controls]
    timesteps = [
        timestep.replace(info=timestep.info.replace(control_actual=jnp.asarray(control)))
        for timestep, control in zip(timesteps, controls, strict=True)
    ]
    episode = begin(timesteps[0])
    for timestep in timesteps:
        episode = accumulate(episode, timestep, (jnp.asarray(1.0), jnp.asarray(80.0)))
    episodes = jax.tree.map(lambda leaf: leaf[None], episode)
    computed = summarise(episodes, SUCCESS, has_controls=True)["control_effort"]
    assert computed == pytest.approx((1.5 / 1.0 + 60.0 / 80.0) / 2 / 3)
    assert summarise(episodes, SUCCESS)["control_effort"] is None


def test_full_controls_are_the_larger_limits_in_either_direction() -> None:
    limits = {"wingman.controller.actuators.acceleration.low": -200.0}
    env = jaxsafe.make("rejoin2d", limits)
    assert np.asarray(full_controls(env)) == pytest.approx([0.17, 200.0])
    useless = {f"deputy.controller.actuators.thrust_x.{end}": 0.0 for end in ("low", "high")}
    assert np.asarray(full_controls(jaxsafe.make("docking2d", useless))).tolist() == [1.0, 1.0]


def test_a_figure_that_is_not_finite_is_none(episodes: Episode) -> None:
    broken = episodes.replace(episode_return=episodes.episode_return.at[1].set(jnp.nan))
    computed = summarise(broken, SUCCESS)
    assert computed["average_return"] is computed["mean_reward"] is None
    assert computed["success_rate"] == pytest.approx(2.0 / 3)


def test_the_metrics_of_a_real_episode_agree_with_its_steps() -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 19})
    actions = jax.random.uniform(jax.random.key(1), (20, 2), minval=-1.0)
    state, timestep = jaxsafe.reset_to(
        env, {"deputy": {"position": [120.0, 0.0], "velocity": [0.0, 0.4]}}
    )
    episode = begin(timestep)
    taken = []
    step = jax.jit(jaxsafe.step)
    for action in actions:
        state, timestep = step(env, state, action)
        episode = accumulate(episode, timestep)
        taken = [*taken, timestep]
    computed = summarise(
        jax.tree.map(lambda leaf: leaf[None], episode), env.outcomes.index("success")
    )
    limits = np.asarray([timestep.info.status["velocity_limit"] for timestep in taken], float)
    over = np.maximum([timestep.info.status["speed"] for timestep in taken] - limits, 0.0) / limits
    assert 0 < (over > 0).sum() < 20
    assert computed["control_usage"] == pytest.approx(
        np.linalg.norm(actions, axis=1).sum() / 12, rel=1e-5
    )
    assert computed["control_usage_l1"] == pytest.approx(np.abs(actions).sum() / 12, rel=1e-5)
    assert computed["episode_safety_violation_rate"] == pytest.approx((over > 0).mean())
    assert computed["episode_violation_severity_mean"] == pytest.approx(
        over[over > 0].mean(), rel=1e-3
    )
    assert computed["episode_violation_severity_max"] == pytest.approx(over.max(), rel=1e-3)
    assert computed["mean_reward"] == pytest.approx(
        np.mean([float(timestep.reward) for timestep in taken]), rel=1e-4
    )
    assert computed["average_return"] == pytest.approx(
        sum(map(float, state.reward_totals.values())), rel=1e-4
    )
    assert computed["episode_length"] == 20.0


# Interaction efficiency


def efficiency(success: Any, episodes: Any, **options: Any) -> dict[str, Any]:
    steps = 100 * (1 + np.arange(len(success)))
    return interaction_efficiency(
        steps, np.asarray(success, float), np.asarray(episodes), **options
    )


def test_interaction_efficiency_is_the_first_step_at_which_the_seeds_average_80_percent() -> None:
    success = [[0.9, 0.0], [0.7, 0.7], [1.0, 0.6], [0.5, 0.8], [1.0, 1.0]]
    assert efficiency(success, np.full((5, 2), 50)) == {"timesteps": 300, "per_seed": [100, 400]}


def test_a_rate_of_exactly_four_fifths_counts() -> None:
    assert efficiency([[0.79], [0.8]], [[100], [100]]) == {"timesteps": 200, "per_seed": [200]}
    rates = [0.97, 0.61, 0.74, 0.85, 0.64, 0.8, 0.85, 0.9, 0.97, 0.67]
    assert np.mean([rates], axis=1)[0] < 0.8  # rounding of floats brings the mean below
    assert efficiency([rates], [[100] * 10])["timesteps"] == 100
    # A sum of hundredths may end this far below.
    single = np.full((1, 1), 80 * np.float32(0.01) - np.float32(6e-8), np.float32)
    assert efficiency(single, [[100]]) == {"timesteps": 100, "per_seed": [100]}
    assert efficiency([[0.79999]], [[100]])["timesteps"] is None


def test_a_rate_counts_only_from_twenty_finished_episodes_on() -> None:
    success = [[1.0, 1.0]] * 4
    episodes = [[19, 3], [20, 10], [25, 19], [30, 20]]
    assert efficiency(success, episodes) == {"timesteps": 400, "per_seed": [200, 400]}


def test_the_average_waits_for_every_seed_to_have_finished_enough() -> None:
    success = [[1.0, 1.0, 1.0, 1.0, 1.0]] * 2
    episodes = [[50, 50, 50, 50, 19], [60, 60, 60, 60, 20]]
    assert efficiency(success, episodes) == {
        "timesteps": 200,
        "per_seed": [100, 100, 100, 100, 200],
    }


def test_interaction_efficiency_is_none_if_never_reached() -> None:
    assert efficiency([[0.7, 1.0]] * 3, np.full((3, 2), 99)) == {
        "timesteps": 100,
        "per_seed": [None, 100],
    }
    assert efficiency([[0.5, 1.0]] * 3, np.full((3, 2), 99)) == {
        "timesteps": None,
        "per_seed": [None, 100],
    }
    assert efficiency([[1.0]], [[19]]) == {"timesteps": None, "per_seed": [None]}


def test_a_seed_without_a_rate_yet_does_not_count_as_a_success() -> None:
    assert efficiency([[np.nan, 1.0], [0.9, 1.0]], [[0, 50], [20, 60]]) == {
        "timesteps": 200,
        "per_seed": [200, 100],
    }


# Over seeds


def test_the_mean_of_ten_seeds_has_the_interval_of_scipys_percentile_bootstrap() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, 10)
    computed = over_seeds([float(value) for value in values])
    expected = bootstrap(
        (values,), np.mean, method="percentile", n_resamples=20_000, rng=np.random.default_rng(1)
    )
    assert computed["mean"] == pytest.approx(values.mean())
    assert computed["iqm"] == pytest.approx(trim_mean(values, 0.25))
    assert computed["per_seed"] == pytest.approx(list(values))
    assert computed["ci95"] == pytest.approx(list(expected.confidence_interval), abs=0.1)
    assert computed["ci95"][0] < values.mean() < computed["ci95"][1]


def test_the_bootstrap_interval_is_row_by_row() -> None:
    rows = np.random.default_rng(4).normal(size=(3, 10))
    computed = bootstrap_interval(rows)
    assert computed.shape == (2, 3)
    for i in range(3):
        np.testing.assert_array_equal(computed[:, i], bootstrap_interval(rows[i : i + 1])[:, 0])
    np.testing.assert_array_equal(bootstrap_interval(np.full((1, 5), 0.3)), np.full((2, 1), 0.3))


@settings(deadline=None, max_examples=20)
@given(st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=10))
def test_the_interval_lies_within_the_values(values: list[float]) -> None:
    computed = over_seeds(values)
    low, high = computed["ci95"]
    slack = 1e-9 * (1.0 + max(map(abs, values)))
    assert min(values) - slack <= low <= high <= max(values) + slack


def test_one_seed_or_two_have_no_interval() -> None:
    assert over_seeds([0.7]) == {"mean": 0.7, "ci95": None, "iqm": 0.7, "per_seed": [0.7]}
    assert over_seeds([0.5, 0.75])["ci95"] is None
    assert over_seeds([0.5, 0.75, 1.0])["ci95"] == [0.5, 1.0]
    assert stratified_iqm([[0.5] * 10, [0.7, 0.8]])["ci95"] is None
    assert with_interval(0.7, None, ".1f") == "0.7"
    assert with_interval(1234.5, [1000.0, 2000.0], ",.0f") == "1,234 [1,000, 2,000]"


def test_a_metric_without_a_meaning_stays_none() -> None:
    assert over_seeds([None, None]) == {
        "mean": None,
        "ci95": None,
        "iqm": None,
        "per_seed": [None, None],
    }


def test_the_interquartile_mean_drops_the_outer_quarters_over_all_tasks() -> None:
    computed = stratified_iqm([[0.0, 0.8, 0.9, 1.0], [0.9, 0.9, 0.9, 0.9]])
    assert computed["iqm"] == pytest.approx(0.9)  # the middle four of 0, 0.8, 0.9 × 5, 1
    low, high = computed["ci95"]
    assert 0.6 <= low <= 0.9 <= high <= 1.0


def test_the_stratified_bootstrap_resamples_within_tasks() -> None:
    # Every resample has five of each.
    assert stratified_iqm([[0.0] * 5, [1.0] * 5])["ci95"] == [
        0.5,
        0.5,
    ]


def test_the_tail_of_severity_is_over_episodes(episodes: Episode) -> None:
    worst = jnp.arange(1000) / 1000.0
    many = jax.tree.map(lambda leaf: jnp.resize(leaf, (1000,)), episodes).replace(
        severity_max=worst
    )
    computed = summarise(many, SUCCESS)
    assert computed["episode_violation_severity_p95"] == pytest.approx(0.95)
    assert computed["episode_violation_severity_p99"] == pytest.approx(0.99)
    assert summarise(many, SUCCESS, has_constraints=False)["episode_violation_severity_p99"] is None
    infinite = summarise(many.replace(severity_max=worst.at[-3:].set(jnp.inf)), SUCCESS)
    assert infinite["episode_violation_severity_p99"] == pytest.approx(0.99)
    assert infinite["episode_violation_severity_max"] is None


def test_metrics_of_ones_own_are_taken_over_the_steps_of_an_episode() -> None:
    names = [f"height.{over_steps}" for over_steps in OVER_STEPS]
    heights = [-3.0, -1.0, -5.0]
    steps = [
        step.replace(info=step.info.replace(status={**step.info.status, "height": jnp.array(x)}))
        for step, x in zip([time_step(0.0), time_step(0.0), time_step(0.0)], heights, strict=True)
    ]
    episode = functools.reduce(accumulate, steps, begin(steps[0], measure=names))
    computed = summarise(jax.tree.map(lambda leaf: leaf[None], episode), SUCCESS)
    assert [computed[name] for name in names] == [-3.0, -1.0, -5.0, -5.0]
    assert {*computed} == {*METRICS, *names}
