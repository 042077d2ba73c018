"""A session of a run: compiled chunks of updates, and logs, evaluations, checkpoints between them.

The numbers are functions of the configuration and of the state in the checkpoint alone.
Chunks begin at the same updates however often a run is interrupted. So a resumed run ends bit for
bit where the uninterrupted one ends, if it has as many processor cores or accelerators as before.
"""

from __future__ import annotations

import json
import shutil
import signal
import time
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.autoreset import choose
from jaxsafe.devices import memory, processes
from jaxsafe.devices.background_compile import CompiledInBackground
from jaxsafe.devices.processes import in_main_thread
from jaxsafe.devices.seed_mapper import SeedMapper
from jaxsafe.environment import Environment
from jaxsafe.evaluate.evaluator import EVALUATION_KINDS, EVALUATION_SEED, Evaluator, episode_rows
from jaxsafe.garbage_collection import without_collection
from jaxsafe.metrics import Episode
from jaxsafe.schema.convert import to_data
from jaxsafe.storage.files import append_rows, keep_rows, sync
from jaxsafe.storage.forms import COUNT
from jaxsafe.train.host.checkpoint import Checkpoints
from jaxsafe.train.host.log import Display, ProgressLog, progress_rows, read_progress
from jaxsafe.train.host.options import TrainConfig, flatten
from jaxsafe.train.host.restore import made_from, restore, start_params
from jaxsafe.train.host.sinks import Sink, open_sinks
from jaxsafe.train.recent_episodes import SIZE as WINDOW
from jaxsafe.train.train import STATE, programs


class Clock:
    """A clock that counts the seconds spent on a run, over all its sessions.

    Time counts inside `with`. Each run of a command has a clock of its own.
    """

    def __init__(self, spent: float = 0.0) -> None:
        """Begin with the seconds that were spent already."""
        self.spent = spent
        self._since: float | None = None

    @property
    def seconds(self) -> float:
        """The seconds spent so far."""
        return self.spent + (0.0 if self._since is None else time.monotonic() - self._since)

    def __enter__(self) -> None:
        self._since = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self.spent, self._since = self.seconds, None


class Training:
    """One run: all seeds of one configuration."""

    def __init__(
        self,
        config: TrainConfig,
        env: Environment,
        name: str,
        run: Path,
        clock: Clock,
        checkpoints: Path | None = None,
    ) -> None:
        """Set up a training without compiling anything yet.

        Args:
            config: the configuration of the run.
            env: the environment of the run.
            name: the name of the environment.
            run: the directory for logs and results.
            clock: a clock that begins with what was spent on the run before.
            checkpoints: the run directory that holds the checkpoints, if it is another one.
        """
        self.config = config
        self.env = env
        self.name = name
        self.run = run
        self.clock = clock
        self.mapper = SeedMapper(config.seeds, config.shares)
        self.shared = self.mapper.replicate((env, config.agent, config.ppo))
        intervals = (config.every(config.eval_every), config.every(config.checkpoint_every))
        self.chunk = max(
            1, min(config.num_updates // 50, 100_000 // config.ppo.batch_size, *intervals)
        )
        self.evaluator = Evaluator(self.mapper, env, config.agent)
        self.checkpoints = Checkpoints(checkpoints or run, create=True)
        self.compile_s = 0.0
        self.updates = 0
        # For each seed that diverged, the step after which its networks or returns were not finite.
        self.diverged: dict[int, int] = {}
        self._prepared = False

    def prepare(self) -> None:
        """Make the state, fresh or from the latest checkpoint, and begin to compile.

        A second call does nothing.

        Raises:
            ConfigError: the training does not fit into memory, the logs or checkpoints of the run
                cannot be read, or a sink cannot be opened.
        """
        if self._prepared:
            return
        with self.clock, without_collection():
            self._begin()
        self._keep_copies()
        self.log = ProgressLog(self.run, self.step, self.updates * self.config.seeds)
        if processes.leads():
            self.log.sinks = self._open_sinks()
        for name in ("eval.jsonl", "episodes.jsonl"):
            keep_rows(self.run / name, self._is_kept, {"step": COUNT})
        if not self._has_evaluated():
            keep_rows(self.run / "eval.jsonl", lambda row: False)
        self.diverged = {}
        self._find_diverged(self.log.rows)
        self._prepared = True

    @property
    def step(self) -> int:
        """Number of environment steps that each seed has taken."""
        return self.updates * self.config.ppo.batch_size

    @property
    def num_steps(self) -> int:
        """Number of environment steps that each seed is to take."""
        return self.config.num_updates * self.config.ppo.batch_size

    def train(self, progress: bool = True) -> bool:
        """Train to the end, or until the user asks to stop.

        The state is in a checkpoint either way.

        Args:
            progress: whether to show how far it is.

        Returns:
            False if the user asked to stop.

        Raises:
            ConfigError: the program does not fit into memory, the progress log was begun with other
                columns, or a checkpoint cannot be written.
        """
        display = Display(self.num_steps, self.step, progress)
        with self.clock:
            self._await_compiled()
        display.start()
        untrained = self.state.average if self.updates == 0 and self._early_due() else None
        with self.clock, _StopRequest() as stop:
            # All processes agree on this, because a signal may reach only one of them.
            stopping = False
            while not self.has_ended and not stopping:
                before = self.updates
                self.state, curves = self.advance(self.shared, self.state)
                self.updates = min(before + self.chunk, self.config.num_updates)
                self._write_progress(curves, self.updates - before, display)
                if untrained is not None:
                    self._record(untrained, 0, num_episodes=1)
                    untrained = None
                if self._succeeds_enough():
                    display.tell(
                        f"every seed succeeds in {self.config.stop_at_success:.0%} of its last "
                        f"{WINDOW} episodes: training ends at step {self.step:,}"
                    )
                if not self.has_ended and self._due(before, self.config.eval_every):
                    self._evaluate()
                elif self._early_due():
                    self._record(self.state.average, self.step, num_episodes=1)
                stopping = processes.any_process(stop.requested)
                if self._due(before, self.config.checkpoint_every) or stopping:
                    self._save()
            # A signal may have come with the last chunk.
            stopping = stopping or processes.any_process(stop.requested)
        display.close()
        self.log.close()
        return not stopping

    def params(self) -> list[Any]:
        """Return the networks of each seed, on the host. They are the averaged ones."""
        return self._by_seed(self.state.average)

    def prepare_evaluation(self) -> None:
        """Compile what `evaluate_finally` needs, while other work goes on."""
        with self.clock, without_collection():
            self.evaluator.prepare(self.state.average)

    def evaluate_finally(self) -> dict[str, Episode]:
        """Run the last periodic evaluation, then the one that stands in the results.

        The rows of both go to the logs.

        Returns:
            The episodes of the evaluation in the results, by kind.
        """
        self._evaluate()
        self._save()
        episodes = {}
        for kind in EVALUATION_KINDS:
            episodes[kind] = self._run_episodes(
                kind, self.config.episodes, self.state.average, self.step, final=True
            )
        self._record(self.state.average, self.step, self.config.episodes, final=True)
        return episodes

    def _begin(self) -> None:
        """Make the state, fresh or restored, while all programs are compiled side by side."""
        begin = time.monotonic()
        keys = self.mapper.keys(self.config.seed)
        fresh, advance = programs(self.mapper, self.chunk, self.config.num_updates)
        described = json.dumps(made_from(self.env, self.config), sort_keys=True)
        if self.checkpoints.steps:
            shapes = jax.eval_shape(fresh, self.shared, keys)
        else:
            text = f"start of {described}"
            fresh = CompiledInBackground(fresh, self.shared, keys, made_from=text)
            shapes = fresh.result_shapes
        like = self.mapper.like(shapes, STATE)
        # The best parameters of each seed are in memory too.
        state_bytes = memory.size((like, like.average)) // self.mapper.mesh.size
        memory.require(state_bytes, self.mapper.num_local_devices, memory.COMPILE_BYTES)
        self.advance = CompiledInBackground(
            advance,
            self.shared,
            like,
            made_from=f"{self.chunk} of {self.config.num_updates} updates of {described}",
        )
        if self.checkpoints.steps:
            self._restore()
        else:
            self.state = fresh(self.shared, keys)
            if self.config.start_from is not None:
                params = start_params(self.mapper, self.config, self.env)
                self.state = self.state.replace(params=params, average=params)
            never = self.mapper.place(np.full(self.config.seeds, -1.0, np.float32))
            self.best = {"params": self.state.average, "success": never}
        # If the only evaluation is at the end, its program can wait until the cores are free.
        if self.config.every(self.config.eval_every) < self.config.num_updates:
            self.evaluator.prepare(like.average, described, after=self.advance)
        self.compile_s += time.monotonic() - begin

    def _open_sinks(self) -> dict[str, Sink]:
        """Return what takes the rows of the progress log besides its files, by name."""
        config = self.config
        return open_sinks(
            tensorboard=config.tensorboard,
            wandb=config.wandb,
            mlflow=config.mlflow,
            run=self.run,
            resume_step=self.step,
            options={"env": self.name, **flatten(to_data(config))},
        )

    def _restore(self) -> None:
        """Go back to the newest checkpoint that the progress log covers.

        A loss of power may have cut off the end of the log.
        """
        steps = self.checkpoints.steps
        rows = Counter(row["step"] for row in read_progress(self.run))
        done = {step: sum(count for at, count in rows.items() if at <= step) for step in steps}
        covered = [
            step
            for step in steps
            if done[step] == step // self.config.ppo.batch_size * self.config.seeds
        ]
        # A log that covers no checkpoint is refused later, when it is opened.
        newest = max(covered, default=steps[-1])
        if newest != steps[-1]:
            print(
                f"{self.run / 'progress.jsonl'} ends before the checkpoint of step {steps[-1]:,}: "
                f"going on from {newest:,}"
            )
        content, facts = restore(self.checkpoints, newest, self.env, self.config)
        self.state = self.mapper.place(content["state"], STATE)
        self.best = self.mapper.place(content["best"])
        self.updates = facts["updates"]
        self.compile_s = facts["compile_s"]
        self.clock.spent += facts["wall_s"]

    def _keep_copies(self) -> None:
        """Copy the logs, before they are cut, if checkpoints are missing.

        Checkpoints are missing if the logs are further on than a kill can explain.
        """
        interval = self.config.every(self.config.checkpoint_every)
        due = (self.updates // interval + 1) * interval
        reached = -(-due // self.chunk) * self.chunk * self.config.ppo.batch_size
        if any(row["step"] > reached for row in read_progress(self.run)):
            print(
                f"checkpoints after step {self.step:,} are missing: "
                "going on from there, the longer logs kept as *.bak"
            )
            for log in self.run.glob("*.jsonl"):
                shutil.copy(log, log.with_suffix(".jsonl.bak"))

    def _await_compiled(self) -> None:
        """Wait for the program of the updates, and check that it fits into memory.

        Raises:
            ConfigError: it does not fit.
        """
        begin = time.monotonic()
        self.advance.compiled()
        self.compile_s += time.monotonic() - begin
        # The state is in memory already.
        state_bytes = memory.size(self.state) // self.mapper.mesh.size
        memory.require(
            self.advance.footprint() - state_bytes,
            self.mapper.num_local_devices,
            memory.RUN_BYTES,
        )

    @property
    def has_ended(self) -> bool:
        """Whether all updates are done, or the seeds succeed often enough to end before."""
        return self.updates == self.config.num_updates or self._succeeds_enough()

    def _succeeds_enough(self) -> bool:
        """Return whether every seed succeeds as often as `stop_at_success` asks.

        The last episodes of a seed must be as many as the progress log averages over. With a
        curriculum they count once it has come to its end.
        """
        level, ppo = self.config.stop_at_success, self.config.ppo
        easier = ppo.curriculum and (
            self.updates < float(ppo.curriculum_share) * self.config.num_updates
        )
        if level is None or easier:
            return False
        latest = [row for row in self.log.rows[-self.config.seeds :] if not row.get("diverged")]
        return bool(latest) and all(
            row["episodes"] >= WINDOW and row["success_rate"] >= level for row in latest
        )

    def _due(self, before: int, every: int | None) -> bool:
        """Return whether a chunk passed a multiple of an interval, or the end.

        Args:
            before: the update at which the chunk began.
            every: the interval in environment steps, as `TrainConfig.every` takes it.
        """
        interval = self.config.every(every)
        return self.updates // interval > before // interval or self.has_ended

    def _early_due(self) -> bool:
        """Return whether to log an episode that shows early learning.

        This is after 0, 1, 2, 4, … chunks of updates, if evaluations come later.
        """
        chunks = self.updates // self.chunk
        first = self.config.every(self.config.eval_every)
        early = self.updates < first < self.config.num_updates and not self.has_ended
        return early and chunks & (chunks - 1) == 0

    def _is_kept(self, row: dict[str, Any]) -> bool:
        """Return whether to keep a row of the logs of evaluations.

        A row is kept if the training, which goes on from here, will not write it again.
        """
        written_again = row["step"] == self.step and self.has_ended
        return self.updates > 0 and row["step"] <= self.step and not written_again

    def _write_progress(self, curves: dict[str, jax.Array], count: int, display: Display) -> None:
        host = {name: value[:, :count] for name, value in self.mapper.gather(curves).items()}
        rows = progress_rows(
            self.env, host, self.config.seed, self.config.ppo.batch_size, self.clock.seconds
        )
        self.log.write(rows)
        for seed in self._find_diverged(rows):
            step = self.diverged[seed]
            display.tell(
                f"seed {seed} has diverged by step {step:,}: "
                "networks or returns are not finite. It is stopped"
            )
        display.show(self.step, rows[-self.config.seeds :])

    def _find_diverged(self, rows: list[dict[str, Any]]) -> list[int]:
        """Note the seeds that rows of the progress log call diverged, and return the new ones."""
        before = set(self.diverged)
        for row in rows:
            if row.get("diverged"):
                self.diverged.setdefault(row["seed"], row["step"])
        return [seed for seed in self.diverged if seed not in before]

    def _evaluate(self) -> None:
        """Run a periodic evaluation.

        It writes rows, logs some episodes step by step, and keeps the best parameters of each seed
        so far. The first one also measures the policies as they were before training, unless it is
        the only one.
        """
        params = self.state.average
        if not self.has_ended and not self._has_evaluated():
            self._keep_best(self.best["params"], step=0)
        self._keep_best(params, self.step)
        self._record(self.state.average, self.step, self.config.eval_episodes)

    def _has_evaluated(self) -> bool:
        """Return whether there has been a periodic evaluation."""
        return bool((self.mapper.gather(self.best["success"]) >= 0.0).any())

    def _keep_best(self, params: Any, step: int) -> None:
        """Evaluate the parameters of a step, and keep those of each seed that succeed most."""
        count = self.config.eval_episodes
        episodes = self._run_episodes("deterministic", count, params=params, step=step)
        rate = np.mean(self.env.succeeded(np.asarray(episodes.outcome)), axis=1)
        success = self.mapper.place(rate.astype(np.float32))
        self.best = _keep_best(self.best, {"params": params, "success": success})

    def _run_episodes(
        self, kind: str, num_episodes: int, params: Any, step: int, final: bool = False
    ) -> Episode:
        """Run episodes of every seed, and log a row for each of them."""
        self.evaluator.prepare(params)
        deterministic = kind == "deterministic"
        episodes = self.evaluator.run(params, num_episodes, EVALUATION_SEED, deterministic)
        rows = episode_rows(self.env, episodes, self.config.seed, step=step, kind=kind, final=final)
        append_rows(
            self.run / "eval.jsonl", (row for row in rows if row["seed"] not in self.diverged)
        )
        return episodes

    def _by_seed(self, stacked: Any) -> list[Any]:
        """Return parts of the state of each seed, on the host."""
        host = self.mapper.gather(stacked)
        return [jax.tree.map(lambda x, i=i: x[i], host) for i in range(self.config.seeds)]

    def _record(self, params: Any, step: int, num_episodes: int, final: bool = False) -> None:
        """Log some episodes step by step. The first seed that has not diverged flies them.

        Args:
            params: the parameters of all seeds.
            step: the step at which the seeds had them.
            num_episodes: number of episodes, of which every `log_every`-th is logged.
            final: whether the episodes are those of the results.
        """
        index = next(
            (i for i in range(self.config.seeds) if self.config.seed + i not in self.diverged), None
        )
        if index is None:
            return
        count = -(-num_episodes // self.config.log_every)
        recorded = self.evaluator.record(self._by_seed(params)[index], count, EVALUATION_SEED)
        facts = {
            "step": step,
            "seed": self.config.seed + index,
            "kind": "deterministic",
            "final": final,
        }
        for number, rows in enumerate(recorded):
            append_rows(
                self.run / "episodes.jsonl", ({**facts, "episode": number, **row} for row in rows)
            )

    def _save(self) -> None:
        for log in self.run.glob("*.jsonl"):
            # A checkpoint survives a loss of power, so the rows before it must survive it too.
            sync(log)
        facts = {
            "updates": self.updates,
            "wall_s": self.clock.seconds,
            "compile_s": self.compile_s,
            "made_from": made_from(self.env, self.config),
        }
        self.checkpoints.save(
            self.step, self.mapper.gather({"state": self.state, "best": self.best}), facts
        )


@jax.jit
def _keep_best(best: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Return the parameters of each seed that succeeded more often, or the later ones if equal.

    Parameters that are not finite are never taken.
    """
    finite = jax.tree.map(lambda x: jnp.all(jnp.isfinite(x), axis=range(1, x.ndim)), now["params"])
    better = (now["success"] >= best["success"]) & jax.tree.reduce(jnp.logical_and, finite)
    return choose(better, now, best)


class _StopRequest:
    """A context that turns the first Ctrl-C or termination into a flag.

    So the run can stop between chunks. A second signal acts as usual. Signals come to the main
    thread, and a training in another thread leaves them alone.
    """

    def __enter__(self) -> _StopRequest:
        self.requested = False
        numbers = (signal.SIGINT, signal.SIGTERM) if in_main_thread() else ()
        self._previous = {number: signal.signal(number, self._set) for number in numbers}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _set(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        signal.signal(number, self._previous[signal.Signals(number)])
