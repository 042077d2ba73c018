"""The metrics of Section 5 of the paper, from running sums over any stream of time steps.

`accumulate` follows one episode step by step; `summarise` turns finished episodes into the paper's metrics.
`episode_cost`, the violating steps of an episode, is not the paper's but what constrained RL calls cost.
The paper defines the safety violation rate as the share of tests *without* a violation and calls lower better; here it is
the share with one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsafe.environment import Environment
from jaxsafe.types import Record, TimeStep

METRICS = (
    "average_return",
    "episode_length",
    "success_rate",
    "control_usage",
    "control_usage_l1",
    "safety_violation_rate",
    "episode_safety_violation_rate",
    "episode_cost",
    "episode_violation_severity_mean",
    "episode_violation_severity_max",
    "mean_reward",
    "intervention_rate",
)
"""The names that `summarise` returns."""

SAFETY_METRICS = (
    "safety_violation_rate",
    "episode_safety_violation_rate",
    "episode_cost",
    "episode_violation_severity_mean",
    "episode_violation_severity_max",
)
"""The metrics that only an environment with safety constraints has."""

ENOUGH_EPISODES = 20
"""Training episodes that a seed must have finished before its success rate counts for interaction efficiency."""

ENOUGH_SEEDS = 3
"""Below this an interval over seeds would say nothing: resampling one seed has no spread, and two give their own values."""

ROUNDING = 1e-6
"""Of success rates and their averages: what is so close below a threshold has reached it."""


class Episode(Record):
    """Sums over one episode so far."""

    episode_return: Float[Array, ""]
    length: Int[Array, ""]  # steps
    outcome: Int[Array, ""]  # index into `env.outcomes`, 0 while running
    delta_v: Float[Array, ""]  # Σ ‖u/m‖₂ Δt [m/s], 0 where the task has no Δv
    delta_v_l1: Float[Array, ""]  # Σ ‖u/m‖₁ Δt [m/s]
    violating_steps: Int[Array, ""]  # steps with h < 0
    severity_sum: Float[Array, ""]  # Σ max(0, −h)/limit
    severity_max: Float[Array, ""]
    interventions: Int[Array, ""]  # steps on which run time assurance changed the control
    reward_totals: Mapping[str, Float[Array, ""]]  # Σ of each reward term


def begin(timestep: TimeStep) -> Episode:
    """Sums at the start of an episode: all zero, in the shapes of `timestep`."""
    zero, count = jnp.zeros_like(timestep.reward), jnp.zeros(timestep.reward.shape, jnp.int32)
    totals = jax.tree.map(jnp.zeros_like, timestep.info.reward_totals)
    return Episode(zero, count, count, zero, zero, count, zero, zero, count, totals)


def accumulate(episode: Episode, timestep: TimeStep) -> Episode:
    """Add one step."""
    info = timestep.info
    severity = jnp.max(jnp.stack([*info.severity.values(), jnp.zeros_like(timestep.reward)]), axis=0)
    return Episode(
        episode.episode_return + timestep.reward,
        episode.length + 1,
        info.outcome,
        episode.delta_v + info.status.get("delta_v", 0.0),
        episode.delta_v_l1 + info.status.get("delta_v_l1", 0.0),
        episode.violating_steps + (timestep.cost > 0.0).astype(jnp.int32),
        episode.severity_sum + severity,
        jnp.maximum(episode.severity_max, severity),
        episode.interventions + info.intervening.astype(jnp.int32),
        info.reward_totals,
    )


def measures(env: Environment) -> dict[str, bool]:
    """Return what an environment measures, as `summarise` asks for it."""
    statuses = {status.name for status in env.status}
    return {
        "has_delta_v": "delta_v" in statuses,
        "has_delta_v_l1": "delta_v_l1" in statuses,
        "has_constraints": bool(env.constraints),
        "has_rta": env.rta is not None,
    }


def summarise(
    episodes: Episode,
    success: int,
    has_delta_v: bool = True,
    has_rta: bool = False,
    has_delta_v_l1: bool | None = None,
    has_constraints: bool = True,
) -> dict[str, float | None]:
    """The metrics over a set of finished episodes. What the environment does not measure is None, never 0.

    Args:
        episodes: sums of the episodes, each field of shape (episodes,).
        success: index of the outcome that counts as success; below 0 there is none.
        has_delta_v: whether the environment has the status `delta_v`, from which control usage comes.
        has_rta: whether there was run time assurance, whose interventions are counted.
        has_delta_v_l1: whether the environment has the status `delta_v_l1`; None is as `has_delta_v`.
        has_constraints: whether the environment has safety constraints, whose violations are counted.

    Returns:
        Every name of `METRICS`: rates as fractions in [0, 1], Δv in m/s, length in steps, severity as a share of the limit
        (mean over violating steps, 0 if there is none). A figure that is not finite is None too.
    """
    mean = {name: float(np.mean(value)) for name, value in vars(episodes).items() if name != "reward_totals"}
    violating, steps = mean["violating_steps"], mean["length"]
    found = {
        "average_return": mean["episode_return"],
        "episode_length": steps,
        "success_rate": float(np.mean(np.asarray(episodes.outcome) == success)),
        "control_usage": mean["delta_v"],
        "control_usage_l1": mean["delta_v_l1"],
        "safety_violation_rate": float(np.mean(np.asarray(episodes.violating_steps) > 0)),
        "episode_safety_violation_rate": violating / max(steps, 1e-9),
        "episode_cost": violating,
        "episode_violation_severity_mean": mean["severity_sum"] / violating if violating else 0.0,
        "episode_violation_severity_max": float(np.max(episodes.severity_max)),
        "mean_reward": mean["episode_return"] / max(steps, 1e-9),
        "intervention_rate": mean["interventions"] / max(steps, 1e-9),
    }
    measured = {
        "success_rate": success >= 0,
        "control_usage": has_delta_v,
        "control_usage_l1": has_delta_v if has_delta_v_l1 is None else has_delta_v_l1,
        "intervention_rate": has_rta,
        **dict.fromkeys(SAFETY_METRICS, has_constraints),
    }
    return {name: value if measured.get(name, True) and np.isfinite(value) else None for name, value in found.items()}


def interaction_efficiency(
    steps: np.ndarray, success: np.ndarray, episodes: np.ndarray, threshold: float = 0.8, at_least: int = ENOUGH_EPISODES
) -> dict[str, Any]:
    """First environment step (per seed) at which success in training reaches a threshold, Table 2.

    Args:
        steps: environment steps taken by each seed, shape (updates,).
        success: success rate of each seed over its last 100 finished episodes, shape (updates, seeds).
        episodes: number of episodes that each seed has finished, shape (updates, seeds).
        threshold: the success rate to reach, on the average over seeds.
        at_least: episodes that a seed must have finished before its rate counts.

    Returns:
        `timesteps` for the seed-averaged curve and `per_seed` for each curve; None where never reached.
    """

    def first(reached: np.ndarray) -> int | None:
        return int(steps[np.argmax(reached)]) if reached.any() else None

    enough = episodes >= at_least
    rate = np.where(enough, np.nan_to_num(np.asarray(success, float)), 0.0)
    threshold -= ROUNDING
    together = enough.all(axis=1) & (rate.mean(axis=1) >= threshold)
    return {
        "timesteps": first(together),
        "per_seed": [first(enough[:, i] & (rate[:, i] >= threshold)) for i in range(rate.shape[1])],
    }


def over_seeds(per_seed: list[float | None]) -> dict[str, Any]:
    """Mean, 95 % percentile-bootstrap interval over seeds, interquartile mean, and the values themselves.

    The interval of fewer than `ENOUGH_SEEDS` is None.
    """
    if any(value is None for value in per_seed):
        return {"mean": None, "ci95": None, "iqm": None, "per_seed": per_seed}
    from scipy.stats import trim_mean

    values = np.asarray(per_seed, float)
    return {
        "mean": float(values.mean()),
        "ci95": bootstrap_interval(values[None])[:, 0].tolist() if len(values) >= ENOUGH_SEEDS else None,
        "iqm": float(trim_mean(values, 0.25)),
        "per_seed": [float(value) for value in values],
    }


def stratified_iqm(scores: Sequence[Sequence[float]], resamples: int = 2000) -> dict[str, Any]:
    """Interquartile mean over all runs of all tasks, with its 95 % stratified-bootstrap interval.

    The mean of the middle half of all scores, where each task's runs are resampled among themselves (Agarwal et al. 2021).
    The interval is None where a task has fewer than `ENOUGH_SEEDS` runs.

    Args:
        scores: a sequence of scores, one for each run, for each task.
        resamples: bootstrap samples.
    """
    from scipy.stats import trim_mean

    generator, tasks = np.random.default_rng(0), [np.asarray(one, float) for one in scores]
    drawn = [one[generator.integers(len(one), size=(resamples, len(one)))] for one in tasks]
    spread = trim_mean(np.concatenate(drawn, axis=1), 0.25, axis=1)
    return {
        "iqm": float(trim_mean(np.concatenate(tasks), 0.25)),
        "ci95": np.percentile(spread, [2.5, 97.5]).tolist() if min(map(len, tasks)) >= ENOUGH_SEEDS else None,
    }


def with_interval(value: float, interval: Sequence[float] | None, form: str) -> str:
    """Return a number, and the interval that it lies in if there is one, as text: `0.5 [0.4, 0.6]`."""
    if interval is None:
        return format(value, form)
    low, high = interval
    return f"{value:{form}} [{low:{form}}, {high:{form}}]"


def bootstrap_interval(values: np.ndarray, resamples: int = 2000) -> np.ndarray:
    """95 % percentile-bootstrap interval of the mean over the last axis: (rows, seeds) to (2, rows)."""
    draws = np.random.default_rng(0).integers(values.shape[-1], size=(resamples, values.shape[-1]))
    return np.percentile(values[:, draws].mean(axis=-1), [2.5, 97.5], axis=-1)
