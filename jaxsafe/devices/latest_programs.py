"""Compiled functions that give up their oldest programs.

JAX keeps up to 4,096 programs of a function, and with each the policy that is a constant in it. On
a CPU one holds about 300 of the 65,530 memory maps that Linux gives a process, so a process that
runs some 200 policies one after another would end in a segmentation fault.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable
from typing import Any

import jax

MAX_PROGRAMS = 32
"""Number of programs that a function keeps."""


def latest_programs(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that is compiled, and keeps the programs that ran last.

    Args:
        function: takes `constants` as its first argument. All others are trees of arrays.

    Returns:
        A function of the same arguments. `constants` must have a hash. What compares equal to
        earlier ones, with arrays of the same shapes, compiles nothing again.
    """

    @functools.lru_cache(maxsize=MAX_PROGRAMS)
    def program(constants: Hashable, structure: Hashable) -> Callable[..., Any]:
        # The structure is part of what names a program: each has a program of its own in JAX too.
        @functools.wraps(function)
        def run(*arrays: Any) -> Any:
            return function(constants, *arrays)

        return jax.jit(run)

    @functools.wraps(function)
    def call(constants: Hashable, *arrays: Any) -> Any:
        return program(constants, jax.tree.structure(arrays))(*arrays)

    return call
