"""The end of a run: `results.json`, the policy files, and the table that is printed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxsafe.environment import Environment
from jaxsafe.evaluate.seeds import given_up, metrics_over_seeds
from jaxsafe.metrics import Episode, interaction_efficiency, over_seeds
from jaxsafe.origin import versions
from jaxsafe.train.config import TrainConfig
from jaxsafe.train.files import read_json, write_json
from jaxsafe.train.loop import Training
from jaxsafe.train.policy import save_policy

_ROWS = (
    ("success_rate", "success rate", "%"),
    ("average_return", "average return", ""),
    ("episode_length", "episode length [steps]", ""),
    ("control_usage", "control usage Δv [m/s]", ""),
    ("control_usage_l1", "control usage Δv, L1 [m/s]", ""),
    ("safety_violation_rate", "episodes with a violation", "%"),
    ("episode_safety_violation_rate", "violating steps", "%"),
    ("episode_cost", "violating steps per episode", ""),
    ("episode_violation_severity_mean", "violation severity, mean", "%"),
    ("episode_violation_severity_max", "violation severity, max", "%"),
    ("intervention_rate", "steps with an intervention", "%"),
)


def finish(training: Training) -> dict[str, Any]:
    """Evaluate, write policies and results, and return the results."""
    config, env, name = training.config, training.env, training.name
    with training.clock:
        episodes = training.evaluate_finally()
    for index, params in enumerate(training.params()):
        about = {"env": name, "preset": config.preset, "seed": config.seed + index, "step": training.step}
        save_policy(training.run / "policy" / f"seed_{config.seed + index}.npz", env, config.agent, params, about)
    results = {
        **facts(config, name),
        "steps": training.step,
        "wall_s": round(training.clock.seconds, 2),
        "compile_s": round(training.compile_s, 2),
        "training_computation_time": training.log.rows[-1]["wall_s"],  # [s] to the last update, and all before it
        "versions": versions(),
        "interaction_efficiency": _efficiency(training),
        "training_cost": over_seeds(training.log.curve("cost")[1][-1].tolist()),  # violating steps
        "evaluation": evaluation(env, episodes),
        **given_up(env, episodes),
    }
    write_json(training.run / "results.json", results)
    return results


def facts(config: TrainConfig, name: str) -> dict[str, Any]:
    """What every result says about the run that it belongs to."""
    return {"env": name, "preset": config.preset, "seeds": config.seeds, "seed": config.seed}


def evaluation(env: Environment, episodes: dict[str, Episode]) -> dict[str, Any]:
    """The metrics of each kind of evaluation."""
    return {kind: metrics_over_seeds(env, one) for kind, one in episodes.items()}


def table(results: dict[str, Any], path: Path) -> str:
    """The results as text: a column for each kind, mean and 95 % interval over seeds."""
    found = results["evaluation"]
    count = results["seeds"]
    lines = [
        f"{results['env']}, preset {results['preset']}, {count} seed{'s' * (count != 1)}, {results['steps']:,} steps each"
    ]
    lines += ["", f"{'':28}" + "".join(f"{kind:>26}" for kind in found)]
    for name, label, unit in _ROWS:
        if all(one[name]["mean"] is not None for one in found.values()):
            lines.append(f"{label:28}" + "".join(f"{_cell(one[name], unit):>26}" for one in found.values()))
    worst = {kind: min(one["success_rate"]["per_seed"]) for kind, one in found.items()}
    lines.append(f"{'worst seed, success rate':28}" + "".join(f"{value:>26.1%}" for value in worst.values()))
    if "given_up" in results:
        counts, limit = results["given_up"], results["given_up"]["after_steps"]
        told = ", ".join(f"{counts[kind]:,} {kind}" for kind in found)
        lines.append(f"episodes still running after {limit:,} steps, given up and counted as failures: {told}")
    if "interaction_efficiency" in results:
        steps = results["interaction_efficiency"]["timesteps"]
        lines += ["", f"80 % training success after {steps:,} steps" if steps else "80 % training success not reached"]
        lines += [f"{results['wall_s']:.1f} s in total, {results['compile_s']:.1f} s of it compiling the training"]
    return "\n".join([*lines, f"results in {path}"])


def summary(runs: Mapping[str, Path]) -> str:
    """A line for each of several runs, by name: success after training, and violating steps during and after it."""
    heads = (
        "steps", "80 % after", "stochastic", "deterministic", "worst seed", "cost/episode", "cost of training", "wall [s]",
    )  # fmt: skip
    lines = [" " * 20 + "".join(f"{head:>17}" for head in heads)]
    for name, run in runs.items():
        results = read_json(run / "results.json")
        found = [results["evaluation"][kind] for kind in ("stochastic", "deterministic")]
        success = [one["success_rate"] for one in found]
        reached = results["interaction_efficiency"]["timesteps"]
        lines.append(
            f"{name:20}{results['steps']:>17,}{f'{reached:,}' if reached else 'never':>17}"
            f"{success[0]['mean']:>17.2%}{success[1]['mean']:>17.2%}"
            f"{min(min(one['per_seed']) for one in success):>17.1%}{found[0]['episode_cost']['mean']:>17.2f}"
            f"{results['training_cost']['mean']:>17,.0f}{results['wall_s']:>17.1f}"
        )
    return "\n".join(lines)


def _efficiency(training: Training) -> dict[str, Any]:
    steps, success = training.log.curve("success_rate")
    return interaction_efficiency(steps, success, training.log.curve("episodes")[1])


def _cell(metric: dict[str, Any], unit: str) -> str:
    low, high = metric["ci95"]
    if unit == "%":
        return f"{100 * metric['mean']:.2f} [{100 * low:.2f}, {100 * high:.2f}] %"
    return f"{metric['mean']:.2f} [{low:.2f}, {high:.2f}]"
