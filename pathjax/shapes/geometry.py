"""All shapes of a scene behind three questions: what does a ray hit first, is it blocked, what is there.

Hits are found on detached rays; `surface` then computes the point again from the ray, differentiably.
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

# As a primitive: none. As the bits of a float32 distance: beyond infinity.
NO_HIT = np.int32(0x7FFFFFFF)


@register_dataclass
@dataclass(frozen=True)
class Geometry:
    tables: tuple[Table, ...]  # one for each kind of primitive present, through which these are numbered in this order
    shape: Int[Array, " P"]  # of each primitive, its place in the scene file
    light: Int[Array, " P"] | None  # number of its light; -1: emits nothing. None: lights are not built yet
    tangents: bool = field(default=False, metadata={"static": True})  # whether `surface` tells them
    along: bool = field(default=False, metadata={"static": True})
    corners: bool = field(default=False, metadata={"static": True})


def firsts(geometry: Geometry) -> list[int]:
    """Number of the first primitive of each table."""
    counts = [table.count for table in geometry.tables]
    return np.cumsum([0, *counts])[:-1].tolist()


def closest_hit(geometry: Geometry, ray: Ray) -> Hit:
    """First primitive that the ray meets at 0 < t <= ray.t_max; of coincident ones the lowest."""
    none = jnp.int32(NO_HIT)
    ray = jax.tree.map(lax.stop_gradient, ray)

    def test_one(distances, rows, first, t, primitive):
        (distance,), (candidate,) = compute_once((distances, rows + first))
        nearer = (distance > 0) & ((distance < t) | ((distance == t) & (primitive == none)))
        return jnp.where(nearer, distance, t), jnp.where(nearer, candidate, primitive)

    def search(traverse, intersect, first, t, primitive):
        def row_in(leaf):
            """Row of the nearest primitive of a leaf; of coincident ones the lowest, as rows ascend with the lanes."""
            distances, rows = intersect(leaf)

            def pick():
                order = _order(distances)
                lanes = jnp.arange(len(order), dtype=jnp.int32)
                tied = jnp.sum(jnp.left_shift((order == _least(order)).astype(jnp.int32), lanes), dtype=jnp.int32)
                return at(rows, lax.population_count(~tied & (tied - 1)))

            # A branch reads what was computed before it; without, each that reads distances would compute them again.
            return lax.cond(leaf >= 0, pick, lambda: none)

        def lowest_at(distance, row):
            """The lowest row of all that are hit at this distance, one of which is known."""
            wanted = _order(distance)

            def lower(leaf, t, row):
                distances, rows = intersect(leaf)
                return t, jnp.minimum(row, jnp.min(jnp.where(_order(distances) == wanted, rows, none)))

            return traverse(lower, distance, row)[1]

        # Most leaves are left as they are found: which of their primitives is hit is asked at the end. `found` is the
        # leaf with the nearest one, doubled, and 1 is added if another leaf has one as near; -1: none is found.
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

    # A miss is infinitely far, and no bound may equal that.
    farthest = smaller(ray.t_max, jnp.full_like(ray.t_max, jnp.finfo(ray.t_max.dtype).max))
    t, primitive = _visit(geometry, ray, test_one, search, farthest, none)
    found = primitive != none
    shape = at(geometry.shape, jnp.where(found, primitive, 0)) if geometry.tables else none
    return Hit(jnp.where(found, t, jnp.inf), jnp.where(found, primitive, -1), jnp.where(found, shape, -1))


def occluded(geometry: Geometry, ray: Ray, target: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether anything but the primitive `target` lies at 0 < t < ray.t_max."""

    def test_one(distances, rows, first, t, primitive):
        blocked = jnp.any((distances > 0) & (distances < t) & (rows != target - first))
        return jnp.where(blocked, -1, t), primitive

    def search(traverse, intersect, first, t, primitive):
        def leaf_test(leaf, t, primitive):
            distances, rows = intersect(leaf)
            order = _order(distances)
            before = order < lax.bitcast_convert_type(jnp.maximum(_bits(t), 1) - 1, order.dtype)
            # Sums of numbers vectorise, those of flags do not.
            blocked = jnp.sum((before & (rows != target - first)).astype(jnp.int32)) != 0
            return jnp.where(blocked, -1, t), primitive

        return traverse(leaf_test, t, primitive)

    ray = jax.tree.map(lax.stop_gradient, ray)
    t, _ = _visit(geometry, ray, test_one, search, ray.t_max, jnp.int32(NO_HIT))
    return t < 0


def surface(geometry: Geometry, ray: Ray, hit: Hit) -> Surface:
    """What the ray sees at its hit; differentiable in the ray. A miss gives the surface of some primitive."""
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
    """Unit vector across n; any, where u does not grow along the surface."""
    across = along_u - dot(along_u, n) * n
    squared = dot(across, across)
    found = squared > 0
    return jnp.where(found, across * lax.rsqrt(jnp.where(found, squared, 1)), frame_from_normal(n).s)


def _along(surface, o, n):
    """Derivatives of the point in u and in v, detached, from how both change as the ray moves sideways."""
    across = frame_from_normal(n)

    def moved(direction):
        return jax.jvp(lambda o: (lambda seen: (seen.p, seen.uv))(surface(o)), (o,), (direction,))[1]

    (p_s, uv_s), (p_t, uv_t) = compute_once(lax.stop_gradient((moved(across.s), moved(across.t))))
    scale = safe_divide(1, uv_s[0] * uv_t[1] - uv_s[1] * uv_t[0])
    return (uv_t[1] * p_s - uv_s[1] * p_t) * scale, (uv_s[0] * p_t - uv_t[0] * p_s) * scale


def emits(geometry: Geometry, hit: Hit) -> Bool[Array, ""]:
    """Whether what was hit is a light."""
    return (hit.primitive >= 0) & (at(geometry.light, jnp.maximum(hit.primitive, 0)) >= 0)


def sample_lamp(
    geometry: Geometry,
    lamps: Lamps,
    lamp: Int[Array, ""],
    ref: Float[Array, "3"],
    u: Float[Array, "2"],
    u_part: Float[Array, ""],
) -> LampSample:
    """A point of a lamp as seen from `ref`: uniform in area, for spheres in the cone that they fill.

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
    """Density [1/sr] with which `sample_lamp`, seen from ray.o, finds what the ray hit, a point of this lamp."""
    first = firsts(geometry)

    def of(index):
        return lambda: geometry.tables[index].lamp_density(lamps, lamp, first[index], ray, hit, surface)

    return _switch_by_lamp(lamps, lamp, of)


def _switch_by_lamp(lamps, lamp, of):
    branches = [of(index) for index in lamps.tables]
    return branches[0]() if len(branches) == 1 else lax.switch(at(lamps.table, lamp), branches)


def switch_by_range(number: Int[Array, ""], first: list[int], branches: list[Callable]):
    """Call the branch whose range, starting at first[i], holds the number. One branch is called without a test."""
    if len(branches) == 1:
        return branches[0]()
    index = sum((number >= start).astype(jnp.int32) for start in first[1:])
    return lax.switch(index, branches)


def _visit(geometry: Geometry, ray: Ray, test_one, search, t, primitive):
    """Give all primitives that the ray may meet to a test.

    Args:
        test_one: (distances (1,), rows (1,), first, t, primitive) -> (t, primitive), where there is no tree. The
            primitives are first + rows.
        search: (traverse, intersect, first, t, primitive) -> (t, primitive), where there is a tree. traverse is that of
            `bvh`: (leaf test, t, found, result); intersect: number of a leaf -> (distances (W,), rows (W,)).
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
    # XLA dissolves a loop of one trip, and would test again for each consumer.
    return compute_once(found)


def _order(x):
    """(W,) unsigned integers that order as positive floats x do, whose bits less 1 they are; others come last."""
    bits = _bits(x)
    return lax.bitcast_convert_type(bits, np.dtype(f"u{bits.dtype.itemsize}")) - 1


def _least(x):
    """Minimum of (W,) integers, W a power of 2. (XLA reduces one by one; halves fold into each other.)"""
    while len(x) > 1:
        half = len(x) // 2
        x = smaller(x[:half], x[half:])
    return x[0]


def _bits(x):
    """Integers that order as the positive floats x do."""
    return lax.bitcast_convert_type(x, integer_like(x.dtype))
