"""The closed loop of a policy as a short list of operations on vectors.

The list is read off the program that JAX makes of `jaxsafe.step` and the policy. So a proof is
about the loop that runs, and not about a second model of it. Everything linear between two
nonlinear operations becomes one matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array, Float

from jaxsafe.schema.errors import ConfigError

BASIC = 2.1
"""Largest relative error of a basic operation of the loop, in units of `Program.unit`.

Correct rounding gives 1. XLA may multiply by a reciprocal in place of a division, which gives 1.5.
"""

ELEMENTARY = 16.0
"""Largest relative error of tanh, exp and log in the loop, in units of `Program.unit`."""

ANGULAR = 4.0
"""Largest absolute error of sin, cos and atan in the loop, in units of `Program.unit`."""

MAX_ANGLE = 1e4
"""Largest angle of which sin and cos are as exact as `ANGULAR` says [rad]."""

FINE = 2.0**-40
"""A bound on the relative error of sums of up to 4,000 terms in double precision."""

# Operations that only call another jaxpr.
_INLINED = (
    "jit",
    "pjit",
    "closed_call",
    "custom_jvp_call",
    "custom_vjp_call",
    "remat",
    "checkpoint",
)
# Operations that move or copy numbers and do not change them.
_MOVING = [
    "reshape",
    "squeeze",
    "expand_dims",
    "broadcast_in_dim",
    "transpose",
    "slice",
    "split",
    "unstack",
    "concatenate",
    "stack",
    "copy",
    "convert_element_type",
]
# Functions of one number that have a rule of their own in `forms`.
_UNIVARIATE = ("tanh", "exp", "log", "sqrt", "abs", "square", "sin", "cos", "atan", "floor")
# Operations that return their arguments.
_IDENTITIES = ("stop_gradient", "optimization_barrier")


START = 1
"""The number of the vector that a program starts from."""


class Constant(NamedTuple):
    """Numbers of the loop that do not depend on its state, each known up to a radius."""

    value: np.ndarray
    radius: np.ndarray

    @property
    def shape(self) -> tuple[int, ...]:
        return self.value.shape


class Op(NamedTuple):
    """One operation on vectors.

    The kind `affine` is the sum of a constant and of constant matrices times its inputs. The radii
    of its constants include all rounding. `max` and `min` take one input and a constant. The other
    kinds take inputs alone.
    """

    kind: str
    inputs: tuple[int, ...]
    output: int
    size: int
    constants: tuple[Constant, ...] = ()


class Program(NamedTuple):
    """A function from a vector to a vector."""

    ops: tuple[Op, ...]
    input: int
    output: int
    unit: float
    """The unit roundoff of the arithmetic in which the loop runs, 0 for real numbers."""

    def __call__(self, y: Float[Array, " i"]) -> Float[Array, " o"]:
        """Return the value of the function, computed operation by operation."""
        values: dict[int, Any] = {self.input: y}
        for op in self.ops:
            x = [values[key] for key in op.inputs]
            if op.kind == "affine":
                pairs = zip(op.constants[1:], x, strict=True)
                values[op.output] = op.constants[0].value + sum(m.value @ v for m, v in pairs)
            else:
                values[op.output] = FUNCTIONS[op.kind](*x, *(c.value for c in op.constants))
        return values[self.output]


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "mul": jnp.multiply,
    "max": jnp.maximum,
    "min": jnp.minimum,
    "norm": lambda x: jnp.sqrt(jnp.sum(x * x, keepdims=True)),
    "reciprocal": lambda x: 1.0 / x,
    "inverse": lambda x: 1.0 / x,
    "select": lambda d, yes, no: jnp.where(d > 0.0, yes, no),
    **{name: getattr(jnp, {"atan": "arctan"}.get(name, name)) for name in _UNIVARIATE},
}
"""The operations that are not affine. All but `norm` work element by element."""


RULED = ("affine", *FUNCTIONS)
"""The kinds of operations for which there is a rule."""


class _Affine:
    """An array that is affine in earlier vectors, the bases, up to errors.

    For each base there are coefficients and bounds on their errors. Both have the shape of the
    array and a last axis for the elements of the base. The base None stands for the number 1.
    """

    def __init__(self, shape: Sequence[int], terms: dict[int | None, Any], errors: Any) -> None:
        self.shape = tuple(shape)
        self.terms: dict[int | None, np.ndarray] = terms
        self.errors: dict[int | None, np.ndarray] = errors


class _Zero(NamedTuple):
    """The truth value of `value == 0`."""

    value: _Affine


class _Positive(NamedTuple):
    """The truth value of `value > 0`, which stands for `larger > smaller`."""

    value: _Affine
    larger: Any
    smaller: Any


class _Not(NamedTuple):
    """The truth value of the opposite."""

    condition: Any


class _Both(NamedTuple):
    """The truth value of two conditions."""

    first: Any
    second: Any


_CONDITIONS = (_Positive, _Not, _Both)


class _Guarded(NamedTuple):
    """`where(value == 0, 1, value)`."""

    value: _Affine


class _Root(NamedTuple):
    """The root of `_Guarded(value)`. It is 1 where the value is 0, and `norm` elsewhere."""

    value: _Affine
    norm: _Affine


def trace(function: Callable[[Array], Array], size: int, unit: float) -> Program:
    """Return the program of a function of a vector.

    Args:
        function: the function, from a vector to a vector.
        size: number of elements of its argument.
        unit: the unit roundoff of the arithmetic in which it runs.

    Raises:
        ConfigError: there is no rule for an operation of the function.
    """
    closed = jax.make_jaxpr(function)(jnp.zeros(size))
    builder = _Builder(unit, size)
    start = builder.base((size,))
    [result] = builder.run(closed.jaxpr, closed.consts, [start])
    if not isinstance(result, _Affine):
        raise ConfigError("verify: the loop does not depend on its state")
    output = builder.vector(result)
    needed = {output}
    ops = []
    for op in reversed(builder.ops):
        if op.output in needed:
            needed.update(op.inputs)
            ops.append(op)
    return Program(ops=tuple(reversed(ops)), input=START, output=output, unit=unit)


class _Builder:
    """Turns the equations of a jaxpr into operations, and computes those of constants."""

    def __init__(self, unit: float, size: int) -> None:
        self.unit = unit
        self.size = size
        self.ops: list[Op] = []
        self.made: dict[int, Op] = {}
        self.vectors: dict[int, tuple[_Affine, int]] = {}
        self.chosen: dict[int, tuple[Any, ...]] = {}
        self.quotients: dict[int, tuple[Any, ...]] = {}
        self.count = 0

    def base(self, shape: Sequence[int]) -> _Affine:
        """Return a new base as an array of this shape."""
        self.count += 1
        size = int(np.prod(shape))
        identity = np.eye(size).reshape(*shape, size)
        return _Affine(shape, {self.count: identity}, {self.count: np.zeros_like(identity)})

    def emit(self, kind: str, inputs: Sequence[Any], *constants: Constant) -> _Affine:
        """Add an operation that is not affine, and return its output as an array."""
        shape = () if kind == "norm" else inputs[0].shape
        keys = tuple(self.vector(item) for item in inputs)
        flat = tuple(Constant(c.value.ravel(), c.radius.ravel()) for c in constants)
        out = self.base(shape)
        op = Op(kind, keys, self.count, int(np.prod(shape)), flat)
        self.ops.append(op)
        self.made[op.output] = op
        return out

    def vector(self, item: Any) -> int:
        """Return the number of the vector with the elements of an array.

        If there is none yet, add the operation that computes it.
        """
        if not isinstance(item, _Affine):
            raise ConfigError(
                "verify: no rule for a comparison, or for a random number, in the loop"
            )
        if id(item) in self.vectors:
            return self.vectors[id(item)][1]
        size = int(np.prod(item.shape))
        keys = [key for key in item.terms if key is not None]
        flat = {
            key: Constant(item.terms[key].reshape(size, -1), item.errors[key].reshape(size, -1))
            for key in item.terms
        }
        if not keys:
            keys = [START]
            flat[START] = Constant(*np.zeros((2, size, self.size)))
        if len(keys) == 1 and None not in flat:
            [(value, radius)] = flat.values()
            if np.array_equal(value, np.eye(size)) and not radius.any():
                return keys[0]
        zeros = np.zeros((size, 1))
        offset = flat.get(None, Constant(zeros, zeros))
        self.count += 1
        constants = (Constant(*(x[:, 0] for x in offset)), *(flat[key] for key in keys))
        self.ops.append(Op("affine", tuple(keys), self.count, size, constants))
        self.vectors[id(item)] = item, self.count  # the array is kept, so that its id stays its own
        return self.count

    def literal(self, value: Any) -> Constant | None:
        """Return a constant of the jaxpr, or None for a key of random numbers.

        A number that single precision cannot hold has the rounding of the loop as its radius.
        """
        if jnp.issubdtype(jnp.result_type(value), jax.dtypes.prng_key):
            return None
        array = np.asarray(value)
        if array.dtype.kind != "f":
            return Constant(array, np.zeros(array.shape))
        array = array.astype(np.float64)
        inexact = array != array.astype(np.float32)
        return Constant(array, np.where(inexact, self.unit * np.abs(array), 0.0))

    def run(self, jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
        """Return the outputs of a jaxpr. Equations that they do not need are left out."""
        values: dict[Any, Any] = dict(zip(jaxpr.invars, arguments, strict=True))
        values |= dict(zip(jaxpr.constvars, map(self.literal, consts), strict=True))
        needed = {var for var in jaxpr.outvars if not isinstance(var, Literal)}
        chosen = []
        for eqn in reversed(jaxpr.eqns):
            if needed & set(eqn.outvars):
                needed |= {var for var in eqn.invars if not isinstance(var, Literal)}
                chosen.append(eqn)

        def read(var: Any) -> Any:
            return self.literal(var.val) if isinstance(var, Literal) else values[var]

        for eqn in reversed(chosen):
            results = self.equation(eqn, [read(var) for var in eqn.invars])
            values |= dict(zip(eqn.outvars, results, strict=True))
        return [read(var) for var in jaxpr.outvars]

    def equation(self, eqn: Any, x: list[Any]) -> Sequence[Any]:
        """Return the outputs of an equation."""
        name = eqn.primitive.name
        if name in _INLINED:
            keys = ("jaxpr", "call_jaxpr", "fun_jaxpr")
            inner = next(eqn.params[key] for key in keys if key in eqn.params)
            return self.run(*_opened(inner), x)
        if name == "scan":
            return self.loop(eqn, x)
        if name in _IDENTITIES:
            return x
        if name == "select_n" and isinstance(x[0], Constant) and not isinstance(x[1], Constant):
            return [self._select_n(eqn, *x)]  # what is not chosen may be random
        random = any(jnp.issubdtype(out.aval.dtype, jax.dtypes.prng_key) for out in eqn.outvars)
        if random or any(item is None for item in x):
            return [None] * len(eqn.outvars)
        if all(isinstance(item, Constant) for item in x):
            return self.fold(eqn, x)
        if name == "convert_element_type":
            if jnp.issubdtype(eqn.params["new_dtype"], jnp.floating) and isinstance(x[0], _Affine):
                return x
        elif name in _MOVING:
            return self.move(eqn, x)
        elif name in _UNIVARIATE and name != "sqrt":
            return [self.emit(name, x)]
        elif rule := getattr(self, f"_{name}", None):
            return [rule(eqn, *x)]
        raise ConfigError(f"verify: no rule for the operation {name!r}")

    def loop(self, eqn: Any, x: list[Any]) -> list[Any]:
        """Return the outputs of a loop whose number of turns is known, turn by turn."""
        body, closed_over = _opened(eqn.params["jaxpr"])
        pairs = [*zip(body.invars, eqn.invars, strict=True)]
        pairs += zip(body.outvars, eqn.outvars, strict=True)
        if any(inner.aval.shape != outer.aval.shape for inner, outer in pairs):
            raise ConfigError("verify: no rule for a loop over the elements of an array")
        num_consts = len(x) - len(eqn.outvars)
        consts, carry = x[:num_consts], x[num_consts:]
        for _ in range(eqn.params["length"]):
            carry = self.run(body, closed_over, [*consts, *carry])
        return carry

    def move(self, eqn: Any, x: list[Any]) -> list[Any]:
        """Return the outputs of an operation that leaves numbers as they are."""
        if len(x) == 1 and isinstance(x[0], _CONDITIONS):
            return [self.moved_condition(eqn, x[0])]
        if not all(isinstance(item, Constant | _Affine) for item in x):
            raise ConfigError(
                f"verify: no rule for the operation {eqn.primitive.name!r} of comparisons"
            )
        arrays = [self.affine(item, item.shape) for item in x]
        shapes = [out.aval.shape for out in eqn.outvars]
        outs = [_Affine(shape, {}, {}) for shape in shapes]
        sizes = {key: term.shape[-1] for item in arrays for key, term in item.terms.items()}
        several = eqn.primitive.multiple_results
        for key, size in sizes.items():
            for which in ("terms", "errors"):
                given = [
                    getattr(item, which).get(key, np.zeros((*item.shape, size))) for item in arrays
                ]
                moved = jax.vmap(
                    lambda *a: eqn.primitive.bind(*a, **eqn.params), in_axes=-1, out_axes=-1
                )(*map(jnp.asarray, given))
                for out, array in zip(outs, moved if several else [moved], strict=True):
                    getattr(out, which)[key] = np.asarray(array)
        return outs

    def moved_condition(self, eqn: Any, condition: Any) -> Any:
        """Return a condition of whose elements an operation changes the places."""
        if isinstance(condition, _Positive):
            return _Positive(self.move(eqn, [condition.value])[0], None, None)
        return type(condition)(*(self.moved_condition(eqn, part) for part in condition))

    def affine(self, item: Any, shape: Sequence[int]) -> _Affine:
        """Return a value as an array of a shape. A constant has no base."""
        if isinstance(item, Constant):
            value, radius = (np.broadcast_to(x, shape)[..., None] * 1.0 for x in item)
            return _Affine(shape, {None: value}, {None: radius})
        if not isinstance(item, _Affine):
            raise ConfigError("verify: no rule for a comparison in the loop")
        if item.shape == tuple(shape):
            return item
        spread = [
            {key: np.broadcast_to(x, (*shape, x.shape[-1])) for key, x in terms.items()}
            for terms in (item.terms, item.errors)
        ]
        return _Affine(shape, *spread)

    def sum(self, a: Any, b: Any, sign: float) -> _Affine:
        """Return a + sign·b."""
        shape = np.broadcast_shapes(a.shape, b.shape)
        a, b = (self.affine(item, shape) for item in (a, b))
        terms, errors = dict(a.terms), dict(a.errors)
        for key, term in b.terms.items():
            terms[key] = terms.get(key, 0.0) + sign * term
            errors[key] = errors.get(key, 0.0) + b.errors[key]
        return self.rounded(a.shape, terms, errors)

    def rounded(self, shape: Any, terms: Any, errors: Any) -> _Affine:
        """Return an array whose errors include the rounding of a basic operation.

        That is the rounding of the loop, and the rounding of the numbers here.
        """
        share = BASIC * self.unit * (1.0 + 1e-6) + FINE
        errors = {
            key: (1.0 + 1e-6) * (error + share * np.abs(terms[key]))
            for key, error in errors.items()
        }
        return _Affine(shape, terms, errors)

    def scaled(self, item: _Affine, factor: Constant) -> _Affine:
        """Return an array times constants, element by element."""
        value, radius = factor.value[..., None], factor.radius[..., None]
        terms = {key: value * term for key, term in item.terms.items()}
        errors = {
            key: (np.abs(value) + radius) * error + radius * np.abs(item.terms[key])
            for key, error in item.errors.items()
        }
        return self.rounded(item.shape, terms, errors)

    def contracted(self, item: _Affine, matrix: Constant, count: int) -> _Affine:
        """Return an array times a matrix. Each sum has `count` products, in any order."""
        value, radius = matrix

        def moved(x: np.ndarray, m: np.ndarray) -> np.ndarray:
            return np.moveaxis(np.tensordot(x, m, ((-2,), (0,))), -1, -2)

        terms = {key: moved(term, value) for key, term in item.terms.items()}
        share = (count + 1) * (1.0 + 1e-3) * self.unit + FINE
        errors = {
            key: (1.0 + FINE)
            * (
                moved(error, np.abs(value) + radius)
                + moved(np.abs(item.terms[key]), radius + share * np.abs(value))
            )
            for key, error in item.errors.items()
        }
        return _Affine((*item.shape[:-1], value.shape[1]), terms, errors)

    def fold(self, eqn: Any, x: list[Constant]) -> list[Constant]:
        """Return the outputs of an operation on constants, with the errors of the loop as radii."""
        name, several = eqn.primitive.name, eqn.primitive.multiple_results
        # Some constants are known more precisely than the loop computes. All are taken so.
        precise = np.result_type(
            np.float32, *(item.value.dtype for item in x if item.value.dtype.kind == "f")
        )
        values = (
            jnp.asarray(item.value, precise if item.value.dtype.kind == "f" else None) for item in x
        )
        out = eqn.primitive.bind(*values, **eqn.params)
        outs = [np.asarray(item) for item in (out if several else [out])]
        exact = not any(np.any(item.radius) for item in x)
        if outs[0].dtype.kind != "f":
            # Of inexact numbers only a comparison of two is known, where they are far enough apart.
            if not exact and (
                len(x) != 2 or np.any(np.abs(x[0].value - x[1].value) <= x[0].radius + x[1].radius)
            ):
                raise ConfigError(f"verify: rounding decides the operation {name!r} of numbers")
            return [Constant(item, np.zeros(item.shape)) for item in outs]
        if name == "select_n" or (name in _MOVING and not exact):
            radii = [item.radius if item.value.dtype.kind == "f" else item.value for item in x]
            moved = eqn.primitive.bind(*map(jnp.asarray, radii), **eqn.params)
            pairs = zip(outs, moved if several else [moved], strict=True)
            return [Constant(value, np.asarray(radius)) for value, radius in pairs]
        if name in _MOVING:
            return [Constant(item, np.zeros(item.shape)) for item in outs]
        if name not in _ERRORS:
            raise ConfigError(f"verify: no rule for the operation {name!r} of numbers")
        own = (_units(name) * self.unit + FINE) * np.abs(outs[0])
        if name in ("sin", "cos", "atan"):
            # Up to 1 rad the error is relative.
            own = np.where(np.abs(x[0].value) <= 1.0, own, ANGULAR * self.unit + FINE)
        error = _ERRORS[name](outs[0], *(part for item in x for part in item), **eqn.params)
        return [Constant(outs[0], (1.0 + FINE) * (error + own))]

    def _add(self, eqn: Any, a: Any, b: Any) -> _Affine:
        return self.sum(a, b, 1.0)

    _add_any = _add

    def _sub(self, eqn: Any, a: Any, b: Any) -> _Affine:
        return self.sum(a, b, -1.0)

    def _neg(self, eqn: Any, a: Any) -> _Affine:
        return _Affine(a.shape, {key: -term for key, term in a.terms.items()}, a.errors)

    def _mul(self, eqn: Any, a: Any, b: Any) -> _Affine:
        if a is b:
            return self.emit("square", [a])
        if isinstance(a, Constant):
            a, b = b, a
        shape = eqn.outvars[0].aval.shape
        if isinstance(b, Constant):
            return self.scaled(
                self.affine(a, shape), Constant(*(np.broadcast_to(x, shape) for x in b))
            )
        return self.emit("mul", [self.affine(a, shape), self.affine(b, shape)])

    def _div(self, eqn: Any, a: Any, b: Any) -> _Affine:
        quotient = self.quotient(eqn, a, b)
        if id(b) in self.chosen:
            self.quotients[id(quotient)] = quotient, eqn, a, b
        return quotient

    def quotient(self, eqn: Any, a: Any, b: Any) -> _Affine:
        over = self.reciprocal(b)
        if isinstance(a, Constant) and np.all(a.value == 1.0) and a.shape in ((), over.shape):
            return over
        return self._mul(eqn, a, over)

    def reciprocal(self, x: Any) -> Any:
        if isinstance(x, Constant):
            value = 1.0 / x.value
            error = np.abs(value) * x.radius / np.maximum(np.abs(x.value) - x.radius, 0.0)
            return Constant(value, (1.0 + FINE) * (error + FINE * np.abs(value)))
        return self.emit("reciprocal", [x])

    def _integer_pow(self, eqn: Any, x: Any) -> _Affine:
        power = eqn.params["y"]
        if power == -1:
            return self.reciprocal(x)
        if power not in (2, 3):
            raise ConfigError(f"verify: no rule for the operation 'integer_pow' to the {power}")
        square = self.emit("square", [x])
        return square if power == 2 else self.emit("mul", [square, x])

    def _logistic(self, eqn: Any, x: Any) -> _Affine:
        half = Constant(np.full(x.shape, 0.5), np.zeros(x.shape))
        return self.sum(self.scaled(self.emit("tanh", [self.scaled(x, half)]), half), half, 1.0)

    def extreme(self, kind: str, a: Any, b: Any) -> _Affine:
        """Return the larger or the smaller of two values."""
        if isinstance(a, Constant):
            a, b = b, a
        if isinstance(b, Constant):
            return self.emit(kind, [a], Constant(*(np.broadcast_to(x, a.shape) for x in b)))
        zero = Constant(np.zeros(a.shape), np.zeros(a.shape))
        return self.sum(b, self.emit(kind, [self.sum(a, b, -1.0)], zero), 1.0)

    def _max(self, eqn: Any, a: Any, b: Any) -> _Affine:
        return self.extreme("max", a, b)

    def _min(self, eqn: Any, a: Any, b: Any) -> _Affine:
        return self.extreme("min", a, b)

    def _clamp(self, eqn: Any, low: Any, x: Any, high: Any) -> _Affine:
        return self.extreme("min", self.extreme("max", x, low), high)

    def _eq(self, eqn: Any, a: Any, b: Any) -> _Zero:
        if isinstance(b, Constant) and not b.value.any() and isinstance(a, _Affine):
            return _Zero(a)
        raise ConfigError("verify: no rule for the operation 'eq'")

    def _gt(self, eqn: Any, a: Any, b: Any) -> _Positive:
        return _Positive(self.sum(a, b, -1.0), a, b)

    def _lt(self, eqn: Any, a: Any, b: Any) -> _Positive:
        return self._gt(eqn, b, a)

    def _ge(self, eqn: Any, a: Any, b: Any) -> _Not:
        return _Not(self._gt(eqn, b, a))

    def _le(self, eqn: Any, a: Any, b: Any) -> _Not:
        return _Not(self._gt(eqn, a, b))

    def _not(self, eqn: Any, condition: Any) -> _Not:
        return _Not(self.condition(condition))

    def _and(self, eqn: Any, a: Any, b: Any) -> _Both:
        return _Both(self.condition(a), self.condition(b))

    def _or(self, eqn: Any, a: Any, b: Any) -> _Not:
        return _Not(_Both(_Not(self.condition(a)), _Not(self.condition(b))))

    def condition(self, item: Any) -> Any:
        if isinstance(item, _CONDITIONS):
            return item
        raise ConfigError("verify: no rule for a logical operation of these values")

    def _select_n(self, eqn: Any, which: Any, otherwise: Any, chosen: Any) -> Any:
        """Return one of two values.

        The choice is a constant or a comparison, or it guards a root against zero as `safe_norm`
        does.
        """
        if isinstance(which, Constant) and (which.value.all() or not which.value.any()):
            return chosen if which.value.all() else otherwise
        if isinstance(which, _Zero) and isinstance(chosen, Constant):
            if otherwise is which.value and np.all(chosen.value == 1.0):
                return _Guarded(which.value)
            guards = isinstance(otherwise, _Root) and otherwise.value is which.value
            if guards and not chosen.value.any():
                return otherwise.norm
        if isinstance(which, _CONDITIONS):
            result = self.choose(which, self.unguarded(which, chosen), otherwise)
            self.chosen[id(result)] = result, which, chosen
            return result
        raise ConfigError("verify: no rule for the operation 'select_n'")

    def unguarded(self, which: Any, value: Any) -> Any:
        """Return a value that is used only where a condition holds.

        The same condition may guard the divisor of a quotient. If it says that the divisor is not
        0, the guard is not needed here.
        """
        if id(value) not in self.quotients:
            return value
        _, eqn, dividend, divisor = self.quotients[id(value)]
        _, guard, inner = self.chosen[id(divisor)]
        if guard is not which or not self.says_nonzero(which, inner):
            return value
        return self._mul(eqn, dividend, self.emit("inverse", [inner]))

    def says_nonzero(self, which: Any, x: Any) -> bool:
        """Return whether a condition is a·|x| > |z| with a number a > 0, so that x is not 0."""
        if not isinstance(which, _Positive) or not isinstance(x, _Affine):
            return False
        larger, smaller = self.absolute_of(which.larger), self.absolute_of(which.smaller)
        return larger == self.vector(x) and smaller is not None

    def absolute_of(self, item: Any) -> int | None:
        """Return the number of the vector of which an array is positive times the absolute value.

        It is None if the array is something else.
        """
        if not isinstance(item, _Affine) or len(item.terms) != 1:
            return None
        [(key, term)] = item.terms.items()
        op = self.made.get(key) if key is not None else None
        if op is None or op.kind != "abs" or int(np.prod(item.shape)) != op.size:
            return None
        least = (term - item.errors[key]).reshape(op.size, op.size)
        positive = np.all(np.diag(least) > 0.0) and not np.any(least - np.diag(np.diag(least)))
        return op.inputs[0] if positive else None

    def choose(self, which: Any, yes: Any, no: Any) -> _Affine:
        """Return the first value where a condition holds, and else the second."""
        if isinstance(which, _Not):
            return self.choose(which.condition, no, yes)
        if isinstance(which, _Both):
            return self.choose(which.first, self.choose(which.second, yes, no), no)
        shape = np.broadcast_shapes(which.value.shape, yes.shape, no.shape)
        return self.emit("select", [self.affine(x, shape) for x in (which.value, yes, no)])

    def _sqrt(self, eqn: Any, x: Any) -> Any:
        total = x.value if isinstance(x, _Guarded) else x
        keys = list(total.terms)
        op = self.made.get(keys[0]) if len(keys) == 1 and keys[0] is not None else None
        if op is not None and op.kind == "square" and np.all(total.terms[keys[0]] == 1.0):
            root = self.emit("norm", [self.base_of(op.inputs[0], op.size)])
            root = _Affine(
                total.shape,
                {key: term.reshape(*total.shape, 1) for key, term in root.terms.items()},
                {key: error.reshape(*total.shape, 1) for key, error in root.errors.items()},
            )
            return _Root(total, root) if isinstance(x, _Guarded) else root
        if isinstance(x, _Guarded):
            raise ConfigError("verify: no rule for the operation 'select_n'")
        return self.emit("sqrt", [x])

    def base_of(self, key: int, size: int) -> _Affine:
        identity = np.eye(size)
        return _Affine((size,), {key: identity}, {key: np.zeros_like(identity)})

    def _reduce_sum(self, eqn: Any, x: Any) -> _Affine:
        axes = tuple(eqn.params["axes"])
        count = int(np.prod([x.shape[axis] for axis in axes]))
        share = count * (1.0 + 1e-3) * self.unit + FINE
        shape = eqn.outvars[0].aval.shape
        terms = {key: term.sum(axes) for key, term in x.terms.items()}
        errors = {
            key: (error + share * np.abs(x.terms[key])).sum(axes) for key, error in x.errors.items()
        }
        return _Affine(shape, terms, errors)

    def _dot_general(self, eqn: Any, a: Any, b: Any) -> _Affine:
        (left, right), batch = eqn.params["dimension_numbers"]
        rank = len(eqn.outvars[0].aval.shape)
        if not any(batch) and len(left) == 1:
            if isinstance(b, Constant) and b.value.ndim == 2 and left == (len(a.shape) - 1,):
                matrix = b if right == (0,) else Constant(b.value.T, b.radius.T)
                return self.contracted(a, matrix, a.shape[-1])
            if isinstance(a, Constant) and isinstance(b, _Affine) and a.value.ndim == 2 == rank + 1:
                matrix = a if left == (0,) else Constant(a.value.T, a.radius.T)
                return self.contracted(b, matrix, b.shape[-1])
        raise ConfigError("verify: no rule for the operation 'dot_general' of these values")


def _opened(jaxpr: Any) -> tuple[Any, Sequence[Any]]:
    """Return a jaxpr and the constants that it closes over, if it is a closed one."""
    return getattr(jaxpr, "jaxpr", jaxpr), getattr(jaxpr, "consts", ())


def _units(name: str) -> float:
    """Return the relative error of an operation of the loop, in units of its roundoff."""
    return ELEMENTARY if name in ("tanh", "exp", "log", "sin", "cos", "atan") else BASIC


def _of_product(value: Any, a: Any, ra: Any, b: Any, rb: Any, **_: Any) -> Any:
    return np.abs(a) * rb + np.abs(b) * ra + ra * rb


def _of_power(value: Any, a: Any, ra: Any, y: int, **_: Any) -> Any:
    # A power is a chain of products, and each of them is rounded.
    high = (np.abs(a) + ra) * (1.0 + 1e-6)
    return np.abs(high ** abs(y) - np.abs(a) ** abs(y)) if y > 0 else np.full(np.shape(a), np.inf)


def _monotone(function: Callable[[Any], Any]) -> Callable[..., Any]:
    return lambda value, a, ra, **_: np.maximum(
        np.abs(function(a + ra) - value), np.abs(function(a - ra) - value)
    )


_ERRORS: dict[str, Callable[..., Any]] = {
    "add": lambda value, a, ra, b, rb, **_: ra + rb,
    "sub": lambda value, a, ra, b, rb, **_: ra + rb,
    "mul": _of_product,
    "div": lambda value, a, ra, b, rb, **_: (
        (ra + np.abs(value) * rb) / np.maximum(np.abs(b) - rb, 0.0)
    ),
    "neg": lambda value, a, ra, **_: ra,
    "abs": lambda value, a, ra, **_: ra,
    "max": lambda value, a, ra, b, rb, **_: np.maximum(ra, rb),
    "min": lambda value, a, ra, b, rb, **_: np.maximum(ra, rb),
    "integer_pow": _of_power,
    "sin": lambda value, a, ra, **_: ra,
    "cos": lambda value, a, ra, **_: ra,
    "atan": lambda value, a, ra, **_: ra,
    "sqrt": _monotone(np.sqrt),
    "exp": _monotone(np.exp),
    "log": _monotone(np.log),
    "tanh": _monotone(np.tanh),
    "reduce_sum": lambda value, a, ra, axes, **_: np.sum(
        ra + 2.0**-20 * np.abs(a), axis=tuple(axes)
    ),
}
"""By how much errors of the arguments move the result of an operation on constants.

Each function takes the result, each argument with its radius, and the parameters of the operation.
"""
