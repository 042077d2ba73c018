"""All types that an environment, a filter and an agent are made of.

`jaxsafe config types` prints them, and a page of the site lists them.
"""

from __future__ import annotations

import dataclasses
import difflib
import typing
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from jaxsafe.agents.agent import Agent
from jaxsafe.agents.features import Features
from jaxsafe.agents.networks import Network
from jaxsafe.commands.help_text import Row
from jaxsafe.control.law import ControlLaw
from jaxsafe.environment import Environment
from jaxsafe.processors.constraint import Constraint
from jaxsafe.processors.observation import Observation
from jaxsafe.processors.reward import Bound, Reward
from jaxsafe.processors.status import Status
from jaxsafe.processors.terminal import Terminal
from jaxsafe.rta.asif import Strengthening
from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.cascade import Stage
from jaxsafe.rta.certificate import BackupController, TerminalSet
from jaxsafe.rta.filter import RTA
from jaxsafe.schema.component import Component, Field, choices, fields
from jaxsafe.schema.convert import bare, expects, is_component, to_data
from jaxsafe.schema.errors import ConfigError, show
from jaxsafe.schema.field_docs import field_docs, paragraphs
from jaxsafe.schema.ties import Tie
from jaxsafe.simulation.controllers import Actuator, Controller
from jaxsafe.simulation.initializers import Direction, Initializer
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.regions import Offset, Region
from jaxsafe.simulation.scripted import Command
from jaxsafe.simulation.uncertainty import Uncertainty
from jaxsafe.simulation.vectors import Vector
from jaxsafe.train.hyperparameters import PPO


class Section(NamedTuple):
    """Types that can stand in the same field."""

    heading: str
    bases: tuple[type[Component], ...]


SECTIONS = {
    "environment": Section("Environment", (Environment, Tie)),
    "platforms": Section("Platforms", (Platform,)),
    "controller": Section("Controllers", (Controller, Actuator)),
    "commands": Section("Commands of a script", (Command,)),
    "start": Section("Starts", (Initializer, Direction)),
    "regions": Section("Regions", (Region, Offset)),
    "vector": Section("Vectors", (Vector,)),
    "status": Section("Statuses", (Status,)),
    "constraints": Section("Constraints", (Constraint,)),
    "uncertainty": Section("Uncertainty", (Uncertainty,)),
    "terminal": Section("Ends", (Terminal,)),
    "reward": Section("Rewards", (Reward, Bound)),
    "observation": Section("Observations", (Observation,)),
    "rta": Section("Filters", (RTA, UncertaintyBound, Stage, Strengthening)),
    "backups": Section("Backup controllers", (BackupController,)),
    "terminal_set": Section("Terminal sets", (TerminalSet,)),
    "control_laws": Section("Control laws", (ControlLaw,)),
    "agent": Section("Agents", (Agent, Features, Network)),
    "ppo": Section("PPO", (PPO,)),
}
"""The sections. Most have the name of the field in which their types stand."""


class Entry(NamedTuple):
    """The description of a type."""

    name: str
    paragraphs: list[str]
    rows: list[Row]
    """Its fields, except the name, which is the user's choice."""


def find(name: str) -> list[type[Component]]:
    """Return the types of the section of this name, or else the types of this name.

    Raises:
        ConfigError: neither a section nor a type has this name.
    """
    # `region` means the section `regions`.
    sections = {key.rstrip("s"): section for key, section in SECTIONS.items()}
    if name.rstrip("s") in sections:
        return types_of(sections[name.rstrip("s")], with_users=True)
    types = [cls for section in SECTIONS.values() for cls in types_of(section, with_users=True)]
    matches = [cls for cls in dict.fromkeys(types) if title(cls) == name]
    if not matches:
        near = difflib.get_close_matches(name, [*SECTIONS, *map(title, types)], n=3, cutoff=0.6)
        hint = f"; choose from the types and from the sections {', '.join(SECTIONS)}"
        if near:
            hint = f". Did you mean {' or '.join(map(repr, dict.fromkeys(near)))}?"
        raise ConfigError(f"types: nothing is called {show(name)}{hint}")
    return matches


def types_of(section: Section, with_users: bool = False) -> list[type[Component]]:
    """Return the types of a section, with those that a user has defined if `with_users` is true."""
    return [cls for base in section.bases for cls in _classes(base, with_users)]


def describe(cls: type[Component], with_users: bool = False) -> Entry:
    """Return the description of a type."""
    docs = field_docs(cls)
    rows = [
        Row(
            name=name,
            takes=_takes(field, with_users),
            default=_default(field),
            text=_line(docs.get(name, "")),
        )
        for name, field in fields(cls).items()
        if name != "name"
    ]
    return Entry(name=title(cls), paragraphs=paragraphs(cls), rows=rows)


def title(cls: type[Component]) -> str:
    """Return the name of a type in YAML, or a name for a type that has none there."""
    return cls.type_name or cls.__name__.lower()


def number(value: Any) -> str:
    """Return a number, or a list of numbers, as readable text.

    A fraction of π is written as such if it is exact in float32.
    """
    if np.ndim(value):
        return "[" + ", ".join(map(number, value)) + "]"
    scalar = np.float32(value)
    share = Fraction(float(scalar) / np.pi).limit_denominator(180)
    if (
        share
        and abs(float(share) * np.pi / float(scalar) - 1.0) < 1e-6
        and share.denominator * abs(share.numerator) < 400
    ):
        top = {1: "π", -1: "-π"}.get(share.numerator, f"{share.numerator}π")
        text = top if share.denominator == 1 else f"{top}/{share.denominator}"
    else:
        text = np.format_float_positional(scalar, trim="-")
    return text.replace("-", "−")


def _classes(base: type[Component], with_users: bool) -> list[type[Component]]:
    """Return the types that can stand for a base, or the base itself if there are none."""
    types = choices(base).values()
    shown = [cls for cls in types if with_users or cls.__module__.startswith("jaxsafe.")]
    return shown or [base]


def _takes(field: Field, with_users: bool) -> str:
    """Return what a field takes: some types, a name from a section, or what its errors say."""
    core = bare(field.hint)
    inner = typing.get_args(core)
    base = inner[0] if typing.get_origin(core) is tuple and inner else core
    if is_component(base):
        types = ", ".join(f"`{title(cls)}`" for cls in _classes(base, with_users))
        return ("a list of " if inner else "one of " if "," in types else "") + types
    if field.refers and core is str:
        return f"a name of {field.refers.where}"
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


def _line(text: str) -> str:
    return " ".join(text.split())
