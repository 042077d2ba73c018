"""Prove from which angles the backup of oriented docking holds the speed limit for ever.

`align_and_brake` turns the thrust axis along the velocity. Let e be the angle from the axis to the
course, and w the spin of the body. Over a step, the distance and the velocity change e and w only
through how far the course turns, and that has a bound. So the plane of e and w is cut into cells.
Each cell is mapped with interval arithmetic to all cells that it may reach under every course
within the bound. The cells are followed until there are no new ones. These lines are printed:

- the largest angle that is ever reached from `angle` or less at any spin,
- the steps until the axis is within `angle`, from any angle and spin, and then until it is within
  `aligned`,
- the distance up to which the weaker thrust holds the limit at that largest angle, against gravity
  and the shrinking limit.

These are steps of the proof in `docs/safety/proofs.md`. `jaxsafe/rta/proofs.py` keeps the numbers.

With `floor` the speed limit at the chief is another one. Proposition 16 asks for 0.17 m/s.

With `push` a disturbance of so many m/s² also turns the course, and thrust must also take off the
speed that it adds. That says what the set would hold if the backup looked at the true state. It is
why a filter with a bound rehearses the manoeuvre instead.

    python benchmarks/terminal_set.py [angle=75] [dt=1] [cells=1440] [push=0] [floor=0.2]
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from isolated import words

import jaxsafe
from jaxsafe.envs.docking import TURN
from jaxsafe.rta.speed_limit import speed_limit_facts

LOW_SHARE = 0.3
"""Below this share of the speed limit the limit is far, and nothing is asked of the angle."""

FLIPS = 6
"""How often the nearer end of the axis may change on the way, see docs/safety/proofs.md."""

MOST_STEPS = 200
"""Number of steps after which `Proof.steps` gives up."""

SLACK = 1.01
"""A factor for the straightened limit, and for speeds a little below it."""


def main() -> None:
    """Prove and print."""
    options = words(angle="75", dt="1", cells="1440", push="0", floor="0.2")
    numbers = {"dt": options["dt"], "status.velocity_limit.floor": options["floor"]}
    env = jaxsafe.make("docking2d_oriented", {path: float(text) for path, text in numbers.items()})
    proof = Proof(env, float(options["angle"]), int(options["cells"]), float(options["push"]))
    for line in proof.lines():
        print(line)


class Proof:
    """The proof. Angles are in degrees, rates in degrees a second."""

    def __init__(
        self, env: jaxsafe.Environment, angle: float, cells: int, push: float = 0.0
    ) -> None:
        plant: Any = env.agent_platform
        backup = TURN["backups"][0]
        wheel = plant.controller.actuators[1]
        facts = speed_limit_facts(env, "velocity_limit")
        assert facts is not None
        self.margin = max(float(facts.least_margin), backup.margin)
        self.dt = float(env.dt)
        self.n = float(facts.mean_motion)
        self.floor = float(facts.floor)
        self.slope = float(facts.slope)
        self.weakest = float(facts.weakest)
        self.strongest = float(facts.strongest)
        self.wheel = math.degrees(float(wheel.high))
        self.spin = math.degrees(float(plant.attitude_rate_limits[1]))
        self.angle = angle
        self.push = push * self.dt
        self.aligned = math.degrees(backup.aligned)
        edges = np.linspace(-90.0, 90.0, cells + 1)
        spins = np.linspace(-self.spin, self.spin, 161)
        self.low, self.high = (grid[..., None] for grid in (edges[:-1], edges[1:]))
        self.slower = spins[None, :-1]
        self.faster = spins[None, 1:]
        self.width = 180.0 / cells
        self.num = (cells, 160)

    def gravity(self, share: float) -> float:
        """Return how far gravity, the Coriolis force and a push turn the course in a step.

        `share` is the speed as a share of the limit.
        """
        pushed = math.asin(min(self.push / (0.99 * share * self.floor), 1.0))
        return math.degrees((2.0 * self.n + 1.5 * self.n / share) * self.dt + pushed)

    def needed(self, first: bool) -> float:
        """Return what thrust must take off in a step, as a share of the speed.

        The limit is then kept with twice the margin.
        """
        gained = first * self.margin + self.push
        return SLACK * (2.0 * self.n * self.dt + gained / (self.floor - 2.0 * self.margin))

    def thrust_turn(self, error: np.ndarray, first: bool) -> np.ndarray:
        """Return how far the least thrust that holds the limit turns the course in a step.

        It is infinite where no thrust holds the limit.
        """
        error = np.radians(np.minimum(error, 90.0))
        sine = np.sin(error)
        cosine = np.maximum(np.cos(error), 1e-9)
        # Thrust across the velocity lengthens it.
        root = cosine**2 - 2.0 * self.needed(first) * sine**2
        push = SLACK * (cosine - np.sqrt(np.maximum(root, 0.0))) / np.maximum(sine, 1e-9) ** 2
        turn = np.degrees(np.arctan2(push * sine, 1.0 - push * cosine))
        return np.where((root > 0.0) & (error > 1e-3), turn, np.where(error > 1e-3, np.inf, 0.0))

    def course(self, first: bool) -> np.ndarray:
        """Return how far the course may turn in a step, for each cell of the angle."""
        error = np.maximum(np.abs(self.low), np.abs(self.high)) + self.spin * self.dt + 1.0
        near = self.gravity(0.99) + self.thrust_turn(error, first)
        return np.maximum(near, self.gravity(LOW_SHARE))

    def swing(self) -> float:
        """Return the largest angle after a step of braking along the body.

        The step begins within `aligned`, above `LOW_SHARE`.
        """
        least = LOW_SHARE * self.floor
        across = math.sin(math.radians(self.aligned + self.spin * self.dt + 1.0))
        ratio = (least + self.strongest * self.dt) * across / least
        return math.degrees(math.asin(min(ratio, 1.0))) + self.spin * self.dt + 1.0

    def rate(self, error: np.ndarray) -> np.ndarray:
        """Return the spin that the backup aims for at an angle."""
        return np.sign(error) * np.minimum(self.spin, np.sqrt(1.6 * self.wheel * np.abs(error)))

    def after(self, error: np.ndarray, spin: np.ndarray) -> np.ndarray:
        """Return the spin after a step. It grows with both arguments."""
        return np.clip(self.rate(error), spin - self.wheel * self.dt, spin + self.wheel * self.dt)

    def image(self, cells: np.ndarray, course: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Return all cells that may be reached from some cells in a step.

        The course turns by up to `course` either way. The cells beyond ±90° are returned apart,
        because there the angle is measured from the other end of the axis.
        """
        slowest = self.after(self.low, self.slower)
        fastest = self.after(self.high, self.faster)
        least = self.low - (self.faster + fastest) / 2.0 * self.dt - course
        most = self.high - (self.slower + slowest) / 2.0 * self.dt + course
        step = 2.0 * self.spin / self.num[1]
        columns = np.floor(
            (np.stack([slowest, fastest]) + self.spin) / step + [[[-1e-9]], [[1e-9]]]
        ).astype(int)
        columns = np.clip(columns, 0, self.num[1] - 1)
        rows = np.floor((np.stack([least, most]) + 90.0) / self.width + [[[-1e-9]], [[1e-9]]])
        rows = np.clip(rows, -self.num[0], 2 * self.num[0] - 1).astype(int)
        # The marks are corners of rectangles. Their cumulative sums fill the rectangles.
        marks = np.zeros((3 * self.num[0] + 1, self.num[1] + 1), int)
        chosen = np.nonzero(cells)
        first, last = (side[chosen] + self.num[0] for side in rows)
        left, right = (side[chosen] for side in columns)
        for row, column, sign in (
            (first, left, 1),
            (last + 1, left, -1),
            (first, right + 1, -1),
            (last + 1, right + 1, 1),
        ):
            np.add.at(marks, (row, column), sign)
        filled = marks.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0
        below, same, above = filled.reshape(3, *self.num)
        return same, below | above

    def within(self, angle: float) -> np.ndarray:
        """Return the cells of an angle or less, at any spin."""
        inside = np.maximum(np.abs(self.low), np.abs(self.high)) <= angle + 1e-9
        return np.broadcast_to(inside, self.num)

    def closure(self) -> np.ndarray | None:
        """Return the cells that are ever reached from `angle` or less at any spin.

        Return None if the axis escapes.
        """
        begin = self.within(self.angle)
        aligned = self.within(self.aligned)
        first = self.course(first=True)
        reachable = begin | np.logical_or(*self.image(begin & ~aligned, first))
        fresh = reachable & ~aligned
        later = self.course(first=False)
        while fresh.any():
            if not np.isfinite(later[np.nonzero(fresh)[0]]).all():
                return None
            reached = np.logical_or(*self.image(fresh, later))
            fresh = reached & ~reachable
            reachable |= reached
        return reachable

    def largest(self, cells: np.ndarray) -> float:
        """Return the largest angle of some cells."""
        return float(np.maximum(np.abs(self.low), np.abs(self.high))[cells.any(axis=1)].max())

    def steps(self, begin: np.ndarray, goal: float, course: np.ndarray | float) -> int | None:
        """Return the number of steps until all cells have been within an angle.

        The nearer end of the axis changes at most `FLIPS` times. Return None if some cells are not
        within the angle after `MOST_STEPS` steps.
        """
        goals = self.within(goal)
        layers = [begin, *(np.zeros(self.num, bool) for _ in range(FLIPS))]
        for count in range(MOST_STEPS):
            layers = [cells & ~goals for cells in layers]
            if not any(cells.any() for cells in layers):
                return count
            images = [self.image(cells, course) for cells in layers]
            layers = [images[0][0], *(images[i + 1][0] | images[i][1] for i in range(FLIPS))]
        return None

    def hold(self, largest: float) -> float:
        """Return the distance up to which the weaker thrust holds the limit.

        The angle is at most `largest`.
        """
        angle = math.radians(largest + self.spin * self.dt + 1.0)
        spare = (
            self.weakest * math.cos(angle) / SLACK
            - (self.margin + self.push) / self.dt
            - self.slope * self.floor
        )
        return spare / max(3.0 * self.n**2, self.slope**2)

    def lines(self) -> list[str]:
        """Return what was proved, in words."""
        reachable = self.closure()
        swing = self.swing()
        if reachable is None or swing > self.angle:
            return [f"not proved: from {self.angle:g}° the angle may escape (swing {swing:.1f}°)"]
        largest = self.largest(reachable)
        every = np.ones(self.num, bool)
        drift = self.gravity(LOW_SHARE)
        later = self.course(first=False)
        turned = self.steps(every, self.angle, drift)
        within = self.steps(reachable, self.aligned, later)
        return [
            (
                f"dt {self.dt:g} s, margin {self.margin:g} m/s, wheel {self.wheel:g}°/s², spin"
                f" {self.spin:g}°/s"
            ),
            (
                f"from {self.angle:g}° at any spin: never above {largest:.2f}°; braking swings it"
                f" to {swing:.1f}° at most"
            ),
            (
                f"from any angle and spin: within {self.angle:g}° after {turned} steps, then"
                f" {self.aligned:g}° after {within}"
            ),
            f"the limit is held up to {self.hold(largest):.0f} m",
        ]


if __name__ == "__main__":
    main()
