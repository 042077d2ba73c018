"""From actions to named controls."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsafe
from jaxsafe.component import normalise
from jaxsafe.simulation.controllers import Actuator, Continuous, Discrete, Uncontrolled


def actuator(low: float = -1.0, high: float = 2.0, **options: object) -> Actuator:
    return normalise(Actuator(name="thrust", low=low, high=high, **options))


@pytest.mark.parametrize(
    ("action", "control"), [(-1.0, -1.0), (-0.5, -0.25), (0.0, 0.5), (0.5, 1.25), (1.0, 2.0), (1.5, 2.0), (-7.0, -1.0)]
)
def test_an_action_is_clipped_and_mapped_affinely_to_the_limits(action: float, control: float) -> None:
    assert actuator().from_continuous(jnp.float32(action)) == control


@pytest.mark.parametrize(
    ("action", "control"), [(-1.0, -1.0), (-0.5, -0.5), (0.0, 0.0), (0.25, 0.5), (1.0, 2.0), (3.0, 2.0), (-3.0, -1.0)]
)
def test_a_zero_centred_actuator_leaves_zero_at_zero(action: float, control: float) -> None:
    assert actuator(zero_centred=True).from_continuous(jnp.float32(action)) == control


@pytest.mark.parametrize(("action", "control"), [(-3.0, -1.0), (-0.5, -0.5), (0.0, 0.0), (1.5, 1.5), (2.5, 2.0)])
def test_without_rescaling_an_action_is_physical_and_only_clipped(action: float, control: float) -> None:
    assert actuator(rescale=False).from_continuous(jnp.float32(action)) == control


@settings(deadline=None, max_examples=50)
@given(action=st.floats(-1e6, 1e6), zero_centred=st.booleans(), rescale=st.booleans())
def test_a_control_never_exceeds_its_limits(action: float, zero_centred: bool, rescale: bool) -> None:
    control = actuator(-0.17, 96.5, zero_centred=zero_centred, rescale=rescale).from_continuous(jnp.float32(action))
    assert np.float32(-0.17) <= control <= np.float32(96.5)


def test_the_gradient_of_a_control_is_finite_on_both_sides_of_every_kink() -> None:
    for options in ({}, {"zero_centred": True}, {"rescale": False}):
        for action in (-2.0, -1.0, 0.0, 1.0, 2.0):
            assert jnp.isfinite(jax.grad(actuator(**options).from_continuous)(action))
    assert jax.grad(actuator().from_continuous)(0.3) == 1.5


@pytest.mark.parametrize("zero_centred", [False, True])
def test_discrete_points_are_equally_spaced_and_include_both_ends(zero_centred: bool) -> None:
    thrust = actuator(-1.0, 1.0, zero_centred=zero_centred)
    controls = jax.vmap(thrust.from_discrete)(jnp.arange(11))
    np.testing.assert_allclose(controls, np.linspace(-1.0, 1.0, 11), atol=1e-7)
    assert controls[0] == -1.0
    assert controls[10] == 1.0
    assert controls[5] == 0.0
    lopsided = jax.vmap(actuator(points=4, zero_centred=zero_centred).from_discrete)(jnp.arange(4))
    np.testing.assert_allclose(lopsided, [-1.0, 0.0, 1.0, 2.0], atol=1e-7)


@pytest.mark.parametrize("dtype", ["int8", "uint8", "int32"])
def test_in_x64_discrete_points_have_all_digits(dtype: str) -> None:
    with jax.enable_x64(True):
        controls = jax.vmap(actuator(-1.0, 1.0).from_discrete)(jnp.arange(11, dtype=dtype))
        assert controls.dtype == jnp.float64
        np.testing.assert_allclose(controls, np.linspace(-1.0, 1.0, 11), atol=1e-15)


def test_indices_beyond_the_points_are_clipped() -> None:
    thrust = actuator(-1.0, 1.0, points=5)
    assert thrust.from_discrete(jnp.asarray(-3)) == -1.0
    assert thrust.from_discrete(jnp.asarray(5)) == 1.0
    assert thrust.from_discrete(jnp.asarray(99)) == 1.0


def test_actions_are_positional_and_controls_are_named() -> None:
    actuators = (Actuator(name="b", low=0.0, high=1.0, points=3), Actuator(name="a", low=-10.0, high=10.0, points=5))
    continuous, discrete = normalise(Continuous(actuators=actuators)), normalise(Discrete(actuators=actuators))
    assert continuous.names == discrete.names == ("b", "a")
    assert continuous.control(jnp.asarray([1.0, 0.5])) == {"b": 1.0, "a": 5.0}
    assert discrete.control(jnp.asarray([1, 4])) == {"b": 0.5, "a": 10.0}
    assert continuous.points == ()
    assert discrete.points == (3, 5)


def test_an_uncontrolled_platform_has_no_controls() -> None:
    assert Uncontrolled().control(jnp.zeros(0)) == {}
    assert Uncontrolled().names == ()


@pytest.mark.parametrize(("task", "size"), [("docking2d", 2), ("docking3d", 3)])
def test_docking_thrusts_one_newton_per_axis_in_eleven_points(task: str, size: int) -> None:
    env = jaxsafe.make(task, actions="discrete")
    assert env.num_action_points == (11,) * size
    controller = env.agent_platform.controller
    lowest, highest = controller.control(jnp.zeros(size, int)), controller.control(jnp.full(size, 10))
    assert list(lowest) == [f"thrust_{axis}" for axis in "xyz"[:size]]
    assert set(map(float, lowest.values())) == {-1.0}
    assert set(map(float, highest.values())) == {1.0}
