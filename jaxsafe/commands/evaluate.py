"""The command `python -m jaxsafe.evaluate run=runs/x` measures trained policies.

It computes their metrics in their own environment or in a changed one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jaxsafe.commands import cli
from jaxsafe.config.arguments import Arguments
from jaxsafe.devices.compilation_cache import enable_compilation_cache
from jaxsafe.devices.seed_mapper import claim_cores

OPTIONS = ("run", "activation", "episodes", "seed", "checkpoint", "deterministic", "render", "out")


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    claim_cores()
    enable_compilation_cache()
    from jaxsafe.commands import environment_choice
    from jaxsafe.commands.evaluation import evaluate, film
    from jaxsafe.commands.policies import load, load_foreign
    from jaxsafe.commands.policy_source import pop_source
    from jaxsafe.schema.errors import ConfigError
    from jaxsafe.train.host.results import table

    arguments = Arguments.parse(argv)
    run = arguments.pop_text("run")
    if run is None:
        raise ConfigError(
            "run: missing; for instance run=runs/docking3d or run=pretrained/docking3d"
        )
    chosen = environment_choice.EnvironmentChoice.pop(arguments)
    elsewhere = pop_source(arguments, run, chosen)
    arguments.refuse_beside(["checkpoint"] if elsewhere else [], "for a policy from elsewhere")
    out, checkpoint, render = (arguments.pop_text(name) for name in ("out", "checkpoint", "render"))
    episodes, seed = arguments.pop_count("episodes", 1000), arguments.pop_seed()
    deterministic = arguments.pop_flag("deterministic")
    arguments.refuse_rest([*OPTIONS, *environment_choice.OPTIONS])
    if render not in (None, "gif"):
        raise ConfigError(f"render: found {render!r}; choose from gif")
    if elsewhere and deterministic is False:
        raise ConfigError(
            "deterministic: expected true or nothing, found False; "
            "a policy from elsewhere acts by its mode"
        )
    deterministic = True if elsewhere else deterministic
    kinds = {
        None: ("stochastic", "deterministic"),
        True: ("deterministic",),
        False: ("stochastic",),
    }[deterministic]
    subject = load_foreign(elsewhere) if elsewhere else load(run, checkpoint)
    env = subject.env if elsewhere else chosen.change(subject.env, subject.name, run)
    if told := environment_choice.differences(subject.env, env):
        print(told)
    request: dict[str, Any] = {
        "run": run,
        "episodes": episodes,
        "evaluation_seed": seed,
        "checkpoint": checkpoint or "last",
        "changes": {
            name: value
            for name, value in chosen.changes.items()
            if not (elsewhere and name == "env")
        },
    }
    path, results = evaluate(subject, env, kinds, request, out, render is not None)
    print(table(results, path))
    if render:
        print("films: " + ", ".join(str(film(path.parent, kind)) for kind in kinds))
    return cli.DIVERGED if "diverged" in results else 0


def usage() -> str:
    """Return the help text."""
    return (
        "usage: python -m jaxsafe.evaluate run=RUN [key=value …]\n\n"
        "  run=RUN                a run directory, a policy file (.npz), or pretrained/TASK\n"
        "  run=FILE env=TASK      a policy from elsewhere: .onnx, "
        "or .npz with kernel_0, bias_0, … (activation=tanh);\n"
        "                         actions=discrete if it gives logits; it acts by its mode\n"
        "  env=TASK|FILE.yaml     another environment of the same observation and action "
        "(default: that of the training)\n"
        "  variant=paper|released   what the variants of a task differ in "
        "(default as in training)\n"
        "  episodes=N             episodes of each seed (default 1000)\n"
        "  seed=N                 evaluation key: other starts and other noise "
        "(default 0, as in the run's own results)\n"
        "  checkpoint=last|best|N best is per seed by success "
        "in the evaluations during training (default last)\n"
        "  rta=none|default|…     run time assurance (default as in training)\n"
        "  rta=FILE.yaml          a filter, or an environment whose filter is taken\n"
        "  deterministic=true|false   one kind only (default both)\n"
        "  render=gif             draw the first episode of the first seed as an animation\n"
        "  env.PATH=VALUE         change the environment, "
        "for instance 'env.deputy.start.position.distance=[1000,1000]'\n"
        "  out=DIR                where to write "
        "(default: a new directory in RUN/evaluations, or in evaluations/)"
    )


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, usage, cli.at_once)
