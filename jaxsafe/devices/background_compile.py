"""Programs that are compiled side by side, on threads of their own, while other work goes on."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import jax

from jaxsafe.devices.program_store import compile_anew, load, program_file, save

NUM_THREADS = 4
"""How many programs are compiled at a time. A training has as many.

The compiler does little in parallel by itself.
"""


class CompiledInBackground:
    """A jitted function whose arguments always have the same shapes.

    It is traced at once and compiled before it is first called, unless its program is in a file.
    """

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
            after: a function that is needed sooner. Its compilation has the cores first.
        """
        file = None if made_from is None else program_file(made_from, arguments)

        def load_or_compile(file: Path) -> jax.stages.Compiled:
            return load(file) or compile_in_turn(function.lower(*arguments))

        def compile_in_turn(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
            if after is not None:
                after.compiled()
            compiled, is_new = compile_anew(lowered)
            if file is not None and is_new:
                _threads().submit(save, file, lowered, compiled)
            return compiled

        self._lowered = None
        if file is not None and file.exists():
            self._compiled = _threads().submit(load_or_compile, file)
        else:
            self._lowered = function.lower(*arguments)
            self._compiled = _threads().submit(compile_in_turn, self._lowered)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function once it is compiled."""
        return self.compiled()(*arguments)

    def result_shapes(self) -> Any:
        """Return shapes and types of what the function returns."""
        info = (self._lowered or self.compiled()).out_info
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), info)

    def compiled(self) -> jax.stages.Compiled:
        """Wait for the program and return it."""
        return self._compiled.result()


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(NUM_THREADS, "compile")
