"""What the page says about a run beyond the metrics of its episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jaxsafe.evaluate.evaluator import EVALUATION_KINDS
from jaxsafe.metrics import ENOUGH_EPISODES, interaction_efficiency
from jaxsafe.plot.curves import curve_table


def failed_seeds(results: Mapping[str, Any]) -> list[int]:
    """Return the seeds of a run that failed.

    After training, a failed seed succeeds in less than 95 % of its stochastic or of its
    deterministic episodes. A seed whose success is not known has failed.
    """
    rates = [results["evaluation"][kind]["success_rate"]["per_seed"] for kind in EVALUATION_KINDS]
    pairs = enumerate(zip(*rates, strict=True), start=results["seed"])
    return [seed for seed, pair in pairs if any(rate is None or rate < 0.95 for rate in pair)]


def finished(curves: Sequence[Mapping[str, Any]], step: int) -> float:
    """Return how many training episodes a seed had finished by a step, on average."""
    latest = max(row["step"] for row in curves if row["step"] <= step)
    counts = [row["episodes"] for row in curves if row["step"] == latest]
    return sum(counts) / len(counts)


def steps_to(
    level: float, curves: Sequence[Mapping[str, Any]], at_least: int = ENOUGH_EPISODES
) -> int | None:
    """Return the environment steps per seed until the success rate in training reaches a level.

    This is the definition of Table 2.

    Args:
        level: the success rate, on average over seeds.
        curves: rows of the progress log.
        at_least: episodes that every seed must have finished.
    """
    steps, rates = curve_table(curves, "step", "success_rate", most=len(curves))
    _, episodes = curve_table(curves, "step", "episodes", most=len(curves))
    return interaction_efficiency(steps, rates, episodes, level, at_least)["timesteps"]


def wall_to(level: float, curves: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the seconds until the success rate in training reaches a level.

    This is the definition of Table 2.
    """
    reached = steps_to(level, curves)
    return (
        None if reached is None else max(row["wall_s"] for row in curves if row["step"] == reached)
    )


def samples_per_second(curves: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the environment steps of all seeds per second of wall time.

    They are counted from the first time in the log to the last. Updates that ran as one program
    have the time of its end. Return None if the log has only one time.
    """
    times = [pick(row["wall_s"] for row in curves) for pick in (min, max)]
    steps = [max(row["step"] for row in curves if row["wall_s"] == time) for time in times]
    seeds = len({row["seed"] for row in curves})
    return seeds * (steps[1] - steps[0]) / (times[1] - times[0]) if times[1] > times[0] else None
