"""Programs that are compiled side by side, on threads of their own, while other work goes on."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import jax

from jaxsafe.devices import memory
from jaxsafe.devices.program_store import (
    compile_anew,
    program_file,
    read,
    save,
)

NUM_THREADS = 4
"""How many programs are compiled at a time. A training has as many.

The compiler does little in parallel by itself.
"""


class CompiledInBackground:
    """A jitted function whose arguments always have the same shapes.

    It is traced at once and compiled before it is first called, unless its program is in a file.
    """

    result_shapes: Any
    """Shapes and types of what it returns."""

    def __init__(
        self,
        function: Any,
        *arguments: Any,
        made_from: str | None = None,
        after: CompiledInBackground | None = None,
    ) -> None:
        """Begin to compile a function, or to load what it was compiled to in another process.

        Args:
            function: the jitted function.
            *arguments: arguments like those of the calls, or their shapes, types and shardings.
            made_from: a text for `program_file`. None stands for a program that is not stored.
            after: a function that is needed sooner. It is compiled or loaded first.
        """
        file = None if made_from is None else program_file(made_from, arguments)
        stored = None if file is None else read(file)
        lowered = None if stored else function.lower(*arguments)

        def load_or_compile() -> jax.stages.Compiled:
            if after is not None:
                after.compiled()
            return (stored and stored.load()) or compile_and_store(
                lowered or function.lower(*arguments)
            )

        def compile_and_store(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
            compiled, is_new = compile_anew(lowered)
            if file is not None and is_new:
                _threads().submit(save, file, lowered, compiled, self.result_shapes)
            return compiled

        self._stored = stored
        self.result_shapes = (
            stored.result_shapes if stored else jax.eval_shape(function, *arguments)
        )
        self._compiled = _threads().submit(load_or_compile)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function once it is compiled."""
        return self.compiled()(*arguments)

    def compiled(self) -> jax.stages.Compiled:
        """Wait for the program and return it."""
        return self._compiled.result()

    def footprint(self) -> int:
        """Return the bytes that the program needs on each device, as `memory.footprint` does."""
        return memory.footprint(self.compiled()) if self._stored is None else self._stored.footprint


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(NUM_THREADS, "compile")
