"""Which task an environment is, and where it differs from it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from jaxsafe.config import build
from jaxsafe.environment import Environment
from jaxsafe.envs.task import registered
from jaxsafe.schema.convert import to_data


def identity(env: Environment) -> dict[str, Any]:
    """Return what results say about their task.

    Returns:
        `id`, the Gymnasium id of the task after which the environment is named, or None, and
        `changes`, the dotted paths of the numbers and parts that are not those of the task. Its
        filter is no change, because results name it.
    """
    task = registered(env.task)
    if task is None or task.gymnasium_id is None:
        return {"id": None, "changes": []}
    declared = to_data(build(task.environment()).replace(rta=None))
    return {
        "id": task.gymnasium_id,
        "changes": sorted(set(_different(declared, to_data(env.replace(rta=None))))),
    }


def _different(task: Any, found: Any, path: str = "") -> Iterator[str]:
    """Yield the paths at which two values of plain data differ. Parts of a list go by name."""
    if isinstance(task, list) and isinstance(found, list):
        task, found = _by_name(task), _by_name(found)
    if not (isinstance(task, dict) and isinstance(found, dict)):
        if task != found:
            yield path
        return
    for key in [*task, *(key for key in found if key not in task)]:
        inner = f"{path}.{key}" if path and path != "platforms" else key
        if key in task and key in found:
            yield from _different(task[key], found[key], inner)
        else:
            yield inner


def _by_name(items: list[Any]) -> Any:
    """Return named parts as a mapping, and other lists as they are."""
    named = all(isinstance(item, dict) and "name" in item for item in items)
    return {item["name"]: item for item in items} if items and named else items
