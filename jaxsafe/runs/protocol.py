"""What a result on a task must report, and which of it a run has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxsafe.envs.task import default_filter
from jaxsafe.evaluate.evaluator import EVALUATION_KINDS
from jaxsafe.evaluate.hidden_seed import HiddenSeed
from jaxsafe.storage.files import read_json
from jaxsafe.train.host.results import check_results

SEEDS = 10
"""Least number of training seeds."""

EPISODES = 1000
"""Least number of episodes of each seed."""


class Finding(NamedTuple):
    """One of the things that the protocol asks for, and whether a result has it."""

    what: str
    reported: bool
    detail: str
    """What the result says about it, or how to get it."""


def read_all(place: str) -> list[dict[str, Any]]:
    """Return the results of a run and of the evaluations in it, or those of a single file.

    Args:
        place: a run directory, or a `results.json`.

    Raises:
        ConfigError: there are no results, or they cannot be read.
    """
    path = Path(place)
    files = [path]
    if path.is_dir():
        files = [path / "results.json", *sorted(path.glob("evaluations/*/results.json"))]
    found = []
    for number, file in enumerate(files):
        results = read_json(file)
        check_results(results, str(file), training=path.is_dir() and number == 0)
        found.append(results)
    return found


def findings(
    results: Mapping[str, Any], others: Sequence[Mapping[str, Any]], run: str = "RUN"
) -> list[Finding]:
    """Return what the protocol asks for, each with whether it is there.

    Args:
        results: the results of a training, or of an evaluation.
        others: the results of further evaluations of the same policies.
        run: the run that the commands to type shall name.
    """
    name = str(results.get("env", "TASK"))
    task = results.get("task", {"id": None, "changes": []})
    changes = f", with other {', '.join(task['changes'])}" if task["changes"] else ""
    sound = results["seeds"] - len(results.get("diverged", ()))
    episodes = results.get("episodes", 0)
    metrics = results["evaluation"].values()
    intervals = all(of_kind["success_rate"]["ci95"] is not None for of_kind in metrics)
    tails = [of_kind.get("episode_violation_severity_p99", {}) for of_kind in metrics]
    tail = all(severity.get("mean") is not None for severity in tails)
    alike = [results, *(other for other in others if other.get("task") == task)]
    filters = sorted({str(each.get("rta", "none")) for each in alike})
    other_filter = "default" if filters == ["none"] else "none"
    starts = any(each.get("cases") == name for each in alike)
    cost = results.get("training_cost", {}).get("mean")
    versions = results.get("versions", {})
    machine = [str(versions.get(key, "unknown")) for key in ("jaxsafe", "jax", "device")]
    return [
        Finding(
            "the task as it is",
            task["id"] is not None and not changes,
            f"{task['id']}{changes}" if task["id"] else "no task of jaxsafe",
        ),
        Finding(
            f"{SEEDS} seeds or more, none diverged",
            results["seeds"] == sound >= SEEDS,
            f"{sound} of {results['seeds']} seeds"
            + ("" if sound >= SEEDS else f"; train with seeds={SEEDS}"),
        ),
        Finding(
            f"{EPISODES:,} episodes per seed or more",
            episodes >= EPISODES,
            f"{episodes:,} episodes"
            + ("" if episodes >= EPISODES else f"; train with episodes={EPISODES}"),
        ),
        Finding(
            "deterministic and sampled actions",
            {*EVALUATION_KINDS} <= {*results["evaluation"]},
            ", ".join(results["evaluation"]),
        ),
        Finding(
            "95 % intervals over seeds",
            intervals,
            "there" if intervals else "too few seeds for them",
        ),
        Finding(
            "the tail of the severity of violations",
            tail,
            "95 and 99 % of episodes" if tail else "evaluate again with this version",
        ),
        Finding(
            "with and without a filter",
            len(filters) > 1 or default_filter(name) is None,
            ", ".join(filters)
            if len(filters) > 1
            else f"only rta={filters[0]}; jaxsafe evaluate {run} rta={other_filter}",
        ),
        Finding(
            "the fixed starts of the task",
            starts,
            "there" if starts else f"jaxsafe evaluate {run} cases={name}",
        ),
        Finding(
            "steps and violating steps of the training",
            cost is not None,
            f"{results['steps']:,} and {cost:,.0f} per seed"
            if cost is not None
            else "unknown; give the run directory",
        ),
        Finding("versions and the machine", bool(versions), ", ".join(machine)),
    ]


def committed(results: Sequence[Mapping[str, Any]], hidden: HiddenSeed) -> Finding:
    """Return whether the results with a hidden seed are committed to this one.

    Args:
        results: results, of which some may have a commitment.
        hidden: the seed, which is no longer hidden.
    """
    found = [each["seed_commitment"] for each in results if "seed_commitment" in each]
    wrong = next((each for each in found if each != hidden.commitment), None)
    detail = f"{hidden.seed}, as committed in {len(found)} of {len(results)} results"
    if not found:
        detail = "no result has a commitment; evaluate with hidden_seed=FILE"
    elif wrong is not None:
        detail = f"the file has the commitment {hidden.commitment}, a result has {wrong}"
    return Finding("the hidden seed", bool(found) and wrong is None, detail)
