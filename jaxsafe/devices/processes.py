"""Several processes, on one machine or on many, that train the seeds of one run together.

Each process runs the same program on its own devices. Process 0 writes the run directory, and all
processes write its checkpoints.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxsafe.schema.errors import ConfigError
from jaxsafe.types import is_key

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

MAX_MESSAGE_BYTES = 4096
"""Size of a message from process 0 to the others: a path or an error's text. Longer text is cut."""

MAX_REASON_LETTERS = 200
"""How much of the first line of a library's error is repeated in a ConfigError."""

_LOST_PROCESS = re.compile("gloo|nccl|heartbeat|coordination|unavailable|deadline", re.IGNORECASE)
"""Words in the errors that collectives raise when another process has ended."""


def join() -> None:
    """Find the other processes.

    They are found by the environment variables of Slurm, Open MPI or another launcher that JAX
    knows.

    Raises:
        ConfigError: there is no such launcher, or some process did not join.
    """
    try:
        jax.distributed.initialize()
    except (RuntimeError, ValueError) as error:
        reason = _first_line(error)
        raise ConfigError(f"distributed: start the processes by srun or mpirun: {reason}") from None


def leads() -> bool:
    """Return whether this is process 0, or the only process."""
    return jax.process_index() == 0


def from_leader(decide: Callable[[], str]) -> str:
    """Return in every process what process 0 decides.

    Args:
        decide: a function that only process 0 calls.

    Raises:
        ConfigError: `decide` raised it in process 0. It is raised in every process.
    """
    if jax.process_count() == 1:
        return decide()
    from jax.experimental.multihost_utils import broadcast_one_to_all

    failed = False
    text = ""
    if leads():
        try:
            text = decide()
        except ConfigError as error:
            failed = True
            text = str(error)
    message = np.zeros(MAX_MESSAGE_BYTES, np.uint8)
    content = text.encode()[: MAX_MESSAGE_BYTES - 1]
    message[0] = failed
    message[1 : 1 + len(content)] = np.frombuffer(content, np.uint8)
    received = np.asarray(broadcast_one_to_all(message))
    text = received[1:].tobytes().rstrip(b"\0").decode(errors="replace")
    if received[0]:
        raise ConfigError(text)
    return text


def any_process(flag: bool) -> bool:
    """Return in every process whether the flag is set in some process.

    This is how the processes decide what all of them must do together.
    """
    if jax.process_count() == 1:
        return flag
    from jax.experimental.multihost_utils import process_allgather

    return bool(np.any(process_allgather(np.asarray(flag))))


def count_on_this_machine() -> int:
    """Return how many processes of this run are on this machine, this process included."""
    if jax.process_count() == 1:
        return 1
    from jax.experimental.multihost_utils import process_allgather

    name = np.frombuffer(hashlib.sha256(platform.node().encode()).digest()[:8], np.int32)
    return int(np.sum(np.all(process_allgather(name) == name, axis=-1)))


def gather(x: Any) -> np.ndarray:
    """Return an array on the host of every process, wherever its parts are.

    PRNG keys become the words that they consist of.
    """
    if is_key(x):
        x = jax.random.key_data(x)
    if x.is_fully_addressable:
        return np.asarray(x)
    from jax.experimental.multihost_utils import process_allgather

    return np.asarray(process_allgather(x, tiled=True))


@contextlib.contextmanager
def own_files(run: Path) -> Iterator[Path]:
    """Give each process a directory for the files of a run.

    Process 0 gets the run directory itself and is the only one that writes there. Every other
    process gets a copy of the run's logs to go on from, and prints nothing.

    Raises:
        ConfigError: another command already writes this run. It is raised in every process.
    """
    with contextlib.ExitStack() as held:
        from_leader(lambda: held.enter_context(_locked(run)))
        if leads():
            wait_for_all("copied")
            yield run
            return
    with (
        tempfile.TemporaryDirectory() as copy,
        open(os.devnull, "w") as nowhere,
        contextlib.redirect_stdout(nowhere),
    ):
        for file in run.iterdir():
            if file.is_file():
                shutil.copy(file, copy)
        wait_for_all("copied")
        yield Path(copy)


@contextlib.contextmanager
def _locked(run: Path) -> Iterator[str]:
    """Hold a lock on a run, if the system has locks. The lock ends with the process.

    Yields:
        An empty text, because `from_leader` takes a text.

    Raises:
        ConfigError: another command holds the lock.
    """
    with contextlib.ExitStack() as files:
        try:
            if fcntl:
                file = files.enter_context(open(run / "config.yaml", "rb+"))
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"{run}: another command is at work on this run; wait for its end, or stop it"
            ) from None
        # The file system has no locks, or there is no such run, which is reported elsewhere.
        except OSError:
            pass
        yield ""


@contextlib.contextmanager
def reporting_lost_process(advice: str) -> Iterator[None]:
    """Turn an error that is caused by the loss of another process into a ConfigError.

    Args:
        advice: what the user can do, for the message.

    Raises:
        ConfigError: another process of this run has ended.
    """
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        if jax.process_count() == 1 or not _LOST_PROCESS.search(str(error)):
            raise
        reason = _first_line(error)
        raise ConfigError(
            f"distributed: another process of this run has ended ({reason}); {advice}"
        ) from None


def wait_for_all(name: str) -> None:
    """Wait until all processes have reached the barrier with this name."""
    if jax.process_count() > 1:
        from jax.experimental.multihost_utils import sync_global_devices

        sync_global_devices(name)


def in_main_thread() -> bool:
    """Return whether this is the main thread, the only one that may set what a signal does."""
    return threading.current_thread() is threading.main_thread()


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0][:MAX_REASON_LETTERS]
