"""Ray queries on a scene, many rays at a time; inside of jit, vmap and loops too."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Real

from pathjax.compile import native_map, usual_promotion
from pathjax.core.math import normalize, rescale
from pathjax.core.types import Hit, Ray
from pathjax.scene.alike import by_all
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry

Vectors = Real[Array | np.ndarray, "N 3"]


@by_all
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


@by_all
@usual_promotion
def any_hit(
    scene: Scene, origins: Vectors, directions: Vectors, distances: Real[ArrayLike, "..."] = jnp.inf
) -> Bool[Array, " N"]:
    """Return whether each ray meets anything before a distance: cheaper than to ask for the first of what it meets.

    Args:
        directions: of any positive length.
        distances: (N,) or one for all, in units of the scene, whatever the length of the directions; inf: no limit.
    """
    dtype = scene.camera.origin.dtype
    origins, directions = jnp.asarray(origins, dtype), jnp.asarray(directions, dtype)
    distances = jnp.broadcast_to(jnp.asarray(distances, dtype), origins.shape[:1])
    return _any_hit(scene.geometry, origins, directions, distances)


@partial(jax.jit, static_argnames=("form", "devices"))
def _closest_hit(shapes, origins, directions, form=None, devices=None):
    def one(ray, shapes):
        return geometry.closest_hit(shapes, _ray(*ray, jnp.inf))

    return native_map(one, (origins, directions), shapes, form=form, devices=devices)


@partial(jax.jit, static_argnames=("form", "devices"))
def _any_hit(shapes, origins, directions, distances, form=None, devices=None):
    def one(ray, shapes):
        return geometry.occluded(shapes, _ray(*ray), jnp.int32(-1))

    return native_map(one, (origins, directions, distances), shapes, form=form, devices=devices)


def _ray(o, d, t_max):
    return Ray(o, normalize(rescale(d)), jnp.full_like(o[0], t_max), jnp.int32(-1))
