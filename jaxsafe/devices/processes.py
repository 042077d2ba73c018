"""Several processes, on one machine or on many, that train the seeds of one run together.

Each runs the same program on its own devices; process 0 writes the run directory, all of them its checkpoints.
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

LONGEST = 4096
"""Of what process 0 tells the others, in bytes."""

_LOST = re.compile("gloo|nccl|heartbeat|coordination|unavailable|deadline", re.IGNORECASE)
"""In what collectives raise when one of the others has gone."""


def join() -> None:
    """Find the other processes, by the environment of Slurm, Open MPI or another launcher that JAX knows.

    Raises:
        ConfigError: there is no such launcher, or not all processes came.
    """
    try:
        jax.distributed.initialize()
    except (RuntimeError, ValueError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise ConfigError(f"distributed: start the processes by srun or mpirun: {reason[:200]}") from None


def leads() -> bool:
    """Whether this is process 0, or the only one."""
    return jax.process_index() == 0


def from_leader(decide: Callable[[], str]) -> str:
    """What process 0 decides, in every process.

    Raises:
        ConfigError: in every process, if process 0 could not.
    """
    if jax.process_count() == 1:
        return decide()
    from jax.experimental.multihost_utils import broadcast_one_to_all

    failed, text = False, ""
    if leads():
        try:
            text = decide()
        except ConfigError as error:
            failed, text = True, str(error)
    words = np.zeros(LONGEST, np.uint8)
    content = text.encode()[: LONGEST - 1]
    words[0], words[1 : 1 + len(content)] = failed, np.frombuffer(content, np.uint8)
    found = np.asarray(broadcast_one_to_all(words))
    text = found[1:].tobytes().rstrip(b"\0").decode(errors="replace")
    if found[0]:
        raise ConfigError(text)
    return text


def anyone(wants: bool) -> bool:
    """Whether this holds in some process: what all of them must do together is decided so."""
    if jax.process_count() == 1:
        return wants
    from jax.experimental.multihost_utils import process_allgather

    return bool(np.any(process_allgather(np.asarray(wants))))


def beside() -> int:
    """How many processes of this run are on this machine, this one included."""
    if jax.process_count() == 1:
        return 1
    from jax.experimental.multihost_utils import process_allgather

    name = np.frombuffer(hashlib.sha256(platform.node().encode()).digest()[:8], np.int32)
    return int(np.sum(np.all(process_allgather(name) == name, axis=-1)))


def gather(x: Any) -> np.ndarray:
    """An array, or the words of keys, on the host of every process, wherever its parts are."""
    if is_key(x):
        x = jax.random.key_data(x)
    if x.is_fully_addressable:
        return np.asarray(x)
    from jax.experimental.multihost_utils import process_allgather

    return np.asarray(process_allgather(x, tiled=True))


@contextlib.contextmanager
def own_files(run: Path) -> Iterator[Path]:
    """The run directory, which process 0 alone writes; the others have a copy of its logs to go on from, and print nothing.

    Raises:
        ConfigError: in every process, if another command writes this run already.
    """
    with contextlib.ExitStack() as held:
        from_leader(lambda: held.enter_context(_locked(run)))
        if leads():
            meet("copied")
            yield run
            return
    with tempfile.TemporaryDirectory() as place, open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        for file in run.iterdir():
            if file.is_file():
                shutil.copy(file, place)
        meet("copied")
        yield Path(place)


@contextlib.contextmanager
def _locked(run: Path) -> Iterator[str]:
    """Hold the run, where the system has locks; this one goes with the process. Gives an empty text."""
    with contextlib.ExitStack() as files:
        try:
            if fcntl:
                fcntl.flock(files.enter_context(open(run / "config.yaml", "rb+")), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"{run}: another command is at work on this run; wait for its end, or stop it") from None
        except OSError:  # a file system without locks, or no such run, which is told elsewhere
            pass
        yield ""


@contextlib.contextmanager
def loss_told(advice: str) -> Iterator[None]:
    """What fails because another process has gone becomes a ConfigError with this advice."""
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        if jax.process_count() == 1 or not _LOST.search(str(error)):
            raise
        reason = (str(error).splitlines() or [""])[0][:200]
        raise ConfigError(f"distributed: another process of this run has ended ({reason}); {advice}") from None


def meet(name: str) -> None:
    """Wait until all processes are here."""
    if jax.process_count() > 1:
        from jax.experimental.multihost_utils import sync_global_devices

        sync_global_devices(name)


def in_main_thread() -> bool:
    """Return whether this is the main thread, the only one that may say what a signal does."""
    return threading.current_thread() is threading.main_thread()
