"""Shadow rays where some surfaces let light pass, or media absorb it."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax import bsdfs, media
from pathjax.core.math import dot, shading_frame, smaller, spawn_ray
from pathjax.core.types import Ray
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry


class _Way(NamedTuple):
    ray: Ray
    share: Float[Array, ""] | Float[Array, "3"]
    passes: Int[Array, ""]
    goes_on: Bool[Array, ""]
    medium: Int[Array, ""] | None


def transmitted(
    scene: Scene,
    ray: Ray,
    target: Int[Array, ""],
    most: Int[Array, ""],
    differentiated: bool,
    medium: Int[Array, ""] | None = None,
) -> tuple[Float[Array, ""] | Float[Array, "3"], Int[Array, ""]]:
    """Share of light that a shadow ray finds, and how many vertices it takes to pass surfaces straight.

    The share is the probability that paths pass them all: what light samples and bsdf samples find is the same. In a
    scene with media it is one of each colour.

    Args:
        ray: up to the light; of negative length: no share is asked for.
        target: primitive of the light, which does not shadow itself.
        most: surfaces that it may pass, unless passes are free.
        differentiated: go on through what lets nothing pass, if other parameters may change that.
        medium: in which the ray starts; None in scenes without media.
    """

    def dimmed(medium, share, distance):
        return share if medium is None else share * media.transmittance(scene.media, medium, distance)

    if not bsdfs.occurs(scene.materials, "passes"):
        visible = (ray.t_max >= 0) & ~geometry.occluded(scene.geometry, ray, target)
        return dimmed(medium, visible.astype(ray.t_max.dtype), ray.t_max), jnp.int32(0)
    # A line meets no primitive more than twice: rounding that found one again and again comes to an end.
    ever = jnp.int32(2 * scene.geometry.shape.shape[0])
    most = ever if scene.free_passes else jnp.minimum(most, ever)

    def step(way):
        hit = geometry.closest_hit(scene.geometry, way.ray)
        arrives = (hit.primitive < 0) | (hit.primitive == target)
        surface = geometry.surface(scene.geometry, way.ray, hit)
        front = dot(shading_frame(surface).n, way.ray.d) < 0
        through = jnp.where(way.passes < most, bsdfs.passing(scene.materials, hit.shape, surface, front), 0)
        share = jnp.where(arrives, way.share, way.share * through)
        share = dimmed(way.medium, share, smaller(hit.t, way.ray.t_max))
        within = way.medium
        if within is not None:
            within = media.beyond(scene.media, within, hit.shape, surface.n, way.ray.d)
        beyond = spawn_ray(surface, way.ray.d, hit.primitive)._replace(t_max=way.ray.t_max - hit.t)
        maybe = bsdfs.is_tree(scene.materials, hit.shape, front) if differentiated else False
        on = ~arrives & (way.passes < most) & ((through > 0) | maybe)
        return _Way(beyond, share, way.passes + on.astype(jnp.int32), on, within)

    one = jnp.ones_like(ray.t_max if medium is None else ray.o)
    end = lax.while_loop(lambda way: way.goes_on, step, _Way(ray, one, jnp.int32(0), ray.t_max >= 0, medium))
    return jnp.where(ray.t_max >= 0, end.share, 0), jnp.int32(0) if scene.free_passes else end.passes
