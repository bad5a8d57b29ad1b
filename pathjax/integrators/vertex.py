"""Where a path meets a surface, and what scatters it there."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pathjax import bsdfs
from pathjax.core.math import shading_frame, to_local
from pathjax.core.types import Frame, Hit, Ray, Surface
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry


class Vertex(NamedTuple):
    hit: Hit
    surface: Surface
    frame: Frame  # around the shading normal; of reflectors, turned towards the ray
    wi: Float[Array, "3"]  # unit, in the frame, where the ray came from
    kind: Int[Array, ""]  # of the bsdf; -1: none, which absorbs
    row: Int[Array, ""]


def vertex(scene: Scene, ray: Ray, hit: Hit) -> Vertex:
    """What a ray meets at its hit; of a miss, some surface. The scene holds a shape.

    Reflectors see either side as their front, so their frame is turned towards the ray; glass tells its sides apart.
    """
    surface = geometry.surface(scene.geometry, ray, hit)
    frame = shading_frame(surface)
    wi = to_local(frame, -ray.d)
    kind, row = bsdfs.select(scene.materials, hit.shape, wi[2] > 0)
    side = jnp.where(bsdfs.has(scene.materials, kind, "sided") | (wi[2] > 0), 1, -1).astype(wi.dtype)
    frame, wi = frame._replace(n=frame.n * side), jnp.stack([wi[0], wi[1], wi[2] * side])
    return Vertex(hit, surface, frame, wi, kind, row)
