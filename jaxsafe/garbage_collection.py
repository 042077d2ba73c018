"""A pause of Python's garbage collector while modules are imported and programs are traced.

Both make many objects that last. Looking through all of them again and again takes a tenth of the
time and finds nothing.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_collection() -> Iterator[None]:
    """Suspend garbage collection, unless it is already."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
