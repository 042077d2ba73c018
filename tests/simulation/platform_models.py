"""One instance of every dynamics model, with states and controls that are typical of it.

A new model is one more line in `MODELS`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.schema.component import normalise
from jaxsafe.simulation import (
    DoubleIntegrator,
    Dubins2D,
    Dubins3D,
    LaggedDubins2D,
    LaggedDubins3D,
    OrientedSpacecraft,
    Platform,
    PointMassAircraft,
    ReactionWheelSpacecraft,
    Spacecraft,
    TwoBody,
    TwoBodyJ2,
)

SIZES = {
    "position": 150.0,
    "velocity": 0.5,
    "attitude": 3.0,
    "attitude_rate": 0.02,
    "wheel_speed": 100.0,
    "heading": 3.0,
    "flight_path_angle": 0.2,
    "roll": 0.6,
    "heading_rate": 0.1,
    "roll_rate": 0.1,
    "flight_path_angle_rate": 0.05,
    "acceleration": 5.0,
    "true_anomaly": 3.0,
    "argument_of_latitude": 3.0,
}
"""Largest size of a field at the start. Fields that are not listed are as at rest."""

LARGEST_CONTROL = {
    "thrust": 1.0,
    "thrust_x": 1.0,
    "thrust_y": 1.0,
    "thrust_z": 1.0,
    "attitude_acceleration": 0.01,
    "wheel_acceleration": 20.0,
    "heading_rate": 0.1,
    "acceleration": 8.0,
    "roll_rate": 0.15,
    "flight_path_angle_rate": 0.05,
}


@dataclasses.dataclass(frozen=True)
class Model:
    """A platform, and how far the float32 step may be from an accurate solution in float64."""

    platform: Platform
    tolerance: float
    """Largest error of a field after a step of 1 s, as a share of the field's size or of 1."""
    controls: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Ranges of controls that `LARGEST_CONTROL` does not have."""


def _model(cls: Any, tolerance: float = 5e-7, controls: Any = None, **fields: Any) -> Model:
    return Model(normalise(cls(name="own", **fields)), tolerance, controls or {})


MODELS = {
    "double_integrator 1D": _model(DoubleIntegrator, dimension=1),
    "double_integrator 2D": _model(DoubleIntegrator, dimension=2),
    "double_integrator 3D": _model(DoubleIntegrator, dimension=3),
    "spacecraft 2D": _model(Spacecraft, dimension=2),
    "spacecraft 3D": _model(Spacecraft, dimension=3),
    "two_body 2D": _model(TwoBody, dimension=2, eccentricity=0.1),
    "two_body 3D": _model(TwoBody, dimension=3, eccentricity=0.6, substeps=2),
    "two_body_j2": _model(TwoBodyJ2, eccentricity=0.05, argument_of_perigee=1.0),
    "oriented_spacecraft": _model(OrientedSpacecraft),
    "reaction_wheel_spacecraft": _model(
        ReactionWheelSpacecraft, wheel_speed_limits=(-576.0, 576.0), tolerance=2e-6
    ),
    "dubins2d": _model(Dubins2D),
    "dubins3d": _model(Dubins3D, tolerance=2e-6),
    "dubins2d_lag": _model(LaggedDubins2D, tolerance=2e-6),
    "dubins3d_lag": _model(LaggedDubins3D, tolerance=5e-6),
    "point_mass_aircraft": _model(
        PointMassAircraft,
        tolerance=5e-6,
        controls={"thrust": (0.0, 2000.0), "load_factor": (-1.0, 3.0)},
    ),
}


def random_state(model: Model, rng: np.random.Generator) -> Any:
    """Draw a state that lies well within the limits."""
    rest = model.platform.rest()
    drawn = {
        name: jnp.asarray(rng.uniform(-SIZES[name], SIZES[name], value.shape), value.dtype)
        for name, value in vars(rest).items()
        if name in SIZES
    }
    if "speed" in vars(rest):
        drawn["speed"] = jnp.asarray(rng.uniform(230.0, 370.0), rest.speed.dtype)
    return model.platform.settle(rest.replace(**drawn))


def random_controls(model: Model, rng: np.random.Generator) -> dict[str, jax.Array]:
    """Draw a value for every control, but for the second way to turn a `dubins3d`."""
    inputs = [
        name
        for name in model.platform.inputs
        if not (name == "heading_rate" and "roll_rate" in model.platform.inputs)
    ]
    ranges = {
        name: (-LARGEST_CONTROL[name], LARGEST_CONTROL[name])
        for name in inputs
        if name not in model.controls
    }
    ranges |= model.controls
    return {name: jnp.asarray(rng.uniform(*ranges[name])) for name in inputs}
