"""The filters that `make(…, rta=…)` knows by name, task by task."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from jaxsafe.rta.asif import DiscreteASIF, ExplicitASIF, ImplicitASIF, Polynomial
from jaxsafe.rta.backups import AlignAndBrake, AlignedOrSlow, Brake, MatchVelocity, Slow, VelocityMatched
from jaxsafe.rta.filter import RTA
from jaxsafe.rta.simplex import CollisionSimplex, Simplex

LIMIT_MARGIN = 2.5e-4
"""Kept below the speed limit at samples [m/s], so that it holds inside a step as well: near the chief the distance dips
below its values at the samples by up to half a step's way."""

DOCKING: dict[str, Any] = {
    "constraints": ("velocity_limit",),
    "margin": LIMIT_MARGIN,
    "backups": (Brake(name="brake"),),
}
"""Braking holds the limit from one step to the next, so no horizon is needed, see docs/rta.md."""

STOP: dict[str, Any] = {**DOCKING, "horizon": 16, "terminal": Slow(speed=0.19)}
"""The same without that knowledge: braking is predicted until there is hardly any speed."""

TURN: dict[str, Any] = {
    "constraints": ("velocity_limit",),
    "margin": LIMIT_MARGIN,
    "backups": (AlignAndBrake(name="align", constraint="velocity_limit", margin=LIMIT_MARGIN),),
    "horizon": 14,
    "terminal": AlignedOrSlow(angle=math.radians(75.0), speed=0.15),
}

MATCH_2D: dict[str, Any] = {
    "constraints": ("collision",),
    "margin": 1.0,  # ft; for what prediction and plant may differ by in float32
    "backups": tuple(MatchVelocity(name=turn, lead="lead", clearance=101.0, turn=turn) for turn in ("left", "right")),
    "horizon": 40,
    "terminal": VelocityMatched(of="wingman", to="lead", tolerance=1.0, clearance=101.0),
}

MATCH_3D: dict[str, Any] = {
    "constraints": ("collision",),
    "margin": 2.0,
    "backups": tuple(
        MatchVelocity(name=f"{turn}_{climb}", lead="lead", clearance=102.0, turn=turn, climb=climb)
        for turn in ("left", "right")
        for climb in ("up", "down")
    ),
    "horizon": 60,
    "terminal": VelocityMatched(of="wingman", to="lead", tolerance=4.0, clearance=102.0, drift=9.0, lag=1.0),
}


def _explicit_asif(filters: dict[str, Any], **options: Any) -> RTA:
    """The continuous-time filter of the paper, whose solution acts whatever it leads to: for comparison."""
    backups = filters["backups"][:1]
    return ExplicitASIF(constraints=filters["constraints"], backups=backups, enforce=False, **options)


_LIMIT_ALPHA = Polynomial(linear=0.05, cubic=0.1)
_COLLISION_ALPHA = Polynomial(linear=0.2)

_DOCKING: Mapping[str, Callable[[], RTA]] = {
    "default": lambda: DiscreteASIF(**DOCKING),
    "discrete_asif": lambda: DiscreteASIF(**DOCKING),
    "explicit_simplex": lambda: Simplex(**DOCKING),
    "implicit_simplex": lambda: Simplex(**STOP),
    "implicit_asif": lambda: ImplicitASIF(**STOP),
    "explicit_asif": lambda: _explicit_asif(DOCKING, strengthening=_LIMIT_ALPHA),
}

PRESETS: Mapping[str, Mapping[str, Callable[[], RTA]]] = {
    "rejoin2d": {
        "default": lambda: Simplex(**MATCH_2D),
        "implicit_simplex": lambda: Simplex(**MATCH_2D),
        "implicit_asif": lambda: ImplicitASIF(**MATCH_2D),
        "explicit_asif": lambda: _explicit_asif(MATCH_2D, strengthening=_COLLISION_ALPHA, degree=2),
        "released": lambda: CollisionSimplex(other="lead"),
    },
    "rejoin3d": {
        "default": lambda: Simplex(**MATCH_3D),
        "implicit_simplex": lambda: Simplex(**MATCH_3D),
        "implicit_asif": lambda: ImplicitASIF(**MATCH_3D),
        "explicit_asif": lambda: _explicit_asif(MATCH_3D, strengthening=_COLLISION_ALPHA, degree=2),
    },
    "docking2d": _DOCKING,
    "docking3d": _DOCKING,
    "docking2d_oriented": {
        "default": lambda: Simplex(**TURN),
        "implicit_simplex": lambda: Simplex(**TURN),
        "implicit_asif": lambda: ImplicitASIF(**TURN),
        "explicit_asif": lambda: _explicit_asif(TURN, strengthening=_LIMIT_ALPHA),
    },
}
"""By task and name; `default` is the recommended one, with a guarantee for the sampled plant, see docs/rta.md."""
