"""All shapes of a scene behind three questions: what does a ray hit first, is it blocked, what is there.

Hits are found on detached rays; `surface` then computes the point again from the ray, differentiably.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax.compile import compute_once, one_by_one, register_dataclass
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
    beyond = _bits(jnp.full_like(ray.t_max, jnp.inf))
    ray = jax.tree.map(lax.stop_gradient, ray)

    def leaf_test(distances, rows, first, t, primitive):
        if len(distances) == 1:
            (distance,), (candidate,) = compute_once((distances, rows + first))
            nearer = (distance > 0) & ((distance < t) | ((distance == t) & (primitive == none)))
            return jnp.where(nearer, distance, t), jnp.where(nearer, candidate, primitive)
        hit, distances = compute_once(((distances > 0) & (distances <= t), distances))

        def update():
            # Positive floats order as integers, and integer minima vectorise.
            bits = jnp.where(hit, _bits(distances), beyond)
            nearest = _least(bits)
            found = lax.bitcast_convert_type(nearest, distances.dtype)
            # The lowest of those that tie is the first: primitives ascend with the lanes.
            lanes = jnp.left_shift(jnp.int32(1), jnp.arange(len(bits), dtype=jnp.int32))
            tied = jnp.sum(jnp.where(bits == nearest, lanes, 0), dtype=jnp.int32)
            candidate = at(rows, lax.population_count(~tied & (tied - 1))) + first
            better = (found < t) | (candidate < primitive)
            return jnp.where(better, found, t), jnp.where(better, candidate, primitive)

        return lax.cond(jnp.any(hit), update, lambda: (t, primitive))

    # A miss is infinitely far, and no bound may equal that.
    farthest = smaller(ray.t_max, jnp.full_like(ray.t_max, jnp.finfo(ray.t_max.dtype).max))
    t, primitive = _visit(geometry, ray, leaf_test, farthest, none)
    found = primitive != none
    shape = at(geometry.shape, jnp.where(found, primitive, 0)) if geometry.tables else none
    return Hit(jnp.where(found, t, jnp.inf), jnp.where(found, primitive, -1), jnp.where(found, shape, -1))


def occluded(geometry: Geometry, ray: Ray, target: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether anything but the primitive `target` lies at 0 < t < ray.t_max."""

    def leaf_test(distances, rows, first, t, primitive):
        blocked = jnp.any((distances > 0) & (distances < t) & (rows != target - first))
        return jnp.where(blocked, -1, t), primitive

    ray = jax.tree.map(lax.stop_gradient, ray)
    t, _ = _visit(geometry, ray, leaf_test, ray.t_max, jnp.int32(NO_HIT))
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
    return compute_once(((uv_t[1] * p_s - uv_s[1] * p_t) * scale, (uv_s[0] * p_t - uv_t[0] * p_s) * scale))


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


def _visit(geometry: Geometry, ray: Ray, leaf_test, t, primitive):
    """Give every leaf that the ray may meet to `leaf_test(distances (W,), rows (W,), first, t, primitive)`, which
    returns t, primitive. The primitives are first + rows: W sums that only a hit wants."""
    for table, first in zip(geometry.tables, firsts(geometry), strict=True):
        for part in table.searched():
            t, primitive = _visit_table(part, first, ray, leaf_test, t, primitive)
    return t, primitive


def _visit_table(table: Searched, first, ray, leaf_test, t, primitive):
    def leaf(prepared, exclude, number, t, primitive):
        distances, rows = table.intersect(number, prepared, exclude - first)
        return leaf_test(distances, rows, first, t, primitive)

    # A search goes its own way for each ray; what it starts from is made for all of them.
    @one_by_one
    def search(slabs, entry, prepared, exclude, t, primitive):
        of_ray = partial(leaf, prepared, exclude)
        return bvh.traverse(table.tree, of_ray, slabs, entry, t, primitive)

    prepared = compute_once(table.prepare(ray.o, ray.d))
    if table.tree is not None:
        slabs = compute_once(bvh.prepare(ray.o, ray.d))
        entry = compute_once(bvh.enter(table.tree, slabs, t))
        # Many rays meet no child of the root.
        return lax.cond(
            entry != 0,
            lambda: search(slabs, entry, prepared, ray.exclude, t, primitive),
            lambda: (t, primitive),
        )
    of_ray = partial(leaf, prepared, ray.exclude)
    found = lax.fori_loop(0, len(table.leaves), lambda number, state: of_ray(number, *state), (t, primitive))
    # XLA dissolves a loop of one trip, and would test again for each consumer.
    return compute_once(found)


def _least(x):
    """Minimum of (W,) integers, W a power of 2. (XLA reduces one by one; halves fold into each other.)"""
    while len(x) > 1:
        half = len(x) // 2
        x = smaller(x[:half], x[half:])
    return x[0]


def _bits(x):
    """Integers that order as the positive floats x do."""
    return lax.bitcast_convert_type(x, integer_like(x.dtype))
