"""Measure trained policies over whole episodes, in their own environment or in another.

The results are written into a new directory, and a table of them is printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

from jaxsafe.commands import cli
from jaxsafe.commands.options import Count, Directory, File, Option, Seed
from jaxsafe.commands.policy_options import PolicyOptions, differences
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.devices.seed_mapper import claim_cores
from jaxsafe.schema.component import Range
from jaxsafe.schema.errors import ConfigError

FORMS = ("gif", "mp4", "png", "jsonl")
"""The formats in which an episode is shown."""

EPISODES = ("first", "failing", "violating", "worst")
"""The episodes that can be shown."""

LOGGED = ("failing", "violating", "all")
"""The episodes whose steps can be logged together."""

MAPS = ("success", "violations", "return", "length", "delta_v")
"""The panels of a map. `jaxsafe.plot.start_map` has their labels."""

Radius = Annotated[float, Range(0.0, open_low=True, high=1e6), Option(takes="a radius > 0 in m")]


class Options(PolicyOptions):
    """The options of `jaxsafe evaluate`."""

    groups: ClassVar = {
        "The policies.": ("run", "checkpoint", "deterministic", "activation"),
        "The environment in which they act.": ("env", "env.PATH", "actions", "variant", "rta"),
        "The episodes, and what is kept of them.": (
            "episodes",
            "cases",
            "seed",
            "hidden_seed",
            "map",
            "bounds",
            "passive_safety",
            "out",
        ),
        "Films, figures and logs of single episodes.": ("render", "film", "film_seed", "log"),
    }

    episodes: Count = 1000
    """Number of episodes of each seed."""
    cases: str | None = None
    """A CSV or YAML file of starts. There is one episode from each.

    A task stands for the file that comes with it: 1,000 random starts, and then the corners.
    """
    seed: Seed = 0
    """Seed of the starts and of the noise. 0 gives those of the results of the run itself."""
    hidden_seed: File | None = None
    """A file with a seed that the results do not name, for a leaderboard.

    If there is no such file, a seed is drawn and written into it. The results have a commitment to
    the seed, and nothing of single episodes is written.
    """
    checkpoint: str | None = None
    """The checkpoint of a run: last, best, or its number of steps. By default it is the last.

    With best, each seed has the one with the most success in the evaluations during training.
    """
    deterministic: bool | None = None
    """Whether the policies act by their most probable action. By default both are measured."""
    map: Annotated[tuple[str, ...], Option(names=MAPS, kind="panel")] = ()
    """Draw a map of the starts, with a panel for each of these quantities: means over the seeds."""
    passive_safety: Radius | None = None
    """Measure in how many steps the craft would stay outside of a radius without thrust.

    The chief is the centre, and the drift lasts one orbit.
    """
    bounds: bool = False
    """Compare with what is possible: the gap of each episode to the bounds of its start."""
    render: Annotated[tuple[str, ...], Option(names=FORMS, kind="format")] = ()
    """Show an episode: as a film, as a figure (png), or as a log of all its steps (jsonl).

    An mp4 needs ffmpeg on the PATH.
    """
    film: Annotated[tuple[str, ...], Option(names=EPISODES, kind="episode")] = ("first",)
    """The episodes to show: the first, the first that fails or violates, or the worst by return.

    If there is no such episode, the first is shown.
    """
    film_seed: Seed | None = None
    """The training seed whose policy is shown. By default it is the first with such an episode."""
    log: Annotated[tuple[str, ...], Option(names=LOGGED, kind="episode")] = ()
    """Log all steps of all episodes that fail or violate a constraint, or of all episodes.

    The log `episodes.jsonl` has the episodes of all seeds, in the form of the log of a training.
    """
    out: Directory | None = None
    """Where to write. By default it is a new directory in RUN/evaluations, or in evaluations/."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    claim_cores()
    enable_compilation_cache()
    from jaxsafe.agents.callables import draws
    from jaxsafe.commands.evaluation import Film, evaluate
    from jaxsafe.commands.policies import load, load_foreign
    from jaxsafe.evaluate.cases import load_cases
    from jaxsafe.evaluate.evaluator import EVALUATION_KINDS
    from jaxsafe.evaluate.hidden_seed import read_or_draw_hidden_seed
    from jaxsafe.evaluate.passive_safety import with_passive_safety
    from jaxsafe.train.host.options import cases_file
    from jaxsafe.train.host.results import table

    options = Options.parse(argv)
    foreign = options.is_foreign()
    if foreign:
        options.refuse_beside(["checkpoint"], "for a policy from elsewhere")
    if foreign and options.deterministic is False and not draws(options.run):
        raise ConfigError(
            "deterministic: expected true or nothing, found False; "
            "a policy from elsewhere acts by its mode"
        )
    deterministic = True if foreign and options.deterministic is None else options.deterministic
    kinds = [kind for kind in EVALUATION_KINDS if deterministic in (None, kind == "deterministic")]
    film = None
    if not options.render:
        options.refuse_beside(["film", "film_seed"], "without render=gif or another format")
    else:
        film = Film(options.render, options.film, options.film_seed)
    if options.hidden_seed is not None:
        shown = ["seed", "map", "render", "log"]
        options.refuse_beside(shown, "beside hidden_seed, which nothing may show")
    if "mp4" in options.render:
        from jaxsafe.plot.animation import require_ffmpeg

        require_ffmpeg()
    subject = load_foreign(options) if foreign else load(options.run, options.checkpoint)
    if options.film_seed is not None:
        first = subject.facts["seed"]
        last = first + subject.facts["seeds"] - 1
        if not first <= options.film_seed <= last:
            raise ConfigError(
                f"film_seed: expected a seed from {first} to {last}, found {options.film_seed}"
            )
    env = subject.env if foreign else options.change(subject.env, subject.name)
    if difference := differences(subject.env, env):
        print(difference)
    changes = {
        name: value for name, value in options.changes.items() if not (foreign and name == "env")
    }
    if options.passive_safety is not None:
        env = with_passive_safety(env, options.passive_safety)
        changes["passive_safety"] = options.given["passive_safety"]
    cases = None
    if options.cases is not None:
        options.refuse_beside(["episodes"], "beside cases, which say how many there are")
        cases = load_cases(env, cases_file(options.cases))
    hidden = None
    if options.hidden_seed is not None:
        hidden = read_or_draw_hidden_seed(Path(options.hidden_seed))
    request: dict[str, Any] = {
        "run": options.run,
        "episodes": options.episodes if cases is None else cases.size,
        "evaluation_seed": options.seed if hidden is None else None,
        **({} if hidden is None else {"seed_commitment": hidden.commitment}),
        "checkpoint": options.checkpoint or "last",
        **({} if options.cases is None else {"cases": options.cases}),
        "changes": changes,
    }
    path, results, films = evaluate(
        subject,
        env,
        kinds,
        request=request,
        out=options.out,
        film=film,
        cases=cases,
        panels=options.map,
        bounds=options.bounds,
        logged=options.log,
        hidden=hidden,
    )
    print("\n".join([table(results, path), *films]))
    return cli.DIVERGED if "diverged" in results else 0


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options, cli.at_once)
