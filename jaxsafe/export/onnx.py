"""Conversion of JAX functions to ONNX graphs.

Each primitive becomes the ONNX operators that compute the same. The policies, features and dynamics
of the tasks consist of primitives that are known here. Any other primitive is refused by name. A
graph has fixed shapes, opset 17 and float32, because verifiers and small runtimes understand these.
"""
# pyright: reportMissingImports=false

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.interpreters import partial_eval

from jaxsafe.schema.errors import ConfigError, missing
from jaxsafe.storage.files import write_bytes

try:
    from onnx import TensorProto, checker, helper, numpy_helper
except ImportError as error:
    raise missing(error, "onnx", "export") from None

OPSET = 17
"""Version of the ONNX operators. Verifiers and small runtimes understand it."""

MAX_ROUNDS = 1000
"""Most rounds of a loop. A graph has no loops, so the rounds are written one after another."""

_SAME = {
    "add": "Add",
    "add_any": "Add",
    "sub": "Sub",
    "mul": "Mul",
    "div": "Div",
    "max": "Max",
    "min": "Min",
    "neg": "Neg",
    "exp": "Exp",
    "log": "Log",
    "sqrt": "Sqrt",
    "tanh": "Tanh",
    "abs": "Abs",
    "sin": "Sin",
    "cos": "Cos",
    "atan": "Atan",
    "asinh": "Asinh",
    "sign": "Sign",
    "floor": "Floor",
    "round": "Round",
    "lt": "Less",
    "gt": "Greater",
    "le": "LessOrEqual",
    "ge": "GreaterOrEqual",
    "eq": "Equal",
    "and": "And",
    "or": "Or",
    "not": "Not",
    "copy": "Identity",
    "stop_gradient": "Identity",
    "logistic": "Sigmoid",
    "pow": "Pow",
}
"""ONNX operators of primitives that have the same arguments, by name of the primitive."""

_INSIDE = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}
"""The parameter that holds the inner jaxpr, by name of the primitive that calls it."""

_TYPES = {
    "float32": TensorProto.FLOAT,
    "float64": TensorProto.FLOAT,
    "int32": TensorProto.INT32,
    "int64": TensorProto.INT32,
    "bool": TensorProto.BOOL,
}
"""ONNX types by JAX's dtype. The graph has single precision even if JAX computes in double."""

_NARROW = {"float64": np.float32, "int64": np.int32}
"""Dtypes that constants get in the graph, by the wider ones that they have in JAX."""


def write_onnx(
    path: Path, function: Callable[[Any], Any], shape: Sequence[int], about: dict[str, str]
) -> Path:
    """Write a function as an ONNX file, and check it.

    The graph has one input, `input`, and one output, `output`.

    Args:
        path: the file.
        function: a function of one float array.
        shape: the shape of that array.
        about: metadata of the file.

    Returns:
        The path of the file.

    Raises:
        ConfigError: the function contains a primitive that has no counterpart here.
    """
    model = to_onnx(function, shape)
    helper.set_model_props(model, about)
    write_bytes(path, model.SerializeToString())
    return path


def to_onnx(function: Callable[[Any], Any], shape: Sequence[int]) -> Any:
    """Return the checked ONNX model of a function.

    Args:
        function: a function of one float array.
        shape: the shape of that array.

    Raises:
        ConfigError: the function contains a primitive that has no counterpart here.
    """
    closed = jax.make_jaxpr(function)(jax.ShapeDtypeStruct(shape, jnp.float32))
    # Primitives whose results nothing needs are left out, because they need no counterpart.
    jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True], instantiate=True)
    graph = _Graph()
    [output] = graph.inline(jaxpr, closed.consts, ["input"])
    graph.node("Identity", [output], "output")
    graph.prune("output")
    [result] = closed.out_avals
    graph_proto = helper.make_graph(
        graph.nodes,
        "jaxsafe",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("output", _TYPES[result.dtype.name], result.shape)],
        graph.constants,
    )
    model = helper.make_model(
        graph_proto,
        opset_imports=[helper.make_opsetid("", OPSET)],
        producer_name="jaxsafe",
        ir_version=8,
    )
    checker.check_model(model, full_check=True)
    return model


def _loop_counts(params: Any) -> tuple[int, int]:
    """Return how many inputs of a loop stay as they are, and how many it carries on."""
    if "ft_in" in params:  # from JAX 0.12 on
        consts, carry, _ = params["ft_in"].unpack()
        return len(consts), len(carry)
    return params["num_consts"], params["num_carry"]


class _Graph:
    """An ONNX graph that is being built. Constants and results of nodes are known by name."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._count = 0
        self._signs: set[str] = set()

    def node(
        self, kind: str, inputs: Sequence[str], output: str | None = None, **attributes: Any
    ) -> str:
        """Add a node, and return the name of its output."""
        output = output or self._name()
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def constant(self, value: Any) -> str:
        """Add a constant, and return its name."""
        array = np.asarray(value)
        return self._initializer(array.astype(_NARROW.get(array.dtype.name, array.dtype)))

    def integers(self, *values: int) -> str:
        """Add shapes, axes or bounds, and return their name. Unlike data they stay 64 bits wide."""
        return self._initializer(np.array(values, np.int64))

    def _initializer(self, array: np.ndarray) -> str:
        name = self._name()
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def inline(self, jaxpr: Any, consts: Sequence[Any], inputs: Sequence[str]) -> list[str]:
        """Add the equations of a jaxpr, and return the names of its results.

        Args:
            jaxpr: the jaxpr.
            consts: the values of its constants.
            inputs: the names of its inputs in the graph.
        """
        names: dict[Any, str] = dict(zip(jaxpr.invars, inputs, strict=True))
        names |= {
            var: self.constant(value) for var, value in zip(jaxpr.constvars, consts, strict=True)
        }

        def read(atom: Any) -> str:
            return self.constant(atom.val) if isinstance(atom, core.Literal) else names[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            names |= dict(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def prune(self, output: str) -> None:
        """Remove nodes and constants that the output does not need."""
        needed = {output}
        kept = []
        for node in reversed(self.nodes):
            if needed & set(node.output):
                needed |= set(node.input)
                kept.append(node)
        self.nodes = kept[::-1]
        self.constants = [constant for constant in self.constants if constant.name in needed]

    def _name(self) -> str:
        self._count += 1
        return f"x{self._count}"

    def _equation(self, equation: Any, inputs: list[str]) -> list[str]:
        """Add one equation, and return the names of its results."""
        kind = equation.primitive.name
        params = equation.params
        if kind in _INSIDE:
            inner = params[_INSIDE[kind]]
            return self.inline(inner.jaxpr, inner.consts, inputs)
        if kind == "bitcast_convert_type" or self._signs.intersection(inputs):
            return [self._sign_bit(kind, inputs, equation)]
        if kind == "optimization_barrier":
            return inputs
        if kind == "scan":
            return self._rounds(inputs, params)
        if kind == "and" and equation.outvars[0].aval.dtype != bool:
            return [self._masked(inputs[0], equation.invars[1])]
        if kind in _SAME:
            return [self.node(_SAME[kind], inputs)]
        if kind == "split":
            return self._pieces(inputs[0], params["sizes"], params["axis"])
        if kind == "unstack":
            pieces = self._pieces(inputs[0], [1] * len(equation.outvars), params["axis"])
            shape = self.integers(*equation.outvars[0].aval.shape)
            return [self.node("Reshape", [piece, shape]) for piece in pieces]
        translate = getattr(self, f"_{kind}", None)
        if translate is None:
            raise ConfigError(f"onnx: {kind!r} has no counterpart here")
        shapes = [tuple(atom.aval.shape) for atom in equation.invars]
        return [translate(inputs, shapes, equation.outvars[0].aval, params)]

    def _pieces(self, whole: str, sizes: Sequence[int], axis: int) -> list[str]:
        """Split an array along an axis into pieces of these sizes, and return their names."""
        results = [self._name() for _ in sizes]
        self.nodes.append(
            helper.make_node("Split", [whole, self.integers(*sizes)], results, axis=axis)
        )
        return results

    def _rounds(self, inputs: list[str], params: Any) -> list[str]:
        """Add all rounds of a loop of known length, and return the names of its results.

        Raises:
            ConfigError: the loop is too long.
        """
        length = params["length"]
        if length > MAX_ROUNDS:
            raise ConfigError(
                f"onnx: a loop of {length:,} rounds has no counterpart here, which writes at most"
                f" {MAX_ROUNDS:,} rounds one after another"
            )
        num_consts, num_carry = _loop_counts(params)
        consts = inputs[:num_consts]
        carry = inputs[num_consts : num_consts + num_carry]
        whole = inputs[num_consts + num_carry :]
        rounds = range(length)[::-1] if params["reverse"] else range(length)
        body = params["jaxpr"]
        given = {}
        for index in rounds:
            ends = (self.integers(index), self.integers(index + 1), self.integers(0))
            pieces = [self.node("Slice", [name, *ends]) for name in whole]
            pieces = [self.node("Squeeze", [name, self.integers(0)]) for name in pieces]
            results = self.inline(body.jaxpr, body.consts, [*consts, *carry, *pieces])
            carry = results[: len(carry)]
            given[index] = results[len(carry) :]
        stacked = [
            self._stack(list(names), None, None, {})
            for names in zip(*(given[index] for index in range(length)), strict=True)
        ]
        return [*carry, *stacked]

    def _sign_bit(self, kind: str, inputs: list[str], equation: Any) -> str:
        """Return integers that stand for the bits of floats, or the sign bit of these integers.

        ONNX has no access to bits. JAX's functions only ask for the sign, so the integer is −1 for
        a negative float and 0 for any other. The sign of −0 is lost.

        Raises:
            ConfigError: something else than the sign is asked for.
        """
        kinds = [str(atom.aval.dtype) for atom in (equation.invars[0], equation.outvars[0])]
        if kind == "bitcast_convert_type" and kinds == ["float32", "int32"]:
            negative = self.node("Less", [inputs[0], self.constant(np.float32(0.0))])
            sign = self.node("Neg", [self.node("Cast", [negative], to=TensorProto.INT32)])
            self._signs.add(sign)
            return sign
        by = equation.invars[-1]
        shifted = kind == "shift_right_arithmetic" and isinstance(by, core.Literal)
        if shifted and by.val == 31:
            return self.node("Identity", inputs[:1])
        raise ConfigError(f"onnx: {kind!r} of the bits of a number has no counterpart here")

    def _masked(self, whole: str, mask: Any) -> str:
        """Return one bit m of integers x as (x mod 2m) − (x mod m).

        ONNX has bitwise operators only from opset 18 on.

        Raises:
            ConfigError: the mask is not a constant with one bit.
        """
        bit = int(mask.val) if isinstance(mask, core.Literal) else 0
        if bit <= 0 or bit & (bit - 1):
            raise ConfigError("onnx: 'and' of whole numbers has a counterpart for one bit only")
        high, low = (self.node("Mod", [whole, self.constant(np.int32(n))]) for n in (2 * bit, bit))
        return self.node("Sub", [high, low])

    def _iota(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        axis = params["dimension"]
        along = np.arange(out.shape[axis]).reshape(
            [-1 if i == axis else 1 for i in range(len(out.shape))]
        )
        return self.constant(np.broadcast_to(along, out.shape).astype(out.dtype))

    def _ne(self, inputs: list[str], *_: Any) -> str:
        return self.node("Not", [self.node("Equal", inputs)])

    def _is_finite(self, inputs: list[str], *_: Any) -> str:
        return self.node("Less", [self.node("Abs", inputs), self.constant(np.float32(np.inf))])

    def _square(self, inputs: list[str], *_: Any) -> str:
        return self.node("Mul", [inputs[0], inputs[0]])

    def _integer_pow(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        return self.node("Pow", [inputs[0], self.constant(np.float32(params["y"]))])

    def _rsqrt(self, inputs: list[str], *_: Any) -> str:
        return self.node("Reciprocal", [self.node("Sqrt", inputs)])

    def _clamp(self, inputs: list[str], *_: Any) -> str:
        return self.node("Min", [self.node("Max", [inputs[1], inputs[0]]), inputs[2]])

    def _select_n(self, inputs: list[str], *_: Any) -> str:
        return self.node("Where", [inputs[0], inputs[2], inputs[1]])

    def _convert_element_type(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        return self.node("Cast", inputs, to=_TYPES[out.dtype.name])

    def _concatenate(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        return self.node("Concat", inputs, axis=params["dimension"])

    def _stack(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        axis = params.get("axis", params.get("dimension", 0))
        return self.node(
            "Concat",
            [self.node("Unsqueeze", [name, self.integers(axis)]) for name in inputs],
            axis=axis,
        )

    def _reshape(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        return self.node("Reshape", [inputs[0], self.integers(*out.shape)])

    _squeeze = _expand_dims = _reshape

    def _broadcast_in_dim(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        aligned = [1] * len(out.shape)
        for size, axis in zip(shapes[0], params["broadcast_dimensions"], strict=True):
            aligned[axis] = size
        reshaped = self.node("Reshape", [inputs[0], self.integers(*aligned)])
        return (
            reshaped
            if tuple(aligned) == out.shape
            else self.node("Expand", [reshaped, self.integers(*out.shape)])
        )

    def _slice(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        begin = params["start_indices"]
        end = params["limit_indices"]
        axes = range(len(begin))
        strides = params["strides"] or [1] * len(begin)
        bounds = (self.integers(*values) for values in (begin, end, axes, strides))
        return self.node("Slice", [inputs[0], *bounds])

    def _transpose(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        return self.node("Transpose", inputs, perm=list(params["permutation"]))

    def _reduce_sum(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        return self.node("ReduceSum", [inputs[0], self.integers(*params["axes"])], keepdims=0)

    def _reduce_max(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        return self.node("ReduceMax", inputs, axes=list(params["axes"]), keepdims=0)

    def _argmax(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        [axis] = params["axes"]
        return self.node(
            "Cast", [self.node("ArgMax", inputs, axis=axis, keepdims=0)], to=_TYPES[out.dtype.name]
        )

    def _atan2(self, inputs: list[str], *_: Any) -> str:
        """Return the angle of (x, y) from the arctangent of y/x, by the signs of both."""
        y, x = inputs
        zero = self.constant(np.float32(0.0))
        right = self.node("Atan", [self.node("Div", [y, x])])
        half_turn = [self.constant(np.float32(turn)) for turn in (-np.pi, np.pi)]
        below = self.node("Less", [y, zero])
        left = self.node("Add", [right, self.node("Where", [below, *half_turn])])
        upright = self.node("Mul", [self.node("Sign", [y]), self.constant(np.float32(np.pi / 2))])
        angle = self.node("Where", [self.node("Less", [x, zero]), left, right])
        return self.node("Where", [self.node("Equal", [x, zero]), upright, angle])

    def _dot_general(self, inputs: list[str], shapes: Any, out: Any, params: Any) -> str:
        contracted, batch = params["dimension_numbers"]
        last = len(shapes[0]) - 1
        plain = (tuple(contracted[0]), tuple(contracted[1])) == ((last,), (0,))
        if plain and not any(batch) and len(shapes[1]) <= 2:
            return self.node("MatMul", inputs)
        matrices = []
        for side in (0, 1):
            summed = [*contracted[side]]
            first = [*batch[side]]
            free = [axis for axis in range(len(shapes[side])) if axis not in (*summed, *first)]
            order = [*first, *free, *summed] if side == 0 else [*first, *summed, *free]
            groups = [free, summed] if side == 0 else [summed, free]
            sizes = [math.prod(shapes[side][axis] for axis in group) for group in groups]
            turned = self.node("Transpose", [inputs[side]], perm=[int(axis) for axis in order])
            shape = self.integers(*(shapes[side][axis] for axis in first), *sizes)
            matrices.append(self.node("Reshape", [turned, shape]))
        return self.node("Reshape", [self.node("MatMul", matrices), self.integers(*out.shape)])
