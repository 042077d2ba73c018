"""The options of a training run.

The options of the command line are resolved over a recipe from `configs/`, and checked.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from jaxsafe.agents.agent import Agent, check_agent
from jaxsafe.config import load_recipe_name, load_recipes, override
from jaxsafe.config.arguments import Arguments, text
from jaxsafe.environment import Environment, require_success
from jaxsafe.envs import STARTERS, TASKS, adapt, find_task, is_file, make, short_name
from jaxsafe.processors.reward import Intervention
from jaxsafe.schema.component import Component, Range, fields, normalise
from jaxsafe.schema.convert import to_value
from jaxsafe.schema.dotted_paths import find_path, set_path
from jaxsafe.schema.errors import ConfigError, ConfigWarning, choices_text, meant_environment, show
from jaxsafe.schema.retype import set_paths
from jaxsafe.train.host.sinks import LIBRARIES, library
from jaxsafe.train.host.starts import with_unproved_starts
from jaxsafe.train.host.warm_start import agent_options
from jaxsafe.train.hyperparameters import (
    MAX_COUNT,
    PPO,
    CostLimit,
    check_complete_episodes,
    check_cost_limit,
    check_curriculum,
)

Count = Annotated[int, Range(1, largest=MAX_COUNT)]
"""A number of devices or episodes."""

Steps = Annotated[int, Range(1, largest=10**15)]
"""A number of environment steps. For an interval of steps, a huge number means never.

Double precision represents even the largest one exactly.
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

MAPPINGS = ("cost_limit", "ppo.cost_limit", "ppo.multiplier", "ppo.curriculum")
"""Options that take a mapping. In a recipe all other mappings group options."""

NO_RECIPE = "none"
"""Name of the recipe that leaves all options at their defaults."""

MAX_SEEDS = 100_000
"""Largest number of seeds of a run."""

MIN_SAMPLES_PER_DEVICE = 128
"""Smallest number of samples of a minibatch for each device that shares a seed.

Fewer samples take less time than exchanging their gradients.
"""


class TrainConfig(Component):
    """Options of `jaxsafe train`. Steps and episodes are counted for each seed."""

    field_word: ClassVar[str] = "option"
    synonyms: ClassVar[Mapping[str, str]] = {
        **{name: f"ppo.{field}" for name, field in PPO.synonyms.items()},
        "hidden_sizes": "agent.actor.hidden",
        "net_arch": "agent.actor.hidden",
        "num_seeds": "seeds",
        "total_timesteps": "steps",
    }

    preset: str = "engineered_features"
    """The recipe of the task: engineered_features, observation_only, many_envs or shortest_time.

    The docking tasks also have wide, for starts from 100 m to 10 km. The values of a recipe take
    the place of the defaults of other options.
    """
    recipe: str | None = None
    """The task or the file whose recipe is taken, or none for the options' own defaults.

    By default it is the recipe of the task, or the one that an environment's file has or names.
    """
    like: str | None = None
    """The run whose environment and options are taken. Options that are given here replace its own.

    For instance like=runs/docking3d ppo.gamma=0.98 trains it once more with another number.
    """
    algorithm: Literal["ppo", "ppo_lagrangian"] = "ppo"
    """The algorithm. `ppo_lagrangian` also keeps the violating steps below `cost_limit`."""
    cost_limit: CostLimit | Mapping[str, CostLimit] | None = None
    """Number of violating steps that an episode may have, with `algorithm=ppo_lagrangian`.

    It may be one for each constraint, for instance cost_limit='{velocity_limit: 1, keep_out: 0}'.
    A constraint without a limit is not limited then.
    """
    seeds: Annotated[int, Range(1, largest=MAX_SEEDS)] = 1
    """Number of seeds, which are trained as one program."""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """The first seed. With `seeds=10` the seeds are seed … seed + 9."""
    devices_per_seed: Count | None = None
    """Number of devices that share the environments of a seed.

    By default all devices share the environments, as long as each has enough work.
    """
    steps: Steps = 500_000
    """Number of environment steps of each seed."""
    stop_at_success: Annotated[float, Range(0.0, 1.0, open_low=True)] | None = None
    """The success rate of every seed at which training ends before `steps`.

    It is that of the last 100 training episodes. By default training goes on to `steps`.
    """
    actions: Literal["continuous", "discrete", "mixed"] | None = None
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
    acted. By default it is `punishment` if there is a filter.
    """
    start_from: str | None = None
    """The run directory, policy file or `pretrained/TASK` whose networks are trained further.

    It is also written `from=`, for instance from=runs/docking3d. None stands for fresh networks.
    """
    starts: str | None = None
    """A certificate of `jaxsafe verify`. Every second start is in a box that it does not prove."""
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
    """One of this many evaluation episodes is logged step by step.

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
            if count == 1 or minibatch >= count * MIN_SAMPLES_PER_DEVICE
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
        options: the options of `jaxsafe train`, as `resolve` takes them.

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

    The options win over the recipe for the preset, and that wins over the defaults. With `like` the
    options win over those of a run, and no recipe is read.

    Args:
        options: the options of `jaxsafe train` by name, for instance `{"env":
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
    like = arguments.options.get("like")
    if task is None and like is None:
        raise ConfigError("env: missing; for instance env=docking3d")
    for name, example in (("agent", "features"), ("ppo", "gamma")):
        if name in arguments.options:
            raise ConfigError(f"{name}: name one of its options, for instance {name}.{example}=…")
    for sink in ("wandb", "mlflow"):
        if isinstance(arguments.options.get(sink), bool):
            arguments.options[sink] = "jaxsafe" if arguments.options[sink] else None
    if "rta_training" in arguments.options:
        value = arguments.options["rta_training"]
        arguments.options["rta_training"] = current_name("rta_training", value)
    base = None if like is None else _base(text(like, "like"), arguments.options)
    config = base.config if base else TrainConfig()
    for option in arguments.options:
        if hint := meant_environment(option, ("agent", "ppo")):
            raise ConfigError(hint)
    # This comes first, so that a misspelt option is reported before anything slow begins.
    try:
        config = set_paths(config, arguments.options)
    except ConfigError:
        if task is not None:
            _refuse_fields(task, arguments.options)
        raise
    starts = config.starts if "starts" in arguments.options else None
    env, rta_training = _environment(task, config, base, arguments.options)
    name = base.name if base and task is None else str(task)
    if base:
        config, chosen = normalise(base.config), {}
    else:
        config, env, chosen = _with_recipe(name, env, arguments.options)
    if starts is not None:
        env = with_unproved_starts(env, starts)
    env = override(env, overrides, place="env")
    require_success(env)
    config = set_paths(config, {**arguments.options, **chosen})
    config = config.replace(rta_training=rta_training)
    if rta_training == "corrected_action":
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
    check_complete_episodes(env, config.ppo)
    check_cost_limit(env, config.agent, config.ppo)
    check_curriculum(env, config.ppo)
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
    return config, env, short_name(name)


def _refuse_fields(task: str, options: Mapping[str, Any]) -> None:
    """Refuse options that are fields of the environment, such as `mass`, which lack their path."""
    known = fields(TrainConfig)
    env = make(task)
    for option in options:
        path = None if option in known or "." in option else find_path(env, option)
        if path is not None:
            raise ConfigError(
                f"{option}: unknown option; a field of the environment is written env.{path}"
            )


def _environment(
    task: str | None, config: TrainConfig, base: Base | None, given: Mapping[str, Any]
) -> tuple[Environment, str | None]:
    """Return the environment of a training before overrides, and how interventions are treated.

    Args:
        task: a task or a file. None stands for the environment of another run.
        config: the configuration so far.
        base: what the training takes from another run.
        given: the options that the user gave.
    """
    if task is None:
        assert base is not None
        changes = {name: given.get(name) for name in ("actions", "variant", "rta")}
        env = adapt(base.env, base.name, place="", **changes)
    else:
        env = make(task, actions=config.actions, variant=config.variant, rta=config.rta)
    rta_training = config.rta_training
    if base and env.rta is None:
        rta_training = given.get("rta_training")
    elif rta_training is None and env.rta is not None:
        rta_training = "punishment"
    punished = any(isinstance(term, Intervention) for term in env.reward)
    if base and base.config.rta_training == "punishment" and rta_training != "punishment":
        others = [term for term in env.reward if not isinstance(term, Intervention)]
        env = env.replace(reward=tuple(others))
    elif rta_training == "punishment" and not punished:
        env = env.replace(reward=(*env.reward, normalise(Intervention(name="intervention"))))
    return env, rta_training


def _with_recipe(
    task: str, env: Environment, given: Mapping[str, Any]
) -> tuple[TrainConfig, Environment, dict[str, Any]]:
    """Return the configuration and the environment of a recipe, and the options that name it.

    Args:
        task: a task or a file.
        env: its environment.
        given: the options that the user gave.
    """
    settings = recipe(task, given.get("preset"), given.get("recipe"))
    source = settings["recipe"]
    preset = settings["preset"]
    place = f"{source}: recipes.{preset}" if is_file(source) else ""
    changes = {
        path.removeprefix("env."): settings.pop(path)
        for path in [*settings]
        if path.startswith("env.")
    }
    env = override(env, changes, place=f"{place}.env".removeprefix("."))
    config = set_paths(normalise(TrainConfig()), settings, place)
    return config, env, {"recipe": source, "preset": preset}


class Base(NamedTuple):
    """What a training takes from another run."""

    config: TrainConfig
    env: Environment
    name: str
    """The name of the environment."""


def _base(run: str, given: Mapping[str, Any]) -> Base:
    """Return what a training takes from another run.

    Values that follow from other options are at their defaults, because these options may change.

    Args:
        run: the run directory.
        given: the options that the user gave.

    Raises:
        ConfigError: there is no such run, its configuration cannot be read, or an option is given
            that the run decides.
    """
    from jaxsafe.train.host import run_directory  # it imports this module

    for name in ("preset", "recipe"):
        if name in given:
            raise ConfigError(f"{name}: the options are those of {run}; leave out {name} or like")
    config, env, name = run_directory.read(Path(run), "like")
    defaults = TrainConfig()
    same_algorithm = config.algorithm == given.get("algorithm", config.algorithm)
    config = config.replace(
        out=None,
        cost_limit=config.cost_limit if same_algorithm else None,
        agent=config.agent.replace(
            cost_critic=defaults.agent.cost_critic, cost_names=defaults.agent.cost_names
        ),
        ppo=config.ppo.replace(cost_limit=defaults.ppo.cost_limit),
    )
    if config.rta_training == "corrected_action":
        config = config.replace(ppo=config.ppo.replace(learns_from=defaults.ppo.learns_from))
    return Base(config, env, name)


def _inherit_agent(arguments: Arguments, source: str) -> None:
    """Add the options of the agent of the run or policy from which a training starts.

    Raises:
        ConfigError: there is no such run or policy, or the user asks for another agent.
    """
    inherited = agent_options(source)
    for path, value in inherited.items():
        given = [name for name in arguments.options if f"{name}.".startswith(f"{path}.")]
        if given:
            raise ConfigError(f"{given[0]}: the training starts from {source}, which decides it")
        if path == "agent.cost_names":
            numbers = [arguments.options.get(name) for name in ("cost_limit", "ppo.multiplier")]
            names = next((sorted(each) for each in numbers if isinstance(each, Mapping)), [])
            if names != value and inherited.get("agent.cost_critic"):
                kind = f"one for each of {', '.join(value)}" if value else "a number"
                raise ConfigError(f"cost_limit: expected {kind}, because {source} has that")
        elif path != "agent.cost_critic":
            arguments.options[path] = value
        elif value and arguments.options.get("algorithm") != "ppo_lagrangian":
            raise ConfigError(f"from: {source} was trained with algorithm=ppo_lagrangian; add it")
    arguments.options["start_from"] = source


def _with_algorithm(config: TrainConfig, given: Mapping[str, Any]) -> TrainConfig:
    """Return the configuration with the values that follow from its algorithm.

    Args:
        config: the configuration.
        given: the options that the user gave.

    Raises:
        ConfigError: the options do not fit the algorithm.
    """
    for path, instead in (
        ("agent.cost_critic", "algorithm=ppo_lagrangian"),
        ("agent.cost_names", "cost_limit={NAME: N} or ppo.multiplier={NAME: N}"),
        ("ppo.cost_limit", "cost_limit=N"),
    ):
        if path in given:
            raise ConfigError(f"{path}: follows from the algorithm; give {instead}")
    if config.algorithm == "ppo":
        for path in given:
            if path.startswith("ppo.multiplier"):
                raise ConfigError(f"{path}: plain PPO has none; add algorithm=ppo_lagrangian")
        if config.cost_limit is not None:
            raise ConfigError("cost_limit: plain PPO has none; add algorithm=ppo_lagrangian")
        return config
    gains = (
        config.ppo.multiplier_rate,
        config.ppo.multiplier_proportional,
        config.ppo.multiplier_derivative,
    )
    if config.cost_limit is None and any(float(gain) > 0.0 for gain in gains):
        raise ConfigError(
            "cost_limit: missing; the violating steps that an episode may have, for instance "
            "cost_limit=5, or ppo.multiplier_rate=0 for a fixed multiplier"
        )
    if float(config.ppo.gamma) >= 1.0:
        raise ConfigError(
            "ppo.gamma: expected less than 1 with algorithm=ppo_lagrangian, "
            f"found {float(config.ppo.gamma)}"
        )
    ppo = config.ppo
    if config.cost_limit is not None:
        ppo = ppo.replace(cost_limit=config.cost_limit)
        if isinstance(ppo.multiplier, Mapping) and not isinstance(config.cost_limit, Mapping):
            raise ConfigError(
                f"cost_limit: expected a number for each of {', '.join(ppo.cost_names)}, as "
                f"ppo.multiplier has, found {float(config.cost_limit):g}"
            )
    agent = config.agent.replace(cost_critic=True, cost_names=ppo.cost_names)
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


def recipe(task: str, preset: str | None, source: str | None = None) -> dict[str, Any]:
    """Return settings by dotted path from a recipe, with the recipe's source and its preset.

    Without a recipe there is only the preset `observation_only`.

    Args:
        task: the name of the task, or the file of an environment.
        preset: a preset of the recipe. None stands for the first one.
        source: the task or the file whose recipe is taken, as for `find_recipes`.

    Raises:
        ConfigError: there is no such task or file, or the recipe does not have the preset.
    """
    available = find_recipes(task, source)
    presets = available.presets or {"observation_only": {}}
    name = next(iter(presets)) if preset is None else preset
    if name not in presets and RENAMED["preset"].get(name) in presets:
        name = current_name("preset", name)
    if name not in presets:
        raise ConfigError(f"preset: unknown preset {show(name)}{choices_text(name, presets)}")
    options = recipe_paths(available.source, name, presets[name])
    return {"recipe": available.source, "preset": name, **options}


def recipe_paths(source: str, preset: str, options: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the values of a recipe by dotted path. Changes of the environment are `env.PATH`.

    Args:
        source: the task or the file that has the recipe, for the message.
        preset: the name of the recipe.
        options: what stands below this name.

    Raises:
        ConfigError: `env` is no mapping from paths to values.
    """
    rest = dict(options or {})
    changes = rest.pop("env", None) or {}
    if not isinstance(changes, Mapping):
        raise ConfigError(
            f"{source}: recipes.{preset}.env: expected a mapping from paths to values, "
            f"found {show(changes)}"
        )
    return {**flatten(rest, whole=MAPPINGS), **{f"env.{path}": changes[path] for path in changes}}


class Recipes(NamedTuple):
    """The recipes for a training."""

    source: str
    """The task or the file that has them. It is `none` if there are none."""

    presets: dict[str, Any]
    """The options of each preset."""


def find_recipes(task: str, source: str | None = None) -> Recipes:
    """Return the recipes for a training.

    Args:
        task: the name of the task, or the file of an environment.
        source: the task or the file whose recipes are taken, or `none`. None stands for the task
            itself. A file stands for the recipes that it has or names.

    Raises:
        ConfigError: there is no such task or file, or files name one another.
    """
    name = task if source is None else source
    place = "env" if source is None else "recipe"
    seen: list[str] = []
    while name != NO_RECIPE:
        if not is_file(name):
            others = () if place == "env" else (NO_RECIPE,)
            file = find_task(name, place, others).recipe
            presets = load_recipes(configs() / file) if file else {}
            return Recipes(name if presets else NO_RECIPE, presets)
        following = load_recipe_name(name)
        if following is None:
            presets = load_recipes(name)
            return Recipes(name if presets else NO_RECIPE, presets)
        seen.append(name)
        if following in seen:
            raise ConfigError(f"{name}: recipe: {following} leads back here; name another one")
        place = f"{name}: recipe"
        name = following
    return Recipes(NO_RECIPE, {})


def recipes(task: str) -> dict[str, Any]:
    """Return the recipes of a task, or those that its file has or names, by preset.

    Raises:
        ConfigError: there is no such task or file.
    """
    return find_recipes(task).presets


def recipe_options() -> set[str]:
    """Return the options for which a recipe of some task has a value, by dotted path."""
    found = {task: recipes(task).items() for task in (*TASKS, *STARTERS)}
    flat = [recipe_paths(task, *preset) for task, presets in found.items() for preset in presets]
    return {"preset", *(path for settings in flat for path in settings)}


def current_name(option: str, value: Any) -> Any:
    """Return today's name of a value of an option, and warn if an earlier name is given."""
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


def cases_file(name: str) -> str:
    """Return the file of the starts that a task is evaluated from, or `name` if it is a file.

    Raises:
        ConfigError: no task has such a file.
    """
    if Path(name).suffix:
        return name
    files = {path.stem: path for path in sorted((configs() / "cases").glob("*.csv"))}
    if name not in files:
        raise ConfigError(
            f"cases: expected a .csv or .yaml file, or a task, found {name}"
            f"{choices_text(name, files)}"
        )
    return str(files[name])


def flatten(
    tree: Mapping[str, Any], place: str = "", whole: Collection[str] = ()
) -> dict[str, Any]:
    """Return the values of nested mappings by dotted path. Mappings in `whole` are values too."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        path = f"{place}{key}"
        nested = isinstance(value, Mapping) and path not in whole
        flat |= flatten(value, f"{path}.", whole) if nested else {path: value}
    return flat
