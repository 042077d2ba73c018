"""Evaluating the policies of all seeds of a run at once, from the same starts, into rows and metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from jaxsafe.agents.agent import Params
from jaxsafe.devices.background_compile import Ahead
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.environment import Environment
from jaxsafe.evaluate.episodes import begin_recording, max_steps, record_steps, run_episodes
from jaxsafe.metrics import METRICS, Episode, measures, summarise
from jaxsafe.rollout import Policy
from jaxsafe.types import Key, State, TimeStep

BATCH = 100
"""Episodes that run side by side; the noise of a batch is drawn together, so this number is part of the results."""

RECORDED = 10
"""Episodes recorded at a time, at least: one compiled program serves the evaluations during and after training."""

PIECE = 256
"""Steps recorded at a time: what a recording holds follows from how long its episodes are, not from any limit."""

MAX_RECORDED_STEPS = 25_000
"""A recording ends here, if its episode has not ended before: beyond it, logs and figures would take GiB.

Every task at a tenth of its time step is still recorded whole."""

EVALUATION_SEED = 0
"""The seed of the evaluations during and after training; `python -m jaxsafe.evaluate seed=…` chooses others."""

KINDS = ("stochastic", "deterministic")


class Recorder(NamedTuple):
    """Two compiled functions that record some episodes of one policy."""

    begin: Callable[..., Any]  # of a key: the position and the starts
    go_on: Callable[..., Any]  # of parameters, key, `deterministic` and a position: the next, and `PIECE` steps


class Acting(Protocol):
    """What evaluation asks of an agent."""

    def policy(self, env: Environment, params: Any, deterministic: Any) -> Policy:
        """As `Agent.policy`."""
        ...


class Evaluator:
    """Compiled once; runs whole batches of episodes for every seed."""

    def __init__(self, mapper: SeedMapper, env: Environment, agent: Acting) -> None:
        """Evaluate in `env`."""
        self.mapper, self.env, self.agent = mapper, env, agent
        self._shared = mapper.replicate((env, agent))
        self._run = mapper.map(self._one_seed)
        self._recorders: dict[int, Recorder] = {}

    def prepare(self, params: Params) -> None:
        """Compile while other work goes on; `params` are those of `run`, or as `SeedMapper.like` describes them.

        The second call does nothing.
        """
        if isinstance(self._run, Ahead):
            return
        key, deterministic = jax.random.key(0), np.asarray(True)
        self._run = Ahead(self._run, self._arguments(key, deterministic), params)
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), params)
        begin, go_on = self._recorder(RECORDED)
        position, _ = jax.eval_shape(begin, key)
        self._recorders[RECORDED] = Recorder(Ahead(begin, key), Ahead(go_on, one, key, deterministic, position))

    def run(self, params: Params, num_episodes: int, seed: int, deterministic: bool) -> Episode:
        """Episodes of every seed's policy: each field [seeds, num_episodes], on the host."""

        def batch(key: Key) -> Episode:
            return self.mapper.gather(self._run(self._arguments(key, np.asarray(deterministic)), params))

        return in_batches(batch, num_episodes, seed)

    def record(
        self, params: Params, num_episodes: int, seed: int, deterministic: bool = True
    ) -> Iterator[Iterator[dict[str, Any]]]:
        """Every step of the first episodes that `run` runs with one seed's parameters, as rows for a log."""
        for state, timestep in self.episodes(params, num_episodes, seed, deterministic):
            yield (_step_row(self.env, state, timestep, t) for t in range(len(timestep.reward)))

    def episodes(
        self, params: Params, num_episodes: int, seed: int, deterministic: bool = True
    ) -> Iterator[tuple[State, TimeStep]]:
        """States and time steps, [steps + 1], of each of the episodes that `record` describes.

        At most `MAX_RECORDED_STEPS` steps of each.
        """
        for batch, key in enumerate(batch_keys(seed, -(-num_episodes // BATCH))):
            yield from self._episodes(params, key, np.asarray(deterministic), min(BATCH, num_episodes - batch * BATCH))

    def _episodes(self, params: Params, key: Key, deterministic: Any, count: int) -> Iterator[tuple[State, TimeStep]]:
        """The first `count` episodes of a batch; of each only what it lasts is kept."""
        begin, go_on = self._recorder(max(count, RECORDED))
        position, first = begin(key)
        pieces = [[jax.tree.map(lambda x, i=i: np.asarray(x)[i : i + 1], first)] for i in range(count)]
        left = [*range(count)]
        limit = min(max_steps(self.env), MAX_RECORDED_STEPS)
        for before in range(0, limit, PIECE):
            position, recorded = go_on(params, key, deterministic, position)
            recorded = jax.tree.map(np.asarray, recorded)
            ended = {i: np.flatnonzero(recorded[1].done[:, i]) for i in left}
            for i in left:
                size = min(ended[i][0] + 1 if ended[i].size else PIECE, limit - before)
                pieces[i].append(jax.tree.map(lambda x, i=i, n=size: x[:n, i].copy(), recorded))
            left = [i for i in left if not ended[i].size]
            if not left:
                break
        for parts in pieces:
            yield jax.tree.map(lambda *x: np.concatenate(x), *parts)

    def _one_seed(self, shared: tuple, params: Params) -> Episode:
        env, agent, key, deterministic = shared
        return run_episodes(env, agent.policy(env, params, deterministic), key, BATCH)

    def _arguments(self, key: Key, deterministic: Any) -> tuple:
        return *self._shared, *self.mapper.replicate((key, deterministic))

    def _recorder(self, num_episodes: int) -> Recorder:
        """Compiled once for each number of episodes."""
        if num_episodes not in self._recorders:

            def begin(key: Key) -> Any:
                return begin_recording(self.env, key, num_episodes)

            def go_on(params: Params, key: Key, deterministic: Any, position: Any) -> Any:
                policy = self.agent.policy(self.env, params, deterministic)
                return record_steps(self.env, policy, key, position, PIECE)

            self._recorders[num_episodes] = Recorder(jax.jit(begin), jax.jit(go_on))
        return self._recorders[num_episodes]


def in_batches(run: Callable[[Key], Episode], num_episodes: int, seed: int) -> Episode:
    """Join the episodes of as many batches as that takes: each field [seeds, num_episodes]."""
    batches = [run(key) for key in batch_keys(seed, -(-num_episodes // BATCH))]
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1)[:, :num_episodes], *batches)


def batch_keys(seed: int, batches: int) -> Iterator[Key]:
    """The evaluation keys: they depend on the evaluation seed only, never on the training seed."""
    base = jax.random.key(seed)
    return (jax.random.fold_in(base, index) for index in range(batches))


def episode_rows(env: Environment, episodes: Episode, first_seed: int, **common: Any) -> list[dict[str, Any]]:
    """A row for each episode of each seed, for `eval.jsonl`."""
    success = env.success
    measured = measures(env)
    needs = {
        "delta_v": "has_delta_v",
        "delta_v_l1": "has_delta_v_l1",
        "violating_steps": "has_constraints",
        "severity_max": "has_constraints",
        "interventions": "has_rta",
    }
    names = ("episode_return", "length", *needs)
    columns = {name: np.asarray(getattr(episodes, name)).tolist() for name in names}
    unmeasured = {name for name, what in needs.items() if not measured[what]}
    outcomes = np.asarray(episodes.outcome)
    return [
        {
            **common,
            "seed": first_seed + seed,
            "episode": index,
            "outcome": env.outcomes[outcomes[seed, index]],
            "success": bool(outcomes[seed, index] == success),
            **{
                name.removeprefix("episode_"): None if name in unmeasured else _short(column[seed][index])
                for name, column in columns.items()
            },
        }
        for seed in range(outcomes.shape[0])
        for index in range(outcomes.shape[1])
    ]


def given_up(env: Environment, kinds: Mapping[str, Episode]) -> dict[str, Any]:
    """Return how many episodes of each kind had not ended when they were given up, and after how many steps.

    They count as failures. Empty if all have ended.
    """
    counts = {kind: int(np.sum(np.asarray(episodes.outcome) == 0)) for kind, episodes in kinds.items()}
    return {"given_up": {"after_steps": max_steps(env), **counts}} if any(counts.values()) else {}


def metrics_per_seed(env: Environment, episodes: Episode) -> dict[str, list[float | None]]:
    """Every metric of Section 5 for each seed, from sums [seeds, episodes]."""
    measured = measures(env)
    seeds = range(np.asarray(episodes.outcome).shape[0])
    each = [summarise(jax.tree.map(lambda x, i=i: x[i], episodes), env.success, **measured) for i in seeds]
    return {name: [one[name] for one in each] for name in METRICS}


def _step_row(env: Environment, state: Any, timestep: Any, t: int) -> dict[str, Any]:
    info = timestep.info
    assurance = {} if info.rta is None else {"intervening": info.intervening, **vars(info.rta)}
    pick = lambda tree: {name: _plain(value[t]) for name, value in tree.items()}  # noqa: E731
    sim = state.sim
    return {
        "t": _plain(sim.time[t]),
        "platforms": {name: pick(vars(one)) for name, one in sim.platforms.items()},
        "regions": {name: {"position": _plain(one.position[t])} for name, one in sim.regions.items()},
        "control_desired": dict(zip(env.action_names, _plain(info.control_desired[t]), strict=True)),
        "control_actual": dict(zip(env.action_names, _plain(info.control_actual[t]), strict=True)),
        "status": pick(info.status),
        "margins": pick(info.margins),
        **({"rta": pick(assurance)} if assurance else {}),
        "reward_terms": pick(info.reward_terms),
        "reward": _plain(timestep.reward[t]),
        "outcome": env.outcomes[int(info.outcome[t])],
    }


def _plain(value: Any) -> Any:
    array = np.asarray(value)
    return [_plain(item) for item in array] if array.ndim else _short(array.item())


def _short(value: Any) -> Any:
    return float(f"{value:.6g}") if isinstance(value, float) else value
