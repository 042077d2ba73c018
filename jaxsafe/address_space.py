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

Devices, with threads for two cores, take 1.4 GiB before anything is compiled. Evaluating docking2d
takes 1.8 GiB.
"""


def shortage() -> str | None:
    """Return what is wrong with the limit of this process, or None if nothing is."""
    if resource is None:
        return None
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if most == resource.RLIM_INFINITY or most >= LEAST:
        return None
    return (
        f"memory is short: ulimit -v leaves {most / GIB:.1f} GiB of address space,"
        f" a command needs {LEAST / GIB:.1f} GiB"
    )


def is_shortage(error: BaseException) -> bool:
    """Return whether an error says that there is not enough memory.

    It may be Python's own error, one of JAX, or one of a library that could not be loaded.
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
# script is called by its name. So this holds for commands only.
_first = "".join(sys.argv[:1])
_is_command = _first == "-m" or os.path.basename(_first) in ("jaxsafe", "jaxsafe.exe")
if _is_command and (fault := shortage()):
    print(f"error: {fault}", file=sys.stderr)
    raise SystemExit(2)
