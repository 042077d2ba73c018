"""Run time assurance: filters between the agent's desired control and the plant.

They are described in Section 2 and Fig. 2 of the paper.
"""

from jaxsafe.rta.asif import DiscreteASIF, ExplicitASIF, ImplicitASIF, Polynomial, Strengthening
from jaxsafe.rta.backups import (
    AlignAndBrake,
    AlignedOrSlow,
    AtRest,
    Brake,
    Coast,
    MatchVelocity,
    Slow,
    VelocityMatched,
)
from jaxsafe.rta.backups_with_memory import HoldPosition, Latched, Rehearsed
from jaxsafe.rta.bound import UncertaintyBound
from jaxsafe.rta.cascade import Cascade, Stage
from jaxsafe.rta.certificate import BackupController, TerminalSet
from jaxsafe.rta.certified import CertifiedRTA
from jaxsafe.rta.filter import RTA, RTAMemory
from jaxsafe.rta.own_simulator import Barrier, Plant, filter_by_asif, filter_by_simplex
from jaxsafe.rta.simplex import Blend, CollisionSimplex, Simplex

__all__ = [
    "RTA",
    "AlignAndBrake",
    "AlignedOrSlow",
    "AtRest",
    "BackupController",
    "Barrier",
    "Blend",
    "Brake",
    "Cascade",
    "CertifiedRTA",
    "Coast",
    "CollisionSimplex",
    "DiscreteASIF",
    "ExplicitASIF",
    "HoldPosition",
    "ImplicitASIF",
    "Latched",
    "MatchVelocity",
    "Plant",
    "Polynomial",
    "RTAMemory",
    "Rehearsed",
    "Simplex",
    "Slow",
    "Stage",
    "Strengthening",
    "TerminalSet",
    "UncertaintyBound",
    "VelocityMatched",
    "filter_by_asif",
    "filter_by_simplex",
]
