"""Write episodes of policies as data for offline reinforcement learning.

The data are an .npz file, or a dataset of Minari. Every step has its cost by safety constraint.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
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
    "medium": "the policies of the checkpoint at which half of the success was reached",
    "replay": "the policies of all checkpoints, as many of each",
    "filtered": "the policies after the training, under run time assurance",
}
"""Where the episodes of each kind of data come from."""


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
    run time assurance. medium has those of the checkpoint at which half of the success was reached,
    and replay those of all checkpoints. These two need the directory of a run.
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
    from jaxsafe.envs import find_task
    from jaxsafe.storage.provenance import versions

    options = Options.parse(argv)
    name, env, policy_of, parameters = _policies(options)
    place = Path(options.out or f"{name}_{options.kind}.npz")
    if options.format == "npz" and place.suffix != ".npz":
        raise ConfigError(f"out: expected NAME.npz, found {place}")
    if options.format == "minari":
        require_minari(env)
    key = jax.random.key(options.seed)
    each = -(-options.episodes // len(parameters))
    data = collect_from_each(env, policy_of, parameters, key, each)
    found = facts(env, data)
    header = {
        "task": name,
        "kind": options.kind,
        "command": f"jaxsafe dataset {shlex.join(argv)}",
        "versions": versions(),
        **found,
    }
    if options.format == "npz":
        save_dataset(place, data, header)
        where = str(place)
    else:
        where = options.out or f"jaxsafe/{name}/{options.kind}-v0"
        task = find_task(options.env or name)
        plain = options.changes.keys() <= {"env"} and options.kind != "filtered"
        save_minari(where, env, data, header, task.gymnasium_id if task and plain else None)
    costs = ", ".join(
        f"{cost:.2f} {constraint}"
        for constraint, cost in zip(found["constraints"], found["mean_costs"], strict=True)
    )
    counted = "violating steps" if env.cost == "violation" else "cost"
    print(
        f"{found['steps']:,} steps in {found['episodes']:,} episodes of {KINDS[options.kind]}\n"
        f"return {found['mean_return']:.3f}, success {found['success_rate']:.1%}, "
        f"{counted} of an episode: {costs or 'no constraint'}\nwritten to {where}"
    )
    return 0


class _Policies(NamedTuple):
    """Policies that act in an environment."""

    name: str
    """The name of the environment."""
    env: Environment
    policy_of: Callable[[Any], Any]
    """Returns the policy of some parameters."""
    parameters: list[Any]


def _policies(options: Options) -> _Policies:
    """Return the policies whose episodes are asked for.

    Raises:
        ConfigError: the options do not fit each other.
    """
    from jaxsafe.commands.policies import load, load_foreign
    from jaxsafe.dataset.collect import random_policy

    if options.kind == "random":
        options.refuse_beside(["deterministic", "activation"], "with kind=random")
        if (options.run is None) == (options.env is None):
            raise ConfigError(
                "env: kind=random needs a task and no run, for instance env=docking2d"
            )
        options = options.replace(env=options.env or options.run, run=None)
        env = options.make(str(options.env))
        policy = random_policy(env)
        return _Policies(options.task, env, lambda _: policy, [()])
    run = options.run
    if run is None:
        raise ConfigError("run: missing; the policies, for instance run=pretrained/docking2d")
    if options.kind == "filtered" and options.rta is None:
        options = options.replace(rta="default")
    if options.kind in ("medium", "replay"):
        subjects = list(_at_checkpoints(run, options.kind))
    elif options.is_foreign():
        subjects = [load_foreign(options)]
    else:
        subjects = [load(run, None)]
    first = subjects[0]
    env = first.env if options.is_foreign() else options.change(first.env, first.name)
    return _Policies(
        first.name,
        env,
        lambda parameters: first.agent.policy(env, parameters, options.deterministic),
        [parameters for subject in subjects for parameters in _by_seed(subject)],
    )


def _by_seed(subject: Any) -> list[Any]:
    """Return the parameters of each seed."""
    import jax

    gathered = subject.mapper.gather(subject.params)
    return [
        jax.tree.map(lambda x, index=index: x[index], gathered)
        for index in range(subject.facts["seeds"])
    ]


def _at_checkpoints(run: str, kind: str) -> Iterator[Any]:
    """Yield the policies of a run at the checkpoints from which data of a kind come.

    Raises:
        ConfigError: it is no run, or its log has no success rates.
    """
    from jaxsafe.agents.policy_file import is_single
    from jaxsafe.commands.policies import load
    from jaxsafe.train.host.checkpoint import Checkpoints
    from jaxsafe.train.host.log import read_progress

    if is_single(run):
        raise ConfigError(f"run: kind={kind} needs the directory of a run, found {run}")
    steps = Checkpoints(Path(run)).steps
    if not steps:
        load(run, None)  # which says what is wrong
    if kind == "medium":
        rows = [row for row in read_progress(Path(run)) if row["success_rate"] is not None]
        if not rows:
            raise ConfigError(f"run: no training episode of {run} has ended")
        rates = [_mean_rate(rows, step) for step in steps]
        half = 0.5 * rates[-1]
        steps = [next(step for step, rate in zip(steps, rates, strict=True) if rate >= half)]
    for step in steps:
        yield load(run, str(step))


def _mean_rate(rows: Sequence[dict[str, Any]], step: int) -> float:
    """Return the success rate over seeds in the last rows of a progress log up to a step."""
    latest = {row["seed"]: row["success_rate"] for row in rows if row["step"] <= step}
    return sum(latest.values()) / len(latest) if latest else 0.0


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
