"""Policies to evaluate: those of all seeds of a run, or the one of a policy file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.callables import CONTROLLER
from jaxsafe.agents.imported_policy import ForeignAgent
from jaxsafe.agents.networks import Params
from jaxsafe.agents.policy_file import find_policy, is_single, read_policy
from jaxsafe.commands.policy_options import PolicyOptions
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.environment import Environment
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.restore import load_params
from jaxsafe.train.host.results import facts


class Subject(NamedTuple):
    """Policies that were trained together, and where they come from."""

    name: str
    """Name of the environment."""

    env: Environment
    """Environment in which the policies were trained."""

    agent: Agent | ForeignAgent
    """Agent that acts with the parameters of a policy."""

    mapper: SeedMapper
    """Mapping of functions over the policies."""

    params: Params
    """Parameters [mapper.padded], placed on the devices."""

    facts: dict[str, Any]
    """Facts for the results: `env`, `preset`, `algorithm`, `seeds`, `seed` (the first), `steps`."""

    place: Path
    """Directory into which evaluations of the policies are written."""

    def not_finite(self) -> list[int]:
        """Return the indices of the policies with parameters that are not finite.

        A training that diverged leaves such policies.
        """
        leaves = jax.tree.leaves(self.mapper.gather(self.params))
        return [
            index
            for index in range(self.facts["seeds"])
            if not all(np.isfinite(leaf[index]).all() for leaf in leaves)
        ]


def load_foreign(options: PolicyOptions) -> Subject:
    """Return a policy that was trained elsewhere or not at all, to act in a task.

    `jaxsafe.agents.imported_policy` says which files can be read, and `jaxsafe.agents.callables`
    says which names are known.

    Args:
        options: the options of the command, which name the policy and the task.

    Raises:
        ConfigError: there is no such task, or the policy does not fit it.
    """
    policy = options.read_foreign()
    mapper = SeedMapper(1)
    params = mapper.place(jax.tree.map(lambda x: np.asarray(x)[None], policy.params))
    path = Path(options.run)
    own_facts = {
        "env": options.task,
        "preset": path.name,
        # A function of a module may be a trained policy.
        "algorithm": "not trained" if options.run.startswith(CONTROLLER) else "unknown",
        "seeds": 1,
        "seed": 0,
        "steps": 0,
    }
    return Subject(
        name=options.task,
        env=policy.env,
        agent=policy.agent,
        mapper=mapper,
        params=params,
        facts=own_facts,
        place=Path("evaluations") / path.stem.replace(":", "_"),
    )


def load(run: str, checkpoint: str | None) -> Subject:
    """Return the policies of a run, or a single policy.

    Args:
        run: a run directory, a policy file, or `pretrained/<task>` for a policy that comes with the
            package.
        checkpoint: `last`, `best` or the step of a checkpoint of a run. None stands for `last`.
            A single policy has no checkpoints, so only None is possible for it.

    Raises:
        ConfigError: there is no such run, policy or checkpoint.
    """
    if is_single(run):
        if checkpoint is not None:
            raise ConfigError(
                f"checkpoint: {run} is a single policy; leave checkpoint={checkpoint} out"
            )
        return _of_file(find_policy(run))
    config, env, name = run_directory.read(Path(run), "run")
    mapper = SeedMapper(config.seeds)
    params, step = load_params(mapper, Path(run), config, env, checkpoint or "last")
    return Subject(
        name=name,
        env=env,
        agent=config.agent,
        mapper=mapper,
        params=params,
        facts={**facts(config, env, name), "steps": step},
        place=Path(run) / "evaluations",
    )


def _of_file(path: Path) -> Subject:
    saved = read_policy(path)
    mapper = SeedMapper(1)
    params = mapper.place(jax.tree.map(lambda x: np.asarray(x)[None], saved.params))
    about = {"env": path.stem, "preset": "unknown", "seed": 0, "step": 0} | saved.about
    # No algorithm but PPO-Lagrangian has a critic of the cost.
    algorithm = "ppo_lagrangian" if saved.agent.cost_critic else "ppo"
    return Subject(
        name=str(about["env"]),
        env=saved.env,
        agent=saved.agent,
        mapper=mapper,
        params=params,
        facts={
            "env": about["env"],
            "preset": about["preset"],
            "algorithm": algorithm,
            "seeds": 1,
            "seed": about["seed"],
            "steps": about["step"],
        },
        place=Path("evaluations") / path.stem,
    )
