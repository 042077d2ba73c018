"""Evaluation of trained policies, written into a directory of its own."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsafe.agents.networks import Params
from jaxsafe.bounds import best_possible
from jaxsafe.commands.policies import Subject
from jaxsafe.environment import Environment, filter_name, require_success
from jaxsafe.envs.identity import identity
from jaxsafe.evaluate.cases import Cases, columns_of
from jaxsafe.evaluate.evaluator import (
    Evaluator,
    episode_rows,
    gaps_per_seed,
    given_up,
    step_rows,
)
from jaxsafe.evaluate.hidden_seed import HiddenSeed
from jaxsafe.metrics import Episode
from jaxsafe.storage.files import append_rows, write_csv, write_json
from jaxsafe.storage.provenance import versions
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.results import diverged_seeds, evaluation, over_sound_seeds
from jaxsafe.types import State, TimeStep

MAX_NAME = 120
"""Most characters of the name of a new directory. File systems take at most 255."""


class Film(NamedTuple):
    """Which episodes to show, and in which formats."""

    forms: Sequence[str]
    """The formats: `gif` and `mp4` are films, `png` is a figure, and `jsonl` a log of the steps."""

    which: Sequence[str] = ("first",)
    """The first episode, the first that is `failing` or `violating`, or the `worst` by return."""

    seed: int | None = None
    """The training seed of the policy. None stands for the first one with such an episode."""

    def find(
        self, which: str, sums: Episode, env: Environment, first: int, left_out: Sequence[int] = ()
    ) -> tuple[int, int, str]:
        """Return the index of a policy, the number of its episode, and a line if there is none.

        If no policy has such an episode, it is the first episode of the first policy.

        Args:
            which: the name of the episode.
            sums: sums over the episodes, each field [seeds, episodes].
            env: the environment, which says what counts as success.
            first: the first training seed.
            left_out: indices of policies that are passed over, unless the seed is given.
        """
        count = len(sums.outcome)
        own = [jax.tree.map(lambda x, index=index: x[index], sums) for index in range(count)]
        numbers = [self.choose(which, episodes, env) for episodes in own]
        sound = [index for index in range(count) if index not in left_out] or [0]
        having = [index for index in sound if numbers[index] is not None]
        index = [*having, *sound][0] if self.seed is None else self.seed - first
        number = numbers[index]
        if number is not None:
            return index, number, ""
        whose = "any seed" if self.seed is None and count > 1 else f"seed {first + index}"
        other = f", but seed {first + having[0]} has one" if having else ""
        return index, 0, f"no {which} episode of {whose}{other}; the first one is shown"

    @staticmethod
    def choose(which: str, sums: Episode, env: Environment) -> int | None:
        """Return the number of an episode, or None if there is no such episode.

        Args:
            which: the name of the episode.
            sums: sums over the episodes of the policy, each field [episodes].
            env: the environment, which says what counts as success.
        """
        if which == "worst":
            return int(np.argmin(sums.episode_return))
        numbers = numbers_of("all" if which == "first" else which, sums, env)
        return numbers[0] if numbers else None


def numbers_of(which: str, sums: Episode, env: Environment) -> list[int]:
    """Return the numbers of the episodes that are `failing` or `violating`, or of `all`.

    Args:
        which: the name of the episodes.
        sums: sums over the episodes of a policy, each field [episodes].
        env: the environment, which says what counts as success.
    """
    flags = {
        "all": np.ones(len(sums.outcome), bool),
        "failing": ~env.succeeded(np.asarray(sums.outcome)),
        "violating": sums.violating_steps > 0,
    }[which]
    return np.flatnonzero(flags).tolist()


def _name(request: Mapping[str, Any]) -> str:
    """Return the name of a new directory, for instance `best-1000-seed0-deputy.mass=14`.

    It has the checkpoint, the number of episodes, the cases, the seed and what was changed. Values
    that are no single number or text are left out.
    """
    parts = [request["checkpoint"], request["episodes"]]
    if "cases" in request:
        parts.append(Path(request["cases"]).stem)
    seed = request["evaluation_seed"]
    parts.append("hidden_seed" if seed is None else f"seed{seed}")
    for name, value in request["changes"].items():
        parts.append(name if isinstance(value, (list, dict)) else f"{name}={value}")
    return re.sub(r"[^\w.=+-]+", "_", "-".join(map(str, parts)))[:MAX_NAME]


def evaluate(
    subject: Subject,
    env: Environment,
    kinds: Sequence[str],
    request: dict[str, Any],
    out: str | None,
    film: Film | None = None,
    cases: Cases | None = None,
    panels: Sequence[str] = (),
    bounds: bool = False,
    logged: Sequence[str] = (),
    hidden: HiddenSeed | None = None,
) -> tuple[Path, dict[str, Any], list[str]]:
    """Evaluate every policy and write `results.json`, `eval.jsonl` and `starts.csv`.

    With a hidden seed only `results.json` is written, because the others would give the seed away.

    Args:
        subject: the policies.
        env: the environment to evaluate in. The policies fit it.
        kinds: `stochastic`, `deterministic` or both.
        request: what was asked for: `run`, `episodes`, `evaluation_seed`, `checkpoint`, `changes`,
            and `cases` if there are any. It becomes part of the results.
        out: a new directory. None makes one in `subject.place`.
        film: the episodes to show of each kind of evaluation, or None.
        cases: the starts of the episodes. None stands for random ones.
        panels: the panels of a map of the starts, names of `jaxsafe.plot.start_map.PANELS`. If
            there are none, no map is drawn.
        bounds: whether to compare the episodes with what is possible.
        logged: the episodes to log step by step in `episodes.jsonl`, names that `numbers_of` knows.
        hidden: the seed of the evaluation if it is hidden. `evaluation_seed` is then None.

    Returns:
        The path of `results.json`, its content, and lines about films, logs and maps.

    Raises:
        ConfigError: `out` holds something, no outcome of the environment counts as a success, or no
            bounds are known.
    """
    require_success(env)
    episodes = request["episodes"]
    seed = request["evaluation_seed"] if hidden is None else hidden.seed
    path = run_directory.make(out, subject.place, _name(request))
    try:
        evaluator = Evaluator(subject.mapper, env, subject.agent, cases)
        starts = evaluator.starts(episodes, seed)
        possible = best_possible(env, starts) if bounds else None
        sums = {
            kind: evaluator.run(subject.params, episodes, seed, kind == "deterministic")
            for kind in kinds
        }
    except Exception:
        run_directory.discard_unused(path)
        raise
    first = subject.facts["seed"]
    left_out = subject.not_finite()
    for kind, of_kind in sums.items() if hidden is None else ():
        rows = episode_rows(
            env, of_kind, first, possible, step=subject.facts["steps"], kind=kind, final=True
        )
        append_rows(
            path / "eval.jsonl", (row for row in rows if row["seed"] - first not in left_out)
        )
    columns = columns_of(env, starts)
    if columns and hidden is None:
        cells = zip(*(column.tolist() for column in columns.values()), strict=True)
        write_csv(path / "starts.csv", [dict(zip(columns, row, strict=True)) for row in cells])
    results = {
        **subject.facts,
        **request,
        "task": identity(env),
        "rta": filter_name(env),
        "versions": versions(),
        "evaluation": evaluation(env, sums, left_out),
    }
    results |= given_up(env, sums) | diverged_seeds({first + index: None for index in left_out})
    if possible is not None:
        for kind, of_kind in sums.items():
            results["evaluation"][kind] |= {
                name: over_sound_seeds(values, left_out)
                for name, values in gaps_per_seed(env, of_kind, possible).items()
            }
    write_json(path / "results.json", results)
    lines = [] if hidden is None else [f"commitment to the hidden seed: {hidden.commitment}"]
    for kind, of_kind in sums.items() if panels else ():
        lines.append(_map(subject, env, starts, of_kind, kind, panels, path))
    if film is not None:
        for kind, of_kind in sums.items():
            lines += _render(subject, evaluator, of_kind, seed, kind, film, left_out, path)
    for kind, of_kind in sums.items() if logged else ():
        lines.append(_log(subject, evaluator, of_kind, seed, kind, logged, left_out, path))
    return path / "results.json", results, lines


def _render(
    subject: Subject,
    evaluator: Evaluator,
    sums: Episode,
    seed: int,
    kind: str,
    film: Film,
    left_out: Sequence[int],
    path: Path,
) -> list[str]:
    """Show some episodes, and return lines with the seeds and the paths.

    Args:
        subject: the policies.
        evaluator: the evaluator that has flown the episodes.
        sums: sums over the episodes, each field [seeds, episodes].
        seed: the seed of the evaluation.
        kind: the kind of evaluation.
        film: what to show.
        left_out: indices of policies that are shown only if their seed is given.
        path: the directory of the evaluation.
    """
    env = evaluator.env
    first = subject.facts["seed"]
    sums = jax.tree.map(np.asarray, sums)
    all_params = subject.mapper.gather(subject.params)
    lines = []
    for which in film.which:
        index, number, note = film.find(which, sums, env, first, left_out)
        if note:
            lines.append(f"film, {kind}: {note}")
        whose = f"seed {first + index}, {kind}"
        _, params = _of_seed(index, sums, all_params)
        episode = evaluator.episode(params, number, seed, kind == "deterministic")
        title = f"{subject.name}, {whose}, episode {number}"
        stem = f"episode_{kind}" + f"_{which}" * (len(film.which) > 1)
        for form in film.forms:
            file = _show(env, episode, path / f"{stem}.{form}", title)
            lines.append(f"{KINDS_OF_FILE[form]} of {whose}, episode {number}: {file}")
    return lines


def _log(
    subject: Subject,
    evaluator: Evaluator,
    sums: Episode,
    seed: int,
    kind: str,
    which: Sequence[str],
    left_out: Sequence[int],
    path: Path,
) -> str:
    """Add every step of some episodes of all seeds to `episodes.jsonl`, and return a line.

    Args:
        subject: the policies.
        evaluator: the evaluator that has flown the episodes.
        sums: sums over the episodes, each field [seeds, episodes].
        seed: the seed of the evaluation.
        kind: the kind of evaluation.
        which: the names of the episodes.
        left_out: indices of policies that are not logged.
        path: the directory of the evaluation.
    """
    env = evaluator.env
    params = subject.mapper.gather(subject.params)
    file = path / "episodes.jsonl"
    count = 0
    for index in range(subject.facts["seeds"]):
        own, policy = _of_seed(index, sums, params)
        numbers = sorted({number for name in which for number in numbers_of(name, own, env)})
        numbers = [] if index in left_out else numbers
        count += len(numbers)
        facts = {
            "step": subject.facts["steps"],
            "seed": subject.facts["seed"] + index,
            "kind": kind,
            "final": True,
        }
        episodes = evaluator.chosen_episodes(policy, numbers, seed, kind == "deterministic")
        for number, episode in zip(numbers, episodes, strict=True):
            rows = step_rows(env, *episode)
            append_rows(file, ({**facts, "episode": number, **row} for row in rows))
    whose = " or ".join(which)
    where = f": {file}" if count else ""
    return f"log of the {kind} episodes, {whose}: {count:,} of {np.size(sums.outcome):,}{where}"


def _of_seed(index: int, sums: Episode, params: Params) -> tuple[Episode, Params]:
    """Return the sums over the episodes of one training seed, and the parameters of its policy."""
    own = jax.tree.map(lambda x: np.asarray(x)[index], sums)
    return own, jax.tree.map(lambda x: x[index], params)


KINDS_OF_FILE = {"gif": "film", "mp4": "film", "png": "figure", "jsonl": "log"}
"""What a format shows an episode as."""


def _show(env: Environment, episode: tuple[State, TimeStep], file: Path, title: str) -> Path:
    """Write an episode into a file in the format of its ending, and return the file."""
    if file.suffix == ".jsonl":
        append_rows(file, step_rows(env, *episode))
        return file
    if file.suffix == ".png":
        from jaxsafe.plot.flight import flight_figure
        from jaxsafe.plot.style import save

        return save(flight_figure(env, episode, title), file)
    from jaxsafe.plot.animation import animate

    return animate(env, episode, file, title)


def _map(
    subject: Subject,
    env: Environment,
    starts: State,
    sums: Episode,
    kind: str,
    panels: Sequence[str],
    path: Path,
) -> str:
    """Draw the means over the seeds at every start, and return a line with the path."""
    from jaxsafe.plot.start_map import start_map
    from jaxsafe.plot.style import save

    values = {
        "success": env.succeeded(np.asarray(sums.outcome)),
        "violations": sums.violating_steps,
        "return": sums.episode_return,
        "length": sums.length,
        "delta_v": sums.delta_v,
    }
    means = {name: np.mean(np.asarray(values[name], float), axis=0) for name in panels}
    title = f"{subject.name}, {kind}, {len(starts.num_steps):,} starts"
    file = save(start_map(env, starts, means, title), path / f"map_{kind}.png")
    return f"map of the starts, {kind}: {file}"
