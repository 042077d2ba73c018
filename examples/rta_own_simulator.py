"""Filters for a simulator of your own: a vehicle in the plane that must not hit an obstacle.

The simulator is NumPy and knows nothing of jaxsafe. A policy flies straight at the obstacle,
without a filter and with each of two filters.

    pip install . && python examples/rta_own_simulator.py
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.rta import Barrier, Plant, Polynomial, filter_by_asif, filter_by_simplex

DT = 0.1  # s
DRAG = 0.05  # 1/s
RADIUS = 2.0  # m, of the obstacle at the origin


def simulate(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the state [x, y, vx, vy] a step later: your own simulator, with small steps inside."""
    for _ in range(100):
        x = x + DT / 100 * np.concatenate([x[2:], u - DRAG * x[2:]])
    return x


def derivative(x, u):
    """Return how the state changes, which an ASIF must know."""
    return jnp.concatenate([x[2:], u - DRAG * x[2:]])


def step(x, u):
    """Return where a step leads, which a Simplex must know."""
    middle = x + DT / 2 * derivative(x, u)
    return x + DT * derivative(middle, u)


plant = Plant(low=-1.0, high=1.0, derivative=derivative, step=step)


def clearance(x):
    """Return the distance to the obstacle."""
    return jnp.linalg.norm(x[:2]) - RADIUS


def speed_left(x):
    """Return how far the speed is below its limit."""
    return 1.5 - jnp.sqrt(x[2] ** 2 + x[3] ** 2 + 1e-12)  # the root has no derivative at 0


def brake(x):
    """Return the control that would stop the vehicle within a step."""
    return -x[2:] / DT


@jax.jit
def by_asif(x, u):
    """Return the control that is nearest to u under two barriers, and what happened."""
    alpha = Polynomial(linear=0.5).of
    constraints = [
        Barrier(h=clearance, degree=2, alpha=alpha, priority=1),
        Barrier(h=speed_left, alpha=alpha),
    ]
    return filter_by_asif(plant, constraints, x, u)


@jax.jit
def by_simplex(x, u):
    """Return u or the control of the brake, and what happened."""
    constraints = [Barrier(h=clearance, margin=0.05), Barrier(h=speed_left, margin=0.01)]
    return filter_by_simplex(
        plant,
        constraints,
        x,
        u,
        backup=brake,
        horizon=20,
        terminal=lambda x: jnp.linalg.norm(x[2:]) <= 0.01,
    )


def fly(filter_control=None):
    """Fly for 20 s and return the smallest clearance, the highest speed and the share altered."""
    x = np.array([-8.0, 0.3, 0.0, 0.0])
    nearest = np.inf
    fastest = 0.0
    altered = 0
    for _ in range(200):
        u = np.clip(-x[:2] + [3.0, 0.0], -1.0, 1.0)
        if filter_control:
            actual, info = filter_control(x, u)
            altered += int(info.constraint >= 0)
            u = np.asarray(actual)
        x = simulate(x, u)
        nearest = min(nearest, np.linalg.norm(x[:2]) - RADIUS)
        fastest = max(fastest, np.linalg.norm(x[2:]))
    return nearest, fastest, altered / 200


if __name__ == "__main__":
    for name, control_filter in (("no filter", None), ("ASIF", by_asif), ("Simplex", by_simplex)):
        nearest, fastest, altered = fly(control_filter)
        print(
            f"{name:9} clearance {nearest:6.2f} m, speed {fastest:.2f} m/s, altered {altered:.0%}"
        )
