"""Aerospace SafeRL benchmarks as pure JAX functions."""

import importlib
from typing import TYPE_CHECKING, Any

import jaxsafe.address_space
import jaxsafe.quiet  # noqa: F401 before anything imports jaxlib
from jaxsafe.garbage_collection import without_collection

with without_collection():
    from jaxsafe.agents.policy_file import load_policy
    from jaxsafe.config import dump, load, override
    from jaxsafe.environment import Environment, reset, reset_to, step
    from jaxsafe.envs import make
    from jaxsafe.rollout import rollout
    from jaxsafe.schema.errors import ConfigError, choices_text

if TYPE_CHECKING:
    from jaxsafe.evaluate.evaluate import evaluate
    from jaxsafe.flight import fly
    from jaxsafe.runs.run import open_run
    from jaxsafe.runs.training import train
    from jaxsafe.verify.verify import verify

    TASKS: tuple[str, ...]
    __version__: str
else:
    from jaxsafe import evaluate, train, verify  # packages that can be called

__all__ = [
    "TASKS",
    "ConfigError",
    "Environment",
    "__version__",
    "dump",
    "evaluate",
    "fly",
    "load",
    "load_policy",
    "make",
    "open_run",
    "override",
    "reset",
    "reset_to",
    "rollout",
    "step",
    "train",
    "verify",
]

_LATER = {"fly": "jaxsafe.flight", "open_run": "jaxsafe.runs.run"}
"""Functions whose modules are imported when they are first used."""


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return getattr(importlib.import_module(_LATER[name]), name)
    if name == "TASKS":
        from jaxsafe.envs import TASKS

        return tuple(TASKS)  # a task that is registered later is among them too
    if name == "__version__":
        from jaxsafe.storage.provenance import version

        return version()
    hint = choices_text(name, __all__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")


def __dir__() -> list[str]:
    return sorted(
        {*globals(), *__all__}
        - {"Any", "TYPE_CHECKING", "choices_text", "importlib", "without_collection"}
    )
