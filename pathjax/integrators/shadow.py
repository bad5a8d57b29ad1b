"""Shadow rays where some surfaces let light pass, or media absorb it."""

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


class Arrival(NamedTuple):
    """Light at the end of a shadow ray, and what derivatives ask of its way."""

    light: Float[Array, ""] | Float[Array, "3"]  # share of it that arrives; of a light sample, what is reflected of it
    passed: Int[Array, ""] | None = None  # vertices that it took to pass surfaces straight; None: nothing lets it pass
    nudged: Passed | None = None  # None: nothing asks for it
    dimmed: Dimmed | None = None  # likewise


class _Way(NamedTuple):
    ray: Ray  # what is left of the shadow ray
    share: Float[Array, ""] | Float[Array, "3"]  # of light that gets through what lies behind
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
    """The share of light that a shadow ray finds.

    It is the probability that paths pass all surfaces on the way: what light samples and bsdf samples find is the same.
    In a scene with media it is one of each colour.

    Args:
        ray: up to the light; of negative length: no share is asked for.
        target: primitive of the light, which does not shadow itself.
        most: surfaces that it may pass, unless passes are free.
        differentiated: go on through what lets nothing pass, if other parameters may change that.
        medium: in which the ray starts; None in scenes without media.
        along: of `Bounce`.
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
        # A line meets no primitive more than twice: rounding that found one again and again comes to an end.
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
    """The way beyond the next surface, or its end at the light or at what lets nothing pass."""
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
    """The way after so far through its medium."""
    if way.medium is None:
        return way
    share = way.share * media.transmittance(scene.media, way.medium, way.ray, distance)
    if way.dimmed is None:
        return way._replace(share=share)
    return way._replace(share=share, dimmed=_looked_at(scene, way.dimmed, way.medium, way.ray, distance, along[2]))


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
