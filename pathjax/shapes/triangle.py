"""Triangles: watertight intersection, surface, area sampling."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax.core.math import at, cross, dot, larger, normalize, rescale, safe_divide
from pathjax.core.types import Surface
from pathjax.core.warp import square_to_triangle
from pathjax.shapes.accel.leaves import numbers_of, rows_of
from pathjax.shapes.accel.traverse import Tree


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Triangles:
    leaves: jax.Array  # (L, 10, W) bits of x of the three vertices, y, z, NaN in empty lanes; row of each lane
    tree: Tree | None  # None: L = 1, every ray tests all
    vertices: jax.Array  # (P, 3, 3) by row: vertex, axis
    normals: jax.Array | None  # (P, 3, 3) at the vertices; None: no triangle of the scene is smooth
    uv: jax.Array | None  # (P, 3, 2)
    margins: jax.Array | None  # (P,) of `coincident`, beside their own; None: nothing flat lies in any of these


def leaf_numbers(vertices):
    """(P, 3, 3) -> (P, 9), what a leaf keeps of each triangle: x of the vertices, y, z."""
    return np.swapaxes(np.asarray(vertices), 1, 2).reshape(-1, 9)


def bounds(vertices):
    """(P, 3, 3) -> two (P, 3)."""
    a, b, c = np.moveaxis(vertices, 1, 0)  # NumPy reduces short axes slowly
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def prepare(o, d):
    """Constants of a ray: the shear that turns it into the z axis (Woop, Benthin, Wald 2013, JCGT 2(1)).

    Returns:
        (3,) int32 axes x, y, z, and (6,) origin and shear in that order.
    """
    size = jnp.abs(d)
    z = jnp.where(size[0] > size[1], jnp.where(size[0] > size[2], 0, 2), jnp.where(size[1] > size[2], 1, 2))
    z = z.astype(jnp.int32)
    x = jnp.where(z == 2, 0, z + 1)
    y = jnp.where(x == 2, 0, x + 1)
    scale = 1 / at(d, z)
    shear = [at(d, x) * scale, at(d, y) * scale, scale]
    return jnp.stack([x, y, z]), jnp.stack([at(o, x), at(o, y), at(o, z), *shear])


def intersect(table: Triangles, leaf, prepared, start):
    """Of the W triangles of a leaf.

    Args:
        start: () int32 row of the triangle that the ray starts on, which is flat and not hit again, or of nothing here.
    Returns:
        distances (W,), NaN or inf where missed, possibly negative where behind; rows (W,).
    Watertight: edges are inclusive by the rounding error of their edge function. (Contraction to fused multiply-adds
    leaves the plain functions of two triangles that share an edge with different signs.)
    """
    axes, ray = prepared
    _, _, width = table.leaves.shape

    def coordinates(axis):
        start = [jnp.asarray(i, jnp.uint32) for i in (leaf, 3 * axis, 0)]
        block = lax.dynamic_slice(table.leaves, start, (1, 3, width), allow_negative_indices=False)[0]
        return list(numbers_of(block, ray.dtype))

    # Vertex by vertex: XLA does not vectorise loops over (3, W).
    z = [c - ray[2] for c in coordinates(axes[2])]
    x = [c - ray[0] - ray[3] * z for c, z in zip(coordinates(axes[0]), z, strict=True)]
    y = [c - ray[1] - ray[4] * z for c, z in zip(coordinates(axes[1]), z, strict=True)]
    tolerance = 2 * np.finfo(ray.dtype).eps

    def edge(i, j):
        a, b = x[i] * y[j], y[i] * x[j]
        return a - b, tolerance * (jnp.abs(a) + jnp.abs(b))

    (u, u_error), (v, v_error), (w, w_error) = edge(2, 1), edge(0, 2), edge(1, 0)
    front = (u >= -u_error) & (v >= -v_error) & (w >= -w_error)
    back = (u <= u_error) & (v <= v_error) & (w <= w_error)
    det, error = u + v + w, u_error + v_error + w_error
    moment = u * z[0] + v * z[1] + w * z[2]
    t = moment * ray[5] / det
    reach = larger(larger(jnp.abs(z[0]), jnp.abs(z[1])), jnp.abs(z[2]))
    # Seen edge-on, or tiny and far from the ray, all three errors rule and every edge is inclusive. And a ray that
    # starts in the plane, or on a neighbour's edge, finds a distance that is rounding alone, below half of the errors.
    sound = (jnp.abs(det) > error) & (jnp.abs(moment) > reach * (error / 2))
    rows = rows_of(at(table.leaves, leaf))
    return jnp.where((front | back) & sound & (rows != start), t, jnp.inf), rows


def count(table: Triangles) -> int:
    return table.vertices.shape[0]


def surface(table: Triangles, row, o, d, t) -> Surface:
    """Differentiable in the ray; the point comes from barycentrics, so it lies on the triangle to the last bits."""
    vertices = at(table.vertices, row)
    edge1, edge2 = vertices[1] - vertices[0], vertices[2] - vertices[0]
    s = o - vertices[0]
    q = cross(s, edge1)
    h = cross(d, edge2)
    scale = safe_divide(1, dot(edge1, h))
    b1 = jnp.clip(dot(s, h) * scale, 0, 1)
    b2 = jnp.clip(dot(d, q) * scale, 0, 1 - b1)
    b0 = 1 - b1 - b2
    n = _normal(edge1, edge2)

    def interpolate(values):
        return b0 * values[0] + b1 * values[1] + b2 * values[2]

    shading_n = n
    if table.normals is not None:
        shading_n = normalize(interpolate(at(table.normals, row)))
    uv = jnp.stack([b1, b2]) if table.uv is None else interpolate(at(table.uv, row))
    margin = dot(jnp.abs(n), _point_error(vertices))
    if table.margins is not None:
        margin = margin + at(table.margins, row)
    return Surface(interpolate(vertices), n, margin, shading_n, uv)


def sample(table: Triangles, row, u):
    """Uniform point of the triangle: u (2,) -> point (3,), unit normal (3,), rounding error along it ()."""
    vertices = at(table.vertices, row)
    b = square_to_triangle(u)
    edge1, edge2 = vertices[1] - vertices[0], vertices[2] - vertices[0]
    n = _normal(edge1, edge2)
    p = vertices[0] + b[0] * edge1 + b[1] * edge2
    return p, n, dot(jnp.abs(n), _point_error(vertices))


def _normal(edge1, edge2):
    # Edges of length 1 first: the square of a product of tiny ones underflows.
    return normalize(cross(rescale(edge1), rescale(edge2)))


def _point_error(vertices):
    """(3, 3) -> (3,), bound on the rounding error of an interpolated vertex, and of those of a coplanar triangle."""
    return (3 * np.finfo(vertices.dtype).eps) * jnp.max(jnp.abs(vertices), 0)


def face_normals(vertices):
    """(P, 3, 3) -> (P, 3, 3), the unit normal of each triangle at its three vertices."""
    n = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    return np.repeat((n / np.linalg.norm(n, axis=-1, keepdims=True))[:, None], 3, axis=1)


def area(vertices):
    """(P, 3, 3) -> (P,)."""
    return np.linalg.norm(np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]), axis=-1) / 2
