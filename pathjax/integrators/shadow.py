"""Shadow rays through surfaces that let light pass and through media that absorb it."""

from __future__ import annotations

from functools import partial
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
    """The surface selected by `Materials.nudged` among those that a shadow ray passes."""

    count: Int[Array, ""]  # of all surfaces passed
    surface: Surface
    held: Int[Array, "held 2"]  # kinds and rows of `tree.on_the_way`


class Dimmed(NamedTuple):
    """A point of a shadow ray, drawn uniformly from all its segments in grids of extinctions."""

    medium: Int[Array, ""]
    p: Float[Array, "3"]
    length: Float[Array, ""]  # of all these segments
    u: Float[Array, ""]  # uniform in [0, 1): chooses among them


class Arrival(NamedTuple):
    """Light at the end of a shadow ray, and the records of its way that derivatives need."""

    light: Float[Array, ""] | Float[Array, "3"]  # share of light that arrives; from `light_sample`: reflected light
    passed: Int[Array, ""] | None = None  # vertices at surfaces passed straight on; None: no surface lets light pass
    nudged: Passed | None = None  # None: not needed
    dimmed: Dimmed | None = None  # likewise


class _Way(NamedTuple):
    ray: Ray  # the rest of the shadow ray
    share: Float[Array, ""] | Float[Array, "3"]  # of light that passes the part already traced
    passed: Int[Array, ""]  # surfaces so far
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
) -> Arrival:
    """Return the share of light that arrives along a shadow ray.

    It is the probability that a path passes all surfaces on the way, so light samples and bsdf samples agree.
    In a scene with media there is one share per channel.

    Args:
        ray: up to the light; a negative length skips the ray, and its share is 0.
        target: primitive of the light, which does not shadow itself.
        most: most surfaces that the ray may pass, unless passes are free.
        differentiated: continue through surfaces that let nothing pass, if other parameters may change that.
        medium: in which the ray starts; None in scenes without media.
        along: `Bounce.along`.
    """
    passes = bsdfs.occurs(scene.materials, "passes")
    nobody = none_passed(scene)
    way = _Way(
        ray,
        jnp.ones_like(ray.t_max if medium is None else ray.o),
        jnp.int32(0),
        ray.t_max >= 0,
        medium,
        None if nobody is None else (nobody.surface, nobody.held),
        none_dimmed(scene, along),
    )
    if passes:
        # A line meets a primitive at most twice; the limit ends the loop if rounding finds one again and again.
        ever = jnp.int32(2 * scene.geometry.shape.shape[0])
        most = ever if scene.free_passes else jnp.minimum(most, ever)
        beyond = partial(_beyond, scene, target, most, differentiated, along)
        way = lax.while_loop(lambda way: way.goes_on, beyond, way)
    else:
        visible = way.goes_on & ~geometry.occluded(scene.geometry, ray, target)
        way = _flown(scene, way._replace(share=jnp.where(visible, way.share, 0)), larger(ray.t_max, 0), along)
    share = way.share if way.dimmed is None else way.share * media.nudged_shadow(scene.media, way.dimmed.medium)
    vertices = None if not passes else jnp.int32(0) if scene.free_passes else way.passed
    nudged = None if nobody is None else Passed(way.passed, *way.nudged)
    return Arrival(jnp.where(ray.t_max >= 0, share, 0), vertices, nudged, way.dimmed)


def _beyond(scene, target, most, differentiated, along, way: _Way) -> _Way:
    """Step the ray past the next surface, or end it at the light or at a surface that lets nothing pass."""
    hit = geometry.closest_hit(scene.geometry, way.ray)
    arrives = (hit.primitive < 0) | (hit.primitive == target)
    surface = geometry.surface(scene.geometry, way.ray, hit)
    cos = -dot(shading_frame(surface).n, way.ray.d)
    nudges = None
    if way.nudged is not None:
        number, nudges = scene.materials.nudged
        mine = way.passed == number
        nudges = jnp.where(mine, nudges, 0)
        code = bsdfs.select(scene.materials, hit.shape, cos > 0)
        held = jnp.stack([jnp.stack(each) for each in tree.on_the_way(scene.materials, code, cos > 0)])
        way = way._replace(
            nudged=jax.tree.map(lambda new, old: jnp.where(mine & ~arrives, new, old), (surface, held), way.nudged)
        )
    free = bsdfs.passing(scene.materials, hit.shape, surface, cos, nudges)
    through = jnp.where(way.passed < most, free, 0)
    maybe = bsdfs.is_tree(scene.materials, hit.shape, cos > 0) if differentiated else False
    on = ~arrives & (way.passed < most) & ((through > 0) | maybe)
    way = way._replace(share=jnp.where(arrives, way.share, way.share * through))
    way = _flown(scene, way, smaller(hit.t, way.ray.t_max), along)
    within = way.medium
    if within is not None:
        within = media.beyond(scene.media, within, hit.shape, surface.n, way.ray.d)
    return way._replace(
        ray=spawn_ray(surface, way.ray.d, hit.primitive)._replace(t_max=way.ray.t_max - hit.t),
        passed=way.passed + on.astype(jnp.int32),
        goes_on=on,
        medium=within,
    )


def _flown(scene, way: _Way, distance, along) -> _Way:
    """Attenuate the light over a distance in the ray's current medium."""
    if way.medium is None:
        return way
    share = way.share * media.transmittance(scene.media, way.medium, way.ray, distance)
    if way.dimmed is None:
        return way._replace(share=share)
    return way._replace(share=share, dimmed=_with_segment(scene, way.dimmed, way.medium, way.ray, distance, along[2]))


def _with_segment(scene, seen, medium, ray, distance, u):
    """Update the drawn point with one more segment (reservoir sampling, reusing one random number)."""
    p, length = media.on_the_way(scene.media, medium, ray, distance, u)
    total = seen.length + length
    mark = seen.u * total
    takes = mark < length
    left = jnp.where(takes, length, seen.length)
    u = jnp.where(left > 0, jnp.where(takes, mark, mark - length) / jnp.where(left > 0, left, 1), seen.u)
    return Dimmed(jnp.where(takes, medium, seen.medium), jnp.where(takes, p, seen.p), total, u)


def none_dimmed(scene: Scene, along: Float[Array, "3"] | None) -> Dimmed | None:
    """Return the `Dimmed` of no shadow ray; None where no derivative needs the optical depth of shadow rays."""
    if along is None or scene.media.nudges is None or scene.media.nudges.shadow is None:
        return None
    zero = jnp.zeros_like(along)
    return Dimmed(jnp.int32(media.NONE), zero, zero[0], along[1])


def none_passed(scene: Scene) -> Passed | None:
    """Return the `Passed` of no shadow ray; None where no derivative needs the surfaces that shadow rays pass."""
    if scene.materials.nudged is None:
        return None

    def seen(o):
        return geometry.surface(scene.geometry, Ray(o, o, o[0], jnp.int32(-1)), Hit(o[0], jnp.int32(-1), jnp.int32(-1)))

    surface = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(seen, scene.camera.origin))
    return Passed(jnp.int32(0), surface, jnp.full((len(scene.materials.nudged[1]), 2), -1, jnp.int32))
