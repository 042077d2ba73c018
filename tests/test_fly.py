"""One whole episode as arrays: it is what the steps say."""

import csv
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.flight import Flight
from jaxsafe.rollout import RecurrentPolicy
from jaxsafe.simulation import Sphere

LENGTH = 300
TRACED: list[tuple[int, ...]] = []


def policy(key: jax.Array, observation: jax.Array) -> jax.Array:
    TRACED.append(observation.shape)
    return 0.02 * jnp.sin(7.0 * observation[:2])


class Unhashable:
    """A policy like a module of arrays."""

    __hash__ = None  # type: ignore[assignment]

    def __call__(self, key: jax.Array, observation: jax.Array) -> jax.Array:
        return observation[:2]


@pytest.fixture(scope="module")
def env() -> Environment:
    """Return an environment whose episodes last longer than one compiled piece."""
    return jaxsafe.make("docking2d", {"terminal.timeout.limit": LENGTH - 1})


@pytest.fixture(scope="module")
def flight(env: Environment) -> Flight:
    return jaxsafe.fly(env, policy, jax.random.key(3))


def test_a_flight_is_what_the_steps_say(env: Environment, flight: Flight) -> None:
    assert flight.outcome == "timeout"
    assert len(flight) == LENGTH
    assert flight.observations.shape == (LENGTH + 1, env.observation_size)
    assert flight.platforms["deputy"].position.shape == (LENGTH + 1, 2)
    for array in (flight.times, flight.margins["velocity_limit"], flight.status["speed"]):
        assert array.shape == (LENGTH + 1,)
    for array in (flight.rewards, flight.costs, flight.intervening):
        assert array.shape == (LENGTH,)
    for array in (flight.actions, flight.control_desired, flight.control_actual):
        assert array.shape == (LENGTH, 2)
    position, velocity = (
        getattr(flight.platforms["deputy"], name) for name in ("position", "velocity")
    )
    step = jax.jit(jaxsafe.step)
    for k in (0, 255, 256, LENGTH - 1):
        state, _ = jaxsafe.reset_to(
            env, {"deputy": {"position": position[k], "velocity": velocity[k]}}
        )
        state, timestep = step(env, state, flight.actions[k])
        np.testing.assert_allclose(
            state.sim.platforms["deputy"].position, position[k + 1], rtol=1e-5
        )
        np.testing.assert_allclose(timestep.observation, flight.observations[k + 1], rtol=1e-5)
        np.testing.assert_allclose(timestep.info.control_actual, flight.control_actual[k])
        np.testing.assert_allclose(timestep.cost, flight.costs[k])


def test_a_chosen_start_and_other_numbers_compile_nothing_anew(env: Environment) -> None:
    jaxsafe.fly(env, policy)
    before = len(TRACED)
    start = {"deputy": {"position": [100.0, 5.0], "velocity": [0.0, 0.1]}}
    flight = jaxsafe.fly(env, policy, start=start)
    np.testing.assert_allclose(flight.platforms["deputy"].position[0], [100.0, 5.0])
    same = jaxsafe.fly(env, policy, start=jaxsafe.reset_to(env, start))
    np.testing.assert_array_equal(same.observations, flight.observations)
    heavy = jaxsafe.override(env, {"deputy.mass": 14.0})
    assert jaxsafe.fly(heavy, policy, start=start).observations[5] != pytest.approx(
        flight.observations[5]
    )
    assert len(TRACED) == before


def test_a_policy_remembers(env: Environment) -> None:
    counter = RecurrentPolicy(lambda key, observation, t: (t * jnp.ones(2), t + 0.001), 0.0)
    actions = jaxsafe.fly(env, counter).actions
    np.testing.assert_allclose(actions[:, 0], 0.001 * np.arange(len(actions)), atol=1e-5)


def test_the_csv_has_every_number_once(flight: Flight, tmp_path: Path) -> None:
    path = flight.to_csv(tmp_path / "flight.csv")
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == LENGTH + 1
    np.testing.assert_array_equal(
        np.array([row["deputy.position.y"] for row in rows], np.float32),
        flight.platforms["deputy"].position[:, 1],
    )
    assert rows[0]["action.thrust_x"] == ""
    assert np.float32(rows[1]["action.thrust_x"]) == flight.actions[0, 0]
    assert (rows[0]["outcome"], rows[-1]["outcome"]) == ("running", "timeout")


@pytest.mark.parametrize("task", ["docking3d", thorough("rejoin2d")])
def test_a_flight_is_drawn(task: str, tmp_path: Path) -> None:
    env = jaxsafe.make(task, {"terminal.timeout.limit": 20})
    flight = jaxsafe.fly(env, jaxsafe.load_policy(task))
    figure = flight.plot()
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert len(figure.axes) == (5 if task == "docking3d" else 4)
    assert figure.get_suptitle().startswith(f"{task}: ")
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    film = flight.animate(tmp_path / "episode.gif")
    assert (tmp_path / "episode.gif").read_bytes() == film.data
    assert film.data.startswith(b"GIF8")
    assert "data:image/gif;base64," in film._repr_html_()
    assert film.save(tmp_path / "copy.gif").read_bytes() == film.data
    assert repr(flight).startswith(f"Flight of {task}: ")
    with pytest.raises(ConfigError, match=r"animate: expected a path that ends in .gif or .mp4"):
        flight.animate("episode.mov")


@pytest.mark.thorough
@pytest.mark.parametrize(("task", "drawn"), [thorough("docking2d", True), ("rejoin2d", False)])
def test_a_region_in_place_is_drawn_where_the_map_stays_too(task: str, drawn: bool) -> None:
    regions = jaxsafe.make(task).regions
    zone = Sphere(name="zone", on=None, radius=10.0)
    env = jaxsafe.make(task, {"terminal.timeout.limit": 3, "regions": [*regions, zone]})
    panel = jaxsafe.fly(env, lambda key, observation: observation[:2]).plot().axes[0]
    assert ("zone" in [patch.get_label() for patch in panel.patches]) == drawn


@pytest.mark.parametrize("world", [False, True])
def test_all_craft_are_drawn_in_either_axes(world: bool) -> None:
    start = {"type": "fixed", "name": "position", "value": [-100.0, 80.0]}
    drift = {"type": "fixed", "name": "velocity", "value": [2.0, 0.0]}
    chaser = {"type": "spacecraft", "name": "chaser", "dimension": 2, "start": [start, drift]}
    moved = {"type": "fixed", "name": "position", "value": [5000.0, 0.0]}
    changes = {
        "chief.type": "spacecraft",
        "chief.start": [moved, drift],
        "platforms": ["chief", "deputy", chaser],
        "terminal.timeout.limit": 20,
    }
    flight = jaxsafe.fly(jaxsafe.make("docking2d", changes), lambda key, o: jnp.zeros(2))
    panel = flight.plot(world=world).axes[0]
    lines = {line.get_label(): line for line in panel.lines}
    assert {"chief", "chaser", "deputy"} <= set(lines)
    # From a moving chief one sees where it came from.
    behind = lines.get("path of the chief")
    assert (behind is None) == world
    if behind is not None:
        path = flight.platforms["chief"].position
        np.testing.assert_allclose(behind.get_xydata(), path - path[-1], atol=1e-3)
    chief = lines["chief"].get_xydata()[0]
    expected = flight.platforms["chief"].position[-1] if world else np.zeros(2)
    np.testing.assert_allclose(chief, expected, atol=1e-3)
    for name in ("chaser", "deputy"):
        path = flight.platforms[name].position
        seen = path if world else path - flight.platforms["chief"].position
        shown = lines[name].get_xydata()
        np.testing.assert_allclose(shown[-1], seen[-1], atol=1e-3)
        low, high = np.transpose([panel.get_xlim(), panel.get_ylim()])
        assert (low < seen[-1]).all()
        assert (seen[-1] < high).all()


@pytest.mark.thorough
def test_a_filter_shows_in_a_flight() -> None:
    env = jaxsafe.make("docking2d", {"terminal.timeout.limit": 60}, rta="explicit_simplex")
    flight = jaxsafe.fly(env, lambda key, observation: jnp.ones(2))
    assert flight.intervening.any()
    altered = (flight.control_desired != flight.control_actual).any(axis=1)
    np.testing.assert_array_equal(altered, flight.intervening)


def recurrent(act: Any) -> RecurrentPolicy:
    return RecurrentPolicy(lambda key, observation, memory: act(memory), memory=0.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": lambda key, o: jnp.zeros((16, 2))}, r"action: expected shape \(2,\)"),
        ({"policy": Unhashable()}, "policy: expected a function, found Unhashable, which has no"),
        (
            {"policy": "docking3d"},
            r"policy: expected a function of a key and an observation, found 'docking3d'; "
            r"write jaxsafe\.load_policy\('docking3d'\)$",
        ),
        (
            {"policy": lambda observation: jnp.zeros(2)},
            r"policy: expected a function of \(key, observation\), found <lambda>\(observation\)$",
        ),
        ({"start": "here"}, "fly: start: expected what reset or reset_to returns"),
        ({"start": {"chief": {}}}, "reset_to: "),
        ({"policy": lambda key, o: None}, r"action: expected shape \(2,\) .*, found None"),
        ({"policy": recurrent(lambda memory: 0.0)}, "policy: expected an action and the memory"),
        (
            {"policy": recurrent(lambda memory: (jnp.zeros(2), jnp.zeros(4)))},
            r"policy: expected a memory of shape \(\) after each action, .* found \(4,\)",
        ),
        ({"key": jax.random.split(jax.random.key(0), 4)}, r"one key, found keys of shape \(4,\)"),
        ({"key": 3}, r"fly: key: expected a key, such as jax.random.key\(3\), found 3"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    arguments: dict[str, Any], message: str, env: Environment
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        jaxsafe.fly(env, **{"policy": policy, **arguments})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("policy", "hint"),
    [
        (lambda key, o: np.clip(o[:2], -1, 1), "write jnp in place of np, and jnp.where in place"),
        (lambda key, o: jnp.ones(2) if o[0] > 0 else jnp.zeros(2), "jnp.where in place of if"),
        (lambda key, o: jnp.zeros(2) + o, r"it gets a key and an observation of shape \(6,\)$"),
    ],
)
def test_an_error_in_a_policy_says_what_a_policy_must_be_like(
    policy: Any, hint: str, env: Environment
) -> None:
    with pytest.raises(TypeError) as caught:
        jaxsafe.fly(env, policy)
    assert re.search(
        f"^in the policy test_fly:<lambda>: .*{hint}", "\n".join(caught.value.__notes__), re.M
    )
