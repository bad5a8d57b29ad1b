"""The textbook path tracer (Kajiya 1986; PBRT 4 ed., chapter 14): read it first. `path` computes the same, faster.

With w = -ray.d, the radiance that arrives along a ray from the point that it meets is

    L(w) = Le(w) + integral of f(w, w') L(w') |cos theta'| dw'        over the directions w' of the sphere.

One direction, drawn by the bsdf, estimates the integral, so a path is a loop. A light sample also looks for light that
the bsdf seldom finds; each technique is weighted by the power heuristic (Veach 1997).

This tracer has no options, is not optimised and does not hide emitters. It is the oracle of tests: with the same random
numbers it equals a sample of `path` up to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from pathjax import bsdfs, emitters, media
from pathjax.compile import native_map
from pathjax.core import sampler
from pathjax.core.math import dot, spawn_ray
from pathjax.core.types import Number, Ray
from pathjax.emitters import Choice
from pathjax.integrators.pixel import camera_ray
from pathjax.integrators.random_numbers import Bounce, bounce_numbers
from pathjax.integrators.shadow import transmitted
from pathjax.integrators.vertex import Vertex, evaluate, is_smooth, leaving, sample, vertex, within
from pathjax.scene.scene import Scene
from pathjax.sensors import film
from pathjax.shapes import geometry


def radiance(scene: Scene, choice: Choice | None, ray: Ray, numbers: Callable) -> Float[Array, "3"]:
    """Return one estimate of the radiance that arrives along a ray, unbiased up to the scene's max_depth.

    Args:
        choice: how lights are chosen, from `emitters.choice`.
        numbers: depth -> Bounce.
    """
    shapes, materials = scene.geometry, scene.materials

    def bounce(state):
        ray, L, throughput, pdf, origin, passive, medium, depth, passed, _ = state
        u = numbers(depth + passed)
        here, flight = meet(scene, ray, medium, throughput, u)
        hit, throughput = here.hit, throughput * flight
        found = hit.primitive >= 0
        passes = bsdfs.has(materials, here.kind, "passes")
        free = passes & scene.free_passes
        depth, passed = jnp.where(free, depth, depth + 1), jnp.where(free, passed + 1, passed)
        goes_on = (here.scattered | (here.kind >= 0) & found) & (free | (depth < scene.max_depth))

        # Emission, of the surface or of the background.
        from_origin, arrival = ray._replace(o=origin), hit._replace(t=dot(here.surface.p - origin, ray.d))
        lamp, pdf_lamp = emitters.hit(scene.emitters, shapes, choice, from_origin, arrival, here.surface)
        sky, pdf_sky = emitters.background(scene.emitters, choice, ray.d)
        Le, pdf_light = jnp.where(found, lamp, sky), jnp.where(found, pdf_lamp, pdf_sky)
        L = L + jnp.where(here.scattered, 0, throughput * Le * share(pdf, pdf_light))

        if here.weight is not None:
            throughput = throughput * here.weight

        # Light sample. A Dirac lobe reflects none of it.
        if choice is not None and scene.samples_lights:
            light = emitters.sample(scene.emitters, shapes, choice, here.surface.p, u.light, u.triangle)
            f, pdf_bsdf = evaluate(scene, here, light.d)
            shadow_ray = spawn_ray(here.surface, light.d, hit.primitive)._replace(t_max=light.distance)
            lit = goes_on & is_smooth(scene, here) & (light.pdf > 0) & (pdf_bsdf > 0)
            start, most = leaving(scene, here, medium, light.d), scene.max_depth - 1 - depth
            arrival = transmitted(scene, shadow_ray, light.primitive, most, False, start)
            direct = f * light.Le / jnp.where(lit, light.pdf, 1) * share(jnp.where(lit, light.density, 1), pdf_bsdf)
            L = L + jnp.where(lit, throughput * arrival.light * direct, 0)

        # Bsdf sample.
        drawn, d = sample(scene, here, u.bsdf)
        throughput, passive = throughput * drawn.weight, passive * drawn.passive

        # Roulette, by the share of light that is left, which refraction does not change; `roulette` explains the 3.
        survival = jnp.where(depth >= scene.rr_depth, jnp.clip(3 * jnp.max(throughput) / passive, 0.05, 0.95), 1)
        alive = goes_on & (drawn.pdf > 0) & jnp.any(throughput > 0) & (u.roulette < survival)
        # A ray that passes straight on keeps its pdf and origin.
        pdf = jnp.where(passes, pdf, jnp.where(drawn.delta, jnp.inf, drawn.pdf))
        origin = jnp.where(passes, origin, here.surface.p)
        ray, medium = spawn_ray(here.surface, d, hit.primitive), leaving(scene, here, medium, d)
        return ray, L, throughput / survival, pdf, origin, passive, medium, depth, passed, alive

    zero, one, none = jnp.zeros_like(ray.o), jnp.ones_like(ray.t_max), jnp.int32(0)
    around = None if scene.media is None else scene.media.camera
    state = ray, zero, zero + 1, one * jnp.inf, ray.o, one, around, none, none, scene.max_depth > 0
    return lax.while_loop(lambda state: state[-1], bounce, state)[1]


def meet(
    scene: Scene, ray: Ray, medium: Int[Array, ""] | None, throughput: Float[Array, "3"], u: Bounce
) -> tuple[Vertex, Float[Array, "3"]]:
    """Return the vertex at the particle or surface that comes first, and the weight of the flight to it."""
    distance = jnp.full_like(ray.t_max, jnp.inf)
    if scene.scatters:
        distance = media.distance(scene.media, medium, ray, throughput, u.flight)
    hit = geometry.closest_hit(scene.geometry, ray._replace(t_max=jnp.minimum(distance, ray.t_max)))
    here = vertex(scene, ray, hit, u.leaf)
    if scene.scatters:
        here = within(here, ray, medium, distance)
    if medium is None:
        return here, jnp.ones_like(throughput)
    way, scattered = jnp.minimum(here.hit.t, ray.t_max), here.scattered if scene.scatters else None
    return here, media.flight_weight(scene.media, medium, ray, throughput, way, scattered)


def share(pdf: Float[Array, ""], other_pdf: Float[Array, ""]) -> Float[Array, ""]:
    """Power heuristic for a sample of density `pdf` that the other technique finds with `other_pdf`; inf: Dirac."""
    return jnp.where(jnp.isinf(pdf), 1, 1 / (1 + (other_pdf / pdf) ** 2))


@partial(jax.jit, static_argnames="spp")
def samples(scene: Scene, spp: int, seed: Number) -> Float[Array, "{spp} height width 3"]:
    """Return the samples of an image of a scene without names; their mean equals `pathjax.render`."""
    pixels = jnp.arange(film.pixel_count(scene.film), dtype=jnp.int32)
    choice = emitters.choice(scene.emitters, "mis")

    def sample(item, scene, choice):
        pixel, number = item
        stream = sampler.pixel_stream(seed, pixel)
        ray, weight = camera_ray(scene, pixel, stream, number)
        return weight * radiance(scene, choice, ray, lambda depth: bounce_numbers(scene, stream, number, depth))

    items = jnp.tile(pixels, spp), jnp.repeat(jnp.arange(spp, dtype=jnp.uint32), len(pixels))
    return native_map(sample, items, scene, choice).reshape(spp, *film.image_shape(scene.film), 3)
