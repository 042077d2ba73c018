"""Packages that are also functions: `python -m jaxsafe.train` and `jaxsafe.train(…)`."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def make_callable(package: str, function: str, **names: str) -> None:
    """Let calls of a package call a function, which is imported at the first call.

    Args:
        package: the dotted name of the package. Its last part is the name of the function.
        function: the module that defines the function.
        names: further attributes of the package, each with the module that defines it.
    """

    class CallablePackage(ModuleType):
        # With this name `inspect` and `jax.jit` see the arguments of the function.
        @property
        def __wrapped__(self) -> Callable[..., Any]:
            return getattr(importlib.import_module(function), package.rpartition(".")[2])

        def __call__(self, *arguments: Any, **keywords: Any) -> Any:
            return self.__wrapped__(*arguments, **keywords)

        def __getattr__(self, name: str) -> Any:
            if name in names:
                return getattr(importlib.import_module(names[name]), name)
            raise AttributeError(f"module {package!r} has no attribute {name!r}")

    sys.modules[package].__class__ = CallablePackage
