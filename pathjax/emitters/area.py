"""Surfaces that emit the same radiance from their front in all directions."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from pathjax.core.math import at, dot, larger
from pathjax.core.types import EmitterSample, Hit, Ray, Surface
from pathjax.shapes import Geometry, Lamps, geometry


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AreaLights:
    radiance: jax.Array  # (E, 3) of each emitter of the file
    emitter: jax.Array  # (R,) int32 row of `radiance`
    lamps: Lamps  # R rows


def sample(lights: AreaLights, shapes: Geometry, row, ref, u, u_part) -> EmitterSample:
    """A point of light `row` as seen from `ref` (3,); for the numbers see `geometry.sample_lamp`.

    Returns:
        EmitterSample, its pdf without the choice of the light; pdf and Le are 0 behind the light or edge-on.
    """
    Le = at(lights.radiance, at(lights.emitter, row))
    drawn = geometry.sample_lamp(shapes, lights.lamps, row, ref, u, u_part)
    front = dot(drawn.n, drawn.d) < 0
    Le, pdf = jnp.where(front, Le, 0), jnp.where(front, drawn.pdf, 0)
    return EmitterSample(drawn.d, drawn.distance, drawn.primitive, Le, pdf)


def hit(lights: AreaLights, shapes: Geometry, row, ray: Ray, hit: Hit, surface: Surface):
    """Radiance (3,) that the ray receives from light `row`, and the density [1/sr] of `sample` there."""
    front = dot(surface.n, ray.d) < 0
    Le = jnp.where(front, at(lights.radiance, at(lights.emitter, row)), 0)
    pdf = geometry.lamp_density(shapes, lights.lamps, row, ray, hit, surface)
    return Le, larger(pdf, jnp.zeros_like(pdf))
