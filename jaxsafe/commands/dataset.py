"""Write episodes of policies as data for offline reinforcement learning.

The data are an .npz file, or a dataset of Minari. Every step has its cost by safety constraint.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

from jaxsafe.commands import cli
from jaxsafe.commands.options import Count, Option, Seed
from jaxsafe.commands.policy_options import PolicyOptions
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.schema.errors import ConfigError

if TYPE_CHECKING:
    from jaxsafe.environment import Environment

KINDS = {
    "random": "actions drawn uniformly",
    "expert": "the policies after the training",
    "medium": "the policies of the checkpoint with about half of the success",
    "replay": "the policies of all checkpoints, as many of each",
    "filtered": "the policies after the training",
}
"""Where the episodes of each kind of data come from, but for the filter."""


class Options(PolicyOptions):
    """The options of `jaxsafe dataset`."""

    groups: ClassVar = {
        "The policies.": ("run", "kind", "deterministic", "activation"),
        "The environment in which they act.": ("env", "env.PATH", "actions", "variant", "rta"),
        "The data.": ("episodes", "seed", "format", "out"),
    }

    run: Annotated[  # pyright: ignore[reportIncompatibleVariableOverride] it may be left out here
        str | None, Option(first=True, examples=("run=runs/docking3d", "env=docking3d"))
    ] = None
    """The policies, as for `jaxsafe evaluate`. With kind=random there are none."""
    kind: Literal["random", "expert", "medium", "replay", "filtered"] = "expert"
    """Where the episodes come from.

    random draws actions. expert and filtered have the policies after the training, filtered under
    run time assurance: the filter of the environment, or rta=default. medium has those of the
    checkpoint with about half of the success, and replay those of all checkpoints. These two need
    the directory of a run.
    """
    deterministic: bool = False
    """Whether the policies act by their most probable action. By default actions are sampled."""
    episodes: Count = 1000
    """Number of whole episodes, of all policies together.

    It is rounded up, because each policy flies as many.
    """
    seed: Seed = 0
    """Seed of the starts and of the noise."""
    format: Literal["npz", "minari"] = "npz"
    """The form of the data: an .npz file, or a dataset in the directory of Minari."""
    out: str | None = None
    """The file, or with format=minari the name. By default it has those of the task and the kind.
    """


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    enable_compilation_cache()
    import jax

    from jaxsafe.dataset.collect import collect_from_each
    from jaxsafe.dataset.files import facts, require_minari, save_dataset, save_minari
    from jaxsafe.environment import filter_name
    from jaxsafe.envs import registered
    from jaxsafe.envs.identity import identity
    from jaxsafe.storage.provenance import versions

    options = Options.parse(argv)
    policies = _policies(options)
    env = policies.env
    place = Path(options.out or f"{policies.name}_{options.kind}.npz")
    if options.format == "npz" and place.suffix != ".npz":
        raise ConfigError(f"out: expected NAME.npz, found {place}")
    if options.format == "minari":
        require_minari(env)
    key = jax.random.key(options.seed)
    each = -(-options.episodes // len(policies.parameters))
    data = collect_from_each(env, policies.policy_of, policies.parameters, key, each)
    found = facts(env, data)
    task = identity(env)
    same = task["id"] is not None and not task["changes"]
    known = registered(env.task) if same else None
    header = {
        "task": policies.name,
        "changes": task["changes"],
        "rta": filter_name(env),
        "kind": options.kind,
        "policies": len(policies.parameters),
        "diverged": policies.diverged,
        "training_steps": policies.training_steps,
        "command": f"jaxsafe dataset {shlex.join(argv)}",
        "versions": versions(),
        "reference_returns": dict(known.reference_returns) if known else {},
        **found,
    }
    if options.format == "npz":
        save_dataset(place, data, header)
        where = str(place)
    else:
        where = options.out or f"jaxsafe/{policies.name}/{options.kind}-v0"
        gymnasium_id = task["id"] if same and env.rta is None else None
        save_minari(where, env, data, header, gymnasium_id)
    print("\n".join([*_told(policies, header), f"written to {where}"]))
    return 0


def _told(policies: _Policies, header: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the terminal says of the data, line by line."""
    count = f"{header['steps']:,} steps in {header['episodes']:,} episodes of "
    rta = "" if header["rta"] == "none" else f", with the filter {header['rta']}"
    yield count + policies.source + rta
    costs = ", ".join(
        f"{cost:.2f} {constraint}"
        for constraint, cost in zip(header["constraints"], header["mean_costs"], strict=True)
    )
    counted = "violating steps" if policies.env.cost == "violation" else "cost"
    yield (
        f"return {header['mean_return']:.3f}, success {header['success_rate']:.1%}, "
        f"{counted} of an episode: {costs or 'no constraint'}"
    )
    if header["given_up"]:
        yield f"episodes still running at the end, given up: {header['given_up']:,}"
    if header["diverged"]:
        yield f"policies left out because their training diverged: {header['diverged']:,}"


class _Policies(NamedTuple):
    """Policies that act in an environment."""

    name: str
    """The name of the environment."""
    source: str
    """Where the policies come from, in words."""
    env: Environment
    policy_of: Callable[[Any], Any]
    """Returns the policy of some parameters."""
    parameters: list[Any]
    training_steps: Sequence[int] = ()
    """Environment steps of each seed at the checkpoints that the policies are from."""
    diverged: int = 0
    """Number of policies that are left out because their parameters are not finite."""


def _policies(options: Options) -> _Policies:
    """Return the policies whose episodes are asked for.

    Raises:
        ConfigError: the options do not fit each other, or there are no such policies.
    """
    from jaxsafe.commands.policies import load, load_foreign
    from jaxsafe.dataset.collect import random_policy
    from jaxsafe.envs import short_name

    kind = options.kind
    if kind == "random":
        options.refuse_beside(["deterministic", "activation"], "with kind=random")
        if (options.run is None) == (options.env is None):
            raise ConfigError(
                "env: kind=random needs a task and no run, for instance env=docking2d"
            )
        options = options.replace(env=options.env or options.run, run=None)
        env = options.make(str(options.env))
        policy = random_policy(env)
        return _Policies(options.task, KINDS[kind], env, lambda _: policy, [()])
    run = options.run
    if run is None:
        raise ConfigError("run: missing; the policies, for instance run=pretrained/docking2d")
    foreign = options.is_foreign()
    if kind in ("medium", "replay"):
        subjects = list(_at_checkpoints(run, kind))
    elif foreign:
        subjects = [load_foreign(options)]
    else:
        _require_finished(run, kind)
        subjects = [load(run, None)]
    first = subjects[0]
    env = first.env if foreign else options.change(first.env, first.name)
    if kind == "filtered" and env.rta is None:
        if options.rta is not None:
            raise ConfigError("rta: kind=filtered needs a filter, found none; or use kind=expert")
        return _policies(options.replace(rta="default"))
    left_out = [[] if foreign else subject.not_finite() for subject in subjects]
    sound = [
        parameters
        for subject, indices in zip(subjects, left_out, strict=True)
        for index, parameters in enumerate(_by_seed(subject))
        if index not in indices
    ]
    if not sound:
        raise ConfigError(f"run: the training of {run} diverged, so it has no policies")
    return _Policies(
        name=short_name(options.env or first.name),
        source=run if foreign else KINDS[kind],
        env=env,
        policy_of=lambda parameters: first.agent.policy(env, parameters, options.deterministic),
        parameters=sound,
        training_steps=[] if foreign else [int(subject.facts["steps"]) for subject in subjects],
        diverged=sum(map(len, left_out)),
    )


def _by_seed(subject: Any) -> list[Any]:
    """Return the parameters of each seed."""
    import jax

    gathered = subject.mapper.gather(subject.params)
    return [
        jax.tree.map(lambda x, index=index: x[index], gathered)
        for index in range(subject.facts["seeds"])
    ]


def _require_finished(run: str, kind: str) -> None:
    """Refuse the directory of a run whose training has not ended.

    Raises:
        ConfigError: it has checkpoints and no results.
    """
    from jaxsafe.agents.policy_file import is_single

    place = Path(run)
    began = not is_single(run) and (place / "checkpoints").is_dir()
    if began and not (place / "results.json").exists():
        raise ConfigError(
            f"run: {run} has not finished, and kind={kind} needs its end; "
            f"go on with jaxsafe train resume={run}"
        )


def _at_checkpoints(run: str, kind: str) -> Iterator[Any]:
    """Yield the policies of a run at the checkpoints from which data of a kind come.

    Raises:
        ConfigError: it is no run, it has no checkpoint of this kind, or for `medium` it has not
            finished.
    """
    from jaxsafe.commands.policies import load
    from jaxsafe.train.host.checkpoint import Checkpoints

    if not Path(run).is_dir():
        raise ConfigError(f"run: kind={kind} needs the directory of a run, found {run}")
    steps = Checkpoints(Path(run)).steps
    if not steps:
        load(run, None)  # which says what is wrong
    if kind == "medium":
        _require_finished(run, kind)
        steps = [_half_way(run, steps)]
    for step in steps:
        yield load(run, str(step))


def _half_way(run: str, steps: Sequence[int]) -> int:
    """Return the checkpoint of a run at which the success was nearest to half of that at the end.

    Raises:
        ConfigError: there is none between a quarter and three quarters of the success at the end.
    """
    from jaxsafe.train.host.log import read_progress

    rows = [row for row in read_progress(Path(run)) if row["success_rate"] is not None]
    rates = [_mean_rate(rows, step) for step in steps]
    final = rates[-1]
    distances = {step: abs(rate - 0.5 * final) for step, rate in zip(steps, rates, strict=True)}
    nearest = min(steps, key=distances.__getitem__)
    if final == 0.0:
        raise ConfigError(f"run: {run} ended without a success, so it has no data of kind=medium")
    if distances[nearest] > 0.25 * final:
        listed = ", ".join(f"{rate:.0%}" for rate in rates)
        raise ConfigError(
            f"run: kind=medium needs a checkpoint near half of the success at the end, {run} has "
            f"{listed}; train with a smaller checkpoint_every"
        )
    return nearest


def _mean_rate(rows: Sequence[Mapping[str, Any]], step: int) -> float:
    """Return the success rate over seeds in the last rows of a progress log up to a step."""
    latest = {row["seed"]: row["success_rate"] for row in rows if row["step"] <= step}
    return sum(latest.values()) / len(latest) if latest else 0.0


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
