"""Evaluation of trained policies, written into a directory of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsafe.commands.policies import Subject
from jaxsafe.environment import Environment, filter_name, require_success
from jaxsafe.envs.identity import identity
from jaxsafe.evaluate.cases import Cases
from jaxsafe.evaluate.evaluator import Evaluator, episode_rows, given_up
from jaxsafe.metrics import Episode
from jaxsafe.storage.files import append_rows, write_json
from jaxsafe.storage.provenance import versions
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.results import diverged_seeds, evaluation


class Film(NamedTuple):
    """Which episode to film, and in which format."""

    form: str
    """The format, `gif` or `mp4`."""

    which: str = "first"
    """The first episode, the first that is `failing` or `violating`, or the `worst` by return."""

    seed: int | None = None
    """The training seed of the policy. None stands for the first one."""

    def choose(self, sums: Episode, env: Environment) -> int | None:
        """Return the number of the episode, or None if there is no such episode.

        Args:
            sums: sums over the episodes of the policy, each field [episodes].
            env: the environment, which says what counts as success.
        """
        if self.which == "worst":
            return int(np.argmin(sums.episode_return))
        flags = {
            "first": np.ones(len(sums.outcome), bool),
            "failing": ~env.succeeded(np.asarray(sums.outcome)),
            "violating": sums.violating_steps > 0,
        }[self.which]
        return int(np.argmax(flags)) if flags.any() else None


def evaluate(
    subject: Subject,
    env: Environment,
    kinds: Sequence[str],
    request: dict[str, Any],
    out: str | None,
    film: Film | None = None,
    cases: Cases | None = None,
) -> tuple[Path, dict[str, Any], list[str]]:
    """Evaluate every policy and write `results.json` and `eval.jsonl`.

    Args:
        subject: the policies.
        env: the environment to evaluate in. The policies fit it.
        kinds: `stochastic`, `deterministic` or both.
        request: what was asked for: `run`, `episodes`, `evaluation_seed`, `checkpoint`, `changes`,
            and `cases` if there are any. It becomes part of the results.
        out: a new directory. None makes one in `subject.place`.
        film: the film to make of each kind of evaluation, or None.
        cases: the starts of the episodes. None stands for random ones.

    Returns:
        The path of `results.json`, its content, and lines about the films.

    Raises:
        ConfigError: `out` holds something, or no outcome of the environment counts as a success.
    """
    require_success(env)
    episodes = request["episodes"]
    seed = request["evaluation_seed"]
    started = "" if cases is None else f"-{Path(request['cases']).stem}"
    changed = "-changed" * bool(request["changes"])
    path = run_directory.make(
        out, subject.place, f"{request['checkpoint']}-{episodes}{started}-seed{seed}{changed}"
    )
    try:
        evaluator = Evaluator(subject.mapper, env, subject.agent, cases)
        sums = {
            kind: evaluator.run(subject.params, episodes, seed, kind == "deterministic")
            for kind in kinds
        }
    except Exception:
        run_directory.discard_unused(path)
        raise
    first = subject.facts["seed"]
    left_out = _not_finite(subject)
    for kind, of_kind in sums.items():
        rows = episode_rows(env, of_kind, first, step=subject.facts["steps"], kind=kind, final=True)
        append_rows(
            path / "eval.jsonl", (row for row in rows if row["seed"] - first not in left_out)
        )
    results = {
        **subject.facts,
        **request,
        "task": identity(env),
        "rta": filter_name(env),
        "versions": versions(),
        "evaluation": evaluation(env, sums, left_out),
    }
    results |= given_up(env, sums) | diverged_seeds({first + index: None for index in left_out})
    write_json(path / "results.json", results)
    lines = []
    if film is not None:
        for kind, of_kind in sums.items():
            lines += _render(subject, evaluator, of_kind, seed, kind, film, path)
    return path / "results.json", results, lines


def _not_finite(subject: Subject) -> list[int]:
    """Return the indices of the policies with parameters that are not finite.

    A training that diverged leaves such policies.
    """
    leaves = jax.tree.leaves(subject.mapper.gather(subject.params))
    return [
        index
        for index in range(subject.facts["seeds"])
        if not all(np.isfinite(leaf[index]).all() for leaf in leaves)
    ]


def _render(
    subject: Subject,
    evaluator: Evaluator,
    sums: Episode,
    seed: int,
    kind: str,
    film: Film,
    path: Path,
) -> list[str]:
    """Make a film of an episode of one policy, and return lines with its path.

    Args:
        subject: the policies.
        evaluator: the evaluator that has flown the episodes.
        sums: sums over the episodes, each field [seeds, episodes].
        seed: the seed of the evaluation.
        kind: the kind of evaluation.
        film: what to film.
        path: the directory of the evaluation.
    """
    from jaxsafe.plot.animation import animate

    env = evaluator.env
    first = subject.facts["seed"]
    index = 0 if film.seed is None else film.seed - first
    own = jax.tree.map(lambda x: np.asarray(x)[index], sums)
    number = film.choose(own, env)
    whose = f"seed {first + index}, {kind}"
    lines = []
    if number is None:
        lines.append(f"film: no {film.which} episode of {whose}; the first one is shown")
    params = jax.tree.map(lambda x: x[index], subject.mapper.gather(subject.params))
    episode = evaluator.episode(params, number or 0, seed, kind == "deterministic")
    title = f"{subject.name}, {whose}, episode {number or 0}"
    file = animate(env, episode, path / f"episode_{kind}.{film.form}", title)
    return [*lines, f"film of {whose}, episode {number or 0}: {file}"]
