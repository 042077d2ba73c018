"""The plant: platforms and their dynamics, controllers, geometry, vectors and initializers.

Figs. 8 and 9 of the paper show these parts.
"""

from jaxsafe.simulation.controllers import (
    Actuator,
    AgentController,
    Continuous,
    Controller,
    Discrete,
    Mixed,
    Uncontrolled,
)
from jaxsafe.simulation.cwh import (
    Anchor,
    Spacecraft,
    SpacecraftState,
    ThrustedSpacecraft,
    cwh_acceleration,
    cwh_flow,
)
from jaxsafe.simulation.double_integrator import DoubleIntegrator
from jaxsafe.simulation.dubins import Dubins2D, Dubins2DState, Dubins3D, Dubins3DState
from jaxsafe.simulation.dubins_lag import (
    LaggedDubins2D,
    LaggedDubins2DState,
    LaggedDubins3D,
    LaggedDubins3DState,
)
from jaxsafe.simulation.geometry import (
    angle_between,
    direction,
    rotation,
    safe_norm,
    to_body,
    to_global,
)
from jaxsafe.simulation.initializers import (
    AroundAtAltitude,
    AtDistance,
    BelowSpeedLimit,
    Cases,
    Direction,
    Fixed,
    Initializer,
    Normal,
    Uniform,
    read_cases,
)
from jaxsafe.simulation.oriented import OrientedSpacecraft, OrientedState
from jaxsafe.simulation.platform import Platform
from jaxsafe.simulation.point_mass import PointMassAircraft
from jaxsafe.simulation.reaction_wheel import ReactionWheelSpacecraft, ReactionWheelState
from jaxsafe.simulation.regions import (
    Aspect,
    BodyDisplacement,
    Box,
    Circle,
    Cone,
    Cylinder,
    Displacement,
    HalfSpace,
    Offset,
    Region,
    Sphere,
)
from jaxsafe.simulation.scripted import Command, Constant, Schedule, Scripted, Sinusoid
from jaxsafe.simulation.two_body import TwoBody, TwoBodyState
from jaxsafe.simulation.two_body_j2 import TwoBodyJ2, TwoBodyJ2State
from jaxsafe.simulation.vectors import BodyDirection, FixedDirection, Position, Vector, Velocity

__all__ = [
    "Actuator",
    "AgentController",
    "Anchor",
    "AroundAtAltitude",
    "Aspect",
    "AtDistance",
    "BelowSpeedLimit",
    "BodyDirection",
    "BodyDisplacement",
    "Box",
    "Cases",
    "Circle",
    "Command",
    "Cone",
    "Constant",
    "Continuous",
    "Controller",
    "Cylinder",
    "Direction",
    "Discrete",
    "Displacement",
    "DoubleIntegrator",
    "Dubins2D",
    "Dubins2DState",
    "Dubins3D",
    "Dubins3DState",
    "Fixed",
    "FixedDirection",
    "HalfSpace",
    "Initializer",
    "LaggedDubins2D",
    "LaggedDubins2DState",
    "LaggedDubins3D",
    "LaggedDubins3DState",
    "Mixed",
    "Normal",
    "Offset",
    "OrientedSpacecraft",
    "OrientedState",
    "Platform",
    "PointMassAircraft",
    "Position",
    "ReactionWheelSpacecraft",
    "ReactionWheelState",
    "Region",
    "Schedule",
    "Scripted",
    "Sinusoid",
    "Spacecraft",
    "SpacecraftState",
    "Sphere",
    "ThrustedSpacecraft",
    "TwoBody",
    "TwoBodyJ2",
    "TwoBodyJ2State",
    "TwoBodyState",
    "Uncontrolled",
    "Uniform",
    "Vector",
    "Velocity",
    "angle_between",
    "cwh_acceleration",
    "cwh_flow",
    "direction",
    "read_cases",
    "rotation",
    "safe_norm",
    "to_body",
    "to_global",
]
