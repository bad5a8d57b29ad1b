"""Vectors, frames and functions that are safe to differentiate."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Integer, Real, Shaped

from pathjax.compile import compute_once
from pathjax.core.types import Frame, Ray, Surface

# x, y and z, each a scalar or several lanes, as in the leaves of hierarchies.
Components = Float[Array, "3 *#lanes"] | Sequence[Float[Array, "*#lanes"]]


def dot(a: Components, b: Components) -> Float[Array, "*#lanes"]:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Components, b: Components) -> Float[Array, "3 *#lanes"]:
    """Vector product."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def smaller(a: Real[Array, "*#shape"], b: Real[Array, "*#shape"] | float) -> Real[Array, "*#shape"]:
    """Minimum in one `vmin`; `b` where either is NaN. (`jnp.minimum` spends four instructions on propagating NaN.)"""
    return jnp.where(a < b, a, b)


def larger(a: Real[Array, "*#shape"], b: Real[Array, "*#shape"] | float) -> Real[Array, "*#shape"]:
    """Maximum in one `vmax`; `b` where either is NaN."""
    return jnp.where(a > b, a, b)


def at(table: Shaped[Array, "..."], *index: Integer[Array, ""] | int) -> Shaped[Array, "..."]:
    """Return `table[index]` for indices known to be in range: one contiguous load.

    (Plain indexing, which counts negative indices from the end, and gathers cost a dozen instructions each in the
    kernel. Clamping an unsigned index takes two.)
    """
    if all(isinstance(i, int) for i in index):
        return table[index]
    rest = table.shape[len(index) :]
    start = [jnp.asarray(i, jnp.uint32) for i in index] + [jnp.uint32(0)] * len(rest)
    block = lax.dynamic_slice(table, start, (1,) * len(index) + rest, allow_negative_indices=False)
    return block.reshape(rest)


def integer_like(dtype: np.dtype) -> type[np.signedinteger]:
    """Return the integer type as wide as a float type."""
    return np.int64 if dtype == np.float64 else np.int32


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """sqrt(max(x, 0)), with derivative 0 where x <= 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_divide(a: Float[Array, "*#shape"] | float, b: Float[Array, "*#shape"]) -> Float[Array, "*#shape"]:
    """a / b, and 0 with derivative 0 where b is 0."""
    nonzero = b != 0
    return jnp.where(nonzero, a / jnp.where(nonzero, b, 1), 0)


def normalize(v: Float[Array, "3"]) -> Float[Array, "3"]:
    """v / |v|; the zero vector stays zero."""
    squared = dot(v, v)
    positive = squared > 0
    return jnp.where(positive, v * lax.rsqrt(jnp.where(positive, squared, 1)), 0)


def rescale(v: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return v over its largest component, so that squares and products of it neither overflow nor underflow."""
    largest = jnp.max(jnp.abs(v))
    return v / lax.stop_gradient(jnp.where(largest > 0, largest, 1))


# Taylor series on short ranges, exact to rounding: a few multiply-adds, where the general functions are library calls.


def _series(x: Float[Array, ""], coefficients: Sequence[float]) -> Float[Array, ""]:
    """sum(coefficients[k] x^k), k ascending."""
    total = jnp.zeros_like(x)
    for c in reversed(coefficients):
        total = total * x + c
    return total


def cos_sin_octant(x: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cosine and sine for |x| <= pi/4."""
    terms = range(5 if x.dtype == jnp.float32 else 9)
    squared = x * x
    cos, sin = ([(-1) ** k / math.factorial(2 * k + first) for k in terms] for first in (0, 1))
    return compute_once((_series(squared, cos), x * _series(squared, sin)))


def cos_sin_turns(u: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cosine and sine of 2 pi u for 0 <= u <= 1."""
    quarter = jnp.floor(4 * u + jnp.asarray(0.5, u.dtype))
    cos, sin = cos_sin_octant((u - quarter / 4) * (2 * math.pi))
    quarter = quarter.astype(jnp.int32)
    cos, sin = jnp.where(quarter & 1 == 1, -sin, cos), jnp.where(quarter & 1 == 1, cos, sin)
    sign = jnp.where(quarter & 2 == 2, -1, 1).astype(u.dtype)
    return sign * cos, sign * sin


def safe_atan2(y: Float[Array, ""], x: Float[Array, ""]) -> Float[Array, ""]:
    """atan2 with value and derivatives 0 at the origin."""
    origin = (x == 0) & (y == 0)
    steep = jnp.abs(y) > jnp.abs(x)
    low, high = jnp.where(steep, jnp.abs(x), jnp.abs(y)), jnp.where(steep, jnp.abs(y), jnp.abs(x))
    slope = low / jnp.where(origin, 1, high)
    # atan(s) = pi/4 + atan((s - 1) / (s + 1)) leaves |s| <= tan(pi/8).
    far = slope > math.tan(math.pi / 8)
    s = jnp.where(far, (slope - 1) / (slope + 1), slope)
    terms = range(10 if s.dtype == jnp.float32 else 20)
    angle = s * _series(s * s, [(-1) ** k / (2 * k + 1) for k in terms])
    angle = jnp.where(far, math.pi / 4 + angle, angle)
    angle = jnp.where(steep, math.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, math.pi - angle, angle)
    return jnp.where(origin, 0, jnp.where(y < 0, -angle, angle))


def turns(y: Float[Array, ""], x: Float[Array, ""]) -> Float[Array, ""]:
    """Angle of the point (x, y) from the x axis, in turns from 0 to 1; value and derivatives 0 at the origin."""
    angle = safe_atan2(y, x) / (2 * math.pi)
    return jnp.where(angle < 0, angle + 1, angle)


# Shares of red, green and blue in luminance: Rec. 709.
LUMINANCE = 0.2126, 0.7152, 0.0722


def luminance(rgb: Float[Array, "*shape 3"]) -> Float[Array, "*shape"]:
    """Rec. 709 luminance of linear RGB."""
    red, green, blue = LUMINANCE
    return rgb[..., 0] * red + rgb[..., 1] * green + rgb[..., 2] * blue


def frame_from_normal(n: Float[Array, "3"]) -> Frame:
    """Orthonormal frame around a unit normal (Duff et al. 2017, JCGT 6(1))."""
    sign = jnp.copysign(jnp.ones_like(n[2]), n[2])
    a = -1 / (sign + n[2])
    b = n[0] * n[1] * a
    s = jnp.stack([1 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]])
    t = jnp.stack([b, sign + n[1] * n[1] * a, -n[1]])
    return Frame(s, t, n)


def shading_frame(surface: Surface) -> Frame:
    """Frame around the shading normal, along the tangent where the surface has one."""
    n, s = surface.shading_n, surface.tangent
    return frame_from_normal(n) if s is None else Frame(s, cross(n, s), n)


def to_local(frame: Frame, v: Float[Array, "3"]) -> Float[Array, "3"]:
    return jnp.stack([dot(frame.s, v), dot(frame.t, v), dot(frame.n, v)])


def to_world(frame: Frame, v: Float[Array, "3"]) -> Float[Array, "3"]:
    return frame.s * v[0] + frame.t * v[1] + frame.n * v[2]


def offset_point(surface: Surface, d: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the point moved to the side of the surface that `d` points to, by the bound of its rounding error.

    The bound is relative to the coordinates that the point was computed from (PBRT, "Managing rounding error"), so a
    scene may have any size and position. The primitive itself is excluded by index, so thinner sheets stay solid.
    """
    return surface.p + surface.n * jnp.copysign(surface.margin, dot(surface.n, d))


def spawn_ray(surface: Surface, d: Float[Array, "3"], primitive: Int[Array, ""]) -> Ray:
    """Return the ray that leaves `primitive` at `surface` in the unit direction d."""
    return Ray(offset_point(surface, d), d, jnp.full_like(surface.margin, jnp.inf), primitive)
