"""The end of a run: `results.json`, the policy files, and the table that is printed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxsafe.agents.policy_file import save_policy
from jaxsafe.environment import Environment, filter_name
from jaxsafe.envs.identity import identity
from jaxsafe.evaluate.evaluator import EVALUATION_KINDS, given_up, metrics_per_seed
from jaxsafe.metrics import (
    COST_OF,
    ENOUGH_SEEDS,
    METRICS,
    Episode,
    interaction_efficiency,
    over_seeds,
    with_interval,
)
from jaxsafe.storage.files import read_json, write_json
from jaxsafe.storage.forms import (
    AMOUNT,
    COUNT,
    NULL,
    NUMBER,
    OTHERS,
    SHARE,
    TEXT,
    Kind,
    check,
    numbers,
)
from jaxsafe.storage.provenance import versions
from jaxsafe.storage.text_table import columns, or_dash
from jaxsafe.train.host.log import headline
from jaxsafe.train.host.options import TrainConfig
from jaxsafe.train.host.session import Training

_ROWS = (
    ("success_rate", "success rate", "%"),
    ("average_return", "average return", ""),
    ("episode_length", "episode length [steps]", ""),
    ("control_usage", "control usage Δv [m/s]", ""),
    ("control_usage_l1", "control usage Δv, L1 [m/s]", ""),
    ("control_effort", "control, share of full control", "%"),
    ("safety_violation_rate", "episodes with a violation", "%"),
    ("episode_safety_violation_rate", "violating steps", "%"),
    ("episode_cost", "violating steps per episode", ""),
    ("episode_violation_severity_mean", "violation severity, mean", "%"),
    ("episode_violation_severity_p95", "violation severity, 95 % of episodes below", "%"),
    ("episode_violation_severity_p99", "violation severity, 99 % of episodes below", "%"),
    ("episode_violation_severity_max", "violation severity, max", "%"),
    ("intervention_rate", "steps with an intervention", "%"),
)
"""The rows of the table: the name of a metric, its label, and its unit if that is a percentage."""

_METRICS = {
    **{name: AMOUNT for name, *_ in _ROWS},
    "average_return": NUMBER,
    **dict.fromkeys(
        (
            "success_rate",
            "safety_violation_rate",
            "episode_safety_violation_rate",
            "intervention_rate",
        ),
        SHARE,
    ),
}
"""The form of the values of each metric. Every evaluation has these metrics."""

_NEW = (
    "control_effort",
    "episode_violation_severity_p95",
    "episode_violation_severity_p99",
)
"""Metrics that the results of earlier versions lack."""

_OPTIONAL = {
    "algorithm": TEXT,
    "rta": TEXT,
    "task": {"id": TEXT | NULL, "changes": [TEXT]},
    "episodes": COUNT,
    "cases": TEXT,
    "seed_commitment": TEXT,
    "diverged": [{"seed": COUNT, "step": COUNT | NULL}],
    "versions": {OTHERS: TEXT | NULL},
}
"""The form of what some results have, and those of earlier versions lack."""


def finish(training: Training) -> dict[str, Any]:
    """Evaluate a training, write its policies and results, and return the results."""
    config, env, name = training.config, training.env, training.name
    with training.clock:
        episodes = training.evaluate_finally()
    for seed, params in enumerate(training.params(), start=config.seed):
        if seed not in training.diverged:
            about = {"env": name, "preset": config.preset, "seed": seed, "step": training.step}
            save_policy(
                training.run / "policy" / f"seed_{seed}.npz", env, config.agent, params, about
            )
    left_out = [seed - config.seed for seed in training.diverged]
    results = {
        **facts(config, env, name),
        "task": identity(env),
        "steps": training.step,
        "episodes": config.episodes,
        "wall_s": round(training.clock.seconds, 2),
        "compile_s": round(training.compile_s, 2),
        # Seconds spent on everything up to the last update.
        "training_computation_time": training.log.rows[-1]["wall_s"],
        "versions": versions(),
        "interaction_efficiency": _efficiency(training),
        # The number of violating steps in the whole training.
        "training_cost": over_sound_seeds(training.log.curve("cost")[1][-1].tolist(), left_out),
        "evaluation": evaluation(env, episodes, left_out),
        **given_up(env, episodes),
        **diverged_seeds(training.diverged),
    }
    write_json(training.run / "results.json", results)
    return results


def facts(config: TrainConfig, env: Environment, name: str) -> dict[str, Any]:
    """Return what all results say about the run to which they belong."""
    return {
        "env": name,
        "preset": config.preset,
        "algorithm": config.algorithm,
        "rta": filter_name(env),
        "seeds": config.seeds,
        "seed": config.seed,
    }


def evaluation(
    env: Environment, episodes: dict[str, Episode], left_out: Collection[int] = ()
) -> dict[str, Any]:
    """Return the metrics of each kind of evaluation.

    Args:
        env: the environment.
        episodes: the episodes of all seeds, by kind of evaluation.
        left_out: indices of seeds that no average includes. Their values are None.
    """
    per_seed = {kind: metrics_per_seed(env, sums) for kind, sums in episodes.items()}
    return {
        kind: {name: over_sound_seeds(values, left_out) for name, values in metrics.items()}
        for kind, metrics in per_seed.items()
    }


def over_sound_seeds(per_seed: Sequence[float | None], left_out: Collection[int]) -> dict[str, Any]:
    """Return what `over_seeds` returns, without some seeds.

    Args:
        per_seed: the values of all seeds.
        left_out: indices of the seeds to leave out. Their values in `per_seed` become None.
    """
    shown = [None if index in left_out else value for index, value in enumerate(per_seed)]
    sound = [value for index, value in enumerate(per_seed) if index not in left_out]
    return {**over_seeds(sound or [None]), "per_seed": shown}


def diverged_seeds(steps: Mapping[int, int | None]) -> dict[str, Any]:
    """Return the entry of the results about seeds that diverged. It is empty if none has.

    Args:
        steps: for each of these seeds the step by which it had diverged, if that is known.
    """
    entries = [{"seed": seed, "step": step} for seed, step in sorted(steps.items())]
    return {"diverged": entries} if entries else {}


def table(results: dict[str, Any], path: Path) -> str:
    """Return the results as text.

    Each kind of evaluation has a column with means and 95 % intervals over seeds.

    Args:
        results: the results.
        path: the file that holds them.
    """
    evaluations = results["evaluation"]
    lines = [f"{headline(results)}, {results['steps']:,} steps each", ""]
    sound = results["seeds"] - len(results.get("diverged", ()))
    rows = [["mean [95 % interval] over seeds" if sound >= ENOUGH_SEEDS else "", *evaluations]]
    for name, label, unit in _ROWS:
        if all(metrics.get(name, {}).get("mean") is not None for metrics in evaluations.values()):
            rows.append([label, *(_cell(metrics[name], unit) for metrics in evaluations.values())])
    kinds = [*evaluations.values()]
    own = [name for name in kinds[0] if name not in METRICS]
    costs = [name for name in own if name.startswith(COST_OF)]
    # The cost of the only constraint stands in the table already.
    own = [name for name in own if name not in costs or len(costs) > 1]
    own = [name for name in own if all(of_kind[name]["mean"] is not None for of_kind in kinds)]
    rows += [[name, *(_cell(of_kind[name], "") for of_kind in kinds)] for name in own]
    worst = [least([metrics["success_rate"]]) for metrics in evaluations.values()]
    rows.append(["worst seed, success rate", *(percent(rate, 1) for rate in worst)])
    lines += [*columns(rows), *told_diverged(results), *told_violations(results)]
    if "given_up" in results:
        counts = results["given_up"]
        limit = counts["after_steps"]
        listed = ", ".join(f"{counts[kind]:,} {kind}" for kind in evaluations)
        lines.append(
            f"episodes still running after {limit:,} steps, "
            f"given up and counted as failures: {listed}"
        )
    if "interaction_efficiency" in results:
        steps = results["interaction_efficiency"]["timesteps"]
        lines += [
            "",
            f"80 % training success after {steps:,} steps"
            if steps
            else "80 % training success not reached",
        ]
        lines += [
            f"{results['wall_s']:.1f} s in total, "
            f"{results['compile_s']:.1f} s of it compiling the training"
        ]
    return "\n".join([*lines, f"results in {path}"])


def read_results(path: Path) -> dict[str, Any]:
    """Read the `results.json` of a run.

    Raises:
        ConfigError: the file is missing, broken, or not what a run writes.
    """
    results = read_json(path)
    check_results(results, str(path), training=True)
    return results


def check_results(results: Any, place: str, training: bool) -> None:
    """Check the results of a training, or of an evaluation of its policies.

    Args:
        results: what a file holds.
        place: the place of the results, for the message.
        training: whether they are those of a training.

    Raises:
        ConfigError: they have another form.
    """
    form = {
        "env": TEXT,
        "preset": TEXT,
        "seeds": COUNT,
        "seed": COUNT,
        "steps": COUNT,
        "evaluation": {OTHERS: {OTHERS: {}}},
    }
    check(results, form, place)
    check(results, {name: form for name, form in _OPTIONAL.items() if name in results}, place)
    seeds = results["seeds"]
    for kind, metrics in results["evaluation"].items():
        for name, values in _METRICS.items():
            if name in _NEW and name not in metrics:
                continue
            check(metrics.get(name), _metric(seeds, values), f"{place}: evaluation.{kind}.{name}")
    if training:
        form = {
            "evaluation": {kind: {} for kind in EVALUATION_KINDS},
            "wall_s": AMOUNT,
            "compile_s": AMOUNT,
            "interaction_efficiency": {
                "timesteps": COUNT | NULL,
                "per_seed": numbers(seeds, COUNT | NULL),
            },
            "training_cost": _metric(seeds, AMOUNT),
            "versions": {"device": TEXT, OTHERS: TEXT | NULL},
        }
    else:
        form = {"run": TEXT, "checkpoint": TEXT, "evaluation_seed": COUNT | NULL, "changes": {}}
    check(results, form, place)


def _metric(seeds: int, kind: Kind) -> dict[str, Any]:
    """Return the form of a metric over seeds. The values of some seeds may be unknown."""
    unknown = kind | NULL
    return {"mean": unknown, "ci95": numbers(2, kind) | NULL, "per_seed": numbers(seeds, unknown)}


def summary(runs: Mapping[str, Path]) -> str:
    """Return a table of several runs, given their directories by name, with a line for each.

    A line has the success after training, and the violating steps during and after it.

    Raises:
        ConfigError: the results of a run cannot be read.
    """
    heads = (
        "",
        "steps",
        "80 % after",
        *(f"success, {kind}" for kind in EVALUATION_KINDS),
        "worst seed",
        "violating steps/episode",
        "violating steps in training",
        "wall [s]",
        "algorithm",
        "rta",
    )
    rows: list[Sequence[str]] = [heads]
    diverged: list[str] = []
    for name, run in runs.items():
        results = read_results(run / "results.json")
        evaluations = [results["evaluation"][kind] for kind in EVALUATION_KINDS]
        success = [metrics["success_rate"] for metrics in evaluations]
        reached = results["interaction_efficiency"]["timesteps"]
        cost = evaluations[0]["episode_cost"]["mean"]
        diverged += [f"{name}: {line}" for line in told_diverged(results)]
        rows.append(
            (
                name,
                f"{results['steps']:,}",
                f"{reached:,}" if reached else "never",
                *(percent(rate["mean"], 2) for rate in success),
                percent(least(success), 1),
                or_dash(cost, ".2f"),
                or_dash(results["training_cost"]["mean"], ",.0f"),
                f"{results['wall_s']:.1f}",
                # Results of older versions have neither of these.
                str(results.get("algorithm", "–")),
                str(results.get("rta", "–")),
            )
        )
    return "\n".join([*columns(rows), *diverged])


def told_diverged(results: Mapping[str, Any]) -> list[str]:
    """Return a line that names the seeds that diverged and says that no average includes them.

    Return no line if none diverged.
    """
    diverged = results.get("diverged", [])
    if not diverged:
        return []
    steps = ", ".join(
        f"{entry['seed']}" + (f" by step {entry['step']:,}" if entry["step"] else "")
        for entry in diverged
    )
    return [f"DIVERGED, and left out of the averages: seed{'s' * (len(diverged) > 1)} {steps}"]


def told_violations(results: Mapping[str, Any]) -> list[str]:
    """Return lines about the violating steps while training and after it.

    Return no line if the environment has no safety constraints.
    """
    kinds = results["evaluation"].items()
    rates = {kind: metrics["episode_safety_violation_rate"]["mean"] for kind, metrics in kinds}
    if any(rate is None for rate in rates.values()):
        return []
    rta = results.get("rta", "none")
    line = f"violating steps {'without a filter' if rta == 'none' else f'with the filter {rta}'}: "
    cost = results.get("training_cost", {}).get("mean")
    if cost is not None:
        share = 100.0 * cost / max(results["steps"], 1)
        line += f"{share:.2f} % while training ({cost:,.0f} per seed); after it "
    line += ", ".join(f"{100.0 * rate:.2f} % {kind}" for kind, rate in rates.items())
    lines = ["", line]
    episodes = {kind: metrics["safety_violation_rate"]["mean"] for kind, metrics in kinds}
    if episodes.get("stochastic", 0.0) > episodes.get("deterministic", 0.0):
        lines += [
            "Stochastic actions are sampled, as in training. Now and then their noise carries a",
            "policy that flies along a limit across it, so more episodes have a violation, though",
            "of few steps. Deterministic actions are the most probable ones.",
        ]
    return lines


def least(metrics: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the smallest known value of any seed in several metrics, or None if there is none."""
    return min(
        (value for metric in metrics for value in metric["per_seed"] if value is not None),
        default=None,
    )


def percent(value: float | None, digits: int) -> str:
    """Return a share as text in percent, or a dash if it is None."""
    return or_dash(value, f".{digits}%")


def mean_text(metric: Mapping[str, Any], form: str, factor: float = 1.0) -> str:
    """Return the mean of a metric with its interval as text, both multiplied by a factor."""
    interval = metric["ci95"] and [factor * bound for bound in metric["ci95"]]
    return with_interval(factor * metric["mean"], interval, form)


def _efficiency(training: Training) -> dict[str, Any]:
    steps, success = training.log.curve("success_rate")
    return interaction_efficiency(steps, success, training.log.curve("episodes")[1])


def _cell(metric: Mapping[str, Any], unit: str) -> str:
    if unit == "%":
        return f"{mean_text(metric, '.2f', 100.0)} %"
    return mean_text(metric, ".2f")
