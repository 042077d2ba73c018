"""A finished run as an object: its results, logs, policies and figures."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jaxsafe.schema.describe import Described, Rows
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.storage.columns import table

if TYPE_CHECKING:
    from jaxsafe.agents.trained_policy import TrainedPolicy, TrainedRecurrentPolicy
    from jaxsafe.environment import Environment
    from jaxsafe.runs.figures import Figures
    from jaxsafe.train.host.options import TrainConfig

# Most imports wait until they are needed, because `import jaxsafe` must not load orbax, matplotlib
# or yaml.


class Run(Described):
    """A finished training of all seeds of a task, in its directory.

    `jaxsafe.train("docking2d")` and `jaxsafe.open_run("runs/docking2d")` return it.
    """

    path: Path
    """The run directory."""
    config: TrainConfig
    """All options of the training, resolved."""
    env: Environment
    """The environment that was trained in."""
    task: str
    """The name of the environment."""

    def __init__(self, path: str | os.PathLike) -> None:
        """Open a run.

        Raises:
            ConfigError: there is no run at this path, it has not finished, or its files are broken.
        """
        from jaxsafe.agents.policy_file import is_single
        from jaxsafe.train.host import run_directory

        if is_single(os.fspath(path)):
            raise ConfigError(
                f"run: {os.fspath(path)!r} is one policy and no run; "
                f"write jaxsafe.load_policy({os.fspath(path)!r})"
            )
        self.path = Path(path)
        self.config, self.env, self.task = run_directory.read(self.path, "run")
        if not (self.path / "results.json").exists():
            raise ConfigError(
                f"run: {self.path} has not finished; "
                f"go on with jaxsafe.train(resume={str(self.path)!r})"
            )

    @cached_property
    def results(self) -> dict[str, Any]:
        """The content of `results.json`, with the metrics of each kind of evaluation."""
        from jaxsafe.train.host.results import read_results

        return read_results(self.path / "results.json")

    @cached_property
    def progress(self) -> Any:
        """The progress log, with a row for each update of each seed.

        It is a pandas `DataFrame`, or a dict of NumPy arrays by column if pandas is not installed.
        Values that are not known yet are NaN.
        """
        from jaxsafe.train.host.log import read_progress

        return table(read_progress(self.path))

    @cached_property
    def episodes(self) -> Any:
        """The evaluation episodes that were logged, with a row for each of their steps.

        It has the form of `progress`. The columns `step`, `final` and `episode` say to which
        episode a row belongs. Other columns have names such as `platforms.deputy.position.x`.
        """
        from jaxsafe.storage.files import read_rows

        return table(read_rows(self.path / "episodes.jsonl"))

    @property
    def seeds(self) -> list[int]:
        """The seeds that were trained."""
        return [self.config.seed + index for index in range(self.config.seeds)]

    def policy(
        self,
        seed: int | None = None,
        checkpoint: str | int = "last",
        deterministic: bool = True,
    ) -> TrainedPolicy | TrainedRecurrentPolicy:
        """Return the policy of a seed.

        Args:
            seed: one of `seeds`. None stands for the first.
            checkpoint: `last`, `best` for the one with the most success in the evaluations during
                training, or the step of a checkpoint.
            deterministic: whether to act by the most probable action. Otherwise actions are
                sampled, as in training.

        Raises:
            ConfigError: there is no such seed or checkpoint, or the training of the seed diverged.
        """
        import jax
        import numpy as np

        from jaxsafe.agents.trained_policy import trained_policy
        from jaxsafe.devices.seed_mapper import SeedMapper
        from jaxsafe.train.host.restore import load_params

        seed = self.config.seed if seed is None else seed
        if seed not in self.seeds:
            raise ConfigError(f"seed: expected one of {_span(self.seeds)}, found {show(seed)}")
        mapper = SeedMapper(self.config.seeds)
        which = checkpoint if isinstance(checkpoint, str) else show(checkpoint)
        params, step = load_params(mapper, self.path, self.config, self.env, which)
        index = seed - self.config.seed
        params = jax.tree.map(lambda x: x[index], mapper.gather(params))
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params)):
            raise ConfigError(f"seed: seed {seed} diverged, so it has no policy")
        about = {"env": self.task, "preset": self.config.preset, "seed": seed, "step": step}
        return trained_policy(self.env, self.config.agent, params, about, deterministic)

    def plot(self, x: Literal["steps", "wall"] = "steps") -> Figures:
        """Return the figures of the run by name, which a notebook shows one below the other.

        Each is a matplotlib `Figure`. The run directory holds their files in `figures/`.

        Args:
            x: the horizontal axis of training curves: steps, or wall time.

        Raises:
            ConfigError: `x` is something else, or a log is broken.
        """
        from jaxsafe.runs.figures import draw

        return draw(self.path, x)

    def resume(self, steps: float, progress: bool = True) -> Run:
        """Train for more steps and return the longer run. Schedules run over the new number.

        Args:
            steps: the new number of environment steps of each seed.
            progress: whether to show how far the training is.

        Raises:
            ConfigError: `steps` is not larger than it is now.
            KeyboardInterrupt: the user stopped the training, which is kept.
        """
        from jaxsafe.runs.training import train_run

        return train_run(resume=self.path, steps=steps, progress=progress)

    def _heading(self) -> str:
        return f"Run {self.path}"

    def _rows(self) -> Rows:
        from jaxsafe.storage.text_table import or_dash
        from jaxsafe.train.host.results import least, percent, told_diverged, told_violations

        results = self.results
        kinds = results["evaluation"]
        rates = [metrics["success_rate"] for metrics in kinds.values()]

        def means(name: str, form: str) -> str:
            texts = {kind: or_dash(metrics[name]["mean"], form) for kind, metrics in kinds.items()}
            return ", ".join(f"{text} {kind}" for kind, text in texts.items())

        reached = results["interaction_efficiency"]["timesteps"]
        yield "task", f"{self.task}, preset {self.config.preset}, {self.config.algorithm}"
        yield "seeds", f"{_span(self.seeds)}, {results['steps']:,} steps each"
        yield "filter", results.get("rta", "unknown")
        yield "success", f"{means('success_rate', '.1%')}, worst seed {percent(least(rates), 1)}"
        yield "80 % success", f"after {reached:,} steps" if reached else "not reached in training"
        yield "return", means("average_return", ".2f")
        for line in told_violations(results)[1:2]:
            yield "violating steps", line.partition(": ")[2]
        yield "time", f"{results['wall_s']:.1f} s, {results['compile_s']:.1f} s of it compiling"
        for line in told_diverged(results):
            yield "diverged", line


def open_run(path: str | os.PathLike) -> Run:
    """Return a finished run.

    Args:
        path: the run directory, such as `runs/docking2d`.

    Raises:
        ConfigError: there is no run at this path, it has not finished, or its files are broken.
    """
    return Run(path)


def _span(seeds: list[int]) -> str:
    return f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else str(seeds[0])
