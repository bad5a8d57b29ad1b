"""All shapes of a scene behind three queries: the closest hit of a ray, whether it is occluded, the surface at a hit.

Hits are found on detached rays; `surface` then recomputes the point from the ray, differentiably.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax.compile import compute_once, register_dataclass
from pathjax.core.math import at, dot, frame_from_normal, integer_like, safe_divide, smaller
from pathjax.core.types import Hit, Ray, Surface
from pathjax.shapes.accel import traverse as bvh
from pathjax.shapes.shape import Lamps, LampSample, Searched, Table

# As a primitive index: no hit. As the bits of a float32 distance: beyond infinity.
NO_HIT = np.int32(0x7FFFFFFF)


@register_dataclass
@dataclass(frozen=True)
class Geometry:
    tables: tuple[Table, ...]  # one for each kind of primitive present; primitives are numbered through them in order
    shape: Int[Array, " P"]  # index in the scene file of each primitive's shape
    light: Int[Array, " P"] | None  # index of each primitive's light; -1: emits nothing. None: lights not yet built
    tangents: bool = field(default=False, metadata={"static": True})  # whether `surface` returns these fields
    along: bool = field(default=False, metadata={"static": True})
    corners: bool = field(default=False, metadata={"static": True})


def firsts(geometry: Geometry) -> list[int]:
    """Return the index of the first primitive of each table."""
    counts = [table.count for table in geometry.tables]
    return np.cumsum([0, *counts])[:-1].tolist()


def closest_hit(geometry: Geometry, ray: Ray) -> Hit:
    """Find the first primitive that the ray meets at 0 < t <= ray.t_max; among coincident ones the lowest index."""
    none = jnp.int32(NO_HIT)
    ray = jax.tree.map(lax.stop_gradient, ray)

    def test_one(distances, rows, first, t, primitive):
        (distance,), (candidate,) = compute_once((distances, rows + first))
        nearer = (distance > 0) & ((distance < t) | ((distance == t) & (primitive == none)))
        return jnp.where(nearer, distance, t), jnp.where(nearer, candidate, primitive)

    def search(traverse, intersect, first, t, primitive):
        def row_in(leaf):
            """Return the nearest primitive of a leaf; if coincident, the lowest row, as rows ascend with the lanes."""
            distances, rows = intersect(leaf)

            def pick():
                order = _order(distances)
                lanes = jnp.arange(len(order), dtype=jnp.int32)
                tied = jnp.sum(jnp.left_shift((order == _least(order)).astype(jnp.int32), lanes), dtype=jnp.int32)
                return at(rows, lax.population_count(~tied & (tied - 1)))

            # A branch reads operands computed before it; without one, each reader would compute the distances again.
            return lax.cond(leaf >= 0, pick, lambda: none)

        def lowest_at(distance, row):
            """Return the lowest row of all that are hit at this distance, given one of them."""
            wanted = _order(distance)

            def lower(leaf, t, row):
                distances, rows = intersect(leaf)
                return t, jnp.minimum(row, jnp.min(jnp.where(_order(distances) == wanted, rows, none)))

            return traverse(lower, distance, row)[1]

        # Traversal keeps only the nearest leaf; which of its primitives is hit is determined at the end. `found` is
        # twice the leaf with the nearest hit, plus 1 if another leaf has a hit at the same distance; -1: no hit yet.
        def leaf_test(leaf, t, found):
            nearest = jnp.min(_order(intersect(leaf)[0]))
            beyond = lax.bitcast_convert_type(jnp.maximum(_bits(t), 0), nearest.dtype)
            tied = (nearest + 1 == beyond) & (found >= 0)
            better = (nearest < beyond) & ~tied
            t = jnp.where(better, lax.bitcast_convert_type(nearest + 1, t.dtype), t)
            return t, jnp.where(better, 2 * leaf, found | tied.astype(jnp.int32))

        def result(nearest, found):
            def compare():
                row = row_in(found >> 1)
                row = lax.cond(found & 1 == 1, lambda: lowest_at(nearest, row), lambda: row)
                better = (nearest < t) | (row + first < primitive)
                return jnp.where(better, nearest, t), jnp.where(better, row + first, primitive)

            return lax.cond(found >= 0, compare, lambda: (t, primitive))

        return traverse(leaf_test, t, jnp.int32(-1), result)

    # A miss is infinitely far, so the bound on t must be finite.
    farthest = smaller(ray.t_max, jnp.full_like(ray.t_max, jnp.finfo(ray.t_max.dtype).max))
    t, primitive = _visit(geometry, ray, test_one, search, farthest, none)
    found = primitive != none
    shape = at(geometry.shape, jnp.where(found, primitive, 0)) if geometry.tables else none
    return Hit(jnp.where(found, t, jnp.inf), jnp.where(found, primitive, -1), jnp.where(found, shape, -1))


def occluded(geometry: Geometry, ray: Ray, target: Int[Array, ""]) -> Bool[Array, ""]:
    """Return whether any primitive but `target` lies at 0 < t < ray.t_max."""

    def test_one(distances, rows, first, t, primitive):
        blocked = jnp.any((distances > 0) & (distances < t) & (rows != target - first))
        return jnp.where(blocked, -1, t), primitive

    def search(traverse, intersect, first, t, primitive):
        def leaf_test(leaf, t, primitive):
            distances, rows = intersect(leaf)
            order = _order(distances)
            before = order < lax.bitcast_convert_type(jnp.maximum(_bits(t), 1) - 1, order.dtype)
            # Integer sums vectorise, reductions of booleans do not.
            blocked = jnp.sum((before & (rows != target - first)).astype(jnp.int32)) != 0
            return jnp.where(blocked, -1, t), primitive

        return traverse(leaf_test, t, primitive)

    ray = jax.tree.map(lax.stop_gradient, ray)
    t, _ = _visit(geometry, ray, test_one, search, ray.t_max, jnp.int32(NO_HIT))
    return t < 0


def surface(geometry: Geometry, ray: Ray, hit: Hit) -> Surface:
    """Return the surface at the hit, differentiable in the ray. A miss gives the surface of some primitive."""
    first = firsts(geometry)
    primitive = jnp.maximum(hit.primitive, 0)
    names = [name for table in geometry.tables for name in table.attributes]

    def of(table, start):
        def see():
            row = jnp.maximum(primitive - start, 0)
            seen = table.surface(row, ray.o, ray.d, hit.t)
            if geometry.tangents:
                seen = seen._replace(tangent=_tangent(table.along_u(row, seen), seen.shading_n))
            if geometry.corners:
                seen = seen._replace(corners=table.corners(row, ray.o, ray.d))
            if names and seen.attributes is None:
                seen = seen._replace(attributes=dict.fromkeys(names, jnp.zeros_like(seen.p)))
            if geometry.along:
                seen = seen._replace(along=_along(lambda o: table.surface(row, o, ray.d, hit.t), ray.o, seen.n))
            return seen

        return see

    return switch_by_range(primitive, first, [of(*pair) for pair in zip(geometry.tables, first, strict=True)])


def _tangent(along_u, n):
    """Return the unit vector of `along_u` made perpendicular to n; an arbitrary one if u is constant on the surface."""
    across = along_u - dot(along_u, n) * n
    squared = dot(across, across)
    found = squared > 0
    return jnp.where(found, across * lax.rsqrt(jnp.where(found, squared, 1)), frame_from_normal(n).s)


def _along(surface, o, n):
    """Return the derivatives of the point in u and in v, detached, from those of both as the ray moves sideways."""
    across = frame_from_normal(n)

    def moved(direction):
        return jax.jvp(lambda o: (lambda seen: (seen.p, seen.uv))(surface(o)), (o,), (direction,))[1]

    (p_s, uv_s), (p_t, uv_t) = compute_once(lax.stop_gradient((moved(across.s), moved(across.t))))
    scale = safe_divide(1, uv_s[0] * uv_t[1] - uv_s[1] * uv_t[0])
    return (uv_t[1] * p_s - uv_s[1] * p_t) * scale, (uv_s[0] * p_t - uv_t[0] * p_s) * scale


def emits(geometry: Geometry, hit: Hit) -> Bool[Array, ""]:
    """Return whether the hit primitive emits."""
    return (hit.primitive >= 0) & (at(geometry.light, jnp.maximum(hit.primitive, 0)) >= 0)


def sample_lamp(
    geometry: Geometry,
    lamps: Lamps,
    lamp: Int[Array, ""],
    ref: Float[Array, "3"],
    u: Float[Array, "2"],
    u_part: Float[Array, ""],
) -> LampSample:
    """Sample a point of a lamp as seen from `ref`: uniform in area, for spheres in the cone that they subtend.

    lamp: row of `lamps`; u_part: chooses the triangle of a mesh.
    """
    first = firsts(geometry)

    def of(index):
        def draw():
            drawn = geometry.tables[index].sample_lamp(lamps, lamp, ref, u, u_part)
            return drawn._replace(primitive=drawn.primitive + first[index])

        return draw

    return _switch_by_lamp(lamps, lamp, of)


def lamp_density(
    geometry: Geometry, lamps: Lamps, lamp: Int[Array, ""], ray: Ray, hit: Hit, surface: Surface
) -> Float[Array, ""]:
    """Return the density [1/sr] with which `sample_lamp`, from ray.o, draws the point of this lamp that the ray hit."""
    first = firsts(geometry)

    def of(index):
        return lambda: geometry.tables[index].lamp_density(lamps, lamp, first[index], ray, hit, surface)

    return _switch_by_lamp(lamps, lamp, of)


def _switch_by_lamp(lamps, lamp, of):
    branches = [of(index) for index in lamps.tables]
    return branches[0]() if len(branches) == 1 else lax.switch(at(lamps.table, lamp), branches)


def switch_by_range(number: Int[Array, ""], first: list[int], branches: list[Callable]):
    """Call the branch whose range, starting at first[i], holds the number. A single branch is called without a test."""
    if len(branches) == 1:
        return branches[0]()
    index = sum((number >= start).astype(jnp.int32) for start in first[1:])
    return lax.switch(index, branches)


def _visit(geometry: Geometry, ray: Ray, test_one, search, t, primitive):
    """Test all primitives that the ray may meet.

    Args:
        test_one: (distances (1,), rows (1,), first, t, primitive) -> (t, primitive), where there is no tree. The
            primitives are first + rows.
        search: (traverse, intersect, first, t, primitive) -> (t, primitive), where there is a tree. traverse is that of
            `bvh`: (leaf test, t, found, result); intersect: index of a leaf -> (distances (W,), rows (W,)).
    """
    for table, first in zip(geometry.tables, firsts(geometry), strict=True):
        for part in table.searched():
            t, primitive = _visit_table(part, first, ray, test_one, search, t, primitive)
    return t, primitive


def _visit_table(table: Searched, first, ray, test_one, search, t, primitive):
    prepared = compute_once(table.prepare(ray.o, ray.d))

    def intersect(leaf):
        return table.intersect(leaf, prepared, ray.exclude - first)

    if table.tree is not None:
        slabs = compute_once(bvh.prepare(ray.o, ray.d))
        entry = compute_once(bvh.enter(table.tree, slabs, t))

        def traverse(leaf_test, *state):
            return bvh.traverse(table.tree, leaf_test, slabs, entry, *state)

        # Many rays meet no child of the root.
        return lax.cond(entry != 0, lambda: search(traverse, intersect, first, t, primitive), lambda: (t, primitive))
    found = lax.fori_loop(
        0, len(table.leaves), lambda number, state: test_one(*intersect(number), first, *state), (t, primitive)
    )
    # XLA inlines a loop of one iteration, and would repeat the test for each consumer.
    return compute_once(found)


def _order(x):
    """Return (W,) unsigned integers, the bits of x less 1, that order as positive floats x do; others come last."""
    bits = _bits(x)
    return lax.bitcast_convert_type(bits, np.dtype(f"u{bits.dtype.itemsize}")) - 1


def _least(x):
    """Return the minimum of (W,) integers, W a power of 2, by halving. (XLA would reduce them one by one.)"""
    while len(x) > 1:
        half = len(x) // 2
        x = smaller(x[:half], x[half:])
    return x[0]


def _bits(x):
    """Return integers that order as the positive floats x do."""
    return lax.bitcast_convert_type(x, integer_like(x.dtype))
