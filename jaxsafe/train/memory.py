"""Whether a training fits into memory, told before it starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax

from jaxsafe.errors import ConfigError
from jaxsafe.train import hosts
from jaxsafe.types import is_key

GIB = 2**30


def size(shapes: Any) -> int:
    """Bytes of all arrays of a tree, or of their shapes."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(_raw, shapes)))


def footprint(compiled: jax.stages.Compiled) -> int:
    """Bytes that a compiled program needs on each of its devices, what it is given included; 0 where that is not known."""
    found = compiled.memory_analysis()
    return 0 if found is None else int(
        found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes - found.alias_size_in_bytes
    )  # fmt: skip


def require(needed: int, devices: int, what: str) -> None:
    """Refuse what does not fit, in every process if it does not in one.

    Args:
        needed: bytes on each device.
        devices: how many of this process take part.
        what: the options that decide it.

    Raises:
        ConfigError: the devices do not have as much left; on a CPU they share what the machine has.
    """
    free = available()
    total = needed * devices if jax.local_devices()[0].platform == "cpu" else needed
    short = free is not None and total > free
    if hosts.anyone(short):
        found = f"{free / GIB:,.1f} GiB are free" if free is not None and short else "another process has less"
        raise ConfigError(f"{what}: this training needs {total / GIB:,.1f} GiB of memory, {found}")


def available() -> int | None:
    """Bytes free on an accelerator, or on this machine and within the limit of its container; None if nobody tells."""
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0) if "bytes_limit" in stats else None
    known = [free for free in (_machine(), _container()) if free is not None]
    return min(known) if known else None


def _machine() -> int | None:
    for line in _lines("/proc/meminfo"):
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return None


def _container() -> int | None:
    limit, used = ("".join(_lines(f"/sys/fs/cgroup/memory.{name}")) for name in ("max", "current"))
    return int(limit) - int(used) if limit.strip().isdigit() and used.strip().isdigit() else None


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="ascii").splitlines()
    except OSError:
        return []


def _raw(tree: Any) -> Any:
    """Keys as the words that they are."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, tree)
