"""Programs that are compiled side by side, on threads of their own, while other work goes on."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import jax

NUM_THREADS = 4
"""How many programs are compiled at a time. A training has as many.

The compiler does little in parallel by itself.
"""


class CompiledInBackground:
    """A jitted function whose arguments always have the same shapes.

    It is traced at once and compiled before it is first called.
    """

    def __init__(
        self,
        function: Any,
        *arguments: Any,
        after: CompiledInBackground | None = None,
    ) -> None:
        """Begin to compile a function.

        Args:
            function: the jitted function.
            *arguments: arguments like those of the calls, or their shapes, types and shardings.
            after: a function that is needed sooner. Its compilation has the cores first.
        """
        lowered = function.lower(*arguments)

        def compile_in_turn() -> jax.stages.Compiled:
            if after is not None:
                after.compiled()
            return lowered.compile()

        self._compiled = _threads().submit(compile_in_turn)

    def __call__(self, *arguments: Any) -> Any:
        """Call the function once it is compiled."""
        return self.compiled()(*arguments)

    def compiled(self) -> jax.stages.Compiled:
        """Wait for the program and return it."""
        return self._compiled.result()


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(NUM_THREADS, "compile")
