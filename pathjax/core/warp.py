"""Maps from uniform numbers to points and directions, each beside its density."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pathjax.core.math import cos_sin_octant, cos_sin_turns, safe_divide, safe_sqrt, smaller


def chosen(u: Float[Array, " numbers"], chance: Float[Array, ""]) -> tuple[Bool[Array, ""], Float[Array, " numbers"]]:
    """Choose between two by u[0]; return whether the first is chosen, and u with u[0] rescaled to be uniform again.

    chance: probability of the first. After an unlikely choice the rescaled number has few digits.
    """
    first = u[0] < chance
    rest = safe_divide(u[0] - jnp.where(first, 0, chance), jnp.where(first, chance, 1 - chance))
    below_1 = float(1 - jnp.finfo(u.dtype).epsneg)
    return first, jnp.concatenate([smaller(rest, below_1)[None], u[1:]])


def square_to_disk(u: Float[Array, "2"]) -> Float[Array, "2"]:
    """Concentric map of [0, 1)^2 to the unit disk (Shirley and Chiu 1997), density 1/pi."""
    x, y = 2 * u[0] - 1, 2 * u[1] - 1
    flat = jnp.abs(x) > jnp.abs(y)
    r = jnp.where(flat, x, y)
    ratio = jnp.where(flat, y, x) / jnp.where(r == 0, 1, r)
    cos, sin = cos_sin_octant(ratio * (math.pi / 4))
    return r * jnp.stack([jnp.where(flat, cos, sin), jnp.where(flat, sin, cos)])


def square_to_cosine_hemisphere(u: Float[Array, "2"]) -> Float[Array, "3"]:
    """Map to unit directions with z >= 0, cosine-weighted."""
    p = square_to_disk(u)
    return jnp.stack([p[0], p[1], safe_sqrt(1 - p[0] * p[0] - p[1] * p[1])])


def square_to_cosine_hemisphere_pdf(w: Float[Array, "3"]) -> Float[Array, ""]:
    """Density in 1/sr."""
    return jnp.maximum(w[2], 0) / math.pi


def square_to_sphere(u: Float[Array, "2"]) -> Float[Array, "3"]:
    """Map to unit directions, density SPHERE_PDF in 1/sr."""
    z = 1 - 2 * u[1]
    r = safe_sqrt(1 - z * z)
    cos, sin = cos_sin_turns(u[0])
    return jnp.stack([r * cos, r * sin, z])


SPHERE_PDF = 1 / (4 * math.pi)


def square_to_cone(u: Float[Array, "2"], one_minus_cos: Float[Array, ""]) -> Float[Array, "3"]:
    """Map to uniform unit directions around +z, up to the angle whose 1 - cos is given.

    The argument is 1 - cos instead of cos, so that a small distant light keeps its digits.
    """
    h = u[0] * one_minus_cos
    r = safe_sqrt(h * (2 - h))
    cos, sin = cos_sin_turns(u[1])
    return jnp.stack([r * cos, r * sin, 1 - h])


def cone_pdf(one_minus_cos: Float[Array, ""]) -> Float[Array, ""]:
    """Density in 1/sr inside the cone."""
    return 1 / ((2 * math.pi) * one_minus_cos)


def square_to_triangle(u: Float[Array, "2"]) -> Float[Array, "2"]:
    """Map to barycentric (b1, b2) of a uniform point (Heitz 2019, "A low-distortion map"), density 1/area."""
    x, y = u[0], u[1]
    above = y > x
    b1 = jnp.where(above, x / 2, x - y / 2)
    b2 = jnp.where(above, y - x / 2, y / 2)
    return jnp.stack([b1, b2])


def tent(u: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Map [0, 1) to [-1, 1], density 1 - |x|."""
    low = u < 0.5
    return jnp.where(low, safe_sqrt(2 * u) - 1, 1 - safe_sqrt(2 - 2 * u))


def tent_pdf(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    return jnp.maximum(1 - jnp.abs(x), 0)
