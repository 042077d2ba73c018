"""ONNX graphs as functions, evaluated operator by operator.

The operators are those that the networks of other libraries are made of.
"""
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

from jaxsafe.schema.errors import ConfigError, missing, show

Network = Callable[[Mapping[str, Array], Float[Array, " o"]], Float[Array, " a"]]
"""A function from weights and one observation to one output."""

DOMAINS = ("", "ai.onnx")
"""The domains of ONNX itself.

An operator of another domain may have the name of one of ONNX's and mean something else.
"""

MIN_OPSET = 7
"""The oldest opset that is read. Older opsets match the shapes of operands by an attribute."""

MAX_NODES = 10_000
"""Most operators of a graph. Without a bound a small file could ask for any amount of work."""

MAX_SIZE = 2**26
"""Most numbers of an array that an operator makes.

Without a bound a small file could ask for any amount of memory.
"""


def read_graph(path: Path) -> tuple[Network, dict[str, np.ndarray]]:
    """Return the function of a graph with one input and one output, and its weights.

    Raises:
        ConfigError: the file cannot be read, has several inputs or outputs, or has an operator that
            is not known.
    """
    try:
        import onnx
        from onnx import numpy_helper
    except ImportError as error:
        raise missing(error, "onnx", "export") from None
    try:
        model = onnx.load(path)
        onnx.checker.check_model(model)
        nodes = [_node(path, node) for node in model.graph.node]
        initializers = {item.name: numpy_helper.to_array(item) for item in model.graph.initializer}
        constants = {
            outputs[0]: _constant(path, attributes)
            for kind, _, outputs, attributes in nodes
            if kind == "Constant"
        }
    except ConfigError:
        raise
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None
    # protobuf, the checker and numpy have errors of their own.
    except Exception as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise ConfigError(f"{path}: cannot be read: {reason}") from None
    graph = model.graph
    for opset in model.opset_import:
        newest = onnx.defs.onnx_opset_version()
        if opset.domain in DOMAINS and not MIN_OPSET <= opset.version <= newest:
            raise ConfigError(
                f"{path}: opset: expected {MIN_OPSET} to {newest}, found {opset.version}"
            )
    inputs = [declared for declared in graph.input if declared.name not in initializers]
    if len(inputs) != 1 or len(graph.output) != 1:
        raise ConfigError(
            f"{path}: expected one input and one output, "
            f"found {len(inputs)} and {len(graph.output)}"
        )
    [declared] = inputs
    kind = declared.type.tensor_type.elem_type
    if kind not in (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE, onnx.TensorProto.FLOAT16):
        known = kind in onnx.TensorProto.DataType.values()
        found = onnx.TensorProto.DataType.Name(kind) if known else kind
        raise ConfigError(f"{path}: {declared.name}: expected an input of FLOAT, found {found}")
    # The size of an axis is 0 where the axis has a name instead.
    sizes = [axis.dim_value for axis in declared.type.tensor_type.shape.dim]
    if len(nodes) > MAX_NODES:
        raise ConfigError(f"{path}: expected at most {MAX_NODES:,} operators, found {len(nodes):,}")
    arrays = {**initializers, **constants}
    for name, array in arrays.items():
        if array.dtype.kind not in "iub" and not jnp.issubdtype(array.dtype, jnp.floating):
            raise ConfigError(f"{path}: {name}: expected real numbers, found {array.dtype}")
    # Integers give shapes and axes, so they must be known while tracing. The other arrays are the
    # weights.
    integers = {name: array for name, array in arrays.items() if array.dtype.kind in "iu"}
    weights = {name: array for name, array in arrays.items() if name not in integers}

    def network(weights: Mapping[str, Array], observation: Array) -> Array:
        if any(size > 1 for size in sizes[:-1]) or (
            sizes and sizes[-1] not in (0, observation.size)
        ):
            raise TypeError(f"its input is declared as {sizes}")
        values: dict[str, Any] = {
            **integers,
            **weights,
            declared.name: observation.reshape((1,) * (len(sizes) - 1) + (-1,)),
        }
        for kind, names, outputs, attributes in nodes:
            if kind == "Constant":
                continue
            given: list[Any] = [values[name] if name else None for name in names]
            results = (
                _split(given, attributes, len(outputs))
                if kind == "Split"
                else [_OPERATORS[kind](given, attributes)]
            )
            if any(result.size > MAX_SIZE for result in results):
                raise TypeError(f"{kind} makes an array of more than {MAX_SIZE:,} numbers")
            values |= dict(zip(outputs, results, strict=True))
        return values[graph.output[0].name].ravel()

    return network, weights


def _node(path: Path, node: Any) -> tuple[str, list[str], list[str], dict[str, Any]]:
    """Return the kind, inputs, outputs and attributes of an operator.

    Raises:
        ConfigError: the operator or one of its attributes is not known here.
    """
    from onnx import helper

    kind = node.op_type
    if kind not in (*_OPERATORS, "Constant", "Split") or node.domain not in DOMAINS:
        raise ConfigError(f"{path}: the operator {kind} is not known here")
    attributes = {item.name: helper.get_attribute_value(item) for item in node.attribute}
    for name, value in attributes.items():
        if name not in _ATTRIBUTES.get(kind, "").split() and value != 0:
            raise ConfigError(
                f"{path}: {kind}: the attribute {name}={show(value)} is not known here"
            )
    return kind, list(node.input), list(node.output), attributes


def _constant(path: Path, attributes: Mapping[str, Any]) -> np.ndarray:
    """Return the value of a constant, given as an array, one number, or a list.

    Raises:
        ConfigError: the constant is of another kind.
    """
    from onnx import numpy_helper

    if len(attributes) != 1:
        raise ConfigError(
            f"{path}: Constant: expected one attribute, found {', '.join(attributes) or 'nothing'}"
        )
    [(kind, value)] = attributes.items()
    if kind == "value":
        return numpy_helper.to_array(value)
    types = {
        "value_float": np.float32,
        "value_floats": np.float32,
        "value_int": np.int64,
        "value_ints": np.int64,
    }
    if kind not in types:
        raise ConfigError(f"{path}: a constant of kind {kind} is not known here")
    return np.asarray(value, types[kind])


def _split(x: list[Any], a: Mapping[str, Any], count: int) -> list[Array]:
    """Cut an array into parts of given sizes, or into `count` equal parts."""
    axis = a.get("axis", 0)
    given = x[1] if len(x) > 1 and x[1] is not None else a.get("split")
    length = x[0].shape[axis]
    part = -(-length // count)  # if the parts cannot be equal, the last ones are smaller
    equal = [min(part, max(0, length - i * part)) for i in range(count)]
    sizes = equal if given is None else [int(size) for size in given]
    if len(sizes) != count or min(sizes) < 0 or sum(sizes) != length:
        raise TypeError(f"Split has sizes {sizes} for {count} outputs of an axis of {length}")
    return jnp.split(x[0], np.cumsum(sizes)[:-1], axis=axis)


def _mod(x: list[Any], a: Mapping[str, Any]) -> Array:
    """Return a remainder.

    With the attribute `fmod` it has the sign of the dividend, otherwise that of the divisor. Floats
    need `fmod`.
    """
    if a.get("fmod", 0):
        return jnp.fmod(*x)
    if any(jnp.issubdtype(jnp.result_type(operand), jnp.floating) for operand in x):
        raise TypeError("Mod of floats needs the attribute fmod=1")
    return jnp.mod(*x)


def _divide(x: list[Any], a: Mapping[str, Any]) -> Array:
    """Return a quotient. A quotient of integers is rounded towards 0."""
    if all(jnp.issubdtype(jnp.result_type(operand), jnp.integer) for operand in x):
        return jnp.sign(x[0]) * jnp.sign(x[1]) * (jnp.abs(x[0]) // jnp.abs(x[1]))
    return jnp.divide(*x)


def _cast(x: list[Any], a: Mapping[str, Any]) -> Array:
    # The numbers are those of onnx.TensorProto: float, int32, int64, bool and double.
    types = {1: jnp.float32, 6: jnp.int32, 7: jnp.int32, 9: bool, 11: jnp.float32}
    if a["to"] not in types:
        raise TypeError(f"Cast to type {a['to']} is not known here")
    return x[0].astype(types[a["to"]])


def _gemm(x: list[Any], a: Mapping[str, Any]) -> Array:
    left = x[0].T if a.get("transA") else x[0]
    right = x[1].T if a.get("transB") else x[1]
    product = a.get("alpha", 1.0) * (left @ right)
    return product if len(x) < 3 else product + a.get("beta", 1.0) * x[2]


def _slice(x: list[Any], a: Mapping[str, Any]) -> Array:
    begin, end = (x[1], x[2]) if len(x) > 2 else (a["starts"], a["ends"])
    axes = x[3] if len(x) > 3 else a.get("axes", range(len(begin)))
    steps = x[4] if len(x) > 4 else [1] * len(begin)
    index = [slice(None)] * x[0].ndim
    for axis, *bounds in zip(axes, begin, end, steps, strict=True):
        index[int(axis)] = slice(*map(int, bounds))
    return x[0][tuple(index)]


def _axes(x: list[Any], a: Mapping[str, Any]) -> Any:
    axes = x[1] if len(x) > 1 and x[1] is not None else a.get("axes")
    return None if axes is None else tuple(int(axis) for axis in axes)


def _reduced(x: list[Any], a: Mapping[str, Any]) -> Any:
    return _axes(x, a) or None  # without axes the reduction is over all of them


def _reshape(x: list[Any], a: Mapping[str, Any]) -> Array:
    kept = not a.get("allowzero", 0)
    shape = [x[0].shape[i] if size == 0 and kept else int(size) for i, size in enumerate(x[1])]
    return x[0].reshape(shape)


def _clip(x: list[Any], a: Mapping[str, Any]) -> Array:
    low = x[1] if len(x) > 1 else a.get("min")
    high = x[2] if len(x) > 2 else a.get("max")
    return jnp.clip(x[0], low, high)


_ELEMENTWISE = {
    "Add": jnp.add,
    "Sub": jnp.subtract,
    "Mul": jnp.multiply,
    "Pow": jnp.power,
    "Neg": jnp.negative,
    "Exp": jnp.exp,
    "Log": jnp.log,
    "Sqrt": jnp.sqrt,
    "Tanh": jnp.tanh,
    "Abs": jnp.abs,
    "Sin": jnp.sin,
    "Cos": jnp.cos,
    "Atan": jnp.arctan,
    "Asinh": jnp.arcsinh,
    "Relu": jax.nn.relu,
    "Sigmoid": jax.nn.sigmoid,
    "Softplus": jax.nn.softplus,
    "Identity": lambda x: x,
    "Where": jnp.where,
    "Not": jnp.logical_not,
    "And": jnp.logical_and,
    "Or": jnp.logical_or,
    "Less": jnp.less,
    "Greater": jnp.greater,
    "LessOrEqual": jnp.less_equal,
    "GreaterOrEqual": jnp.greater_equal,
    "Equal": jnp.equal,
    "Sign": jnp.sign,
    "Round": jnp.round,
    "Floor": jnp.floor,
    "MatMul": jnp.matmul,
}
_OPERATORS: Mapping[str, Callable[[list[Any], Mapping[str, Any]], Any]] = {
    **{name: lambda x, a, f=function: f(*x) for name, function in _ELEMENTWISE.items()},
    "Div": _divide,
    "Mod": _mod,
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
    "ReduceSum": lambda x, a: jnp.sum(
        x[0], axis=_reduced(x, a), keepdims=bool(a.get("keepdims", 1))
    ),
    "ReduceMax": lambda x, a: jnp.max(
        x[0], axis=_reduced(x, a), keepdims=bool(a.get("keepdims", 1))
    ),
    "ArgMax": lambda x, a: jnp.argmax(
        x[0], axis=a.get("axis", 0), keepdims=bool(a.get("keepdims", 1))
    ),
    "Reciprocal": lambda x, a: 1.0 / x[0],
}

_ATTRIBUTES: Mapping[str, str] = {
    "Constant": "value value_float value_floats value_int value_ints value_string",
    "Split": "axis split num_outputs",
    "Gemm": "alpha beta transA transB",
    "Slice": "axes starts ends",
    "Reshape": "allowzero",
    "Clip": "min max",
    "LeakyRelu": "alpha",
    "Elu": "alpha",
    "Flatten": "axis",
    "Concat": "axis",
    "Unsqueeze": "axes",
    "Squeeze": "axes",
    "Transpose": "perm",
    "Cast": "to saturate round_mode",
    "ReduceSum": "axes keepdims",
    "ReduceMax": "axes keepdims",
    "ArgMax": "axis keepdims",
    "Mod": "fmod",
}
"""The attributes that are understood, by operator.

Any other attribute may only be 0, its default in each of these operators.
"""
