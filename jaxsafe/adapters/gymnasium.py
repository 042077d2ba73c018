"""Gymnasium environments, one at a time or as a batch in one compiled step.

Gymnasium makes them by their ids::

    gymnasium.make("jaxsafe/Docking3D-v0", rta="default")
    gymnasium.make_vec("jaxsafe/Docking3D-v0", num_envs=64, autoreset_mode="SameStep")

Observations, rewards and infos are NumPy arrays and Python numbers.
"""

from __future__ import annotations

import inspect
import multiprocessing
import os
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from jaxsafe.adapters import FORKED, checked_count, elements, environment, refuse_fork
from jaxsafe.adapters.gymnasium_spaces import facts, masked, spaces
from jaxsafe.adapters.packed_batch import Episodes, PackedBatch
from jaxsafe.environment import Environment, reset_to
from jaxsafe.schema.errors import ConfigError, choices_text
from jaxsafe.types import Key
from jaxsafe.uncertain import episode_key, random_parts


class _Chains:
    """Chains of PRNG keys from which episodes start, one for each environment of the batch."""

    env: Environment
    _batch: PackedBatch
    _unseeded: np.ndarray
    """Which environments begin a chain at their next start even without a seed, [num_envs].

    These are the environments without a chain, and all of them after `np_random` has been set.
    """

    @property
    def np_random(self) -> np.random.Generator:
        """Return Gymnasium's random number generator.

        Once it has been set, chains that begin without a seed draw their seeds from it.
        """
        return super().np_random  # type: ignore[misc]

    @np_random.setter
    def np_random(self, value: np.random.Generator) -> None:
        if not isinstance(value, np.random.Generator):
            raise ConfigError(f"np_random: expected a numpy.random.Generator, found {value!r}")
        self._np_random = value
        # In Gymnasium −1 stands for a generator whose seed is unknown.
        self._np_random_seed = -1
        self._unseeded[:] = True

    def _start(self, mask: np.ndarray, seeds: Sequence[int | None], placed: _Placed | None) -> None:
        """Start an episode in each environment of the mask.

        Args:
            mask: which environments to start, [num_envs].
            seeds: for each environment of the batch a seed, or None.
            placed: the chosen start of the episodes. None stands for random starts.
        """
        self._begin_chains(mask, seeds)
        if placed is None or placed.random:
            self._batch.restart(mask)
        if placed is None:
            return
        if not placed.random:
            self._batch.place(mask, placed.episode)
            return
        keys = self._batch.now.state.key  # each environment has disturbances of its own
        for index in np.flatnonzero(mask):
            alone = np.arange(len(mask)) == index
            self._batch.place(alone, placed.with_key(episode_key(keys[index])))

    def _begin_chains(self, mask: np.ndarray, seeds: Sequence[int | None]) -> None:
        """Begin a chain in each environment of the mask that has a seed or needs a chain."""
        begin = mask & (self._unseeded | [seed is not None for seed in seeds])
        if not begin.any():
            return
        own_seeds = [0] * len(seeds)
        if any(seed is None for seed in seeds):
            first: Any = self.np_random_seed  # type: ignore[attr-defined]
            own_seeds = (
                self.np_random.integers(2**32, size=len(seeds)).tolist()
                if first == -1
                else range(first, first + len(seeds))
            )
        self._batch.seed(
            begin,
            [own if seed is None else seed for seed, own in zip(seeds, own_seeds, strict=True)],
        )
        self._unseeded &= ~begin


class GymEnv(_Chains, gym.Env[np.ndarray, Any]):
    """One environment with Gymnasium's interface.

    `reset(seed=s)` starts a chain of keys from `jax.random.key(s)`, and each reset takes the next
    key. So equal seeds give equal sequences of episodes.

    `reset(options={"start": …, "parameters": …})` starts where `jaxsafe.reset_to` would.

    `info` holds:

    - `cost`: 1 on a step that violates a safety constraint, or its severity, and `costs` by
      constraint,
    - `margins`: h of each constraint, which is safe where h ≥ 0,
    - `outcome`: the name of the outcome, `running` until the end,
    - `is_success`, `severity`, `status`, `reward_terms` and `reward_totals`,
    - `control_desired`, `control_actual` and `intervening`,
    - `rta`: only with run time assurance.
    """

    # Gymnasium declares it so, without an annotation.
    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 30}  # noqa: RUF012

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
            render_mode: `rgb_array` for pictures, `human` for a window that shows every step, or
                None for neither.
            max_episode_steps: number of steps after which an episode is truncated, if the task has
                not ended it before. None stands for no such limit.
            options: `actions`, `variant`, `randomize` and `rta` of `jaxsafe.make`.

        Raises:
            ConfigError: as `jaxsafe.make`; or there is no display to open a window on.
        """
        _refuse_forking_workers()
        self.env = environment(task, overrides, options)
        self.render_mode = _checked_render_mode(render_mode, GymEnv.metadata["render_modes"])
        self.observation_space, self.action_space = spaces(self.env)
        self._batch = PackedBatch(self.env, 1, _checked_limit(max_episode_steps))
        self._unseeded = np.ones(1, bool)
        self._frames = Frames(self.env) if render_mode else None
        if not _may_have_display():
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
        self._window = Window(self.metadata["render_fps"]) if render_mode == "human" else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Start an episode.

        Args:
            seed: a new chain of keys begins here. None takes the next key of the chain.
            options: `start` and `parameters`, as `jaxsafe.reset_to` takes them. Without options the
                start is random.

        Returns:
            The observation and `info`.

        Raises:
            ConfigError: the seed or the options are refused.
        """
        super().reset(seed=seed)
        chosen = _checked_options(options, ("start", "parameters"))
        self._start(_ALONE, [_checked_seed(seed)], _placed(self.env, chosen))
        if self._frames is not None:
            self._frames.clear()
        observation, _, _, _, info = self._receive(self._batch.now)
        return observation, info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Advance one time step of the task.

        Args:
            action: the action. A mixed action is a mapping from the name of each actuator to its
                element, or the vector of the elements.

        Returns:
            The observation, the reward, `terminated`, `truncated` and `info`.

        Raises:
            ResetNeeded: there was no reset before.
            ConfigError: the action has another shape, or actions are discrete and it is not whole
                numbers.
        """
        if not self._batch.running:
            raise ResetNeeded("step: call reset first")
        self._batch.step(_checked_action(self.env, action)[None])
        return self._receive(self._batch.now)

    def render(self) -> Any:
        """Return a picture of the episode so far, [height, width, 3].

        It is None where a window shows the picture. Without a render mode it is None, with a
        warning.

        Raises:
            ResetNeeded: there was no reset before.
        """
        if self._frames is None:
            gym.logger.warn(
                "render: no render_mode was chosen;"
                " make the environment with render_mode='rgb_array'"
            )
            return None
        if not self._batch.running:
            raise ResetNeeded("render: call reset first")
        if self._window is not None:
            self._window.show(self._frames.draw())
            return None
        return self._frames.draw()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _receive(self, episodes: Episodes) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Return the latest time step as `step` returns it, and show it if there is a window."""
        timestep: Any = jax.tree.map(lambda x: x[0], episodes.timestep)
        if self._frames is not None:
            self._frames.add(jax.tree.map(lambda x: x[0], episodes.state.sim), timestep.info)
        if self._window is not None:
            self.render()
        info = jax.tree.map(
            lambda x: x.item() if isinstance(x, np.generic) else x, facts(self.env, timestep)
        )
        flags = bool(timestep.terminated), bool(timestep.truncated)
        return timestep.observation.copy(), float(timestep.reward), *flags, info


class GymVectorEnv(_Chains, VectorEnv[np.ndarray, Any, np.ndarray]):
    """Many environments, stepped by one compiled program.

    Each environment does what a `GymEnv` of its own would do with the same seed. `reset(seed=s)`
    seeds environment i with s + i. Gymnasium's `autoreset_mode` decides what follows the end of an
    episode:

    - `NextStep`: the next step starts a new episode and ignores the action.
    - `SameStep`: the same step starts a new episode. `infos["final_obs"]`, [num_envs, observation],
      and `infos["final_info"]` hold what the old episode ended with. They count where
      `infos["_final_obs"]` is True.
    - `Disabled`: `reset(options={"reset_mask": …})` starts the environments of the mask again.
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
        """Make the environments.

        Args:
            task: as `GymEnv` takes it.
            num_envs: number of environments.
            overrides: as `jaxsafe.make` takes them.
            autoreset_mode: what follows the end of an episode.
            render_mode: `rgb_array` for pictures, or None.
            max_episode_steps: as `GymEnv` takes it.
            options: as `GymEnv` takes them.

        Raises:
            ConfigError: as `jaxsafe.make`.
        """
        self.env = environment(task, overrides, options)
        self.num_envs = checked_count("num_envs", num_envs)
        self.render_mode = _checked_render_mode(render_mode, ["rgb_array"])
        self.autoreset_mode = _checked_mode(autoreset_mode)
        self.metadata = {
            **GymEnv.metadata,
            "render_modes": ["rgb_array"],
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space, self.single_action_space = spaces(self.env)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._batch = PackedBatch(self.env, self.num_envs, _checked_limit(max_episode_steps))
        self._unseeded = np.ones(self.num_envs, bool)
        self._over = np.zeros(self.num_envs, bool)
        self._frames = [Frames(self.env) for _ in range(self.num_envs)] if render_mode else []

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Start an episode in each environment, or in those of a mask.

        Args:
            seed: the seed of environment 0, to which the others add their index. Or a list that has
                a seed or None for each environment. None takes the next keys of the chains.
            options: those of `GymEnv.reset`, and `reset_mask`, a bool array [num_envs].

        Returns:
            The observations, [num_envs, observation], and the infos.

        Raises:
            ResetNeeded: the first reset has a mask that leaves out some environments.
            ConfigError: the seeds or the options are refused.
        """
        chosen = dict(_checked_options(options, ("start", "parameters", "reset_mask")))
        mask = _checked_mask(chosen.pop("reset_mask", None), self.num_envs)
        if not self._batch.running and not mask.all():
            raise ResetNeeded("reset: the first reset takes no reset_mask")
        placed = _placed(self.env, chosen)
        self._start(mask, self._seeds(seed), placed)
        return self._begun(mask)

    def start_each(
        self, seeds: Sequence[int | None], options: Sequence[Mapping[str, Any] | None]
    ) -> tuple[np.ndarray, dict]:
        """Start an episode in each environment, with a seed and options of its own.

        Args:
            seeds: a seed, or None, for each environment.
            options: options of `GymEnv.reset`, or None, for each environment.

        Returns:
            The observations, [num_envs, observation], and the infos.

        Raises:
            ConfigError: as `GymEnv.reset`.
        """
        checked_seeds = self._seeds(seeds)
        groups = [
            (_checked_options(chosen, ("start", "parameters")), mask)
            for chosen, mask in _grouped(options)
        ]
        placements = [_placed(self.env, chosen) for chosen, _ in groups]
        for placed, (_, mask) in zip(placements, groups, strict=True):
            self._start(mask, checked_seeds, placed)
        return self._begun(np.ones(self.num_envs, bool))

    def _begun(self, mask: np.ndarray) -> tuple[np.ndarray, dict]:
        """Return observations and infos after the environments of a mask have started episodes."""
        episodes = self._batch.now
        self._over = np.where(mask, False, self._over)
        self._film(mask, episodes)
        return np.array(episodes.timestep.observation), masked(
            facts(self.env, episodes.timestep), mask
        )

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Advance every environment one time step of the task.

        Args:
            actions: an action for each environment, [num_envs, action]. Mixed actions may also be
                a mapping from the name of each actuator to its elements, [num_envs].

        Returns:
            The observations, [num_envs, observation]; rewards, `terminated` and `truncated`,
            [num_envs] each; and the infos.

        Raises:
            ResetNeeded: there was no reset before, or `autoreset_mode` is `Disabled` and an episode
                is over.
            ConfigError: the actions have another shape, or actions are discrete and they are not
                whole numbers.
        """
        if not self._batch.running:
            raise ResetNeeded("step: call reset first")
        over = self._over
        if self.autoreset_mode is AutoresetMode.DISABLED and over.any():
            ended = np.flatnonzero(over).tolist()
            raise ResetNeeded(
                f"step: the episodes of environments {ended} are over;"
                " reset them with options={'reset_mask': …}"
            )
        action = _checked_action(self.env, actions)
        expected = (self.num_envs, self.env.action_size)
        if action.shape != expected:
            raise ConfigError(f"actions: expected shape {expected}, found {action.shape}")
        self._batch.step(action)
        restarted = np.zeros_like(over)
        final = {}
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and over.any():
            # The start replaces the step that these environments have taken above.
            restarted = over
            self._batch.restart(over)
        episodes = self._batch.now
        taken = episodes.timestep
        self._over = taken.terminated | taken.truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._over.any():
            restarted = self._over
            self._batch.restart(restarted)
            episodes = self._batch.now
            final = {"final_obs": np.array(taken.observation), "final_info": facts(self.env, taken)}
        self._film(restarted, episodes)
        infos = masked(facts(self.env, episodes.timestep), np.ones(self.num_envs, bool)) | masked(
            final, restarted
        )
        rewards = taken.reward.astype(np.float64)
        flags = np.array(taken.terminated), np.array(taken.truncated)
        return np.array(episodes.timestep.observation), rewards, *flags, infos

    def render(self) -> Any:
        """Return a picture of each environment's episode so far, [height, width, 3] each.

        Without a render mode it is None, with a warning.

        Raises:
            ResetNeeded: there was no reset before.
        """
        if not self._frames:
            gym.logger.warn(
                "render: no render_mode was chosen;"
                " make the environments with render_mode='rgb_array'"
            )
            return None
        if not self._batch.running:
            raise ResetNeeded("render: call reset first")
        return tuple(frames.draw() for frames in self._frames)

    def _seeds(self, seed: int | Iterable[int | None] | None) -> list[int | None]:
        """Return a seed, or None, for each environment.

        Raises:
            ConfigError: there are too many seeds or too few, or one is refused.
        """
        if seed is None or isinstance(seed, int | np.integer):
            # Gymnasium's own reset sets `np_random`.
            super().reset(seed=seed)
            first = _checked_seed(seed)
            return [None if first is None else first + index for index in range(self.num_envs)]
        if not isinstance(seed, Iterable):
            raise ConfigError(
                "reset: seed: expected a whole number ≥ 0, or one for each environment, "
                f"found {seed!r}"
            )
        seeds = [_checked_seed(own) for own in seed]
        if len(seeds) != self.num_envs:
            raise ConfigError(f"reset: seed: expected {self.num_envs} seeds, found {len(seeds)}")
        return seeds

    def _film(self, restarted: np.ndarray, episodes: Episodes) -> None:
        """Remember what the pictures of each environment show.

        Args:
            restarted: which environments have started a new episode, [num_envs].
            episodes: the episodes after the step or reset.
        """
        for index, frames in enumerate(self._frames):
            if restarted[index]:
                frames.clear()
            frames.add(
                *jax.tree.map(
                    lambda x, index=index: x[index],
                    (episodes.state.sim, episodes.timestep.info),
                )
            )


class Frames:
    """Pictures of an episode that is still going on."""

    def __init__(self, env: Environment) -> None:
        self._env = env
        self._scene: Any = None
        self._new: list[tuple[Any, Any]] = []

    def clear(self) -> None:
        """Forget the episode."""
        self._new.clear()
        if self._scene is not None:
            self._scene.clear()

    def add(self, sim: Any, info: Any) -> None:
        """Remember one step.

        Args:
            sim: the simulation after the step, as NumPy arrays.
            info: the facts about the step.
        """
        self._new.append((sim, info))

    def draw(self) -> np.ndarray:
        """Return a picture of the latest step and the path that led there, [height, width, 3]."""
        # Only drawing needs matplotlib.
        from jaxsafe.plot.animation import Scene

        if self._scene is None:
            self._scene = Scene(self._env, self._env.agent)
        for sim, info in self._new:
            self._scene.add(sim, info)
        self._new.clear()
        return self._scene.draw()


class Window:
    """A window that shows pictures as fast as they come, but no faster than `fps`."""

    def __init__(self, fps: int) -> None:
        """Find out whether a window can be opened. It opens with the first picture.

        Raises:
            ConfigError: there is no display, or matplotlib was told to draw into files.
        """
        import matplotlib
        from matplotlib import pyplot

        self._pyplot = pyplot
        self._seconds = 1.0 / fps
        self._latest = 0.0
        self._figure: Any = None
        backend = pyplot.get_backend()
        if not _opens_windows(matplotlib, backend):
            raise ConfigError(
                f"render_mode: human needs a display, and matplotlib draws with {backend} here, "
                "which opens no window; choose rgb_array"
            )

    def show(self, picture: np.ndarray) -> None:
        """Show a picture. Nothing happens after the user has closed the window."""
        if self._figure is None:
            height, width, _ = picture.shape
            self._figure = self._pyplot.figure(
                "jaxsafe", figsize=(width / 100, height / 100), dpi=100
            )
            self._image = self._figure.figimage(picture)
            self._pyplot.show(block=False)
        elif not self._pyplot.fignum_exists(self._figure.number):
            return
        self._image.set_data(picture)
        time.sleep(max(0.0, self._latest + self._seconds - time.monotonic()))
        self._latest = time.monotonic()
        self._figure.canvas.draw()
        self._figure.canvas.flush_events()

    def close(self) -> None:
        """Close the window."""
        if self._figure is not None:
            self._pyplot.close(self._figure)


def _may_have_display() -> bool:
    """Return whether a window could be opened here, as far as that is known without matplotlib."""
    desktop = sys.platform in ("darwin", "win32")
    return desktop or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _opens_windows(matplotlib: Any, backend: str) -> bool:
    """Return whether a backend of matplotlib opens windows."""
    interactive = matplotlib.backends.backend_registry.list_builtin(
        matplotlib.backends.BackendFilter.INTERACTIVE
    )
    # The backend of notebooks that show widgets is not a builtin one.
    return backend.lower() in interactive or "ipympl" in backend


_ALONE = np.ones(1, bool)
"""The mask of a batch of one environment."""


def _refuse_forking_workers() -> None:
    """Raise if `AsyncVectorEnv` is making this environment and will fork its workers.

    Forked workers would wait for ever for JAX's threads. Before it forks them, `AsyncVectorEnv`
    makes an environment in the parent process to read its spaces. The error is raised there,
    because an error in a worker reaches the parent as a mere EOFError.

    Raises:
        ConfigError: the workers will be forked.
    """
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_code is AsyncVectorEnv.__init__.__code__:
            chosen = frame.f_locals.get("context") or multiprocessing.get_start_method(
                allow_none=True
            )
            # The first start method of the list is the default.
            if (chosen or multiprocessing.get_all_start_methods()[0]) == "fork":
                raise ConfigError(
                    f"AsyncVectorEnv: {FORKED},"
                    " or leave out vectorization_mode for the compiled batch"
                )
        frame = frame.f_back


MAX_SEED_BITS = 128
"""The largest number of bits of a seed. Seeds that Gymnasium draws itself have that many."""


def _checked_seed(seed: Any) -> int | None:
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ConfigError(f"reset: seed: expected a whole number ≥ 0, found {seed!r}")
    bits = int(seed).bit_length()
    if bits > MAX_SEED_BITS:
        raise ConfigError(f"reset: seed: expected at most {MAX_SEED_BITS} bits, found {bits}")
    return int(seed)


def _checked_action(env: Environment, action: Any) -> np.ndarray:
    """Return an action as an array of one dtype, so that the step is compiled only once.

    Discrete actions that are not integers are passed on as they are and fail in the step.

    Raises:
        ConfigError: elements by name are not those of the actuators, or have different shapes.
    """
    if isinstance(action, Mapping):
        parts = list(map(np.asarray, elements(env, action)))
        shapes = {part.shape for part in parts}
        if len(shapes) > 1:
            raise ConfigError(
                f"action: expected one shape of all elements, found {', '.join(map(str, shapes))}"
            )
        action = np.stack(parts, axis=-1)
    array = np.asarray(action)
    whole = array.dtype.kind in "iub" and env.action_kind == "discrete"
    return array.astype(np.int32 if whole else jnp.result_type(float))


def _grouped(
    options: Sequence[Mapping[str, Any] | None],
) -> list[tuple[Mapping[str, Any] | None, np.ndarray]]:
    """Return each of the options with a mask of the environments that have them, [num_envs].

    All environments without options are one group.
    """
    groups = {id(chosen) if chosen else None: chosen for chosen in options}
    keys = np.array([id(chosen) if chosen else None for chosen in options], object)
    return [(chosen, keys == key) for key, chosen in groups.items()]


class _Placed:
    """The start of an episode that options choose.

    Attributes:
        episode: an episode that begins there.
        random: whether disturbances and errors of sensors are random. Each episode then needs a key
            of its own.
    """

    def __init__(self, env: Environment, chosen: Mapping[str, Any]) -> None:
        refuse_fork()
        self._arguments = (env, chosen.get("start", {}), chosen.get("parameters"))
        self.random = bool(random_parts(env))
        self.episode = self.with_key(jax.random.key(0) if self.random else None)

    def with_key(self, key: Key | None) -> Episodes:
        """Return an episode that begins there. Its disturbances are drawn from the key."""
        return Episodes(*reset_to(*self._arguments, key=key))


def _placed(env: Environment, chosen: Mapping[str, Any]) -> _Placed | None:
    """Return the start that the options choose, or None if they choose none."""
    return _Placed(env, chosen) if chosen else None


def _checked_options(
    options: Mapping[str, Any] | None, known: tuple[str, ...]
) -> Mapping[str, Any]:
    if options and not isinstance(options, Mapping):
        raise ConfigError(f"reset: options: expected a dict, found {options!r}")
    for option in options or {}:
        if option not in known:
            raise ConfigError(f"reset: options: unknown {option!r}{choices_text(option, known)}")
    return options or {}


def _checked_mask(mask: Any, num_envs: int) -> np.ndarray:
    if mask is None:
        return np.ones(num_envs, bool)
    if (
        not isinstance(mask, np.ndarray)
        or mask.dtype != bool
        or mask.shape != (num_envs,)
        or not mask.any()
    ):
        found = (
            f"{mask.dtype} of shape {mask.shape}" if isinstance(mask, np.ndarray) else repr(mask)
        )
        raise ConfigError(
            f"reset: reset_mask: expected a bool array of shape ({num_envs},), some of it True,"
            f" found {found}"
        )
    return mask


def _checked_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        choices = [member.value for member in AutoresetMode]
        raise ConfigError(
            f"autoreset_mode: unknown mode {mode!r}{choices_text(str(mode), choices)}"
        ) from None


def _checked_render_mode(render_mode: str | None, known: Sequence[str]) -> str | None:
    if render_mode not in (None, *known):
        raise ConfigError(
            f"render_mode: found {render_mode!r}{choices_text(render_mode, [*known, None])}"
        )
    return render_mode


def _checked_limit(max_episode_steps: int | None) -> float:
    return (
        np.inf
        if max_episode_steps is None
        else float(checked_count("max_episode_steps", max_episode_steps))
    )
