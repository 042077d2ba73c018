"""Everything that a part of your own needs, in one import: bases, annotations and helpers.

    from jaxsafe.parts import MetresPerSecond, PlatformName, Status

A part is a subclass of a base with annotated fields and one or two pure methods; docs/extend.md and
docs/extend_rta.md show each kind.
"""

from jaxsafe.agents.features import Features
from jaxsafe.agents.networks import Network
from jaxsafe.control.law import ControlLaw
from jaxsafe.environment import Environment
from jaxsafe.envs.task import Task, register
from jaxsafe.processors.constraint import Constraint
from jaxsafe.processors.observation import Observation
from jaxsafe.processors.reward import Bound, Reward
from jaxsafe.processors.status import Status
from jaxsafe.processors.strengthening import Strengthening
from jaxsafe.processors.terminal import Terminal
from jaxsafe.rta.certificate import BackupController, Faults, TerminalSet
from jaxsafe.rta.certified import CertifiedRTA
from jaxsafe.rta.filter import RTA, RTAMemory
from jaxsafe.schema.component import ANY, Component, Range, Refers, Unit
from jaxsafe.schema.errors import ConfigError
from jaxsafe.schema.ties import Tie
from jaxsafe.simulation.controllers import (
    Actuator,
    AgentController,
    Continuous,
    Controller,
    Discrete,
    Mixed,
)
from jaxsafe.simulation.geometry import (
    angle_between,
    direction,
    rotation,
    safe_norm,
    to_body,
    to_global,
)
from jaxsafe.simulation.initializers import Direction, Initializer
from jaxsafe.simulation.integrate import runge_kutta
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.regions import Offset, Region
from jaxsafe.simulation.scripted import Command, Scripted
from jaxsafe.simulation.uncertainty import ActuatorFault, Disturbance, Uncertainty
from jaxsafe.simulation.vectors import Vector
from jaxsafe.types import (
    AnyStatusName,
    CentreName,
    ConstraintName,
    Dimensionless,
    FlagName,
    Key,
    Kilograms,
    Length,
    MetresPerSecond,
    Newtons,
    Number,
    OutcomeName,
    PerSecond,
    PlaceName,
    PlatformName,
    Positive,
    Radians,
    RadiansPerSecond,
    Record,
    RegionName,
    RegionState,
    RTAInfo,
    Seconds,
    ShapeName,
    Sim,
    StatusName,
    place,
)

__all__ = [
    "ANY",
    "RTA",
    "Actuator",
    "ActuatorFault",
    "AgentController",
    "AnyStatusName",
    "BackupController",
    "Bound",
    "CentreName",
    "CertifiedRTA",
    "Command",
    "Component",
    "ConfigError",
    "Constraint",
    "ConstraintName",
    "Continuous",
    "ControlLaw",
    "Controller",
    "Dimensionless",
    "Direction",
    "Discrete",
    "Disturbance",
    "Environment",
    "Faults",
    "Features",
    "FlagName",
    "Initializer",
    "Key",
    "Kilograms",
    "Length",
    "MetresPerSecond",
    "Mixed",
    "Network",
    "Newtons",
    "Number",
    "Observation",
    "Offset",
    "OutcomeName",
    "PerSecond",
    "PlaceName",
    "Platform",
    "PlatformName",
    "Positive",
    "RTAInfo",
    "RTAMemory",
    "Radians",
    "RadiansPerSecond",
    "Range",
    "Record",
    "Refers",
    "Region",
    "RegionName",
    "RegionState",
    "Reward",
    "Scripted",
    "Seconds",
    "ShapeName",
    "Sim",
    "Status",
    "StatusName",
    "Strengthening",
    "Task",
    "Terminal",
    "TerminalSet",
    "Tie",
    "Uncertainty",
    "Unit",
    "Vector",
    "angle_between",
    "direction",
    "place",
    "register",
    "rotation",
    "runge_kutta",
    "safe_norm",
    "to_body",
    "to_global",
]
