"""Whether a training fits into memory, told before it starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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

COMPILING = 1450 * 2**20
"""Bytes that each process takes while the programs of a training are compiled. Resident memory rose by 1.12 GB for
docking2d, 1.29 GB with its filter, and 1.41 GB for rejoin3d. Not counted: it rose by 1.86 GB for
rejoin3d with 16,384 environments, and by 2.01 GB with its filter."""

RUNNING = 320 * 2**20
"""Bytes that each process takes besides the buffers of the update: code, small programs of evaluations, logs, figures.
Resident memory rose by 250 MB for docking2d after the update had been compiled."""

GROUPS = {
    "": ("/sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"),
    "memory": ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}
"""By controllers as in /proc/self/cgroup, version 2 and 1: where groups are, and what says limit, use and cache."""


def size(shapes: Any) -> int:
    """Bytes of all arrays of a tree, or of their shapes."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(_raw, shapes)))


def footprint(compiled: jax.stages.Compiled) -> int:
    """Bytes that a compiled program needs on each of its devices, what it is given included; 0 where that is not known."""
    found = compiled.memory_analysis()
    return 0 if found is None else int(
        found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes - found.alias_size_in_bytes
    )  # fmt: skip


def require(needed: int, devices: int, what: str, beside: int = 0) -> None:
    """Refuse what does not fit, in every process if it does not in one.

    Args:
        needed: bytes on each device.
        devices: how many of this process take part.
        what: the options that decide it.
        beside: bytes that this process takes once, whatever the number of devices: `COMPILING` or `RUNNING`. They are in
            the memory of the machine, so an accelerator does not need to have them.

    Raises:
        ConfigError: the devices do not have as much left; CPU devices of all processes on a machine share what it has.
    """
    free = available()
    on_cpu = jax.local_devices()[0].platform == "cpu"
    total = (needed * devices + beside) * processes.beside() if on_cpu else needed
    short = free is not None and total > free
    if processes.anyone(short):
        found = f"{free / GIB:,.1f} GiB are free" if free is not None and short else "another process has less"
        raise ConfigError(f"{what}: this training needs {total / GIB:,.1f} GiB of memory, {found}")


def available() -> int | None:
    """Bytes free on an accelerator, or on this machine within the limits of container and process; None if nobody tells."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0) if "bytes_limit" in stats else None
    known = [free for free in (_machine(), _container(), _process()) if free is not None]
    return min(known) if known else None


def _machine() -> int | None:
    for line in _lines("/proc/meminfo"):
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return None


def _process() -> int | None:
    """What `ulimit -v` leaves this process."""
    if resource is None:
        return None
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    pages = [int(line.split()[0]) for line in _lines("/proc/self/statm")]
    if most == resource.RLIM_INFINITY or not pages:
        return None
    return max(0, most - pages[0] * resource.getpagesize())


def _container() -> int | None:
    """What the control groups of this process leave it, version 1 or 2: the least of its own and of those around it."""
    known = []
    for line in _lines("/proc/self/cgroup"):
        _, controllers, path = line.split(":", 2)
        if controllers not in GROUPS:
            continue
        root, limit, used, cache = GROUPS[controllers]
        group = Path(path.lstrip("/"))
        for inner in (group, *group.parents):  # of a container, the file system may show only the root
            known.append(_left(Path(root) / inner, limit, used, cache))
    return min((free for free in known if free is not None), default=None)


def _left(group: Path, limit: str, used: str, cache: str) -> int | None:
    """The limit of a control group, less what is used and not a cache that can be dropped."""
    most, now = ("".join(_lines(str(group / name))).strip() for name in (limit, used))
    if not (most.isdigit() and now.isdigit()):
        return None
    dropped = [int(line.split()[1]) for line in _lines(str(group / "memory.stat")) if line.startswith(f"{cache} ")]
    return int(most) - int(now) + sum(dropped)


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="ascii").splitlines()
    except OSError:
        return []


def _raw(tree: Any) -> Any:
    """Keys as the words that they are."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, tree)
