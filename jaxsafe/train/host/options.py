"""The options of a training run.

The options of the command line are resolved over a recipe from `configs/`, and checked.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from jaxsafe.agents.agent import Agent, check_agent
from jaxsafe.config import load_recipes, override
from jaxsafe.config.arguments import Arguments
from jaxsafe.environment import Environment, require_success
from jaxsafe.envs import STARTERS, TASKS, find_task, is_file, make, short_name
from jaxsafe.processors.reward import Intervention
from jaxsafe.schema import yaml12
from jaxsafe.schema.component import Component, Range, normalise
from jaxsafe.schema.convert import to_value
from jaxsafe.schema.dotted_paths import set_path
from jaxsafe.schema.errors import ConfigError, ConfigWarning, nearest, show
from jaxsafe.schema.retype import set_paths
from jaxsafe.train.host.sinks import LIBRARIES, library
from jaxsafe.train.host.warm_start import agent_options
from jaxsafe.train.ppo import MAX_COUNT, PPO
from jaxsafe.types import Dimensionless, Positive

Count = Annotated[int, Range(1, largest=MAX_COUNT)]
"""A number of devices or episodes."""

Steps = Annotated[int, Range(1, largest=10**15)]
"""A number of environment steps. Users raise an interval of steps to mean never.

Double precision counts as far as the largest one.
"""

RENAMED = {
    "preset": {
        "features": "engineered_features",
        "plain": "observation_only",
        "lanes": "many_envs",
        "quick": "shortest_time",
    },
    "rta_training": {
        "punished": "punishment",
        "unpunished": "no_punishment",
        "corrected": "corrected_action",
    },
}
"""Today's names of values by option and earlier name. Commands and old runs may use both."""

MAX_SEEDS = 100_000
WORTHWHILE = 128
"""Least number of samples of a minibatch for each device that shares a seed.

Fewer samples take less time than exchanging their gradients.
"""


class TrainConfig(Component):
    """Options of `python -m jaxsafe.train`. Steps and episodes are counted for each seed."""

    preset: str = "engineered_features"
    """The recipe of the task: engineered_features, observation_only, many_envs or shortest_time.

    Its values take the place of the defaults of other options.
    """
    algorithm: Literal["ppo", "ppo_lagrangian"] = "ppo"
    """The algorithm. `ppo_lagrangian` also keeps the violating steps below `cost_limit`."""
    cost_limit: Annotated[Dimensionless, Positive] | None = None
    """Number of violating steps that an episode may have, with `algorithm=ppo_lagrangian`."""
    seeds: Annotated[int, Range(1, largest=MAX_SEEDS)] = 1
    """Number of seeds, which are trained as one program."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """The first seed. With `seeds=10` the seeds are seed … seed + 9."""
    devices_per_seed: Count | None = None
    """Number of devices that share the environments of a seed.

    By default as many as there are share them, while each has work.
    """
    steps: Steps = 500_000
    """Number of environment steps of each seed."""
    actions: Literal["continuous", "discrete"] | None = None
    """The kind of actions. By default it is what the environment says."""
    variant: Literal["paper", "released"] | None = None
    """The variant of the environment. By default it is `paper`."""
    rta: str | None = None
    """The run time assurance: `default`, or another preset of the task.

    By default it is what the environment says.
    """
    rta_training: Literal["punishment", "no_punishment", "corrected_action"] | None = None
    """How training treats interventions of run time assurance.

    `punishment` adds a reward term for them, and `corrected_action` learns from the control that
    acted. By default it is `punishment`, where there is a filter.
    """
    start_from: str | None = None
    """The run directory, policy file or `pretrained/TASK` whose networks are trained on.

    It is also written `from=`, for instance from=runs/docking3d. None stands for fresh networks.
    """
    out: str | None = None
    """The run directory. By default it is a new directory in runs/."""
    eval_every: Steps | None = None
    """Number of steps between two evaluations. By default it is a tenth of the run."""
    eval_episodes: Count = 100
    """Number of episodes of each evaluation during training."""
    episodes: Count = 1000
    """Number of episodes of the evaluation at the end."""
    checkpoint_every: Steps | None = None
    """Number of steps between two checkpoints. By default it is a tenth of the run."""
    log_every: Steps = 100
    """One of so many evaluation episodes is logged step by step.

    Some episodes are logged before the first evaluation too.
    """
    tensorboard: bool = False
    """Whether the progress also goes to files of TensorBoard. It needs the extra `tensorboard`."""
    wandb: str | None = None
    """Project of Weights & Biases that the progress also goes to. It needs the extra `wandb`.

    `true` stands for the project `jaxsafe`.
    """
    mlflow: str | None = None
    """Experiment of MLflow that the progress also goes to. It needs the extra `mlflow`.

    `true` stands for the experiment `jaxsafe`.
    """
    agent: Agent = Agent()
    ppo: PPO = PPO()

    @property
    def num_updates(self) -> int:
        """Number of updates of each seed: `steps`, rounded up to whole batches."""
        return -(-self.steps // self.ppo.batch_size)

    @property
    def rounding(self) -> str:
        """A line about `steps` if it is no whole number of updates, else an empty text."""
        rounded = self.num_updates * self.ppo.batch_size
        if rounded == self.steps:
            return ""
        return (
            f"steps: {self.steps:,} becomes {rounded:,}, "
            f"a whole number of updates of {self.ppo.batch_size:,}"
        )

    @property
    def shares(self) -> list[int]:
        """The numbers of devices that may share a seed."""
        if self.devices_per_seed is not None:
            return [self.devices_per_seed]
        minibatch = self.ppo.batch_size // self.ppo.num_minibatches
        return [
            count
            for count in self.ppo.shares(self.agent)
            if count == 1 or minibatch >= count * WORTHWHILE
        ]

    def every(self, steps: int | None) -> int:
        """Return an interval of environment steps in updates. None is a tenth of the run."""
        return (
            -(-self.num_updates // 10)
            if steps is None
            else max(1, round(steps / self.ppo.batch_size))
        )


def resolve_all(options: Mapping[str, Any]) -> list[tuple[TrainConfig, Environment, str]]:
    """Return what `resolve` returns. With `env=all` return it for each task.

    Args:
        options: those of `python -m jaxsafe.train`, as `resolve` takes them.

    Raises:
        ConfigError: as `resolve`. Its message begins with the task if the same options do not fit
            all tasks.
    """
    if options.get("env") != "all":
        return [resolve(options)]
    resolved = []
    for task in TASKS:
        try:
            resolved.append(resolve({**options, "env": task}))
        except ConfigError as error:
            raise ConfigError(f"env=all: {task}: {error}") from None
    return resolved


def resolve(options: Mapping[str, Any]) -> tuple[TrainConfig, Environment, str]:
    """Return the complete configuration of a training, its environment, and the environment's name.

    The options win over the task's recipe for the preset, and that wins over the defaults.

    Args:
        options: the options of `python -m jaxsafe.train` by name, for instance `{"env":
            "docking3d", "seeds": 10, "ppo.gamma": 0.99, "env.reward.delta_v.scale": -0.02}`.

    Raises:
        ConfigError: an option is wrong. The message names the option, what was found and what is
            allowed.
    """
    arguments = Arguments(dict(options))
    task = arguments.pop_text("env")
    source = arguments.pop_text("from")
    if source is not None:
        _inherit_agent(arguments, source)
    overrides = arguments.pop_overrides()
    if task is None:
        raise ConfigError("env: missing; for instance env=docking3d")
    for name, example in (("agent", "features"), ("ppo", "gamma")):
        if name in arguments.options:
            raise ConfigError(f"{name}: name one of its options, for instance {name}.{example}=…")
    for sink in ("wandb", "mlflow"):
        if isinstance(arguments.options.get(sink), bool):
            arguments.options[sink] = "jaxsafe" if arguments.options[sink] else None
    if "rta_training" in arguments.options:
        told = arguments.options["rta_training"]
        arguments.options["rta_training"] = current_name("rta_training", told)
    config = TrainConfig()
    # This comes first, so that a misspelt option is told before a slow start.
    config = set_paths(config, arguments.options)
    env = make(task, actions=config.actions, variant=config.variant, rta=config.rta)
    told = config.rta_training or ("punishment" if env.rta is not None else None)
    if told == "punishment" and not any(isinstance(term, Intervention) for term in env.reward):
        env = env.replace(reward=(*env.reward, normalise(Intervention(name="intervention"))))
    env = override(env, overrides, place="env")
    require_success(env)
    config = normalise(TrainConfig())
    settings = recipe(task, arguments.options.get("preset"))
    place = f"{task}: recipes.{settings['preset']}" if is_file(task) else ""
    config = set_paths(config, settings, place)
    config = set_paths(config, {**arguments.options, "preset": settings["preset"]})
    config = config.replace(rta_training=told)
    if told == "corrected_action":
        config = set_path(config, "ppo.learns_from", "actual", to_value)
    config = _with_algorithm(config, arguments.options)
    _check_rta(config, env)
    rows = config.ppo.rows(config.agent)
    if rows % config.ppo.num_minibatches:
        what = "ppo.num_envs" if config.agent.recurrent else "ppo.num_envs × ppo.num_steps"
        why = ", because a network remembers" if config.agent.recurrent else ""
        raise ConfigError(
            f"ppo.num_minibatches: expected a divisor of {what} = {rows}{why}, "
            f"found {config.ppo.num_minibatches}"
        )
    shares = config.ppo.shares(config.agent)
    if config.devices_per_seed is not None and config.devices_per_seed not in shares:
        raise ConfigError(
            f"devices_per_seed: expected one of {', '.join(map(str, shares))}, "
            "which divide ppo.num_envs and the samples of a minibatch, "
            f"found {config.devices_per_seed}"
        )
    if config.ppo.batch_size >= 2**31:
        raise ConfigError(
            f"ppo.num_envs × ppo.num_steps: expected less than 2³¹, found {config.ppo.batch_size:,}"
        )
    if config.num_updates >= 2**31:
        raise ConfigError(
            f"steps: expected less than 2³¹ updates of {config.ppo.batch_size:,}, "
            f"found {config.steps:,} steps"
        )
    if float(config.ppo.horizon_growth) < 1.0 - float(config.ppo.gamma):
        raise ConfigError(
            "ppo.horizon_growth: expected at least 1 − ppo.gamma = "
            f"{1.0 - float(config.ppo.gamma):.3g}, "
            f"or the discount factor falls below 0; found {float(config.ppo.horizon_growth):g}"
        )
    if config.ppo.learning_rate_decay == "exponential" and not config.ppo.final_learning_rate > 0.0:
        raise ConfigError(
            "ppo.final_learning_rate: expected a number > 0 for an exponential decay, found 0"
        )
    if config.seed + config.seeds > 2**31:
        raise ConfigError(
            f"seeds: seed + seeds must not exceed 2³¹, found {config.seed} + {config.seeds}"
        )
    for sink in LIBRARIES:
        if getattr(config, sink):
            library(sink)
    check_agent(config.agent, env)
    return config, env, short_name(task)


def _inherit_agent(arguments: Arguments, source: str) -> None:
    """Add the options of the agent that a training has from what it starts from.

    Raises:
        ConfigError: there is no such run or policy, or the user asks for another agent.
    """
    for path, value in agent_options(source).items():
        given = [name for name in arguments.options if f"{name}.".startswith(f"{path}.")]
        if given:
            raise ConfigError(f"{given[0]}: the training starts from {source}, which decides it")
        if path != "agent.cost_critic":
            arguments.options[path] = value
        elif value and arguments.options.get("algorithm") != "ppo_lagrangian":
            raise ConfigError(f"from: {source} was trained with algorithm=ppo_lagrangian; add it")
    arguments.options["start_from"] = source


def _with_algorithm(config: TrainConfig, given: Mapping[str, Any]) -> TrainConfig:
    """Return the configuration with what follows from its algorithm.

    Args:
        config: the configuration.
        given: the options that the user gave.

    Raises:
        ConfigError: the options do not fit the algorithm.
    """
    for path, instead in (
        ("agent.cost_critic", "algorithm=ppo_lagrangian"),
        ("ppo.cost_limit", "cost_limit=N"),
    ):
        if path in given:
            raise ConfigError(f"{path}: follows from the algorithm; give {instead}")
    if config.algorithm == "ppo":
        for path in ("ppo.multiplier", "ppo.multiplier_rate"):
            if path in given:
                raise ConfigError(f"{path}: plain PPO has none; add algorithm=ppo_lagrangian")
        if config.cost_limit is not None:
            raise ConfigError("cost_limit: plain PPO has none; add algorithm=ppo_lagrangian")
        return config
    if config.cost_limit is None:
        raise ConfigError(
            "cost_limit: missing; the violating steps that an episode may have, "
            "for instance cost_limit=5"
        )
    if float(config.ppo.gamma) >= 1.0:
        raise ConfigError(
            "ppo.gamma: expected less than 1 with algorithm=ppo_lagrangian, "
            f"found {float(config.ppo.gamma)}"
        )
    agent, ppo = (
        config.agent.replace(cost_critic=True),
        config.ppo.replace(cost_limit=config.cost_limit),
    )
    return config.replace(agent=agent, ppo=ppo)


def _check_rta(config: TrainConfig, env: Environment) -> None:
    if config.rta_training is not None and env.rta is None:
        raise ConfigError(
            f"rta_training: {config.rta_training!r} needs run time assurance, "
            "for instance rta=default"
        )
    if config.ppo.learns_from == "actual" and env.num_action_points:
        raise ConfigError(
            "ppo.learns_from: the actual control is no choice of discrete actions; "
            "use actions=continuous"
        )


def recipe(task: str, preset: str | None) -> dict[str, Any]:
    """Return settings by dotted path from the recipe of a task, or from that in its file.

    For an environment without a recipe there is only the preset `observation_only`.

    Args:
        task: the name of the task, or the file of an environment.
        preset: a preset of the recipe. None stands for the first one.

    Raises:
        ConfigError: there is no such task or file, or the recipe does not have the preset.
    """
    known = recipes(task) or {"observation_only": {}}
    name = next(iter(known)) if preset is None else preset
    if name not in known and RENAMED["preset"].get(name) in known:
        name = current_name("preset", name)
    if name not in known:
        raise ConfigError(
            f"preset: unknown preset {show(name)}; choose from {nearest(name, known)}"
        )
    return {"preset": name, **flatten(known[name] or {})}


def recipes(task: str) -> dict[str, Any]:
    """Return the recipes of a task, or those in its file, by preset. There may be none.

    Raises:
        ConfigError: there is no such task or file.
    """
    if is_file(task):
        return load_recipes(task)
    file = find_task(task).recipe
    return yaml12.read(configs() / file) if file else {}


def recipe_options() -> set[str]:
    """Return the options for which a recipe of some task has a value, by dotted path."""
    presets = [settings for task in (*TASKS, *STARTERS) for settings in recipes(task).values()]
    return {"preset", *(path for settings in presets for path in flatten(settings or {}))}


def current_name(option: str, value: Any) -> Any:
    """Return today's name of the value of an option, and warn if it is another one."""
    name = RENAMED[option].get(value, value) if isinstance(value, str) else value
    if name != value:
        warnings.warn(f"{option}: {value} is now called {name}", ConfigWarning, stacklevel=2)
    return name


def configs() -> Path:
    """Return the directory of recipes. It is in the installed package, or beside it in a checkout.

    Raises:
        ConfigError: there is no such directory, as in a zipped package.
    """
    package = Path(__file__).resolve().parents[2]
    for path in (package / "configs", package.parent / "configs"):
        if path.is_dir():
            return path
    raise ConfigError(
        f"preset: no recipes in {package / 'configs'}; install the package unpacked, as pip does"
    )


def flatten(tree: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    """Return the values of nested mappings by dotted path."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= (
            flatten(value, f"{place}{key}.")
            if isinstance(value, Mapping)
            else {f"{place}{key}": value}
        )
    return flat
