"""Affine bounds of a program: one form per vector, with a rule per operation.

A form is about a vector v that is a function of the loop's state y. It says that
|v − slope·y − centre| ≤ radius and low ≤ v ≤ high for every y of a domain. Each operation adds a
noise: what its linearisation and the rounding leave open. The noises of all operations are carried
backwards to the outputs at once, so that they cancel on the way as far as the network lets them.

All functions work on a batch of domains. Each operation is a program of its own, which is compiled
once per size. One program for a whole step took XLA minutes to compile.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.verify.program import (
    ANGULAR,
    BASIC,
    ELEMENTARY,
    FINE,
    MAX_ANGLE,
    Constant,
    Program,
)

TINY = 2.0**-60
"""A bound on what an operation of the loop loses by underflow in single precision.

The square of a number below 1.1e-19 is 0 there, so that a norm loses as much.
"""

MAX_INTERVALS = 1024
"""Largest number of coefficients for which intervals are summed beside forms."""


class Domain(NamedTuple):
    """A set of states: centre + generators·e + box·f, |e|, |f| ≤ 1, between low and high."""

    centre: Float[Array, " d"]
    generators: Float[Array, "d k"]
    box: Float[Array, " d"]
    """Half the box around all that is too small for a generator of its own."""
    low: Float[Array, " d"]
    high: Float[Array, " d"]
    reach: Float[Array, " d"]
    """A bound on the size of the terms of each element."""

    @classmethod
    def of(cls, centre: Array, generators: Array, box: Array, low: Array, high: Array) -> Domain:
        """Return a set of states, or a batch of them, from all but `reach`."""
        reach = jnp.abs(centre) + jnp.abs(generators).sum(-1) + box
        return cls(centre, generators, box, low, high, reach)


class Form(NamedTuple):
    """Bounds of a vector v over a domain, as the module's docstring explains them."""

    slope: Float[Array, "s d"]
    centre: Float[Array, " s"]
    radius: Float[Array, " s"]
    low: Float[Array, " s"]
    high: Float[Array, " s"]
    mass: Float[Array, " s"]
    """A bound on the size of the terms of slope·y + centre."""

    @property
    def size(self) -> Float[Array, " s"]:
        """A bound on |v|."""
        largest = jnp.maximum(jnp.abs(self.low), jnp.abs(self.high))
        return jnp.minimum(self.mass + self.radius, largest)


class Linearised(NamedTuple):
    """An operation as coefficients of its inputs, an offset, and what these leave open."""

    coefficients: Sequence[Any]
    offset: Any
    noise: Any
    low: Any = -jnp.inf
    """A lower bound of the exact operation."""
    high: Any = jnp.inf
    rounding: float = BASIC
    """The relative error of the loop's own operation, in units."""
    absolute: float = 0.0
    """The absolute error of the loop's own operation, in units."""


class Bounds(NamedTuple):
    """Bounds of the outputs of a program. They are those of a form, without `mass`."""

    slope: Float[Array, "o d"]
    centre: Float[Array, " o"]
    radius: Float[Array, " o"]
    low: Float[Array, " o"]
    high: Float[Array, " o"]


def spread(slope: Float[Array, "s d"], domain: Domain) -> Float[Array, " s"]:
    """Return a bound on |slope·(y − centre)|, before rounding."""
    return jnp.abs(slope @ domain.generators).sum(-1) + jnp.abs(slope) @ domain.box


def interval(form: Form, domain: Domain) -> tuple[Array, Array]:
    """Return the lowest and the highest value of a form."""
    middle = form.slope @ domain.centre + form.centre
    half = (1.0 + FINE) * (spread(form.slope, domain) + form.radius) + FINE * form.mass
    return jnp.maximum(middle - half, form.low), jnp.minimum(middle + half, form.high)


def bound(program: Program, domain: Domain) -> Bounds:
    """Return bounds of the outputs of a program over each of a batch of domains."""
    forms = {program.input: _start(domain)}
    noises = {}
    coefficients = {}
    for op in program.ops:
        inputs = [forms[key] for key in op.inputs]
        forms[op.output], noises[op.output], coefficients[op.output] = _forwards(
            op.kind, program.unit, op.constants, domain, inputs
        )
    form = forms[program.output]
    rows = {
        program.output: jnp.broadcast_to(
            jnp.eye(form.centre.shape[-1]), (*form.centre.shape, form.centre.shape[-1])
        )
    }
    together = jnp.zeros_like(form.radius)
    for op in reversed(program.ops):
        matrices = [constant.value for constant in op.constants[1:]]
        local = matrices if op.kind == "affine" else coefficients[op.output]
        before = [rows.get(key) for key in op.inputs]
        moved, together = _backwards(
            op.kind, local, rows.pop(op.output), noises[op.output], together, before
        )
        rows |= dict(zip(op.inputs, moved, strict=True))
    return _bounds(form, domain, together)


@jax.jit
@jax.vmap
def _start(domain: Domain) -> Form:
    size = domain.centre.shape[0]
    zeros = jnp.zeros(size)
    return Form(jnp.eye(size), zeros, zeros, domain.low, domain.high, domain.reach)


@jax.jit
@jax.vmap
def _bounds(form: Form, domain: Domain, together: Array) -> Bounds:
    low, high = interval(form, domain)
    # `form.radius` bounds the noises along all paths by themselves.
    radius = jnp.minimum(form.radius, (1.0 + FINE) * together + FINE * form.radius)
    return Bounds(form.slope, form.centre, radius, low, high)


def _apply(kind: str, coefficient: Any, vector: Array) -> Array:
    """Return what an input contributes to the result of an operation."""
    if kind == "affine":
        return coefficient @ vector
    product = _times(coefficient if vector.ndim == 1 else coefficient[:, None], vector)
    return product.sum(0, keepdims=True) if kind == "norm" else product


def _times(coefficient: Array, x: Array) -> Array:
    """Return a product that is 0 where the coefficient is 0, even if x is infinite."""
    return jnp.where(coefficient == 0.0, 0.0, coefficient * x)


def _total(arrays: Iterable[Array]) -> Array:
    return functools.reduce(jnp.add, arrays)


@functools.partial(jax.jit, static_argnums=(0, 1))
@functools.partial(jax.vmap, in_axes=(None, None, None, 0, 0))
def _forwards(
    kind: str, unit: float, constants: Any, domain: Domain, x: list[Form]
) -> tuple[Form, Array, Any]:
    """Return the form of the result of an operation, its noise and its coefficients.

    Args:
        kind: the kind of the operation.
        unit: the unit roundoff of the loop.
        constants: the constants of the operation.
        domain: the domain.
        x: the forms of its inputs.
    """
    rule = RULES[kind]
    linearised = rule(domain, constants, x)
    if kind not in ("affine", "norm"):
        linearised = _with_numbers(linearised)
    coefficients, offset, noise, low, high, rounding, absolute = linearised
    pairs = list(zip(coefficients, x, strict=True))
    slope = _total(_apply(kind, a, form.slope) for a, form in pairs)
    centre = _total(_apply(kind, a, form.centre) for a, form in pairs) + offset
    both = _total(
        _apply(kind, jnp.abs(a), jnp.stack([form.mass, form.radius], axis=-1)) for a, form in pairs
    )
    fine = both[:, 0] + jnp.abs(offset)
    carried = both[:, 1]
    mass = jnp.abs(slope) @ domain.reach + jnp.abs(centre)
    largest = jnp.maximum(jnp.abs(low), jnp.abs(high))
    exact = jnp.minimum(mass + FINE * fine + carried + noise, largest)
    own = absolute * unit + (rounding * unit * exact if rounding * unit else 0.0)
    noise = noise + FINE * fine + own + TINY
    share = rounding * unit + FINE
    form = Form(
        slope=slope,
        centre=centre,
        radius=(1.0 + FINE) * (carried + noise),
        low=jnp.broadcast_to(low - share * jnp.abs(low) - absolute * unit - TINY, centre.shape),
        high=jnp.broadcast_to(high + share * jnp.abs(high) + absolute * unit + TINY, centre.shape),
        mass=(1.0 + FINE) * mass,
    )
    return form, noise, () if kind == "affine" else coefficients


def _with_numbers(linearised: Linearised) -> Linearised:
    """Return an operation without coefficients where its noise is not finite.

    There the noise is what its interval says, and infinite if the interval is. So what is chosen or
    clipped afterwards is known again. An interval that is not a number stands for a result that may
    not be one, and stays as it is.
    """
    low, high = linearised.low, linearised.high
    known = jnp.isfinite(linearised.noise)
    bounded = jnp.isfinite(low) & jnp.isfinite(high)
    middle, half = _middle(jnp.where(bounded, low, 0.0), jnp.where(bounded, high, 0.0))
    unknown = jnp.where(jnp.isnan(low) | jnp.isnan(high), jnp.nan, jnp.inf)
    return linearised._replace(
        coefficients=[jnp.where(known, a, 0.0) for a in linearised.coefficients],
        offset=jnp.where(known, linearised.offset, middle),
        noise=jnp.where(known, linearised.noise, jnp.where(bounded, half, unknown)),
    )


@functools.partial(jax.jit, static_argnums=0)
def _backwards(
    kind: str, coefficients: Any, row: Array, noise: Array, together: Array, before: list[Any]
) -> tuple[list[Array], Array]:
    """Carry the outputs' coefficients of an operation's result backwards to its inputs.

    Args:
        kind: the kind of the operation.
        coefficients: the operation's coefficients of its inputs.
        row: the outputs' coefficients of its result, `[batch, outputs, size]`.
        noise: the noise of the operation, `[batch, size]`.
        together: how far the noises of later operations may move the outputs, `[batch, outputs]`.
        before: the outputs' coefficients of each input through later operations, or None.

    Returns:
        The outputs' coefficients of each input, and `together` with the noise of the operation.
    """
    together = together + _times(jnp.abs(row), noise[:, None]).sum(-1)
    moved = []
    for a, rows in zip(coefficients, before, strict=True):
        own = row @ a if kind == "affine" else row * a[:, None]
        moved.append(own if rows is None else rows + own)
    return moved, together


def _affine(domain: Domain, constants: Sequence[Constant], x: list[Form]) -> Linearised:
    """Add matrices times vectors. Their radii include the rounding of the loop."""
    offset, *matrices = constants
    noise = offset.radius
    low = high = offset.value
    slack: Any = 0.0
    for matrix, form in zip(matrices, x, strict=True):
        noise = noise + matrix.radius @ form.size
        if matrix.value.size > MAX_INTERVALS:
            low, high = -jnp.inf, jnp.inf
            continue
        ends = [
            jnp.where(matrix.value != 0.0, matrix.value * end, 0.0) for end in (form.low, form.high)
        ]
        low = low + jnp.minimum(*ends).sum(-1)
        high = high + jnp.maximum(*ends).sum(-1)
        slack = slack + FINE * jnp.maximum(*map(jnp.abs, ends)).sum(-1)
    slack = slack + noise
    values = [matrix.value for matrix in matrices]
    return Linearised(values, offset.value, noise, low - slack, high + slack, rounding=0.0)


def _mul(domain: Domain, constants: Sequence[Constant], x: list[Form]) -> Linearised:
    """Multiply. The product is linearised at the middles of the intervals."""
    first, second = (interval(form, domain) for form in x)
    corners = jnp.stack([_corner(a, b) for a in first for b in second])
    (a, half_a), (b, half_b) = _middle(*first), _middle(*second)
    noise = half_a * half_b * (1.0 + FINE)
    return Linearised([b, a], -a * b, noise, corners.min(0), corners.max(0))


def _select(domain: Domain, constants: Sequence[Constant], x: list[Form]) -> Linearised:
    """Choose the second input where the first is above 0, and else the third.

    Where the set has states with both choices, the value is ½(a + b) ± ½(a − b).
    """
    decision, yes, no = x
    low, high = interval(decision, domain)
    always, never = low > 0.0, high <= 0.0
    (a, b), (c, d) = interval(yes, domain), interval(no, domain)
    apart = (yes.slope - no.slope) @ domain.centre + yes.centre - no.centre
    reach = (1.0 + FINE) * (spread(yes.slope - no.slope, domain) + yes.radius + no.radius)
    reach = reach + FINE * (yes.mass + no.mass)
    half = 0.5 * jnp.minimum(jnp.abs(apart) + reach, jnp.maximum(b - c, d - a)) * (1.0 + FINE)
    decided = always | never
    share = jnp.where(decided, always, 0.5)
    return Linearised(
        [jnp.zeros_like(share), share, 1.0 - share],
        jnp.zeros_like(share),
        jnp.where(decided, 0.0, half),
        jnp.where(always, a, jnp.where(never, c, jnp.minimum(a, c))),
        jnp.where(always, b, jnp.where(never, d, jnp.maximum(b, d))),
        rounding=0.0,
    )


def _floor(domain: Domain, constants: Sequence[Constant], x: list[Form]) -> Linearised:
    """Round downwards: one number, or x − ½ ± ½."""
    low, high = (jnp.floor(end) for end in interval(x[0], domain))
    one = low == high
    slope = jnp.where(one, 0.0, 1.0)
    return Linearised(
        [slope],
        jnp.where(one, low, -0.5),
        jnp.where(one, 0.0, 0.5),
        low,
        high,
        rounding=0.0,
    )


def _wave(function: Callable[[Array], Array], shift: float) -> Rule:
    """Return the rule of sin(x + shift).

    Both lines touch its graph at an end, or where its derivative is the slope of the chord. The
    intervals of more than a turn have the slope 0.
    """
    turn = 2.0 * jnp.pi

    def rule(domain: Domain, constants: Sequence[Constant], x: list[Form]) -> Linearised:
        low, high = interval(x[0], domain)
        width = high - low
        wide = (width > 1e-9 * (jnp.abs(low) + jnp.abs(high))) & (width < turn)
        rise = function(high) - function(low)
        slope = jnp.where(wide, rise / jnp.where(wide, width, 1.0), 0.0)

        def reached(angle: Array) -> list[Array]:
            """Return the points whose angle has a cosine, within the interval."""
            middle = 0.5 * (low + high) + shift
            points = []
            for base in (angle, -angle):
                nearest = base + turn * jnp.round((middle - base) / turn)
                points += [nearest - turn, nearest, nearest + turn]
            return [jnp.clip(point - shift, low, high) for point in points]

        touching = jnp.stack([low, high, *reached(jnp.arccos(jnp.clip(slope, -1.0, 1.0)))])
        gaps = function(touching) - slope * touching
        extreme = function(jnp.stack([low, high, *reached(jnp.full_like(low, 0.5 * jnp.pi))]))
        far = jnp.maximum(jnp.abs(low), jnp.abs(high))
        rough = FINE * (1.0 + jnp.abs(slope) * far)
        noise = 0.5 * (gaps.max(0) - gaps.min(0)) * (1.0 + FINE) + rough
        whole = width >= turn
        known = jnp.where(far <= MAX_ANGLE, 1.0, jnp.nan)
        return Linearised(
            [slope],
            jnp.where(whole, 0.0, 0.5 * (gaps.min(0) + gaps.max(0))),
            jnp.where(whole, 1.0, noise) * known,
            jnp.where(whole, -1.0, jnp.maximum(extreme.min(0) - rough, -1.0)) * known,
            jnp.where(whole, 1.0, jnp.minimum(extreme.max(0) + rough, 1.0)) * known,
            rounding=0.0,
            absolute=ANGULAR,
        )

    return rule


def _corner(a: Array, b: Array) -> Array:
    """Return the product of two ends of intervals. An infinite end times 0 is 0."""
    empty = ((a == 0.0) & jnp.isinf(b)) | ((b == 0.0) & jnp.isinf(a))
    return jnp.where(empty, 0.0, a * b)


def _middle(low: Array, high: Array) -> tuple[Array, Array]:
    """Return a point of an interval and a bound on the distance to its ends."""
    middle = 0.5 * (low + high)
    return middle, jnp.maximum(high - middle, middle - low) * (1.0 + FINE)


def _norm(domain: Domain, constants: Sequence[Constant], x: list[Form]) -> Linearised:
    """Bound a Euclidean norm by its tangent.

    With w a unit vector, p = w·x and q the rest of x, p ≤ ‖x‖ = √(p² + q²) ≤ p + q²/(2p) where
    p > 0.
    """
    [form] = x
    low, high = interval(form, domain)
    middle = 0.5 * (low + high)
    length = jnp.sqrt((middle**2).sum())
    along = jnp.where(length > 0.0, middle / jnp.where(length > 0.0, length, 1.0), 0.0)
    # The part along w and the rest are forms of their own, narrower than those of the elements.
    split = jnp.concatenate([along[None], jnp.eye(along.size) - jnp.outer(along, along)])
    slope = split @ form.slope
    radius = jnp.abs(split) @ form.radius + FINE * form.mass.sum()
    half = (1.0 + FINE) * (spread(slope, domain) + radius)
    centre = slope @ domain.centre + split @ form.centre
    least_part = centre[0] - half[0]
    rest = ((jnp.abs(centre[1:]) + half[1:]) ** 2).sum()
    largest = jnp.sqrt((jnp.maximum(jnp.abs(low), jnp.abs(high)) ** 2).sum())
    least = jnp.sqrt((jnp.maximum(jnp.maximum(low, -high), 0.0) ** 2).sum())
    forwards = least_part > 0.0
    above = jnp.where(forwards, 0.5 * rest / jnp.where(forwards, least_part, 1.0), jnp.inf)
    above = (1.0 + FINE) * jnp.minimum(above, largest - least_part) + FINE * largest
    noise = (0.5 * above + FINE * largest)[None]
    ends = (least * (1.0 - FINE))[None], (largest * (1.0 + FINE))[None]
    # The squares of all elements are rounded, and their sum.
    return Linearised([along], 0.5 * above[None], noise, *ends, rounding=BASIC * along.size)


Rule = Callable[[Domain, Sequence[Constant], list[Form]], Linearised]


def _univariate(
    function: Callable[..., Array],
    turns: Callable[[Array], Sequence[Array]],
    within: tuple[float, float] = (-jnp.inf, jnp.inf),
    rounding: float = BASIC,
    valid: Callable[[Array, Array], Any] | None = None,
    rising: bool = True,
    absolute: float = 0.0,
    otherwise: float = jnp.nan,
) -> Rule:
    """Return the rule of a function of one number: two parallel lines around its graph.

    Args:
        function: the function. It is monotone. It may take a constant as a second argument, at
            which it has its only kink.
        turns: the function from a slope to the points at which the derivative has that slope.
        within: the range of the function.
        rounding: the relative error of the loop's own function, in units.
        valid: whether the rule holds on an interval, given its ends. None stands for always.
        rising: whether the function rises.
        absolute: the absolute error of the loop's own function, in units.
        otherwise: a bound on what the function is where the rule does not hold. NaN stands for a
            result that may not be a number.
    """

    def rule(domain: Domain, constants: Sequence[Constant], x: list[Form]) -> Linearised:
        low, high = interval(x[0], domain)
        fixed = [constant.value for constant in constants]
        ends = function(low, *fixed), function(high, *fixed)
        width = high - low
        wide = width > 1e-9 * (jnp.abs(low) + jnp.abs(high))
        slope = jnp.where(wide, (ends[1] - ends[0]) / jnp.where(wide, width, 1.0), 0.0)
        inner = [jnp.clip(point, low, high) for point in fixed or turns(slope)]
        points = jnp.stack([low, high, *inner])
        values = function(points, *fixed)
        gaps = values - slope * points
        size = jnp.abs(slope) * jnp.maximum(jnp.abs(low), jnp.abs(high)) + jnp.abs(values).max(0)
        radius = sum(constant.radius for constant in constants)
        rough = FINE * size + radius
        noise = 0.5 * (gaps.max(0) - gaps.min(0)) * (1.0 + FINE) + rough
        bottom, top = (
            end + sign * jnp.where(jnp.isfinite(size), rough, FINE * jnp.abs(end) + radius)
            for end, sign in zip(ends if rising else ends[::-1], (-1.0, 1.0), strict=True)
        )
        fits = True if valid is None else valid(low, high)
        return Linearised(
            [slope],
            0.5 * (gaps.min(0) + gaps.max(0)),
            jnp.where(fits, noise, jnp.nan),
            jnp.where(fits, jnp.maximum(bottom, within[0]), -otherwise),
            jnp.where(fits, jnp.minimum(top, within[1]), otherwise),
            rounding,
            absolute,
        )

    return rule


def _even(function: Callable[[Array], Array], turns: Any, rounding: float = BASIC) -> Rule:
    """Return the rule of a function that falls to 0 and rises from there."""
    rule = _univariate(function, turns, rounding=rounding)

    def bounded(domain: Domain, constants: Sequence[Constant], x: list[Form]) -> Linearised:
        low, high = interval(x[0], domain)
        nearest = jnp.maximum(jnp.maximum(low, -high), 0.0)
        largest = jnp.maximum(jnp.abs(low), jnp.abs(high))
        return rule(domain, constants, x)._replace(
            low=(1.0 - FINE) * function(nearest), high=(1.0 + FINE) * function(largest)
        )

    return bounded


def _tanh_turns(slope: Array) -> list[Array]:
    point = jnp.arctanh(jnp.sqrt(jnp.clip(1.0 - slope, 0.0, 1.0)))
    return [point, -point]


def _atan_turns(slope: Array) -> list[Array]:
    point = jnp.sqrt(jnp.maximum(1.0 / slope - 1.0, 0.0))
    return [point, -point]


def _reciprocal_turns(slope: Array) -> list[Array]:
    point = 1.0 / jnp.sqrt(-slope)
    return [point, -point]


def _reciprocal(otherwise: float) -> Rule:
    return _univariate(
        lambda x: 1.0 / x,
        _reciprocal_turns,
        valid=lambda low, high: low * high > 0.0,
        rising=False,
        otherwise=otherwise,
    )


RULES: Mapping[str, Rule] = {
    "affine": _affine,
    "mul": _mul,
    "norm": _norm,
    "tanh": _univariate(jnp.tanh, _tanh_turns, within=(-1.0, 1.0), rounding=ELEMENTARY),
    "exp": _univariate(jnp.exp, lambda slope: [jnp.log(slope)], rounding=ELEMENTARY),
    "log": _univariate(
        jnp.log,
        lambda slope: [1.0 / slope],
        rounding=ELEMENTARY,
        valid=lambda low, high: low > 0.0,
    ),
    "sqrt": _univariate(jnp.sqrt, lambda slope: [0.25 / slope**2], valid=lambda low, _: low >= 0.0),
    "reciprocal": _reciprocal(otherwise=jnp.nan),
    "inverse": _reciprocal(otherwise=jnp.inf),
    "max": _univariate(jnp.maximum, lambda slope: [], rounding=0.0),
    "min": _univariate(jnp.minimum, lambda slope: [], rounding=0.0),
    "select": _select,
    "floor": _floor,
    "sin": _wave(jnp.sin, 0.0),
    "cos": _wave(jnp.cos, 0.5 * jnp.pi),
    "atan": _univariate(jnp.arctan, _atan_turns, rounding=0.0, absolute=ANGULAR),
    "square": _even(jnp.square, lambda slope: [0.5 * slope]),
    "abs": _even(jnp.abs, lambda slope: [jnp.zeros_like(slope)], rounding=0.0),
}
"""The rule of each operation."""
