"""Components of a user's own package in YAML: the modules that define them, to import before the rest is read."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from jaxsafe.schema.component import Component, fields
from jaxsafe.schema.dotted_paths import join
from jaxsafe.schema.errors import ConfigError, show, told

_allowed: ContextVar[bool] = ContextVar("allowed", default=True)


@contextmanager
def allowed(whether: bool) -> Iterator[None]:
    """Say whether files may name modules to import, which runs their code."""
    token = _allowed.set(whether)
    try:
        yield
    finally:
        _allowed.reset(token)


def modules(component: Component) -> list[str]:
    """The modules outside jaxsafe that define parts of a component, in order of first use."""
    module = type(component).__module__
    found = [] if module.split(".")[0] == "jaxsafe" else [module]
    for name in fields(type(component)):
        value = getattr(component, name)
        for inner in value if isinstance(value, tuple) else (value,):
            found += modules(inner) if isinstance(inner, Component) else []
    return list(dict.fromkeys(found))


def import_modules(names: Any, place: str) -> None:
    """Import modules, from the current directory too.

    Raises:
        ConfigError: `names` is not a list of names, or a module cannot be imported or must not be.
    """
    here = join(place, "imports")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{here}: expected a list of modules, found {show(names)}")
    if names and not _allowed.get():
        raise ConfigError(f"{here}: names {show(names)}, whose code would run; imports=false refuses that")
    if os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.append(os.getcwd())
    for name in names:
        try:
            importlib.import_module(name)
        except ConfigError:
            raise
        except (Exception, SystemExit) as error:
            raise ConfigError(f"{here}: cannot import {show(name)}: {told(error, [name])}") from error
