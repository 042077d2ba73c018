"""No flight beats the bounds, and where the best flight is known the bounds are near it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from default_cases import TASKS_BY_DEFAULT, one_of_each_kind, thorough

import jaxsafe
from jaxsafe.bounds import best_possible, docking
from jaxsafe.control import Align
from jaxsafe.envs import STARTERS, TASKS, find_task
from jaxsafe.evaluate.episodes import run_episodes
from jaxsafe.rollout import reset_batch
from jaxsafe.schema.errors import ConfigError
from jaxsafe.types import State

ROUNDING = {"length": 0, "return": 1e-3, "delta_v": 1e-3}
"""By how much float32 may carry a flight across a bound."""


def require_no_flight_beats_the_bounds(
    env: jaxsafe.Environment, policy: Any, count: int, noise: tuple[float, ...] = (0.0,)
) -> list[int]:
    """Fly from many starts, compare with the bounds, and return the numbers of successes.

    The actions of the policy are disturbed at random, by each size of noise in turn. One program
    flies with all of them.
    """

    @jax.jit
    def fly(env: jaxsafe.Environment, key: jax.Array, scale: jax.Array) -> Any:
        def disturbed(key: jax.Array, observation: jax.Array) -> jax.Array:
            action = policy(key, observation)
            return jnp.clip(action + scale * jax.random.normal(key, action.shape), -1.0, 1.0)

        return run_episodes(env, disturbed, key, count)

    key = jax.random.key(5)
    starts, _ = jax.jit(reset_batch, static_argnums=2)(env, jax.random.split(key)[0], count)
    bounds = best_possible(env, starts)
    flown = [jax.device_get(fly(env, key, jnp.asarray(scale))) for scale in noise]
    return [successes(env, sums, bounds) for sums in flown]


def successes(env: jaxsafe.Environment, sums: Any, bounds: dict[str, np.ndarray]) -> int:
    """Compare flights with the bounds, and return the number of successes."""
    succeeded = np.asarray(env.succeeded(sums.outcome))
    safe = succeeded & (sums.violating_steps == 0)
    assert (sums.episode_return <= bounds["return"] + ROUNDING["return"]).all()
    assert (sums.length >= bounds["length"])[safe].all()
    if "delta_v" in bounds:
        assert (sums.delta_v >= bounds["delta_v"] - ROUNDING["delta_v"])[succeeded].all()
    return int(succeeded.sum())


@pytest.mark.parametrize("task", one_of_each_kind([*STARTERS, *TASKS], ["docking2d"]))
def test_no_flight_beats_the_bounds(task: str) -> None:
    env = jaxsafe.make(task)
    name = next(iter(find_task(task).controllers))
    law = jaxsafe.load_policy(f"controller/{name}", env=env)
    exact, disturbed, _ = require_no_flight_beats_the_bounds(env, law, 100, (0.0, 0.1, 3.0))
    assert exact == 100
    assert disturbed > 0


@pytest.mark.parametrize(
    ("task", "variant"),
    [
        *(thorough(task, "paper") for task in TASKS),
        *(thorough(task, "released") for task in TASKS_BY_DEFAULT),
        *(
            pytest.param(task, "released", marks=pytest.mark.slow)
            for task in TASKS
            if task not in TASKS_BY_DEFAULT
        ),
    ],
)
def test_packaged_policies_do_not_beat_the_bounds(task: str, variant: Any) -> None:
    env = jaxsafe.make(task, variant=variant)
    require_no_flight_beats_the_bounds(env, jaxsafe.load_policy(task, env=env), 200)


def on_a_line(positions: list[float], velocities: list[float]) -> State:
    env = jaxsafe.make("docking1d")
    starts = {
        "position": jnp.asarray(positions)[:, None],
        "velocity": jnp.asarray(velocities)[:, None],
    }
    return jax.vmap(lambda fields: jaxsafe.reset_to(env, {"deputy": fields})[0])(starts)


def test_on_a_line_the_least_delta_v_is_that_of_one_push() -> None:
    """2001 steps are allowed, and whoever comes with more than ν₀ must brake to it."""
    env = jaxsafe.make("docking1d")
    edge = 0.5
    last = 0.2 + 2.0 * 0.001027 * edge
    starts = on_a_line([100.0, 100.0, 120.0, 120.0], [0.0, 0.1, -0.15, -0.3])
    wanted = [(100.0 - edge) / 2001.0, 0.1 + (100.0 - edge) / 2001.0, 0.0, 0.3 - last]
    found = best_possible(env, starts)["delta_v"]
    assert (found <= np.asarray(wanted) + 1e-6).all()
    np.testing.assert_allclose(found, wanted, rtol=0.02, atol=1e-3)


def test_the_bounds_follow_the_numbers_of_the_task() -> None:
    starts = on_a_line([100.0], [0.0])
    usual = best_possible(jaxsafe.make("docking1d"), starts)
    shorter = best_possible(jaxsafe.make("docking1d", {"terminal.timeout.limit": 500.0}), starts)
    faster = best_possible(jaxsafe.make("docking1d", {"status.velocity_limit.floor": 0.4}), starts)
    np.testing.assert_allclose(shorter["delta_v"], 99.5 / 501.0, rtol=0.02)
    assert shorter["delta_v"][0] > 3.0 * usual["delta_v"][0]
    assert faster["length"][0] < 0.65 * usual["length"][0]
    assert faster["return"][0] > usual["return"][0]


def test_a_rough_look_at_a_length_changes_no_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 600.0})
    starts, _ = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(3), 5)
    usual = best_possible(env, starts)
    monkeypatch.setattr(docking, "ROUGH", docking.FINE)
    for name, values in best_possible(env, starts).items():
        np.testing.assert_allclose(usual[name], values, rtol=1e-12)


@pytest.mark.parametrize("angle", [docking.FINE, docking.ROUGH])
def test_between_its_samples_a_primer_vector_is_not_larger_than_said(angle: float) -> None:
    task = docking._Task.of(jaxsafe.make("docking3d"))
    assert task is not None
    times = np.append(np.arange(0.0, 1900.0, docking._apart(task, angle) * task.dt), 1900.0)
    back = scipy.linalg.expm(-docking._motion(task))
    flows = [np.linalg.matrix_power(back, time) for time in range(1901)]
    costate = np.random.default_rng(0).normal(size=(50, 6))
    q = np.stack([costate @ flow[:, 3:] for flow in flows], axis=-1).swapaxes(0, 1)
    largest = np.max(np.linalg.norm(q, axis=0), axis=-1)
    said = docking._largest(task, q[..., times.astype(int)], times)
    assert (said >= largest).all()
    assert (said <= 1.02 * largest).all()


@pytest.mark.parametrize("away", [0.0, 0.3])
def test_the_least_length_is_that_of_a_flight_that_speeds_up_to_the_limit(away: float) -> None:
    """The push is 1/12 m/s² until the limit is reached, and then the speed follows the limit."""
    distance = 140.0
    approach = -away
    time = 0.0
    while distance > 0.5:
        distance -= 0.01 * approach
        approach = min(approach + 0.01 / 12.0, 0.2 + 2.0 * 0.001027 * distance)
        time += 0.01
    found = best_possible(jaxsafe.make("docking1d"), on_a_line([140.0], [away]))["length"][0]
    assert time - 1.0 <= found <= time + 1.0


def test_a_deputy_whose_axis_points_across_must_turn_first() -> None:
    """From rest nothing pushes it towards the chief before."""
    env = jaxsafe.make("docking2d_oriented")
    rest = {"position": jnp.asarray([140.0, 0.0]), "velocity": jnp.zeros(2)}
    angles = jnp.pi + jnp.asarray([0.0, jnp.pi / 2.0, jnp.pi])
    starts = jax.vmap(
        lambda attitude: jaxsafe.reset_to(env, {"deputy": {**rest, "attitude": attitude}})[0]
    )(angles)
    ahead, across, astern = best_possible(env, starts)["length"]
    assert ahead < astern < across - 4


@pytest.mark.thorough
def test_flights_near_the_limit_that_turn_first_do_not_beat_the_bounds() -> None:
    env = jaxsafe.make("docking2d_oriented")
    law = Align(share=0.985, approach=0.3).policy(env)
    assert require_no_flight_beats_the_bounds(env, law, 100) == [100]


@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_an_aircraft_behind_the_region_arrives_when_the_bound_says(turn: float) -> None:
    """With its nose ahead it closes in at 150 ft/s.

    Otherwise it must turn around first, for π/0.17 s, and the region gets 250 ft ahead each second.
    """
    env = jaxsafe.make("rejoin2d")
    lead = np.asarray([6000.0, 6000.0])
    centre = lead + 500.0 * np.asarray([np.cos(np.pi * 4 / 3), np.sin(np.pi * 4 / 3)])
    start = {
        "lead": {"position": lead, "heading": 0.0, "speed": 250.0},
        "wingman": {"position": centre - [6150.0, 0.0], "heading": turn, "speed": 400.0},
    }
    state, _ = jaxsafe.reset_to(env, start)
    starts = jax.tree.map(lambda leaf: leaf[None], state)
    found = best_possible(env, starts)["length"][0] - 20
    if turn == 0.0:
        assert found == 40
    else:
        late = np.pi / 0.17
        assert 40 + late * 250.0 / 150.0 < found < 40 + late * 450.0 / 150.0


def test_what_has_no_bounds_is_refused() -> None:
    env = jaxsafe.make("docking1d")
    starts = on_a_line([100.0], [0.0])
    with pytest.raises(ConfigError, match="bounds: known for the parts of docking and of rejoin"):
        best_possible(jaxsafe.make("docking1d", {"reward": ["delta_v", "success"]}), starts)
    with pytest.raises(ConfigError, match="bounds: known for"):
        best_possible(jaxsafe.make("docking1d", {"reward.delta_v.scale": 0.1}), starts)
    with pytest.raises(ConfigError, match=r"bounds: not known .* decision_period"):
        best_possible(env.replace(decision_period=2), starts)
