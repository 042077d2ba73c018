"""One whole episode, to look at: `jaxsafe.fly`."""

from __future__ import annotations

import base64
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.devices.latest_programs import latest_programs
from jaxsafe.environment import Environment, require_environment, reset, reset_to, step
from jaxsafe.evaluate.episodes import max_steps
from jaxsafe.evaluate.evaluator import MAX_RECORDED_STEPS, RECORDED_STEPS_PER_CALL
from jaxsafe.rollout import (
    Policy,
    RecurrentPolicy,
    RolloutState,
    act,
    first_memory,
    require_hashable,
)
from jaxsafe.schema.describe import Described, Rows, brief
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.storage.columns import flat
from jaxsafe.storage.files import write_csv
from jaxsafe.types import Key, State, TimeStep, require_key

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_reset = jax.jit(reset)


class Flight(Described):
    """One episode on the host, as NumPy arrays over its n steps.

    The arrays of instants have n + 1 entries, the first one for the start: `times`, `platforms`,
    `observations`, `status` and `margins`. The arrays of steps have n entries: `actions`,
    `control_desired`, `control_actual`, `intervening`, `rewards` and `costs`. Step k leads from
    instant k to instant k + 1.
    """

    env: Environment
    """The environment of the episode."""
    states: Any  # a `State` of NumPy arrays [n + 1]
    timesteps: Any  # a `TimeStep` of NumPy arrays [n + 1]
    actions: np.ndarray
    """What the policy returned, [n, action_size]."""

    def __init__(self, env: Environment, states: Any, timesteps: Any, actions: np.ndarray) -> None:
        self.env = env
        self.states = states
        self.timesteps = timesteps
        self.actions = actions

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def times(self) -> np.ndarray:
        """Seconds since the start, [n + 1]."""
        return self.states.sim.time

    @property
    def platforms(self) -> Mapping[str, Any]:
        """The states of the platforms by name, for instance `platforms["deputy"].position`."""
        return self.states.sim.platforms

    @property
    def observations(self) -> np.ndarray:
        """The observations, [n + 1, observation_size]. The policy acted on all but the last."""
        return self.timesteps.observation

    @property
    def control_desired(self) -> np.ndarray:
        """The controls that the policy asked for, in physical units, [n, action_size]."""
        return self.timesteps.info.control_desired[1:]

    @property
    def control_actual(self) -> np.ndarray:
        """The controls that acted, after run time assurance, [n, action_size]."""
        return self.timesteps.info.control_actual[1:]

    @property
    def intervening(self) -> np.ndarray:
        """Whether run time assurance changed the control of each step, [n]."""
        return self.timesteps.info.intervening[1:]

    @property
    def rewards(self) -> np.ndarray:
        """The reward of each step, [n]."""
        return self.timesteps.reward[1:]

    @property
    def costs(self) -> np.ndarray:
        """The cost of each step, [n]: 1 if it violates a constraint, else 0, or the severity."""
        return self.timesteps.cost[1:]

    @property
    def status(self) -> Mapping[str, np.ndarray]:
        """The statuses by name, [n + 1]."""
        return self.timesteps.info.status

    @property
    def margins(self) -> Mapping[str, np.ndarray]:
        """The margin h of each constraint by name, [n + 1]. It is safe where h ≥ 0."""
        return self.timesteps.info.margins

    @property
    def outcome(self) -> str:
        """How the episode ended: one of `env.outcomes`, or `running` if it was given up."""
        return self.env.outcomes[int(self.timesteps.info.outcome[-1])]

    def plot(self, world: bool = False) -> Figure:
        """Return a figure of the paths, and of distance, controls and margins over time.

        It is a matplotlib `Figure`, which a notebook shows.

        Args:
            world: whether the paths are drawn in the axes of the world. By default they are as seen
                from the first platform that is not the agent.
        """
        from jaxsafe.plot.flight import flight_figure

        return flight_figure(self.env, (self.states, self.timesteps), self._title(), world)

    def animate(self, path: str | os.PathLike | None = None) -> Film:
        """Return a film of the episode, which a notebook shows.

        Args:
            path: a file to write it to. It ends in `.gif`, or in `.mp4` if ffmpeg is installed.
                With None no file is written.

        Raises:
            ConfigError: the path has another ending, or ffmpeg is missing.
        """
        from jaxsafe.plot.animation import animate

        kind = "gif" if path is None else Path(path).suffix[1:]
        if kind not in FILMS:
            raise ConfigError(f"animate: expected a path that ends in .gif or .mp4, found {path}")
        with tempfile.TemporaryDirectory() as directory:
            file = Path(directory) / f"episode.{kind}" if path is None else Path(path)
            animate(self.env, (self.states, self.timesteps), file, self._title())
            return Film(file.read_bytes(), kind)

    def columns(self) -> dict[str, np.ndarray]:
        """Return all numbers of the episode as columns [n + 1] by dotted name.

        `pandas.DataFrame(flight.columns())` makes a table of them. The row of an instant has the
        action, the controls and the reward of the step that led there. At the start the action is
        NaN.
        """
        info = self.timesteps.info
        no_action = np.full((1, self.env.action_size), np.nan)
        actions = np.concatenate([no_action, self.actions])
        names = self.env.action_names
        values = {
            "time": self.times,
            **{name: vars(platform) for name, platform in self.platforms.items()},
            "observation": dict(zip(self.env.observation_names, self.observations.T, strict=True)),
            "action": dict(zip(names, actions.T, strict=True)),
            "control_desired": dict(zip(names, info.control_desired.T, strict=True)),
            "control_actual": dict(zip(names, info.control_actual.T, strict=True)),
            "intervening": info.intervening,
            "reward": self.timesteps.reward,
            "reward_terms": info.reward_terms,
            "cost": self.timesteps.cost,
            "status": self.status,
            "margins": self.margins,
            "outcome": np.array(self.env.outcomes, object)[info.outcome],
        }
        return dict(flat(_by_component(values)))

    def to_csv(self, path: str | os.PathLike) -> Path:
        """Write the columns to a CSV file and return its path."""
        columns = {name: list(map(_cell, column)) for name, column in self.columns().items()}
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        write_csv(Path(path), rows)
        return Path(path)

    def _title(self) -> str:
        return self.env.task or "episode"

    def _heading(self) -> str:
        task = f" of {self.env.task}" if self.env.task else ""
        return f"Flight{task}: {self.outcome} after {len(self)} steps, {self.times[-1]:g} s"

    def _rows(self) -> Rows:
        yield "return", brief(self.rewards.sum())
        yield "violating steps", f"{int((self.costs > 0.0).sum())} of {len(self)}"
        for name, margin in self.margins.items():
            yield "least margin", f"{name} {brief(margin.min())}"
        yield "altered steps", f"{int(self.intervening.sum())} of {len(self)}"
        agent = self.platforms[self.env.agent]
        for when, index in (("start", 0), ("end", -1)):
            yield when, f"{self.env.agent} at {brief(agent.position[index])}"
        yield "arrays", "times, platforms, observations, status, margins [n + 1]"
        yield "", "actions, control_desired, control_actual, intervening, rewards, costs [n]"


FILMS = {
    "gif": '<img src="data:image/gif;base64,{}">',
    "mp4": '<video controls src="data:video/mp4;base64,{}"></video>',
}
"""How HTML shows each kind of film."""


class Film:
    """An animated GIF or an mp4, which a notebook shows."""

    def __init__(self, data: bytes, kind: str) -> None:
        self.data = data
        self.kind = kind

    def save(self, path: str | os.PathLike) -> Path:
        """Write the film to a file and return its path."""
        Path(path).write_bytes(self.data)
        return Path(path)

    def __repr__(self) -> str:
        size = f"{self.kind} of {len(self.data):,} bytes"
        return f"Film: {size}; film.save('episode.{self.kind}') writes it"

    def _repr_html_(self) -> str:
        return FILMS[self.kind].format(base64.b64encode(self.data).decode())


def fly(
    env: Environment,
    policy: Policy | RecurrentPolicy,
    key: Key | None = None,
    start: Mapping[str, Mapping[str, Any]] | tuple[State, TimeStep] | None = None,
) -> Flight:
    """Fly one whole episode and return it.

    The program is compiled once for an environment and a policy, whatever the start and the numbers
    of the environment are. The 32 latest are kept.

    Args:
        env: the environment.
        policy: `policy(key, observation)` returns an action. Neither has a batch axis, as in
            `rollout` without `num_envs`. It may be a `RecurrentPolicy`.
        key: a typed PRNG key. It decides a random start and the noise of the policy. None stands
            for `jax.random.key(0)`.
        start: the start: what `reset` or `reset_to` returned, or the platform states that
            `reset_to` takes, such as `{"deputy": {"position": [100, 0], "velocity": [0, 0]}}`.
            None stands for a random start.

    Returns:
        The episode up to its end. An episode of more than 25,000 steps is given up.

    Raises:
        ConfigError: the start or the policy does not fit the environment, or the key is a plain
            number.
    """
    require_environment("fly: env", env)
    require_key("fly: key", key)
    require_hashable(policy)
    key_start, key_act = jax.random.split(jax.random.key(0) if key is None else key)
    state, timestep = _reset(env, key_start) if start is None else _started(env, start, key_start)
    # A weakly typed number would compile the program again.
    state, timestep = jax.tree.map(lambda x: jnp.asarray(x, x.dtype), (state, timestep))
    pieces = [jax.tree.map(lambda x: np.asarray(x)[None], (state, timestep))]
    position = RolloutState(
        state=state, observation=timestep.observation, memory=first_memory(policy)
    )
    actions = []
    limit = min(max_steps(env), MAX_RECORDED_STEPS)
    for before in range(0, limit, RECORDED_STEPS_PER_CALL):
        position, recorded = _fly_on(policy, env, key_act, jnp.asarray(before), position)
        recorded = jax.device_get(recorded)
        ends = np.flatnonzero(recorded[1].done)
        size = ends[0] + 1 if ends.size else min(RECORDED_STEPS_PER_CALL, limit - before)
        *piece, acted = jax.tree.map(lambda x, size=size: x[:size], recorded)
        pieces.append(tuple(piece))
        actions.append(acted)
        if ends.size:
            break
    states, timesteps = jax.tree.map(lambda *x: np.concatenate(x), *pieces)
    return Flight(env, states=states, timesteps=timesteps, actions=np.concatenate(actions))


@latest_programs
def _fly_on(
    policy: Policy | RecurrentPolicy,
    env: Environment,
    key: Key,
    before: jax.Array,
    position: RolloutState,
) -> tuple[RolloutState, tuple[State, TimeStep, jax.Array]]:
    """Go on with an episode, and return its states, time steps and actions."""

    def one_step(position: RolloutState, t: jax.Array) -> tuple[RolloutState, Any]:
        own_key = jax.random.fold_in(key, t)
        action, memory = act(policy, own_key, position.observation, position.memory)
        state, timestep = step(env, position.state, action)
        position = RolloutState(state=state, observation=timestep.observation, memory=memory)
        return position, (state, timestep, jnp.asarray(action))

    return jax.lax.scan(one_step, position, before + jnp.arange(RECORDED_STEPS_PER_CALL))


def _started(env: Environment, start: Any, key: Key) -> tuple[State, TimeStep]:
    if isinstance(start, Mapping):
        return reset_to(env, start, key=key)
    if isinstance(start, tuple) and [type(part) for part in start] == [State, TimeStep]:
        return start
    raise ConfigError(
        "fly: start: expected what reset or reset_to returns, or platform states by name, "
        f"found {show(start)}"
    )


def _by_component(tree: Any) -> Any:
    """Return a tree of arrays with each array [n, k] replaced by the list of its k columns."""
    if isinstance(tree, Mapping):
        return {name: _by_component(value) for name, value in tree.items()}
    return list(tree.T) if np.ndim(tree) > 1 else tree


def _cell(value: Any) -> Any:
    """Return a number with the digits of its own precision, or None if it is not finite."""
    if isinstance(value, np.floating):
        return float(str(value)) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
