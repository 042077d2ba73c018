"""End a command with a line of text if `ulimit -v` leaves too little memory for JAX.

This module is imported before jaxlib is. With too little memory some libraries raise an ImportError
or a MemoryError. Others end the process without an exception, so that nothing can be caught. A
program that imports jaxsafe is left alone, because it may need less than a command.
"""

from __future__ import annotations

import os
import sys

try:
    import resource
except ImportError:  # Windows
    resource = None

GIB = 2**30

LEAST = 2 * GIB
"""Bytes of address space that a command needs.

JAX's devices, with threads for two cores, take 1.4 GiB before anything is compiled. An evaluation
of docking2d takes 1.8 GiB.
"""


def shortage() -> str | None:
    """Return what is wrong with the address space of this process, or None if nothing is."""
    if resource is None:
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY or limit >= LEAST:
        return None
    return (
        f"memory is short: ulimit -v leaves {limit / GIB:.1f} GiB of address space,"
        f" a command needs {LEAST / GIB:.1f} GiB"
    )


def is_shortage(error: BaseException) -> bool:
    """Return whether an error says that there is not enough memory.

    The error may come from Python, from JAX, or from a library that could not be loaded.
    """
    signs = (
        "RESOURCE_EXHAUSTED",
        "Out of memory",
        "failed to map segment",
        "Cannot allocate memory",
        "bad_alloc",
    )
    return isinstance(error, MemoryError) or any(sign in str(error) for sign in signs)


# While Python looks for the module of `python -m`, the first argument is still "-m". The console
# script is called by its own name. No other program that imports jaxsafe is taken for a command.
_first = "".join(sys.argv[:1])
_is_command = _first == "-m" or os.path.basename(_first) in ("jaxsafe", "jaxsafe.exe")
if _is_command and (fault := shortage()):
    print(f"error: {fault}", file=sys.stderr)
    raise SystemExit(2)
