"""The memory that a training needs and the memory that is free.

A training that does not fit is refused before it starts.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxsafe.devices import processes
from jaxsafe.schema.errors import ConfigError
from jaxsafe.types import is_key

try:
    import resource
except ImportError:  # Windows
    resource = None

GIB = 2**30

OPTIONS = "ppo.num_envs, ppo.num_steps, seeds"
"""Options to name when a training does not fit into memory."""

COMPILE_BYTES = 1200 * 2**20
"""Bytes that each process takes while the programs of a training are compiled.

Resident memory rose by 0.67 to 0.71 GB for docking2d and by 0.76 to 0.94 GB for rejoin3d. With
their filters it rose by 0.79 to 1.04 GB for four tasks. rejoin3d with its filter is not covered. It
took 1.3 to 1.6 GB, and in an earlier version 2.01 GB with 16,384 environments.
"""

RUN_BYTES = 512 * 2**20
"""Bytes that each process takes besides the buffers of the update.

They are for code, the programs of evaluations and compiling them, logs and figures. Resident memory
rose by 310 to 480 MB for docking2d and rejoin3d after the update had been compiled. With filters it
rose by 440 MB to 1.1 GB, which is not all covered.
"""


class ControlGroupFiles(NamedTuple):
    """Where control groups are, and which of their files say how much memory they leave."""

    root: str
    limit: str  # file with the limit [bytes]
    used: str  # file with the use [bytes], caches included
    cache: str  # row of `memory.stat` with the caches that can be dropped [bytes]


CONTROL_GROUPS = {
    "": ControlGroupFiles(
        root="/sys/fs/cgroup",
        limit="memory.max",
        used="memory.current",
        cache="inactive_file",
    ),
    "memory": ControlGroupFiles(
        root="/sys/fs/cgroup/memory",
        limit="memory.limit_in_bytes",
        used="memory.usage_in_bytes",
        cache="total_inactive_file",
    ),
}
"""Files of control groups, version 2 and 1, by their controllers in /proc/self/cgroup."""


def size(shapes: Any) -> int:
    """Return the bytes of all arrays of a tree of arrays or of their shapes."""
    shapes = jax.eval_shape(_keys_as_words, shapes)
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(shapes))


def footprint(compiled: jax.stages.Compiled) -> int:
    """Return the bytes that a compiled program needs on each of its devices.

    Its arguments are included. The result is 0 where the need is not known.
    """
    analysis = compiled.memory_analysis()
    if analysis is None:
        return 0
    return int(
        analysis.argument_size_in_bytes
        + analysis.output_size_in_bytes
        + analysis.temp_size_in_bytes
        - analysis.alias_size_in_bytes
    )


def require(needed: int, devices: int, once: int = 0) -> None:
    """Refuse a training that does not fit into memory.

    If it does not fit in one process, all processes refuse it. The CPU devices of all processes on
    a machine share its memory.

    Args:
        needed: bytes on each device.
        devices: number of devices of this process that take part.
        once: bytes that this process takes once, whatever the number of devices: `COMPILE_BYTES` or
            `RUN_BYTES`. They are in the memory of the machine, so they do not count on an
            accelerator.

    Raises:
        ConfigError: the training needs more memory than is free.
    """
    free = available()
    total = needed
    if jax.local_devices()[0].platform == "cpu":
        total = (needed * devices + once) * processes.count_on_this_machine()
    short = free is not None and total > free
    if processes.any_process(short):
        reason = "another process has less"
        if free is not None and short:
            reason = f"{free / GIB:,.1f} GiB are free"
        raise ConfigError(
            f"{OPTIONS}: this training needs {total / GIB:,.1f} GiB of memory, {reason}"
        )


def available() -> int | None:
    """Return the bytes that are free, or None if that is not known.

    On an accelerator they are the free bytes of one device. Otherwise they are the free bytes of
    this machine within the limits of container and process.
    """
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        if "bytes_limit" not in stats:
            return None
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    limits = [free for free in (_machine(), _container(), _process()) if free is not None]
    return min(limits, default=None)


def _machine() -> int | None:
    """Return the bytes that are free on this machine."""
    for line in _lines("/proc/meminfo"):
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return None


def _process() -> int | None:
    """Return the bytes that `ulimit -v` leaves this process."""
    if resource is None:
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    pages = [int(line.split()[0]) for line in _lines("/proc/self/statm")]
    if limit == resource.RLIM_INFINITY or not pages:
        return None
    return max(0, limit - pages[0] * resource.getpagesize())


def _container() -> int | None:
    """Return the bytes that the control groups of this process leave it, of version 1 or 2.

    It is the least of what its own group and the groups around it leave.
    """
    limits = []
    for line in _lines("/proc/self/cgroup"):
        _, controllers, path = line.split(":", 2)
        if controllers not in CONTROL_GROUPS:
            continue
        files = CONTROL_GROUPS[controllers]
        own = Path(path.lstrip("/"))
        for group in (own, *own.parents):  # a container's file system may show only the root
            free = _group(Path(files.root) / group, files)
            if free is not None:
                limits.append(free)
    return min(limits, default=None)


def _group(path: Path, files: ControlGroupFiles) -> int | None:
    """Return the bytes that the limit of a group leaves, or None if it has no limit.

    A cache that can be dropped counts as free.
    """
    limit = "".join(_lines(str(path / files.limit))).strip()
    used = "".join(_lines(str(path / files.used))).strip()
    if not (limit.isdigit() and used.isdigit()):
        return None
    rows = [
        line for line in _lines(str(path / "memory.stat")) if line.startswith(f"{files.cache} ")
    ]
    caches = [int(row.split()[1]) for row in rows]
    return int(limit) - int(used) + sum(caches)


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="ascii").splitlines()
    except OSError:
        return []


def _keys_as_words(tree: Any) -> Any:
    """Return the tree with each PRNG key replaced by the words that it consists of."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, tree)
