"""Spheres, from marbles to the walls of radius 1e5 of the classic boxes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.core.math import (
    at,
    dot,
    frame_from_normal,
    larger,
    normalize,
    safe_atan2,
    safe_divide,
    safe_sqrt,
    to_world,
)
from pathjax.core.types import Surface
from pathjax.core.warp import SPHERE_PDF, cone_pdf, square_to_cone, square_to_sphere
from pathjax.shapes.accel.leaves import numbers_of, rows_of
from pathjax.shapes.accel.traverse import Tree


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spheres:
    leaves: jax.Array  # (L, 5, W) bits of center, radius, NaN in empty lanes; row of each lane
    tree: Tree | None  # None: L = 1, every ray tests all
    balls: jax.Array  # (P, 4) center, radius
    to_local: jax.Array  # (P, 3, 3) rotation into the frame of its uv
    sign: jax.Array  # (P,) -1 where the normal points inwards
    margins: jax.Array | None  # (P,) of `coincident`; None: no two of these coincide


def leaf_numbers(balls):
    return balls


def bounds(balls):
    """(P, 4) -> two (P, 3)."""
    return balls[:, :3] - balls[:, 3:], balls[:, :3] + balls[:, 3:]


def prepare(o, d):
    return o, d


def intersect(table: Spheres, leaf, prepared, start):
    """Of the W spheres of a leaf.

    Args:
        start: () int32 row of the sphere that the ray starts on, whose root there is exactly 0, or of nothing here.
    Returns:
        distances (W,), NaN where missed, negative where behind; rows (W,).

    Discriminant from the vector of closest approach, roots without cancellation (Haines, Gunther, Akenine-Moller 2019,
    "Precision improvements for ray/sphere intersection").
    """
    o, d = prepared
    block = at(table.leaves, leaf)
    leaf = numbers_of(block, d.dtype)
    radius = leaf[3]
    f = [o[axis] - leaf[axis] for axis in range(3)]
    b = -dot(f, d)
    closest = [f[axis] + b * d[axis] for axis in range(3)]
    half_chord = jnp.sqrt(radius * radius - dot(closest, closest))  # NaN: a miss, and every comparison drops it
    f_length = jnp.sqrt(dot(f, f))
    rows = rows_of(block)
    c = jnp.where(rows == start, 0, (f_length - radius) * (f_length + radius))
    q = b + jnp.copysign(half_chord, b)
    other = c / q
    near, far = jnp.where(q < other, q, other), jnp.where(q < other, other, q)
    return jnp.where(near > 0, near, far), rows


def count(table: Spheres) -> int:
    return table.balls.shape[0]


def surface(table: Spheres, row, o, d, t) -> Surface:
    """Differentiable in the ray; the point is projected back onto the sphere. No margin but where two coincide."""
    ball = at(table.balls, row)
    center, radius = ball[:3], ball[3]
    f = o - center
    b = -dot(f, d)
    closest = f + b * d
    half_chord = safe_sqrt(radius * radius - dot(closest, closest))
    # t says which of the two roots was found.
    outward = normalize(closest + jnp.copysign(half_chord, t - b) * d)
    local = at(table.to_local, row) @ outward
    phi = safe_atan2(local[1], local[0]) / (2 * math.pi)
    theta = safe_atan2(safe_sqrt(local[0] * local[0] + local[1] * local[1]), local[2]) / math.pi
    uv = jnp.stack([jnp.where(phi < 0, phi + 1, phi), theta])
    n = outward * at(table.sign, row)
    margin = jnp.zeros_like(radius) if table.margins is None else at(table.margins, row)
    return Surface(center + radius * outward, n, margin, n, uv)


def _one_minus_cos(ball, ref):
    """1 - cos of the half angle under which a point sees the ball, and whether it lies outside."""
    f = ref - ball[:3]
    squared, radius2 = dot(f, f), ball[3] * ball[3]
    outside = squared > radius2 * (1 + 4 * np.finfo(ball.dtype).eps)
    sin2 = jnp.where(outside, radius2 / jnp.where(outside, squared, 1), 1)
    return sin2 / (1 + safe_sqrt(1 - sin2)), outside


def sample_direction(table: Spheres, row, ref, u):
    """Uniform over the cone that the sphere fills seen from `ref`, or over its area from inside.

    Returns:
        direction (3,) unit, distance (), unit normal there (3,), pdf [1/sr].
    """
    ball = at(table.balls, row)
    center, radius = ball[:3], ball[3]
    one_minus_cos, outside = _one_minus_cos(ball, ref)
    to_center = center - ref
    axis = normalize(to_center)
    frame = frame_from_normal(axis)
    # Read by five results: without the barrier each computes it again.
    d = lax.optimization_barrier(to_world(frame, square_to_cone(u, one_minus_cos)))
    b = dot(to_center, d)
    closest = b * d - to_center
    distance = larger(b - safe_sqrt(radius * radius - dot(closest, closest)), jnp.zeros_like(b))
    outward = normalize(ref + distance * d - center)

    from_inside = square_to_sphere(u)
    to_p = center + radius * from_inside - ref
    d_inside = normalize(to_p)
    distance_inside = jnp.sqrt(dot(to_p, to_p))

    outward = jnp.where(outside, outward, from_inside)
    d = jnp.where(outside, d, d_inside)
    distance = jnp.where(outside, distance, distance_inside)
    return d, distance, outward * at(table.sign, row), _pdf(ball, one_minus_cos, outside, outward, d, distance)


def pdf_direction(table: Spheres, row, ref, d, distance, n):
    """Density [1/sr] with which `sample_direction` finds the point at `distance`, whose normal is n."""
    ball = at(table.balls, row)
    one_minus_cos, outside = _one_minus_cos(ball, ref)
    return _pdf(ball, one_minus_cos, outside, n, d, distance)


def _pdf(ball, one_minus_cos, outside, n, d, distance):
    by_area = SPHERE_PDF * safe_divide(distance * distance, jnp.abs(dot(n, d)) * ball[3] * ball[3])
    return jnp.where(outside, cone_pdf(one_minus_cos), by_area)


def area(balls):
    """(P, 4) -> (P,)."""
    return 4 * math.pi * balls[:, 3] ** 2
