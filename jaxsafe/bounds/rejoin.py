"""Bounds of rejoin: how far an aircraft can get in each direction while it turns."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxsafe.environment import Environment
from jaxsafe.processors.reward import DistanceChange, Failure, FirstTime, Success, WhileIn
from jaxsafe.processors.status import Distance, InRegion, RegionDistance, TimeHeld
from jaxsafe.processors.terminal import Held, Timeout, TooClose, TooFar, time_limit
from jaxsafe.simulation.dubins import Dubins2D, Dubins3D
from jaxsafe.simulation.regions import Aspect, Circle, Cylinder
from jaxsafe.simulation.scripted import Constant, Scripted
from jaxsafe.types import State

REWARDS = (DistanceChange, WhileIn, FirstTime, Success, Failure)
ENDS = (Held, TooClose, TooFar, Timeout)

DIRECTIONS = 120
"""Number of directions of the plane in which the path is bounded. More make the bound tighter."""

PARTS_OF_STEP = 4
"""Number of parts of a step. The path in each part is bounded by the best values there."""

SLACK = 0.1
"""Distance [ft] that is left for rounding in float32."""


def rejoin_bounds(env: Environment, starts: State) -> dict[str, np.ndarray] | None:
    """Return the bounds that `best_possible` describes, or None if the task is another one."""
    task = _Task.of(env)
    if task is None:
        return None
    region = np.asarray(starts.sim.regions[env.regions[0].name].position, np.float64)[:, :2]
    lead = starts.sim.platforms[env.platforms[0].name]
    if np.any(np.asarray(getattr(lead, "roll", 0.0)) != 0.0):  # it would turn
        return None
    own = starts.sim.platforms[env.agent]
    way = region - np.asarray(own.position, np.float64)[:, :2]
    arrival = _least_arrival(task, env, own, way, np.asarray(lead.velocity, np.float64)[:, :2])
    length = arrival + task.hold
    before = np.asarray(starts.sim.status[task.distance], np.float64)
    share = 0.5 ** (before / task.half_distance)
    potential = task.potential * (0.5 ** (task.nearest / task.half_distance) - share)
    stay = task.while_in * task.paid + task.first_time
    success = potential + stay + task.success - length * task.dt / task.time_scale
    failure = task.potential * (1.0 - share) + stay + task.failure
    return {"length": length, "return": np.maximum(success, failure)}


class _Task(NamedTuple):
    """The numbers of a rejoin task on which the bounds rest."""

    dt: float
    last_step: int
    radius: float
    """Radius of the region in the plane [ft]."""
    hold: int
    """Steps from the first sample in the region to the success."""
    paid: int
    """Samples in the region, at most, that are paid."""
    distance: str
    """The status whose fall is rewarded."""
    nearest: float
    """Its least value in the region [ft]."""
    potential: float
    half_distance: float
    while_in: float
    first_time: float
    success: float
    time_scale: float
    failure: float
    """The best reward of a failure."""

    @classmethod
    def of(cls, env: Environment) -> _Task | None:
        """Return the numbers of an environment, or None if it is no rejoin task."""
        rewards: Any = {type(term): term for term in env.reward}
        statuses = {status.name: status for status in env.status}
        last = time_limit(env)
        region: Any = env.regions[0] if len(env.regions) == 1 else None
        platforms = [type(platform) for platform in env.platforms]
        known = (
            platforms in ([Dubins2D] * 2, [Dubins3D] * 2)
            and env.agent == env.platforms[1].name
            and _flies_straight(env.platforms[0].controller)
            and type(region) in (Circle, Cylinder)
            and type(region.offset) is Aspect
            and Counter(map(type, env.reward)) == Counter(REWARDS)
            and Counter(map(type, env.terminal)) == Counter(ENDS)
            and last is not None
            and env.successes == ("success",)
        )
        if not known:
            return None
        held = next(condition for condition in env.terminal if type(condition) is Held)
        timer = statuses[held.time]
        gain = rewards[DistanceChange]
        best_failure = max(map(float, rewards[Failure].values.values()))
        signs = (gain.scale, rewards[WhileIn].value, rewards[FirstTime].value, -best_failure)
        if type(timer) is not TimeHeld or min(map(float, signs)) < 0.0:
            return None
        if type(statuses[timer.status]) is not InRegion:
            return None
        if type(statuses[gain.distance]) not in (Distance, RegionDistance):
            return None
        dt = float(env.dt)
        steps = math.ceil(float(held.duration) / dt - 1e-6)
        nearest = float(region.offset.distance) - float(region.radius)
        to_region = isinstance(statuses[gain.distance], RegionDistance)
        return cls(
            dt=dt,
            last_step=int(float(last) / dt + 1e-6) + 1,  # type: ignore[arg-type]
            radius=float(region.radius),
            hold=steps - timer.first_sample,
            paid=steps + 1 + (not held.inclusive),
            distance=gain.distance,
            nearest=0.0 if to_region else max(nearest, 0.0),
            potential=float(gain.scale),
            half_distance=float(gain.half_distance),
            while_in=float(rewards[WhileIn].value),
            first_time=float(rewards[FirstTime].value),
            success=float(rewards[Success].value),
            time_scale=float(rewards[Success].time_scale),
            failure=best_failure,
        )


def _flies_straight(controller: Any) -> bool:
    """Return whether a script never turns and never changes the speed."""
    return isinstance(controller, Scripted) and all(
        type(command) is Constant and float(command.at) == 0.0 for command in controller.commands
    )


def _least_arrival(
    task: _Task, env: Environment, own: Any, way: np.ndarray, velocity: np.ndarray
) -> np.ndarray:
    """Return the least number of steps until the aircraft can be in the region, per start.

    For every direction e of the plane, the aircraft's way along e is at most the integral of its
    highest speed times the cosine of the smallest angle between its course and e. That angle falls
    no faster than the aircraft can turn, to the left or to the right. The region's centre moves at
    the lead's velocity. Its distance along e, less the radius, must be reached for every e at once.

    Args:
        task: the task.
        env: the environment.
        own: the aircraft's state at the start, with arrays [starts, …].
        way: from the aircraft to the region's centre at the start [ft], (starts, 2).
        velocity: the velocity of the region [ft/s], (starts, 2).
    """
    angles = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    directions = np.stack([np.cos(angles), np.sin(angles)])
    to_the_left = (angles - np.asarray(own.heading, np.float64)[:, None]) % (2.0 * np.pi)
    to_the_right = 2.0 * np.pi - to_the_left
    span = task.dt / PARTS_OF_STEP
    fastest, slowest, turn_rates, level = _abilities(env, own)
    left = np.zeros((len(way), 1))
    right = np.zeros((len(way), 1))
    reach = np.zeros((len(way), DIRECTIONS))
    arrival = np.full(len(way), task.last_step)
    waiting = np.ones(len(way), bool)
    for step in range(task.last_step):
        ahead = (way + velocity * (step * task.dt)) @ directions - task.radius - SLACK
        here = waiting & np.all(ahead <= reach, axis=1)
        arrival[here] = step
        waiting &= ~here
        if not waiting.any():
            break
        for part in range(1, PARTS_OF_STEP + 1):
            time = (step + part / PARTS_OF_STEP) * task.dt
            left_rate, right_rate = turn_rates(time)
            left = left + span * left_rate
            right = right + span * right_rate
            angle = np.clip(np.minimum(to_the_left - left, to_the_right - right), 0.0, np.pi)
            along = np.cos(angle)
            forwards = fastest(time) * along
            backwards = level * slowest(time) * along
            reach = reach + span * np.where(along > 0.0, forwards, backwards)
    return arrival


def _abilities(
    env: Environment, own: Any
) -> tuple[
    Callable[[float], Any], Callable[[float], Any], Callable[[float], tuple[Any, Any]], float
]:
    """Return what the aircraft can do at most by a time t.

    Returns:
        Functions of t: the highest speed, the lowest speed, and the highest turn rates to the left
        and to the right. Then the least share of a speed that is horizontal.
    """
    plant: Any = env.agent_platform
    actuators = {actuator.name: actuator for actuator in env.actuators}
    lowest, highest = map(float, plant.speed_limits)
    speed = np.asarray(own.speed, np.float64)[:, None]
    brake = max(-float(actuators["acceleration"].low), 0.0)
    push = max(float(actuators["acceleration"].high), 0.0)

    def fastest(time: float) -> Any:
        return np.minimum(speed + push * time, highest)

    def slowest(time: float) -> Any:
        return np.maximum(speed - brake * time, lowest)

    if isinstance(plant, Dubins2D):
        steering = actuators["heading_rate"]
        rates = max(float(steering.high), 0.0), max(-float(steering.low), 0.0)
        return fastest, slowest, lambda time: rates, 1.0

    roll = np.asarray(own.roll, np.float64)[:, None]
    steering = actuators["roll_rate"]
    most_left, most_right = float(plant.roll_limits[1]), -float(plant.roll_limits[0])

    def turn_rates(time: float) -> tuple[Any, Any]:
        bank_left = np.minimum(roll + max(float(steering.high), 0.0) * time, most_left)
        bank_right = np.minimum(-roll + max(-float(steering.low), 0.0) * time, most_right)
        pull = float(plant.gravity) / slowest(time)
        return tuple(pull * np.tan(np.maximum(bank, 0.0)) for bank in (bank_left, bank_right))

    climb = np.max(np.abs(np.asarray(plant.flight_path_angle_limits, np.float64)))
    return fastest, slowest, turn_rates, float(np.cos(climb))
