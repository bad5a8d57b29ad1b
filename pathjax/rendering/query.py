"""Ray queries on a scene, many rays at a time."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Real

from pathjax.compile import native_map, usual_promotion
from pathjax.core.math import normalize, rescale
from pathjax.core.types import Hit, Ray
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry

Vectors = Real[Array | np.ndarray, "N 3"]


@usual_promotion
def closest_hit(scene: Scene, origins: Vectors, directions: Vectors) -> Hit:
    """Return the first primitive that each ray meets; directions are of any positive length.

    Returns:
        Hit of arrays (N,). `t` is the distance, inf where the ray meets nothing; `primitive` and `shape` are then -1.
        `shape` counts the shapes of the file; `primitive` counts spheres, rectangles (six of each cube), disks and
        triangles, in this order.
    """
    dtype = scene.camera.origin.dtype
    return _closest_hit(scene.geometry, jnp.asarray(origins, dtype), jnp.asarray(directions, dtype))


@partial(jax.jit, static_argnames=("form", "devices"))
def _closest_hit(shapes, origins, directions, form=None, devices=None):
    def one(ray, shapes):
        o, d = ray
        ray = Ray(o, normalize(rescale(d)), jnp.full_like(o[0], jnp.inf), jnp.int32(-1))
        return geometry.closest_hit(shapes, ray)

    return native_map(one, (origins, directions), shapes, form=form, devices=devices)
