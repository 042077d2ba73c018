"""What each constraint, backup controller and filter brings along: Section 4 of the paper."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough
from scipy.linalg import solve_continuous_are

import jaxsafe
from jaxsafe import ConfigError, Environment
from jaxsafe.envs.docking import BRAKE
from jaxsafe.evaluate.run_adversaries import attack
from jaxsafe.rta import (
    Brake,
    Cascade,
    HoldPosition,
    Latched,
    Simplex,
    Slow,
    Stage,
)
from jaxsafe.rta.asif import nearest_by_priority
from jaxsafe.rta.filter import RTAMemory
from jaxsafe.transition import advance, bounds
from jaxsafe.types import RTAInfo

step = jax.jit(jaxsafe.step)

FAST = {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, 0.405]}}
"""A start of docking2d at the speed limit, moving across."""

SEPARATION = {"type": "separation", "name": "keep_out", "distance": "docking_distance"}
SPEED_LIMIT = {
    "type": "speed_limit",
    "name": "velocity_limit",
    "speed": "speed",
    "velocity_limit": "velocity_limit",
}


def rows(env: Environment) -> tuple[jax.Array, jax.Array]:
    assert env.rta is not None
    return env.rta.rows(env, jaxsafe.reset_to(env, FAST)[0].sim)


@pytest.mark.thorough
def test_a_barrier_row_takes_strengthening_and_degree_of_its_constraint() -> None:
    alpha = {"type": "polynomial", "linear": 0.3, "cubic": 0.2}
    keep_out = SEPARATION | {"minimum": 10}
    filters = {
        "type": "explicit_asif",
        "constraints": ["velocity_limit", "keep_out"],
        "enforce": False,
    }
    own = {"constraints": [SPEED_LIMIT, keep_out | {"degree": 2, "strengthening": alpha}]}
    mixed_rows, mixed_ends = rows(jaxsafe.make("docking2d", own | {"rta": filters}))
    lifted = {"constraints": [SPEED_LIMIT, keep_out]}
    alone = ({}, {"degree": 2, "strengthening": alpha})
    for index, (name, changes) in enumerate(zip(filters["constraints"], alone, strict=True)):
        rta = filters | changes | {"constraints": [name]}
        (row,), (end,) = rows(jaxsafe.make("docking2d", lifted | {"rta": rta}))
        np.testing.assert_array_equal(mixed_rows[index], row)
        np.testing.assert_array_equal(mixed_ends[index], end)
    with pytest.raises(ConfigError, match=r"^rta: of degree 1 the control has no .*'keep_out'"):
        jaxsafe.make("docking2d", lifted | {"rta": filters})


BOX = {"low": -jnp.ones(2), "high": jnp.ones(2)}
OPPOSED = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])
"""Rows u₀ ≥ b₀, −u₀ ≥ b₁, u₁ ≥ b₂."""

CASES = [
    # offsets, slacks, priorities, control, whether all hard rows are met or given up, row
    ([0.5, 0.0, 0.3], [None, None, None], [2, 1, 1], [0.5, 0.0], 0),
    ([0.5, 0.0, 0.3], [None, None, None], [2, 0, 1], [0.5, 0.3], 0),
    ([0.5, 0.0, 0.3], [None, None, None], [1, 2, 1], [0.0, 0.0], -1),
    ([0.2, -0.1, 0.3], [None, 1.0, None], [0, 0, 0], [0.2, 0.3], 2),
]


@pytest.mark.parametrize(("offsets", "slacks", "priorities", "expected", "row"), CASES)
def test_rows_of_low_priority_are_given_up_first(
    offsets: list, slacks: list, priorities: list, expected: list, row: int
) -> None:
    control, feasible, cause = nearest_by_priority(
        u=jnp.zeros(2),
        rows=OPPOSED,
        offsets=jnp.array(offsets),
        slacks=slacks,
        priorities=priorities,
        **BOX,
    )
    np.testing.assert_allclose(control, expected, atol=1e-6)
    assert feasible
    assert row in (-1, cause)


def test_rows_that_cannot_be_met_are_missed_as_little_as_possible() -> None:
    """Two opposed rows are met half-way, and the control says that it is not feasible."""
    control, feasible, _ = nearest_by_priority(
        u=jnp.array([0.9, 0.0]),
        rows=OPPOSED,
        offsets=jnp.array([0.5, 0.1, 0.3]),
        slacks=[None] * 3,
        priorities=[0] * 3,
        miss_least=True,
        **BOX,
    )
    np.testing.assert_allclose(control, [0.2, 0.3], atol=1e-3)
    assert not feasible


@pytest.mark.thorough
@pytest.mark.parametrize("preset", ["explicit_simplex", "discrete_asif"])
def test_a_margin_of_a_constraint_is_that_of_the_filter_for_it(preset: str) -> None:
    own = {"constraints.velocity_limit.required_margin": 0.05}
    timesteps = []
    for changes in (own, {"rta.margin": 0.05}):
        env = jaxsafe.make("docking2d", changes, rta=preset)
        _, timestep = step(env, jaxsafe.reset_to(env, FAST)[0], jnp.array([0.0, 1.0]))
        timesteps.append(timestep)
    own_margin, filters_margin = timesteps
    np.testing.assert_array_equal(
        own_margin.info.control_actual, filters_margin.info.control_actual
    )
    assert own_margin.info.margins["velocity_limit"] >= 0.049
    assert own_margin.info.rta.certified


def keeper(**changes: Any) -> Environment:
    """Return docking2d with a speed limit and a keep-out sphere that a brake to rest keeps."""
    rta = {
        "type": "simplex",
        "constraints": ["velocity_limit", "keep_out"],
        "margin": 0.01,
        "backups": [{"type": "brake", "name": "brake"}],
        "horizon": 12,
        "terminal": {"type": "at_rest"},
    }
    keep_out = SEPARATION | {"minimum": 20, "required_margin": 0.1}
    return jaxsafe.make("docking2d", {"constraints": [SPEED_LIMIT, keep_out], "rta": rta | changes})


@pytest.mark.thorough
def test_the_info_names_the_constraint_that_caused_an_intervention() -> None:
    env = keeper()
    assert env.rta is not None
    names = env.rta.constraints
    causes = {}
    starts = {
        "none": ([100.0, 0.0], [0.0, 0.1], [0.0, 0.1]),
        "velocity_limit": ([100.0, 0.0], [0.0, 0.38], [0.0, 1.0]),
        "keep_out": ([20.2, 0.0], [-0.1, 0.0], [-1.0, 0.0]),
    }
    for expected, (position, velocity, action) in starts.items():
        start = {"deputy": {"position": position, "velocity": velocity}}
        state, first = jaxsafe.reset_to(env, start)
        assert first.info.rta.constraint == -1
        assert first.info.rta.certified
        _, timestep = step(env, state, jnp.array(action))
        index = int(timestep.info.rta.constraint)
        causes[expected] = "none" if index < 0 else names[index]
        assert timestep.info.intervening == (index >= 0)
        assert timestep.info.rta.certified
    assert causes == {name: name for name in starts}
    _, timestep = step(env, state, jnp.full(2, jnp.nan))
    assert timestep.info.intervening
    assert timestep.info.rta.constraint == -1


def test_at_rest_is_proved_for_what_rests() -> None:
    with pytest.raises(ConfigError, match=r"^rta: at_rest is proved to be kept by brake alone"):
        keeper(backups=[{"type": "coast", "name": "coast"}])
    with pytest.raises(ConfigError, match=r"^rta: coast is proved to keep budgets alone"):
        keeper(backups=[{"type": "coast", "name": "coast"}], horizon=0, terminal=None)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["simplex", "blend", "implicit_asif"])
def test_two_constraints_are_kept_at_once(kind: str) -> None:
    env = keeper(type=kind)
    for policy in ("inward", "bang_bang"):
        row = attack(env, policy, 400, 16, jax.random.key(0))
        assert row["violating_steps"] == row["violating_steps_inside"] == 0, row
        assert row["uncertified_steps"] == 0
        assert row["intervention_rate"] > 0.0


def test_a_small_change_of_the_control_is_no_intervention_within_the_tolerance() -> None:
    flags = []
    for tolerance in (0.0, 0.9):
        env = jaxsafe.make("docking2d", {"rta.tolerance": tolerance}, rta="default")
        _, timestep = step(env, jaxsafe.reset_to(env, FAST)[0], jnp.array([0.0, 1.0]))
        assert 0.0 < timestep.info.rta.correction < 0.9 * 2.0
        flags.append(bool(timestep.info.intervening))
        assert (timestep.info.rta.constraint == 0) == timestep.info.intervening
    assert flags == [True, False]


@pytest.mark.thorough
def test_a_cascade_numbers_the_constraints_of_all_stages() -> None:
    stages = (
        Stage(name="loose", rta=Simplex(**{**BRAKE, "margin": 0.0})),
        Stage(name="tight", rta=Simplex(**{**BRAKE, "margin": 0.05})),
    )
    env = jaxsafe.make("docking2d", rta=Cascade(stages=stages))
    assert env.rta is not None
    assert env.rta.constraints == ("velocity_limit", "velocity_limit")
    start = {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, 0.33]}}
    _, timestep = step(env, jaxsafe.reset_to(env, start)[0], jnp.array([0.0, 0.5]))
    assert timestep.info.rta.constraint == 1


def test_a_filter_of_ones_own_needs_no_index_of_a_constraint() -> None:
    info = RTAInfo(
        correction=jnp.zeros(()),
        feasible=jnp.ones((), bool),
        certified=jnp.zeros((), bool),
        predicted_margin=jnp.zeros(()),
        backup_index=jnp.zeros((), jnp.int32),
    )
    assert info.constraint == -1
    assert info.constraint.dtype == jnp.int32


ALONE = {"constraints": ["velocity_limit"], "enforce": False}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["explicit_asif", thorough("discrete_asif")])
def test_an_asif_that_is_not_enforced_needs_no_backup(kind: str) -> None:
    """It acts as the same filter does with one, and certifies nothing."""
    alone = jaxsafe.make("docking2d", {"rta": ALONE | {"type": kind}})
    backed = jaxsafe.override(alone, {"rta.backups": [{"type": "brake", "name": "brake"}]})
    controls = []
    for env in (alone, backed):
        state, _ = jaxsafe.reset_to(env, FAST)
        _, timestep = step(env, state, jnp.array([0.3, 1.0]))
        assert timestep.info.intervening
        assert timestep.info.rta.constraint == 0
        controls.append(timestep.info.control_actual)
    np.testing.assert_allclose(*controls, rtol=1e-5)
    _, timestep = step(alone, jaxsafe.reset_to(alone, FAST)[0], jnp.full(2, jnp.nan))
    assert np.isfinite(timestep.info.control_actual).all()
    assert not timestep.info.rta.certified
    assert timestep.info.rta.backup_index == -1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"type": "simplex"}, "expected at least one constraint and one backup controller$"),
        ({"type": "explicit_asif", "enforce": True}, "with enforce: false it needs no backup"),
        (
            {"type": "explicit_asif", "horizon": 3, "terminal": {"type": "at_rest"}},
            "a horizon needs a backup controller",
        ),
    ],
)
def test_where_a_backup_is_needed_its_absence_is_told(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"^rta: .*{message}") as caught:
        jaxsafe.make("docking2d", {"rta": ALONE | changes})
    assert "\n" not in str(caught.value)


def memories(env: Environment, timesteps: int, action: Any) -> list[RTAMemory]:
    state, _ = jaxsafe.reset_to(env, FAST)
    found = [state.memory.rta]
    for _ in range(timesteps):
        state, _ = step(env, state, jnp.array(action))
        found.append(state.memory.rta)
    return found


def test_backup_controllers_of_the_tasks_remember_nothing() -> None:
    env = jaxsafe.make("docking2d", rta="default")
    memory = jaxsafe.reset_to(env, FAST)[0].memory.rta
    assert memory.backups == ((),)
    assert len(jax.tree.leaves(memory)) == 3


@pytest.mark.thorough
def test_a_latched_manoeuvre_is_finished() -> None:
    latched = Latched(name="latched", backup=Brake(name="brake"), at_least=3.0)
    rta = Simplex(constraints=("velocity_limit",), margin=2.5e-4, backups=(latched,))
    env = jaxsafe.make("docking2d", rta=rta)
    state, _ = jaxsafe.reset_to(env, FAST)
    acted = []
    for action in ([0.0, 1.0], *[[0.01, 0.0]] * 4):  # only the first one is not safe
        state, timestep = step(env, state, jnp.array(action))
        acted.append(bool(timestep.info.intervening))
        assert timestep.info.rta.certified
    assert acted == [True, True, True, False, False]
    assert state.memory.rta.backups[0].acted_for == 0.0
    assert jaxsafe.config.load(jaxsafe.config.dump(env)) == env


class Planar(Brake, type="of_tests_planar_brake"):
    """A backup controller of the tests that is meant for the plane."""

    def misfits(self, env: Environment) -> dict[str, str]:
        return {} if env.agent_platform.dimension == 2 else {"": "expected a task in the plane"}


class Thrifty(Simplex, type="of_tests_thrifty"):
    """A filter of the tests that is meant for one actuator."""

    def misfits(self, env: Environment) -> dict[str, str]:
        return (
            {} if env.action_size == 1 else {"": f"expected one actuator, found {env.action_size}"}
        )


@pytest.mark.parametrize(
    ("filter_type", "backup_type", "message"),
    [
        ("of_tests_thrifty", "brake", "rta: expected one actuator, found 3"),
        ("simplex", "of_tests_planar_brake", "rta.backups.own: expected a task in the plane"),
    ],
)
def test_a_filter_and_its_parts_say_what_does_not_fit_them(
    filter_type: str, backup_type: str, message: str
) -> None:
    rta = {
        "type": filter_type,
        "constraints": ["velocity_limit"],
        "margin": 2.5e-4,
        "backups": [{"type": backup_type, "name": "own"}],
    }
    with pytest.raises(ConfigError) as caught:
        jaxsafe.make("docking3d", {"rta": rta})
    assert str(caught.value) == message
    task = "docking1d" if filter_type != "simplex" else "docking2d"
    assert jaxsafe.make(task, {"rta": rta}).rta is not None


HOLD = {"position_weight": 0.02, "velocity_weight": 0.2, "integral_weight": 0.0005}


def test_the_gains_of_hold_position_are_those_of_the_riccati_equation() -> None:
    chain = np.diag([1.0, 1.0], k=1)
    push = np.array([[0.0], [0.0], [1.0]])
    weights = [HOLD[f"{name}_weight"] ** 2 for name in ("integral", "position", "velocity")]
    expected = push.T @ solve_continuous_are(chain, push, np.diag(weights), np.eye(1))
    np.testing.assert_allclose(HoldPosition(name="hold", **HOLD).gains(), expected[0], rtol=1e-5)


class Calm(Slow, type="of_tests_calm"):
    """A terminal set of the tests, which every backup controller may keep."""

    def faults(self, env: Any, sim: Any, rta: Any) -> Any:
        return {}


def holding() -> jaxsafe.Environment:
    """Return docking2d with a filter that holds the position."""
    rta = Simplex(
        constraints=("velocity_limit",),
        margin=1e-3,
        backups=(HoldPosition(name="hold", **HOLD),),
        horizon=6,
        terminal=Calm(speed=0.35),
    )
    return jaxsafe.make("docking2d", rta=rta)


@pytest.mark.thorough
def test_a_certificate_predicts_the_memory_of_a_backup_controller() -> None:
    """Where the backup ends after its horizon is where the certificate said, integral included."""
    env = holding()
    start = {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, 0.395]}}
    state, first = jaxsafe.reset_to(env, start)
    assert first.info.rta.certified
    begun = state.memory.rta
    for _ in range(6):
        state, timestep = step(env, state, jnp.full(2, jnp.nan))
        assert timestep.info.intervening
        assert timestep.info.rta.certified
    assert float(jnp.abs(state.memory.rta.backups[0].missing).max()) > 0.1
    np.testing.assert_allclose(
        state.sim.platforms["deputy"].position, begun.ahead["deputy"].position, atol=1e-4
    )
    np.testing.assert_allclose(
        state.memory.rta.backups[0].missing, begun.backups_ahead[0].missing, atol=1e-4
    )
    np.testing.assert_allclose(state.memory.rta.backups[0].place, [100.0, 0.0])


def test_a_backup_controller_takes_over_anew_each_time() -> None:
    env = holding()
    state, _ = jaxsafe.reset_to(env, {"deputy": {"position": [100.0, 0.0], "velocity": [0.0, 0.2]}})
    state, timestep = step(env, state, jnp.zeros(2))
    assert not timestep.info.intervening
    np.testing.assert_array_equal(
        state.memory.rta.backups[0].place, state.sim.platforms["deputy"].position
    )


def test_hold_position_holds_against_the_tide() -> None:
    env = jaxsafe.make("docking2d")
    hold = HoldPosition(name="hold", **HOLD)
    state, _ = jaxsafe.reset_to(
        env, {"deputy": {"position": [1000.0, 300.0], "velocity": [0.2, 0.0]}}
    )

    def one_step(carry: Any, _: None) -> tuple[Any, None]:
        sim, memory = carry
        control, memory = hold.act(env, sim, {}, memory)
        return (advance(env, sim, jnp.clip(control, *bounds(env))), memory), None

    sim = state.sim.replace(regions={}, status={})
    (sim, _), _ = jax.lax.scan(one_step, (sim, hold.init(env, sim)), length=300)
    np.testing.assert_allclose(sim.platforms["deputy"].position, [1000.0, 300.0], atol=0.02)
    with pytest.raises(ConfigError, match=r"^rta: hold_position is proved for no constraint"):
        jaxsafe.make("docking2d", rta=Simplex(constraints=("velocity_limit",), backups=(hold,)))
