"""Evaluating a run after training, into a directory of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxsafe.environment import Environment
from jaxsafe.errors import ConfigError
from jaxsafe.evaluate.seeds import Evaluator, episode_rows
from jaxsafe.train import directory
from jaxsafe.train.config import TrainConfig
from jaxsafe.train.files import append_rows, write_json
from jaxsafe.train.restore import load_params
from jaxsafe.train.results import evaluation, facts
from jaxsafe.train.seeds import SeedMapper


def evaluate_run(
    run: Path,
    config: TrainConfig,
    envs: tuple[Environment, Environment],
    name: str,
    kinds: Sequence[str],
    request: dict[str, Any],
    out: str | None,
) -> tuple[Path, dict[str, Any]]:
    """Evaluate every seed's policy; write `results.json` and `eval.jsonl` and return their place and the results.

    Args:
        run: the run directory.
        config: its configuration.
        envs: the environment it was trained in, and the one to evaluate in.
        name: the environment's name.
        kinds: of `stochastic` and `deterministic`.
        request: `episodes`, `evaluation_seed`, `checkpoint`, and anything else to put into the results.
        out: a new directory; None makes one in `<run>/evaluations`.

    Raises:
        ConfigError: there is no such checkpoint, `out` holds something, or the policies do not fit the environment.
    """
    own, env = envs
    for what in ("observation_size", "action_names", "num_action_points"):
        found, needed = getattr(env, what), getattr(own, what)
        if found != needed:
            raise ConfigError(f"env: the change gives {what} {found}, the policies of {run} have {needed}")
    mapper = SeedMapper(config.seeds)
    params, step = load_params(mapper, run, config, own, request["checkpoint"])
    label = f"{request['checkpoint']}-{request['episodes']}-seed{request['evaluation_seed']}"
    path = directory.make(out, run / "evaluations", label + "-changed" * bool(request["changes"]))
    evaluator = Evaluator(mapper, env, config.agent)
    episodes = {
        kind: evaluator.run(params, request["episodes"], request["evaluation_seed"], kind == "deterministic")
        for kind in kinds
    }
    for kind, one in episodes.items():
        append_rows(path / "eval.jsonl", episode_rows(env, one, config.seed, step=step, kind=kind, final=True))
    results = {
        **facts(config, name), **request, "run": str(run), "steps": step,
        "versions": directory.versions(), "evaluation": evaluation(env, episodes),
    }  # fmt: skip
    write_json(path / "results.json", results)
    return path / "results.json", results
