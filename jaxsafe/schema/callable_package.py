"""Packages that are also functions: `python -m jaxsafe.train` and `jaxsafe.train(…)`."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def make_callable(package: str, function: str, **names: str) -> None:
    """Let calls of a package call a function, which is imported with the first one.

    Args:
        package: the name of the package.
        function: the module of the function, which has the name of the package's last part.
        names: further attributes of the package, each with the module that defines it.
    """

    class CallablePackage(ModuleType):
        @property
        def __wrapped__(
            self,
        ) -> Callable[..., Any]:  # so that `inspect` and `jax.jit` see its arguments
            return getattr(importlib.import_module(function), package.rpartition(".")[2])

        def __call__(self, *arguments: Any, **keywords: Any) -> Any:
            return self.__wrapped__(*arguments, **keywords)

        def __getattr__(self, name: str) -> Any:
            if name in names:
                return getattr(importlib.import_module(names[name]), name)
            raise AttributeError(f"module {package!r} has no attribute {name!r}")

    sys.modules[package].__class__ = CallablePackage
