"""The meaning of the state, as in Figs. 8, 10 and 11 of the paper.

These are statuses, safety constraints, ends of an episode, rewards and observations.
"""

from jaxsafe.processors.constraint import Constraint, Separation, SpeedLimit
from jaxsafe.processors.observation import (
    Observation,
    Observe,
    ObserveAngle,
    ObserveRegion,
    ObserveStatus,
)
from jaxsafe.processors.reward import (
    Bound,
    DeltaVCost,
    DistanceChange,
    Failure,
    FirstTime,
    Intervention,
    Reward,
    Success,
    VelocityConstraint,
    WhileIn,
)
from jaxsafe.processors.status import (
    DeltaV,
    Distance,
    InRegion,
    RegionDistance,
    Speed,
    Status,
    TimeHeld,
    VelocityLimit,
)
from jaxsafe.processors.terminal import (
    Crashed,
    Docked,
    Held,
    Holds,
    Terminal,
    Timeout,
    TooClose,
    TooFar,
)

__all__ = [
    "Bound",
    "Constraint",
    "Crashed",
    "DeltaV",
    "DeltaVCost",
    "Distance",
    "DistanceChange",
    "Docked",
    "Failure",
    "FirstTime",
    "Held",
    "Holds",
    "InRegion",
    "Intervention",
    "Observation",
    "Observe",
    "ObserveAngle",
    "ObserveRegion",
    "ObserveStatus",
    "RegionDistance",
    "Reward",
    "Separation",
    "Speed",
    "SpeedLimit",
    "Status",
    "Success",
    "Terminal",
    "TimeHeld",
    "Timeout",
    "TooClose",
    "TooFar",
    "VelocityConstraint",
    "VelocityLimit",
    "WhileIn",
]
