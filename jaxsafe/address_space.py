"""Ends a command in one line where `ulimit -v` leaves too little for JAX. Imported before jaxlib is.

Some libraries raise an ImportError or a MemoryError then, and others end the process without one, so that nothing can be
caught. A program that imports jaxsafe is left alone: it may need less than a command.
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
"""Bytes of address space that a command needs. Devices, with threads for two cores, take 1.4 GiB before anything is
compiled, and evaluating docking2d takes 1.8 GiB."""


def shortage() -> str | None:
    """Return what is wrong with the limit of this process, None if nothing is."""
    if resource is None:
        return None
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if most == resource.RLIM_INFINITY or most >= LEAST:
        return None
    return f"memory is short: ulimit -v leaves {most / GIB:.1f} GiB of address space, a command needs {LEAST / GIB:.1f} GiB"


def is_shortage(error: BaseException) -> bool:
    """Return whether an error says that there is not enough memory: Python's own, JAX's, or that of a library to load."""
    signs = (
        "RESOURCE_EXHAUSTED",
        "Out of memory",
        "failed to map segment",
        "Cannot allocate memory",
        "bad_alloc",
    )
    return isinstance(error, MemoryError) or any(sign in str(error) for sign in signs)


_command = sys.argv[:1] == ["-m"]  # as long as Python looks for the module
_command |= os.path.basename("".join(sys.argv[:1])) in (
    "jaxsafe",
    "jaxsafe.exe",
)  # the console script
if _command and (fault := shortage()):
    print(f"error: {fault}", file=sys.stderr)
    raise SystemExit(2)
