"""Results of complete submissions, made of those of a tiny run."""

import copy
import json
from pathlib import Path
from typing import Any


def over(results: dict, seeds: int) -> dict:
    """Return results whose numbers are repeated, so that they are those of so many seeds."""
    results = copy.deepcopy(results)
    metrics = [metric for of_kind in results["evaluation"].values() for metric in of_kind.values()]
    for metric in [*metrics, results["training_cost"], results["interaction_efficiency"]]:
        metric["per_seed"] = (seeds * metric["per_seed"])[:seeds]
        if "ci95" in metric and seeds == 1:
            metric["ci95"] = None
    return results | {"seeds": seeds}


def as_evaluation(results: dict, **changes: Any) -> dict:
    """Return the results of an evaluation of the policies of a training."""
    left_out = ("training_cost", "interaction_efficiency", "wall_s", "compile_s")
    kept = {name: value for name, value in results.items() if name not in left_out}
    about = {"run": "runs/x", "checkpoint": "last", "evaluation_seed": 0, "changes": {}}
    return copy.deepcopy(kept | about | changes)


def write(results: dict, *places: Any) -> Path:
    """Write results, and return their directory."""
    path = Path(*places)
    path.mkdir(parents=True)
    (path / "results.json").write_text(json.dumps(results))
    return path


def complete_results(whole: Path) -> tuple[dict, list[dict]]:
    """Return results that have everything, and those of two further evaluations.

    Args:
        whole: the directory of a tiny run.
    """
    results = over(json.loads((whole / "results.json").read_text()), 10)
    results |= {"episodes": 1000, "task": {"id": "jaxsafe/Docking2D-v0", "changes": []}}
    filtered = as_evaluation(results, rta="discrete_asif")
    return results, [filtered, as_evaluation(results, cases="docking2d")]


def write_run(whole: Path, path: Path) -> None:
    """Write the results of a run that has everything into a directory."""
    results, evaluations = complete_results(whole)
    write(results, path)
    for number, evaluation in enumerate(evaluations):
        write(evaluation, path, "evaluations", str(number))


def write_policies(whole: Path, path: Path) -> None:
    """Write three evaluations of each of ten policies from elsewhere into a directory."""
    single = over(complete_results(whole)[0], 1)
    single["algorithm"] = "unknown"
    del single["evaluation"]["stochastic"]
    for number in range(10):
        own = as_evaluation(single, run=f"policy_{number}.onnx")
        write(own, path, str(number))
        write(own | {"rta": "discrete_asif"}, path, f"{number}-filter")
        write(own | {"cases": "docking2d"}, path, f"{number}-cases")
