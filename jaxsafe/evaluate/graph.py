"""ONNX graphs as functions: operator by operator what networks of other libraries are made of."""
# pyright: reportMissingImports=false

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsafe.errors import ConfigError, missing

Network = Callable[[Mapping[str, Array], Float[Array, " o"]], Float[Array, " a"]]
"""From weights and one observation to one output."""


def read_graph(path: Path) -> tuple[Network, dict[str, np.ndarray]]:
    """The function of a graph with one input and one output, and its weights.

    Raises:
        ConfigError: the file cannot be read, or has more inputs, outputs, or an operator that is not known.
    """
    try:
        import onnx
        from onnx import numpy_helper
    except ImportError as error:
        raise missing(error, "onnx", "export") from None
    try:
        model = onnx.load(path)
        onnx.checker.check_model(model)
    except Exception as error:  # protobuf, the checker and the file system have errors of their own
        raise ConfigError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None
    graph = model.graph
    weights = {one.name: numpy_helper.to_array(one) for one in graph.initializer}
    inputs = [one for one in graph.input if one.name not in weights]
    if len(inputs) != 1 or len(graph.output) != 1:
        raise ConfigError(f"{path}: expected one input and one output, found {len(inputs)} and {len(graph.output)}")
    rank = len(inputs[0].type.tensor_type.shape.dim)
    nodes = [
        (
            node.op_type,
            list(node.input),
            list(node.output),
            {one.name: onnx.helper.get_attribute_value(one) for one in node.attribute},
        )
        for node in graph.node
    ]
    for kind, *_ in nodes:
        if kind not in _OPERATORS and kind not in ("Constant", "Split"):
            raise ConfigError(f"{path}: the operator {kind} is not known here")
    constants = {
        outputs[0]: numpy_helper.to_array(attributes["value"]) if "value" in attributes else _constant(path, attributes)
        for kind, _, outputs, attributes in nodes
        if kind == "Constant"
    }
    # what says shapes and axes must be known while tracing; what computes are the weights
    whole = {name: value for name, value in {**weights, **constants}.items() if value.dtype.kind in "iu"}
    floats = {name: value for name, value in {**weights, **constants}.items() if value.dtype.kind not in "iu"}

    def network(weights: Mapping[str, Array], observation: Array) -> Array:
        values: dict[str, Any] = {**whole, **weights, inputs[0].name: observation.reshape((1,) * (rank - 1) + (-1,))}
        for kind, names, outputs, attributes in nodes:
            if kind == "Constant":
                continue
            given: list[Any] = [values[name] if name else None for name in names]
            if kind == "Split":
                ends = np.cumsum(given[1] if len(given) > 1 else attributes["split"])[:-1]
                results = jnp.split(given[0], ends, axis=attributes.get("axis", 0))
            else:
                results = [_OPERATORS[kind](given, attributes)]
            values |= dict(zip(outputs, results, strict=True))
        return values[graph.output[0].name].ravel()

    return network, floats


def _constant(path: Path, attributes: Mapping[str, Any]) -> np.ndarray:
    """A constant that is given as one number or a list."""
    [(kind, value)] = attributes.items()
    types = {"value_float": np.float32, "value_floats": np.float32, "value_int": np.int64, "value_ints": np.int64}
    if kind not in types:
        raise ConfigError(f"{path}: a constant of kind {kind} is not known here")
    return np.asarray(value, types[kind])


def _cast(x: list[Any], a: Mapping[str, Any]) -> Array:
    known = {1: jnp.float32, 6: jnp.int32, 7: jnp.int32, 9: bool, 11: jnp.float32}
    if a["to"] not in known:
        raise TypeError(f"Cast to type {a['to']} is not known here")
    return x[0].astype(known[a["to"]])


def _gemm(x: list[Any], a: Mapping[str, Any]) -> Array:
    left, right = (x[0].T if a.get("transA") else x[0]), (x[1].T if a.get("transB") else x[1])
    product = a.get("alpha", 1.0) * (left @ right)
    return product if len(x) < 3 else product + a.get("beta", 1.0) * x[2]


def _slice(x: list[Any], a: Mapping[str, Any]) -> Array:
    begin, end = (x[1], x[2]) if len(x) > 2 else (a["starts"], a["ends"])
    axes = x[3] if len(x) > 3 else a.get("axes", range(len(begin)))
    steps = x[4] if len(x) > 4 else [1] * len(begin)
    index = [slice(None)] * x[0].ndim
    for one, *bounds in zip(axes, begin, end, steps, strict=True):
        index[int(one)] = slice(*map(int, bounds))
    return x[0][tuple(index)]


def _axes(x: list[Any], a: Mapping[str, Any]) -> Any:
    axes = x[1] if len(x) > 1 and x[1] is not None else a.get("axes")
    return None if axes is None else tuple(int(axis) for axis in axes)


def _reshape(x: list[Any], a: Mapping[str, Any]) -> Array:
    shape = [x[0].shape[i] if size == 0 else int(size) for i, size in enumerate(x[1])]
    return x[0].reshape(shape)


def _clip(x: list[Any], a: Mapping[str, Any]) -> Array:
    low = x[1] if len(x) > 1 else a.get("min")
    high = x[2] if len(x) > 2 else a.get("max")
    return jnp.clip(x[0], low, high)


_ELEMENTWISE = {
    "Add": jnp.add, "Sub": jnp.subtract, "Mul": jnp.multiply, "Div": jnp.divide, "Pow": jnp.power,
    "Neg": jnp.negative, "Exp": jnp.exp, "Log": jnp.log, "Sqrt": jnp.sqrt, "Tanh": jnp.tanh,
    "Abs": jnp.abs, "Sin": jnp.sin, "Cos": jnp.cos, "Atan": jnp.arctan, "Relu": jax.nn.relu, "Sigmoid": jax.nn.sigmoid,
    "Softplus": jax.nn.softplus, "Identity": lambda x: x, "Where": jnp.where, "Not": jnp.logical_not,
    "And": jnp.logical_and, "Or": jnp.logical_or, "Less": jnp.less, "Greater": jnp.greater, "LessOrEqual": jnp.less_equal,
    "GreaterOrEqual": jnp.greater_equal, "Equal": jnp.equal, "Sign": jnp.sign, "Round": jnp.round, "Floor": jnp.floor,
    "MatMul": jnp.matmul, "Mod": jnp.mod,
}  # fmt: skip
_OPERATORS: Mapping[str, Callable[[list[Any], Mapping[str, Any]], Any]] = {
    **{name: lambda x, a, f=function: f(*x) for name, function in _ELEMENTWISE.items()},
    "Gemm": _gemm,
    "Slice": _slice,
    "Reshape": _reshape,
    "Clip": _clip,
    "LeakyRelu": lambda x, a: jax.nn.leaky_relu(x[0], a.get("alpha", 0.01)),
    "Elu": lambda x, a: jax.nn.elu(x[0], a.get("alpha", 1.0)),
    "Flatten": lambda x, a: x[0].reshape(int(np.prod(x[0].shape[: a.get("axis", 1)])), -1),
    "Concat": lambda x, a: jnp.concatenate(x, axis=a["axis"]),
    "Unsqueeze": lambda x, a: jnp.expand_dims(x[0], _axes(x, a)),
    "Squeeze": lambda x, a: jnp.squeeze(x[0], _axes(x, a)),
    "Expand": lambda x, a: x[0] * jnp.ones([int(n) for n in x[1]], x[0].dtype),
    "Transpose": lambda x, a: jnp.transpose(x[0], a.get("perm")),
    "Cast": _cast,
    "Max": lambda x, a: functools.reduce(jnp.maximum, x),
    "Min": lambda x, a: functools.reduce(jnp.minimum, x),
    "ReduceSum": lambda x, a: jnp.sum(x[0], axis=_axes(x, a), keepdims=bool(a.get("keepdims", 1))),
    "ReduceMax": lambda x, a: jnp.max(x[0], axis=_axes(x, a), keepdims=bool(a.get("keepdims", 1))),
    "ArgMax": lambda x, a: jnp.argmax(x[0], axis=a.get("axis", 0), keepdims=bool(a.get("keepdims", 1))),
    "Reciprocal": lambda x, a: 1.0 / x[0],
}
