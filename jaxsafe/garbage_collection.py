"""A pause of Python's garbage collector while modules are imported and programs are traced.

Both make many objects that last. Looking through all of them again and again takes a tenth of the
time and finds nothing.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_collection() -> Iterator[None]:
    """Suspend garbage collection, unless it is already.

    All objects then count as old. Otherwise the collector would look through all new ones at once.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            if not gc.get_freeze_count():  # nobody keeps objects out of the collector's sight
                gc.freeze()
                gc.unfreeze()
            gc.enable()
