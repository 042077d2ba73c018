"""Times are whole numbers of steps.

A limit is met after as many steps as it is long, whatever dt rounds to.
"""

from decimal import Decimal
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.processors.terminal import Held, Timeout
from jaxsafe.schema.component import normalise
from jaxsafe.simulation.clock import later, reached
from jaxsafe.simulation.scripted import Schedule
from jaxsafe.types import Sim

USUAL = [
    Decimal(hundredths) / 100
    for hundredths in (1, 2, 3, 4, 5, 10, 15, 20, 25, 30, 40, 60, 70, 75, 90, 100, 150, 500)
]
COUNTS = np.array(
    [1, 2, 3, 5, 7, 10, 25, 50, 99, 100, 333, 1000, 1500, 3000, 9999, 100_000, 1_000_000]
)


def at(time: Any) -> Sim:
    return Sim(jnp.asarray(time), {}, {}, {"held": jnp.asarray(time)}, {}, jnp.zeros((), bool))


@pytest.mark.parametrize("dt", USUAL, ids=str)
def test_a_limit_of_whole_steps_is_met_on_that_step(dt: Decimal) -> None:
    limits = jnp.asarray([float(dt * int(count)) for count in COUNTS], jnp.float32)
    times = {
        offset: jnp.float32(float(dt)) * (COUNTS + offset).astype(np.float32)
        for offset in (-1, 0, 1)
    }
    assert not later(times[0], limits).any()
    assert later(times[1], limits).all()
    assert reached(times[0], limits).all()
    assert not reached(times[-1], limits).any()


@pytest.mark.parametrize(
    ("dt", "seconds", "steps"), [(0.3, 15.0, 50), (0.6, 30.0, 50), (0.02, 0.2, 10), (0.1, 0.7, 7)]
)
def test_timeouts_holds_and_schedules_count_steps(dt: float, seconds: float, steps: int) -> None:
    timeout = normalise(Timeout(name="timeout", limit=seconds))
    held = normalise(Held(name="held", time="held", duration=seconds))
    longer = normalise(Held(name="held", time="held", duration=seconds, inclusive=False))
    schedule = normalise(Schedule(name="heading_rate", times=(seconds,), values=(1.0,)))
    before, then, after = (at(np.float32(dt) * np.float32(steps + offset)) for offset in (-1, 0, 1))
    assert [bool(timeout.reached(sim)) for sim in (before, then, after)] == [False, False, True]
    assert [bool(held.reached(sim)) for sim in (before, then, after)] == [False, True, True]
    assert [bool(longer.reached(sim)) for sim in (before, then, after)] == [False, False, True]
    assert [float(schedule.value(sim)) for sim in (before, then, after)] == [0.0, 1.0, 1.0]


@pytest.mark.parametrize(("dt", "limit"), [(0.3, 15.0), (0.6, 30.0)])
def test_an_episode_lasts_one_step_longer_than_its_timeout(dt: float, limit: float) -> None:
    env = jaxsafe.make("docking2d", {"dt": dt, "terminal.timeout.limit": limit})
    state, _ = jaxsafe.reset_to(env, {"deputy": {"position": [120.0, 0.0], "velocity": [0.0, 0.0]}})
    step = jax.jit(jaxsafe.step)
    done = []
    for _ in range(51):
        state, timestep = step(env, state, jnp.zeros(2))
        done.append(bool(timestep.terminated))
    assert done == [False] * 50 + [True]
