"""The pages `docs/reference/options.md` and `docs/reference/parts.md`, from the code itself.

Run `python docs/make_reference.py` after a change of an option or a component.
`tests/docs/test_docs.py` compares the committed pages with it.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import itertools
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path

from make_tasks import number, table, wrapped

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.features import Features
from jaxsafe.agents.networks import Network
from jaxsafe.commands import COMMANDS
from jaxsafe.commands.help_text import entries, grouped, shown
from jaxsafe.envs import TASKS
from jaxsafe.processors.constraint import Constraint
from jaxsafe.processors.observation import Observation
from jaxsafe.processors.reward import Bound, Reward
from jaxsafe.processors.status import Status
from jaxsafe.processors.terminal import Terminal
from jaxsafe.rta.asif import Strengthening
from jaxsafe.rta.cascade import Stage
from jaxsafe.rta.filter import RTA, BackupController, TerminalSet
from jaxsafe.schema.component import Component, Field, choices, fields
from jaxsafe.schema.convert import bare, expects, to_data
from jaxsafe.schema.field_docs import field_docs
from jaxsafe.simulation.controllers import Actuator, Controller
from jaxsafe.simulation.geometry import Offset, Region
from jaxsafe.simulation.initializers import Direction, Initializer
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.scripted import Command
from jaxsafe.train.host.options import flatten
from jaxsafe.train.host.options import recipes as task_recipes
from jaxsafe.train.ppo import PPO

TARGET = Path(__file__).parent / "reference"

KINDS: dict[str, tuple[type[Component], ...]] = {
    "Platforms": (Platform,),
    "Controllers": (Controller, Actuator),
    "Commands of a script": (Command,),
    "Starts": (Initializer, Direction),
    "Regions": (Region, Offset),
    "Statuses": (Status,),
    "Constraints": (Constraint,),
    "Ends": (Terminal,),
    "Rewards": (Reward, Bound),
    "Observations": (Observation,),
    "Filters": (RTA, Stage, Strengthening),
    "Backup controllers": (BackupController,),
    "Terminal sets": (TerminalSet,),
    "Agents": (Agent, Features, Network),
    "PPO": (PPO,),
}
"""Headings of the catalogue, and the bases of the parts below each."""


def options() -> str:
    """Return the page of all options of all commands."""
    blocks = [
        "<!-- Written by docs/make_reference.py. -->\n# Command line",
        (
            "`jaxsafe` lists the commands, and `jaxsafe COMMAND help` prints what this page says of"
            " one. `jaxsafe train TASK help` shows the defaults of the task's recipe. An option is"
            " written `name=value`, and the first word may be the value of `env` or `run` alone:"
            " `jaxsafe train docking3d`. A list is written with commas. `python -m jaxsafe.COMMAND`"
            " is the same as `jaxsafe COMMAND`; for `falsify` and `safe_set` it is"
            " `python -m jaxsafe.rta.falsify` and `python -m jaxsafe.plot.safe_set`."
        ),
        "The exit code is 0, or 2 after a mistake in an option or a file, 3 if a seed diverged, and"
        " 130 after Ctrl-C. `falsify` exits with 1 if there was a violation.",
    ]
    for command in COMMANDS:
        module = importlib.import_module(f"jaxsafe.commands.{command}")
        blocks += [f"## jaxsafe {command}", _line(module.__doc__ or "")]
        for title, group in grouped(module.Options, entries(module.Options)).items():
            rows = ((f"`{row.name}`", row.takes, row.default, _line(row.text)) for row in group)
            blocks += [title, table(("option", "takes", "default", "meaning"), rows)]
    blocks += ["## Recipes", *recipes()]
    return _page(blocks)


def _line(text: str) -> str:
    return " ".join(text.split())


def recipes() -> Iterator[str]:
    """Yield what the recipes of the tasks put in the place of defaults, a table per preset."""
    yield (
        "A recipe puts its values in the place of the defaults above. `preset=` chooses one. An"
        " empty cell keeps the default."
    )
    found = {task: task_recipes(task) for task in TASKS}
    for preset in next(iter(found.values())):
        values = {task: flatten(presets[preset] or {}) for task, presets in found.items()}
        names = dict.fromkeys(name for flat in values.values() for name in flat)
        yield f"### preset={preset}"
        yield table(
            ("option", *TASKS),
            (
                (
                    f"`{name}`",
                    *(shown(flat[name]) if name in flat else "" for flat in values.values()),
                )
                for name in names
            ),
        )


def parts() -> str:
    """Return the catalogue of everything that an environment or an agent is made of."""
    blocks = [
        "<!-- Written by docs/make_reference.py. -->\n# Configuration catalogue",
        (
            "These are the parts of an environment, a filter and an agent, as YAML and overrides"
            " name them. [Compose](../compose.md) puts them together, and"
            " [Extend](../extend.md) defines others. A part is written `{type: …, name: …, …}`."
            " The name is the user's choice, and the tables leave it out. Fields without a default"
            " must be given. A length is in metres for spacecraft and in feet for aircraft."
        ),
    ]
    for heading, bases in KINDS.items():
        blocks.append(f"## {heading}")
        for base in bases:
            blocks += itertools.chain.from_iterable(map(part, _classes(base)))
    return _page(blocks)


def _classes(base: type[Component]) -> list[type[Component]]:
    found = [cls for cls in choices(base).values() if cls.__module__.startswith("jaxsafe.")]
    return found or [base]


def name(cls: type[Component]) -> str:
    """Return what YAML calls a part, or what the catalogue calls one that has no type."""
    return cls.type_name or cls.__name__.lower()


def part(cls: type[Component]) -> Iterator[str]:
    """Yield the name of a part, what it is, and its fields."""
    yield f"### `{name(cls)}`"
    yield from inspect.cleandoc(cls.__doc__ or "").split("\n\n")
    docs = field_docs(cls)
    rows = [
        (f"`{key}`", _takes(field), _default(field), _line(docs.get(key, "")))
        for key, field in fields(cls).items()
        if key != "name"
    ]
    heads = ("field", "takes", "default", "meaning")
    if rows:
        columns = len(heads) if any(row[-1] for row in rows) else len(heads) - 1
        yield table(heads[:columns], (row[:columns] for row in rows))


def _takes(field: Field) -> str:
    """Return what a field takes: which parts, a name of which section, or as errors say it."""
    core = bare(field.hint)
    inner = typing.get_args(core)
    base = inner[0] if typing.get_origin(core) is tuple and inner else core
    if isinstance(base, type) and issubclass(base, Component):
        types = ", ".join(f"`{name(cls)}`" for cls in _classes(base))
        return ("a list of " if inner else "one of " if "," in types else "") + types
    if field.refers and core is str:
        return f"a name of `{field.refers.section}`"
    return expects(field)


def _default(field: Field) -> str:
    value = field.default
    if value is dataclasses.MISSING:
        return ""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Component) and not fields(type(value)):
        return f"`{value.type_name}`"
    if isinstance(value, str):
        return f"`{value}`"
    if field.unit:
        return number(value)
    return f"`{to_data(value)}`"


def _page(blocks: Iterable[str]) -> str:
    return "\n\n".join(wrapped(block) for block in blocks if block) + "\n"


if __name__ == "__main__":
    TARGET.mkdir(exist_ok=True)
    (TARGET / "options.md").write_text(options(), encoding="utf-8")
    (TARGET / "parts.md").write_text(parts(), encoding="utf-8")
