"""Where the progress of a training goes besides its own files.

TensorBoard, Weights & Biases and MLflow are sinks. A run may have any of them. Their libraries are
imported only when they are asked for.
"""

from __future__ import annotations

import contextlib
import importlib
import re
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

from jaxsafe.schema.errors import ConfigError, install_hint
from jaxsafe.storage.files import write_text

LIBRARIES = {"tensorboard": "tensorboardX", "wandb": "wandb", "mlflow": "mlflow"}
"""The library of each sink, by the option and the extra of the sink."""

METRICS_PER_REQUEST = 500
"""Number of values that go to MLflow at a time. It takes at most 1000, and a row has far fewer."""


class Sink(Protocol):
    """Something that takes the numbers of the progress log while a training goes on."""

    def write(self, step: int, seed: int, values: Mapping[str, float]) -> None:
        """Take the numbers of a row of the progress log.

        Args:
            step: environment steps of the seed.
            seed: the seed.
            values: the numbers that are known, by column.
        """
        ...

    def close(self) -> None:
        """Deliver what is left. The run may be resumed later."""
        ...


class TensorBoard:
    """Event files in `<run>/tensorboard`."""

    def __init__(self, run: Path, resume_step: int) -> None:
        """Open the files. Values after `resume_step` are no longer shown."""
        writer = library("tensorboard").SummaryWriter
        self._writer = writer(str(run / "tensorboard"), purge_step=resume_step + 1)

    def write(self, step: int, seed: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(f"{name}/seed_{seed}", value, step)

    def close(self) -> None:
        self._writer.close()


class WandB:
    """A run of Weights & Biases. Without a network, `WANDB_MODE=offline` keeps it in `<run>/wandb`.

    When a run is resumed, Weights & Biases ignores the steps that it already has. Their values
    would be equal.
    """

    def __init__(self, project: str, run: Path, options: Mapping[str, Any]) -> None:
        """Begin the run in a project, or go on with it if the run directory is resumed."""
        self._run = library("wandb").init(
            project=project,
            name=run.name,
            dir=str(run),
            id=_kept_id(run / "wandb_id", lambda: secrets.token_hex(8)),
            resume="allow",
            config={**options},
            reinit="create_new",  # with env=all the next run is prepared before one has ended
        )

    def write(self, step: int, seed: int, values: Mapping[str, float]) -> None:
        self._run.log({f"{name}/seed_{seed}": value for name, value in values.items()}, step=step)

    def close(self) -> None:
        self._run.finish()


class MLflow:
    """A run of MLflow on the server or in the directory that `MLFLOW_TRACKING_URI` names.

    When a run is resumed, values may be logged twice. They are equal then.
    """

    def __init__(self, experiment: str, run: Path, options: Mapping[str, Any]) -> None:
        """Begin the run in an experiment, or go on with it if the run directory is resumed."""
        self._entities = library("mlflow").entities
        # The functions of the module have one run at a time, and env=all prepares the next one.
        self._client = library("mlflow").MlflowClient()

        def new_run() -> str:
            existing = self._client.get_experiment_by_name(experiment)
            group = (
                existing.experiment_id if existing else self._client.create_experiment(experiment)
            )
            run_id = self._client.create_run(group, run_name=run.name).info.run_id
            params = [self._entities.Param(name, str(value)) for name, value in options.items()]
            self._client.log_batch(run_id, params=params)
            return run_id

        self._id = _kept_id(run / "mlflow_id", new_run)
        self._client.update_run(self._id, status="RUNNING")
        self._waiting: list[Any] = []

    def write(self, step: int, seed: int, values: Mapping[str, float]) -> None:
        now = int(1000 * time.time())
        for name, value in values.items():
            key = re.sub(r"[^\w./ -]", "_", f"{name}/seed_{seed}")  # other characters are refused
            self._waiting.append(self._entities.Metric(key, value, now, step))
        if len(self._waiting) >= METRICS_PER_REQUEST:
            self._deliver()

    def close(self) -> None:
        self._deliver()
        self._client.set_terminated(self._id)

    def _deliver(self) -> None:
        self._client.log_batch(self._id, metrics=self._waiting)
        self._waiting = []


def open_sinks(
    tensorboard: bool,
    wandb: str | None,
    mlflow: str | None,
    run: Path,
    resume_step: int,
    options: Mapping[str, Any],
) -> dict[str, Sink]:
    """Return the sinks that a run asks for, by name.

    Args:
        tensorboard: whether to write files of TensorBoard.
        wandb: the project of Weights & Biases, if the run goes there.
        mlflow: the experiment of MLflow, if the run goes there.
        run: the run directory.
        resume_step: environment steps of each seed from which the run goes on.
        options: the options of the run by dotted path, which the services show beside it.

    Raises:
        ConfigError: a library is missing, or a service refuses the run.
    """
    sinks: dict[str, Sink] = {}
    if tensorboard:
        sinks["tensorboard"] = TensorBoard(run, resume_step)
    if wandb is not None:
        with _in_one_line("wandb"):
            sinks["wandb"] = WandB(wandb, run, options)
    if mlflow is not None:
        with _in_one_line("mlflow"):
            sinks["mlflow"] = MLflow(mlflow, run, options)
    return sinks


def library(sink: str) -> Any:
    """Return the library of a sink.

    Raises:
        ConfigError: the library is not installed, or cannot be imported.
    """
    name = LIBRARIES[sink]
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ConfigError(f"{sink}: {name} is not installed; {install_hint(sink)}") from None
    except Exception as error:  # for instance with an old tensorboardX beside a new protobuf
        raise ConfigError(f"{sink}: {name} cannot be imported: {reason(error)}") from None


def reason(error: Exception) -> str:
    """Return the type and the first line of an error."""
    return f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"


@contextlib.contextmanager
def _in_one_line(sink: str) -> Iterator[None]:
    """Turn any error of a service, which may have no network or no login, into a `ConfigError`."""
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(f"{sink}: the run cannot be opened: {reason(error)}") from None


def _kept_id(file: Path, make: Callable[[], str]) -> str:
    """Return the id by which a service knows the run. The run directory keeps it for `resume`."""
    if not file.exists():
        write_text(file, make())
    return file.read_text(encoding="utf-8")
