"""What a result on a task must report, and which of it a submission has.

A submission is a directory with the `results.json` files of the same policies. The directory of a
run is one.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxsafe.envs import STARTERS, TASKS
from jaxsafe.envs.task import default_filter, registered
from jaxsafe.evaluate.evaluator import EVALUATION_KINDS
from jaxsafe.evaluate.hidden_seed import HiddenSeed
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import read_json
from jaxsafe.storage.forms import AMOUNT, COUNT, OTHERS, TEXT, check, numbers
from jaxsafe.train.host.results import check_results, over_sound_seeds

SEEDS = 10
"""Least number of training seeds."""

EPISODES = 1000
"""Least number of episodes of each seed."""

TRAINING = "training.json"
"""The file of a submission that says what a training elsewhere took."""

PLACES = ("results.json", "*/results.json", "evaluations/*/results.json")
"""Where the results of a submission stand in its directory."""

ELSEWHERE = ("unknown", "not trained")
"""The algorithms that results name for policies that were not trained by jaxsafe."""

TRAINING_TERMS = ("reward.intervention",)
"""Changes of a task that make no other task of it.

A training with a filter adds this term to the reward. Only the returns of evaluations include it.
"""

_SAME = (
    "env",
    "task",
    "rta",
    "cases",
    "episodes",
    "evaluation_seed",
    "seed_commitment",
    "algorithm",
    "steps",
    "checkpoint",
    "changes",
)
"""What evaluations of single policies have in common if they become one evaluation."""

Results = Mapping[str, Any]
"""The content of a `results.json`."""


class Finding(NamedTuple):
    """One of the things that the protocol asks for, and whether a result has it."""

    what: str
    reported: bool
    detail: str
    """What the result says about it, or how to get it."""


class Submission(NamedTuple):
    """Results of the same policies."""

    results: Results
    """The results of the training. Without one, those of an evaluation from random starts."""
    others: Sequence[Results] = ()
    """The results of further evaluations."""
    training: Results | None = None
    """What the submitter says about a training elsewhere."""
    run: str = "RUN"
    """The run or the policy that the commands to type shall name."""
    file: Path = Path("results.json")
    """The file of the results, or the first of them if there is one for each policy."""

    @property
    def elsewhere(self) -> bool:
        """Whether jaxsafe has not trained the policies. They may know one way of acting only."""
        return self.results.get("algorithm") in ELSEWHERE

    @property
    def untrained(self) -> bool:
        """Whether nobody has trained the policies. Then there are no seeds."""
        if self.training is not None:
            return self.elsewhere and self.training["steps"] == 0
        return self.results.get("algorithm") == "not trained"

    @property
    def training_cost(self) -> float | None:
        """Violating steps of the training, a mean over the seeds. None if they are unknown."""
        if self.training is not None and self.training["steps"]:
            violating = self.training["violating_steps"]
            return sum(violating) / len(violating)
        return self.results.get("training_cost", {}).get("mean")

    @property
    def task(self) -> str:
        """Name of the task, or of the environment if it is no task of jaxsafe."""
        names = {str(task.gymnasium_id): name for name, task in (TASKS | STARTERS).items()}
        return names.get(str(self.results.get("task", {}).get("id"))) or self.results["env"]


def read_submission(place: str) -> Submission:
    """Return the results in a directory, or those of a single file.

    Evaluations of single policies, such as those of ten files, become one evaluation of them all.

    Args:
        place: the directory of a run, of an evaluation or of a submission, or a `results.json`.
            A record in docs/baselines has the results of a training and its evaluations.

    Raises:
        ConfigError: there are no results, they cannot be read, or they are those of several runs.
    """
    path = Path(place)
    files = [path]
    if path.is_dir():
        files = sorted({file for pattern in PLACES for file in path.glob(pattern)})
        if not files or (path / "config.yaml").exists():  # a run has results, or they are missing
            files = [path / "results.json", *(file for file in files if file.parent != path)]
    found = [entry for file in files for entry in _read(file)]
    trainings = [entry for entry in found if not _is_evaluation(entry[1])]
    if len(trainings) > 1:
        names = " and ".join(str(file) for file, _ in trainings[:2])
        raise ConfigError(
            f"{place}: expected the results of one training, found {len(trainings)}, "
            f"for instance {names}"
        )
    merged = _merge(entry for entry in found if _is_evaluation(entry[1]))
    file, results = trainings[0] if trainings else min(merged, key=_rank)
    training = None
    if not trainings and (path / TRAINING).is_file():
        training = _read_training(path / TRAINING, results["seeds"])
    run = place if (path / "config.yaml").exists() else "RUN"
    if not trainings:
        run = "POLICY" if len(results["runs"]) > 1 else results["run"]
    return Submission(
        results=results,
        others=[other for _, other in merged if other is not results],
        training=training,
        run=run,
        file=file,
    )


def findings(submission: Submission) -> list[Finding]:
    """Return what the protocol asks for, each with whether it is there."""
    results = submission.results
    task = results.get("task", {"id": None})
    changes = _changes(results)
    terms = [name for name in task.get("changes", ()) if name in TRAINING_TERMS]
    cost = submission.training_cost
    steps = (submission.training or results)["steps"]
    versions = results.get("versions", {})
    machine = [str(versions.get(key, "unknown")) for key in ("jaxsafe", "jax", "device")]
    costs = f"{steps:,} and {cost:,.0f} per seed" if cost is not None else "unknown; "
    if submission.untrained:
        costs = "none, it was not trained"
    elif cost is None and submission.elsewhere:
        costs += f"write them into {TRAINING}, see docs/protocol.md"
    elif cost is None:
        costs += "give the run directory"
    return [
        Finding(
            "the task as it is",
            task["id"] is not None and not changes,
            f"{task['id']}"
            + (f", with other {', '.join(changes)}" if changes else "")
            + (f"; returns include {', '.join(terms)}" if terms else "")
            if task["id"]
            else "no task of jaxsafe",
        ),
        *_measured(submission, results),
        _with_and_without_filter(submission),
        _fixed_starts(submission),
        Finding(
            "steps and violating steps of the training",
            submission.untrained or cost is not None,
            costs,
        ),
        Finding("versions and the machine", bool(versions), ", ".join(machine)),
    ]


def committed(results: Sequence[Results], hidden: HiddenSeed) -> Finding:
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


def _measured(submission: Submission, results: Results) -> list[Finding]:
    """Return what the protocol asks of every result of a submission."""
    seeds = results["seeds"]
    sound = seeds - len(results.get("diverged", ()))
    episodes = results.get("episodes", 0)
    metrics = results["evaluation"].values()
    intervals = all(of_kind["success_rate"]["ci95"] is not None for of_kind in metrics)
    tails = [of_kind.get("episode_violation_severity_p99", {}) for of_kind in metrics]
    tail = all(severity.get("mean") is not None for severity in tails)
    more_seeds = f"train with seeds={SEEDS}"
    if submission.elsewhere:
        more_seeds = f"evaluate {SEEDS} policies, one for each seed of the training"
    how = "evaluate" if _is_evaluation(results) else "train"
    kinds = ", ".join(results["evaluation"])
    return [
        Finding(
            f"{SEEDS} seeds or more, none diverged",
            seeds == sound and (submission.untrained or sound >= SEEDS),
            "none, it was not trained"
            if submission.untrained
            else f"{sound} of {seeds} seeds" + ("" if sound >= SEEDS else f"; {more_seeds}"),
        ),
        Finding(
            f"{EPISODES:,} episodes per seed or more",
            episodes >= EPISODES,
            f"{episodes:,} episodes"
            + ("" if episodes >= EPISODES else f"; {how} with episodes={EPISODES}"),
        ),
        Finding(
            "deterministic and sampled actions",
            {*EVALUATION_KINDS} <= {*results["evaluation"]}
            or (submission.elsewhere and bool(kinds)),
            f"{kinds} alone, a policy from elsewhere"
            if submission.elsewhere and len(results["evaluation"]) == 1
            else kinds,
        ),
        Finding(
            "95 % intervals over seeds",
            submission.untrained or intervals,
            "none, it was not trained"
            if submission.untrained
            else "there"
            if intervals
            else "too few seeds for them",
        ),
        Finding(
            "the tail of the severity of violations",
            tail,
            "95 and 99 % of episodes" if tail else "evaluate again with this version",
        ),
    ]


def _with_and_without_filter(submission: Submission) -> Finding:
    """Return whether the policies have flown from random starts with a filter and without one."""
    own = _filter(submission.results)
    wanted = "default" if own == "none" else "none"
    others = [
        other
        for other in _alike(submission)
        if "cases" not in other and (_filter(other) == "none") != (own == "none")
    ]
    detail, complete = _best(submission, others, {"rta": wanted})
    shown = ", ".join(sorted({own, *map(_filter, others)}))
    needed = _has_filter(submission.task)
    return Finding(
        "with and without a filter",
        complete or not needed,
        shown if complete else f"only rta={own}" + (f"; {detail}" if needed else ""),
    )


def _fixed_starts(submission: Submission) -> Finding:
    """Return whether the policies have flown from the fixed starts of the task.

    They have the same filter there as in the results, or none in both.
    """
    own = _filter(submission.results)
    others = [
        other
        for other in [submission.results, *_alike(submission)]
        if other.get("cases") == submission.task and _filter(other) == own
    ]
    detail, complete = _best(submission, others, {"cases": submission.task})
    return Finding("the fixed starts of the task", complete, "there" if complete else detail)


def _best(
    submission: Submission, others: Sequence[Results], options: Mapping[str, str]
) -> tuple[str, bool]:
    """Return a text, and whether one of these results has all that every result needs.

    The text names what the most complete one lacks, and the command that measures it.

    Args:
        submission: the submission.
        others: its results that have what is asked for.
        options: the options of an evaluation that has it.
    """
    lacking = [
        [finding for finding in _measured(submission, other) if not finding.reported]
        for other in others
    ]
    fewest = min(lacking, key=len, default=None)
    if fewest == []:
        return "", True
    words = [f"env={submission.task}"] if submission.elsewhere else []
    words += [f"{name}={value}" for name, value in options.items()]
    command = " ".join(["jaxsafe evaluate", submission.run, *words])
    if fewest is None:
        return command, False
    return f"lacks {', '.join(finding.what for finding in fewest)}; {command}", False


def _alike(submission: Submission) -> list[Results]:
    """Return the other results that are of the same task and of the same policies."""
    results = submission.results
    return [
        other
        for other in submission.others
        if _task(other) == _task(results)
        and _policies(other) == _policies(results)
        and other.get("runs") == results.get("runs", other.get("runs"))
    ]


def _task(results: Results) -> tuple[str | None, list[str]]:
    return results.get("task", {}).get("id"), _changes(results)


def _policies(results: Results) -> tuple[Any, ...]:
    """Return what results of the same policies have in common."""
    names = ("seeds", "seed", "steps")
    return *(results[name] for name in names), results.get("checkpoint", "last")


def _changes(results: Results) -> list[str]:
    """Return where the environment of results differs from the task, but for the training."""
    changes = results.get("task", {}).get("changes", ())
    return [name for name in changes if name not in TRAINING_TERMS]


def _filter(results: Results) -> str:
    """Return the filter that acted, or `none`."""
    return results.get("rta", "none")


def _has_filter(name: str) -> bool:
    """Return whether a task has a recommended filter. A user's module is imported for it."""
    known = ":" in name or registered(name) is not None
    return known and default_filter(name) is not None


def _is_evaluation(results: Results) -> bool:
    """Return whether these are the results of an evaluation, and not those of a training."""
    return "evaluation_seed" in results


def _read(file: Path) -> list[tuple[Path, Results]]:
    """Return the results in a file, each with the file.

    Raises:
        ConfigError: they cannot be read.
    """
    content = read_json(file, {})
    entries = {str(file): content}
    if "results" in content:  # a record of docs/baselines
        check(content, {"results": {}, "evaluations": {OTHERS: {}}}, str(file))
        entries = {f"{file}: results": content["results"]}
        for name, results in content["evaluations"].items():
            entries[f"{file}: evaluations.{name}"] = results
    for place, results in entries.items():
        check_results(results, place, training=not _is_evaluation(results))
    return [(file, results) for results in entries.values()]


def _read_training(file: Path, seeds: int) -> Results:
    """Return what a submitter says about a training elsewhere.

    Raises:
        ConfigError: the file cannot be read, or has no number for each policy.
    """
    content = read_json(file, {"algorithm": TEXT, "steps": COUNT})
    if content["steps"]:
        check(content, {"violating_steps": numbers(seeds, AMOUNT)}, str(file))
    return content


def _rank(entry: tuple[Path, Results]) -> tuple[Any, ...]:
    """Return by what the main results are chosen among evaluations. The smallest is taken."""
    _, results = entry
    changed = bool(_changes(results))
    return "cases" in results, changed, _filter(results) != "none", -results["seeds"]


def _merge(entries: Iterable[tuple[Path, Results]]) -> list[tuple[Path, Results]]:
    """Return evaluations in which those of single policies that fit together have become one.

    Each has the policies under `runs`. A policy that was evaluated twice counts once.
    """
    groups: dict[str, dict[str, tuple[Path, Results]]] = {}
    for file, results in entries:
        run = str(Path(results["run"]))
        same = [results.get(name) for name in _SAME] + sorted(results["evaluation"])
        alone = [] if results["seeds"] == 1 else [run, str(file)]
        key = json.dumps([*same, *alone], sort_keys=True)
        groups.setdefault(key, {})[run] = (file, results)
    return [
        (next(iter(group.values()))[0], _concatenate(dict(sorted(group.items()))))
        for group in groups.values()
    ]


def _concatenate(group: Mapping[str, tuple[Path, Results]]) -> Results:
    """Return the results of several policies as those of one evaluation.

    Args:
        group: file and results of each policy, by its place.
    """
    parts = [results for _, results in group.values()]
    first = parts[0]
    if len(parts) == 1:
        return {**first, "runs": [*group]}
    diverged = [index for index, results in enumerate(parts) if results.get("diverged")]
    evaluation = {
        kind: {
            name: over_sound_seeds(
                [results["evaluation"][kind][name]["per_seed"][0] for results in parts], diverged
            )
            for name in metrics
            if all(_is_metric(results["evaluation"][kind].get(name)) for results in parts)
        }
        for kind, metrics in first["evaluation"].items()
    }
    return {
        **first,
        "seeds": len(parts),
        "evaluation": evaluation,
        "diverged": [parts[index]["diverged"][0] for index in diverged],
        "runs": [*group],
    }


def _is_metric(metric: Any) -> bool:
    """Return whether this is a metric of a single policy. Those of one's own are not checked."""
    return isinstance(metric, Mapping) and numbers(1).fits(metric.get("per_seed"))
