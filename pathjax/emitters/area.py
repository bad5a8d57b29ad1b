"""Surfaces that emit the same radiance from their front in all directions."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import lax

from pathjax.core.math import at, dot, larger, safe_divide, safe_sqrt
from pathjax.core.types import EmitterSample, Hit, Ray, Surface
from pathjax.shapes import geometry, planar, sphere, triangle
from pathjax.shapes.geometry import Geometry
from pathjax.shapes.sphere import Spheres
from pathjax.shapes.triangle import Triangles


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AreaLights:
    """A row for each rectangle, disk and sphere that emits, and one for each mesh that does."""

    radiance: jax.Array  # (E, 3) of each emitter of the file
    emitter: jax.Array  # (R,) int32 row of `radiance`
    area: jax.Array  # (R,)
    table: jax.Array  # (R,) int32 into `tables`
    first: jax.Array  # (R,) int32 first row in the table of its shapes
    count: jax.Array  # (R,) int32 rows: 1 but for meshes
    area_cdf: jax.Array | None  # (T,) running share of the area, of each mesh in turn; None: no mesh emits
    cdf_first: jax.Array | None  # (R,) int32 first entry of a mesh in `area_cdf`
    tables: tuple[int, ...] = field(metadata={"static": True})  # which tables of the geometry hold lights


def sample(lights: AreaLights, shapes: Geometry, row, ref, u, u_triangle) -> EmitterSample:
    """A point of light `row` as seen from `ref`: uniform in area, for spheres in the cone that they fill.

    Args:
        ref: (3,) the shaded point; u: (2,); u_triangle: () chooses the triangle of a mesh.
    Returns:
        EmitterSample, its pdf without the choice of the light; pdf and Le are 0 behind the light or edge-on.
    """
    first_primitive = geometry.firsts(shapes)
    Le = at(lights.radiance, at(lights.emitter, row))

    def of(index):
        table, start = shapes.tables[index], first_primitive[index]

        def by_direction():
            place = at(lights.first, row)
            d, distance, n, pdf = lax.optimization_barrier(sphere.sample_direction(table, place, ref, u))
            return _facing(d, distance, n, pdf, Le, place + start)

        def by_area():
            place, n_lights = at(lights.first, row), at(lights.area, row)
            if isinstance(table, Triangles):
                place = _triangle(lights, row, u_triangle)
                p, n, margin = triangle.sample(table, place, u)
            else:
                p, n, margin = planar.sample(table, place, u)
            # The far end of a shadow ray stays clear of what touches the light, as its near end does.
            p = p + n * jnp.copysign(margin, dot(n, ref - p))
            to_p = p - ref
            squared = dot(to_p, to_p)
            distance = safe_sqrt(squared)
            d = to_p * safe_divide(1, distance)
            d, distance = lax.optimization_barrier((d, distance))
            pdf = safe_divide(squared, jnp.abs(dot(n, d)) * n_lights)
            return _facing(d, distance, n, pdf, Le, place + start)

        return by_direction if isinstance(table, Spheres) else by_area

    branches = [of(index) for index in lights.tables]
    return branches[0]() if len(branches) == 1 else lax.switch(at(lights.table, row), branches)


def _facing(d, distance, n, pdf, Le, primitive):
    front = dot(n, d) < 0
    return EmitterSample(d, distance, primitive, jnp.where(front, Le, 0), jnp.where(front, pdf, 0))


def _triangle(lights: AreaLights, row, u):
    """Row of a triangle of the mesh, chosen by area."""
    start, count = at(lights.cdf_first, row), at(lights.count, row)

    def halve(_, between):
        low, high = between
        middle = (low + high) // 2
        above = at(lights.area_cdf, start + middle) > u
        return jnp.where(above, low, middle + 1), jnp.where(above, middle, high)

    steps = lights.area_cdf.shape[0].bit_length()
    found, _ = lax.fori_loop(0, steps, halve, (jnp.int32(0), count - 1))
    return at(lights.first, row) + jnp.minimum(found, count - 1)


def hit(lights: AreaLights, shapes: Geometry, row, ray: Ray, hit: Hit, surface: Surface):
    """Radiance (3,) that the ray receives from light `row`, and the density [1/sr] of `sample` there."""
    front = dot(surface.n, ray.d) < 0
    Le = jnp.where(front, at(lights.radiance, at(lights.emitter, row)), 0)
    first_primitive = geometry.firsts(shapes)

    def of(index):
        table, start = shapes.tables[index], first_primitive[index]

        def by_direction():
            return sphere.pdf_direction(table, hit.primitive - start, ray.o, ray.d, hit.t, surface.n)

        def by_area():
            cos = jnp.abs(dot(surface.n, ray.d))
            return safe_divide(hit.t * hit.t, cos * at(lights.area, row))

        return by_direction if isinstance(table, Spheres) else by_area

    branches = [of(index) for index in lights.tables]
    pdf = branches[0]() if len(branches) == 1 else lax.switch(at(lights.table, row), branches)
    return Le, larger(pdf, jnp.zeros_like(pdf))
