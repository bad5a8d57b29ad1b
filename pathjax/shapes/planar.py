"""Rectangles (parallelograms where sheared) and disks (ellipses): a plane, and two coordinates on it.

A point of the plane is c + x a + y b; the shape is |x|, |y| <= 1 for a rectangle and x^2 + y^2 <= 1 for a disk.
One test stands for the two triangles of a rectangle, and a disk is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from pathjax.core.math import at, dot, larger, safe_atan2, safe_divide, safe_sqrt
from pathjax.core.types import Surface
from pathjax.core.warp import square_to_disk
from pathjax.shapes.accel.leaves import numbers_of, rows_of
from pathjax.shapes.accel.traverse import Tree
from pathjax.shapes.box import Boxes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Planar:
    leaves: jax.Array  # (L, 15, W) bits of `leaf_numbers`, NaN in empty lanes; row of each lane
    tree: Tree | None  # None: L = 1, every ray tests all
    frames: jax.Array  # (P, 4, 3): c, a, b, unit normal
    boxes: Boxes | None  # which find the last of the rectangles, in place of the leaves
    margins: jax.Array | None  # (P,) of `coincident`; None: no other primitive lies in any of these
    disk: bool = field(metadata={"static": True})


def leaf_numbers(frames):
    """(P, 4, 3) float64 -> (P, 14): c, normal, dual vectors of a and b, bound on the coordinates' rounding."""
    c, a, b, n = np.moveaxis(np.asarray(frames, np.float64), 1, 0)
    normal = np.cross(a, b)
    squared = (normal**2).sum(-1, keepdims=True)
    dual_a, dual_b = np.cross(b, normal) / squared, np.cross(normal, a) / squared
    # A coordinate is computed from c - o and t d, whose lengths differ by at most the radius: its error is bounded by
    # |dual| (2 t + radius) roundings.
    radius = np.sqrt((a**2).sum(-1) + (b**2).sum(-1))
    slope_a, slope_b = np.sqrt((dual_a**2).sum(-1)), np.sqrt((dual_b**2).sum(-1))
    slope = np.maximum(slope_a, slope_b)
    return np.concatenate([c, n, dual_a, dual_b, np.stack([slope * radius, 2 * slope], -1)], -1)


def corners(frames):
    """(P, 4, 3) -> (P, 4, 3) of the rectangle, or of that around the disk."""
    c, a, b, _ = np.moveaxis(frames, 1, 0)
    return np.stack([c - a - b, c + a - b, c + a + b, c - a + b], 1)


def bounds(frames, disk):
    """(P, 4, 3) -> two (P, 3)."""
    c, a, b, _ = np.moveaxis(frames, 1, 0)
    reach = np.sqrt(a**2 + b**2) if disk else np.abs(a) + np.abs(b)
    return c - reach, c + reach


def prepare(o, d):
    return o, d


def intersect(table: Planar, leaf, prepared, start):
    """Of the W shapes of a leaf.

    Args:
        start: () int32 row of the shape that the ray starts on, which is flat and not hit again, or of nothing here.
    Returns:
        distances (W,), NaN or inf where missed, possibly negative where behind; rows (W,).
    The border is inclusive by the rounding error of the coordinate, so faces that share an edge leave no gap.
    """
    o, d = prepared
    block = at(table.leaves, leaf)
    leaf = numbers_of(block, d.dtype)
    c, n, dual_a, dual_b, error = leaf[0:3], leaf[3:6], leaf[6:9], leaf[9:12], leaf[12:14]
    to_c = [c[axis] - o[axis] for axis in range(3)]
    t = dot(n, to_c) / dot(n, d)
    p = [t * d[axis] - to_c[axis] for axis in range(3)]
    x, y = dot(dual_a, p), dot(dual_b, p)
    error = error * (4 * np.finfo(leaf.dtype).eps)
    reach = (1 + error[0]) + t * error[1]
    inside = x * x + y * y <= reach * reach if table.disk else larger(jnp.abs(x), jnp.abs(y)) <= reach
    rows = rows_of(block)
    return jnp.where(inside & (rows != start), t, jnp.inf), rows


def count(table: Planar) -> int:
    return table.frames.shape[0]


def surface(table: Planar, row, o, d, t) -> Surface:
    """Differentiable in the ray; the point lies on the plane to the last bits.

    No margin where nothing else lies in the plane: the primitive is excluded by number, and its few neighbours err only
    within rounding of the shared edge. So a sheet of glass may be as thin as the coordinates can tell.
    """
    c, a, b, n = at(table.frames, row)
    from_c = o - c
    distance = -safe_divide(dot(n, from_c), dot(n, d))
    q = from_c + distance * d
    p = c + (q - dot(n, q) * n)
    margin = jnp.zeros_like(distance) if table.margins is None else at(table.margins, row)
    aa, ab, bb = dot(a, a), dot(a, b), dot(b, b)
    qa, qb = dot(q, a), dot(q, b)
    scale = 1 / (aa * bb - ab * ab)
    x, y = (bb * qa - ab * qb) * scale, (aa * qb - ab * qa) * scale
    if table.disk:
        r = safe_sqrt(x * x + y * y)
        angle = safe_atan2(y, x) / (2 * math.pi)
        uv = jnp.stack([r, jnp.where(angle < 0, angle + 1, angle)])
    else:
        uv = jnp.stack([(x + 1) / 2, (y + 1) / 2])
    return Surface(p, n, margin, n, uv)


def sample(table: Planar, row, u):
    """Uniform point: u (2,) -> point (3,), unit normal (3,), rounding error along it ()."""
    c, a, b, n = at(table.frames, row)
    xy = square_to_disk(u) if table.disk else 2 * u - 1
    margin = dot(jnp.abs(n), jnp.abs(c) + jnp.abs(a) + jnp.abs(b)) * (4 * np.finfo(c.dtype).eps)
    return c + xy[0] * a + xy[1] * b, n, margin


def area(frames, disk):
    """(P, 4, 3) -> (P,)."""
    return np.linalg.norm(np.cross(frames[:, 1], frames[:, 2]), axis=-1) * (math.pi if disk else 4)
