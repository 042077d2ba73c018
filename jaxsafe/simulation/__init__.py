"""The plant: platforms and their dynamics, controllers, geometry and initializers.

Figs. 8 and 9 of the paper show these parts.
"""

from jaxsafe.simulation.controllers import (
    Actuator,
    AgentController,
    Continuous,
    Controller,
    Discrete,
    Uncontrolled,
)
from jaxsafe.simulation.cwh import Anchor, Spacecraft, SpacecraftState, cwh_acceleration, cwh_flow
from jaxsafe.simulation.dubins import Dubins2D, Dubins2DState, Dubins3D, Dubins3DState
from jaxsafe.simulation.geometry import (
    Aspect,
    Circle,
    Cylinder,
    Displacement,
    Offset,
    Region,
    Sphere,
    direction,
    rotation,
    safe_norm,
    to_body,
)
from jaxsafe.simulation.initializers import (
    AroundAtAltitude,
    AtDistance,
    BelowSpeedLimit,
    Direction,
    Fixed,
    Initializer,
    Uniform,
)
from jaxsafe.simulation.oriented import OrientedSpacecraft, OrientedState
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.scripted import Command, Constant, Schedule, Scripted, Sinusoid

__all__ = [
    "Actuator",
    "AgentController",
    "Anchor",
    "AroundAtAltitude",
    "Aspect",
    "AtDistance",
    "BelowSpeedLimit",
    "Circle",
    "Command",
    "Constant",
    "Continuous",
    "Controller",
    "Cylinder",
    "Direction",
    "Discrete",
    "Displacement",
    "Dubins2D",
    "Dubins2DState",
    "Dubins3D",
    "Dubins3DState",
    "Fixed",
    "Initializer",
    "Offset",
    "OrientedSpacecraft",
    "OrientedState",
    "Platform",
    "Region",
    "Schedule",
    "Scripted",
    "Sinusoid",
    "Spacecraft",
    "SpacecraftState",
    "Sphere",
    "Uncontrolled",
    "Uniform",
    "cwh_acceleration",
    "cwh_flow",
    "direction",
    "rotation",
    "safe_norm",
    "to_body",
]
