"""Sine and cosine together, arctangent and wrapped angles, several times cheaper in float32 than XLA's own on a CPU."""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsafe.types import Number

_QUARTER = (1.5703125, 4.837512969970703e-4, 7.549789948768648e-8)
"""π/2 in three parts; the first two have so few bits that a multiple of them up to 2¹³ is exact."""
_SINE = (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1)
_COSINE = (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2)
_ARCTANGENT = (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1)

_traced_once = functools.partial(jax.jit, inline=True)
"""A program calls these functions hundreds of times; tracing each call afresh took two thirds of its tracing time."""


@_traced_once
def sin_cos(x: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """(sin x, cos x), within 1e-7 for |x| ≤ 1e4 in float32; other types take JAX's functions.

    The angle is reduced to [−π/4, π/4] about the nearest multiple of π/2 (Cody and Waite), where a minimax polynomial of
    degree 7 or 8 stands for each function (Moshier's Cephes). Beyond 1e4 the reduction loses digits; the values stay in
    [−1, 1].
    """
    return _sin_cos(x)


@jax.custom_jvp
def _sin_cos(x: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    x = jnp.asarray(x)
    if x.dtype != jnp.float32:
        return jnp.sin(x), jnp.cos(x)
    n = jnp.round(x * (2.0 / math.pi))
    r = ((x - n * _QUARTER[0]) - n * _QUARTER[1]) - n * _QUARTER[2]
    r = jnp.clip(r, -math.pi / 4 - 0.01, math.pi / 4 + 0.01)
    z = r * r
    sine = ((_SINE[0] * z + _SINE[1]) * z + _SINE[2]) * z * r + r
    cosine = ((_COSINE[0] * z + _COSINE[1]) * z + _COSINE[2]) * z * z - 0.5 * z + 1.0
    quadrant = n.astype(jnp.int32)
    swap = (quadrant & 1) == 1
    s, c = jnp.where(swap, cosine, sine), jnp.where(swap, sine, cosine)
    return jnp.where((quadrant & 2) == 2, -s, s), jnp.where(((quadrant + 1) & 2) == 2, -c, c)


@_sin_cos.defjvp
def _derivative(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    sine, cosine = _sin_cos(*primals)
    return (sine, cosine), (cosine * tangents[0], -sine * tangents[0])


def tan(x: Number) -> Any:
    """Tangent of x as sin x/cos x."""
    sine, cosine = sin_cos(x)
    return sine / cosine


@_traced_once
def arctan(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Arctangent, within 2e-7 in float32; other types take JAX's function.

    Arguments beyond tan π/8 are turned by π/4, those beyond tan 3π/8 by π/2; what is left is a polynomial of degree 9
    (Moshier's Cephes).
    """
    return _arctan(x)


@jax.custom_jvp
def _arctan(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    x = jnp.asarray(x)
    if x.dtype != jnp.float32:
        return jnp.arctan(x)
    size = jnp.abs(x)
    far, near = size > math.tan(3 * math.pi / 8), size > math.tan(math.pi / 8)
    turned = jnp.where(far, -1.0, jnp.where(near, size - 1.0, size)) / jnp.where(
        far, size, jnp.where(near, size + 1.0, 1.0)
    )
    base = jnp.where(far, math.pi / 2, jnp.where(near, math.pi / 4, 0.0))
    z = turned * turned
    rest = (((_ARCTANGENT[0] * z + _ARCTANGENT[1]) * z + _ARCTANGENT[2]) * z + _ARCTANGENT[3]) * z * turned + turned
    return jnp.copysign(base + rest, x)


@_arctan.defjvp
def _slope(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    return _arctan(*primals), tangents[0] / (1.0 + primals[0] * primals[0])


def wrap(x: Number, low: float, period: float) -> Any:
    """X + k · period in [low, low + period), k whole."""
    return x - period * jnp.floor((x - low) / period)
