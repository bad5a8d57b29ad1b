"""Ray queries on a scene, many rays at a time; also inside jit, vmap and loops."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Real

from pathjax.compile import native_map, on_all_devices, standard_promotion
from pathjax.core.math import normalize, rescale
from pathjax.core.types import Hit, Ray
from pathjax.errors import InputError
from pathjax.scene.alike import agreed_by_all
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry

Vectors = Real[Array | np.ndarray, "N 3"]


@agreed_by_all
@standard_promotion
def closest_hit(scene: Scene, origins: Vectors, directions: Vectors) -> Hit:
    """Return the first primitive that each ray meets; directions may have any positive length.

    Returns:
        Hit of arrays (N,). `t` is the distance, inf where the ray meets nothing; `primitive` and `shape` are then -1.
        `shape` counts the shapes of the file; `primitive` counts spheres, rectangles (six of each cube), disks,
        triangles, cylinders and ellipsoids, in this order.
    Raises:
        InputError: origins and directions do not have one shape (N, 3).
    """
    return _closest_hit(on_all_devices(scene.geometry), *_rays(scene, origins, directions))


@agreed_by_all
@standard_promotion
def any_hit(
    scene: Scene, origins: Vectors, directions: Vectors, distances: Real[ArrayLike, "..."] = jnp.inf
) -> Bool[Array, " N"]:
    """Return whether each ray meets anything before a distance; cheaper than `closest_hit`.

    Args:
        directions: of any positive length.
        distances: (N,) or one for all, in units of the scene, whatever the length of the directions; inf: no limit.
    Raises:
        InputError: origins and directions do not have one shape (N, 3), or distances are neither one nor N.
    """
    origins, directions = _rays(scene, origins, directions)
    if np.shape(distances) not in ((), origins.shape[:1]):
        raise InputError(f"distances have the shape {np.shape(distances)}; give one, or one for each of the rays")
    distances = jnp.broadcast_to(jnp.asarray(distances, origins.dtype), origins.shape[:1])
    return _any_hit(on_all_devices(scene.geometry), origins, directions, distances)


def _rays(scene: Scene, origins: Vectors, directions: Vectors) -> tuple[Float[Array, "N 3"], Float[Array, "N 3"]]:
    """Return both as arrays of the scene's dtype. Checked here, since kernels clamp indices and accept any shape."""
    shapes = np.shape(origins), np.shape(directions)
    if shapes[0] != shapes[1] or shapes[0][1:] != (3,):
        raise InputError(f"origins and directions have the shapes {shapes[0]} and {shapes[1]}; both must be (N, 3)")
    dtype = scene.camera.origin.dtype
    return jnp.asarray(origins, dtype), jnp.asarray(directions, dtype)


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
