"""Projections and the small quadratic program against independent solvers.

Problems are random, degenerate or infeasible.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import one_of_each_kind, thorough
from qpsolvers import solve_qp
from scipy.optimize import minimize, nnls

import jaxsafe
from jaxsafe.rta.projection import project_box_ball, project_box_halfspace
from jaxsafe.rta.qp import nearest_solution

NUM = 1000
TOLERANCES = [(np.float64, 1e-12), (np.float32, 5e-6)]


def nearest_control(*arguments: Any) -> tuple[Any, Any]:
    """Return control and flag of the nearest solution."""
    solution = nearest_solution(*arguments)
    return solution.control, solution.feasible


def boxes(m: int, dtype: Any) -> tuple[np.ndarray, ...]:
    """Return points inside boxes about 0, and the bounds of the boxes."""
    rng = np.random.default_rng(m)
    low = -rng.uniform(0.5, 1.0, (NUM, m))
    high = rng.uniform(0.5, 2.0, (NUM, m))
    return tuple(
        array.astype(dtype)
        for array in (np.clip(rng.uniform(-1.5, 1.5, (NUM, m)), low, high), low, high)
    )


def oracle(
    u: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    rows: np.ndarray,
    offsets: np.ndarray,
    solver: str = "quadprog",
) -> np.ndarray | None:
    u, low, high, rows, offsets = (array.astype(float) for array in (u, low, high, rows, offsets))
    return solve_qp(np.eye(len(u)), -u, G=-rows, h=-offsets, lb=low, ub=high, solver=solver)


@pytest.mark.parametrize("m", one_of_each_kind([1, 2, 3], [2]))
@pytest.mark.parametrize(("dtype", "tolerance"), TOLERANCES)
@pytest.mark.usefixtures("x64")
def test_box_and_half_space_are_projected_on_as_by_quadprog(
    m: int, dtype: Any, tolerance: float
) -> None:
    rng = np.random.default_rng(10 + m)
    u, low, high = boxes(m, dtype)
    a = rng.normal(size=(NUM, m)).astype(dtype)
    b = rng.normal(size=NUM).astype(dtype)
    a[:50, 0] = 0.0  # an element without authority
    control, feasible = jax.jit(jax.vmap(project_box_halfspace))(u, low, high, a, b)
    assert control.dtype == dtype
    for i in range(NUM):
        expected = oracle(u[i], low[i], high[i], a[i, None], b[i, None])
        if abs(np.sum(np.maximum(a[i] * low[i], a[i] * high[i])) - b[i]) < 1e-5:
            continue  # neither clearly feasible nor clearly infeasible
        assert bool(feasible[i]) == (expected is not None)
        if expected is None:
            # The expected control is the one closest to the half-space.
            expected = np.where(a[i] > 0, high[i], np.where(a[i] < 0, low[i], u[i]))
        np.testing.assert_allclose(control[i], expected, rtol=0, atol=tolerance)
    assert 0.5 < np.mean(feasible) < 1.0


@pytest.mark.parametrize("m", one_of_each_kind([1, 2, 3], [2]))
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-12), (np.float32, 2e-6)])
@pytest.mark.usefixtures("x64")
def test_box_and_ball_are_projected_on_at_least_as_well_as_by_slsqp(
    m: int, dtype: Any, tolerance: float
) -> None:
    rng = np.random.default_rng(20 + m)
    u, low, high = boxes(m, dtype)
    beta, p, k = (
        array.astype(dtype)
        for array in (
            rng.uniform(0.5, 2.0, NUM),
            rng.normal(size=(NUM, m)),
            rng.uniform(-1, 1, NUM),
        )
    )
    control, feasible = (
        np.asarray(array) for array in jax.jit(jax.vmap(project_box_ball))(u, low, high, beta, p, k)
    )
    for i in range(150):
        centre = np.clip(-p[i] / beta[i], low[i], high[i]).astype(float)

        def q(w: np.ndarray, i: int = i) -> float:
            return float(beta[i] * w @ w + 2 * p[i] @ w + k[i])

        assert feasible[i] == (q(centre) <= 0)
        if not feasible[i]:
            np.testing.assert_allclose(control[i], centre, rtol=0, atol=tolerance)
            continue
        assert q(control[i].astype(float)) < 2 * tolerance
        assert ((control[i] >= low[i]) & (control[i] <= high[i])).all()
        best = minimize(
            lambda w, i=i: np.sum((w - u[i]) ** 2),
            centre,
            constraints=[{"type": "ineq", "fun": lambda w, q=q: -q(w)}],
            bounds=list(zip(low[i].astype(float), high[i].astype(float), strict=True)),
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        )
        assert np.linalg.norm(control[i] - u[i]) <= np.linalg.norm(best.x - u[i]) + 2e-6
    assert 0.5 < feasible.mean() < 1.0


def rows_for(m: int, count: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return random rows. Some of them occur twice, and one says nothing about the control."""
    rng = np.random.default_rng(30 + m)
    rows = rng.normal(size=(NUM, count, m))
    offsets = 0.7 * rng.normal(size=(NUM, count))
    rows[:100, 1] = rows[:100, 0]
    offsets[:50, 1] = offsets[:50, 0]
    rows[100:150, 1] = 0.0
    return rows, offsets


@pytest.mark.parametrize("m", one_of_each_kind([1, 2, 3, 4], [2, 3]))
@pytest.mark.parametrize("solver", ["quadprog", "daqp"])
@pytest.mark.usefixtures("x64")
def test_the_nearest_control_is_that_of_other_solvers(m: int, solver: str) -> None:
    u, low, high = boxes(m, np.float64)
    rows, offsets = rows_for(m)
    control, feasible = (
        np.asarray(array)
        for array in jax.jit(jax.vmap(nearest_control))(u, low, high, rows, offsets)
    )
    for i in range(NUM):
        expected = oracle(u[i], low[i], high[i], rows[i], offsets[i], solver)
        assert bool(feasible[i]) == (expected is not None)
        if expected is not None:
            np.testing.assert_allclose(
                control[i], expected, rtol=0, atol=1e-9 if solver == "quadprog" else 1e-5
            )
    assert 0.4 < feasible.mean() < 1.0
    assert (control[~feasible] == u[~feasible]).all()


@pytest.mark.parametrize("m", [2, thorough(3)])
@pytest.mark.usefixtures("x64")
def test_float32_finds_the_same_nearest_control(m: int) -> None:
    """Controls agree within 5e-6 in all but a few of ten thousand problems.

    In those few the active rows are nearly parallel.
    """
    rng = np.random.default_rng(60 + m)
    problem = [array.astype(np.float32) for array in (*boxes(m, np.float64), *rows_for(m))]
    problem = [np.concatenate([array] * 10) for array in problem]
    problem[-1] = (problem[-1] + 0.3 * rng.normal(size=problem[-1].shape)).astype(np.float32)
    solve = jax.jit(jax.vmap(nearest_control))
    control, feasible = solve(*problem)
    assert control.dtype == np.float32
    expected, possible = solve(*(array.astype(float) for array in problem))
    error = np.abs(control - expected).max(axis=1)[np.asarray(feasible & possible)]
    assert np.mean(np.asarray(feasible != possible)) < 1e-3
    assert np.quantile(error, 0.998) < 5e-6


@pytest.mark.usefixtures("x64")
def test_the_nearest_control_meets_the_conditions_of_karush_kuhn_and_tucker() -> None:
    u, low, high = boxes(3, np.float64)
    rows, offsets = rows_for(3)
    control, feasible = (
        np.asarray(array)
        for array in jax.jit(jax.vmap(nearest_control))(u, low, high, rows, offsets)
    )
    identity = np.eye(3)
    for i in np.flatnonzero(feasible):
        sides = np.concatenate([rows[i], identity, -identity])
        ends = np.concatenate([offsets[i], low[i], -high[i]])
        slack = sides @ control[i] - ends
        assert slack.min() > -1e-9
        active = slack < 1e-8
        if not active.any():
            np.testing.assert_array_equal(control[i], u[i])
            continue
        multipliers, *_ = nnls(sides[active].T, control[i] - u[i])  # λ ≥ 0
        np.testing.assert_allclose(sides[active].T @ multipliers, control[i] - u[i], atol=1e-7)


@pytest.mark.parametrize(
    ("m", "count"), [thorough(1, 2), (2, 1), thorough(3, 1), (3, 2), thorough(2, 3)]
)
@pytest.mark.usefixtures("x64")
def test_slack_costs_what_it_should(m: int, count: int) -> None:
    """The expected control is quadprog's, with the slack as variables of its own."""
    u, low, high = boxes(m, np.float64)
    rng = np.random.default_rng(70 + m)
    rows = rng.normal(size=(NUM, count, m))
    offsets = rng.normal(size=(NUM, count))
    cost = rng.uniform(0.1, 100.0, NUM)
    rows[:50, -1] = 0.0
    control, _ = jax.jit(jax.vmap(nearest_control))(u, low, high, rows, offsets, cost)
    for i in range(300):
        hessian = np.diag([1.0] * m + [cost[i]] * count)
        expected = solve_qp(
            hessian,
            np.concatenate([-u[i], np.zeros(count)]),
            G=-np.concatenate([rows[i], np.eye(count)], axis=1),
            h=-offsets[i],
            lb=np.concatenate([low[i], np.zeros(count)]),
            ub=np.concatenate([high[i], np.full(count, 1e6)]),
            solver="quadprog",
        )
        assert expected is not None
        np.testing.assert_allclose(control[i], expected[:m], rtol=0, atol=1e-7)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_derivatives_are_finite_differences_where_something_is_active() -> None:
    rng = np.random.default_rng(50)
    u, low, high = boxes(2, np.float64)
    u = 0.99 * u  # on a bound there are two derivatives
    a = rng.normal(size=(NUM, 2))
    b = rng.normal(size=NUM) + 0.5
    beta = rng.uniform(0.5, 2.0, NUM)
    p = rng.normal(size=(NUM, 2))
    k = rng.uniform(-1, 1, NUM)
    rows = rng.normal(size=(NUM, 2, 2))
    offsets = 0.5 * rng.normal(size=(NUM, 2))
    cases = [
        (project_box_halfspace, (u, low, high, a, b)),
        (project_box_ball, (u, low, high, beta, p, k)),
        (nearest_control, (u, low, high, rows, offsets)),
        (nearest_control, (u, low, high, rows, offsets, rng.uniform(0.1, 10.0, NUM))),
    ]
    for project, problem in cases:

        def value(*arguments: jax.Array, project: Any = project) -> jax.Array:
            return jnp.sum(project(*arguments)[0] * jnp.array([1.0, -2.0]))

        _, feasible = jax.vmap(project)(*problem)
        slopes = jax.jit(jax.vmap(jax.grad(value, argnums=tuple(range(len(problem))))))(*problem)
        assert all(np.isfinite(slope).all() for slope in slopes)
        good = 0
        for j, leaf in enumerate(problem):
            nudge = 1e-6 * rng.normal(size=leaf.shape)
            ahead, behind = (
                [*problem[:j], leaf + sign * nudge, *problem[j + 1 :]] for sign in (1, -1)
            )
            expected = (jax.vmap(value)(*ahead) - jax.vmap(value)(*behind)) / 2.0
            control = np.sum(np.reshape(slopes[j] * nudge, (NUM, -1)), axis=1)
            close = np.abs(control - np.asarray(expected)) < 1e-5 * 1e-6 + 1e-4 * np.abs(expected)
            # The other problems change their active set within the nudge.
            assert close[np.asarray(feasible)].mean() > 0.99
            good += int(np.sum(np.abs(control) > 1e-9))
        assert good > NUM


@pytest.mark.thorough
def test_a_point_that_meets_everything_passes_unaltered() -> None:
    u = jnp.array([0.3, -0.2])
    low = -jnp.ones(2)
    high = jnp.ones(2)
    assert (project_box_halfspace(u, low, high, jnp.array([1.0, 0.0]), 0.3)[0] == u).all()
    assert (project_box_ball(u, low, high, 1.0, jnp.zeros(2), -0.5)[0] == u).all()
    assert (nearest_control(u, low, high, jnp.eye(2), jnp.array([0.3, -1.0]))[0] == u).all()


@pytest.mark.thorough
def test_degenerate_problems_give_numbers() -> None:
    low = -jnp.ones(2)
    high = jnp.ones(2)
    zero = jnp.zeros(2)
    problems = [
        (project_box_halfspace, (zero, low, high, zero, 1.0), False),
        (project_box_halfspace, (zero, low, high, zero, -1.0), True),
        (project_box_halfspace, (high, low, high, jnp.array([1.0, 1.0]), 2.0), True),
        (project_box_ball, (zero, low, high, 1.0, zero, 0.5), False),
        (project_box_ball, (zero, low, high, 1.0, zero, 0.0), True),
        (project_box_ball, (high, low, high, 1.0, -high, 1.0), True),
        (nearest_control, (zero, low, high, jnp.zeros((1, 2)), jnp.ones(1)), False),
        (nearest_control, (zero, low, high, jnp.zeros((1, 2)), -jnp.ones(1)), True),
        (nearest_control, (high, low, high, jnp.eye(2), jnp.ones(2)), True),
        (nearest_control, (zero, low, high, jnp.zeros((1, 2)), jnp.ones(1), 1.0), False),
    ]
    for project, problem, expected in problems:
        control, feasible = project(*problem)
        assert bool(feasible) == expected
        slopes = jax.jacrev(lambda u, project=project, rest=problem[1:]: project(u, *rest)[0])(
            problem[0]
        )
        assert np.isfinite(control).all()
        assert np.isfinite(slopes).all()


@pytest.mark.thorough
@pytest.mark.parametrize("slack", [None, thorough(1.0)])
def test_a_row_of_zeros_has_derivatives(slack: float | None) -> None:
    low = -jnp.ones(2)
    high = jnp.ones(2)

    def value(rows: jax.Array) -> jax.Array:
        return jnp.sum(
            nearest_control(jnp.array([0.9, 0.9]), low, high, rows, jnp.array([-1.0, -0.5]), slack)[
                0
            ]
        )

    slopes = jax.grad(value)(jnp.array([[0.0, 0.0], [-1.0, 0.0]]))
    assert np.isfinite(slopes).all()
    assert np.abs(slopes).max() > 0.0


@pytest.mark.thorough
def test_a_control_on_its_bound_keeps_its_derivative() -> None:
    low = -jnp.ones(2)
    high = jnp.ones(2)
    corner = jnp.array([1.0, -1.0])
    problems = [
        (project_box_halfspace, (jnp.array([1.0, 0.0]), -5.0)),
        (project_box_ball, (1.0, jnp.zeros(2), -9.0)),
        (nearest_control, (jnp.eye(2), jnp.array([-5.0, -5.0]))),
    ]
    for project, rest in problems:
        slope = jax.jit(
            jax.jacfwd(lambda u, project=project, rest=rest: project(u, low, high, *rest)[0])
        )(corner)
        np.testing.assert_array_equal(slope, np.eye(2))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "rta", [thorough("default"), "explicit_simplex", thorough("explicit_asif")]
)
def test_a_step_that_nothing_was_altered_in_has_a_derivative(rta: str) -> None:
    env = jaxsafe.make("docking2d", rta=rta)
    state, _ = jaxsafe.reset_to(env, {"deputy": {"position": [120.0, 0.0], "velocity": [0.0, 0.0]}})

    def outcome(action: Any) -> Any:
        timestep = jaxsafe.step(env, state, action)[1]
        return (
            timestep.observation,
            timestep.reward,
            timestep.info.rta.correction,
            timestep.info.rta.predicted_margin,
        )

    for action in (jnp.zeros(2), jnp.array([0.1, 0.2]), jnp.array([1.0, -1.0])):
        assert outcome(action)[2] == 0.0
        for slope in jax.tree.leaves(jax.jacrev(outcome)(action)):
            assert jnp.isfinite(slope).all()
