"""Gymnasium environments: one at a time, or a batch in one compiled step.

    gymnasium.make("jaxsafe/Docking3D-v0", rta="default")
    gymnasium.make_vec("jaxsafe/Docking3D-v0", num_envs=64, autoreset_mode="SameStep")

Observations, rewards and infos are NumPy arrays and Python numbers.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array

from jaxsafe.adapters import environment, observation_bounds
from jaxsafe.environment import Environment, reset, reset_to, step
from jaxsafe.errors import ConfigError, nearest
from jaxsafe.rollout import choose, cut_short
from jaxsafe.types import Key, Record, State, TimeStep

Space = gym.spaces.Box | gym.spaces.MultiDiscrete


class GymEnv(gym.Env[np.ndarray, np.ndarray]):
    """One environment.

    `reset(seed=s)` starts a chain of keys from `jax.random.key(s)`, and each reset takes the next: equal seeds give equal
    episodes, one after another. `reset(options={"start": …, "parameters": …})` starts where `jaxsafe.reset_to` would.

    `info` holds `cost` (1 on a step that violates a safety constraint), `margins` (h of each constraint, safe where ≥ 0),
    `severity`, `reward_terms` and `reward_totals`, `status`, `outcome` (a name, `running` until the end), `is_success`,
    `control_desired` and `control_actual`, `intervening`, and with run time assurance `rta`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 as Gymnasium declares it

    def __init__(
        self,
        task: str | os.PathLike | Environment = "docking3d",
        overrides: Mapping[str, Any] | None = None,
        *,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        """Make the environment.

        Args:
            task: the name of a task, a YAML file, or an environment that `jaxsafe.make` returned.
            overrides: as `jaxsafe.make` takes them.
            render_mode: `rgb_array`, or None for no pictures.
            max_episode_steps: truncate episodes after as many steps, besides the ends of the task.
            options: `actions`, `variant`, `randomize`, `rta` of `jaxsafe.make`.

        Raises:
            ConfigError: as `jaxsafe.make`.
        """
        self.env = environment(task, overrides, options)
        self.render_mode = _checked_render_mode(render_mode)
        self.observation_space, self.action_space = spaces(self.env)
        self._limit = _checked_limit(max_episode_steps)
        self._unpack = _Unpacker(self.env)
        self._key: Any = None  # until the first reset
        self._state: Any = None
        self._frames = Frames(self.env) if render_mode else None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode: see the class."""
        super().reset(seed=seed)
        if seed is not None or self._key is None:
            self._key = jax.random.key(self.np_random_seed % 2**32)
        chosen = _checked_options(options, ("start", "parameters"))
        if chosen:
            self._state, timestep = reset_to(self.env, chosen.get("start", {}), chosen.get("parameters"))
            packed = _pack(timestep)
        else:
            self._key, self._state, packed = _reset_one(self.env, self._key)
        if self._frames is not None:
            self._frames.clear()
        observation, _, _, _, info = self._receive(packed)
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Advance one time step of the task.

        Raises:
            ResetNeeded: before the first reset.
            ConfigError: the action has another shape, or is not whole numbers where actions are discrete.
        """
        if self._state is None:
            raise ResetNeeded("step: call reset first")
        self._state, packed = _step_one(self.env, self._state, _checked_action(self.env, action), self._limit)
        return self._receive(packed)

    def render(self) -> Any:
        """A picture of the episode so far, (height, width, 3), if there is a render mode."""
        if self._frames is None:
            gym.logger.warn("render: no render_mode was chosen; make the environment with render_mode='rgb_array'")
            return None
        if self._state is None:
            raise ResetNeeded("render: call reset first")
        return self._frames.draw()

    def _receive(self, packed: Array) -> tuple[np.ndarray, float, bool, bool, dict]:
        timestep = self._unpack(packed)
        if self._frames is not None:
            self._frames.add(jax.device_get(self._state.sim), timestep.info.margins)
        info = jax.tree.map(
            lambda x: x.item() if isinstance(x, np.ndarray) and not x.ndim else x, facts(self.env, timestep)
        )
        flags = bool(timestep.terminated), bool(timestep.truncated)
        return np.asarray(timestep.observation), float(timestep.reward), *flags, info


class GymVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many environments, stepped by one compiled program.

    Each lane does what a `GymEnv` of its own would do with the same seed; `reset(seed=s)` seeds lane i with s + i. What
    follows the end of an episode is Gymnasium's `autoreset_mode`: `NextStep`, `SameStep` (then `infos["final_obs"]`,
    [num_envs, observation], and `infos["final_info"]` hold what the episode ended with, where `infos["_final_obs"]`) or
    `Disabled` (then `reset(options={"reset_mask": …})` starts those lanes again).
    """

    def __init__(
        self,
        task: str | os.PathLike | Environment = "docking3d",
        num_envs: int = 1,
        overrides: Mapping[str, Any] | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        """Make the environments; arguments as of `GymEnv`.

        Raises:
            ConfigError: as `jaxsafe.make`.
        """
        self.env = environment(task, overrides, options)
        self.num_envs = _checked_count("num_envs", num_envs)
        self.render_mode = _checked_render_mode(render_mode)
        self.autoreset_mode = _checked_mode(autoreset_mode)
        self.metadata = {**GymEnv.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = spaces(self.env)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._limit = _checked_limit(max_episode_steps)
        self._lanes: Any = None  # until the first reset
        self._over = np.zeros(self.num_envs, bool)
        self._unpack = _Unpacker(self.env)
        self._frames = [Frames(self.env) for _ in range(self.num_envs)] if render_mode else []

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Start an episode in each lane, or where `options["reset_mask"]` says."""
        mask = _checked_mask(_checked_options(options, ("reset_mask",)).get("reset_mask"), self.num_envs)
        if self._lanes is None and not mask.all():
            raise ResetNeeded("reset: the first reset takes no reset_mask")
        seeds = self._seeds(seed)
        if self._lanes is None:
            self._lanes = begin(self.env, _keys([entropy if one is None else one for one, entropy in seeds]))
        else:
            seeded = mask & np.array([one is not None for one, _ in seeds])
            keys = _keys([one or 0 for one, _ in seeds])
            self._lanes = restart(self.env, mask, seed_lanes(self._lanes, seeded, keys))
        timestep = self._unpack(_pack(self._lanes.timestep))
        self._over = np.where(mask, False, self._over)
        self._film(mask, timestep)
        return np.array(timestep.observation), _masked(facts(self.env, timestep), mask)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Advance every lane one time step of the task.

        Raises:
            ResetNeeded: before the first reset, or with `Disabled` where a lane's episode is over.
            ConfigError: the actions have another shape, or are not whole numbers where actions are discrete.
        """
        if self._lanes is None:
            raise ResetNeeded("step: call reset first")
        over = self._over
        if self.autoreset_mode is AutoresetMode.DISABLED and over.any():
            lanes = np.flatnonzero(over).tolist()
            raise ResetNeeded(f"step: the episodes of lanes {lanes} are over; reset them with options={{'reset_mask': …}}")
        action = _checked_action(self.env, actions)
        if action.shape != self.action_space.shape:
            raise ConfigError(f"actions: expected shape {self.action_space.shape}, found {action.shape}")
        self._lanes, packed, ended = advance(self.env, self._lanes, action, self._limit, self.autoreset_mode)
        now = self._unpack(packed)
        taken = now if ended is None else self._unpack(ended)  # differ where a lane has started anew in the same step
        self._over, everywhere = taken.terminated | taken.truncated, np.ones(self.num_envs, bool)
        infos = _masked(facts(self.env, now), everywhere)
        if ended is not None and self._over.any():
            final = {"final_obs": np.array(taken.observation), "final_info": facts(self.env, taken)}
            infos |= _masked(final, self._over)
        restarted = {AutoresetMode.NEXT_STEP: over, AutoresetMode.SAME_STEP: self._over}
        self._film(restarted.get(self.autoreset_mode, ~everywhere), now)
        rewards = taken.reward.astype(np.float64)
        return np.array(now.observation), rewards, np.array(taken.terminated), np.array(taken.truncated), infos

    def render(self) -> Any:
        """A picture of each lane's episode so far, if there is a render mode."""
        if not self._frames:
            gym.logger.warn("render: no render_mode was chosen; make the environments with render_mode='rgb_array'")
            return None
        if self._lanes is None:
            raise ResetNeeded("render: call reset first")
        return tuple(frames.draw() for frames in self._frames)

    def _seeds(self, seed: int | list[int | None] | None) -> list[tuple[int | None, int]]:
        """For each lane the seed that was asked for, and one to begin with if none was."""
        if seed is None or isinstance(seed, int | np.integer):
            super().reset(seed=seed)  # sets np_random
            base = [None if seed is None else int(seed) + lane for lane in range(self.num_envs)]
        else:
            base = [None if one is None else int(one) for one in seed]
        if len(base) != self.num_envs:
            raise ConfigError(f"reset: seed: expected {self.num_envs} seeds, found {len(base)}")
        entropy: Any = self.np_random_seed
        return [(one, entropy + lane) for lane, one in enumerate(base)]

    def _film(self, restarted: np.ndarray, timestep: TimeStep) -> None:
        """Remember what pictures show."""
        if not self._frames:
            return
        sim, margins = jax.device_get(self._lanes.state.sim), timestep.info.margins
        for lane, frames in enumerate(self._frames):
            if restarted[lane]:
                frames.clear()
            frames.add(*jax.tree.map(lambda x, lane=lane: x[lane], (sim, margins)))


class Lanes(Record):
    """A batch of episodes, [num_envs], each with the chain of keys that its starts come from."""

    key: Key
    state: State
    timestep: TimeStep  # the latest


@jax.jit
def begin(env: Environment, keys: Key) -> Lanes:
    """Start an episode in each lane."""
    return Lanes(*jax.vmap(_start, in_axes=(None, 0))(env, keys))


@jax.jit
def restart(env: Environment, mask: Array, lanes: Lanes) -> Lanes:
    """Start a new episode where the mask says; starts are drawn only if there is any such lane."""

    def draw(lanes: Lanes) -> Lanes:
        return choose(mask, begin(env, lanes.key), lanes)

    return jax.lax.cond(jnp.any(mask), draw, lambda lanes: lanes, lanes)


@jax.jit
def seed_lanes(lanes: Lanes, mask: Array, keys: Key) -> Lanes:
    """Begin new chains of keys where the mask says."""
    return lanes.replace(key=jnp.where(mask, keys, lanes.key))


@functools.partial(jax.jit, static_argnames="mode")
def advance(
    env: Environment, lanes: Lanes, action: Array, limit: float, mode: AutoresetMode
) -> tuple[Lanes, Array, Array | None]:
    """One step of every lane: the lanes, the time steps to act on next, and with `SameStep` those that ended, packed.

    With `NextStep` a lane whose episode is over starts anew instead of taking the step.
    """
    state, timestep = jax.vmap(step, in_axes=(None, 0, 0))(env, lanes.state, action)
    timestep = cut_short(state, timestep, limit)
    taken = lanes.replace(state=state, timestep=timestep)
    if mode is AutoresetMode.NEXT_STEP:
        taken = restart(env, lanes.timestep.done, taken)
    if mode is AutoresetMode.SAME_STEP:
        following = restart(env, timestep.done, taken)
        return following, _pack(following.timestep), _pack(timestep)
    return taken, _pack(taken.timestep), None


def _start(env: Environment, key: Key) -> tuple[Key, State, TimeStep]:
    following, now = jax.random.split(key)
    return following, *reset(env, now)


@jax.jit
def _reset_one(env: Environment, key: Key) -> tuple[Key, State, Array]:
    key, state, timestep = _start(env, key)
    return key, state, _pack(timestep)


@jax.jit
def _step_one(env: Environment, state: State, action: Array, limit: float) -> tuple[State, Array]:
    state, timestep = step(env, state, action)
    return state, _pack(cut_short(state, timestep, limit))


@jax.jit
def _pack(timestep: TimeStep) -> Array:
    """All numbers in one array, [numbers] or [numbers, num_envs]: thirty take many times as long to hand over."""
    lanes, dtype = timestep.reward.shape, jnp.result_type(float)
    return jnp.concatenate([x.reshape((*lanes, -1)).astype(dtype).T for x in jax.tree.leaves(timestep)])


class _Unpacker:
    """The inverse of `_pack`, on the host."""

    def __init__(self, env: Environment) -> None:
        shapes, self._structure = jax.tree.flatten(jax.eval_shape(reset, env, jax.random.key(0))[1])
        ends = np.cumsum([shape.size for shape in shapes]).tolist()
        self._parts = [(end - shape.size, end, shape.shape, shape.dtype) for shape, end in zip(shapes, ends, strict=True)]

    def __call__(self, packed: Array) -> Any:  # a TimeStep of NumPy arrays
        host = np.asarray(packed)
        lanes = host.shape[1:]  # () of a single environment
        leaves = [host[a:b].T.reshape((*lanes, *shape)).astype(dtype, copy=False) for a, b, shape, dtype in self._parts]
        return jax.tree.unflatten(self._structure, leaves)


class Frames:
    """Pictures of an episode that is still going on."""

    def __init__(self, env: Environment) -> None:
        """Remember nothing yet."""
        self._env, self._past = env, []

    def clear(self) -> None:
        """Forget the episode."""
        self._past.clear()

    def add(self, sim: Any, margins: Mapping[str, Any]) -> None:
        """Remember one step, on the host."""
        self._past.append((sim, margins))

    def draw(self) -> np.ndarray:
        """The latest step with the path that led there, (height, width, 3)."""
        from jaxsafe.plot.animation import Scene  # draws in matplotlib

        sim, margins = jax.tree.map(lambda *steps: np.stack(steps), *self._past)
        return Scene(self._env, sim, margins, self._env.agent).draw(len(self._past) - 1)


def spaces(env: Environment) -> tuple[gym.spaces.Box, Space]:
    """Of observations and of actions."""
    dtype = jnp.result_type(float)
    low, high = observation_bounds(env)
    observation = gym.spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
    if env.num_action_points:
        return observation, gym.spaces.MultiDiscrete(list(env.num_action_points))
    return observation, gym.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)


def facts(env: Environment, timestep: TimeStep) -> dict[str, Any]:
    """What `info` holds, of one step or of a batch on the host."""
    info = timestep.info
    outcomes = np.array(env.outcomes, object)
    found = {
        "cost": timestep.cost,
        "outcome": outcomes[info.outcome],
        "is_success": info.outcome == env.success,
        **{name: getattr(info, name) for name in _FACTS},
    }
    return found if info.rta is None else {**found, "rta": vars(info.rta)}


_FACTS = (
    "margins", "severity", "reward_terms", "reward_totals", "status", "control_desired", "control_actual", "intervening",
)  # fmt: skip


def _masked(found: Mapping[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Gymnasium's form of a batch of infos: beside each entry, under `_` and its name, which lanes have it."""
    mask = mask.copy()  # one for all, since it must not change
    mask.setflags(write=False)
    masked = {}
    for name, value in found.items():
        masked[name] = _masked(value, mask) if isinstance(value, Mapping) else np.asarray(value)
        masked[f"_{name}"] = mask
    return masked


def _keys(seeds: list[int]) -> Key:
    return jax.vmap(jax.random.key)(np.array([seed % 2**32 for seed in seeds], np.uint32))


def _checked_action(env: Environment, action: Any) -> np.ndarray:
    """One type, or JAX would compile for each that it is given; a discrete action that is no whole number stays wrong."""
    array = np.asarray(action)
    whole = array.dtype.kind in "iub" and env.num_action_points
    return array.astype(np.int32 if whole else jnp.result_type(float))


def _checked_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> Mapping[str, Any]:
    for option in options or {}:
        if option not in known:
            raise ConfigError(f"reset: options: unknown {option!r}; choose from {', '.join(known)}")
    return options or {}


def _checked_mask(mask: Any, num_envs: int) -> np.ndarray:
    if mask is None:
        return np.ones(num_envs, bool)
    if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (num_envs,) or not mask.any():
        found = f"{mask.dtype} of shape {mask.shape}" if isinstance(mask, np.ndarray) else repr(mask)
        raise ConfigError(
            f"reset: reset_mask: expected a bool array of shape ({num_envs},), some of it True, found {found}"
        )
    return mask


def _checked_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = [one.value for one in AutoresetMode]
        raise ConfigError(f"autoreset_mode: unknown mode {mode!r}; choose from {nearest(str(mode), known)}") from None


def _checked_render_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, *GymEnv.metadata["render_modes"]):
        raise ConfigError(f"render_mode: found {render_mode!r}; choose from rgb_array, None")
    return render_mode


def _checked_count(name: str, count: Any) -> int:
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise ConfigError(f"{name}: expected a whole number ≥ 1, found {count!r}")
    return int(count)


def _checked_limit(max_episode_steps: int | None) -> float:
    return np.inf if max_episode_steps is None else float(_checked_count("max_episode_steps", max_episode_steps))
