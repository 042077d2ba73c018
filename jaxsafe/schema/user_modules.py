"""Modules in which a user defines components.

A YAML file names such modules, so that they are imported before the rest of it is read.
"""

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
from jaxsafe.schema.errors import ConfigError, show, summarise_error

_imports_allowed: ContextVar[bool] = ContextVar("imports_allowed", default=True)


@contextmanager
def imports_allowed(allowed: bool) -> Iterator[None]:
    """Set whether files may name modules to import. Importing a module runs its code."""
    token = _imports_allowed.set(allowed)
    try:
        yield
    finally:
        _imports_allowed.reset(token)


def modules(component: Component) -> list[str]:
    """Return the modules outside jaxsafe that define parts of a component, by first use."""
    module = type(component).__module__
    names = [] if module.split(".")[0] == "jaxsafe" else [module]
    for field_name in fields(type(component)):
        value = getattr(component, field_name)
        for inner in value if isinstance(value, tuple) else (value,):
            names += modules(inner) if isinstance(inner, Component) else []
    return list(dict.fromkeys(names))


def import_modules(names: Any, place: str) -> None:
    """Import modules. The current directory is searched too.

    Raises:
        ConfigError: `names` is not a list of names, a module cannot be imported, or imports are not
            allowed.
    """
    place = join(place, "imports")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{place}: expected a list of modules, found {show(names)}")
    if names and not _imports_allowed.get():
        raise ConfigError(
            f"{place}: names {show(names)}, whose code would run; imports=false refuses that"
        )
    if os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.append(os.getcwd())
    for name in names:
        try:
            importlib.import_module(name)
        except ConfigError:
            raise
        except (Exception, SystemExit) as error:
            reason = summarise_error(error, [name])
            raise ConfigError(f"{place}: cannot import {show(name)}: {reason}") from error
