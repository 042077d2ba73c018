"""Scripted platforms: their commands are functions of time, and faulty commands are refused."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.scripted import Command, Constant, Schedule, Scripted, Sinusoid
from jaxsafe.types import Sim


def at(time: float) -> Sim:
    """Return a simulation at a time. Commands see nothing else of it."""
    return Sim(jnp.asarray(time), {}, {}, {}, {}, jnp.zeros((), bool))


def values(command: Command, times: list[float]) -> list[float]:
    built = normalise(command)
    return [float(built.value(at(time))) for time in times]


def test_a_constant_is_the_same_at_all_times() -> None:
    assert values(Constant(name="heading_rate", at=0.25), [0.0, 1.0, 1e6]) == [0.25, 0.25, 0.25]


def test_a_schedule_is_zero_before_its_first_time_and_keeps_its_last_value() -> None:
    schedule = Schedule(name="heading_rate", times=(2.0, 5.0, 6.0), values=(0.5, -0.25, 0.0))
    assert values(schedule, [0.0, 1.9, 2.0, 4.9, 5.0, 5.9, 6.0, 1e6]) == [
        0.0,
        0.0,
        0.5,
        0.5,
        -0.25,
        -0.25,
        0.0,
        0.0,
    ]
    assert values(Schedule(name="x", times=(0.0,), values=(3.0,)), [0.0, 9.0]) == [3.0, 3.0]


def test_a_sinusoid_has_amplitude_period_and_phase() -> None:
    weave = Sinusoid(name="heading_rate", amplitude=0.1, period=40.0)
    np.testing.assert_allclose(
        values(weave, [0.0, 10.0, 20.0, 30.0, 45.0]), [0.0, 0.1, 0.0, -0.1, 0.1 / 2**0.5], atol=1e-7
    )
    ahead = Sinusoid(name="heading_rate", amplitude=0.1, period=40.0, phase=math.pi / 2)
    np.testing.assert_allclose(values(ahead, [0.0, 10.0, 20.0]), [0.1, 0.0, -0.1], atol=1e-7)


def test_a_script_names_its_commands_and_takes_no_actions() -> None:
    commands = (Constant(name="b", at=1.0), Sinusoid(name="a", amplitude=2.0, period=4.0))
    script = normalise(Scripted(commands=commands))
    assert script.names == ("b", "a")
    assert script.points == ()
    assert not script.takes_actions
    computed = script.control(jnp.zeros(0), at(1.0))
    assert {name: float(value) for name, value in computed.items()} == pytest.approx(
        {"b": 1.0, "a": 2.0}
    )
    assert Scripted().control(jnp.zeros(0), at(0.0)) == {}


@pytest.mark.parametrize(
    ("times", "values", "problem"),
    [
        ((0.0, 1.0), (1.0,), "expected as many values as times, found 1 and 2"),
        ((), (), "expected as many values as times, found 0 and 0"),
        ((0.0, 0.0), (1.0, 2.0), r"expected times in ascending order, found \[0\.0, 0\.0\]"),
        ((1.0, 0.0), (1.0, 2.0), r"expected times in ascending order, found \[1\.0, 0\.0\]"),
    ],
)
def test_a_schedule_with_a_problem_is_refused(times: Any, values: Any, problem: str) -> None:
    schedule = Schedule(name="heading_rate", times=times, values=values)
    with pytest.raises(
        ConfigError, match=rf"^platforms\.lead\.controller\.commands\.heading_rate: {problem}$"
    ):
        jaxsafe.make("rejoin2d", {"lead.controller": normalise(Scripted(commands=(schedule,)))})


def test_a_schedule_in_ascending_order_has_no_problem() -> None:
    assert normalise(Schedule(name="x", times=(-1.0, 2.0), values=(0.0, 1.0))).problem() is None


def follow(controller: Any, num_steps: int) -> list[Any]:
    """Return the lead's states along an episode of rejoin2d, the start first."""
    env = jaxsafe.make("rejoin2d", {"lead.controller": normalise(controller)})
    start = {"position": [0.0, 0.0], "heading": 0.0, "speed": 300.0}
    state, _ = jaxsafe.reset_to(
        env, {"lead": start, "wingman": start | {"position": [5000.0, 0.0]}}
    )
    step = jax.jit(jaxsafe.step)
    states = [state.sim.platforms["lead"]]
    for _ in range(num_steps):
        state, _ = step(env, state, jnp.zeros(2))
        states.append(state.sim.platforms["lead"])
    return states


def test_a_command_holds_over_the_step_that_begins_at_its_time() -> None:
    schedule = Schedule(name="heading_rate", times=(1.0, 3.0), values=(0.1, -0.05))
    states = follow(Scripted(commands=(schedule, Constant(name="acceleration", at=2.0))), 5)
    np.testing.assert_allclose(
        [state.heading for state in states], [0.0, 0.0, 0.1, 0.2, 0.15, 0.1], atol=1e-6
    )
    np.testing.assert_allclose(
        [state.speed for state in states], 300.0 + 2.0 * np.arange(6), rtol=1e-6
    )


def test_a_weaving_lead_comes_back_to_its_heading_after_a_period() -> None:
    weave = Sinusoid(name="heading_rate", amplitude=0.1, period=8.0)
    headings = [float(state.heading) for state in follow(Scripted(commands=(weave,)), 16)]
    assert max(headings) > 0.2
    np.testing.assert_allclose([headings[8], headings[16]], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        (
            {
                "type": "scripted",
                "commands": [{"type": "constant", "name": "heading_rat", "at": 0}],
            },
            (
                r"platforms\.lead\.controller\.commands: dubins2d has no control 'heading_rat'\."
                r" Did you mean 'heading_rate'\?"
            ),
        ),
        (
            {
                "type": "scripted",
                "commands": [{"type": "constant", "name": "heading_rate", "at": 0}] * 2,
            },
            r"platforms\.lead\.controller\.commands: the name 'heading_rate' stands twice",
        ),
        (
            {
                "type": "scripted",
                "commands": [
                    {"type": "sinusoid", "name": "heading_rate", "amplitude": 1, "period": 0}
                ],
            },
            (
                r"lead\.controller\.commands\.heading_rate\.period: expected a number in s > 0,"
                r" found 0"
            ),
        ),
        (
            {
                "type": "scripted",
                "commands": [{"type": "constat", "name": "heading_rate", "at": 0}],
            },
            (
                r"heading_rate: unknown type 'constat'\. Did you mean 'constant'\? Choose from"
                r" constant, .*schedule, sinusoid$"
            ),
        ),
        (
            {
                "type": "scripted",
                "commands": [
                    {"type": "schedule", "name": "heading_rate", "times": 1, "values": [1]}
                ],
            },
            r"heading_rate\.times: expected a list of numbers in s, found 1",
        ),
    ],
)
def test_a_bad_script_is_told_in_one_line(controller: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        jaxsafe.make("rejoin2d", {"lead.controller": controller})
    assert "\n" not in str(caught.value)
