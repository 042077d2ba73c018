"""What JAX's profiler measures, without its files."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple


class Event(NamedTuple):
    """Something that the profiler measured on a thread."""

    start_ns: float
    duration_ns: float
    name: str


@contextlib.contextmanager
def profiled() -> Iterator[list[list[Event]]]:
    """Profile what is inside. The list holds the events of each thread once that has ended."""
    import jax

    options = jax.profiler.ProfileOptions()
    options.python_tracer_level = 0
    threads: list[list[Event]] = []
    with tempfile.TemporaryDirectory() as place:
        jax.profiler.start_trace(place, profiler_options=options)
        yield threads
        jax.profiler.stop_trace()
        [file] = Path(place).rglob("*.xplane.pb")
        threads += [
            [Event(event.start_ns, event.duration_ns, event.name) for event in line.events]
            for plane in jax.profiler.ProfileData.from_file(str(file)).planes
            for line in plane.lines
        ]
