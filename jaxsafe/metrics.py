"""The metrics of Section 5 of the paper, from running sums over any stream of time steps.

`accumulate` follows one episode step by step, and `summarise` turns finished episodes into metrics.

Two of them differ from the paper. `episode_cost`, the number of violating steps of an episode, is
what constrained RL calls cost. The safety violation rate is the share of tests with a violation.
The paper defines it as the share *without* one, and yet calls lower better.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsafe.environment import Environment
from jaxsafe.types import Record, TimeStep

SAFETY_METRICS = (
    "safety_violation_rate",
    "episode_safety_violation_rate",
    "episode_cost",
    "episode_violation_severity_mean",
    "episode_violation_severity_p95",
    "episode_violation_severity_p99",
    "episode_violation_severity_max",
)
"""The metrics that only an environment with safety constraints has."""

METRICS = (
    "average_return",
    "episode_length",
    "success_rate",
    "control_usage",
    "control_usage_l1",
    "control_effort",
    *SAFETY_METRICS,
    "mean_reward",
    "intervention_rate",
)
"""The names that `summarise` returns."""

COST_OF = "episode_cost/"
"""Beginning of the names of the costs by constraint, which end in the constraint's name."""

OVER_STEPS = ("mean", "maximum", "minimum", "final")
"""What a metric of one's own takes of a status over the steps of an episode."""

ENOUGH_EPISODES = 20
"""Training episodes that a seed must finish before its success rate counts in Table 2."""

ENOUGH_SEEDS = 3
"""The least number of seeds for which an interval over seeds says something.

Resampling one seed has no spread, and two seeds give their own values.
"""

RATE_TOLERANCE = 1e-6
"""A success rate, or an average of rates, this close below a threshold has reached it.

Rates and their averages are rounded.
"""

MIN_STEPS = 1e-9
"""The least number of steps by which a sum is divided, so that the result without steps is 0."""

NUM_RESAMPLES = 2000
"""Number of bootstrap samples."""


class Episode(Record):
    """Sums over one episode so far."""

    episode_return: Float[Array, ""]
    length: Int[Array, ""]  # steps
    outcome: Int[Array, ""]  # index into `env.outcomes`, 0 while running
    delta_v: Float[Array, ""]  # Σ ‖u/m‖₂ Δt [m/s], 0 where the task has no Δv
    delta_v_l1: Float[Array, ""]  # Σ ‖u/m‖₁ Δt [m/s], 0 where the task has no Δv
    violating_steps: Int[Array, ""]  # steps with h < 0
    severity_sum: Float[Array, ""]  # Σ max(0, −h)/limit
    severity_max: Float[Array, ""]
    interventions: Int[Array, ""]  # steps on which run time assurance changed the control
    # Σ of the mean of |u| over the controls, each as a share of its full magnitude; 0 where the
    # full magnitudes are not known.
    control_effort: Float[Array, ""]
    reward_totals: Mapping[str, Float[Array, ""]]  # Σ of each reward term
    # Σ of the cost of each constraint that is followed, by its name; empty where none is.
    costs: Mapping[str, Float[Array, ""]] = dataclasses.field(default_factory=dict)
    # Each of `Environment.measure` so far, a sum where the mean is asked for; empty without any.
    measured: Mapping[str, Float[Array, ""]] = dataclasses.field(default_factory=dict)


def begin(
    timestep: TimeStep,
    cost_names: Sequence[str] = (),
    measure: Sequence[str] = (),
) -> Episode:
    """Return the sums at the start of an episode: all zero, in the shapes of `timestep`.

    Args:
        timestep: the first time step.
        cost_names: the constraints whose costs are summed up too.
        measure: the metrics of one's own, as `Environment.measure`.
    """
    zero = jnp.zeros_like(timestep.reward)
    count = jnp.zeros(timestep.reward.shape, jnp.int32)
    return Episode(
        episode_return=zero,
        length=count,
        outcome=count,
        delta_v=zero,
        delta_v_l1=zero,
        violating_steps=count,
        severity_sum=zero,
        severity_max=zero,
        interventions=count,
        control_effort=zero,
        reward_totals=jax.tree.map(jnp.zeros_like, timestep.info.reward_totals),
        costs=dict.fromkeys(cost_names, zero),
        measured=dict.fromkeys(measure, zero),
    )


def accumulate(
    episode: Episode, timestep: TimeStep, full_controls: Sequence[Array] = ()
) -> Episode:
    """Add one time step to the sums of an episode.

    Args:
        episode: the sums so far.
        timestep: the time step.
        full_controls: the largest magnitude of each control, as `full_controls` returns them.
            Without them `control_effort` stays 0.
    """
    info = timestep.info
    no_severity = jnp.zeros_like(timestep.reward)
    severity = jnp.max(jnp.stack([*info.severity.values(), no_severity]), axis=0)
    return Episode(
        episode_return=episode.episode_return + timestep.reward,
        length=episode.length + 1,
        outcome=info.outcome,
        delta_v=episode.delta_v + info.status.get("delta_v", 0.0),
        delta_v_l1=episode.delta_v_l1 + info.status.get("delta_v_l1", 0.0),
        violating_steps=episode.violating_steps + (timestep.cost > 0.0).astype(jnp.int32),
        severity_sum=episode.severity_sum + severity,
        severity_max=jnp.maximum(episode.severity_max, severity),
        interventions=episode.interventions + info.intervening.astype(jnp.int32),
        control_effort=episode.control_effort + _effort(info.control_actual, full_controls),
        reward_totals=info.reward_totals,
        costs={name: total + timestep.costs[name] for name, total in episode.costs.items()},
        measured={
            name: _measured(name, before, episode.length, info.status)
            for name, before in episode.measured.items()
        },
    )


def _effort(controls: Float[Array, "... m"], full_controls: Sequence[Array]) -> Any:
    """Return the mean magnitude of some controls, each as a share of its full magnitude."""
    # A sum written out keeps the loop over environments free of a reduction.
    shares = [jnp.abs(controls[..., i]) / full for i, full in enumerate(full_controls)]
    return sum(shares) / max(len(shares), 1)


def _measured(
    name: str, before: Array, length: Array, status: Mapping[str, Array]
) -> Float[Array, ...]:
    """Return a metric of one's own after a step, from what it was after `length` steps."""
    source, _, over_steps = name.rpartition(".")
    value = status[source].astype(before.dtype)
    follow = {"mean": jnp.add, "maximum": jnp.maximum, "minimum": jnp.minimum}
    if over_steps == "final":
        return value
    return jnp.where(length == 0, value, follow[over_steps](before, value))


def metrics_of(env: Environment) -> tuple[str, ...]:
    """Return the names of all metrics of an environment.

    They are `METRICS`, the cost of each safety constraint by its name, and the metrics of one's
    own.
    """
    costs = [f"{COST_OF}{constraint.name}" for constraint in env.constraints]
    return (*METRICS, *costs, *env.measure)


def over_episode(name: str, measured: Any, length: Any) -> Any:
    """Return a metric of one's own over whole episodes: a sum becomes a mean.

    Args:
        name: its name.
        measured: what `Episode.measured` has of it.
        length: the number of steps of each episode.
    """
    return measured / length if name.endswith(".mean") else measured


def measures(env: Environment) -> dict[str, bool]:
    """Return what an environment measures, as keyword arguments of `summarise`."""
    statuses = {status.name for status in env.status}
    return {
        "has_delta_v": "delta_v" in statuses,
        "has_delta_v_l1": "delta_v_l1" in statuses,
        "has_constraints": bool(env.constraints),
        "has_rta": env.rta is not None,
        "has_controls": bool(env.actuators),
    }


def full_controls(env: Environment) -> tuple[Array, ...]:
    """Return the largest magnitude of each control, in the order of the action.

    It is 1 for a control that is always 0, and there are none if the agent's controller lists no
    actuators.
    """
    largest = [
        jnp.maximum(jnp.abs(actuator.low), jnp.abs(actuator.high)) for actuator in env.actuators
    ]
    return tuple(jnp.where(value > 0.0, value, 1.0) for value in largest)


def metrics_in(env: Environment, episodes: Episode) -> dict[str, float | None]:
    """Return the metrics over a set of finished episodes of an environment, as `summarise` does."""
    return summarise(episodes, env.success_indices, **measures(env))


def summarise(
    episodes: Episode,
    success: int | Sequence[int],
    has_delta_v: bool = True,
    has_rta: bool = False,
    has_delta_v_l1: bool | None = None,
    has_constraints: bool = True,
    has_controls: bool = False,
) -> dict[str, float | None]:
    """Return the metrics over a set of finished episodes.

    A metric that the environment does not measure is None, never 0.

    Args:
        episodes: sums of the episodes, each field of shape (episodes,).
        success: index of the outcome that counts as success, or of several, as
            `env.success_indices`. A negative index and an empty list mean that there is none.
        has_delta_v: whether the environment has the status `delta_v`, from which control usage
            comes.
        has_rta: whether there was run time assurance. Then its interventions are counted.
        has_delta_v_l1: whether the environment has the status `delta_v_l1`. None means that it does
            if it has `delta_v`.
        has_constraints: whether the environment has safety constraints. Then their violations are
            counted.
        has_controls: whether the full magnitudes of the controls were known. Then their effort was
            summed.

    Returns:
        A value for every name of `METRICS`, the mean cost `episode_cost/NAME` of an episode for
        each constraint that was followed, and each metric of one's own, which is a mean over
        episodes. Rates are fractions in [0, 1], Δv is in m/s, length in
        steps. `control_effort` is the mean magnitude of the controls that acted, each as a share of
        its full magnitude, over controls and steps. Severity is a share of the limit. Its mean is
        over violating steps, and 0 if there are none. Its percentiles p95 and p99 are over
        episodes, of the largest severity of each. A value that is not finite is None too.
    """
    mean = {
        name: float(np.mean(value))
        for name, value in vars(episodes).items()
        if name not in ("reward_totals", "costs", "measured")
    }
    successes = np.atleast_1d(np.asarray(success, int))
    violating = mean["violating_steps"]
    p95, p99 = np.percentile(np.asarray(episodes.severity_max), (95, 99), method="higher")
    steps = mean["length"]
    values = {
        "average_return": mean["episode_return"],
        "episode_length": steps,
        "success_rate": float(np.mean(np.isin(episodes.outcome, successes))),
        "control_usage": mean["delta_v"],
        "control_usage_l1": mean["delta_v_l1"],
        "control_effort": mean["control_effort"] / max(steps, MIN_STEPS),
        "safety_violation_rate": float(np.mean(np.asarray(episodes.violating_steps) > 0)),
        "episode_safety_violation_rate": violating / max(steps, MIN_STEPS),
        "episode_cost": violating,
        "episode_violation_severity_mean": mean["severity_sum"] / violating if violating else 0.0,
        "episode_violation_severity_p95": float(p95),
        "episode_violation_severity_p99": float(p99),
        "episode_violation_severity_max": float(np.max(episodes.severity_max)),
        "mean_reward": mean["episode_return"] / max(steps, MIN_STEPS),
        "intervention_rate": mean["interventions"] / max(steps, MIN_STEPS),
        **{
            f"{COST_OF}{name}": float(np.mean(np.asarray(cost, float)))
            for name, cost in episodes.costs.items()
        },
        **{
            name: float(np.mean(over_episode(name, value, np.maximum(episodes.length, 1))))
            for name, value in episodes.measured.items()
        },
    }
    measured = {
        "success_rate": bool((successes >= 0).any()),
        "control_usage": has_delta_v,
        "control_usage_l1": has_delta_v if has_delta_v_l1 is None else has_delta_v_l1,
        "control_effort": has_controls,
        "intervention_rate": has_rta,
        **dict.fromkeys(SAFETY_METRICS, has_constraints),
    }
    return {
        name: value if measured.get(name, True) and np.isfinite(value) else None
        for name, value in values.items()
    }


def interaction_efficiency(
    steps: np.ndarray,
    success: np.ndarray,
    episodes: np.ndarray,
    threshold: float = 0.8,
    at_least: int = ENOUGH_EPISODES,
) -> dict[str, Any]:
    """Return the first environment step at which success in training reaches a threshold, Table 2.

    Args:
        steps: environment steps taken by each seed, shape (updates,).
        success: success rate of each seed over its last 100 finished episodes, shape (updates,
            seeds).
        episodes: number of episodes that each seed has finished, shape (updates, seeds).
        threshold: the success rate to reach, as an average over seeds.
        at_least: number of episodes that a seed must have finished before its rate counts.

    Returns:
        `timesteps`, the steps of each seed until the average over seeds reaches the threshold, and
        `per_seed`, the steps until each seed reaches it. They are None where it is never reached.
    """

    def first(reached: np.ndarray) -> int | None:
        return int(steps[np.argmax(reached)]) if reached.any() else None

    enough = episodes >= at_least
    rate = np.where(enough, np.nan_to_num(np.asarray(success, float)), 0.0)
    threshold -= RATE_TOLERANCE
    average_reached = enough.all(axis=1) & (rate.mean(axis=1) >= threshold)
    reached = enough & (rate >= threshold)
    return {
        "timesteps": first(average_reached),
        "per_seed": [first(reached[:, seed]) for seed in range(rate.shape[1])],
    }


def over_seeds(per_seed: list[float | None]) -> dict[str, Any]:
    """Return mean, interquartile mean and interval of one value for each seed, and the values.

    The interval is the 95 % percentile-bootstrap interval over seeds. It is None for fewer than
    `ENOUGH_SEEDS`. Without a value for every seed, all but the values are None.
    """
    if any(value is None for value in per_seed):
        return {"mean": None, "ci95": None, "iqm": None, "per_seed": per_seed}
    from scipy.stats import trim_mean

    values = np.asarray(per_seed, float)
    interval = None
    if len(values) >= ENOUGH_SEEDS:
        interval = bootstrap_interval(values[None])[:, 0].tolist()
    return {
        "mean": float(values.mean()),
        "ci95": interval,
        "iqm": float(trim_mean(values, 0.25)),
        "per_seed": [float(value) for value in values],
    }


def stratified_iqm(scores: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Return the interquartile mean over all runs of all tasks, with its 95 % bootstrap interval.

    The interquartile mean is the mean of the middle half of all scores. The bootstrap is
    stratified: each task's runs are resampled among themselves (Agarwal et al. 2021). The interval
    is None where a task has fewer than `ENOUGH_SEEDS` runs.

    Args:
        scores: for each task, a sequence of the scores of its runs.
    """
    from scipy.stats import trim_mean

    generator = np.random.default_rng(0)
    tasks = [np.asarray(task_scores, float) for task_scores in scores]
    drawn = [
        task_scores[generator.integers(len(task_scores), size=(NUM_RESAMPLES, len(task_scores)))]
        for task_scores in tasks
    ]
    interval = None
    if min(map(len, tasks)) >= ENOUGH_SEEDS:
        means = trim_mean(np.concatenate(drawn, axis=1), 0.25, axis=1)
        interval = np.percentile(means, [2.5, 97.5]).tolist()
    return {"iqm": float(trim_mean(np.concatenate(tasks), 0.25)), "ci95": interval}


def with_interval(value: float, interval: Sequence[float] | None, form: str) -> str:
    """Return a number as text, with the interval in which it lies if there is one.

    Args:
        value: the number.
        interval: its lowest and highest value, or None.
        form: a format for numbers. With `.1f` the text is, for instance, `0.5 [0.4, 0.6]`.
    """
    if interval is None:
        return format(value, form)
    low, high = interval
    return f"{value:{form}} [{low:{form}}, {high:{form}}]"


def bootstrap_interval(values: np.ndarray) -> np.ndarray:
    """Return the 95 % percentile-bootstrap interval of the mean over the last axis.

    Args:
        values: shape (rows, seeds).

    Returns:
        The lowest and the highest value of each row, shape (2, rows).
    """
    num_seeds = values.shape[-1]
    draws = np.random.default_rng(0).integers(num_seeds, size=(NUM_RESAMPLES, num_seeds))
    return np.percentile(values[:, draws].mean(axis=-1), [2.5, 97.5], axis=-1)
