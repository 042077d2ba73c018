"""Controllers turn actions into named controls."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsafe
from jaxsafe.schema.component import normalise
from jaxsafe.simulation.controllers import Actuator, Continuous, Discrete, Mixed, Uncontrolled
from jaxsafe.types import Sim

SIM = Sim(jnp.zeros(()), {}, {}, {}, {}, jnp.zeros((), bool))


def actuator(low: float = -1.0, high: float = 2.0, **options: object) -> Actuator:
    return normalise(Actuator(name="thrust", low=low, high=high, **options))


@pytest.mark.parametrize(
    ("action", "control"),
    [(-1.0, -1.0), (-0.5, -0.25), (0.0, 0.5), (0.5, 1.25), (1.0, 2.0), (1.5, 2.0), (-7.0, -1.0)],
)
def test_an_action_is_clipped_and_mapped_affinely_to_the_limits(
    action: float, control: float
) -> None:
    assert actuator().from_continuous(jnp.float32(action)) == control


@pytest.mark.parametrize(
    ("action", "control"),
    [(-1.0, -1.0), (-0.5, -0.5), (0.0, 0.0), (0.25, 0.5), (1.0, 2.0), (3.0, 2.0), (-3.0, -1.0)],
)
def test_a_zero_centred_actuator_leaves_zero_at_zero(action: float, control: float) -> None:
    assert actuator(zero_centred=True).from_continuous(jnp.float32(action)) == control


@pytest.mark.parametrize(
    ("action", "control"), [(-3.0, -1.0), (-0.5, -0.5), (0.0, 0.0), (1.5, 1.5), (2.5, 2.0)]
)
def test_without_rescaling_an_action_is_physical_and_only_clipped(
    action: float, control: float
) -> None:
    assert actuator(rescale=False).from_continuous(jnp.float32(action)) == control


def test_tanh_brings_any_action_within_the_limits() -> None:
    thrust = actuator(post_activation="tanh")
    controls = [float(thrust.from_continuous(jnp.float32(a))) for a in (-30.0, 0.0, 0.5, 30.0)]
    np.testing.assert_allclose(controls, [-1.0, 0.5, 0.5 + 1.5 * np.tanh(0.5), 2.0], rtol=1e-6)
    centred = actuator(post_activation="tanh", zero_centred=True)
    assert centred.from_continuous(jnp.float32(0.0)) == 0.0
    assert jax.grad(thrust.from_continuous)(0.0) == 1.5
    assert thrust.action_range == (-np.inf, np.inf)


@pytest.mark.parametrize("zero_centred", [False, True])
def test_tanh_leads_back_to_an_action_that_gives_the_control(zero_centred: bool) -> None:
    thrust = actuator(post_activation="tanh", zero_centred=zero_centred)
    controls = jnp.linspace(-0.95, 1.9, 7)
    actions = jax.vmap(thrust.to_continuous)(controls)
    np.testing.assert_allclose(jax.vmap(thrust.from_continuous)(actions), controls, atol=1e-5)
    # The action of a limit is finite, and gives a control that is nearly there.
    actions = jax.vmap(thrust.to_continuous)(jnp.array([-1.0, 2.0]))
    assert jnp.isfinite(actions).all()
    ends = jax.vmap(thrust.from_continuous)(actions)
    np.testing.assert_allclose(ends, [-1.0, 2.0], atol=0.003)


def test_tanh_needs_rescaling() -> None:
    assert actuator(post_activation="tanh", rescale=False).problem() == (
        "post_activation: tanh gives shares of the limits, so leave rescale on"
    )


@settings(deadline=None, max_examples=50)
@given(action=st.floats(-1e6, 1e6), zero_centred=st.booleans(), rescale=st.booleans())
def test_a_control_never_exceeds_its_limits(
    action: float, zero_centred: bool, rescale: bool
) -> None:
    control = actuator(-0.17, 96.5, zero_centred=zero_centred, rescale=rescale).from_continuous(
        jnp.float32(action)
    )
    assert np.float32(-0.17) <= control <= np.float32(96.5)


@settings(deadline=None, max_examples=50)
@given(share=st.floats(0.0, 1.0, width=32), zero_centred=st.booleans(), rescale=st.booleans())
def test_a_control_leads_back_to_the_action_that_gives_it(
    share: float, zero_centred: bool, rescale: bool
) -> None:
    limits = actuator(-1.0, 2.0, zero_centred=zero_centred, rescale=rescale)
    control = jnp.float32(-1.0 + 3.0 * share)
    np.testing.assert_allclose(
        limits.from_continuous(limits.to_continuous(control)), control, atol=5e-7
    )
    still = actuator(0.0, 0.0, zero_centred=zero_centred, rescale=rescale)
    assert jnp.isfinite(still.to_continuous(jnp.float32(0.0)))


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
    actuators = (
        Actuator(name="b", low=0.0, high=1.0, points=3),
        Actuator(name="a", low=-10.0, high=10.0, points=5),
    )
    continuous = normalise(Continuous(actuators=actuators))
    discrete = normalise(Discrete(actuators=actuators))
    assert continuous.names == discrete.names == ("b", "a")
    assert continuous.control(jnp.asarray([1.0, 0.5]), SIM) == {"b": 1.0, "a": 5.0}
    assert discrete.control(jnp.asarray([1, 4]), SIM) == {"b": 0.5, "a": 10.0}
    assert continuous.points == ()
    assert discrete.points == (3, 5)
    assert continuous.takes_actions
    assert discrete.takes_actions


BOTH_KINDS = (
    Actuator(name="a", low=-10.0, high=10.0),
    Actuator(name="b", low=0.0, high=1.0, points=3, discrete=True),
)


def test_a_mixed_action_has_numbers_and_indices_in_one_vector() -> None:
    mixed = normalise(Mixed(actuators=BOTH_KINDS))
    assert mixed.points == (0, 3)
    assert mixed.control(jnp.asarray([0.5, 1.0]), SIM) == {"a": 5.0, "b": 0.5}
    # Indices are rounded, then clipped.
    for index, control in ((0.4, 0.0), (0.6, 0.5), (-7.0, 0.0), (9.0, 1.0)):
        assert mixed.control(jnp.asarray([0.0, index]), SIM)["b"] == control
    assert jnp.isnan(mixed.control(jnp.asarray([0.0, jnp.nan]), SIM)["b"])


def test_a_controller_says_which_actuators_it_cannot_have() -> None:
    assert Mixed(actuators=BOTH_KINDS).problem() is None
    assert Discrete(actuators=BOTH_KINDS).problem() is None
    assert Continuous(actuators=BOTH_KINDS[:1]).problem() is None
    assert Continuous(actuators=BOTH_KINDS).problem() == (
        "expected continuous actuators, found 'b' with discrete: true; choose type mixed"
    )


def test_a_mixed_controller_with_actuators_of_one_kind_has_actions_of_that_kind() -> None:
    numbers, indices = (normalise(Mixed(actuators=(one,))) for one in BOTH_KINDS)
    assert (numbers.points, indices.points) == ((), (3,))
    assert numbers.control(jnp.asarray([0.5]), SIM) == {"a": 5.0}
    assert indices.control(jnp.asarray([1]), SIM) == {"b": 0.5}


def test_an_uncontrolled_platform_has_no_controls_and_takes_no_actions() -> None:
    assert Uncontrolled().control(jnp.zeros(0), SIM) == {}
    assert Uncontrolled().names == ()
    assert Uncontrolled().points == ()
    assert not Uncontrolled().takes_actions


def test_an_actuator_whose_limits_are_the_wrong_way_round_has_a_problem() -> None:
    assert actuator(2.0, 1.0).problem() == "expected low ≤ high, found 2 and 1"
    assert actuator(1.0, 1.0).problem() is None
    assert actuator().problem() is None


TURN = np.pi / 180.0
LIMITS = {
    "rejoin2d": {"heading_rate": (-0.17, 0.17), "acceleration": (-96.5, 96.5)},
    "rejoin3d": {
        "roll_rate": (-0.17, 0.17),
        "flight_path_angle_rate": (-0.09, 0.09),
        "acceleration": (-96.5, 96.5),
    },
    "docking2d": {f"thrust_{axis}": (-1.0, 1.0) for axis in "xy"},
    "docking3d": {f"thrust_{axis}": (-1.0, 1.0) for axis in "xyz"},
    "docking2d_oriented": {"thrust": (-1.0, 2.0), "attitude_acceleration": (-TURN, TURN)},
}


@pytest.mark.parametrize("task", LIMITS)
def test_each_task_has_its_actuators_in_order_and_their_points_reach_from_end_to_end(
    task: str,
) -> None:
    continuous, discrete = (jaxsafe.make(task, actions=kind) for kind in ("continuous", "discrete"))
    size = len(LIMITS[task])
    num_points = 5 if task.startswith("rejoin") else 11
    assert continuous.action_names == discrete.action_names == tuple(LIMITS[task])
    assert discrete.num_action_points == (num_points,) * size
    assert continuous.num_action_points == ()
    ends = {
        continuous: (-jnp.ones(size), jnp.ones(size)),
        discrete: (jnp.zeros(size, int), jnp.full(size, num_points - 1)),
    }
    for env, actions in ends.items():
        for index, action in enumerate(actions):
            computed = env.agent_platform.controller.control(action, SIM)
            expected = {name: limits[index] for name, limits in LIMITS[task].items()}
            assert {name: float(value) for name, value in computed.items()} == pytest.approx(
                expected, rel=1e-6
            )


@pytest.mark.parametrize("task", LIMITS)
def test_no_action_in_the_middle_is_no_control_and_the_oriented_thrust_is_zero_centred(
    task: str,
) -> None:
    env = jaxsafe.make(task)
    computed = env.agent_platform.controller.control(jnp.zeros(env.action_size), SIM)
    assert list(computed) == list(LIMITS[task])
    np.testing.assert_allclose([float(value) for value in computed.values()], 0.0, atol=1e-8)
