"""Shadow rays where some surfaces let light pass, or media absorb it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pathjax import bsdfs, media
from pathjax.bsdfs import tree
from pathjax.core.math import dot, larger, shading_frame, smaller, spawn_ray
from pathjax.core.types import Hit, Ray, Surface
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry


class Passed(NamedTuple):
    """The one of the surfaces that a shadow ray passes which `Materials.nudged` names."""

    count: Int[Array, ""]  # of all of them
    surface: Surface
    held: Int[Array, "held 2"]  # of `tree.on_the_way`


class _Way(NamedTuple):
    ray: Ray
    share: Float[Array, ""] | Float[Array, "3"]
    passes: Int[Array, ""]
    goes_on: Bool[Array, ""]
    medium: Int[Array, ""] | None
    nudged: tuple[Surface, Int[Array, "held 2"]] | None


def transmitted(
    scene: Scene,
    ray: Ray,
    target: Int[Array, ""],
    most: Int[Array, ""],
    differentiated: bool,
    medium: Int[Array, ""] | None = None,
) -> tuple[Float[Array, ""] | Float[Array, "3"], Int[Array, ""], Passed | None]:
    """Share of light that a shadow ray finds, how many vertices it takes to pass surfaces straight, and one of these.

    The share is the probability that paths pass them all: what light samples and bsdf samples find is the same. In a
    scene with media it is one of each colour.

    Args:
        ray: up to the light; of negative length: no share is asked for.
        target: primitive of the light, which does not shadow itself.
        most: surfaces that it may pass, unless passes are free.
        differentiated: go on through what lets nothing pass, if other parameters may change that.
        medium: in which the ray starts; None in scenes without media.
    """

    def dimmed(medium, share, ray, distance):
        return share if medium is None else share * media.transmittance(scene.media, medium, ray, distance)

    if not bsdfs.occurs(scene.materials, "passes"):
        visible = (ray.t_max >= 0) & ~geometry.occluded(scene.geometry, ray, target)
        return dimmed(medium, visible.astype(ray.t_max.dtype), ray, larger(ray.t_max, 0)), jnp.int32(0), None
    # A line meets no primitive more than twice: rounding that found one again and again comes to an end.
    ever = jnp.int32(2 * scene.geometry.shape.shape[0])
    most = ever if scene.free_passes else jnp.minimum(most, ever)

    def step(way):
        hit = geometry.closest_hit(scene.geometry, way.ray)
        arrives = (hit.primitive < 0) | (hit.primitive == target)
        surface = geometry.surface(scene.geometry, way.ray, hit)
        front = dot(shading_frame(surface).n, way.ray.d) < 0
        nudges, nudged = None, way.nudged
        if nudged is not None:
            number, nudges = scene.materials.nudged
            mine = way.passes == number
            nudges = jnp.where(mine, nudges, 0)
            code = bsdfs.select(scene.materials, hit.shape, front)
            held = jnp.stack([jnp.stack(each) for each in tree.on_the_way(scene.materials, code, front)])
            nudged = jax.tree.map(lambda new, old: jnp.where(mine & ~arrives, new, old), (surface, held), nudged)
        free = bsdfs.passing(scene.materials, hit.shape, surface, front, nudges)
        through = jnp.where(way.passes < most, free, 0)
        share = jnp.where(arrives, way.share, way.share * through)
        share = dimmed(way.medium, share, way.ray, smaller(hit.t, way.ray.t_max))
        within = way.medium
        if within is not None:
            within = media.beyond(scene.media, within, hit.shape, surface.n, way.ray.d)
        beyond = spawn_ray(surface, way.ray.d, hit.primitive)._replace(t_max=way.ray.t_max - hit.t)
        maybe = bsdfs.is_tree(scene.materials, hit.shape, front) if differentiated else False
        on = ~arrives & (way.passes < most) & ((through > 0) | maybe)
        return _Way(beyond, share, way.passes + on.astype(jnp.int32), on, within, nudged)

    one, nobody = jnp.ones_like(ray.t_max if medium is None else ray.o), none_passed(scene)
    nudged = None if nobody is None else (nobody.surface, nobody.held)
    start = _Way(ray, one, jnp.int32(0), ray.t_max >= 0, medium, nudged)
    end = lax.while_loop(lambda way: way.goes_on, step, start)
    passed = None if nobody is None else Passed(end.passes, *end.nudged)
    return jnp.where(ray.t_max >= 0, end.share, 0), jnp.int32(0) if scene.free_passes else end.passes, passed


def none_passed(scene: Scene) -> Passed | None:
    """What stands where no shadow ray is; None where nothing asks for what they pass."""
    if scene.materials.nudged is None:
        return None

    def seen(o):
        return geometry.surface(scene.geometry, Ray(o, o, o[0], jnp.int32(-1)), Hit(o[0], jnp.int32(-1), jnp.int32(-1)))

    surface = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(seen, scene.camera.origin))
    return Passed(jnp.int32(0), surface, jnp.full((len(scene.materials.nudged[1]), 2), -1, jnp.int32))
