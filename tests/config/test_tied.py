"""Numbers that follow others, and how they are set apart."""

import re
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.config import dump, load
from jaxsafe.environment import drawn, extremes
from jaxsafe.parts import Tie
from jaxsafe.schema.dotted_paths import get_path
from jaxsafe.schema.errors import ConfigWarning
from jaxsafe.schema.ties import in_order

SLOPE = "status.velocity_limit.slope"
START_SLOPE = "deputy.start.velocity.slope"
MOTION = "deputy.mean_motion"
SCALE = "reward.success.time_scale"
LIMIT = "terminal.timeout.limit"


@pytest.fixture(scope="module")
def env() -> Environment:
    return jaxsafe.make("docking2d")


def numbers(env: Environment, *paths: str) -> list[float]:
    return [float(get_path(env, path)) for path in paths]


def apart(env: Environment, changes: dict[str, Any], *paths: str) -> Environment:
    """Return the environment with changes that set some numbers apart, each in one line."""
    with pytest.warns(ConfigWarning) as caught:
        changed = jaxsafe.override(env, changes)
    told = sorted(str(warning.message) for warning in caught)
    assert [text.partition(" ")[0] for text in told] == sorted(paths)
    assert not any("\n" in text for text in told)
    assert set(env.tied) - set(changed.tied) == set(paths)
    return changed


# Changes


@pytest.mark.parametrize(
    ("task", "changes", "followers"),
    [
        ("docking2d", {MOTION: 0.002}, {SLOPE: 0.004, START_SLOPE: 0.004}),
        ("docking2d_oriented", {f"platforms.{MOTION}": 0.002}, {SLOPE: 0.004, START_SLOPE: 0.004}),
        ("docking2d", {LIMIT: 6000}, {SCALE: 6000}),
        ("docking2d", {"status.velocity_limit.floor": 0.1}, {"deputy.start.velocity.floor": 0.1}),
        ("rejoin2d", {"constraints.collision.minimum": 200}, {"terminal.crash.limit": 200}),
        ("rejoin3d", {LIMIT: 500}, {SCALE: 500}),
    ],
)
def test_a_change_moves_the_numbers_that_follow(
    task: str, changes: dict[str, float], followers: dict[str, float]
) -> None:
    plain = jaxsafe.make(task)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = jaxsafe.make(task, changes)
    assert numbers(env, *followers) == pytest.approx(list(followers.values()))
    assert env.tied == plain.tied
    assert jax.tree.structure(env) == jax.tree.structure(plain)


def test_a_number_that_is_changed_itself_follows_no_longer(env: Environment) -> None:
    message = rf"^{SLOPE} is set apart: it followed 2 × {MOTION}, and does so no longer$"
    with pytest.warns(ConfigWarning, match=message):
        changed = jaxsafe.override(env, {SLOPE: 0.01})
    assert SLOPE not in changed.tied
    assert numbers(changed, MOTION, SLOPE, START_SLOPE) == pytest.approx([0.001027, 0.01, 0.01])
    later = jaxsafe.override(changed, {MOTION: 0.5})
    assert numbers(later, SLOPE, START_SLOPE) == pytest.approx([0.01, 0.01])


@pytest.mark.parametrize(
    "changes",
    [{LIMIT: 6000, SCALE: 7000}, {SCALE: 7000, LIMIT: 6000}, {LIMIT: 7000, SCALE: 7000}],
)
def test_in_one_change_too_a_number_is_set_apart(env: Environment, changes: Any) -> None:
    changed = apart(env, changes, SCALE)
    assert numbers(changed, LIMIT, SCALE) == [changes[LIMIT], 7000.0]


def test_a_change_that_touches_no_tie_is_silent(env: Environment) -> None:
    random = {"deputy.mass": 10, "randomize": {"deputy.mass": [10, 14]}}
    reordered = {"status": [status.name for status in env.status]}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for changes in (random, reordered, {LIMIT: 2000}, {"agent": "deputy"}):
            assert jaxsafe.override(env, changes).tied == env.tied
        assert jaxsafe.make("docking2d", variant="released").tied == env.tied


def test_a_tie_goes_with_its_part(env: Environment) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sparse = jaxsafe.override(env, {"reward": ["velocity_constraint", "failure"]})
    assert set(env.tied) - set(sparse.tied) == {SCALE}


def test_a_part_that_is_replaced_sets_its_numbers_apart(env: Environment) -> None:
    start = [{"type": "uniform", "name": "position", "low": [1, 1], "high": [9, 9]}]
    velocity = {"type": "below_speed_limit", "name": "velocity", "about": "chief", "floor": 0.2}
    slower = {"deputy.start": [*start, {**velocity, "slope": 0.001}]}
    assert numbers(apart(env, slower, START_SLOPE), START_SLOPE) == pytest.approx([0.001])


def test_ties_can_be_changed_too(env: Environment) -> None:
    alone = jaxsafe.override(env, {"tied": {}, LIMIT: 50})
    assert numbers(alone, LIMIT, SCALE) == [50.0, 2000.0]
    again = jaxsafe.override(alone, {"tied": {SCALE: {"to": LIMIT, "times": 3}}})
    assert numbers(again, LIMIT, SCALE) == [50.0, 150.0]
    assert again.tied == {SCALE: Tie(to=LIMIT, times=3.0)}


def test_values_of_a_mapping_may_follow() -> None:
    tied = {"reward.failure.values.crash": {"to": "reward.failure.values.timeout", "times": 2}}
    env = jaxsafe.make("docking2d", {"tied": tied, "reward.failure.values.timeout": -3})
    assert float(env.reward[-1].values["crash"]) == -6.0


def test_a_number_that_follows_keeps_to_its_range(env: Environment) -> None:
    tied = {"deputy.mass": {"to": "reward.delta_v.scale", "times": 1}}
    with pytest.raises(ConfigError, match=r"^deputy\.mass: expected .* > 0, .*; it follows rew"):
        jaxsafe.override(env, {"tied": tied})


# Transformations of JAX


def test_traced_numbers_carry_through_a_tie(env: Environment) -> None:
    def slopes(motion: Any) -> Any:
        changed = jaxsafe.override(env, {MOTION: motion})
        return get_path(changed, START_SLOPE) + jnp.zeros_like(motion)

    np.testing.assert_allclose(jax.vmap(slopes)(jnp.array([0.001, 0.002])), [0.002, 0.004])
    assert float(jax.grad(slopes)(0.003)) == 2.0
    assert float(jax.jit(slopes)(0.003)) == pytest.approx(0.006)


def test_traced_changes_of_sources_are_not_told(env: Environment) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.eval_shape(lambda limit: jaxsafe.override(env, {LIMIT: limit}), 3.0)
        jax.jit(lambda: jaxsafe.override(env, {LIMIT: 3.0}))()


# Random numbers


def test_a_random_number_moves_those_that_follow_it(env: Environment) -> None:
    random = jaxsafe.override(env, {"randomize": {f"platforms.{MOTION}": [0.01, 0.02]}})
    assert random.tied == env.tied
    state, timestep = jaxsafe.reset(random, jax.random.key(3))
    assert list(state.parameters) == [f"platforms.{MOTION}"]
    motion = float(state.parameters[f"platforms.{MOTION}"])
    episode = drawn(random, state.parameters)
    assert numbers(episode, SLOPE, START_SLOPE) == pytest.approx([2 * motion] * 2)
    status = timestep.info.status
    limit = 0.2 + 2 * motion * float(status["docking_distance"])
    assert float(status["velocity_limit"]) == pytest.approx(limit, rel=1e-6)
    assert numbers(extremes(random)[1], START_SLOPE) == pytest.approx([0.04])


def test_a_random_number_follows_no_other(env: Environment) -> None:
    random = {"randomize": {SLOPE: [0.01, 0.02], MOTION: [0.01, 0.02]}}
    changed = apart(env, random, SLOPE)
    state, _ = jaxsafe.reset(changed, jax.random.key(0))
    slope = float(state.parameters[SLOPE])
    assert numbers(drawn(changed, state.parameters), SLOPE, START_SLOPE) == [slope, slope]


def test_intervals_fit_the_numbers_that_follow_too(env: Environment) -> None:
    changes = {
        "tied": {"deputy.mass": {"to": "reward.delta_v.scale", "times": -1000}},
        "randomize": {"reward.delta_v.scale": [-1, 1]},
    }
    with pytest.raises(
        ConfigError, match=r"^randomize: deputy\.mass: expected .*found -1000\.0; it follows -1000 "
    ):
        jaxsafe.override(env, changes)


# Files


def test_ties_are_written_and_read(env: Environment) -> None:
    for one in (env, jaxsafe.make("rejoin2d", {LIMIT: 77})):
        assert load(dump(one)) == one
        assert load(dump(one)).tied == one.tied
    assert f"  {SLOPE}: {{to: {MOTION}, times: 2.0}}\n" in dump(env)


def test_a_file_without_ties_is_read_as_it_is(env: Environment) -> None:
    text = re.sub(r"tied:\n(  .*\n)+", "", dump(env))
    assert "tied" not in text
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        old = load(text.replace("limit: 2000.0", "limit: 50.0"))
        assert numbers(old, LIMIT, SCALE) == [50.0, 2000.0]
        assert numbers(jaxsafe.override(old, {MOTION: 1.0}), SLOPE) == pytest.approx([0.002054])


def test_in_a_file_the_tie_wins_and_says_so(env: Environment) -> None:
    told = (
        f"{SCALE}: 2000 becomes 50, because it follows {LIMIT}; "
        "take it out of `tied` to set it apart"
    )
    with pytest.warns(ConfigWarning) as caught:
        edited = load(dump(env).replace("limit: 2000.0", "limit: 50.0"))
    assert [str(warning.message) for warning in caught] == [told]
    assert numbers(edited, LIMIT, SCALE) == [50.0, 50.0]


@pytest.mark.parametrize(
    ("tied", "message"),
    [
        ({SCALE: {"to": "terminal.timeot.limit"}}, r"terminal\.timeot: unknown name .* 'timeout'"),
        ({"reward.success.scale": {"to": LIMIT}}, r"reward\.success\.scale: unknown field 'scale'"),
        ({SCALE: {"to": "agent"}}, r"agent: expected the path of one number"),
        ({SCALE: {"to": "deputy.start.position.distance"}}, r"distance: expected the path of one"),
        ({SCALE: {"to": "terminal"}}, r"terminal: expected the path of one number"),
        ({SCALE: {"to": "platforms.deputy.mass"}}, r"such as deputy\.mass, found platforms\.depu"),
        ({"randomize.x": {"to": LIMIT}}, r"found randomize\.x"),
        ({SCALE: {"to": SCALE}}, r"in a circle; take one out"),
        ({SCALE: {"to": LIMIT}, LIMIT: {"to": SCALE}}, r"in a circle; take one out"),
        ({SCALE: {"to": LIMIT, "times": 0}}, r"times: expected a number other than 0, found 0"),
        ({SCALE: {"to": LIMIT, "times": "x"}}, r"times: expected a number other than 0, found 'x'"),
        ({SCALE: {"to": LIMIT, "times": float("nan")}}, r"times: expected a number"),
        ({SCALE: {"to": LIMIT, "times": 10**400}}, r"times: expected a number .*, found 1000"),
        ({SCALE: {"to": LIMIT, "times": True}}, r"times: expected a number .*, found True"),
        (
            {SCALE: {"too": LIMIT}},
            r"unknown field 'too'\. Did you mean 'to'\? Choose from to, times",
        ),
        ({SCALE: LIMIT}, r"expected a mapping of fields, found 'terminal"),
        ([SCALE], r": expected a mapping of names"),
    ],
)
def test_a_tie_that_means_nothing_is_refused(env: Environment, tied: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"^tied[^\n]*{message}[^\n]*$"):
        jaxsafe.override(env, {"tied": tied})


def test_a_file_with_a_random_number_that_follows_is_refused(env: Environment) -> None:
    text = dump(env).replace("randomize: {}", f"randomize: {{{SLOPE}: [0.001, 0.002]}}")
    with pytest.raises(ConfigError, match=rf"^randomize: {SLOPE}: it follows 2 × {MOTION}; draw"):
        load(text)


def test_what_is_followed_comes_first() -> None:
    ties = {name: Tie(to=to) for name, to in (("c", "b"), ("b", "a"), ("e", "c"), ("d", "z"))}
    ordered = in_order(ties)
    assert sorted(ordered) == sorted(ties)
    assert ordered.index("b") < ordered.index("c") < ordered.index("e")
