"""Training of many settings at once.

Here a training is one seed with one setting. All trainings run the same compiled program.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.devices import memory
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.evaluate.episodes import run_episodes
from jaxsafe.evaluate.evaluator import (
    EPISODES_PER_BATCH,
    EVALUATION_KINDS,
    EVALUATION_SEED,
    given_up,
    in_batches,
    metrics_per_seed,
)
from jaxsafe.metrics import Episode, interaction_efficiency
from jaxsafe.train.host.results import diverged_seeds
from jaxsafe.train.train import begin, chunk
from jaxsafe.tune.settings import Setting, alike, parameters
from jaxsafe.types import Key

CURVES = ("success_rate", "count", "return", "diverged")
"""Quantities of the training curves that are kept."""

CHUNKS = 20
"""Number of pieces into which a training is cut.

Between two pieces Ctrl-C takes effect and the progress bar moves. Neither waits for the end.
"""


def train_all(
    settings: Sequence[Setting], chosen: Sequence[int], tick: Callable[[int], object]
) -> Iterator[dict[int, dict[str, Any]]]:
    """Train and evaluate the chosen settings, some at a time.

    Args:
        settings: all settings of a sweep.
        chosen: indices of the settings to train.
        tick: called with the number of updates finished since the last call, summed over settings.

    Yields:
        The results of the settings that were trained together, by index.
    """
    for group in alike(settings, chosen):
        batch = BatchedTraining(settings[group[0]], len(group))
        for first in range(0, len(group), batch.at_once):
            some = group[first : first + batch.at_once]
            yield dict(zip(some, batch.run([settings[i] for i in some], tick), strict=True))


class BatchedTraining:
    """A training that is compiled once for settings that differ in numbers only."""

    def __init__(self, like: Setting, count: int) -> None:
        """Prepare for settings such as `like`.

        On a CPU a few settings at a time are trained together, as many as keep all cores busy.
        Elsewhere all are trained together.

        Args:
            like: one of the settings. The others differ from it in numbers only.
            count: number of settings.
        """
        self.like = like
        self.seeds = like.config.seeds
        devices = jax.devices()
        on_cpu = devices[0].platform == "cpu"
        self.at_once = (
            min(count, math.lcm(self.seeds, len(devices)) // self.seeds) if on_cpu else count
        )
        self.mapper = SeedMapper(self.at_once * self.seeds)
        self.length = -(-like.config.num_updates // CHUNKS)
        self._init = self.mapper.map(lambda _, training: begin(*training))
        # It is compiled when the first trainings are known.
        self._advance: Any = None
        self._evaluate = self.mapper.map(_one_evaluation)

    def run(self, some: Sequence[Setting], tick: Callable[[int], object]) -> list[dict[str, Any]]:
        """Train and evaluate at most `at_once` settings, and return a result for each.

        Args:
            some: the settings.
            tick: called with the number of updates finished since the last call, summed over
                settings.
        """
        places = self.mapper.pad(np.arange(self.at_once * self.seeds))
        trees = [parameters(some[min(place // self.seeds, len(some) - 1)]) for place in places]
        trainings = self.mapper.place(jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees))
        keys = self.mapper.place(
            jax.vmap(jax.random.key)(jnp.asarray(self.like.config.seed + places % self.seeds))
        )
        self._advance = self._advance or self._fitting(trainings, keys)
        state = self._init((), (trainings, keys))
        pieces = []
        for first in range(0, self.like.config.num_updates, self.length):
            count = min(self.length, self.like.config.num_updates - first)
            state, rows = self._advance((), (trainings, state))
            pieces.append(self.mapper.gather({name: rows[name][:, :count] for name in CURVES}))
            tick(count * len(some))
        curve = {name: np.concatenate([piece[name] for piece in pieces], axis=1) for name in CURVES}
        sums = {
            kind: self._episodes(trainings, state.average, kind == "deterministic")
            for kind in EVALUATION_KINDS
        }

        def by_setting(x: np.ndarray) -> np.ndarray:
            return x.reshape(self.at_once, self.seeds, *x.shape[1:])[: len(some)]

        curve, sums = jax.tree.map(by_setting, (curve, sums))
        return [
            self._result(setting, *jax.tree.map(lambda x, i=i: x[i], (curve, sums)))
            for i, setting in enumerate(some)
        ]

    def _fitting(self, trainings: Any, keys: jax.Array) -> jax.stages.Compiled:
        """Compile the program of one piece of the training.

        Args:
            trainings: environment, agent and hyperparameters of each training.
            keys: a PRNG key for each training.

        Raises:
            ConfigError: the state or the program needs more memory than there is. This is checked
                before the state is allocated.
        """
        like = self.mapper.like(jax.eval_shape(self._init, (), (trainings, keys)))
        state = memory.size(like) // self.mapper.mesh.size
        memory.require(state, self.mapper.num_local_devices, memory.COMPILE_BYTES)
        compiled = self.mapper.map(self._one_chunk).lower((), (trainings, like)).compile()
        memory.require(
            memory.footprint(compiled),
            self.mapper.num_local_devices,
            memory.RUN_BYTES,
        )
        return compiled

    def _one_chunk(self, _: tuple, training: tuple[Any, Any]) -> tuple[Any, dict[str, jax.Array]]:
        return chunk(*training, self.length, self.like.config.num_updates)

    def _episodes(self, trainings: Any, params: Any, deterministic: bool) -> Episode:
        """Return the evaluation episodes of every training. Each field is [trainings, episodes].

        Args:
            trainings: environment, agent and hyperparameters of each training.
            params: the weights of each training's networks.
            deterministic: whether actions are the mode of the policy's distribution.
        """

        def batch(key: Key, _: int) -> Episode:
            shared = self.mapper.replicate((key, np.asarray(deterministic)))
            return self.mapper.gather(self._evaluate(shared, (trainings, params)))

        return in_batches(batch, self.like.config.episodes, EVALUATION_SEED)

    def _result(
        self, setting: Setting, curve: dict[str, np.ndarray], sums: dict[str, Episode]
    ) -> dict[str, Any]:
        """Return the results of one setting.

        Args:
            setting: the setting.
            curve: the training curves, each [seeds, updates].
            sums: the evaluation episodes by kind of evaluation. Each field is [seeds, episodes].
        """
        steps = (1 + np.arange(setting.config.num_updates)) * setting.config.ppo.batch_size
        diverged = curve["diverged"]
        # A seed that has diverged succeeds no more.
        success = np.where(diverged, 0.0, curve["success_rate"]).T
        counts = curve["count"].T
        last = np.where(diverged, np.nan, curve["return"])[:, -1]
        left_out = np.flatnonzero(diverged[:, -1]).tolist()
        evaluation = {
            kind: metrics_per_seed(setting.env, episodes) for kind, episodes in sums.items()
        }
        for values in (values for metrics in evaluation.values() for values in metrics.values()):
            for index in left_out:
                values[index] = None
        return {
            **setting.changes,
            "steps": int(steps[-1]),
            "interaction_efficiency": interaction_efficiency(steps, success, counts),
            "training_success": success[-1].tolist(),
            "training_return": last.tolist(),
            "evaluation": evaluation,
            **given_up(setting.env, sums),
            **diverged_seeds(
                {setting.config.seed + i: int(steps[np.argmax(diverged[i])]) for i in left_out}
            ),
            "curve": {"steps": steps.tolist(), "success_rate": np.round(success.T, 4).tolist()},
        }


def _one_evaluation(shared: tuple, training: tuple[Any, Any]) -> Episode:
    key, deterministic = shared
    (env, agent, _), params = training
    return run_episodes(env, agent.policy(env, params, deterministic), key, EPISODES_PER_BATCH)
