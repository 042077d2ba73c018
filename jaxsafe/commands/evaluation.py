"""Evaluation of trained policies, written into a directory of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxsafe.commands.policies import Subject
from jaxsafe.environment import Environment, require_success
from jaxsafe.evaluate.evaluator import Evaluator, episode_rows, given_up
from jaxsafe.storage.files import append_rows, write_json
from jaxsafe.storage.provenance import versions
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.log import filter_name
from jaxsafe.train.host.results import diverged_seeds, evaluation


def evaluate(
    subject: Subject,
    env: Environment,
    kinds: Sequence[str],
    request: dict[str, Any],
    out: str | None,
    render: bool = False,
) -> tuple[Path, dict[str, Any]]:
    """Evaluate every policy and write `results.json` and `eval.jsonl`.

    Args:
        subject: the policies.
        env: the environment to evaluate in. The policies fit it.
        kinds: `stochastic`, `deterministic` or both.
        request: what was asked for: `run`, `episodes`, `evaluation_seed`, `checkpoint` and
            `changes`. It becomes part of the results.
        out: a new directory. None makes one in `subject.place`.
        render: whether to draw the first episode of the first policy as `episode_<kind>.gif` too.

    Returns:
        The path of `results.json` and its content.

    Raises:
        ConfigError: `out` holds something, or no outcome of the environment is a success.
    """
    require_success(env)
    episodes, seed = request["episodes"], request["evaluation_seed"]
    path = run_directory.make(
        out,
        subject.place,
        f"{request['checkpoint']}-{episodes}-seed{seed}" + "-changed" * bool(request["changes"]),
    )
    try:
        evaluator = Evaluator(subject.mapper, env, subject.agent)
        sums = {
            kind: evaluator.run(subject.params, episodes, seed, kind == "deterministic")
            for kind in kinds
        }
    except Exception:
        run_directory.discard_unused(path)
        raise
    first = subject.facts["seed"]
    left_out = _not_finite(subject)
    for kind, one in sums.items():
        rows = episode_rows(env, one, first, step=subject.facts["steps"], kind=kind, final=True)
        append_rows(
            path / "eval.jsonl", (row for row in rows if row["seed"] - first not in left_out)
        )
    results = {
        **subject.facts,
        **request,
        "rta": filter_name(env),
        "versions": versions(),
        "evaluation": evaluation(env, sums, left_out),
    }
    results |= given_up(env, sums) | diverged_seeds({first + place: None for place in left_out})
    write_json(path / "results.json", results)
    for kind in kinds if render else ():
        _render(subject, evaluator, seed, kind, path)
    return path / "results.json", results


def _not_finite(subject: Subject) -> list[int]:
    """Return the indices of the policies that have a parameter that is not finite.

    A training that diverged leaves such policies.
    """
    leaves = jax.tree.leaves(subject.mapper.gather(subject.params))
    return [
        place
        for place in range(subject.facts["seeds"])
        if not all(np.isfinite(leaf[place]).all() for leaf in leaves)
    ]


def _render(subject: Subject, evaluator: Evaluator, seed: int, kind: str, path: Path) -> None:
    from jaxsafe.plot.animation import animate

    first = jax.tree.map(lambda x: x[0], subject.mapper.gather(subject.params))
    [episode] = evaluator.episodes(first, 1, seed, kind == "deterministic")
    animate(evaluator.env, episode, film(path, kind), f"{subject.name}, {kind}")


def film(path: Path, kind: str) -> Path:
    """Return the path of an episode's animation in the directory of an evaluation."""
    return path / f"episode_{kind}.gif"
