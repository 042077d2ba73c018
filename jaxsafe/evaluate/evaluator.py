"""Evaluation of the policies of all seeds of a run at once, from the same starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from jaxsafe.agents.networks import Params
from jaxsafe.devices.background_compile import CompiledInBackground
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.environment import Environment
from jaxsafe.evaluate.cases import Cases
from jaxsafe.evaluate.episodes import (
    begin_recording,
    max_steps,
    record_steps,
    run_episodes,
    starts_of,
)
from jaxsafe.metrics import COST_OF, Episode, measures, metrics_in, metrics_of, over_episode
from jaxsafe.rollout import Policy, RecurrentPolicy
from jaxsafe.types import Key, State, TimeStep

EPISODES_PER_BATCH = 100
"""Number of episodes that run side by side.

The noise of a batch is drawn together, so this number is part of the results.
"""

MIN_RECORDED_EPISODES = 10
"""Least number of episodes that are recorded at a time.

It lets one compiled program serve the evaluations during and after training.
"""

RECORDED_STEPS_PER_CALL = 256
"""Number of steps that are recorded at a time.

A recording grows by this number until its episodes have ended, so it is only as long as they are.
"""

MAX_RECORDED_STEPS = 25_000
"""Most steps of a recording. It ends there, even if its episode has not ended.

Longer logs and figures would take GiB. Episodes of every task are still recorded whole at a tenth
of its time step.
"""

EVALUATION_SEED = 0
"""Seed of the evaluations during and after training.

`jaxsafe evaluate seed=…` chooses others.
"""

EVALUATION_KINDS = ("stochastic", "deterministic")
"""Kinds of evaluation: a policy draws its actions, or takes the mode of their distribution."""


class Recorder(NamedTuple):
    """Two compiled functions that record some episodes of one policy."""

    begin: Callable[..., Any]  # (parameters, key, cases) -> (position, starts)
    go_on: Callable[..., Any]  # (parameters, key, deterministic, position) -> (position, steps)


class Acting(Protocol):
    """An agent, as far as an evaluation uses it."""

    def policy(self, env: Environment, params: Any, deterministic: Any) -> Policy | RecurrentPolicy:
        """Return a policy, as `Agent.policy` does."""
        ...


class Evaluator:
    """Runs whole batches of episodes for every seed, with programs that are compiled once."""

    def __init__(
        self, mapper: SeedMapper, env: Environment, agent: Acting, cases: Cases | None = None
    ) -> None:
        """Prepare to evaluate policies.

        Args:
            mapper: maps over their seeds.
            env: the environment.
            agent: the agent, which makes a policy of parameters.
            cases: the starts of the episodes, one after another. None stands for random ones.
        """
        self.mapper = mapper
        self.env = env
        self.agent = agent
        self.cases = cases
        self._shared = mapper.replicate((env, agent))
        self._run = mapper.map(self._one_seed)
        self._recorders: dict[int, Recorder] = {}

    def prepare(
        self,
        params: Params,
        made_from: str | None = None,
        after: CompiledInBackground | None = None,
    ) -> None:
        """Compile the programs while other work goes on. A second call does nothing.

        Args:
            params: the parameters that `run` takes, or their shapes from `SeedMapper.like`.
            made_from: a text that describes the environment and the agent with all their numbers.
                The programs are stored if it is given.
            after: a program that is needed sooner. It has the cores until it is compiled.
        """
        if isinstance(self._run, CompiledInBackground):
            return

        def compile_soon(name: str, function: Any, *arguments: Any) -> CompiledInBackground:
            text = made_from and f"{name} of {made_from}"
            return CompiledInBackground(function, *arguments, made_from=text, after=after)

        key = jax.random.key(0)
        deterministic = np.asarray(True)
        cases = self._cases(0, EPISODES_PER_BATCH)
        arguments = self._arguments(key, deterministic, cases)
        self._run = compile_soon("episodes", self._run, arguments, params)
        params_of_seed = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), params)
        begin, go_on = self._recorder(MIN_RECORDED_EPISODES)
        cases = self._cases(0, MIN_RECORDED_EPISODES)
        begin = compile_soon("starts", begin, params_of_seed, key, cases)
        position, _ = begin.result_shapes
        self._recorders[MIN_RECORDED_EPISODES] = Recorder(
            begin=begin,
            go_on=compile_soon("steps", go_on, params_of_seed, key, deterministic, position),
        )

    def run(self, params: Params, num_episodes: int, seed: int, deterministic: bool) -> Episode:
        """Run episodes of every seed's policy.

        Args:
            params: the parameters of every seed's policy, each array with an axis of seeds in
                front.
            num_episodes: the number of episodes for each seed.
            seed: the seed of the evaluation.
            deterministic: whether the policies take the mode of their actions.

        Returns:
            Sums over each episode on the host. Every field has the shape [seeds, num_episodes].
        """

        def run_batch(key: Key, first: int) -> Episode:
            cases = self._cases(first, EPISODES_PER_BATCH)
            arguments = self._arguments(key, np.asarray(deterministic), cases)
            return self.mapper.gather(self._run(arguments, params))

        return in_batches(run_batch, num_episodes, seed)

    def starts(self, num_episodes: int, seed: int) -> State:
        """Return the states at the starts of the episodes that `run` runs, arrays [num_episodes].

        They are the same for the policies of all seeds and for both kinds of evaluation.
        """
        begin = jax.jit(starts_of, static_argnums=2)
        batches = []
        for index, key in enumerate(batch_keys(seed, -(-num_episodes // EPISODES_PER_BATCH))):
            cases = self._cases(index * EPISODES_PER_BATCH, EPISODES_PER_BATCH)
            state, _ = begin(self.env, jax.random.split(key)[0], EPISODES_PER_BATCH, cases)
            batches.append(jax.device_get(state))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[:num_episodes], *batches)

    def record(
        self, params: Params, num_episodes: int, seed: int, deterministic: bool = True
    ) -> Iterator[Iterator[dict[str, Any]]]:
        """Yield the first episodes that `run` runs, each as rows for a log, one per step.

        Args:
            params: the parameters of one seed's policy.
            num_episodes: the number of episodes.
            seed: the seed of the evaluation.
            deterministic: whether the policy takes the mode of its actions.
        """
        for state, timestep in self.episodes(
            params, num_episodes, seed=seed, deterministic=deterministic
        ):
            yield step_rows(self.env, state, timestep)

    def episodes(
        self, params: Params, num_episodes: int, seed: int, deterministic: bool = True
    ) -> Iterator[tuple[State, TimeStep]]:
        """Yield states and time steps, each [steps + 1], of the episodes that `record` describes.

        At most `MAX_RECORDED_STEPS` steps of each episode are recorded.
        """
        num_batches = -(-num_episodes // EPISODES_PER_BATCH)
        for batch, key in enumerate(batch_keys(seed, num_batches)):
            count = min(EPISODES_PER_BATCH, num_episodes - batch * EPISODES_PER_BATCH)
            yield from self._episodes(
                params,
                key,
                deterministic=np.asarray(deterministic),
                first_case=batch * EPISODES_PER_BATCH,
                chosen=range(count),
                size=max(count, MIN_RECORDED_EPISODES),
            )

    def episode(
        self, params: Params, number: int, seed: int, deterministic: bool
    ) -> tuple[State, TimeStep]:
        """Return states and time steps, each [steps + 1], of one of the episodes that `run` runs.

        The arguments are those of `chosen_episodes`.
        """
        [episode] = self.chosen_episodes(params, [number], seed, deterministic)
        return episode

    def chosen_episodes(
        self, params: Params, numbers: Sequence[int], seed: int, deterministic: bool
    ) -> Iterator[tuple[State, TimeStep]]:
        """Yield states and time steps, each [steps + 1], of some of the episodes that `run` runs.

        The whole batch of an episode is flown again, because it shares the noise of the actions.

        Args:
            params: the parameters of one seed's policy.
            numbers: the indices of the episodes, in ascending order.
            seed: the seed of the evaluation.
            deterministic: whether the policy takes the mode of its actions.
        """
        last = max(numbers, default=-1) // EPISODES_PER_BATCH
        for batch, key in enumerate(batch_keys(seed, last + 1)):
            first = batch * EPISODES_PER_BATCH
            chosen = [n - first for n in numbers if first <= n < first + EPISODES_PER_BATCH]
            if chosen:
                yield from self._episodes(
                    params,
                    key,
                    deterministic=np.asarray(deterministic),
                    first_case=first,
                    chosen=chosen,
                    size=EPISODES_PER_BATCH,
                )

    def _episodes(
        self,
        params: Params,
        key: Key,
        deterministic: Any,
        first_case: int,
        chosen: Sequence[int],
        size: int,
    ) -> Iterator[tuple[State, TimeStep]]:
        """Yield chosen episodes of a batch of `size` episodes, each up to its end."""
        begin, go_on = self._recorder(size)
        position, first = begin(params, key, self._cases(first_case, size))
        pieces = {i: [jax.tree.map(lambda x, i=i: np.asarray(x)[i : i + 1], first)] for i in chosen}
        running = [*chosen]
        limit = min(max_steps(self.env), MAX_RECORDED_STEPS)
        for before in range(0, limit, RECORDED_STEPS_PER_CALL):
            position, recorded = go_on(params, key, deterministic, position)
            recorded = jax.tree.map(np.asarray, recorded)
            ends = {i: np.flatnonzero(recorded[1].done[:, i]) for i in running}
            for i in running:
                num_steps = ends[i][0] + 1 if ends[i].size else RECORDED_STEPS_PER_CALL
                num_steps = min(num_steps, limit - before)
                pieces[i].append(
                    jax.tree.map(lambda x, i=i, n=num_steps: x[:n, i].copy(), recorded)
                )
            running = [i for i in running if not ends[i].size]
            if not running:
                break
        for episode in pieces.values():
            yield jax.tree.map(lambda *x: np.concatenate(x), *episode)

    def _one_seed(self, shared: tuple, params: Params) -> Episode:
        env, agent, key, deterministic, cases = shared
        policy = agent.policy(env, params, deterministic)
        return run_episodes(env, policy, key, EPISODES_PER_BATCH, cases)

    def _arguments(self, key: Key, deterministic: Any, cases: Cases | None) -> tuple:
        return *self._shared, *self.mapper.replicate((key, deterministic, cases))

    def _cases(self, first: int, count: int) -> Cases | None:
        return None if self.cases is None else self.cases.part(first, count)

    def _recorder(self, num_episodes: int) -> Recorder:
        """Return the functions that record this number of episodes. They are compiled once."""
        if num_episodes not in self._recorders:

            def begin(params: Params, key: Key, cases: Cases | None) -> Any:
                policy = self.agent.policy(self.env, params, True)
                return begin_recording(self.env, policy, key, num_episodes, cases)

            def go_on(params: Params, key: Key, deterministic: Any, position: Any) -> Any:
                policy = self.agent.policy(self.env, params, deterministic)
                return record_steps(
                    self.env,
                    policy=policy,
                    key=key,
                    position=position,
                    num_steps=RECORDED_STEPS_PER_CALL,
                )

            self._recorders[num_episodes] = Recorder(begin=jax.jit(begin), go_on=jax.jit(go_on))
        return self._recorders[num_episodes]


def in_batches(run: Callable[[Key, int], Episode], num_episodes: int, seed: int) -> Episode:
    """Run as many batches as needed and join their episodes.

    Args:
        run: runs a batch with a key and the index of its first episode. Each field of its result
            is [seeds, EPISODES_PER_BATCH].
        num_episodes: the number of episodes.
        seed: the seed of the evaluation.

    Returns:
        The first episodes of these batches. Each field is [seeds, num_episodes].
    """
    num_batches = -(-num_episodes // EPISODES_PER_BATCH)
    batches = [
        run(key, index * EPISODES_PER_BATCH)
        for index, key in enumerate(batch_keys(seed, num_batches))
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1)[:, :num_episodes], *batches)


def batch_keys(seed: int, batches: int) -> Iterator[Key]:
    """Return a key for each batch.

    The keys depend on the seed of the evaluation only and never on the seed of a training.
    """
    base = jax.random.key(seed)
    return (jax.random.fold_in(base, index) for index in range(batches))


def episode_rows(
    env: Environment,
    episodes: Episode,
    first_seed: int,
    bounds: Mapping[str, np.ndarray] | None = None,
    **common: Any,
) -> list[dict[str, Any]]:
    """Return a row for each episode of each seed, for `eval.jsonl`.

    Args:
        env: the environment.
        episodes: sums over the episodes, each field [seeds, episodes].
        first_seed: the training seed of the first policy.
        bounds: what is possible from each start, as `best_possible` returns it, or None.
        **common: entries that all rows have.
    """
    measured = measures(env)
    needs = {
        "delta_v": "has_delta_v",
        "delta_v_l1": "has_delta_v_l1",
        "violating_steps": "has_constraints",
        "severity_max": "has_constraints",
        "interventions": "has_rta",
        "control_effort": "has_controls",
    }
    names = ("episode_return", "length", *needs)
    columns = {name: np.asarray(getattr(episodes, name)).tolist() for name in names}
    share = np.asarray(episodes.control_effort) / np.maximum(episodes.length, 1)
    columns["control_effort"] = share.tolist()
    unmeasured = {name for name, what in needs.items() if not measured[what]}
    costs = {f"{COST_OF}{name}": np.asarray(cost).tolist() for name, cost in episodes.costs.items()}
    columns |= {
        name: np.asarray(over_episode(name, value, np.maximum(episodes.length, 1))).tolist()
        for name, value in episodes.measured.items()
    }
    outcomes = np.asarray(episodes.outcome)
    succeeded = env.succeeded(outcomes)
    return [
        {
            **common,
            "seed": first_seed + seed,
            "episode": index,
            "outcome": env.outcomes[outcomes[seed, index]],
            "success": bool(succeeded[seed, index]),
            **{
                name.removeprefix("episode_"): None
                if name in unmeasured
                else _short(column[seed][index])
                for name, column in columns.items()
            },
            **{name: _short(column[seed][index]) for name, column in costs.items()},
            **{
                f"{name}_bound": _short(values[index].item())
                for name, values in (bounds or {}).items()
            },
        }
        for seed in range(outcomes.shape[0])
        for index in range(outcomes.shape[1])
    ]


def given_up(env: Environment, kinds: Mapping[str, Episode]) -> dict[str, Any]:
    """Return how many episodes of each kind were given up, and after how many steps.

    Episodes that are given up count as failures. The result is empty if all have ended.
    """
    counts = {
        kind: int(np.sum(np.asarray(episodes.outcome) == 0)) for kind, episodes in kinds.items()
    }
    return {"given_up": {"after_steps": max_steps(env), **counts}} if any(counts.values()) else {}


def metrics_per_seed(env: Environment, episodes: Episode) -> dict[str, list[float | None]]:
    """Return every metric of an environment for each seed, from sums of shape [seeds, episodes]."""
    num_seeds = np.asarray(episodes.outcome).shape[0]
    metrics = [
        metrics_in(env, jax.tree.map(lambda x, i=i: x[i], episodes)) for i in range(num_seeds)
    ]
    return {name: [of_seed[name] for of_seed in metrics] for name in metrics_of(env)}


def gaps_per_seed(
    env: Environment, episodes: Episode, bounds: Mapping[str, np.ndarray]
) -> dict[str, list[float | None]]:
    """Return how far the policy of each seed is from what is possible, on average over episodes.

    `return_gap` is over all episodes. `length_gap` is over the successes without a violation, and
    `delta_v_gap` over all successes. They are None where there is none.

    Args:
        env: the environment.
        episodes: sums over the episodes, each field [seeds, episodes].
        bounds: what is possible from each start, as `best_possible` returns it.
    """
    succeeded = np.asarray(env.succeeded(np.asarray(episodes.outcome)))
    safe = succeeded & (np.asarray(episodes.violating_steps) == 0)
    gaps = {
        "return": (bounds["return"] - episodes.episode_return, np.ones_like(succeeded))
        if "return" in bounds
        else None,
        "length": (episodes.length - bounds["length"], safe),
        "delta_v": (episodes.delta_v - bounds["delta_v"], succeeded)
        if "delta_v" in bounds
        else None,
    }
    return {
        f"{name}_gap": [
            float(np.mean(of_seed[which])) if which.any() else None
            for of_seed, which in zip(*gap, strict=True)
        ]
        for name, gap in gaps.items()
        if gap is not None
    }


def step_rows(env: Environment, state: State, timestep: TimeStep) -> Iterator[dict[str, Any]]:
    """Return the rows of an episode for a log, one per step. Every array is [steps + 1]."""
    return (_step_row(env, state, timestep, t) for t in range(len(timestep.reward)))


def _step_row(env: Environment, state: Any, timestep: Any, t: int) -> dict[str, Any]:
    """Return step t of an episode as a row for a log."""
    info = timestep.info
    rta = {} if info.rta is None else {"intervening": info.intervening, **vars(info.rta)}
    sim = state.sim

    def pick(arrays: Mapping[str, Any]) -> dict[str, Any]:
        return {name: _plain(array[t]) for name, array in arrays.items()}

    return {
        "t": _plain(sim.time[t]),
        "platforms": {name: pick(vars(platform)) for name, platform in sim.platforms.items()},
        "regions": {
            name: {"position": _plain(region.position[t])} for name, region in sim.regions.items()
        },
        "control_desired": dict(
            zip(env.action_names, _plain(info.control_desired[t]), strict=True)
        ),
        "control_actual": dict(zip(env.action_names, _plain(info.control_actual[t]), strict=True)),
        "status": pick(info.status),
        "margins": pick(info.margins),
        **({"rta": pick(rta)} if rta else {}),
        "reward_terms": pick(info.reward_terms),
        "reward": _plain(timestep.reward[t]),
        "outcome": env.outcomes[int(info.outcome[t])],
    }


def _plain(value: Any) -> Any:
    array = np.asarray(value)
    return [_plain(item) for item in array] if array.ndim else _short(array.item())


def _short(value: Any) -> Any:
    return float(f"{value:.6g}") if isinstance(value, float) else value
