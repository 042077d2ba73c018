"""Reading checkpoints back.

The structure comes from the configuration, and the numbers come from the files.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.agents.networks import Params
from jaxsafe.agents.policy_file import find_policy, is_single, read_policy
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.environment import DIVERGED, Environment
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.storage.files import finite
from jaxsafe.storage.forms import AMOUNT, COUNT, check
from jaxsafe.train import ppo
from jaxsafe.train.host import run_directory
from jaxsafe.train.host.checkpoint import Checkpoints
from jaxsafe.train.host.options import TrainConfig


def structure(env: Environment, config: TrainConfig) -> dict[str, Any]:
    """Return shapes and types of what a checkpoint holds.

    That is the training state and the best parameters of each seed. All have a leading axis of
    seeds.
    """

    def seeds(keys: jax.Array) -> ppo.TrainState:
        return jax.vmap(lambda key: ppo.init(env, config.agent, config.ppo, key))(keys)

    state = jax.eval_shape(seeds, jax.random.split(jax.random.key(0), config.seeds))
    return {
        "state": state,
        "best": {
            "params": state.average,
            "success": jax.ShapeDtypeStruct((config.seeds,), jnp.float32),
        },
    }


NEWER = (
    "control_desired",
    "control_actual",
    "costs",
    "multiplier_boost",
    "cost_excess",
    "measured",
    "control_effort",
)
"""Arrays that older checkpoints lack, by the last part of their names.

They are 0 then, or empty, because no part of an older environment or algorithm looks at them.
"""

MAY_CHANGE = (
    "steps",
    "stop_at_success",
    "devices_per_seed",
    "out",
    "eval_every",
    "eval_episodes",
    "episodes",
    "checkpoint_every",
    "log_every",
    "tensorboard",
    "wandb",
    "mlflow",
)
"""Options that may differ from those of a checkpoint.

They say how long to train, on which devices, where the run is, when it is evaluated and saved, and
where its progress goes.
"""


def made_from(env: Environment, config: TrainConfig) -> dict[str, Any]:
    """Return what a checkpoint belongs to, as data of JSON.

    That is the environment, and the options that decide the numbers.
    """
    content = json.loads(json.dumps(finite(run_directory.described(config, env))))
    for name in MAY_CHANGE:
        del content["training"][name]
    return content


def restore(
    checkpoints: Checkpoints, step: int, env: Environment, config: TrainConfig
) -> tuple[Any, dict[str, Any]]:
    """Read a checkpoint of this environment and configuration.

    Args:
        checkpoints: the checkpoints of the run.
        step: environment steps of each seed at the checkpoint.
        env: the environment of the run.
        config: the configuration of the run.

    Returns:
        The arrays of the checkpoint, with the structure that `structure` returns, and its facts.

    Raises:
        ConfigError: it cannot be read, or another environment or configuration made it.
    """
    facts = checkpoints.facts(step)
    place = f"{checkpoints.directory / str(step)}: facts"
    check(facts, {"updates": COUNT, "wall_s": AMOUNT, "compile_s": AMOUNT}, place)
    if "made_from" in facts:
        own = made_from(env, config)
        path, before, now = _difference(facts["made_from"], own)
        if path:
            path, before, now = _difference(_as_of_today(facts["made_from"]), own)
        if path:
            raise ConfigError(
                f"{checkpoints.directory.parent / 'config.yaml'}: {path}: "
                f"found {now}, but the checkpoints were made with "
                f"{before}; put that back, or begin a new run"
            )
    if facts["updates"] * config.ppo.batch_size != step:
        raise ConfigError(
            f"{place}: updates: expected those of {step} steps, found {facts['updates']}"
        )
    like = structure(env, config)
    # In states of older versions each outcome had a flag. No other array has this name.
    if checkpoints.has(step, DIVERGED):
        flag = jax.ShapeDtypeStruct((config.seeds, config.ppo.num_envs), bool)
        like["state"] = _with_ended(like["state"], dict.fromkeys(env.outcomes[1:], flag))
    restored = checkpoints.restore(step, like, NEWER)
    return {**restored, "state": _with_ended(restored["state"], {})}, facts


def _with_ended(state: ppo.TrainState, flags: dict[str, Any]) -> ppo.TrainState:
    """Return a training state with flags of what ended, which states of older versions kept."""
    env_state = state.env_state
    return state.replace(env_state=env_state.replace(sim=env_state.sim.replace(ended=flags)))


def _as_of_today(before: Any) -> Any:
    """Return what a checkpoint was made from, as this version describes it.

    A field that is newer than the checkpoint has its default.
    """
    try:
        config, env = run_directory.from_described(before, "")
    except (AttributeError, ConfigError, KeyError, TypeError):
        return before
    return made_from(env, config)


def _difference(before: Any, now: Any, place: str = "") -> tuple[str, Any, Any]:
    """Return where two trees of data first differ, as a dotted path, and what both have there.

    The path is empty if they are equal.
    """
    if isinstance(before, dict) and isinstance(now, dict):
        names = [*dict.fromkeys([*before, *now])]
        pairs = [(name, before.get(name, "nothing"), now.get(name, "nothing")) for name in names]
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = [(f"[{index}]", *pair) for index, pair in enumerate(zip(before, now, strict=True))]
    else:
        return ("", None, None) if before == now else (place, show(before), show(now))
    for name, old, new in pairs:
        difference = _difference(old, new, f"{place}.{name}" if place else name)
        if difference[0]:
            return difference
    return "", None, None


def start_params(mapper: SeedMapper, config: TrainConfig, env: Environment) -> Params:
    """Return the networks of every seed at the start of a training that does not start afresh.

    The i-th seed starts with the i-th policy of the run that it starts from. If there are fewer
    policies than seeds, they are taken again from the first one on.

    Raises:
        ConfigError: there is no such run or policy, or its networks have other shapes.
    """
    source = str(config.start_from)
    if is_single(source):
        params = read_policy(find_policy(source)).params
        stacked = jax.tree.map(lambda x: np.asarray(x)[None], params)
    else:
        before, own_env, _ = run_directory.read(Path(source), "from")
        seeds = SeedMapper(before.seeds)
        stacked = seeds.gather(load_params(seeds, Path(source), before, own_env, "last")[0])
    like = structure(env, config)["state"].average
    policies = jax.tree.leaves(stacked)[0].shape[0]

    def pick(path: Any, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        part = stacked
        for entry in path:
            part = part.get(entry.key, {}) if isinstance(part, dict) else {}
        shape = np.shape(part)[1:] if not isinstance(part, dict) else "nothing"
        if shape != leaf.shape[1:]:
            name = jax.tree_util.keystr(path, simple=True, separator="/")
            raise ConfigError(
                f"from: {name}: expected numbers of shape {leaf.shape[1:]}, found {shape}; "
                f"{source} observes or does something else"
            )
        return np.asarray(part)[np.arange(config.seeds) % policies]

    return mapper.place(jax.tree_util.tree_map_with_path(pick, like))


def load_params(
    mapper: SeedMapper, run: Path, config: TrainConfig, env: Environment, which: str
) -> tuple[Params, int]:
    """Return the networks of every seed from a checkpoint, and the step of that checkpoint.

    Args:
        mapper: the mapper of the seeds.
        run: the run directory.
        config: the configuration of the run.
        env: the environment of the run.
        which: the checkpoint: `last`, or a step. `best` stands for the best parameters of each seed
            in the last checkpoint.

    Raises:
        ConfigError: there is no such checkpoint, or it cannot be read.
    """
    checkpoints = Checkpoints(run)
    if not checkpoints.steps:
        raise ConfigError(f"run: {run} has no checkpoint yet")
    try:
        step = checkpoints.steps[-1] if which in ("last", "best") else int(which)
    except ValueError:  # no whole number, or one of thousands of digits
        choices = ["last", "best", *map(str, checkpoints.steps)]
        raise ConfigError(
            f"checkpoint: found {show(which)}{choices_text(which, choices)}"
        ) from None
    content, _ = restore(checkpoints, step, env, config)
    params = content["best"]["params"] if which == "best" else content["state"].average
    return mapper.place(params), step
