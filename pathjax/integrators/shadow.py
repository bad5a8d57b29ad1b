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


class Dimmed(NamedTuple):
    """A point of a shadow ray, drawn evenly of all its ways through grids of extinctions."""

    medium: Int[Array, ""]
    p: Float[Array, "3"]
    length: Float[Array, ""]  # of all these ways
    u: Float[Array, ""]  # uniform in [0, 1): chooses among them


class _Way(NamedTuple):
    ray: Ray
    share: Float[Array, ""] | Float[Array, "3"]
    passes: Int[Array, ""]
    goes_on: Bool[Array, ""]
    medium: Int[Array, ""] | None
    nudged: tuple[Surface, Int[Array, "held 2"]] | None
    dimmed: Dimmed | None


def transmitted(
    scene: Scene,
    ray: Ray,
    target: Int[Array, ""],
    most: Int[Array, ""],
    differentiated: bool,
    medium: Int[Array, ""] | None = None,
    along: Float[Array, "3"] | None = None,
) -> tuple[Float[Array, ""] | Float[Array, "3"], Int[Array, ""], Passed | None, Dimmed | None]:
    """Share of light that a shadow ray finds, how many vertices it takes to pass surfaces straight, and one of these.

    And a point of its way, if derivatives ask for it.

    The share is the probability that paths pass them all: what light samples and bsdf samples find is the same. In a
    scene with media it is one of each colour.

    Args:
        ray: up to the light; of negative length: no share is asked for.
        target: primitive of the light, which does not shadow itself.
        most: surfaces that it may pass, unless passes are free.
        differentiated: go on through what lets nothing pass, if other parameters may change that.
        medium: in which the ray starts; None in scenes without media.
        along: of `Bounce`.
    """
    unseen = none_dimmed(scene, along)

    def dimmed(medium, share, ray, distance):
        return share if medium is None else share * media.transmittance(scene.media, medium, ray, distance)

    def looked_at(seen, medium, ray, distance):
        return None if seen is None else _looked_at(scene, seen, medium, ray, distance, along[2])

    def nudged_by(seen, share):
        return share if seen is None else share * media.nudged_shadow(scene.media, seen.medium)

    if not bsdfs.occurs(scene.materials, "passes"):
        visible = (ray.t_max >= 0) & ~geometry.occluded(scene.geometry, ray, target)
        share, length = visible.astype(ray.t_max.dtype), larger(ray.t_max, 0)
        seen = looked_at(unseen, medium, ray, length)
        return nudged_by(seen, dimmed(medium, share, ray, length)), jnp.int32(0), None, seen
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
        length = smaller(hit.t, way.ray.t_max)
        share, seen = dimmed(way.medium, share, way.ray, length), looked_at(way.dimmed, way.medium, way.ray, length)
        within = way.medium
        if within is not None:
            within = media.beyond(scene.media, within, hit.shape, surface.n, way.ray.d)
        beyond = spawn_ray(surface, way.ray.d, hit.primitive)._replace(t_max=way.ray.t_max - hit.t)
        maybe = bsdfs.is_tree(scene.materials, hit.shape, front) if differentiated else False
        on = ~arrives & (way.passes < most) & ((through > 0) | maybe)
        return _Way(beyond, share, way.passes + on.astype(jnp.int32), on, within, nudged, seen)

    one, nobody = jnp.ones_like(ray.t_max if medium is None else ray.o), none_passed(scene)
    nudged = None if nobody is None else (nobody.surface, nobody.held)
    start = _Way(ray, one, jnp.int32(0), ray.t_max >= 0, medium, nudged, unseen)
    end = lax.while_loop(lambda way: way.goes_on, step, start)
    passed = None if nobody is None else Passed(end.passes, *end.nudged)
    share = jnp.where(ray.t_max >= 0, nudged_by(end.dimmed, end.share), 0)
    return share, jnp.int32(0) if scene.free_passes else end.passes, passed, end.dimmed


def _looked_at(scene, seen, medium, ray, distance, u):
    """What is drawn of the ways so far and of one more."""
    p, length = media.on_the_way(scene.media, medium, ray, distance, u)
    total = seen.length + length
    mark = seen.u * total
    takes = mark < length
    left = jnp.where(takes, length, seen.length)
    u = jnp.where(left > 0, jnp.where(takes, mark, mark - length) / jnp.where(left > 0, left, 1), seen.u)
    return Dimmed(jnp.where(takes, medium, seen.medium), jnp.where(takes, p, seen.p), total, u)


def none_dimmed(scene: Scene, along: Float[Array, "3"] | None) -> Dimmed | None:
    """What stands where no shadow ray is; None where no derivative asks for its depth."""
    if along is None or scene.media.nudges is None or scene.media.nudges.shadow is None:
        return None
    zero = jnp.zeros_like(along)
    return Dimmed(jnp.int32(media.NONE), zero, zero[0], along[1])


def none_passed(scene: Scene) -> Passed | None:
    """What stands where no shadow ray is; None where nothing asks for what they pass."""
    if scene.materials.nudged is None:
        return None

    def seen(o):
        return geometry.surface(scene.geometry, Ray(o, o, o[0], jnp.int32(-1)), Hit(o[0], jnp.int32(-1), jnp.int32(-1)))

    surface = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(seen, scene.camera.origin))
    return Passed(jnp.int32(0), surface, jnp.full((len(scene.materials.nudged[1]), 2), -1, jnp.int32))
