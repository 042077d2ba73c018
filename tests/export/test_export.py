import re
import shutil
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from default_cases import one_of_each_kind
from test_modes import CHECKED_WHILE_RUNNING, CHECKED_WHILE_TRACING

import jaxsafe
from jaxsafe.agents import (
    Agent,
    Directional,
    FarApproachFeatures,
    FarDirectionsFeatures,
    FarOrientedFeatures,
)
from jaxsafe.agents.callables import read_callable
from jaxsafe.agents.imported_policy import ACTIVATIONS
from jaxsafe.agents.policy_file import SavedPolicy, find_policy, read_policy, save_policy
from jaxsafe.commands.export import main
from jaxsafe.control import Align
from jaxsafe.export import functions
from jaxsafe.export.onnx import to_onnx
from jaxsafe.export.vnnlib import search, write_vnnlib
from jaxsafe.rollout import reset_batch
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError


def saved(task: str) -> SavedPolicy:
    return read_policy(find_policy(task))


def unclipped(policy: SavedPolicy, observations: np.ndarray) -> jax.Array:
    """Return the actions of a policy as its network gives them, which may be out of bounds."""
    act: Any = policy.agent.policy(policy.env, policy.params, True)
    return jax.jit(act)(jax.random.key(0), observations)


def session(model: Any) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(model.SerializeToString(), options)


def run(model: Any, inputs: np.ndarray) -> np.ndarray:
    return session(model).run(None, {"input": inputs})[0]


@pytest.mark.parametrize(
    "task",
    one_of_each_kind(
        ["docking2d", "docking3d", "docking2d_oriented", "rejoin2d", "rejoin3d"], ["rejoin2d"]
    ),
)
def test_another_runtime_acts_alike(task: str) -> None:
    policy = saved(task)
    _, starts = jax.jit(reset_batch, static_argnums=2)(policy.env, jax.random.key(0), 10_000)
    drawn = np.random.default_rng(0).uniform(-1, 1, (10_000, policy.env.observation_size))
    limits = [name == "velocity_limit" for name in policy.env.observation_names]
    drawn[:, limits] = np.abs(drawn[:, limits])  # a velocity limit is never negative
    observations = np.concatenate([starts.observation, drawn]).astype(np.float32)
    expected = unclipped(policy, observations)
    computed = run(to_onnx(functions.action(policy).function, observations.shape), observations)
    np.testing.assert_allclose(computed, expected, atol=1e-5)
    network = functions.network(policy)
    features = np.asarray(policy.agent.inputs(policy.env, jnp.asarray(observations)))
    model = to_onnx(network.function, features.shape)
    np.testing.assert_allclose(run(model, features), expected, atol=1e-5)
    assert {node.op_type for node in model.graph.node} <= {
        "MatMul",
        "Add",
        "Tanh",
        "Reshape",
        "Expand",
        "Identity",
    }


@pytest.mark.parametrize(
    ("task", "controller"),
    one_of_each_kind(
        [
            ("docking1d", "pd"),
            ("docking3d", "lqr"),
            ("docking2d", "mpc"),
            ("docking3d", "mpc"),
            ("docking2d_oriented", "align"),
            ("rejoin2d", "pursuit"),
            ("rejoin3d", "pursuit"),
        ],
        [("docking2d", "mpc"), ("rejoin3d", "pursuit")],
    ),
)
def test_another_runtime_flies_a_controller_alike(task: str, controller: str) -> None:
    env = jaxsafe.make(task)
    policy = read_callable(f"controller/{controller}", env)
    _, starts = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(0), 300)
    drawn = np.random.default_rng(0).uniform(-1, 1, (200, env.observation_size))
    observations = np.concatenate([starts.observation, drawn]).astype(np.float32)
    act = functions.action(policy).function
    computed = run(to_onnx(act, observations.shape), observations)
    # The plan of MPC is the end of 40 rounds, each of which rounds.
    np.testing.assert_allclose(computed, jax.jit(act)(observations), atol=1e-4)
    assert np.ptp(computed, axis=0).min() > 0.5


@pytest.mark.parametrize(
    ("function", "shape"),
    [
        (lambda x: jnp.arctan2(x[:, 0], x[:, 1]), (400, 2)),
        (lambda x: jnp.einsum("nij,njk->nik", x, x), (5, 3, 3)),
        (lambda x: jnp.einsum("ij,kj->ik", x, 2.0 * x), (4, 3)),
        (lambda x: jnp.einsum("nij,mij->nm", x, x), (4, 3, 2)),
        (lambda x: jnp.copysign(1.0 + x**2, x), (7,)),
        (lambda x: jax.lax.scan(lambda c, row: (c * row, c + row), x[0], x)[1], (5, 3)),
        (lambda x: jax.lax.scan(lambda c, r: (0.5 * c + r, c), x[0], x, reverse=True)[1], (5, 3)),
        (lambda x: jax.lax.scan(lambda c, _: (c @ x, None), x, None, 3)[0], (3, 3)),
        (lambda x: jax.lax.optimization_barrier((x, 2.0 * x))[1], (3,)),
    ],
)
def test_a_part_of_a_controller_has_a_counterpart(function: Any, shape: tuple[int, ...]) -> None:
    inputs = np.random.default_rng(0).uniform(-2.0, 2.0, shape).astype(np.float32)
    if shape == (400, 2):
        inputs[:100, 0] = 0.0
        inputs[50:150, 1] = 0.0
    computed = run(to_onnx(function, shape), inputs)
    np.testing.assert_allclose(computed, function(inputs), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("task", "agent"),
    [
        ("docking2d", Agent(features=FarApproachFeatures())),
        ("docking2d", Agent(features=FarDirectionsFeatures(), actor=Directional())),
        ("docking2d_oriented", Agent(features=FarOrientedFeatures())),
        ("docking2d_oriented", Agent(controller=Align())),
    ],
    ids=["far_approach", "directional", "far_oriented", "corrected"],
)
def test_another_runtime_flies_from_far_alike(task: str, agent: Agent) -> None:
    env = jaxsafe.make(task, {"deputy.start.position.distance": [100.0, 10_000.0]})
    agent = normalise(agent)
    policy = SavedPolicy(env=env, agent=agent, params=agent.init(jax.random.key(1), env), about={})
    _, starts = jax.jit(reset_batch, static_argnums=2)(env, jax.random.key(0), 1000)
    observations = np.asarray(starts.observation)
    expected = unclipped(policy, observations)
    computed = run(to_onnx(functions.action(policy).function, observations.shape), observations)
    np.testing.assert_allclose(computed, expected, atol=1e-5)


@pytest.mark.thorough
def test_discrete_policies_choose_alike() -> None:
    policy = saved("docking2d")
    env = jaxsafe.make("docking2d", actions="discrete")
    params = policy.agent.init(jax.random.key(0), env)
    params = {
        "actor": jax.tree.map(lambda x: 30.0 * x, params["actor"]),
        "log_std": jnp.array([-1.5, -2.0]),
    }
    policy = policy._replace(env=env, params=params)
    observations = np.random.default_rng(0).uniform(-1, 1, (500, 6)).astype(np.float32)
    expected, _ = policy.agent.act(
        env, policy.params, jax.random.key(0), jnp.asarray(observations), True
    )
    computed = run(to_onnx(functions.action(policy).function, observations.shape), observations)
    assert np.mean(computed == expected) > 0.999
    assert len(np.unique(computed)) >= 3
    network = functions.network(policy)
    inputs = policy.agent.inputs(env, jnp.asarray(observations))
    distribution = policy.agent.distribution(env, params, inputs)
    computed = run(to_onnx(network.function, inputs.shape), np.asarray(inputs))
    np.testing.assert_allclose(computed, distribution.logits, rtol=1e-4, atol=1e-3)  # type: ignore[union-attr]


def mixed() -> SavedPolicy:
    """Return a policy of docking2d that chooses one thrust and gives the other as a number."""
    policy = saved("docking2d")
    thrust_y = "deputy.controller.actuators.thrust_y"
    env = jaxsafe.make(
        "docking2d", {f"{thrust_y}.discrete": True, f"{thrust_y}.points": 5}, actions="mixed"
    )
    params = policy.agent.init(jax.random.key(0), env)
    params = {
        "actor": jax.tree.map(lambda x: 30.0 * x, params["actor"]),
        "log_std": jnp.array([-1.5, -2.0]),
    }
    return policy._replace(env=env, params=params)


@pytest.mark.thorough
def test_mixed_policies_choose_alike() -> None:
    policy = mixed()
    observations = np.random.default_rng(0).uniform(-1, 1, (500, 6)).astype(np.float32)
    expected = unclipped(policy, observations)
    computed = run(to_onnx(functions.action(policy).function, observations.shape), observations)
    np.testing.assert_allclose(computed[:, 0], expected[:, 0], atol=1e-4)
    assert np.mean(computed[:, 1] == expected[:, 1]) > 0.99
    assert len(np.unique(computed[:, 1])) >= 2
    network = functions.network(policy)
    assert network.outputs == ("thrust_x", *(f"logit_{i}" for i in range(5)))
    inputs = np.asarray(policy.agent.inputs(policy.env, jnp.asarray(observations)))
    outputs = run(to_onnx(network.function, inputs.shape), inputs)
    np.testing.assert_allclose(outputs[:, 0], expected[:, 0], atol=1e-4)
    assert np.mean(outputs[:, 1:].argmax(axis=1) == expected[:, 1]) > 0.99


@pytest.mark.thorough
def test_a_held_action_is_exported_as_its_steps() -> None:
    policy = mixed()
    held = policy._replace(env=jaxsafe.override(policy.env, {"decision_period": 3}))
    start = np.array([[80.0, 30.0, -0.1, 0.05]], np.float32)
    loops = [
        np.asarray(functions.closed_loop(one, steps).function(start))[0]
        for one, steps in ((policy, 3), (held, 1))
    ]
    assert len(loops[1]) == 2
    state, timestep = jaxsafe.reset_to(
        held.env, {"deputy": {"position": start[0, :2], "velocity": start[0, 2:]}}
    )
    act: Any = held.agent.policy(held.env, held.params, True)
    _, timestep = jaxsafe.step(held.env, state, act(jax.random.key(0), timestep.observation))
    np.testing.assert_allclose(loops[1][1], timestep.info.margins["velocity_limit"], atol=1e-5)
    for exported in (
        functions.control(held),
        functions.closed_loop(held, 2, unrolled=True),
    ):
        model = to_onnx(exported.function, start.shape)
        np.testing.assert_allclose(run(model, start), exported.function(start), atol=1e-4)


def test_the_state_goes_in_and_the_control_comes_out() -> None:
    policy = saved("docking2d")
    exported = functions.control(policy)
    assert exported.inputs == (
        "deputy.position.x",
        "deputy.position.y",
        "deputy.velocity.x",
        "deputy.velocity.y",
    )
    start = np.array([[80.0, -60.0, 0.1, -0.05]], np.float32)
    env = policy.env
    state, timestep = jaxsafe.reset_to(
        env, {"deputy": {"position": start[0, :2], "velocity": start[0, 2:]}}
    )
    _, timestep = env.step(
        state, jaxsafe.load_policy("docking2d")(jax.random.key(0), timestep.observation)
    )
    computed = run(to_onnx(exported.function, start.shape), start)
    np.testing.assert_allclose(computed[0], timestep.info.control_actual, atol=1e-5)


def test_a_start_that_is_drawn_as_one_case_has_the_names_of_its_fields() -> None:
    values = {"position.x": [1.0], "position.y": [2.0], "velocity.x": [0.0], "velocity.y": [0.1]}
    env = jaxsafe.make(
        "docking2d", {"deputy.start": [{"type": "cases", "name": "start", "values": values}]}
    )
    usual = jaxsafe.make("docking2d")
    assert functions.state_names(env) == functions.state_names(usual)


def test_the_closed_loop_is_the_environments_own() -> None:
    policy = saved("docking2d")
    start = np.array([[80.0, -60.0, 0.1, -0.05], [70.0, 106.0, -0.28, 0.28]], np.float32)
    looped = functions.closed_loop(policy, 3)
    expected = jax.jit(looped.function)(start)
    computed = run(
        to_onnx(functions.closed_loop(policy, 3, unrolled=True).function, start.shape), start
    )
    np.testing.assert_allclose(computed, expected, atol=1e-5)
    assert looped.outputs == tuple(f"velocity_limit_{t}" for t in range(4))
    speed = np.linalg.norm(start[:, 2:], axis=1)
    limit = 0.2 + 2 * 0.001027 * np.linalg.norm(start[:, :2], axis=1)
    np.testing.assert_allclose(expected[:, 0], limit - speed, atol=1e-6)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_every_activation_of_a_policy_from_elsewhere_can_be_exported(name: str) -> None:
    values = np.linspace(-4.0, 4.0, 60, dtype=np.float32).reshape(6, 10)
    np.testing.assert_allclose(
        run(to_onnx(ACTIVATIONS[name], (6, 10)), values), ACTIVATIONS[name](values), atol=1e-6
    )


def test_a_property_names_its_box_and_what_must_not_happen(tmp_path: Path) -> None:
    exported = functions.Exported(lambda x: x, ("a", "b"), ("h_0", "h_1"))
    text = write_vnnlib(tmp_path / "x.vnnlib", exported, [(0.5, 1.5), (-2.0, 3.0)]).read_text()
    assert [line for line in text.splitlines() if line.startswith("(assert (")] == [
        "(assert (>= X_0 0.5))",
        "(assert (<= X_0 1.5))",
        "(assert (>= X_1 -2.0))",
        "(assert (<= X_1 3.0))",
        "(assert (or",
    ]
    assert text.count("(and (<= Y_") == 2
    assert text.count("(") == text.count(")")


def read_property(text: str) -> list[Any]:
    """Return what a VNN-LIB file asserts, as nested lists of words."""
    words = re.sub(r";.*", "", text).replace("(", " ( ").replace(")", " ) ").split()
    stack: list[list[Any]] = [[]]
    for word in words:
        if word == "(":
            stack.append([])
        elif word == ")":
            done = stack.pop()
            stack[-1].append(done)
        else:
            stack[-1].append(word)
    assert len(stack) == 1
    return [term[1] for term in stack[0] if term[0] == "assert"]


def value(term: Any, known: dict[str, np.ndarray]) -> Any:
    """Return the value of a term of VNN-LIB at many points."""
    if isinstance(term, str):
        return known[term] if term in known else float(term)
    name, *arguments = term
    of = [value(argument, known) for argument in arguments]
    compare = {"<=": np.less_equal, ">=": np.greater_equal}
    if name in compare:
        return compare[name](*of)
    return {"and": np.logical_and, "or": np.logical_or}[name].reduce(of)


@pytest.mark.parametrize(
    "task", one_of_each_kind(["docking2d", "docking3d", "docking2d_oriented"], ["docking2d"])
)
def test_the_property_read_back_is_that_the_environment_violates_its_limit(
    task: str, tmp_path: Path
) -> None:
    policy = saved(task)
    words = ["format=vnnlib", "steps=2", "box.position=[70,75]", "box.velocity=[-0.4,0.4]"]
    words += ["box.attitude=[-3,3]"] * (task == "docking2d_oriented")
    path = tmp_path / "x.vnnlib"
    assert main([f"run=pretrained/{task}", *words, f"out={path}"]) == 0
    names = functions.state_names(policy.env)
    fields = [name.split(".")[1] for name in names]
    ends = {"position": (70, 75), "velocity": (-0.4, 0.4), "attitude": (-3, 3)}
    low, high = np.array([ends[field] for field in fields], np.float32).T
    share = np.random.default_rng(0).uniform(-0.02, 1.02, (400, len(names)))
    starts = (low + share * (high - low)).astype(np.float32)
    graph = session(onnx.load(path.with_suffix(".onnx")))
    margins = np.concatenate([graph.run(None, {"input": start[None]})[0] for start in starts])

    def fly(start: jax.Array) -> jax.Array:
        parts = {"position": start[: fields.count("position")]}
        parts["velocity"] = start[len(parts["position"]) :][: len(parts["position"])]
        if "attitude" in fields:
            parts["attitude"] = start[-1]
        state, timestep = jaxsafe.reset_to(policy.env, {"deputy": parts})
        flown = [timestep.info.margins["velocity_limit"]]
        for _ in range(2):
            action = policy.agent.policy(policy.env, policy.params, True)(
                jax.random.key(0), timestep.observation[None]
            )[0]
            state, timestep = jaxsafe.step(policy.env, state, action)
            flown.append(timestep.info.margins["velocity_limit"])
        return jnp.stack(flown)

    flown = np.asarray(jax.jit(jax.vmap(fly))(starts))
    np.testing.assert_allclose(margins, flown, atol=1e-5)
    known = {f"X_{i}": x for i, x in enumerate(starts.T.astype(float))}
    known |= {f"Y_{i}": y for i, y in enumerate(margins.T)}
    asked = np.logical_and.reduce([value(term, known) for term in read_property(path.read_text())])
    inside = np.all((starts >= low) & (starts <= high), axis=1)
    clear = np.abs(flown).min(axis=1) > 1e-5  # rounding decides nothing
    expected = inside & (flown <= 0.0).any(axis=1)
    np.testing.assert_array_equal(asked[clear], expected[clear])
    assert 0 < asked.sum() < inside.sum() < len(starts)


def test_a_search_finds_the_least_margin() -> None:
    bowl = lambda x: jnp.sum((x - jnp.array([0.31, -0.7])) ** 2, axis=-1, keepdims=True) - 0.01  # noqa: E731
    worst = search(
        functions.Exported(bowl, ("a", "b"), ("h",)),
        [(-1, 1), (-1, 1)],
        jax.random.key(0),
        starts=50,
    )
    assert worst.margin == pytest.approx(-0.01, abs=1e-4)
    np.testing.assert_allclose(worst.start, [0.31, -0.7], atol=0.02)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "mode", one_of_each_kind([*CHECKED_WHILE_TRACING, *CHECKED_WHILE_RUNNING], ["x64", "nans"])
)
def test_the_modes_of_jax_change_nothing(mode: str, tmp_path: Path) -> None:
    """Graphs are the same, and the search works."""
    expected = tmp_path / "expected.onnx"
    written = tmp_path / "found.onnx"
    words = ["run=pretrained/docking2d", "inputs=state"]
    assert main([*words, f"out={expected}"]) == 0
    bowl = lambda x: jnp.sum((x - jnp.array([[0.31, -0.7]])) ** 2, axis=-1, keepdims=True) - 0.01  # noqa: E731
    with (CHECKED_WHILE_TRACING | CHECKED_WHILE_RUNNING)[mode]():
        assert main([*words, f"out={written}"]) == 0
        assert (
            main(
                ["run=pretrained/docking2d", "format=stablehlo", f"out={tmp_path / 'x.stablehlo'}"]
            )
            == 0
        )
        exported = functions.Exported(bowl, ("a", "b"), ("h",))
        worst = search(exported, [(-1, 1), (-1, 1)], jax.random.key(0), starts=50)
    start = np.array([[80.0, -60.0, 0.1, -0.05]], np.float32)
    left, right = (run(onnx.load(path), start) for path in (expected, written))
    np.testing.assert_allclose(left, right, atol=1e-5)
    assert worst.margin == pytest.approx(-0.01, abs=1e-4)
    np.testing.assert_allclose(worst.start, [0.31, -0.7], atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["rank_promotion", "dtype_promotion"])
def test_a_property_is_searched_where_types_and_ranks_are_strict(mode: str, tmp_path: Path) -> None:
    with CHECKED_WHILE_TRACING[mode]():
        assert (
            main(
                [
                    "run=pretrained/docking2d",
                    "format=vnnlib",
                    "steps=2",
                    f"out={tmp_path / 'x.vnnlib'}",
                ]
            )
            == 0
        )


@pytest.mark.parametrize("where", ["everywhere", "in a corner", "inside"])
def test_a_margin_that_is_not_a_number_is_a_counterexample(where: str) -> None:
    def margins(x: jax.Array) -> jax.Array:
        wrong = {
            "everywhere": x[:, 0] > -9.0,
            "in a corner": x[:, 0] + x[:, 1] > 1.99,
            "inside": jnp.abs(x[:, 0]) < 0.1,
        }
        return jnp.stack([jnp.where(wrong[where], jnp.nan, 1.0), jnp.ones(len(x))], axis=-1)

    worst = search(
        functions.Exported(margins, ("a", "b"), ("h_0", "h_1")),
        [(-1, 1), (-1, 1)],
        jax.random.key(0),
    )
    assert worst.margin == -np.inf
    assert np.isnan(margins(jnp.asarray(worst.start)[None])).any()


def test_a_slope_that_is_not_a_number_is_no_counterexample() -> None:
    cone = lambda x: 0.5 + jnp.linalg.norm(jnp.maximum(x, 0.0), axis=-1, keepdims=True)  # noqa: E731
    worst = search(
        functions.Exported(cone, ("a", "b"), ("h",)),
        [(-1, 1), (-1, 1)],
        jax.random.key(0),
        starts=50,
    )
    assert worst.margin == 0.5
    assert np.isfinite(worst.start).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_policy_that_diverged_is_not_exported(
    value: float, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    policy = saved("docking2d")
    layers = jax.tree.map(np.array, policy.params["actor"])
    layers["hidden_0"]["kernel"][0, 0] = value
    save_policy(Path("own.npz"), policy.env, policy.agent, {**policy.params, "actor": layers}, {})
    for words in (["format=onnx"], ["format=stablehlo"], ["format=vnnlib"]):
        with pytest.raises(
            ConfigError,
            match=r"^own\.npz: actor/hidden_0/kernel: not all parameters are finite numbers",
        ):
            main(["run=own.npz", *words])
    np.savez("theirs.npz", kernel_0=np.full((6, 2), np.nan), bias_0=np.zeros(2))
    with pytest.raises(
        ConfigError, match=r"^theirs\.npz: kernel_0: not all parameters are finite numbers"
    ):
        main(["run=theirs.npz", "env=docking2d", "format=vnnlib"])
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".npz"]


@pytest.mark.thorough
def test_a_loop_that_ends_in_no_number_is_violated(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    layers = {"kernel_0": np.full((6, 2), 3e38), "kernel_1": np.array([[1.0, 1.0], [-1.0, -1.0]])}
    # The last layer subtracts infinity from infinity.
    np.savez(tmp_path / "x.npz", **layers, bias_0=np.zeros(2), bias_1=np.zeros(2))
    words = [
        f"run={tmp_path / 'x.npz'}",
        "env=docking2d",
        "format=vnnlib",
        "steps=1",
        f"out={tmp_path / 'x.vnnlib'}",
    ]
    assert main([*words, "activation=relu"]) == 0
    assert re.search(
        "least margin not a number from .*: violated$", capsys.readouterr().out.strip()
    )


@pytest.mark.thorough
def test_the_page_tells_what_the_search_finds(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "export.md").read_text(encoding="utf-8")
    assert main(["run=pretrained/docking2d", "format=vnnlib", f"out={tmp_path / 'x.vnnlib'}"]) == 0
    told = re.compile(r"least margin (\S+) from .*(: no counterexample among .*)")
    (said, rest), (margin, end) = (
        told.search(text).groups() for text in (page, capsys.readouterr().out)
    )  # type: ignore[union-attr]
    # The page is from another processor.
    assert float(margin) == pytest.approx(float(said), abs=2e-4)
    assert end == rest


def test_a_run_without_such_a_policy_says_so(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="seed: found 7; choose from 0, 1, 2"):
        main([f"run={whole}", "seed=7"])
    shutil.copy(whole / "config.yaml", tmp_path)
    with pytest.raises(
        ConfigError,
        match=f"^run: {tmp_path} has no policies yet; finish it with: .* resume={tmp_path}$",
    ):
        main([f"run={tmp_path}"])


def test_the_command_writes_each_format(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    for words in (
        ["inputs=network", "batch=3"],
        ["format=stablehlo"],
        ["format=vnnlib", "steps=2"],
    ):
        assert main(["run=pretrained/docking2d", *words]) == 0
    assert "docking2d.onnx: feature_0" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {
        "docking2d.onnx",
        "docking2d.stablehlo",
        "docking2d_closed_loop.onnx",
        "docking2d_closed_loop.vnnlib",
    }
    onnx.checker.check_model(onnx.load("docking2d_closed_loop.onnx"), full_check=True)
    loaded = jax.export.deserialize(bytearray(Path("docking2d.stablehlo").read_bytes()))
    observations = np.random.default_rng(0).uniform(-1, 1, (7, 6)).astype(np.float32)
    expected = unclipped(saved("docking2d"), observations)
    np.testing.assert_allclose(loaded.call(observations), expected, atol=1e-6)
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    with pytest.raises(
        ConfigError, match=r"^flatbuffers is not installed; .* pip install '.\[export\]'$"
    ):
        main(["run=pretrained/docking2d", "format=stablehlo", "out=other"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run=pretrained/doking"], r"Did you mean 'docking3d'\?"),
        (
            ["run=pretrained/docking2d", "format=torch"],
            "format: found 'torch'; choose from onnx, stablehlo, vnnlib",
        ),
        (["run=pretrained/docking2d", "inputs=image"], "inputs: found 'image'"),
        (
            ["run=pretrained/docking2d", "format=vnnlib", "box.speed=[0,1]"],
            "box.speed: the state has no such field",
        ),
        (
            ["run=pretrained/docking2d", "format=vnnlib", "box.position=3"],
            r"box.position: expected \[low, high\]",
        ),
        (
            ["run=pretrained/rejoin2d", "format=vnnlib"],
            r"box.heading: expected \[low, high\] for lead.heading",
        ),
        (["format=onnx"], "run: missing"),
        (
            ["run=pretrained/docking2d", "seed=1"],
            "seed: means nothing beside pretrained/docking2d, which is a single policy",
        ),
        (
            ["run=pretrained/docking2d", "format=vnnlib", "batch=2"],
            "batch: means nothing with format=vnnlib",
        ),
        (
            ["run=pretrained/docking2d", "format=stablehlo", "batch=2"],
            "batch: means nothing with format=stablehlo",
        ),
        (
            ["run=pretrained/docking2d", "format=vnnlib", "out=loop.onnx"],
            "out: expected NAME.vnnlib",
        ),
        (
            ["run=pretrained/docking2d", "format=vnnlib", "box.position=[a,b]"],
            r"box.position: expected \[low, high\]",
        ),
        (
            ["run=pretrained/docking2d", "format=vnnlib", "box.position=[1,.inf]"],
            r"box.position: expected \[low, high\]",
        ),
        (
            ["run=pretrained/docking2d", "format=vnnlib", "box.position=[0,1e30]"],
            r"each within ±1e\+18, found",
        ),
        (["run=nowhere"], "run: no run in 'nowhere'"),
        (
            ["run=pretrained/docking2d", "env=docking3d"],
            "env: docking3d has observation_names",
        ),
        (["run=pretrained/docking2d", "env.deputy.mas=2"], "mas"),
        (
            ["run=pretrained/docking2d", "inputs=state", "rta=default"],
            "leave run time assurance out with rta=none",
        ),
        (
            ["run=pretrained/docking2d", "format=vnnlib", "steps=1e6"],
            "steps: expected a whole number from 1 to 2,000",
        ),
        (
            ["run=pretrained/docking2d", "box.position=[1,2]"],
            "box.position: means nothing without format=vnnlib",
        ),
    ],
)
def test_mistakes_are_named(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        main(words)


def test_finite_numbers_are_told_apart() -> None:
    values = np.array([[0.0, -3e38, np.inf, -np.inf, np.nan]], np.float32)
    model = to_onnx(lambda x: jnp.where(jnp.isfinite(x), 1.0, 0.0), values.shape)
    np.testing.assert_array_equal(run(model, values), np.isfinite(values))


def test_a_large_batch_takes_no_memory() -> None:
    model = to_onnx(functions.action(saved("docking2d")).function, (10**9, 6))
    assert [axis.dim_value for axis in model.graph.output[0].type.tensor_type.shape.dim] == [
        10**9,
        2,
    ]


def test_what_has_no_counterpart_is_named() -> None:
    long = lambda x: jax.lax.fori_loop(0, 2000, lambda _, y: 0.9 * y, x)  # noqa: E731
    with pytest.raises(ConfigError, match="onnx: a loop of 2,000 rounds has no counterpart here"):
        to_onnx(long, (3,))
    bits = lambda x: x.view(jnp.int32) & 8  # noqa: E731
    with pytest.raises(ConfigError, match="onnx: 'and' of the bits of a number has no counterpart"):
        to_onnx(bits, (3,))
    with pytest.raises(ConfigError, match="onnx: 'erf' has no counterpart here"):
        to_onnx(jax.scipy.special.erf, (1, 2))
