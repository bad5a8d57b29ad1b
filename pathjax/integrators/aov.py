"""Mean distance, normal and albedo of the first hit over a pixel's samples."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax import bsdfs
from pathjax.core import sampler
from pathjax.core.math import dot, spawn_ray
from pathjax.integrators.pixel import Work, camera_ray
from pathjax.integrators.random_numbers import bounce_numbers
from pathjax.integrators.vertex import sample as sample_bsdf
from pathjax.integrators.vertex import vertex
from pathjax.scene.scene import Scene
from pathjax.shapes import geometry


class FirstHit(NamedTuple):
    """First hit of a camera ray; all 0 for a miss, as in Mitsuba's `aov`."""

    depth: Float[Array, "1"]  # distance along the ray, from the near clip plane on
    normal: Float[Array, "3"]  # shading normal in world space, on the side that the shape's normals point to
    albedo: Float[Array, "3"]  # share of light that is scattered; 1 for glass and null, 0 for an absorbing side


def mean(work: Work, scene: Scene) -> FirstHit:
    """Return the mean over a pixel's samples."""
    pixel, first_sample, spp, seed = work
    stream = sampler.pixel_stream(seed, pixel)

    def add(i, total):
        seen = sample(scene, pixel, stream, first_sample + i.astype(jnp.uint32))
        return jax.tree.map(jnp.add, total, seen)

    total = lax.fori_loop(0, spp.astype(jnp.int32), add, _nothing(scene))
    return jax.tree.map(lambda x: x / spp.astype(x.dtype), total)


def sample(scene: Scene, pixel: Int[Array, ""], stream: sampler.Word, number: sampler.Word) -> FirstHit:
    """Return one sample, at the film position of `pixel.camera_ray`."""
    ray, weight = camera_ray(scene, pixel, stream, number)
    if scene.camera.gain != 1:  # the gain applies to radiance only
        weight = weight / scene.camera.gain
    if not scene.geometry.tables:
        return _nothing(scene)
    ray, hit, passed = _first(scene, ray)

    def seen():
        u = bounce_numbers(scene, stream, number, jnp.int32(0))
        here = vertex(scene, ray, hit, u.leaf)
        # The mean weight of bsdf samples is the albedo; one sample is exact where all directions have the same weight.
        drawn, _ = sample_bsdf(scene, here, u.bsdf)
        transmits = bsdfs.has(scene.materials, here.kind, "transmissive")
        albedo = jnp.where(transmits, 1, jnp.where(here.kind >= 0, drawn.weight, 0))
        return FirstHit((passed + hit.t)[None], here.surface.shading_n, albedo)

    found = lax.cond(hit.primitive >= 0, seen, lambda: _nothing(scene))
    return jax.tree.map(lambda x: weight * x, found)


def _first(scene, ray):
    """Return the last ray, its hit, and the distance before it; rays pass through lights hidden from the camera."""
    shapes = scene.geometry
    state = ray, geometry.closest_hit(shapes, ray), jnp.zeros_like(ray.t_max)
    if not scene.hide_emitters:
        return state

    def go_on(state):
        ray, hit, passed = state
        surface = geometry.surface(shapes, ray, hit)
        beyond = spawn_ray(surface, ray.d, hit.primitive)._replace(t_max=ray.t_max - hit.t)
        return beyond, geometry.closest_hit(shapes, beyond), passed + dot(beyond.o - ray.o, ray.d)

    return lax.while_loop(lambda state: geometry.emits(shapes, state[1]), go_on, state)


def _nothing(scene) -> FirstHit:
    zero = jnp.zeros((3,), scene.camera.origin.dtype)
    return FirstHit(zero[:1], zero, zero)
