"""Laws that every dynamics model keeps: accuracy, derivatives, batches, parts of a step, bends."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from platform_models import MODELS, Model, random_controls, random_state
from scipy.integrate import solve_ivp

from jaxsafe.schema.component import choices
from jaxsafe.simulation import Anchor, Platform

ANGLES = ("attitude", "true_anomaly", "argument_of_latitude")
"""Fields that are wrapped."""

BY_DEFAULT = (
    "double_integrator 1D",
    "two_body_j2",
    "reaction_wheel_spacecraft",
    "dubins3d_lag",
    "point_mass_aircraft",
)
"""Models of the default suite. Each of the others is the simpler version of one of them."""

of_every_model = pytest.mark.parametrize(
    "model",
    [
        pytest.param(model, id=name, marks=[] if name in BY_DEFAULT else pytest.mark.thorough)
        for name, model in MODELS.items()
    ],
)


def case(model: Model, seed: int) -> tuple[Any, dict[str, jax.Array]]:
    rng = np.random.default_rng(seed)
    return random_state(model, rng), random_controls(model, rng)


def accurate(model: Model, state: Any, controls: Mapping[str, Any], times: np.ndarray) -> list[Any]:
    """Return the states at some times by DOP853 from the model's own derivative, in float64."""
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), (state, controls))
        platform = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), model.platform)
        start, unravel = ravel_pytree(wide[0])

        @jax.jit
        def slope(flat: jax.Array) -> jax.Array:
            rates = platform.derivative(unravel(flat), wide[1])
            # What the last step did is no state of the motion.
            if "delta_v" in vars(rates):
                rates = rates.replace(delta_v=jnp.zeros_like(rates.delta_v))
            return ravel_pytree(rates)[0]

        solution = solve_ivp(
            lambda _, flat: np.asarray(slope(flat)),
            (0.0, times[-1]),
            np.asarray(start),
            method="DOP853",
            t_eval=times,
            rtol=1e-12,
            atol=1e-12,
        )
        return [jax.tree.map(np.asarray, unravel(flat)) for flat in solution.y.T]


def test_every_model_is_among_those_of_this_file() -> None:
    packaged = {
        name
        for name, kind in choices(Platform).items()
        if kind.__module__.startswith("jaxsafe.") and kind is not Anchor
    }
    assert {model.platform.type_name for model in MODELS.values()} == packaged


@of_every_model
def test_a_step_is_the_accurate_solution_of_the_derivative(model: Model) -> None:
    step = jax.jit(type(model.platform).step)
    for seed in range(3):
        state, controls = case(model, seed)
        moved = step(model.platform, state, controls, jnp.float32(1.0))
        (expected,) = accurate(model, state, controls, np.array([1.0]))
        for name, value in vars(moved).items():
            assert value.dtype == jnp.float32, name
            if name == "delta_v":
                continue
            difference = np.asarray(value) - getattr(expected, name)
            if name in ANGLES:
                difference = (difference + np.pi) % (2 * np.pi) - np.pi
            size = max(1.0, float(np.max(np.abs(getattr(expected, name)))))
            np.testing.assert_allclose(difference / size, 0.0, atol=model.tolerance, err_msg=name)


@of_every_model
def test_a_batch_is_each_state_alone(model: Model) -> None:
    cases = [case(model, seed) for seed in range(4)]
    states, controls = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)
    dt = jnp.float32(1.0)
    step: Callable = type(model.platform).step
    together = jax.jit(jax.vmap(step, in_axes=(None, 0, 0, None)))(
        model.platform, states, controls, dt
    )
    one = jax.jit(step)
    alone = [one(model.platform, *case, dt) for case in cases]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-6, atol=2e-5),
        together,
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone),
    )


@of_every_model
@pytest.mark.usefixtures("x64")
def test_gradients_of_a_step_are_those_of_finite_differences(model: Model) -> None:
    wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), case(model, 7))
    state, controls = wide
    platform = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), model.platform)
    flat, unravel = ravel_pytree((state, controls))

    @jax.jit
    def moved(flat: jax.Array) -> jax.Array:
        return ravel_pytree(platform.step(*unravel(flat), jnp.float64(1.0)))[0]

    rng = np.random.default_rng(8)
    scale = np.maximum(1.0, np.abs(flat))
    along = jnp.asarray(rng.normal(size=flat.shape)) * scale
    slope = jax.jit(lambda flat: jax.jvp(moved, (flat,), (along,))[1])(flat)
    h = 1e-6
    expected = (moved(flat + h * along) - moved(flat - h * along)) / (2.0 * h)
    size = jnp.maximum(1.0, jnp.abs(expected))
    np.testing.assert_allclose((slope - expected) / size, 0.0, atol=2e-5)
    # Backwards, the derivative along a direction is that along the transposed one.
    weights = jnp.asarray(rng.normal(size=slope.shape)) / size
    gradient = jax.jit(jax.grad(lambda flat: jnp.vdot(weights, moved(flat))))(flat)
    np.testing.assert_allclose(jnp.vdot(gradient, along), jnp.vdot(weights, slope), rtol=1e-9)


@of_every_model
def test_derivatives_at_rest_without_control_are_finite(model: Model) -> None:
    controls = {name: jnp.zeros(()) for name in model.platform.inputs if name != "heading_rate"}
    numbers, rebuild = jax.tree.flatten((model.platform, model.platform.rest(), controls))

    def moved(*numbers: jax.Array) -> Any:
        platform, state, controls = jax.tree.unflatten(rebuild, numbers)
        return platform.step(state, controls, jnp.float32(1.0))

    along = [jnp.ones_like(number) for number in numbers]
    slopes = jax.jit(lambda: jax.jvp(moved, tuple(numbers), tuple(along))[1])()

    def total(numbers: list[jax.Array]) -> jax.Array:
        return jnp.sum(ravel_pytree(moved(*numbers))[0])

    gradients = jax.jit(jax.grad(total))(numbers)
    for leaf in jax.tree.leaves((slopes, gradients)):
        assert bool(jnp.isfinite(leaf).all())


@of_every_model
def test_held_controls_act_in_parts_of_a_step_as_in_the_whole(model: Model) -> None:
    step = jax.jit(type(model.platform).step)
    state, controls = case(model, 3)
    dt = jnp.float32(1.0)
    whole = step(model.platform, state, controls, dt)
    held = model.platform.held(state, controls, dt)
    half = step(model.platform, state, held, dt / 2)
    both = step(model.platform, half, held, dt / 2)
    for name, value in vars(whole).items():
        if name != "delta_v":
            size = max(1.0, float(jnp.max(jnp.abs(value))))
            difference = (value - getattr(both, name)) / size
            np.testing.assert_allclose(difference, 0.0, atol=10 * model.tolerance, err_msg=name)


@of_every_model
def test_the_path_leaves_the_straight_line_by_no_more_than_its_bend(model: Model) -> None:
    shares = jnp.linspace(0.0, 1.0, 41)
    step = type(model.platform).step

    @jax.jit
    def excess(state: Any, controls: Any) -> jax.Array:
        dt = jnp.float32(1.0)
        held = model.platform.held(state, controls, dt)
        path = jax.vmap(lambda share: step(model.platform, state, held, share * dt).position)(
            shares
        )
        chord = path[0] + shares[:, None] * (path[-1] - path[0])
        after = step(model.platform, state, controls, dt)
        left = jnp.max(jnp.linalg.norm(path - chord, axis=-1))
        return left - model.platform.bend(state, after, dt)

    for seed in range(20):
        state, controls = case(model, seed)
        rounding = 1e-6 * float(jnp.max(jnp.abs(state.position)))
        assert float(excess(state, controls)) <= 1e-4 + rounding
