"""Pinhole and thin-lens cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from pathjax import description
from pathjax.core.math import dot
from pathjax.core.types import Ray
from pathjax.core.warp import square_to_disk


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lens:
    radius: jax.Array  # ()
    focus_distance: jax.Array  # () along the optical axis


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Camera:
    origin: jax.Array  # (3,)
    axes: jax.Array  # (3, 3) rows: unit right, up, forward in world space
    corner: jax.Array  # (2,) x, y at distance 1 of the film's upper left corner
    extent: jax.Array  # (2,) x, y at distance 1 from that corner to the opposite one
    near: jax.Array  # () clip distances along the optical axis
    far: jax.Array  # ()
    lens: Lens | None  # None: a pinhole


def build(camera: description.Camera, film: description.Film, dtype) -> Camera:
    aspect = film.width / film.height
    tan = math.tan(math.radians(camera.fov) / 2)
    tan_x = {
        "x": tan,
        "y": tan * aspect,
        "diagonal": tan * aspect / math.hypot(aspect, 1),
        "smaller": tan * max(aspect, 1),
        "larger": tan * min(aspect, 1),
    }[camera.fov_axis]
    half = np.array([tan_x, tan_x / aspect])
    # The local x axis points to the left of the image.
    axes = camera.to_world[:3, :3] / np.linalg.norm(camera.to_world[:3, :3], axis=0)
    shift = 2 * half * np.array([-camera.principal_point_offset[0], -camera.principal_point_offset[1]])

    def real(x):
        return np.asarray(x, dtype)

    lens = None
    if camera.aperture_radius is not None:
        lens = Lens(real(camera.aperture_radius), real(camera.focus_distance))
    return Camera(
        real(camera.to_world[:3, 3]),
        real(axes.T),
        real(half + shift),
        real(-2 * half),
        real(camera.near_clip),
        real(camera.far_clip),
        lens,
    )


def sample_ray(camera: Camera, position, u_lens) -> Ray:
    """Ray through a point of the film.

    Args:
        position: (2,) in [0, 1]^2 over the whole film, from the upper left corner.
        u_lens: (2,), used by a thin lens only.
    """
    xy = camera.corner + position * camera.extent
    local = jnp.stack([xy[0], xy[1], jnp.ones_like(xy[0])])
    start = jnp.zeros_like(local)
    if camera.lens is not None:
        aperture = camera.lens.radius * square_to_disk(u_lens)
        start = jnp.stack([aperture[0], aperture[1], jnp.zeros_like(xy[0])])
        local, start = lax.optimization_barrier((local * camera.lens.focus_distance - start, start))
    right, up, forward = camera.axes

    def to_world(v):
        return v[0] * right + v[1] * up + v[2] * forward

    v = lax.optimization_barrier(to_world(local))
    length = jnp.sqrt(dot(v, v))
    d = v / length
    along = length / local[2]
    o = camera.origin + to_world(start) + d * (camera.near * along)
    return Ray(o, d, (camera.far - camera.near) * along, jnp.int32(-1))
