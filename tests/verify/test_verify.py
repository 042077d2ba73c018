"""Proofs about closed loops: every bound holds, and a certificate that says too much is refused."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from default_cases import thorough

import jaxsafe
from jaxsafe import Environment
from jaxsafe.agents import Agent, Directional, FarDirectionsFeatures
from jaxsafe.commands.verify import EXIT_CODES, main
from jaxsafe.rollout import RecurrentPolicy
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.simulation.cwh import cwh_flow
from jaxsafe.simulation.oriented import wrapped
from jaxsafe.simulation.trig import arctan, sin_cos
from jaxsafe.verify import check, forms
from jaxsafe.verify.certificate import load_certificate, save_certificate
from jaxsafe.verify.forms import Domain, bound
from jaxsafe.verify.loop import closed_loop, parts, start_of
from jaxsafe.verify.program import ANGULAR, ELEMENTARY, FUNCTIONS, MAX_ANGLE, RULED, trace
from jaxsafe.verify.tube import EVERY, _reduced, between, tube
from jaxsafe.verify.verify import Boxes, Verification, _Search, verify

PUBLISHED = Path(os.environ.get("JAXSAFE_PUBLISHED_NETWORK", "docking2d_published.onnx"))
"""The network of the community's docking benchmark, which does not come with this package."""

FAST = {"type": "above", "name": "fast", "status": "speed", "limit": 1.0}
"""An end of an episode that no proof covers."""

NEAR = {"position": [[1.0, 1.1], [-0.05, 0.05]], "velocity": [-0.005, 0.005]}
"""Starts beside the docking region, at rest."""

SMALL_BOX = {"position": [[80, 92], [80, 86]], "velocity": [[-0.125, 0.03125], [0.0, 0.0625]]}
BEHIND = {
    "position": [[-1010, -990], [140, 160]],
    "heading": [-0.26, -0.24],
    "speed": [300, 310],
    "lead.position": [0, 0],
    "lead.heading": [-0.01, 0.0],
    "lead.speed": [280, 281],
}
"""Starts of a wingman behind its lead."""

WINGMAN_GAINS = 0.2 * np.random.default_rng(0).normal(size=(2, 12))

KEY = jax.random.key(0)
"""A key for policies that do not draw."""

GAINS = np.array([[-0.3, 0.1, -0.9, 0.0, 0.1, 0.0], [0.0, -0.4, 0.1, -0.8, 0.0, -0.1]])


def braking(key: Any, observation: Any) -> Any:
    """Return a smooth action that flies to the chief and brakes."""
    direction = observation[..., :2] / (
        jnp.linalg.norm(observation[..., :2], axis=-1)[..., None] + 0.1
    )
    return jnp.tanh(0.2 * (observation @ GAINS.T) - 0.1 * direction)


def speeding(key: Any, observation: Any) -> Any:
    """Return an action that breaks the speed limit."""
    return jnp.ones((*observation.shape[:-1], 2))


def approaching(key: Any, observation: Any) -> Any:
    """Return an action that flies to the chief like a damped spring, with forces in N."""
    position, velocity = 100.0 * observation[..., :2], 0.5 * observation[..., 2:4]
    return -0.48 * position - 4.8 * velocity


def drifting(key: Any, observation: Any) -> Any:
    """Return no thrust."""
    return jnp.zeros((*observation.shape[:-1], 2))


def domain(key: int, size: int, width: float) -> Domain:
    rng = np.random.default_rng(key)
    centre = rng.uniform(0.5, 2.0, size)
    generators = width * rng.normal(size=(size, 4))
    box = np.abs(1e-9 * rng.normal(size=size))
    half = np.abs(generators).sum(1) + box
    ends = (centre - half, centre + half)
    return Domain.of(*(jnp.asarray(x)[None] for x in (centre, generators, box, *ends)))


def points(domain: Domain, num: int) -> jax.Array:
    rng = np.random.default_rng(0)
    own = jax.tree.map(lambda x: x[0], domain)
    # Many coefficients are at their limits, where bounds are tight.
    e = np.clip(rng.normal(size=(num, 4), scale=2.0), -1, 1)
    f = np.clip(rng.normal(size=(num, len(own.box)), scale=2.0), -1, 1)
    return own.centre + e @ own.generators.T + f * own.box


def _stopped(speed: Any, rate: Any) -> Any:
    """Return when a speed that falls at a rate is 0, or 1 if that is later or never."""
    falls = 2.0 * jnp.abs(rate) > jnp.abs(speed)
    return jnp.clip(jnp.where(falls, speed / jnp.where(falls, rate, 1.0), 1.0), 0.0, 1.0)


COMPOSED: dict[str, Callable[[Any], Any]] = {
    "mul": lambda y: y[:2] * y[2:],
    "max": lambda y: jnp.maximum(y, 1.2),
    "min": lambda y: jnp.minimum(y[:2], y[2:]),
    "norm": lambda y: jnp.sqrt(jnp.sum(y * y))[None],
    "reciprocal": lambda y: 1.0 / (y + 2.0),
    "affine": lambda y: jnp.asarray(GAINS[:, :4]) @ y - 0.3,
    "select": lambda y: jnp.where((y[:2] > 1.1) & (y[2] <= 1.5), y[:2] * y[2:], 2.0 - y[:2]),
    "inverse": lambda y: _stopped(y[:2] - 1.2, y[2:] - 1.2),
    "atan": lambda y: jnp.arctan(3.0 * (y - 1.2)),
    "floor": lambda y: jnp.floor(4.0 * y) + y,
    "wrapped": lambda y: wrapped(4.0 * y),
    **{name: (lambda y, f=FUNCTIONS[name]: f(y + 2.0)) for name in ("exp", "log", "sqrt")},
    **{name: (lambda y, f=FUNCTIONS[name]: f(y - 1.2)) for name in ("tanh", "abs", "square")},
    **{name: (lambda y, f=FUNCTIONS[name]: f(5.0 * y)) for name in ("sin", "cos")},
    "network": lambda y: jnp.tanh(jnp.tanh(GAINS[:, :4] @ y) @ GAINS[:, :5]) / (1.0 + y[0] ** 2),
    "features": lambda y: jnp.log(jnp.sqrt(jnp.sum(y[:2] ** 2)) + 0.1) * y[:2] / (y[2] + 3.0),
    "clipped": lambda y: jnp.clip(jnp.exp(-y) * y, 0.2, 0.35),
    "logistic": lambda y: jax.nn.sigmoid(3.0 * y) * y**3,
}


JUMPING = ("select", "inverse", "floor", "wrapped")
"""Functions with jumps, of which parallel lines say little."""


def test_every_rule_is_tried() -> None:
    assert set(RULED) <= COMPOSED.keys()
    assert set(RULED) == forms.RULES.keys()


def require_points_inside(name: str, program: Any, states: Domain, num: int) -> tuple[Any, Any]:
    """Check points against their bounds. Return how far they leave the planes, and the radius."""
    y = points(states, num)
    values = np.asarray(jax.vmap(COMPOSED[name])(y))
    bounds = jax.tree.map(lambda x: np.asarray(x[0]), bound(program, states))
    apart = np.abs(values - (np.asarray(y) @ bounds.slope.T + bounds.centre))
    assert np.isfinite(bounds.radius).all()
    assert (apart <= bounds.radius).all()
    assert ((values >= bounds.low) & (values <= bounds.high)).all()
    return apart.max(0), bounds.radius


@pytest.mark.parametrize("name", COMPOSED)
@pytest.mark.parametrize("width", [thorough(0.003), 0.1])
def test_no_point_is_outside_of_its_bounds(name: str, width: float) -> None:
    with jax.enable_x64(True):
        program = trace(COMPOSED[name], 4, 0.0)
        assert name in [op.kind for op in program.ops] or name not in RULED
        for key in range(5):
            states = domain(key, 4, width)
            spread, radius = require_points_inside(name, program, states, 20_000)
            if name not in ("abs", "max", "min", "clipped", *JUMPING):
                # The bounds are not much wider than they must be.
                assert (radius <= 6.5 * spread + 1e-8).all()


@pytest.mark.parametrize("name", ["sin", "cos", "atan", *JUMPING])
@pytest.mark.parametrize("num", [2_000, thorough(250_000)])
def test_no_point_is_outside_of_the_bounds_of_a_wide_set(name: str, num: int) -> None:
    with jax.enable_x64(True):
        program = trace(COMPOSED[name], 4, 0.0)
        for key in range(10, 14):
            states = domain(key, 4, 0.4)
            require_points_inside(name, program, states, num)


def test_a_quotient_that_may_be_no_number_has_no_bound() -> None:
    with jax.enable_x64(True):
        program = trace(lambda y: jnp.clip(y[:2] / (y[2:] - 1.2), 0.0, 1.0), 4, 0.0)
        bounds = bound(program, domain(10, 4, 0.4))
    assert np.isnan(bounds.radius).any()


@pytest.mark.thorough
def test_single_precision_is_inside_of_its_bounds_too() -> None:
    for name, function in COMPOSED.items():
        with jax.enable_x64(True):
            program = trace(function, 4, 2.0**-24)
            states = domain(1, 4, 1e-9)
            y = np.asarray(points(states, 2_000)).astype(np.float32)
            half = np.abs(y - states.centre[0]).max(0)
            ends = (states.centre - half, states.centre + half)
            states = Domain.of(states.centre, states.generators, half[None], *ends)
            bounds = jax.tree.map(lambda x: np.asarray(x[0]), bound(program, states))
        for values in (jax.jit(jax.vmap(function))(y), jax.vmap(function)(y)):
            linear = y.astype(np.float64) @ bounds.slope.T + bounds.centre
            assert (np.abs(values - linear) <= bounds.radius).all(), name


@pytest.mark.parametrize("name", ["tanh", "exp", "log"])
def test_elementary_functions_are_as_exact_as_the_proofs_take_them_to_be(name: str) -> None:
    x = np.exp(np.random.default_rng(0).uniform(-30.0, 4.0, 2_000_000)).astype(np.float32)
    x = x if name == "log" else np.concatenate([x, -x])
    exact = getattr(np, name)(x.astype(np.float64))
    error = np.abs(np.asarray(jax.jit(getattr(jnp, name))(x)) - exact)
    assert (error <= 0.5 * ELEMENTARY * 2.0**-24 * np.abs(exact) + 2.0**-60).all()


@pytest.mark.parametrize(("name", "function"), [("sin_cos", sin_cos), ("arctan", arctan)])
def test_angular_functions_are_as_exact_as_the_proofs_take_them_to_be(
    name: str, function: Any
) -> None:
    x = np.random.default_rng(0).uniform(-1.0, 1.0, 1_000_000)
    x = np.concatenate([4.0 * x, MAX_ANGLE * x, np.exp(40.0 * x[:100_000] - 20.0)])
    x = x[np.abs(x) <= MAX_ANGLE].astype(np.float32)
    found = np.atleast_2d(np.asarray(jax.jit(function)(x), np.float64))
    exact = x.astype(np.float64)
    exact = np.stack([np.sin(exact), np.cos(exact)] if name == "sin_cos" else [np.arctan(exact)])
    assert (np.abs(found - exact) <= 0.9 * ANGULAR * 2.0**-24).all()
    small = np.abs(x) <= 1.0
    error = np.abs(found - exact)[:, small]
    assert (error <= 0.5 * ELEMENTARY * 2.0**-24 * np.abs(exact[:, small]) + 2.0**-60).all()


def directional() -> Any:
    """Return the policy of an untrained actor that weighs directions."""
    env = jaxsafe.make("docking2d")
    agent = normalise(Agent(actor=Directional(hidden=(8,)), features=FarDirectionsFeatures()))
    return agent.policy(env, agent.init(KEY, env), deterministic=True)


@pytest.mark.parametrize(
    "build", [thorough(lambda: braking), directional], ids=["own", "directional"]
)
def test_the_program_is_the_loop_that_runs(build: Callable[[], Any]) -> None:
    env, policy = jaxsafe.make("docking2d"), build()
    loop = closed_loop(env, policy)
    x = np.random.default_rng(0).uniform([-90, 60, -0.3, -0.3], [90, 120, 0.3, 0.3], (2000, 4))

    def two_steps(x: jax.Array) -> jax.Array:
        state, timestep = jaxsafe.reset_to(env, start_of(env, x))
        for _ in range(2):
            state, timestep = jaxsafe.step(env, state, policy(KEY, timestep.observation))
        own = state.sim.platforms["deputy"]
        margin = timestep.info.margins["velocity_limit"][None]
        action = policy(KEY, timestep.observation)
        return jnp.concatenate([own.position, own.velocity, action, margin])

    flown = np.asarray(jax.jit(jax.vmap(two_steps))(jnp.asarray(x, jnp.float32)))
    with jax.enable_x64(True):
        y = jnp.concatenate([jnp.asarray(x.astype(np.float32), float), jnp.zeros((2000, 2))], 1)
        for program in (loop.first, loop.following, loop.following):
            out = jax.vmap(program)(y)
            y = out[:, :6]
    np.testing.assert_allclose(flown, out, rtol=2e-6, atol=2e-6)


@pytest.fixture(scope="module")
def proof() -> Verification:
    return verify(jaxsafe.make("docking2d"), braking, SMALL_BOX, steps=6)


@pytest.mark.thorough
def test_thousands_of_flights_stay_inside_of_a_tube(proof: Verification) -> None:
    require_inside(jaxsafe.make("docking2d"), braking, proof)


def require_inside(env: Environment, policy: Any, proof: Verification) -> None:
    """Fly from thousands of starts in the first boxes of a proof, and check all bounds."""
    assert proof.result == "proved"
    low, high = proof.proved.low[:2], proof.proved.high[:2]
    with jax.enable_x64(True):
        ends = map(jnp.asarray, (low, high))
        found = jax.device_get(tube(proof.loop, proof.steps, *ends, order=proof.order))
    names = [item.name for item in env.constraints]

    def fly(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def seen(state: Any, timestep: Any) -> tuple[jax.Array, jax.Array]:
            moving = [getattr(state.sim.platforms[part.platform], part.field) for part in own]
            action = jnp.clip(policy(KEY, timestep.observation), -1.0, 1.0)
            margin = timestep.info.margins[names[0]]
            return jnp.concatenate([*map(jnp.atleast_1d, moving), action]), margin

        def advance(carry: Any, _: None) -> tuple[Any, Any]:
            state, timestep = carry
            carry = jaxsafe.step(env, state, policy(KEY, timestep.observation))
            return carry, seen(*carry)

        start = jaxsafe.reset_to(env, start_of(env, x))
        later = jax.lax.scan(advance, start, None, proof.steps)[1]
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), seen(*start), later)

    own = parts(env)
    share = np.random.default_rng(0).choice([0.0, 1.0, 0.3], (len(low), 3000, low.shape[1]))
    starts = (low[:, None] + share * (high - low)[:, None]).astype(np.float32)
    # Only starts in single precision that are in the box.
    within = np.all((starts >= low[:, None]) & (starts <= high[:, None]), axis=-1)
    assert within.mean() > 0.1
    ways, margins = jax.jit(jax.vmap(jax.vmap(fly)))(starts)
    for row in range(len(low)):
        kept = within[row]
        assert (np.asarray(ways)[row, kept] >= found.low[row]).all()
        assert (np.asarray(ways)[row, kept] <= found.high[row]).all()
        assert (np.asarray(margins)[row, kept] >= found.margin[row]).all()


@pytest.mark.thorough
def test_thousands_of_flights_of_a_wingman_stay_inside_of_a_tube(separation: Verification) -> None:
    require_inside(jaxsafe.make("rejoin2d"), flown_aircraft, separation)


def support(directions: np.ndarray, *generators: Any) -> np.ndarray:
    """Return how far zonotopes reach in some directions."""
    moved = np.concatenate([np.asarray(g) for g in generators], axis=-1)
    return np.abs(np.einsum("ld,ndk->nlk", directions, moved)).sum(-1)


@pytest.mark.parametrize("order", [thorough(1), 3])
def test_a_reduced_set_holds_the_set(order: int) -> None:
    rng = np.random.default_rng(0)
    size, first = 5, order * 5
    generators = np.zeros((8, size, first + 40))
    common = rng.normal(size=(8, size, 2)) @ rng.normal(size=(8, 2, first + 30))
    generators[..., : first + 30] = common + 0.02 * rng.normal(size=common.shape)
    generators[:, 3] = 0.0  # an element of which all states have the same value
    rounding = 1e-3 * rng.normal(size=(8, size, 4 * size))
    directions = np.concatenate([rng.normal(size=(20_000, size)), np.eye(size)])
    before = support(directions, generators, rounding)
    with jax.enable_x64(True):
        centre, far = jnp.zeros((8, size)), jnp.full((8, size), np.inf)
        box = jnp.abs(jnp.asarray(rounding)).sum(-1)
        states = Domain.of(centre, jnp.asarray(generators), box, -far, far)
        fewer, rest = _reduced(states, jnp.asarray(rounding), order)
        assert (fewer.box >= jnp.abs(rest).sum(-1)).all()
        after = support(directions, fewer.generators, rest)
    used = np.any(np.asarray(fewer.generators) != 0.0, axis=1)
    assert (used.sum(axis=1) <= first).all()
    assert (after >= before).all()
    assert np.median(after / before) < 2.0
    checked = support(directions, *check.reduced(generators, rounding, order))
    np.testing.assert_allclose(checked, after, rtol=1e-9)
    assert (checked >= before).all()


@pytest.fixture(scope="module")
def long_proof() -> Verification:
    box = {"position": [[80, 82], [80, 82]], "velocity": [[-0.1, -0.09], [0.0, 0.01]]}
    return verify(jaxsafe.make("docking2d"), braking, box, steps=EVERY + 3, order=2)


@pytest.mark.thorough
def test_flights_stay_inside_of_a_tube_whose_sets_are_reduced(long_proof: Verification) -> None:
    require_inside(jaxsafe.make("docking2d"), braking, long_proof)


@pytest.mark.thorough
def test_a_proof_with_reduced_sets_is_checked_and_read_again(
    long_proof: Verification, tmp_path: Path
) -> None:
    save_certificate(tmp_path / "proof.npz", long_proof, {})
    checked = run_check(tmp_path / "proof.npz")
    assert checked.returncode == 0, checked.stderr
    read = load_certificate(tmp_path / "proof.npz")
    assert read.order == 2
    wide = {"position": [80, 82], "velocity": [[-0.1, -0.09], [0.0, 0.01]]}
    message = r"^resume: order is not that of the certificate"
    with pytest.raises(ConfigError, match=message):
        verify(jaxsafe.make("docking2d"), braking, wide, steps=EVERY + 3, order=3, resume=read)
    with pytest.raises(ConfigError, match=r"^order: found -1; expected 0 or more"):
        verify(jaxsafe.make("docking2d"), braking, wide, order=-1)


def run_check(*paths: Path) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, check.__file__, *paths], capture_output=True, text=True)


def test_a_certificate_is_checked_and_read_again(proof: Verification, tmp_path: Path) -> None:
    save_certificate(tmp_path / "proof.npz", proof, {"policy": "braking"})
    read = load_certificate(tmp_path / "proof.npz")
    same = jax.tree.map(np.array_equal, (read.proved, read.claims), (proof.proved, proof.claims))
    assert jax.tree.all(same)
    checked = run_check(tmp_path / "proof.npz")
    assert checked.returncode == 0, checked.stderr
    assert checked.stdout.startswith("proved: ")


def lost_box(arrays: dict[str, np.ndarray]) -> None:
    claims = ("claims/slope", "claims/centre", "claims/radius")
    for name in ("proved/low", "proved/high", "proved/last", *claims):
        arrays[name] = arrays[name][1:]


def moved_bound(arrays: dict[str, np.ndarray]) -> None:
    high = arrays["proved/high"]
    arrays["proved/high"] = high - 0.5 * np.eye(high.shape[1])[0]


def larger_box(arrays: dict[str, np.ndarray]) -> None:
    high = arrays["box/high"]
    arrays["box/high"] = high + 1e-9 * np.eye(high.shape[1])[3]


def smaller_radius(arrays: dict[str, np.ndarray]) -> None:
    arrays["claims/radius"] = arrays["claims/radius"] * (1.0 - 1e-3)


def wrong_slope(arrays: dict[str, np.ndarray]) -> None:
    arrays["claims/slope"] = arrays["claims/slope"].copy()
    arrays["claims/slope"][0, 2, 0, 0] += 1e-3


def other_network(arrays: dict[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        gains = array.ndim == 2 and len(array) == 2 and not np.isin(array, (-1.0, 0.0, 1.0)).all()
        if name.startswith("following/") and name.endswith("value") and gains:
            arrays[name] = array * 1.001


def lost_last_steps(arrays: dict[str, np.ndarray]) -> None:
    arrays["proved/last"] = arrays["proved/last"][:0]


def moved_last_step(arrays: dict[str, np.ndarray]) -> None:
    arrays["proved/last"] = arrays["proved/last"] - 1


def other_property(arrays: dict[str, np.ndarray]) -> None:
    header = json.loads(str(arrays["header"]))
    header["property"] = {"safe": "docks", "docks": "safe"}[header["property"]]
    arrays["header"] = np.array(json.dumps(header))


def other_property_for_all_steps(arrays: dict[str, np.ndarray]) -> None:
    other_property(arrays)
    steps = json.loads(str(arrays["header"]))["steps"]
    arrays["proved/last"] = np.full_like(arrays["proved/last"], steps)


CHANGES = [
    lost_box,
    moved_bound,
    larger_box,
    smaller_radius,
    wrong_slope,
    other_network,
    lost_last_steps,
    moved_last_step,
    other_property,
]


@pytest.mark.parametrize("change", CHANGES)
def test_a_certificate_that_says_too_much_is_refused(
    change: Callable[[dict[str, np.ndarray]], None], proof: Verification, tmp_path: Path
) -> None:
    require_refused(change, proof, tmp_path)


def larger_set(arrays: dict[str, np.ndarray]) -> None:
    header = json.loads(str(arrays["header"]))
    header["order"] = 1
    arrays["header"] = np.array(json.dumps(header))


@pytest.mark.thorough
@pytest.mark.parametrize("change", [*CHANGES, larger_set])
def test_a_certificate_with_reduced_sets_that_says_too_much_is_refused(
    change: Callable[[dict[str, np.ndarray]], None], long_proof: Verification, tmp_path: Path
) -> None:
    require_refused(change, long_proof, tmp_path)


TURNING = {
    "position": [[87, 89], [69, 71]],
    "velocity": [[-0.11, -0.09], [-0.09, -0.07]],
    "attitude": [0.48, 0.52],
    "attitude_rate": [-0.002, 0.002],
}
"""Starts of a craft that turns."""


def turning(key: Any, observation: Any) -> Any:
    """Return a smooth action of a craft that turns."""
    gains = 0.2 * np.random.default_rng(1).normal(size=(2, observation.shape[-1]))
    return jnp.tanh(observation @ gains.T)


@pytest.fixture(scope="module")
def turned() -> Verification:
    return verify(jaxsafe.make("docking2d_oriented"), turning, TURNING, steps=2)


@pytest.mark.thorough
@pytest.mark.parametrize("change", CHANGES)
def test_a_certificate_about_a_craft_that_turns_that_says_too_much_is_refused(
    change: Callable[[dict[str, np.ndarray]], None], turned: Verification, tmp_path: Path
) -> None:
    assert turned.result == "proved"
    save_certificate(tmp_path / "right.npz", turned, {})
    checked = run_check(tmp_path / "right.npz")
    assert checked.returncode == 0, checked.stderr
    require_refused(change, turned, tmp_path)


def flown_aircraft(key: Any, observation: Any) -> Any:
    """Return a smooth action of a wingman that turns to the lead and follows its speed."""
    return jnp.tanh(observation @ WINGMAN_GAINS.T - 0.2)


@pytest.fixture(scope="module")
def separation() -> Verification:
    return verify(jaxsafe.make("rejoin2d"), flown_aircraft, BEHIND, steps=3)


def test_a_proof_about_aircraft_is_checked_and_read_again(
    separation: Verification, tmp_path: Path
) -> None:
    assert separation.result == "proved"
    save_certificate(tmp_path / "proof.npz", separation, {})
    read = load_certificate(tmp_path / "proof.npz")
    assert read.loop.columns == separation.loop.columns
    assert read.loop.plant == separation.loop.plant
    checked = run_check(tmp_path / "proof.npz")
    assert checked.returncode == 0, checked.stderr


def motion_of_the_state(arrays: dict[str, np.ndarray]) -> None:
    header = json.loads(str(arrays["header"]))
    header["motion"] = 0
    arrays["header"] = np.array(json.dumps(header))


@pytest.mark.parametrize("change", [*CHANGES, motion_of_the_state])
def test_a_certificate_about_aircraft_that_says_too_much_is_refused(
    change: Callable[[dict[str, np.ndarray]], None], separation: Verification, tmp_path: Path
) -> None:
    require_refused(change, separation, tmp_path)


def require_refused(
    change: Callable[[dict[str, np.ndarray]], None], proof: Verification, tmp_path: Path
) -> None:
    """Check that a changed certificate of a proof is refused."""
    save_certificate(tmp_path / "proof.npz", proof, {})
    with np.load(tmp_path / "proof.npz") as file:
        arrays = dict(file)
    before = dict(arrays)
    change(arrays)
    assert any(arrays[name] is not before[name] for name in arrays)
    np.savez(tmp_path / "wrong.npz", **arrays)
    refused = run_check(tmp_path / "wrong.npz")
    assert refused.returncode == 1
    assert refused.stderr.startswith("refused: "), refused.stderr


@pytest.fixture(scope="module")
def arrival() -> Verification:
    return verify(jaxsafe.make("docking2d"), approaching, NEAR, steps=14, property="docks")


def test_all_flights_from_a_box_that_docks_end_with_a_success(arrival: Verification) -> None:
    assert arrival.result == "proved"
    assert (arrival.last >= 1).all()
    assert (arrival.last < 14).all()
    env = jaxsafe.make("docking2d")

    def fly(x: jax.Array) -> jax.Array:
        def advance(carry: Any, _: None) -> tuple[Any, jax.Array]:
            state, timestep = carry
            carry = jaxsafe.step(env, state, approaching(None, timestep.observation))
            return carry, carry[1].info.outcome

        return jax.lax.scan(advance, jaxsafe.reset_to(env, start_of(env, x)), None, 14)[1]

    share = np.random.default_rng(0).choice([0.0, 1.0, 0.3], (len(arrival.last), 200, 4))
    low, high = (x[:, None].astype(np.float32) for x in arrival.proved)
    outcomes = np.asarray(jax.jit(jax.vmap(jax.vmap(fly)))(low + share * (high - low)))
    ended = outcomes > 0
    assert ended.any(axis=2).all()
    when = ended.argmax(axis=2)
    first = np.take_along_axis(outcomes, when[..., None], axis=2)
    assert (first == env.outcomes.index("success")).all()
    assert (when + 1 <= arrival.last[:, None]).all()


def test_a_proof_that_the_agent_docks_is_checked_and_read_again(
    arrival: Verification, tmp_path: Path
) -> None:
    save_certificate(tmp_path / "proof.npz", arrival, {})
    checked = run_check(tmp_path / "proof.npz")
    assert checked.returncode == 0, checked.stderr
    assert checked.stdout.endswith(" until it docks, within 14 steps\n")
    read = load_certificate(tmp_path / "proof.npz")
    assert read.loop.property == "docks"
    np.testing.assert_array_equal(read.last, arrival.last)
    with pytest.raises(ConfigError, match=r"^resume: the property is not that of the certificate"):
        verify(jaxsafe.make("docking2d"), approaching, NEAR, steps=14, resume=read)


@pytest.mark.parametrize("change", [*CHANGES, other_property_for_all_steps])
def test_a_certificate_that_docks_too_early_or_not_at_all_is_refused(
    change: Callable[[dict[str, np.ndarray]], None], arrival: Verification, tmp_path: Path
) -> None:
    require_refused(change, arrival, tmp_path)


def test_a_flight_that_does_not_dock_is_flown_again_from_its_start() -> None:
    env = jaxsafe.make("docking2d")
    found = verify(env, drifting, NEAR, steps=3, property="docks")
    assert found.result == "refuted"
    violation = found.counterexample
    assert violation is not None
    assert violation.undocked
    assert violation.step == 3
    state, timestep = jaxsafe.reset_to(env, violation.start)
    distances = []
    for _ in range(3):
        state, timestep = jaxsafe.step(env, state, drifting(None, timestep.observation))
        distances.append(float(timestep.info.status["docking_distance"]))
    assert int(timestep.info.outcome) == env.outcomes.index("running")
    assert 0.5 - min(distances) == pytest.approx(violation.margin, abs=1e-5)


def test_a_flight_that_docks_too_fast_is_a_violation() -> None:
    env = jaxsafe.make("docking2d")
    fast = {"position": [[0.7, 0.71], [0, 0]], "velocity": [[-0.23, -0.22], [0, 0]]}
    violation = verify(env, drifting, fast, steps=3, property="docks").counterexample
    assert violation is not None
    assert not violation.undocked
    assert violation.step == 0
    assert violation.margin < 0.0


def test_the_certificate_of_another_loop_is_refused(proof: Verification, tmp_path: Path) -> None:
    other = closed_loop(jaxsafe.make("docking2d", overrides={"deputy.mass": 13.0}), braking)
    save_certificate(tmp_path / "proof.npz", proof, {})
    save_certificate(tmp_path / "other.npz", proof._replace(loop=other), {})
    assert run_check(tmp_path / "proof.npz", tmp_path / "proof.npz").returncode == 0
    assert (
        "is not that of the other"
        in run_check(tmp_path / "proof.npz", tmp_path / "other.npz").stderr
    )


def test_a_step_too_long_for_the_bound_between_its_ends_is_refused(
    proof: Verification, tmp_path: Path
) -> None:
    plant = proof.loop.plant._replace(mean_motion=1.0)
    save_certificate(
        tmp_path / "long.npz", proof._replace(loop=proof.loop._replace(plant=plant)), {}
    )
    assert "a step is too long" in run_check(tmp_path / "long.npz").stderr


@pytest.mark.thorough
def test_a_violation_is_flown_again_from_its_start() -> None:
    env = jaxsafe.make("docking2d")
    found = verify(env, speeding, SMALL_BOX, steps=6)
    assert found.result == "refuted"
    assert found.counterexample is not None
    state, timestep = jaxsafe.reset_to(env, found.counterexample.start)
    for _ in range(found.counterexample.step):
        state, timestep = jaxsafe.step(env, state, speeding(None, timestep.observation))
    assert timestep.info.margins["velocity_limit"] < 0.0
    np.testing.assert_allclose(
        timestep.info.margins["velocity_limit"], found.counterexample.margin, rtol=1e-3
    )


@pytest.mark.thorough
def test_a_search_that_stops_goes_on_and_loses_nothing(proof: Verification, tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d")
    wide = {"position": [[70, 106], [70, 106]], "velocity": [[-0.125, 0.03125], [0.0, 0.0625]]}
    part = verify(env, braking, wide, steps=6, max_boxes=1)
    save_certificate(tmp_path / "part.npz", part, {})
    shares = part.shares()
    assert part.result in ("open", "proved")
    assert sum(shares.values()) == pytest.approx(1.0)
    whole = verify(env, braking, wide, steps=6, resume=load_certificate(tmp_path / "part.npz"))
    assert whole.result == "proved"
    assert len(whole.proved.low) >= len(part.proved.low)
    assert whole.bounded >= part.bounded + len(part.open.low)
    assert whole.seconds >= part.seconds
    with pytest.raises(ConfigError, match=r"^resume: the box is not that of the certificate"):
        verify(env, braking, SMALL_BOX, steps=6, resume=part)


def sorted_boxes(boxes: Boxes) -> np.ndarray:
    """Return the corners of boxes in an order that does not depend on the search."""
    corners = np.concatenate(boxes, axis=1)
    return corners[np.lexsort(corners.T)]


def interrupt_at(number: int) -> Callable[..., Any]:
    """Return a tracing function that raises Ctrl-C before the given line of a batch."""
    count = 0

    def trace_line(frame: Any, event: str, argument: Any) -> Any:
        nonlocal count
        count += event == "line"
        if count == number and event == "line":
            raise KeyboardInterrupt
        return trace_line

    def trace_call(frame: Any, event: str, argument: Any) -> Any:
        return trace_line if frame.f_code is _Search.advance.__code__ else None

    return trace_call


def test_ctrl_c_at_any_line_of_a_batch_loses_no_box(proof: Verification) -> None:
    env = jaxsafe.make("docking2d")
    wide = Boxes(np.array([[70.0, 70, -0.4, -0.4]]), np.array([[106.0, 106, 0.4, 0.4]]))
    search = _Search(env, braking, proof.loop, wide, 6, resolution=2)
    search.advance()
    begun = search.known
    assert begun.proved
    assert begun.waiting
    before = sys.gettrace()
    ended = False
    number = 0
    while not ended:
        number += 1
        search.known = begun
        sys.settrace(interrupt_at(number))
        try:
            search.advance()
            ended = True
        except KeyboardInterrupt:
            ended = False
        finally:
            sys.settrace(before)
        assert sum(search.verification(0.0).shares().values()) == pytest.approx(1.0, abs=1e-12)
        assert (search.known is begun) == (not ended)
    assert number > 20


@pytest.mark.slow
def test_an_interrupted_proof_ends_as_one_that_was_not_interrupted(tmp_path: Path) -> None:
    words = [sys.executable, "-u", "-m", "jaxsafe.verify", "run=pretrained/docking2d"]
    words += ["box.position=[97,106]", "box.velocity=[-0.28,0.28]"]
    whole, part, rest = (tmp_path / f"{name}.npz" for name in ("whole", "part", "rest"))
    assert subprocess.run([*words, f"out={whole}"], check=False).returncode == EXIT_CODES["proved"]
    process = subprocess.Popen([*words, f"out={part}"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    first = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    said = first + process.communicate(timeout=120)[0]
    assert process.returncode == EXIT_CODES["open"], said
    assert "\nopen: " in said
    assert f"resume={part}" in said
    interrupted, expected = load_certificate(part), load_certificate(whole)
    assert 0 < interrupted.bounded < expected.bounded
    assert sum(interrupted.shares().values()) == pytest.approx(1.0, abs=1e-12)
    done = subprocess.run([*words, f"resume={part}", f"out={rest}"], check=False)
    assert done.returncode == EXIT_CODES["proved"]
    resumed = load_certificate(rest)
    np.testing.assert_array_equal(sorted_boxes(resumed.proved), sorted_boxes(expected.proved))
    assert resumed.shares() == pytest.approx(expected.shares(), abs=1e-12)
    assert resumed.margin == pytest.approx(expected.margin, rel=1e-6)
    assert resumed.bounded == expected.bounded
    assert run_check(rest, whole).returncode == 0


@pytest.mark.thorough
def test_a_map_tells_refuted_boxes_from_proved_ones() -> None:
    env = jaxsafe.make("docking2d")
    box = {"position": [[80, 98], [80, 98]], "velocity": [[-0.1, 0.4], [0.0, 0.1]]}
    known = verify(env, speeding, box, steps=2, everything=True, resolution=4)
    assert known.result == "refuted"
    shares = known.shares()
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares["refuted"] > 0.1
    assert shares["proved"] > 0.1
    widths = (known.open.high - known.open.low) * 4 / [18.0, 18.0, 0.1, 0.1]
    assert (widths <= 1.0).all()


def test_the_bound_between_two_samples_is_about_the_limit_of_the_constraint() -> None:
    env = jaxsafe.make("docking2d")
    limit: Any = next(status for status in env.status if status.name == "velocity_limit")
    flat = limit.replace(name="flat_limit", slope=jnp.zeros_like(limit.slope))
    distance, *others = env.status
    loop = closed_loop(env.replace(status=(distance, flat, *others)), braking)
    assert loop.plant.slope == pytest.approx(float(limit.slope))


def test_nothing_dips_below_the_bound_between_two_samples() -> None:
    loop = closed_loop(jaxsafe.make("docking2d"), braking)
    n, limit = loop.plant.mean_motion, lambda r: 0.2 + loop.plant.slope * r

    def drop(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        share = jax.random.uniform(key, (7,), minval=-1.0)
        v = 0.4 * share[2:4]
        # Every second one drifts through the chief.
        thrust = jnp.where(share[6] > 0.0, jnp.sign(share[4:6]), 0.0)
        r = jnp.where(share[6] > 0.0, 100.0 * share[:2], -0.5 * v)
        times = jnp.linspace(0.0, 1.0, 65)
        flow = jax.vmap(lambda t: cwh_flow(r, v, thrust / 12.0, n, t))(times)
        distance, speed = (jnp.linalg.norm(x, axis=-1) for x in flow)
        h = limit(distance) - speed
        ends = jnp.array([0, -1])
        allowed = between(
            loop.plant,
            speed=speed[ends].max(),
            distance=distance[ends].max(),
            nearest=distance[ends].max(),
        )
        return h[ends].min() - h.min(), allowed

    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(0), 20_000)
        drops, allowed = jax.device_get(jax.jit(jax.vmap(drop))(keys))
    assert (drops <= allowed).all()
    assert (drops > 0.5 * allowed).any()  # the bound is not far from what happens


def dips(task: str, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Fly random steps, and return by how much h falls within them, and what the bound allows."""
    env = jaxsafe.make(task)
    plant = env.agent_platform
    aircraft = task == "rejoin2d"
    bound = closed_loop(env, flown_aircraft if aircraft else drifting).plant
    low, high = (jnp.stack([getattr(a, end) for a in env.actuators]) for end in ("low", "high"))

    def drop(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        share = jax.random.uniform(key, (10,))
        control = jnp.where(share[8] > 0.5, jnp.round(share[:2]), share[:2])
        controls = dict(zip(env.action_names, low + (high - low) * control, strict=True))
        times = jnp.linspace(0.0, 1.0, 65)
        middle = {"speed": 200.0 + 200.0 * share[2], "heading": 6.0 * share[3] - 3.0}
        if aircraft:
            lead = 200.0 + 200.0 * share[4]
            own = plant.rest().replace(**middle)
            way = jax.vmap(lambda t: plant.step(own, controls, t))(times)
            place = 1000.0 * (share[5:7] - 0.5) * jnp.where(share[9] > 0.5, 1.0, 0.2)
            position = way.position - place - jnp.stack([lead * times, 0.0 * times], -1)
            velocity = way.velocity - jnp.stack([lead, 0.0])
            h = jnp.linalg.norm(position, axis=-1)
        else:
            own = plant.rest().replace(
                position=jnp.where(share[9] > 0.5, 100.0, 1.0) * (share[2:4] - 0.5),
                velocity=0.6 * (share[4:6] - 0.5),
                attitude=6.0 * share[6] - 3.0,
                attitude_rate=0.08 * (share[7] - 0.5),
            )
            way = jax.vmap(lambda t: plant.step(own, controls, t))(times)
            position, velocity = way.position, way.velocity
            speed = jnp.linalg.norm(velocity, axis=-1)
            h = bound.slope * jnp.linalg.norm(position, axis=-1) - speed
        distance = jnp.linalg.norm(position, axis=-1)
        ends = jnp.array([0, -1])
        allowed = between(
            bound,
            speed=jnp.linalg.norm(velocity, axis=-1)[ends].max(),
            distance=distance[ends].max(),
            nearest=distance[ends].max(),
        )
        return h[ends].min() - h.min(), allowed

    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(0), num)
        return jax.device_get(jax.jit(jax.vmap(drop))(keys))


@pytest.mark.parametrize(
    ("task", "share"), [("rejoin2d", 0.5), thorough("docking2d_oriented", 0.04)]
)
def test_nothing_dips_below_the_bound_between_two_samples_of_craft_that_turn(
    task: str, share: float
) -> None:
    drops, allowed = dips(task, 20_000)
    assert (drops <= allowed).all()
    assert (drops > share * allowed).any()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rta": "default"}, "rta: no rule for a filter in the loop"),
        ({"actions": "discrete"}, "env: expected continuous actions, found discrete ones"),
        (
            {"variant": "released"},
            "env: no bound between two steps for velocity_limit: constant_to",
        ),
        ({"overrides": {"decision_period": 2}}, "env: decision_period: expected 1, found 2"),
        (
            {"overrides": {"observation.position.noise": 0.1}},
            "env: observation.position has errors",
        ),
        ({"overrides": {"randomize": {"deputy.mass": [11, 13]}}}, "env: deputy.mass is random"),
    ],
)
def test_loops_of_which_nothing_is_proved_are_refused(change: Any, message: str) -> None:
    with pytest.raises(ConfigError, match="^" + message):
        verify(jaxsafe.make("docking2d", **change), braking, SMALL_BOX)


@pytest.mark.parametrize(
    ("overrides", "options", "message"),
    [
        ({}, {"property": "fast"}, "property: found 'fast'; choose from safe, docks"),
        (
            {},
            {"property": "docks", "steps": 2001},
            "steps: found 2001; the episode ends after 2000 s",
        ),
        (
            {"terminal": ["timeout"], "reward": ["distance_change"]},
            {"property": "docks"},
            "property: docks needs one end of the type docked, and the environment has 0",
        ),
        (
            {"reward": ["distance_change"], "terminal": ["success", FAST]},
            {"property": "docks"},
            "property: docks has no rule for the end fast of the type above",
        ),
        (
            {"regions.docking_region.offset": {"type": "displacement", "by": [1.0, 0.0]}},
            {"property": "docks"},
            "property: docks needs in_docking to be about deputy in a circle or a sphere",
        ),
    ],
)
def test_what_cannot_be_asked_about_docking_is_refused(
    overrides: Any, options: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match="^" + message):
        verify(jaxsafe.make("docking2d", overrides), approaching, NEAR, **options)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ({"position": [0, 1]}, "box.deputy.velocity: missing"),
        ({**SMALL_BOX, "speed": [0, 1]}, "box.speed: no field of a start"),
        (
            {**SMALL_BOX, "velocity": [1, 0]},
            r"box.deputy.velocity: expected 2 intervals \[low, high",
        ),
        ({**SMALL_BOX, "position": [0, 1e9]}, "box.deputy.position: expected 2 intervals"),
        ({**SMALL_BOX, "position": "far"}, "box.deputy.position: expected 2 intervals"),
        (
            {**SMALL_BOX, "position": [[-5, 5], [50_000, 50_001]]},
            "box.deputy.position: every start is farther than 40,000 m, where distance ends",
        ),
    ],
)
def test_what_is_no_box_of_starts_is_refused(box: Any, message: str) -> None:
    with pytest.raises(ConfigError, match="^" + message):
        verify(jaxsafe.make("docking2d"), braking, box)


def test_a_policy_that_remembers_and_an_unknown_operation_are_refused() -> None:
    env = jaxsafe.make("docking2d")
    remembering = RecurrentPolicy(
        lambda key, observation, memory: (observation[..., :2], memory), ()
    )
    with pytest.raises(ConfigError, match=r"^run: the policy remembers"):
        verify(env, remembering, SMALL_BOX)
    with pytest.raises(ConfigError, match=r"^verify: no rule for the operation 'erf'"):
        verify(env, lambda key, x: jax.lax.erf(x[..., :2]), SMALL_BOX)


def test_a_guarded_root_needs_the_guard_behind_it_too() -> None:
    def half_guarded(y: jax.Array) -> jax.Array:
        squared = jnp.sum(y * y)
        return jnp.sqrt(jnp.where(squared == 0.0, 1.0, squared))[None]

    with jax.enable_x64(True), pytest.raises(ConfigError, match=r"^verify: no rule"):
        trace(half_guarded, 2, 0.0)


def test_a_loop_is_taken_turn_by_turn_and_one_over_an_array_is_refused() -> None:
    def twice(y: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda x, _: (jnp.tanh(2.0 * x + y), None), y, length=2)[0]

    def over_an_array(y: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda x, factor: (factor * x, None), y, jnp.stack([y, y]))[0]

    with jax.enable_x64(True):
        y = jnp.array([0.3, -0.1])
        np.testing.assert_allclose(trace(twice, 2, 0.0)(y), twice(y), rtol=1e-15)
        message = "^verify: no rule for a loop over the elements of an array"
        with pytest.raises(ConfigError, match=message):
            trace(over_an_array, 2, 0.0)


def test_a_fact_about_one_rounded_constant_is_refused() -> None:
    def checked(y: jax.Array) -> jax.Array:
        return jnp.where(jnp.isfinite(jnp.asarray(0.1)), y, 0.0)

    message = r"^verify: rounding decides the operation 'is_finite' of numbers"
    with jax.enable_x64(True), pytest.raises(ConfigError, match=message):
        trace(checked, 2, 2.0**-24)


@pytest.mark.slow
@pytest.mark.skipif(not PUBLISHED.exists(), reason="the published network is not here")
def test_the_published_network_is_safe_in_the_whole_box(tmp_path: Path) -> None:
    overrides = {
        "observation": ["position", "velocity"],
        "observation.position.scale": 1.0,
        "observation.velocity.scale": 1.0,
    }
    words = [f"env.{name}={value}" for name, value in overrides.items()]
    words[0] = "env.observation=[position,velocity]"
    command = [sys.executable, "-m", "jaxsafe.verify", f"run={PUBLISHED}", "env=docking2d", *words]
    out = tmp_path / "published.npz"
    done = subprocess.run([*command, f"out={out}"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "\nproved: h ≥ " in done.stdout
    assert run_check(out).returncode == 0


@pytest.mark.thorough
def test_the_command_says_what_is_known_by_its_exit_code(tmp_path: Path, capsys: Any) -> None:
    small = ["box.position=[80,81]", "steps=2"]
    words = {
        "proved": [*small, "box.deputy.velocity=[[0,0.01],[0,0]]"],
        "refuted": [*small, "box.velocity=[0.5,0.6]"],
        "open": ["steps=2", "boxes=1"],
    }
    docks = ["property=docks", "box.position=[2,2.02]", "box.velocity=[0,0.01]"]
    for result, code in EXIT_CODES.items():
        out = tmp_path / f"{result}.npz"
        assert main(["run=pretrained/docking2d", *words[result], f"out={out}"]) == code
        assert f"\n{result}: " in capsys.readouterr().out
        assert load_certificate(out).result == result
    for steps, said in (30, "proved: docked after "), (3, "refuted: not docked after 3"):
        words = [
            "run=pretrained/docking2d",
            *docks,
            f"steps={steps}",
            f"out={tmp_path / 'docks.npz'}",
        ]
        assert main(words) == EXIT_CODES[said.partition(":")[0]]
        assert f"\n{said}" in capsys.readouterr().out
