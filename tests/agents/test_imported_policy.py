import contextlib
import itertools
import random
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

import jaxsafe
from jaxsafe.agents.imported_policy import read_foreign
from jaxsafe.agents.policy_file import find_policy, read_policy
from jaxsafe.commands.evaluate import main
from jaxsafe.commands.export import main as export
from jaxsafe.export import functions
from jaxsafe.export.onnx import write_onnx
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import read_json


def exported(task: str, path: Path) -> Path:
    saved = read_policy(find_policy(task))
    return write_onnx(
        path / f"{task}.onnx", functions.action(saved).function, (1, saved.env.observation_size), {}
    )


def as_torch_writes_it(path: Path, layers: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    """Write a network as torch does: Gemm with transposed weights, and ReLU."""
    nodes = []
    constants = []
    name = "obs"
    for i, (kernel, bias) in enumerate(layers):
        constants += [
            numpy_helper.from_array(kernel.T.copy(), f"w{i}"),
            numpy_helper.from_array(bias, f"b{i}"),
        ]
        nodes.append(helper.make_node("Gemm", [name, f"w{i}", f"b{i}"], [f"z{i}"], transB=1))
        name = f"z{i}"
        if i < len(layers) - 1:
            nodes.append(helper.make_node("Relu", [name], [f"a{i}"]))
            name = f"a{i}"
    sizes = layers[0][0].shape[0], layers[-1][0].shape[1]
    values = [
        helper.make_tensor_value_info(n, TensorProto.FLOAT, ["batch", k])
        for n, k in zip(("obs", name), sizes, strict=True)
    ]
    onnx.save(
        helper.make_model(helper.make_graph(nodes, "net", values[:1], values[1:], constants)), path
    )
    return path


def random_layers(*sizes: int) -> list[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(0)
    normal = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    return [(normal(a, b), normal(b)) for a, b in itertools.pairwise(sizes)]


@pytest.mark.parametrize("task", ["docking3d", "rejoin3d"])
def test_what_was_exported_comes_back(task: str, tmp_path: Path) -> None:
    env = jaxsafe.make(task)
    _, agent, weights = read_foreign(exported(task, tmp_path), env)
    observations = (
        np.random.default_rng(0).uniform(-1, 1, (200, env.observation_size)).astype(np.float32)
    )
    action = jax.jit(agent.policy(env, weights, True))(jax.random.key(0), observations)
    saved = read_policy(find_policy(task))
    own = jax.jit(saved.agent.policy(env, saved.params, True))
    np.testing.assert_allclose(action, own(jax.random.key(0), observations), atol=2e-5)


def test_networks_of_other_libraries_are_understood(tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d")
    layers = random_layers(6, 16, 8, 2)
    observations = np.random.default_rng(1).normal(size=(50, 6)).astype(np.float32)
    expected = observations
    for i, (kernel, bias) in enumerate(layers):
        expected = expected @ kernel + bias
        expected = np.maximum(expected, 0.0) if i < 2 else expected
    arrays = {f"kernel_{i}": kernel for i, (kernel, _) in enumerate(layers)}
    arrays |= {f"bias_{i}": bias for i, (_, bias) in enumerate(layers)}
    np.savez(tmp_path / "net.npz", **arrays)
    for path in (as_torch_writes_it(tmp_path / "net.onnx", layers), tmp_path / "net.npz"):
        _, agent, weights = read_foreign(path, env, "relu")
        action = agent.policy(env, weights, True)(jax.random.key(0), jnp.asarray(observations))
        np.testing.assert_allclose(action, expected, rtol=1e-4, atol=1e-4)


def test_discrete_networks_give_logits(tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d", actions="discrete")
    _, agent, weights = read_foreign(
        as_torch_writes_it(tmp_path / "net.onnx", random_layers(6, 8, 22)), env
    )
    action = agent.policy(env, weights, True)(jax.random.key(0), jnp.ones((3, 6)))
    assert action.shape == (3, 2)
    assert action.dtype == jnp.int32


@pytest.mark.thorough
def test_an_evaluation_of_it_is_that_of_the_original(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    exported("docking2d", tmp_path)
    words = ["episodes=20", "deterministic=true", "env.terminal.timeout.limit=60"]
    assert main(["run=docking2d.onnx", "env=docking2d", "out=theirs", *words]) == 0
    assert main(["run=pretrained/docking2d", "out=ours", *words]) == 0
    theirs, ours = (
        read_json(tmp_path / name / "results.json")["evaluation"]["deterministic"]
        for name in ("theirs", "ours")
    )
    for metric in ("average_return", "episode_length", "control_usage"):
        assert theirs[metric]["mean"] == pytest.approx(ours[metric]["mean"], rel=1e-3)


def test_a_discrete_network_is_evaluated_once_by_its_modes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    as_torch_writes_it(tmp_path / "net.onnx", random_layers(6, 8, 22))
    words = [
        "run=net.onnx",
        "env=docking2d",
        "actions=discrete",
        "episodes=2",
        "env.terminal.timeout.limit=10",
        "out=x",
    ]
    assert main(words) == 0
    assert list(read_json(tmp_path / "x" / "results.json")["evaluation"]) == ["deterministic"]


@pytest.mark.thorough
def test_its_closed_loop_goes_to_a_verifier(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    as_torch_writes_it(tmp_path / "net.onnx", random_layers(6, 8, 2))
    assert export(["run=net.onnx", "env=docking2d", "format=vnnlib", "steps=2"]) == 0
    graph = onnxruntime.InferenceSession("net_docking2d_closed_loop.onnx")
    start = np.array([[80.0, -60.0, 0.1, -0.05]], np.float32)
    state, timestep = jaxsafe.reset_to(
        env := jaxsafe.make("docking2d"),
        {"deputy": {"position": start[0, :2], "velocity": start[0, 2:]}},
    )
    margins = [timestep.info.margins["velocity_limit"]]
    (_, agent, weights) = read_foreign(tmp_path / "net.onnx", env)
    for _ in range(2):
        action = agent.policy(env, weights, True)(jax.random.key(0), timestep.observation[None])[0]
        state, timestep = jaxsafe.step(env, state, action)
        margins.append(timestep.info.margins["velocity_limit"])
    np.testing.assert_allclose(graph.run(None, {"input": start})[0], [margins], atol=1e-5)
    with pytest.raises(
        ConfigError,
        match=r"inputs: net.onnx has no network of jaxsafe; choose from observation, state",
    ):
        export(["run=net.onnx", "env=docking2d", "inputs=network"])


@pytest.mark.thorough
def test_changes_of_the_environment_come_before_what_a_network_must_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("four.npz", kernel_0=np.full((4, 2), 0.1), bias_0=np.zeros(2))
    words = ["run=four.npz", "env=docking2d", "env.observation=[position,velocity]"]
    short = ["episodes=2", "env.terminal.timeout.limit=5"]
    assert main([*words, *short, "variant=released", "rta=default", "out=x"]) == 0
    changes = read_json(tmp_path / "x" / "results.json")["changes"]
    assert changes["variant"] == "released"
    assert changes["rta"] == "default"
    assert changes["observation"] == ["position", "velocity"]
    assert export([*words, "out=four.onnx"]) == 0
    graph = onnxruntime.InferenceSession("four.onnx")
    np.testing.assert_allclose(
        graph.run(None, {"input": np.ones((1, 4), np.float32)})[0], [[0.4, 0.4]], rtol=1e-6
    )
    with pytest.raises(ConfigError, match=r"four\.npz: does not take an observation of 6 numbers"):
        main(["run=four.npz", "env=docking2d"])
    with pytest.raises(ConfigError, match=r"variant 'relesed'\. Did you mean 'released'\?"):
        main([*words, "variant=relesed"])


def graph_of(
    path: Path,
    *nodes: onnx.NodeProto,
    kind: int = TensorProto.FLOAT,
    opset: int = 17,
    **weights: Any,
) -> Path:
    """Write a graph from `obs`, six numbers, to `out`."""
    values = [
        helper.make_tensor_value_info("obs", kind, [1, 6]),
        helper.make_tensor_value_info("out", kind, ["n", "m"]),
    ]
    constants = [
        numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()
    ]
    graph = helper.make_graph(nodes, "net", values[:1], values[1:], constants)
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8), path
    )
    return path


def node(kind: str, names: str, results: str = "out", **attributes: Any) -> onnx.NodeProto:
    return helper.make_node(kind, names.split(), results.split(), **attributes)


LAST = node("Slice", "y begins ends axes")  # the first two of y
BOUNDS = {"begins": [0], "ends": [2], "axes": [1]}


@pytest.mark.parametrize(
    "nodes",
    [
        [node("Mod", "obs w", "y", fmod=1)],
        [node("Split", "obs", "y z", axis=1)],
        [node("Split", "obs", "a y z", axis=1)],
        [node("Split", "obs sizes", "z y", axis=1)],
        [node("Cast", "obs", "i", to=7), node("Div", "i three", "q"), node("Cast", "q", "y", to=1)],
        [node("Cast", "obs", "i", to=7), node("Mod", "i three", "q"), node("Cast", "q", "y", to=1)],
        [node("ReduceSum", "obs none", "sum"), node("Add", "obs sum", "y")],
        [node("Clip", "obs ! high", "y")],
    ],
    ids=lambda nodes: "-".join(operator.op_type for operator in nodes),
)
def test_operators_mean_what_the_runtime_means(nodes: list[onnx.NodeProto], tmp_path: Path) -> None:
    for operator in nodes:
        operator.input[:] = ["" if name == "!" else name for name in operator.input]
    extra = {
        "w": np.array([0.3], np.float32),
        "sizes": [2, 4],
        "three": [3],
        "none": np.array([], np.int64),
        "high": np.float32(0.5),
        **BOUNDS,
    }
    path = graph_of(tmp_path / "net.onnx", *nodes, LAST, **extra)
    observations = np.array(
        [[-1.0, -7.9, 2.5, -0.4, 4.0, 5.0], [7.1, 0.7, -2.5, 1.0, -4.0, 9.0]], np.float32
    )
    session = onnxruntime.InferenceSession(path)
    expected = [np.asarray(session.run(None, {"obs": row[None]})[0])[0] for row in observations]
    _, agent, weights = read_foreign(path, jaxsafe.make("docking2d"))
    computed = [agent.network(weights, jnp.asarray(row)) for row in observations]
    np.testing.assert_allclose(computed, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("nodes", "options", "message"),
    [
        ([node("Mod", "obs w", "y")], {}, "Mod of floats needs the attribute fmod=1"),
        (
            [node("Split", "obs sizes", "y z", axis=1)],
            {"sizes": [2, 9]},
            r"Split has sizes \[2, 9\] for 2 outputs",
        ),
        (
            [node("Split", "obs sizes", "y z", axis=1)],
            {"sizes": [9, -3]},
            r"Split has sizes \[9, -3\]",
        ),
        (
            [node("Split", "obs sizes", "y", axis=1)],
            {"sizes": [2, 4]},
            r"Split has sizes \[2, 4\] for 1 outputs",
        ),
        (
            [node("Identity", "obs", "y")],
            {"kind": TensorProto.INT64},
            "obs: expected an input of FLOAT, found INT64",
        ),
        ([node("Identity", "obs")], {"opset": 1}, "net.onnx: opset: expected 7 to"),
        (
            [node("Add", "obs w", "y")],
            {"w": np.array([1j], np.complex64)},
            "w: expected real numbers, found complex64",
        ),
        ([node("Constant", "", "c"), node("Add", "obs c", "y")], {}, "net.onnx: "),
        (
            [node("ReduceSum", "obs", "y", noop_with_empty_axes=1)],
            {},
            "the attribute noop_with_empty_axes=1 is not known",
        ),
        (
            [node("Expand", "obs shape", "y")],
            {"shape": [10**6, 10**6, 6]},
            "Expand makes an array of more than",
        ),
        (
            [node("Identity", "obs", "y", domain="else")],
            {},
            "net.onnx: cannot be read: No opset import for domain 'else'",
        ),
        ([node("Shape", "obs", "y")], {}, "the operator Shape is not known here"),
    ],
)
def test_graphs_that_are_not_what_they_seem_are_refused(
    nodes: list[onnx.NodeProto], options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    options = {"w": np.array([0.3], np.float32), **BOUNDS, **options}
    graph = graph_of(
        tmp_path / "net.onnx", *nodes, *([] if "opset" in options else [LAST]), **options
    )
    with pytest.raises(ConfigError, match=message) as caught:
        read_foreign(graph, jaxsafe.make("docking2d"))
    assert "\n" not in str(caught.value)


def test_a_damaged_graph_is_told(tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d")
    good = as_torch_writes_it(tmp_path / "x.onnx", random_layers(6, 4, 2)).read_bytes()
    model = onnx.load(tmp_path / "x.onnx")
    model.graph.initializer[0].data_type = 99
    (tmp_path / "x.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ConfigError, match=r"x\.onnx: cannot be read"):
        read_foreign(tmp_path / "x.onnx", env)
    model = onnx.load_from_string(good)
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 5
    (tmp_path / "x.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(
        ConfigError,
        match=r"does not take an observation of 6 numbers: its input is declared as \[0, 5\]",
    ):
        read_foreign(tmp_path / "x.onnx", env)
    draw = random.Random(0)
    for _ in range(40):
        damaged = bytearray(good)
        damaged[draw.randrange(len(good))] ^= 1 << draw.randrange(8)
        (tmp_path / "x.onnx").write_bytes(
            damaged[: draw.choice([len(good), draw.randrange(len(good))])]
        )
        with contextlib.suppress(ConfigError):  # any other error is a fault
            read_foreign(tmp_path / "x.onnx", env)


def test_constants_casts_and_extremes_are_understood(tmp_path: Path) -> None:
    graph = partial(graph_of, tmp_path / "net.onnx")
    low = helper.make_node("Constant", [], ["low"], value_float=0.25)
    high = helper.make_node("Constant", [], ["high"], value_floats=[0.5] * 6)
    ends = helper.make_node("Constant", [], ["ends"], value_ints=[2])
    begins = helper.make_node("Constant", [], ["begins"], value_ints=[0])
    axes = helper.make_node("Constant", [], ["axes"], value_ints=[1])
    clipped = [
        helper.make_node("Max", ["obs", "low", "low"], ["y"]),
        helper.make_node("Min", ["y", "high"], ["z"]),
    ]
    cut = helper.make_node("Slice", ["z", "begins", "ends", "axes"], ["out"])
    env = jaxsafe.make("docking2d")
    _, agent, weights = read_foreign(graph(low, high, begins, ends, axes, *clipped, cut), env)
    action = agent.policy(env, weights, True)(
        jax.random.key(0), jnp.array([[0.1, 0.4, 0.9, 0.0, 0.0, 0.0], [0.9] * 6])
    )
    np.testing.assert_allclose(action, [[0.25, 0.4], [0.5, 0.5]])
    words = [
        helper.make_node("Constant", [], ["a"], value_string="x"),
        helper.make_node("Identity", ["obs"], ["out"]),
    ]
    with pytest.raises(ConfigError, match="a constant of kind value_string is not known here"):
        read_foreign(graph(*words), env)
    casts = [
        helper.make_node("Cast", ["obs"], ["z"], to=10),
        helper.make_node("Cast", ["z"], ["out"], to=1),
    ]
    with pytest.raises(ConfigError, match="Cast to type 10 is not known here"):
        read_foreign(graph(*casts), env)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda path: as_torch_writes_it(path / "x.onnx", random_layers(5, 2)),
            "does not take an observation of 6 numbers",
        ),
        (
            lambda path: as_torch_writes_it(path / "x.onnx", random_layers(6, 3)),
            r"expected 2 outputs \(thrust_x, thrust_y\)",
        ),
        (lambda path: path / "none.onnx", "none.onnx: cannot be read: No such file or directory$"),
        (lambda path: path / "none.npz", "none.npz: cannot be read: No such file"),
    ],
)
def test_what_does_not_fit_is_named(make: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        read_foreign(make(tmp_path), jaxsafe.make("docking2d"))


def claim(path: Path, name: str, header: str, content: bytes = b"") -> None:
    """Put a member with a header of one's own into an archive."""
    text = header.encode().ljust(118) + b"\n"
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as file:
        file.writestr(
            f"{name}.npy", b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + content
        )


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (
            "{'descr': '<f4', 'fortran_order': False, 'shape': (10000000000000, 2)}",
            "does not take an observation of 6",
        ),
        (
            "{'descr': '<f4', 'fortran_order': False, 'shape': (6, 4000000000)}",
            "x.npz: expected 2 outputs",
        ),
        (
            "{'descr': '<f4', 'fortran_order': False, 'shape': (6, 2)}",
            "cannot be read: not an .npz of numbers",
        ),
        (
            "{'descr': '<c8', 'fortran_order': False, 'shape': (6, 2)}",
            "kernel_0: expected a matrix of numbers, found c",
        ),
        (
            "{'descr': '<f4', 'fortran_order': False, 'shape': (12,)}",
            r"expected a matrix of numbers, found float32 of",
        ),
        (
            "{'descr': '|O', 'fortran_order': False, 'shape': (6, 2)}",
            "expected a matrix of numbers, found object",
        ),
        ("{'descr': " + "[" * 60 + "}", "not an .npz of numbers"),
    ],
)
def test_arrays_that_claim_what_does_not_fit_are_not_read(
    header: str, message: str, tmp_path: Path
) -> None:
    claim(tmp_path / "x.npz", "kernel_0", header)
    claim(
        tmp_path / "x.npz",
        "bias_0",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (1,)}",
        b"\0\0\0\0",
    )
    with pytest.raises(ConfigError, match=message):
        read_foreign(tmp_path / "x.npz", jaxsafe.make("docking2d"))


def test_more_mistakes_are_named(tmp_path: Path) -> None:
    env = jaxsafe.make("docking2d")
    np.savez(tmp_path / "x.npz", w=np.ones(3))
    with pytest.raises(ConfigError, match="expected kernel_0, bias_0, kernel_1, …, found w"):
        read_foreign(tmp_path / "x.npz", env)
    with pytest.raises(
        ConfigError, match=r"activation: found 'gelu'\. Did you mean 'relu'\? Choose from"
    ):
        read_foreign(tmp_path / "x.npz", env, "gelu")
    with pytest.raises(ConfigError, match=r"env: missing; the task in which x\.onnx shall act"):
        main(["run=x.onnx"])
    with pytest.raises(ConfigError, match="deterministic: expected true or nothing, found False"):
        main(["run=x.onnx", "env=docking2d", "deterministic=false"])
    np.savez(tmp_path / "layers.npz", kernel_0=np.ones((6, 2)), bias_0=np.ones(2))
    with pytest.raises(
        ConfigError, match=r"env: missing; the task in which .*layers\.npz shall act"
    ):
        main([f"run={tmp_path / 'layers.npz'}"])
    with pytest.raises(ConfigError, match="checkpoint: means nothing for a policy from elsewhere"):
        main(["run=x.npz", "env=docking2d", "checkpoint=best"])
    for words in (["run=x.onnx", "env=docking2d"], ["run=pretrained/docking2d"]):
        with pytest.raises(
            ConfigError,
            match=r"activation: means nothing but for the layers in an \.npz with env=TASK",
        ):
            main([*words, "activation=relu"])
    node = helper.make_node("Erf", ["obs"], ["out"])
    values = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 6]) for name in ("obs", "out")
    ]
    onnx.save(
        helper.make_model(helper.make_graph([node], "net", values[:1], values[1:])),
        tmp_path / "erf.onnx",
    )
    with pytest.raises(ConfigError, match="the operator Erf is not known here"):
        read_foreign(tmp_path / "erf.onnx", env)
